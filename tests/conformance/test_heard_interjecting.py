"""Interjections, as they are heard and as clients see them.

`tests/unit/test_scheduler_interject.py` has the rules of which goal is spoken next.
"""

from __future__ import annotations

import os
import signal
import time
from typing import TYPE_CHECKING

import pytest

from talkcli.engine.child.playback import FADE_S
from tests.conformance import stopped
from tests.conformance.checks import assert_event_order
from tests.conformance.hearing import (
    HOME,
    LONG,
    QUICK,
    SHORTER,
    await_word,
    engine_process,
    heard,
    render_quick,
    send,
    start_goal,
)
from tests.support.compare import matching_length
from tests.support.reference import RATE
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from tests.conftest import MakeTalk
    from tests.support.processes import Talk
    from tests.support.sink import Sink

#: A sentence with a long word.
NUMBER = "one 1234 three"


def word_places(talk: Talk, goal_id: str) -> list[tuple[int, str]]:
    return [(word["number"], word["word"]) for word in talk.watcher.words(goal_id)]


def test_a_sentence_is_heard_to_the_end_of_a_word_and_continues_after_the_interjection(
    make_talk: MakeTalk, sink: Sink
) -> None:
    talk = make_talk("--player", "pulse", "--rate", str(QUICK), sink=sink)
    goal = start_goal(talk, SHORTER, number=2)
    aside = send(talk, HOME, interject=True)
    await_word(talk, aside, 1)
    with talk.connect() as wire:
        status = wire.request("status")
        (interrupted,) = (item["interrupted"] for item in wire.items if "interrupted" in item)
        assert wire.request("wait")["count"] == 2
    assert (status["active"]["id"], interrupted["id"]) == (aside, goal)
    assert (interrupted["state"], interrupted["paused"], interrupted["interrupted_by"]) == ("ACTIVE", True, aside)
    assert talk.watcher.wait_for_terminal(goal) == "SUCCEEDED"
    rest = SHORTER[len(interrupted["spoken"]) :].lstrip()
    samples = heard(talk)
    fade_begin = matching_length(samples, render_quick([SHORTER])[0])
    assert fade_begin / RATE > interrupted["heard"] / 2, "the beginning differs"
    after = samples[fade_begin + round(FADE_S * RATE) :]
    stopped.assert_heard_after_stop(after, SHORTER, [HOME, rest], first_heard=False)
    assert word_places(talk, goal) == list(enumerate(SHORTER.split(), 1))
    assert talk.watcher.texts("ACTIVE") == [SHORTER, HOME, SHORTER]
    assert_event_order(talk)


def test_the_rest_of_a_goal_keeps_its_rate_and_the_whole_goal_is_reported(soundless: Talk) -> None:
    talk = soundless
    whole = send(talk, SHORTER)
    assert talk.watcher.wait_for_terminal(whole) == "SUCCEEDED"
    goal = start_goal(talk, SHORTER, number=2, lead_in=700)
    aside = send(talk, HOME, interject=True)
    assert talk.request("set", rate=450)["ok"]
    assert talk.watcher.wait_for_terminal(aside) == "SUCCEEDED"
    assert talk.watcher.wait_for_terminal(goal) == "SUCCEEDED"
    expected, found = talk.goal(whole), talk.goal(goal)
    assert word_places(talk, goal) == word_places(talk, whole)
    assert (found["spoken"], found["spoken_end"]) == (SHORTER, len(SHORTER))
    assert (found["duration"], found["heard"]) == (pytest.approx(expected["duration"], abs=0.2),) * 2
    assert (found["paused"], found["interrupted_by"], found["voice"]) == (False, None, expected["voice"])
    continued_at = max(event["at"] for event in talk.watcher.events() if event.get("state") == "ACTIVE")
    with limits():
        first_at = min(word["at"] for word in talk.watcher.words(goal) if word["at"] > continued_at)
        assert_within(first_at - continued_at, 0.5, "the rest, which has no lead-in")


def test_a_pause_before_the_end_of_the_word_is_confirmed_at_its_end(soundless: Talk) -> None:
    talk = soundless
    goal = start_goal(talk, NUMBER, number=2)
    with limits():
        aside, requested_at = send(talk, HOME, interject=True), time.monotonic()
        reply = talk.request("pause")
        assert (reply["ok"], reply["goal"]["id"], reply["goal"]["interrupted_by"]) == (True, goal, aside)
        assert_within(time.monotonic() - requested_at, 1.2, "the end of a long word")
    assert talk.request("status")["active"] is None
    assert talk.request("pause")["goal"] is None  # nothing is being spoken
    assert talk.request("resume")["ok"]
    assert talk.watcher.wait_for_terminal(goal) == "SUCCEEDED"
    assert talk.watcher.texts("ACTIVE") == [NUMBER, HOME, NUMBER]
    assert word_places(talk, goal) == list(enumerate(NUMBER.split(), 1))


def test_an_interrupted_goal_continues_after_the_death_of_the_engine(soundless: Talk) -> None:
    talk = soundless
    goal = start_goal(talk, SHORTER, number=2)
    aside = start_goal(talk, SHORTER, number=1, interject=True)
    os.kill(engine_process(talk), signal.SIGKILL)
    assert talk.watcher.wait_for_terminal(goal) == "SUCCEEDED"
    assert talk.goal(aside)["reason"] == "engine_crashed"
    assert word_places(talk, goal) == list(enumerate(SHORTER.split(), 1))


def test_a_growing_text_that_waits_for_text_is_interrupted_at_once_and_continues(soundless: Talk) -> None:
    talk = soundless
    with talk.connect() as wire:
        goal = wire.request("say", text="One two. ", more=True, feedback=True, stall=1)["goal"]["id"]
        await_word(talk, goal, 2)
        wire.receive_event("waits", waits=True)
        aside = send(talk, LONG, interject=True)  # longer than the limit for missing text
        wire.receive_event("waits", waits=False)
        assert wire.receive_event("interrupted")["by"] == {"goal": aside}
        assert wire.request("append", id=goal, text="Three four.")["state"] == "ACTIVE"
        assert talk.watcher.wait_for_terminal(aside) == "SUCCEEDED"
        await_word(talk, goal, 4)
        assert wire.request("append", id=goal, end=True)["ok"]
        assert wire.receive_event("result")["goal"]["state"] == "SUCCEEDED"
    assert [word for _, word in word_places(talk, goal)] == ["One", "two", "Three", "four"]


def test_nothing_is_interrupted_that_is_written_to_a_file(make_talk: MakeTalk, home: str) -> None:
    talk = make_talk("--player", f"file:{home}/out.wav")
    goal = start_goal(talk, " ".join([LONG] * 60), number=1)
    aside = send(talk, HOME, interject=True)
    assert talk.watcher.wait_for_terminal(aside) == "SUCCEEDED"
    assert [event["id"] for event in talk.watcher.events() if event.get("state") == "SUCCEEDED"] == [goal, aside]
    assert not any(event["event"] == "interrupted" for event in talk.watcher.events())
