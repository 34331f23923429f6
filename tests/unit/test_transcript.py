"""Lines for people, at any terminal width."""

from __future__ import annotations

import time
import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from talkcli.frozen import replace
from talkcli.goals.goal import By, Goal, Sender
from talkcli.goals.states import State
from talkcli.protocol.events import (
    Event,
    GoalInterrupted,
    PausedChanged,
    ServerStatus,
    Snapshot,
    StateChanged,
    TextAdded,
    TextMissing,
    WordHeard,
)
from talkcli.terminal.goals import goal_lines, reason_forms, sender_forms, setting_lines, status_lines
from talkcli.terminal.text import Screen, cut, fit_row, width
from talkcli.terminal.transcript import Transcript, log_lines

PATROL = Sender(812, 1000, "talk", "/bin/bash /home/robot/bin/patrol.sh --fast", "night watch")
NOON = time.mktime((2024, 5, 17, 12, 0, 0, 0, 0, -1))
GOAL = Goal("4k7f-7", State.PENDING, "battery low", client=PATROL, queued_at=NOON)
SERVER = {"pid": 1, "socket": "/run/talk/talk.sock", "boot": "4k7f"}

#: Programs with options, which start another program.
STARTERS = [
    *("timeout -s KILL -k 5 1m", "timeout --signal KILL --kill-after=5 0.5", "nice -n 5", "nice -n5", "ionice -c 3"),
    *("env -u X", "sudo -u robot -E A=1", "/usr/bin/time -f %e", "stdbuf -oL", "chrt -f 5"),
    *("taskset -c 0,1", "flock -w 5 /run/lock/x", "xargs -n 1"),
]

TEXTS = st.text(st.characters(exclude_categories=["Cs"]), max_size=80)
NAMES = st.none() | TEXTS
SENDERS = st.none() | st.builds(
    Sender,
    st.none() | st.integers(1, 2**22),
    st.just(1000),
    st.just("talk"),
    NAMES,
    NAMES.map(lambda name: name or None),
)
BYS = st.none() | st.builds(By, goal=st.sampled_from(["4k7f-1", "x" * 64])) | st.builds(By, client=SENDERS)
GOALS = st.builds(
    Goal,
    id=st.sampled_from(["4k7f-1", "4k7f-123456", "i" * 64, "door:open"]),
    state=st.sampled_from([state for state in State if state.terminal]),
    text=NAMES,
    reason=st.sampled_from([None, "canceled", "audio_device"]),
    by=BYS,
    message=st.none() | TEXTS.map("speech failed: {}".format),
    client=SENDERS,
    ended_at=st.none() | st.sampled_from([NOON, NOON - 1e6]),
    duration=st.none() | st.just(12.3),
)
WIDTHS = st.integers(60, 200)


def plain(line: str) -> bool:
    """Return whether a line contains no control characters."""
    return not any(unicodedata.category(character) in {"Cc", "Cf", "Zl", "Zp"} for character in line)


def test_width_counts_columns() -> None:
    assert [width(text) for text in ("", "abc", "日本", "é", "e\u0301", "\x1b[1;32mok\x1b[0m")] == [0, 3, 4, 1, 1, 2]


@given(TEXTS, st.integers(1, 100))
def test_a_cut_text_fits_and_is_as_long_as_possible(text: str, room: int) -> None:
    shown = cut(text, room)
    assert width(shown) <= room
    assert shown == text or shown.endswith("…")
    if shown != text:
        assert text.startswith(shown[:-1])
        assert width(shown) >= room - 1  # the next character may be two columns wide


@given(
    st.text("ab日", max_size=90), st.lists(st.text("ab日", min_size=1, max_size=90), min_size=1), WIDTHS, st.booleans()
)
def test_a_row_fits_and_gives_half_its_width_to_the_text(text: str, details: list[str], room: int, long: bool) -> None:
    text, details = f'"{text}"', sorted(details, key=width, reverse=True)
    row = fit_row("", text, details, 0, Screen(room, long=long))
    assert width(row) <= room
    shown = row[: row.index('"', 1) + 1]
    assert shown == text or "…" in shown
    if shown != text:
        assert width(shown) >= (16 if long else room // 2) - 2  # the next character may be two columns wide
        assert width(row) >= room - 2
    if width(text) + 2 + width(details[0]) <= room and width(details[0]) <= room // 2 - 2:
        assert row == f"{text}  {details[0]}"
    assert fit_row("", text, details, 0, Screen()) == f"{text}  {details[0]}"


@given(st.lists(GOALS, max_size=5), WIDTHS)
def test_a_log_fits_and_its_columns_line_up(goals: list[Goal], room: int) -> None:
    lines = log_lines(goals, Screen(room), NOON)
    assert len(lines) == len(goals)
    assert all(width(line) <= room for line in lines)
    assert all(map(plain, lines))
    for line, goal in zip(lines, goals, strict=True):
        assert goal.state.name in line
    starts = {width(line[: line.index('"')]) for line, goal in zip(lines, goals, strict=True) if goal.text is not None}
    assert len(starts) <= 1


@given(st.lists(GOALS, max_size=5))
def test_a_log_without_a_terminal_is_not_cut(goals: list[Goal]) -> None:
    for line, goal in zip(log_lines(goals, Screen(), NOON), goals, strict=True):
        assert goal.id in line
        assert sender_forms(goal.client, Screen())[0].rstrip() in line
        assert goal.state is State.SUCCEEDED or reason_forms(goal, Screen())[0].rstrip() in line
    long = Screen(long=True)
    for line, goal in zip(log_lines(goals, long, NOON), goals, strict=True):
        assert goal.id in line
        assert sender_forms(goal.client, long)[0].rstrip() in line
        assert reason_forms(goal, long)[0].rstrip() in line


def test_goals_of_the_running_server_are_shown_by_their_numbers() -> None:
    goals = [
        replace(GOAL, state=State.SUCCEEDED, ended_at=NOON),
        replace(GOAL, id="9a9a-3", state=State.RECALLED, reason="replaced", by=By("4k7f-7"), ended_at=NOON),
        replace(GOAL, id="4k7f-b", state=State.RECALLED, reason="replaced", by=By("9a9a-4"), ended_at=NOON),
    ]
    assert [line.split()[2] for line in log_lines(goals, Screen(boot="4k7f"), NOON)] == ["7", "9a9a-3", "4k7f-b"]
    assert [line.split("replaced by ")[-1] for line in log_lines(goals, Screen(boot="4k7f"), NOON)[1:]] == [
        "7",
        "9a9a-4",
    ]
    for screen in (Screen(long=True, boot="4k7f"), Screen()):
        assert [line.split()[2] for line in log_lines(goals, screen, NOON)] == [goal.id for goal in goals]
    lines = status_lines(ServerStatus(SERVER, None, (), tuple(goals)), Screen(), NOON)
    assert [line[9:].split()[1] for line in lines[-3:]] == ["7", "9a9a-3", "4k7f-b"]


def test_the_text_gets_most_of_a_line() -> None:
    ended = replace(GOAL, text="please step back " * 9, state=State.SUCCEEDED, client=replace(PATROL, name=None))
    preempted = replace(ended, state=State.PREEMPTED, reason="canceled", by=By(client=PATROL))
    first, second = log_lines([ended, preempted], Screen(80, boot="4k7f"), NOON)
    assert first == '--:--:--  SUCCEEDED  7  "please step back please step back please s…"  patrol.sh'
    assert second == '--:--:--  PREEMPTED  7  "please step back please s…"  patrol.sh  by "night watc…'
    (long,) = log_lines([ended], Screen(100, long=True), NOON)
    assert long.endswith('"please step bac…"  /bin/bash /home/robot/bin/patrol.sh --fast, pid 812')


@given(st.lists(GOALS, max_size=4), GOALS, WIDTHS, st.booleans())
def test_a_transcript_and_a_status_fit(goals: list[Goal], goal: Goal, room: int, full: bool) -> None:
    now = replace(goal, state=State.ACTIVE, started_at=NOON, paused=True, key="k" * 64, priority=10**6)
    waiting = tuple(replace(other, state=State.PENDING, ttl=5.0, queued_at=NOON) for other in goals)
    status = ServerStatus(SERVER, now, waiting, tuple(goals))
    events: list[Event] = [
        Snapshot(status),
        StateChanged(goal.id, State.ACTIVE, NOON),
        PausedChanged(True, goal.id, By(client=goal.client), NOON),
        StateChanged(goal.id, State.PREEMPTING, NOON),
        StateChanged(goal.id, goal.state, NOON, goal=goal),
    ]
    transcript = Transcript(full=full, words=True)
    shown = [transcript.lines(event, Screen(room), NOON) for event in events]
    for lines in (status_lines(status, Screen(room), NOON), *shown):
        assert all(width(line) <= room and plain(line) for line in lines), lines
    assert shown[-1]


def test_a_date_is_shown_only_for_another_day() -> None:
    ended = replace(GOAL, state=State.SUCCEEDED, ended_at=NOON)
    yesterday = replace(ended, ended_at=NOON - 86400)
    assert log_lines([ended], Screen(), NOON)[0].startswith("12:00:00  SUCCEEDED")
    lines = log_lines([yesterday, ended], Screen(), NOON)
    assert lines[0].startswith("May 16 12:00:00  SUCCEEDED")
    assert lines[1].startswith("       12:00:00  SUCCEEDED")
    assert log_lines([replace(ended, ended_at=None)], Screen(), NOON)[0].startswith("--:--:--  ")


def test_brief_states_are_left_out_on_a_terminal() -> None:
    def shown_states(*states: State, full: bool, paused: bool = False) -> list[str]:
        transcript = Transcript(full=full, words=False)
        transcript.lines(Snapshot(ServerStatus({**SERVER, "paused": paused}, None, (), ())), Screen(), NOON)
        lines = []
        for state in states:
            goal = replace(GOAL, state=state) if state is State.PENDING or state.terminal else None
            lines += transcript.lines(StateChanged(GOAL.id, state, NOON, goal=goal), Screen(), NOON)
        return [line.split()[1] for line in lines]

    course = State.PENDING, State.ACTIVE, State.PREEMPTING, State.PREEMPTED
    assert shown_states(*course, full=True) == [state.name for state in course]
    assert shown_states(State.ACTIVE, full=True) == ["ACTIVE"], "events of unknown goals are shown, too"
    assert shown_states(*course, full=False) == ["ACTIVE", "PREEMPTED"]
    assert shown_states(*course, full=False, paused=True) == ["PENDING", "ACTIVE", "PREEMPTED"]
    assert shown_states(State.PENDING, State.RECALLED, full=False) == ["RECALLED"]


def test_a_goal_that_waits_for_another_is_shown() -> None:
    transcript = Transcript(full=False, words=False)
    transcript.lines(Snapshot(ServerStatus(SERVER, replace(GOAL, id="a", state=State.ACTIVE), (), ())), Screen(), NOON)
    waits = StateChanged(GOAL.id, State.PENDING, NOON, goal=GOAL)
    assert '"battery low"' in transcript.lines(waits, Screen(80), NOON)[0]
    transcript.lines(StateChanged("a", State.SUCCEEDED, NOON), Screen(80), NOON)
    active = transcript.lines(StateChanged(GOAL.id, State.ACTIVE, NOON), Screen(80), NOON)
    assert '"battery low"' in active[0]  # the event itself has no text


@pytest.mark.parametrize(("words", "count"), [(True, 1), (False, 0)])
def test_words_are_shown_only_if_requested(words: bool, count: int) -> None:
    event = WordHeard("4k7f-7", "low", 8, 11, 2, 0.51, NOON)
    lines = Transcript(full=False, words=words).lines(event, Screen(80), NOON)
    assert lines == ["12:00:00  word        4k7f-7  low  0.51 s"] * count
    lines = Transcript(full=False, words=words, boot="4k7f").lines(event, Screen(80), NOON)
    assert lines == ["12:00:00  word        7    low  0.51 s"] * count


def test_a_growing_text_is_shown_by_sentences_and_waits_are_shown_once() -> None:
    transcript = Transcript(full=False, words=False, boot="4k7f")
    whole = ["One. Tw"]

    def shown(event: Event) -> list[str]:
        return [line.partition("  ")[2] for line in transcript.lines(event, Screen(80), NOON)]

    def add(text: str) -> list[str]:
        whole.append(text)
        return shown(TextAdded(GOAL.id, len("".join(whole[:-1])), text, NOON))

    heard, waits = WordHeard(GOAL.id, "One", 0, 3, 1, 0.0, NOON), TextMissing(GOAL.id, waits=True, at=NOON)
    shown(StateChanged(GOAL.id, State.PENDING, NOON, goal=replace(GOAL, text=whole[0], more=True)))
    (active,) = shown(StateChanged(GOAL.id, State.ACTIVE, NOON))
    assert active.startswith('ACTIVE      7    "One. Tw…" ')
    assert shown(waits) == []  # nothing was heard yet
    assert [add("o"), add("."), add(" Th")] == [[], [], ['text        7    "Two."']]
    assert shown(heard) == shown(replace(waits, waits=False)) == []
    assert shown(waits) == ['text        7    "Th"', "waiting     7    for more text"]
    assert shown(waits) == []
    assert add("ree! 四。 5") == ['text        7    "ree! 四。"']
    (ended,) = shown(StateChanged(GOAL.id, State.SUCCEEDED, NOON, goal=replace(GOAL, text="One. Two.", duration=1.0)))
    assert ended.startswith('SUCCEEDED   7    "One. Two." ')
    hidden = replace(GOAL, text=None, more=True)
    shown(StateChanged(GOAL.id, State.PENDING, NOON, goal=hidden))
    assert add(" a. b") == []
    assert transcript.lines(TextAdded("4k7f-8", 3, "a. b", NOON), Screen(80), NOON) == []


@pytest.mark.parametrize(
    ("changes", "state", "text", "now"),
    [
        ({"more": True, "waits": True}, "ACTIVE, waiting for text", '"battery low…"', "waiting for text, for 2.0 s"),
        ({"more": True}, "ACTIVE", '"battery low…"', "for 2.0 s"),
        ({"waits": True, "paused": True}, "ACTIVE, paused, waiting for text", '"battery low"', "paused, waiting for"),
        ({"more": True, "waits": True, "state": State.ABORTED}, "ABORTED", '"battery low"', ""),
        ({"paused": True, "interrupted_by": "8"}, "ACTIVE, interrupted by 8", '"battery low"', "interrupted by 8, for"),
    ],
)
def test_a_silent_goal_says_why(changes: dict[str, object], state: str, text: str, now: str) -> None:
    goal = replace(GOAL, **{"state": State.ACTIVE, "started_at": NOON - 2, **changes})
    rows = dict(line.split(maxsplit=1) for line in goal_lines(goal, Screen(), NOON))
    assert (rows["state"], rows["text"]) == (state, text)
    line = status_lines(ServerStatus(SERVER, goal, (), ()), Screen(120), NOON)[3]
    assert text in line
    assert now in line
    assert ("waiting" in line) == ("waiting" in state)


def test_interrupted_goals_are_shown_between_the_current_one_and_the_queue() -> None:
    aside = replace(GOAL, id="4k7f-8", state=State.ACTIVE, started_at=NOON)
    interrupted = replace(aside, id="4k7f-7", paused=True, interrupted_by="4k7f-8")
    status = ServerStatus(SERVER, aside, (replace(GOAL, id="4k7f-9"),), (), (interrupted,))
    shown = [line.split()[:2] for line in status_lines(status, Screen(), NOON)[3:]]
    assert shown == [["now", "8"], ["next", "7"], ["queue", "9"], ["said", "nothing"]]
    lines = Transcript(full=False, words=False).lines(Snapshot(status), Screen(80), NOON)
    assert [line[10:].split('"')[0].split() for line in lines[1:]] == [
        ["ACTIVE", "8"],
        ["ACTIVE", "7"],
        ["paused", "7", "interrupted", "by", "8"],
        ["PENDING", "9"],
    ]


def test_an_interruption_and_its_end_are_shown() -> None:
    transcript = Transcript(full=False, words=False, boot="4k7f")
    events: list[Event] = [
        StateChanged(GOAL.id, State.PENDING, NOON, goal=GOAL),
        StateChanged(GOAL.id, State.ACTIVE, NOON),
        GoalInterrupted(GOAL.id, By(goal="4k7f-8"), NOON),
        StateChanged(GOAL.id, State.ACTIVE, NOON),
    ]
    lines = [line for event in events for line in transcript.lines(event, Screen(80), NOON)]
    assert lines[1:] == ["12:00:00  paused      7    interrupted by 8", "12:00:00  continues   7"]


def test_forms_of_a_sender_get_shorter_and_keep_the_script() -> None:
    long = Screen(long=True)
    assert sender_forms(PATROL, long) == [
        '"night watch" (/bin/bash /home/robot/bin/patrol.sh --fast, pid 812)',
        '"night watch" (patrol.sh, pid 812)',
    ]
    assert sender_forms(PATROL, Screen()) == ['"night watch"']
    assert sender_forms(replace(PATROL, name=None), long)[1:] == ["patrol.sh, pid 812"]
    assert sender_forms(replace(PATROL, name=None), Screen()) == ["patrol.sh"]
    assert sender_forms(None, long) == sender_forms(None, Screen()) == ["unknown"]


@pytest.mark.parametrize(
    ("parent", "script"),
    [
        ("-bash", "-bash"),
        ("./patrol", "patrol"),
        ("/", "/"),
        # interpreters
        ("/usr/bin/python3.11 /opt/a.py x", "a.py"),
        ("python3 -u -W ignore -Wonce /opt/a.py", "a.py"),
        ("python3 -m robot.patrol x", "robot.patrol"),
        ("python3 -c import talkcli", "python3"),
        ("bash -e a.sh", "a.sh"),
        ("bash -euo pipefail a.sh -c", "a.sh"),
        ("bash -c talk say x", "bash"),
        ("bash -lc talk say x", "bash"),
        ("bash -s x", "bash"),
        ("bash /dev/fd/3", "bash"),
        ("/bin/sh /proc/self/fd/3 x", "sh"),
        ("perl -ne print a", "perl"),
        ("node --require x.js a.js", "a.js"),
        # programs that start another one
        *((f"{starter} ./a", "a") for starter in STARTERS),
        ("timeout 60 python3 a.py", "a.py"),
        ("env -i A=1 B=2 ./a C=3", "a"),
        ("sudo -Eu robot -- ./a -x", "a"),
        ("sudo nohup setsid nice timeout 60 bash a.sh", "a.sh"),
        # without a program
        ("timeout 60", "timeout"),
        ("sudo -u", "sudo"),
        ("nice -", "nice"),
        ("env bash", "bash"),
        ("env  ", "env"),
        (None, "a program"),
    ],
)
def test_a_sender_is_shown_as_the_script_that_it_runs(parent: str | None, script: str) -> None:
    assert sender_forms(Sender(parent=parent), Screen()) == [script]


def test_the_reason_for_the_end_of_a_goal_is_shown() -> None:
    def why(state: State, reason: str | None = None, by: By | None = None, message: str | None = None) -> list[str]:
        goal = replace(GOAL, state=state, reason=reason, by=by, message=message, duration=2.04)
        return reason_forms(goal, Screen())

    assert why(State.SUCCEEDED) == ["2.0 s"]
    assert why(State.PREEMPTED, "preempted", By("4k7f-8"), "Talk preempted: by goal 4k7f-8")[0] == "preempted by 4k7f-8"
    canceled = why(State.PREEMPTED, "canceled", By(client=PATROL), "Talk preempted: the goal was cancelled")
    assert canceled[-2:] == ['cancelled by "night watch"', 'by "night watch"']
    expired = why(State.RECALLED, "expired", None, "not spoken: its time was over")
    assert expired == ["expired: its time was over", "expired"]
    assert why(State.ABORTED, "audio_device", None, "speech failed: no: device") == ["audio_device: no: device"]
    assert why(State.PREEMPTED, "shutdown", None, "Talk preempted: the server was stopped")[1] == "shutdown"
    assert why(State.PREEMPTED, "shutdown", None, "Talk preempted") == ["shutdown", "shutdown"]  # from an older server
    older_server = why(State.ABORTED, "audio_device", None, "Talk aborted: no: device")
    assert older_server == ["audio_device: no: device"]
    throttled = why(State.REJECTED, "throttled", By("4k7f-1"), "not spoken: the same text")
    assert throttled == ["throttled by 4k7f-1: the same text"]
    assert why(State.PREEMPTED, None) == ["preempted", "preempted"]


def test_settings_are_shown_as_their_options_accept_them() -> None:
    lines = setting_lines({"rate": 200, "volume": 0.5, "voice": None, "preempt": True, "ttl": None, "new": None})
    assert lines == ["rate     200", "volume   0.5", "voice    default", "preempt  yes", "ttl      0", "new      -"]
