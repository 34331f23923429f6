"""Sentences that are stopped by a cancel, another goal or the server's end: when it is silent, and what follows."""

from __future__ import annotations

import json
import time
from functools import partial
from typing import TYPE_CHECKING

import pytest

from tests.conformance import stopped
from tests.conformance.hearing import (
    HELP,
    HOME,
    LONG,
    LOW,
    PRECISION,
    await_word,
    begin,
    begin_with_client,
    heard,
    send,
)
from tests.conformance.voices import with_both
from tests.support.compare import assert_begun, assert_silent
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from tests.conformance.voices import Voice
    from tests.conftest import MakeTalk
    from tests.support.connection import Message
    from tests.support.processes import Talk
    from tests.support.sink import Sink

STOPPED = ["PENDING", "ACTIVE", "PREEMPTING", "PREEMPTED"]
SPOKEN = ["PENDING", "ACTIVE", "SUCCEEDED"]


@pytest.fixture
def talk(make_talk: MakeTalk, sink: Sink, voice: Voice) -> Talk:
    return voice.serve(make_talk, sink)


@with_both
def test_row_03_cancel_by_id_is_silent_when_it_returns(talk: Talk, voice: Voice) -> None:
    goal = begin(talk, LONG)
    canceled = talk.run("cancel", goal)
    returned = time.monotonic()
    assert (canceled.code, canceled.id, canceled.err) == (0, goal, "")
    samples = heard(talk)
    _assert_last_sound_before(talk, returned)
    assert_begun(samples, voice.render([LONG])[0])
    assert talk.watcher.states(goal) == STOPPED
    ended = talk.goal(goal)
    assert (ended["reason"], ended["message"]) == ("canceled", "Talk preempted")
    assert LONG.startswith(ended["spoken"])
    assert "two" in ended["spoken"] != LONG


def test_row_03_the_reply_to_a_cancel_comes_within_150_ms_when_it_is_silent(talk: Talk) -> None:
    with limits():
        for number in (1, 4):
            goal = begin(talk, LONG, number=number)
            asked = time.monotonic()
            reply = talk.request("cancel", ids=[goal])
            replied = time.monotonic()
            assert reply["ok"]
            talk.recording.wait_until(replied + 0.1)
            assert_silent(talk.recording.between(replied + PRECISION, replied + 0.1))
            assert_within(replied - asked, 0.15, f"the cancel after {number} words")


def test_row_16_a_server_that_is_terminated_answers_every_waiter(talk: Talk, voice: Voice) -> None:
    texts = [LONG, LOW, HOME, HELP]
    waiters = []
    for number, text in enumerate(texts, 1):
        waiters.append(talk.start("--json", "say", "--wait", "--", text))
        talk.watcher.wait_until(partial(_has_goals, talk, number))
    goals = talk.watcher.goals()
    await_word(talk, goals[0])
    talk.stop(timeout=2)
    ended = time.monotonic()
    done = [talk.finish(each, timeout=1) for each in waiters]
    assert [each.code for each in done] == [7, 6, 6, 6]
    told = [json.loads(each.out) for each in done]
    assert [each["id"] for each in told] == goals
    assert [each["text"] for each in told] == texts
    assert [each["state"] for each in told] == ["PREEMPTED", *["RECALLED"] * 3]
    assert {each["reason"] for each in told} == {"shutdown"}
    assert talk.watcher.states(goals[0]) == STOPPED
    assert [talk.watcher.states(each) for each in goals[1:]] == [["PENDING", "RECALLED"]] * 3
    assert_begun(heard(talk), voice.render([LONG])[0])
    _assert_last_sound_before(talk, ended)


def test_row_24_a_newcomer_is_heard_when_the_one_before_it_is_silent(
    make_talk: MakeTalk, sink: Sink, voice: Voice
) -> None:
    talk = voice.serve(make_talk, sink, "--preempt")
    goal, first = begin_with_client(talk, LONG)
    second = talk.run("say", "--wait", "--", LOW)
    preempted = talk.finish(first)
    assert (preempted.code, preempted.id) == (7, goal)
    assert "Talk preempted" in preempted.err
    assert (second.code, second.err) == (0, "")
    assert talk.watcher.states(goal) == STOPPED
    assert talk.watcher.states(second.id) == SPOKEN
    silent = talk.watcher.wait_for(goal, "PREEMPTED")
    assert silent["n"] < talk.watcher.wait_for(second.id, "ACTIVE")["n"]
    ended = talk.goal(goal)
    assert (ended["reason"], ended["by"]) == ("preempted", {"goal": second.id})
    stopped.assert_heard_after_stop(heard(talk), LONG, [LOW], voice=voice)


def test_row_25_a_goal_that_preempts_goes_before_those_that_wait(talk: Talk, voice: Voice) -> None:
    first, *waiting = [send(talk, text) for text in (LONG, LOW, HOME)]
    await_word(talk, first)
    newcomer = talk.run("say", "--preempt", "--wait", "--", HELP)
    assert (newcomer.code, newcomer.err) == (0, "")
    assert talk.run("wait", *waiting).code == 0
    assert talk.watcher.states(first) == STOPPED
    assert all(talk.watcher.states(each) == SPOKEN for each in waiting)
    stopped.assert_heard_after_stop(heard(talk), LONG, [HELP, LOW, HOME], voice=voice)


def test_row_27_a_goal_is_cancelled_without_preempt(talk: Talk, voice: Voice) -> None:
    goal, waiter = begin_with_client(talk, LONG, "--queue")
    waiting = send(talk, LOW)
    canceled = talk.run("cancel", "--current")
    assert (canceled.code, canceled.id) == (0, goal)
    done = talk.finish(waiter)
    assert done.code == 7
    assert "Talk preempted" in done.err
    assert talk.watcher.states(goal) == STOPPED
    assert talk.watcher.wait_for_terminal(waiting) == "SUCCEEDED"
    assert talk.watcher.states(waiting) == SPOKEN
    stopped.assert_heard_after_stop(heard(talk), LONG, [LOW], voice=voice)


def _assert_last_sound_before(talk: Talk, moment: float) -> None:
    last = talk.recording.last_sound()
    assert last is not None
    assert last < moment + PRECISION


def _has_goals(talk: Talk, number: int, _: Message) -> bool:
    return len(talk.watcher.goals()) == number
