"""Row 43: paused and resumed speech, compared with the recorded sound, and goals during a pause."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import pytest

from tests.conformance import stopped
from tests.conformance.checks import assert_event_order, assert_recalled, submit
from tests.conformance.hearing import (
    HELP,
    HOME,
    LONG,
    LOW,
    PRECISION,
    SHORTER,
    await_word,
    heard,
    send,
    start_goal,
    start_goal_with_client,
)
from tests.conformance.voices import ESPEAK
from tests.support.compare import assert_heard, assert_resumed, assert_silent
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from tests.conformance.voices import Voice
    from tests.conftest import MakeTalk
    from tests.support.connection import Message
    from tests.support.processes import Talk
    from tests.support.sink import Sink

SPOKEN = ["PENDING", "ACTIVE", "SUCCEEDED"]
STOPPED = ["PENDING", "ACTIVE", "PREEMPTING", "PREEMPTED"]
#: Limit in seconds for silence after `pause`.
SILENCE_LIMIT_S = 0.15


@pytest.fixture
def talk(make_talk: MakeTalk, sink: Sink, voice: Voice) -> Talk:
    return voice.serve(make_talk, sink)


def pause(talk: Talk) -> Message:
    """Pause speech, and return the reply, after which it is silent."""
    reply = talk.request("pause")
    assert (reply["ok"], reply["paused"]) == (True, True), reply
    return reply


def resume(talk: Talk) -> Message:
    """Resume speech, and return the reply."""
    reply = talk.request("resume")
    assert (reply["ok"], reply["paused"]) == (True, False), reply
    return reply


def assert_silent_for(talk: Talk, moment: float, seconds: float) -> None:
    """Assert that nothing is heard for this many seconds after a moment."""
    assert talk.recording.wait_until(moment + seconds, seconds + 1)
    assert_silent(talk.recording.between(moment + PRECISION, moment + seconds))


@pytest.mark.parametrize(
    ("voice", "player", "word", "seconds"),
    [("espeak", "aplay", 3, 2), ("espeak", "pacat", 4, 0.5), ("joe", "aplay", 3, 0.5)],
    indirect=["voice"],
)
def test_row_43_a_paused_sentence_resumes_where_it_stopped(
    make_talk: MakeTalk, sink: Sink, voice: Voice, player: str, word: int, seconds: float
) -> None:
    (reference,) = voice.render([SHORTER])

    with limits():
        talk = voice.serve(make_talk, sink, "--player", player)
        goal = send(talk, SHORTER)
        await_word(talk, goal, word)
        sent_at = time.monotonic()
        paused = pause(talk)["goal"]
        paused_at = time.monotonic()
        assert (paused["id"], paused["state"], paused["paused"]) == (goal, "ACTIVE", True)
        assert pause(talk)["goal"]["id"] == goal  # a second pause succeeds
        assert_silent_for(talk, paused_at, seconds)
        status = talk.request("status")
        assert (status["server"]["paused"], status["active"]["id"], status["active"]["paused"]) == (True, goal, True)
        resumed = resume(talk)["goal"]
        assert (resumed["id"], resumed["state"], resumed["paused"]) == (goal, "ACTIVE", False)
        assert talk.watcher.wait_for_terminal(goal) == "SUCCEEDED"
        assert_resumed(heard(talk), reference, pause=seconds - SILENCE_LIMIT_S, repeated=0.05)
        assert [word["word"] for word in talk.watcher.words(goal)] == SHORTER.split()
        assert_event_order(talk)
        talk.stop()
        assert_within(paused_at - sent_at, SILENCE_LIMIT_S, f"the silence after a pause at word {word}")


def test_row_43_nothing_starts_while_paused_but_pending_goals_can_end(talk: Talk) -> None:
    assert pause(talk)["goal"] is None
    reply = talk.request("say", text=HOME)
    assert (reply["paused"], reply["goal"]["state"]) == (True, "PENDING")
    expiring, canceled = send(talk, HELP, ttl=0.3), send(talk, HELP)
    assert talk.request("say", text=LOW, preempt=True)["paused"] is True
    assert talk.request("cancel", ids=[canceled])["count"] == 1
    assert_recalled(talk, canceled, "canceled")
    assert_recalled(talk, expiring, "expired")
    assert_silent_for(talk, time.monotonic(), 0.2)
    assert talk.request("status")["server"]["paused"] is True
    resume(talk)
    assert talk.watcher.wait_for_terminal(reply["goal"]["id"]) == "SUCCEEDED"
    assert_heard(heard(talk), ESPEAK.render([LOW, HOME]))
    assert "paused" not in talk.request("say", text=LOW)


def test_row_43_a_cancelled_paused_goal_ends_at_once_and_stays_silent(talk: Talk) -> None:
    with limits():
        goal = start_goal(talk, LONG)
        pause(talk)
        started_at = time.monotonic()
        assert talk.request("cancel")["count"] == 1
        seconds = time.monotonic() - started_at
        assert talk.watcher.states(goal) == STOPPED
        ended = talk.goal(goal)
        assert (ended["reason"], ended["paused"]) == ("canceled", False)
        after = send(talk, LOW)
        assert_silent_for(talk, time.monotonic(), 0.2)
        resume(talk)
        assert talk.watcher.wait_for_terminal(after) == "SUCCEEDED"
        stopped.assert_heard_after_stop(heard(talk), LONG, [LOW])
        assert_within(seconds, SILENCE_LIMIT_S, "the cancel of a paused goal")


def test_row_43_a_client_times_out_while_speech_is_paused(talk: Talk) -> None:
    with limits():
        started_at = time.monotonic()
        goal, client = start_goal_with_client(talk, LONG, "--timeout", "0.8")
        pause(talk)
        done = talk.finish(client)
        took = time.monotonic() - started_at
        assert (done.code, done.id) == (124, goal)
        assert took >= 0.8
        assert talk.watcher.states(goal) == STOPPED
        assert_within(took, 1.5, "a timeout of 0.8 s")


def test_row_43_a_preempting_goal_ends_the_paused_one_and_waits(talk: Talk) -> None:
    paused = start_goal(talk, LONG, priority=1)
    pause(talk)
    lower = submit(talk, HOME, preempt=True)["id"]
    assert talk.goal(paused)["paused"] is True  # a lower priority does not preempt it
    urgent = send(talk, LOW, preempt=True, priority=1)
    assert talk.watcher.wait_for_terminal(paused) == "PREEMPTED"
    assert talk.goal(paused)["by"] == {"goal": urgent}
    assert_silent_for(talk, time.monotonic(), 0.2)
    assert talk.goal(urgent)["state"] == "PENDING"
    resume(talk)
    assert talk.watcher.wait_for_terminal(urgent) == "SUCCEEDED"
    assert talk.watcher.wait_for_terminal(lower) == "RECALLED"
    stopped.assert_heard_after_stop(heard(talk), LONG, [LOW])
    assert_event_order(talk)
