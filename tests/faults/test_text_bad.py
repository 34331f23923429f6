"""Bad texts: every text is spoken or refused, and the server survives."""

from __future__ import annotations

import itertools
import os
import random
import re
import subprocess
import sys
import time
import unicodedata
import wave
from typing import TYPE_CHECKING

import pytest

from talkcli.engine.parent.render import render
from talkcli.goals.options import bad_text
from tests.conformance.hearing import HOME, LOW, assert_aborted, assert_same, send, start_goal
from tests.faults.broken import await_end
from tests.support.compare import assert_heard
from tests.support.connection import PATIENCE
from tests.support.reference import Sentence
from tests.support.reference import render as reference
from tests.support.timing import assert_within, limits
from tests.tools.fuzz_texts import SENTENCES, Case, list_voices, speak_all
from tests.tools.fuzz_texts import cases as mutated_texts

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from tests.conftest import MakeTalk
    from tests.support.processes import Talk
    from tests.support.sink import Sink

#: Seconds of the slow test of mutated texts, or TALK_TEST_FUZZ seconds if that is set.
_FUZZ_S = float(os.environ.get("TALK_TEST_FUZZ") or (30 if os.environ.get("CI") else 5))
#: Number of characters of a text in the test of every character.
_TEXT_CHARS = 1000
#: All characters are tested in CI, and if TALK_TEST_FUZZ is set. Otherwise, one in 20 or 200 is.
_ALL = bool(os.environ.get("CI") or os.environ.get("TALK_TEST_FUZZ"))
_COMMON_STEP, _LARGE_STEP = (1, 1) if _ALL else (20, 200)

MARKUP = (
    "<speak>hello</speak> &lt; &#65; {{x}}",
    '<audio src="file:///etc/passwd"/><voice name="de"><prosody rate="x-slow">hello</prosody></voice>',
    "[[h@'loU]] [[_^_de]]",
)
#: The longest words, scripts from right to left, and ordinary sentences, each with its voice.
RENDERED = [
    ("gmw/de", "Rindfleischetikettierungsüberwachungsaufgabenübertragungsgesetz"),
    ("trk/tr", "muvaffakiyetsizleştiricileştiriveremeyebileceklerimizdenmişsinizcesine"),
    ("grk/el", "λοπαδοτεμαχοσελαχογαλεοκρανιολειψανοδριμυποτριμματοσιλφιοκαραβομελιτο"),
    ("sem/ar", "البطارية منخفضة، سأعود إلى القاعدة ٣ مرات (AB-12)."),
    ("sem/he", "הסוללה חלשה, אני חוזר לבסיס 12:30."),
    ("gmw/en", "low \u202eyrettab\u202c \u2067שלום\u2069 now"),
    *(("gmw/en", SENTENCES[0]), ("gmw/de", SENTENCES[2]), ("zle/ru", SENTENCES[9])),
]
#: Texts with thousands of similar characters, fewer if they would be spoken for minutes.
ENDLESS = {
    "letters": "a" * 10_000,
    "signs": "%&$#" * 500,
    "points": "." * 9_999 + "a",
    "letters with points": "e.g." * 500,
    "accents": "e" + "\u0301" * 9_999,
    "blanks": " " * 9_999 + "a",
    "digits": "7" * 2_000,
    "vowel signs": "कि" + "ि" * 9_000,
    "joiners": "a\u200d" * 5_000,
    "ideographs": "電" * 1_000,
    "syllables": "한" * 1_000,
    "arabic": "ب" * 2_000,
}
#: The texts of the default run. The others take longer, and are similar texts in other scripts.
QUICK = ("letters", "signs", "points", "letters with points", "accents", "blanks")


def assert_rendered(path: Path, text: str, voice: str) -> None:
    """Assert that a text has the same samples as with libespeak-ng itself."""
    render(text, str(path), voice=voice)
    with wave.open(str(path)) as file:
        assert file.readframes(file.getnframes()) == reference([Sentence(text, voice=voice)])[0].tobytes(), (
            voice,
            text,
        )


def test_libespeak_commands_in_a_text_are_ignored(talk: Talk) -> None:
    text = "\x01s \x01100A\x0180S battery \x01VDe\x02[\x02low"
    goal = send(talk, text, rate=450)
    assert talk.watcher.wait_for_terminal(goal) == "SUCCEEDED"
    talk.recording.wait_until_quiet(0.2)
    assert_same(talk.recording.samples, reference([text.replace("\x01", " ").replace("\x02", " ")], rate=450)[0])
    assert talk.goal(goal)["spoken"] == text


def _every_character(common: bool) -> Iterator[str]:
    """Return texts with all assigned characters: the 32,000 common ones, or the large East Asian sets."""
    large = (range(0x3400, 0xA000), range(0xAC00, 0xD7A4), range(0x17000, 0x19000), range(0x20000, 0xE0000))
    characters = [
        chr(code)
        for code in range(1, sys.maxunicode + 1)
        if unicodedata.category(chr(code)) not in {"Cn", "Co", "Cs"} and common != any(code in block for block in large)
    ]
    characters = characters[:: _COMMON_STEP if common else _LARGE_STEP]
    texts = ("".join(characters[at : at + _TEXT_CHARS]) for at in range(0, len(characters), _TEXT_CHARS))
    return (text for text in texts if bad_text(text) is None)  # a text with only control characters is refused


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("common", [True, False], ids=["all scripts", "East Asia"])
def test_every_assigned_character_can_be_spoken(common: bool) -> None:
    texts = list(_every_character(common))
    tally = speak_all([Case("gmw/en", text) for text in texts], guarded=True)
    print(tally)
    assert tally.texts == len(texts) > 0
    assert (tally.deaths, tally.faults) == ([], [])


def test_numbers_of_up_to_20_digits_are_spoken() -> None:
    """Without the guard, this voice crashes at numbers with 13 and 14 digits."""
    voice, chance = "tai/shn", random.Random(20)
    numbers = ["".join(chance.choices("1234567890", k=digits)) for digits in range(1, 21)]
    numbers += ["1111111111111", "1,111,111,111,111"]
    tally = speak_all([Case(voice, number) for number in numbers], guarded=True)
    assert (tally.texts, tally.deaths, tally.faults) == (len(numbers), [], [])
    assert set(tally.outcomes) == {"completed"}


def test_markup_long_words_and_right_to_left_scripts_are_spoken_whole(tmp_path: Path) -> None:
    for voice, text in [*RENDERED, *(("en", text) for text in MARKUP)]:
        assert_rendered(tmp_path / "x.wav", text, voice)


@pytest.mark.timeout(300)
@pytest.mark.parametrize("quick", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_thousands_of_characters_of_one_kind_do_not_hang(quick: bool) -> None:
    texts = [text for name, text in ENDLESS.items() if (name in QUICK) == quick]
    assert [bad_text(text) for text in texts] == [None] * len(texts)
    tally = speak_all([Case("gmw/en", text) for text in [*texts, LOW]], guarded=True)
    assert (tally.texts, tally.deaths, tally.faults) == (len(texts) + 1, [], [])
    assert set(tally.outcomes) <= {"completed", "nothing_to_say"}


#: Starts the client from a program whose command line also contains escapes.
PARENT = "import subprocess, sys; sys.exit(subprocess.call(sys.argv[2:]))"
HOSTILE = "a\x1b[31mred\x07\x9b2J\u202egnp.exe\r\nfake line"
#: A client that needs only a socket, so that its executable can have any name.
CLIENT = """
import socket, sys
with socket.socket(socket.AF_UNIX) as connection:
    connection.connect(sys.argv[1])
    connection.sendall(b'{"request": "say", "text": "length=0.1 named", "wait": true}\\n')
    received = b""
    while b'"result"' not in received:
        received += connection.recv(65536)
"""


def test_terminal_escapes_in_texts_ids_keys_and_names_are_shown_escaped(scripted: Talk) -> None:
    watch = scripted.start("watch")
    goal = str(scripted.request("say", text=f"length=0.1 {HOSTILE}", key=HOSTILE)["goal"]["id"])
    rejected = scripted.request("say", text="one", id="x\x1b[31m")
    assert not rejected["ok"] or rejected["goal"]["state"] == "REJECTED"
    scripted.watcher.wait_for_terminal(goal)
    own = scripted.run("say", "--wait", "--as", HOSTILE, "--key", HOSTILE, "--", f"length=0.1 {HOSTILE}")
    assert own.code == 0, own
    failed = scripted.run("say", "--wait", "--as", HOSTILE, "--", f"fail=engine_failed {HOSTILE}")
    assert failed.code == 4
    evil = f"{scripted.directory}/ev\x1b[31m\u202e"
    os.symlink(sys.executable, evil)
    command = [sys.executable, "-c", PARENT, HOSTILE, evil, "-c", CLIENT, scripted.socket]
    subprocess.run(command, env=scripted.env, timeout=20, check=True)
    active = start_goal(scripted, f"never-ends {HOSTILE}", number=1, key=HOSTILE)
    send(scripted, f"waits {HOSTILE}")
    # If a script forgets the quotes, talk takes text for commands, options or ids.
    wrong = (
        [HOSTILE],
        ["say", f"--{HOSTILE}"],
        ["voices", "--language", HOSTILE],
        ["wait", HOSTILE],
        ["cancel", HOSTILE],
    )
    commands = (["status"], ["log"], ["status", goal], ["status", active], *wrong, ["cancel"])
    shown = [scripted.run(*args) for args in commands]
    scripted.stop()
    out, err = watch.communicate(timeout=10)
    for text in [out, err, scripted.log, failed.err, own.err, *(command.out + command.err for command in shown)]:
        assert not re.search("[\x00-\x09\x0b-\x1f\x7f-\x9f\u202a-\u202e]", text), ascii(text)
        assert "\nfake line" not in text
    assert r"\x1b[31mred\x07\x9b2J\u202egnp.exe\r\nfake line" in out
    assert r"\x1b[31mred" in shown[0].out
    assert r"\x1b[31mred" in shown[1].out
    assert r"ev\x1b[31m" in out + scripted.log + shown[0].out + shown[1].out


#: A text for which all known versions of libespeak-ng write past the end of a table.
CRASHING = "a." * 200
UNGUARDED = os.path.join(os.path.dirname(os.path.abspath(__file__)), "fuzz_texts_serve.py")
#: Seconds per crashing text, from the first to the sound of the goal behind them.
LOOP_LIMIT = 0.3


def unguarded(make_talk: MakeTalk, sink: Sink, *options: str) -> Talk:
    """Start a server with the real engine, but without the guard for libespeak-ng."""
    return make_talk(*options, program=UNGUARDED, sink=sink)


def test_a_crashing_text_among_ten_goals_aborts_only_itself(make_talk: MakeTalk, sink: Sink) -> None:
    talk = unguarded(make_talk, sink, "--rate", "450")
    texts = [LOW, HOME, "two", "three", "four", CRASHING, "six", "seven", "eight", "nine"]
    goals = [send(talk, text) for text in texts]
    states = []
    for goal in goals:
        with limits():  # one block per goal, so that a load during one goal excuses no other
            states.append(await_end(talk, goal, PATIENCE))
    assert states == ["SUCCEEDED"] * 5 + ["ABORTED"] + ["SUCCEEDED"] * 4
    assert talk.watcher.states(goals[5]) == ["PENDING", "ACTIVE", "ABORTED"]  # not tried again
    assert [event["id"] for event in talk.watcher.events() if event.get("state") == "ACTIVE"] == goals
    assert_aborted(talk.goal(goals[5]), "engine_crashed", "SIG")
    talk.recording.wait_until_quiet(0.2)
    # Two processes speak: one the goals before the crash, and a new one those after it.
    assert_heard(talk.recording.samples, [*reference(texts[:5], rate=450), *reference(texts[6:], rate=450)])


@pytest.mark.parametrize("texts", [10, pytest.param(100, marks=pytest.mark.slow)])
def test_after_100_crashing_texts_the_next_goal_is_heard_in_time(make_talk: MakeTalk, sink: Sink, texts: int) -> None:
    talk = unguarded(make_talk, sink, "--max-queue", "200")

    with limits():
        assert talk.run("voices").code == 0  # the engine is ready
        with sink.record() as recording:
            started_at = time.monotonic()
            with talk.connect() as wire:
                replies = [wire.request("say", text=CRASHING)["goal"]["id"] for _ in range(texts)]
            last = send(talk, LOW)
            assert await_end(talk, last, 4 * texts * LOOP_LIMIT) == "SUCCEEDED"
            assert_same(recording.samples, reference([LOW])[0])
            heard_at = recording.first_sound()
        assert heard_at is not None
        for goal in replies:
            assert_aborted(talk.goal(goal), "engine_crashed", "SIG")
        assert [talk.watcher.states(goal) for goal in replies] == [["PENDING", "ACTIVE", "ABORTED"]] * texts
        print(f"{texts} crashing texts and a good one: {heard_at - started_at:.1f} s")
        assert_within((heard_at - started_at) / texts, LOOP_LIMIT, f"each of {texts} crashing texts before a goal")

    # An engine process was ready for each text, so no goal had to wait for one.
    assert talk.log.count("talk: the engine crashed: it was killed by ") == texts
    assert "engine_failed" not in talk.log


def test_known_crashing_texts_are_spoken_with_the_guard() -> None:
    texts = [
        *("a." * 85, "e.g. " * 60, "http://" + "x." * 100, CRASHING, "y.," * 220, "a." + "b" * 170, "I." + "'s" * 90),
        *("A." * 20 + "\u200d" * 60, "a" * 163 + "ing", "é" * 85 + "s", "'-o", "xin! (-o", "№-o", ".-o", "०." * 90),
    ]
    cases = [Case("gmw/en", text) for text in texts]
    guarded = speak_all(cases, guarded=True)
    assert (guarded.texts, guarded.deaths, guarded.faults) == (len(texts), [], [])
    bare = speak_all(cases[:3], guarded=False)
    assert (bare.texts, bare.faults) == (3, [])
    assert bare.deaths, "these texts do not crash this version: find others that do"


def test_texts_that_crash_some_voices_are_spoken_by_all_of_them() -> None:
    voices = [voice for voice in list_voices() if voice.split("/")[0] in {"gmq", "aav", "inc", "dra"}]
    tally = speak_all([Case(voice, text) for voice in voices for text in ("'-o", ".-す", "…-o x")], guarded=True)
    assert (tally.deaths, tally.faults) == ([], [])


@pytest.mark.parametrize("growing", [False, True], ids=["whole", "growing"])
@pytest.mark.parametrize("count", [25, pytest.param(None, marks=pytest.mark.slow)])
@pytest.mark.timeout(int(_FUZZ_S) + 300)
def test_mutated_texts_end_once_and_never_overflow_a_buffer(count: int | None, growing: bool) -> None:
    before = len(os.listdir("/proc/self/fd"))
    texts = itertools.islice(mutated_texts(7, list_voices()), count)
    tally = speak_all(texts, guarded=True, seconds=_FUZZ_S, growing=growing)
    print(tally, *tally.deaths, sep="\n")
    assert not tally.faults, tally.faults
    assert not tally.overflows, tally.overflows
    assert tally.texts > (20 if count else _FUZZ_S)
    assert len(os.listdir("/proc/self/fd")) == before
