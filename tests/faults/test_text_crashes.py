"""Rows "text that crashes libespeak-ng in the middle of ten goals" and "crash loop: 100 such texts in a row"."""

from __future__ import annotations

import os
import time
from typing import TYPE_CHECKING

import pytest

from tests.conformance.hearing import HOME, LOW, assert_aborted, assert_same, send
from tests.faults.broken import assert_answers
from tests.faults.fuzz_texts import list_voices, speak_all
from tests.faults.fuzz_texts_generator import Case
from tests.support.compare import assert_heard
from tests.support.reference import render
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from tests.conftest import MakeTalk
    from tests.support.processes import Talk
    from tests.support.sink import Sink

#: A text for which every known version of libespeak-ng writes past the end of a table.
CRASHING = "a." * 200
UNGUARDED = os.path.join(os.path.dirname(os.path.abspath(__file__)), "fuzz_texts_serve.py")
#: Seconds for each of a hundred crashing texts, from the first to the sound of the goal behind them.
LOOP_LIMIT = 0.3


def unguarded(make_talk: MakeTalk, sink: Sink, *options: str) -> Talk:
    """Start a server with the real engine, and without the guard before the library."""
    return make_talk(*options, program=UNGUARDED, sink=sink)


def test_a_crashing_text_in_the_middle_of_ten_goals(make_talk: MakeTalk, sink: Sink) -> None:
    talk = unguarded(make_talk, sink, "--rate", "450")
    texts = [LOW, HOME, "battery two", "coming three", "battery four", CRASHING]
    texts += ["coming six", "battery seven", "coming eight", "battery nine"]
    goals = [send(talk, text) for text in texts]
    with limits():
        assert_answers(talk)
    states = [talk.watcher.wait_for_terminal(goal) for goal in goals]
    assert states == ["SUCCEEDED"] * 5 + ["ABORTED"] + ["SUCCEEDED"] * 4
    assert talk.watcher.states(goals[5]) == ["PENDING", "ACTIVE", "ABORTED"]  # never tried again
    assert [each["id"] for each in talk.watcher.events() if each.get("state") == "ACTIVE"] == goals
    assert_aborted(talk.goal(goals[5]), "engine_crashed", "SIG")
    talk.recording.wait_until_quiet(0.2)
    # Spoken by two processes, of which the second begins anew: the goals before the crash, and those after it.
    assert_heard(talk.recording.samples, [*render(texts[:5], rate=450), *render(texts[6:], rate=450)])


@pytest.mark.parametrize("texts", [10, pytest.param(100, marks=pytest.mark.slow)])
def test_crash_loop_of_100_texts(make_talk: MakeTalk, sink: Sink, texts: int) -> None:
    talk = unguarded(make_talk, sink, "--max-queue", "200")

    with limits():
        assert talk.run("voices").code == 0  # the engine is ready
        with sink.record() as recording:
            began = time.monotonic()
            with talk.connect() as wire:
                replies = [wire.request("say", text=CRASHING)["goal"]["id"] for _ in range(texts)]
            last = send(talk, LOW)
            assert talk.watcher.wait_for_terminal(last, 4 * texts * LOOP_LIMIT) == "SUCCEEDED"
            assert_same(recording.samples, render([LOW])[0])
            heard_at = recording.first_sound()
        assert heard_at is not None
        for goal in replies:
            assert_aborted(talk.goal(goal), "engine_crashed", "SIG")
        assert [talk.watcher.states(goal) for goal in replies] == [["PENDING", "ACTIVE", "ABORTED"]] * texts
        print(f"{texts} crashing texts and a good one: {heard_at - began:.1f} s")
        assert_within(heard_at - began, texts * LOOP_LIMIT, f"the goal behind {texts} crashing texts")

    # Each had a process that was ready, so the next one needed no wait.
    assert talk.log.count("talk: the engine crashed: it was killed by ") == texts
    assert "engine_failed" not in talk.log


@pytest.mark.parametrize(
    "voice",
    ["gmw/en", *(pytest.param(each, marks=pytest.mark.slow) for each in ("gmq/da", "zls/mk", "aav/vi"))],
)
def test_with_the_guard_known_crashing_texts_are_spoken(voice: str) -> None:
    texts = [
        *("a." * 85, "e.g. " * 60, "http://" + "x." * 100, CRASHING, "y.," * 220, "a." + "b" * 170, "I." + "'s" * 90),
        *("A." * 20 + "\u200d" * 60, "a" * 163 + "ing", "é" * 85 + "s", "'-o", "xin! (-o", "№-o", ".-o", "०." * 90),
    ]
    cases = [Case(voice, text) for text in texts]
    guarded = speak_all(cases, guarded=True)
    assert (guarded.texts, guarded.deaths, guarded.faults) == (len(texts), [], [])
    without = speak_all(cases[:3], guarded=False)
    assert (without.texts, without.faults) == (3, [])
    assert without.deaths, "this library needs no guard: look for what still kills it"


def test_text_that_crashes_only_a_few_voices_is_spoken_by_all_of_them() -> None:
    voices = [each for each in list_voices() if each.split("/")[0] in {"gmq", "aav", "inc", "dra"}]
    tally = speak_all([Case(voice, text) for voice in voices for text in ("'-o", ".-す", "…-o x")], guarded=True)
    assert (tally.deaths, tally.faults) == ([], [])
