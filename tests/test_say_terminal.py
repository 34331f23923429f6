"""`say -wf` and `wait -f` on a terminal highlight each word as it is heard, and leave the whole line."""

from __future__ import annotations

import signal
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from talkcli.terminal.text import ELLIPSIS, MeasuredText, printable, width
from tests.conformance.bareserve import TALK
from tests.support.screen import Screen, Terminal

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from tests.support.processes import Talk

    Run = Callable[..., Terminal]

#: Attributes of cells: the current word, and the words after it.
LIT, AHEAD = "7", "2"


@pytest.fixture
def in_terminal(scripted: Talk) -> Iterator[Run]:
    """Return a function that runs `talk` in a terminal: `in_terminal("say", "-wf", "--", text, columns=40)`."""
    opened: list[Terminal] = []

    def start(*arguments: str, columns: int = 80, **env: str) -> Terminal:
        opened.append(Terminal([*TALK, *arguments], {**scripted.env, **env}, columns))
        return opened[-1]

    yield start
    for terminal in opened:
        terminal.close()


def painted(terminal: Terminal, columns: int = 80) -> Iterator[Screen]:
    """Draw the terminal's output again, and yield the screen after each redraw."""
    screen = Screen(columns)
    before, *redraws = terminal.raw.decode().split("\r\x1b[2K")
    screen.draw(before)
    for text in redraws:
        screen.draw(f"\r\x1b[2K{text}")
        yield screen


def test_each_word_is_highlighted_while_it_is_heard(scripted: Talk, in_terminal: Run) -> None:
    text = "length=0.4 battery low now"
    terminal = in_terminal("say", "-wf", "--", text)
    terminal.wait_until(lambda screen: bool(screen.marked(LIT)))  # before the rest is heard
    assert terminal.finish() == 0
    seen: list[str] = []
    for screen in painted(terminal):
        lit = screen.marked(LIT)
        if lit and lit not in seen:
            seen.append(lit)
            assert f"  ACTIVE     {text}" in screen.last
            assert screen.marked(AHEAD) == text[text.index(lit) + len(lit) :]
    goal_id = scripted.watcher.goals()[0]
    assert seen == ["length=0.4", "battery", "low", "now"]
    assert terminal.screen.lines == [f"{goal_id}  SUCCEEDED  {text}", ""]
    assert not terminal.screen.marked(LIT, 0)
    assert not terminal.screen.marked(AHEAD, 0)
    assert terminal.screen.attributes == ""


def test_a_long_text_scrolls_and_is_shown_whole_at_the_end(scripted: Talk, in_terminal: Run) -> None:
    words = [f"word{number}" for number in range(60)]
    text = " ".join(["length=0.6", *words])
    terminal = in_terminal("say", "-wf", "--", text, columns=50)
    assert terminal.finish() == 0
    lit: list[str] = []
    for screen in painted(terminal, 50):
        if screen.marked(LIT):
            lit.append(screen.marked(LIT))
            assert screen.wraps == 0
    assert lit[-1] == words[-1]
    assert set(words) & set(lit) == set(lit) - {"length=0.6"}  # words are never cut
    assert len(set(lit)) > 20
    goal_id = scripted.watcher.goals()[0]
    whole = f"{goal_id}  SUCCEEDED  {text}"
    assert "".join(line.ljust(50) for line in terminal.screen.lines).rstrip() == whole


def test_wide_and_control_characters_do_not_break_the_line(in_terminal: Run) -> None:
    text = "length=0.3 日本語の文章です a\x1b[31mred \u202egnp 👩👩👩👩 é é é の終わり\x07"
    terminal = in_terminal("say", "-wf", "--", text, columns=5)
    assert terminal.finish() == 0  # the screen fails at unknown control sequences
    *before, _ = (screen.wraps for screen in painted(terminal, 5))
    assert len(before) > 3
    assert max(before) == 0
    assert terminal.screen.lines[-1] == ""
    shown = "".join(terminal.screen.lines)
    assert "SUCCEEDED" in shown  # on two lines
    assert printable(text).replace(" ", "") in shown.replace(" ", "")


def test_the_line_is_redrawn_when_the_terminal_is_resized(scripted: Talk, in_terminal: Run) -> None:
    text = "never-ends words=1 " + " ".join(f"word{number}" for number in range(20))
    terminal = in_terminal("say", "-wf", "--", text, columns=100)
    terminal.wait_until(lambda screen: screen.marked(LIT) == "never-ends")
    assert len(terminal.screen.last) == 99
    terminal.resize(60)
    terminal.wait_until(lambda screen: len(screen.last) == 59 and screen.last.endswith("…"))
    terminal.resize(120)
    terminal.wait_until(lambda screen: len(screen.last) == 119)
    assert terminal.screen.wraps == 0
    scripted.run("cancel")
    assert terminal.finish() == 7


def test_a_pause_and_an_interruption_are_shown_and_ctrl_c_leaves_the_terminal_clean(
    scripted: Talk, in_terminal: Run
) -> None:
    terminal = in_terminal("say", "-wf", "--", "never-ends words=2 and so on", columns=200)
    terminal.wait_until(lambda screen: screen.marked(LIT) == "words=2")
    scripted.run("pause")
    terminal.wait_until(lambda screen: "  PAUSED     never-ends words=2 and so on" in screen.last)
    scripted.run("resume")
    terminal.wait_until(lambda screen: "  ACTIVE     never-ends words=2 and so on" in screen.last)
    aside = scripted.run("say", "--interject", "never-ends").id
    terminal.wait_until(lambda screen: "  INTERRUPTED  never-ends words=2 and so on" in screen.last)
    scripted.run("cancel", aside)
    terminal.wait_until(lambda screen: "  ACTIVE     never-ends words=2 and so on" in screen.last)
    terminal.type(b"\x03")
    assert terminal.finish() == 128 + signal.SIGINT
    goal_id = scripted.watcher.goals()[0]
    assert scripted.goal(goal_id)["state"] == "PREEMPTED"
    first, second, last = terminal.screen.lines
    assert first == f"{goal_id}  PREEMPTED  never-ends words=2 and so on"
    assert terminal.screen.marked(AHEAD, 0) == " and so on"  # the words that weren't heard
    assert second.startswith(f"talk: {goal_id}: Talk preempted")
    assert (last, terminal.screen.attributes) == ("", "")


def test_the_line_is_whole_after_a_timeout_or_a_lost_server(scripted: Talk, in_terminal: Run) -> None:
    terminal = in_terminal("say", "-f", "-t", "0.3", "--", "never-ends words=1 text")
    assert terminal.finish() == 124
    assert terminal.screen.lines[0] == f"{scripted.watcher.goals()[0]}  PREEMPTED  never-ends words=1 text"
    terminal = in_terminal("say", "-wf", "--", "never-ends words=1 text")
    terminal.wait_until(lambda screen: screen.marked(LIT) == "never-ends")
    scripted.kill()
    assert terminal.finish() == 12
    assert "  LOST       never-ends words=1 text" in terminal.screen.lines[0]
    assert "may still be spoken" in "".join(terminal.screen.lines[1:3])


def test_a_failed_goal_shows_the_heard_words_and_the_reason(in_terminal: Run) -> None:
    terminal = in_terminal(
        "say", "-wf", "--", "length=0.4 fail=audio_lost message=no_cable words=2 never heard", columns=200
    )
    assert terminal.finish() == 4
    first, second, last = terminal.screen.lines
    assert "  ABORTED    length=0.4 " in first
    assert terminal.screen.marked(AHEAD, 0).endswith("never heard")
    assert second.endswith("speech failed: no cable; find out why with: talk doctor")
    assert last == ""


def test_a_terminal_without_colour_gets_one_line_per_event(scripted: Talk, in_terminal: Run) -> None:
    terminal = in_terminal("say", "-wf", "length=0.2", "low", NO_COLOR="1")
    assert terminal.finish() == 0
    goal_id = scripted.watcher.goals()[0]
    events = ["PENDING", "ACTIVE", "word 1 0-10 0.000 length=0.2", "word 2 11-14 0.100 low", "SUCCEEDED"]
    assert terminal.screen.lines == [*(f"{goal_id} {event}" for event in events), ""]
    assert b"\x1b" not in terminal.raw


def test_wait_shows_the_active_goal_and_all_results(scripted: Talk, in_terminal: Run) -> None:
    first = scripted.run("say", "never-ends words=1 first").id
    second = scripted.run("say", "length=0.3 second").id
    third = scripted.run("say", "length=0.3 third").id
    scripted.watcher.wait_for_word(first)
    terminal = in_terminal("wait", "-f", third, first, second, columns=200)
    terminal.wait_until(lambda screen: screen.last == f"{first}  ACTIVE     never-ends words=1 first")
    scripted.run("cancel", third)
    terminal.wait_until(lambda screen: f"{third}  RECALLED   length=0.3 third" in screen.lines)
    terminal.wait_until(lambda screen: screen.last == f"{first}  ACTIVE     never-ends words=1 first")
    scripted.run("cancel", first)
    assert terminal.finish() == 6  # the first goal's exit code
    shown = [line.split("  ")[0:2] for line in terminal.screen.lines[:3]]
    assert shown == [[third, "RECALLED"], [first, "PREEMPTED"], [second, "SUCCEEDED"]]
    assert [line[:5] for line in terminal.screen.lines[3:]] == ["talk:", "talk:", ""]


def test_typed_lines_are_highlighted_one_after_the_other(scripted: Talk, in_terminal: Run) -> None:
    terminal = in_terminal("say", "--lines", "-f", columns=100)
    terminal.type(b"length=0.5 words=1 one\n")
    terminal.wait_until(lambda screen: screen.marked(LIT) == "length=0.5")
    terminal.resize(90)
    terminal.type(b"\0\nlength=0.1 two\n\x04")
    assert terminal.finish() == 5
    first, second = (goal for goal in scripted.watcher.goals() if "ACTIVE" in scripted.watcher.states(goal))
    lines = terminal.screen.lines
    assert f"{first}  SUCCEEDED  length=0.5 words=1 one" in lines
    assert f"{second}  SUCCEEDED  length=0.1 two" in lines
    assert [line for line in lines if line.startswith("talk: line 2: ")] != []
    assert lines[-1] == ""
    assert terminal.screen.attributes == ""


def test_aborted_goals_refer_to_the_doctor_unless_their_texts_are_the_cause(scripted: Talk) -> None:
    causes = [f"fail={reason}" for reason in ("nothing_to_say", "text_stalled", "broken_off")]
    for text, named in (("fail=audio_lost", True), ("length=0", False), *((cause, False) for cause in causes)):
        assert scripted.run("say", "--wait", "--", text).err.endswith("; find out why with: talk doctor\n") == named


# Cutting of long sentences


LONG = "the quick brown fox jumps over the lazy dog"
#: Characters whose width is hard to determine: wide, combining, joined or escaped.
ODD = st.text(st.sampled_from("ab .日本é\u0301👩\u200d💻❤\ufe0f🇩🇪\n\x1b\\\u202eﷺ"), max_size=80)


def position(text: str, word: str) -> tuple[int, int]:
    start = text.index(word)
    return start, start + len(word)


def test_a_sentence_is_cut_around_the_current_word() -> None:
    assert MeasuredText("battery low").view(8, 11, 11) == ("battery ", "low", "")
    assert MeasuredText("").view(0, 0, 80) == ("", "", "")
    sentence = MeasuredText(LONG)
    assert sentence.view(*position(LONG, "the"), 20) == ("", "the", f" quick brown fox{ELLIPSIS}")
    assert sentence.view(*position(LONG, "jumps"), 20) == (f"{ELLIPSIS} fox ", "jumps", f" over th{ELLIPSIS}")
    assert sentence.view(*position(LONG, "dog"), 20) == (f"{ELLIPSIS}s over the lazy ", "dog", "")
    heard, lit, ahead = MeasuredText("a" * 50 + " " + "b" * 50).view(51, 101, 12)
    assert (lit[:3], ahead) == ("bbb", ELLIPSIS), "the start of a word wider than the terminal is shown"
    assert width(heard + lit + ahead) <= 12
    for end in (0, 3, 7, 11, 99):
        assert MeasuredText("battery low").split(end) == ("battery low"[:end], "battery low"[end:])


def test_escaped_characters_do_not_shift_the_highlight() -> None:
    text = "a\x1b[31m \u202ered\nnext"
    assert MeasuredText(text).view(*position(text, "next"), 80)[:2] == ("a\\x1b[31m \\u202ered\\n", "next")


@given(text=ODD, start=st.integers(-3, 90), length=st.integers(-3, 30), columns=st.integers(-2, 60))
def test_the_view_fits_the_terminal_and_is_always_printable(text: str, start: int, length: int, columns: int) -> None:
    sentence, whole = MeasuredText(text), printable(text)
    assert sentence.split(len(sentence)) == (whole, "")
    heard, lit, ahead = sentence.view(start, start + length, columns)
    shown = heard + lit + ahead
    assert width(shown) <= max(0, columns)
    assert shown.isprintable() or all(character.isprintable() or character in "\u0301\ufe0f" for character in shown)
    if width(whole) <= columns:
        assert shown == whole
    elif columns >= 15 and 0 <= start < len(text) and length > 0:
        assert lit
        assert shown.removeprefix(ELLIPSIS).removesuffix(ELLIPSIS) in whole


@given(st.lists(st.text(st.sampled_from("a 日\n\u0301"), max_size=5)))
def test_a_text_that_grows_is_measured_like_a_whole_one(parts: list[str]) -> None:
    grown = MeasuredText("")
    for part in parts:
        grown.extend(part)
    whole = MeasuredText("".join(parts))
    assert (vars(grown), len(grown)) == (vars(whole), len("".join(parts)))
