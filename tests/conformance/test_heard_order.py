"""Goals that wait for, stop or replace each other, and their settings, compared with the recorded sound."""

from __future__ import annotations

import json
import os
import signal
import time
from functools import partial
from typing import TYPE_CHECKING, Any

import pytest

from tests.conformance import stopped
from tests.conformance.checks import assert_event_order, assert_recalled, assert_rejected, submit
from tests.conformance.hearing import (
    HELP,
    HOME,
    LONG,
    LOW,
    PRECISION,
    QUICK,
    assert_aborted,
    assert_same,
    await_word,
    heard,
    player_process,
    send,
    start_goal,
    start_goal_with_client,
)
from tests.conformance.voices import ESPEAK, with_both
from tests.support.compare import assert_heard, assert_only_beginning, assert_silent, loudness
from tests.support.reference import Sentence
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from tests.conformance.voices import Voice
    from tests.conftest import MakeTalk
    from tests.support.connection import Message
    from tests.support.processes import Talk
    from tests.support.sink import Sink

SPOKEN = ["PENDING", "ACTIVE", "SUCCEEDED"]
STOPPED = ["PENDING", "ACTIVE", "PREEMPTING", "PREEMPTED"]
NEVER = "never to be heard"


@pytest.fixture
def talk(make_talk: MakeTalk, sink: Sink, voice: Voice) -> Talk:
    return voice.serve(make_talk, sink)


def start_short_goal(talk: Talk, **fields: Any) -> str:
    """Send a goal of half a second, wait for its first word, and return its id."""
    return start_goal(talk, HELP, number=1, **fields)


def await_spoken(talk: Talk, *goals: str) -> None:
    """Wait until these goals have ended, and assert that all have SUCCEEDED."""
    for goal_id in goals:
        assert talk.watcher.wait_for_terminal(goal_id, 20) == "SUCCEEDED"
        assert talk.watcher.states(goal_id) == SPOKEN


def test_row_28_half_the_volume_sounds_half_as_loud(make_talk: MakeTalk, sink: Sink) -> None:
    volumes = []
    for volume in (0.5, 1.0):
        talk = ESPEAK.serve(make_talk, sink, "--volume", str(volume))
        await_spoken(talk, send(talk, HELP))
        samples = heard(talk)
        assert_same(samples, ESPEAK.render([Sentence(HELP, QUICK, volume)])[0])
        volumes.append(loudness(samples))
    assert volumes[0] / volumes[1] == pytest.approx(0.5, abs=0.1)
    refused = talk.run("--socket", f"{talk.directory}/other", "serve", "--volume", "1.5")
    assert (refused.code, refused.out, "--volume" in refused.err) == (2, "", True)


def test_row_29_half_the_rate_takes_twice_as_long(make_talk: MakeTalk, sink: Sink) -> None:
    durations = []
    for rate in (100, 200):
        talk = ESPEAK.serve(make_talk, sink, rate=rate)
        await_spoken(talk, send(talk, "coming"))
        durations.append(assert_same(heard(talk), ESPEAK.render(["coming"], rate)[0]).heard)
    assert durations[0] / durations[1] == pytest.approx(2, abs=0.4)


def test_row_36_an_expired_goal_is_never_heard(talk: Talk) -> None:
    long = send(talk, LONG, rate=200)
    goal = send(talk, NEVER, ttl=1)
    after = send(talk, LOW)
    assert_recalled(talk, goal, "expired")
    assert talk.watcher.states(long) == ["PENDING", "ACTIVE"]
    expired = talk.goal(goal)
    assert expired["ended_at"] - expired["queued_at"] == pytest.approx(1, abs=0.1)
    assert (expired["ttl"], expired["message"].startswith("not spoken: ")) == (1, True)
    await_spoken(talk, long, after)
    assert_heard(heard(talk), ESPEAK.render([Sentence(LONG, rate=200), LOW]))


def test_row_37_a_newer_goal_with_the_same_key_takes_the_old_ones_place(talk: Talk) -> None:
    long = start_short_goal(talk, key="battery")
    first = send(talk, "never the first", key="battery")
    other = send(talk, HOME)
    second = send(talk, "never the second", key="battery")
    newest = send(talk, LOW, key="battery")
    assert_recalled(talk, first, "replaced", by=second)
    assert_recalled(talk, second, "replaced", by=newest)
    await_spoken(talk, long, newest, other)
    assert_heard(heard(talk), ESPEAK.render([HELP, LOW, HOME]))


def test_row_38_only_a_goal_that_was_heard_throttles_the_next(make_talk: MakeTalk, sink: Sink) -> None:
    """A throttled goal is silent, and its client exits with 0. An expired or aborted goal throttles nothing."""
    talk = ESPEAK.serve(make_talk, sink, "--player", "aplay")
    aborted = start_goal(talk, LONG, key="battery", throttle=60)
    expired = send(talk, NEVER, key="home", throttle=60, ttl=0.1)
    assert_recalled(talk, expired, "expired")
    os.kill(player_process(talk), signal.SIGKILL)
    assert talk.watcher.wait_for_terminal(aborted) == "ABORTED"
    assert_aborted(talk.goal(aborted), "audio_lost")
    low, home = (send(talk, text, key=key, throttle=60) for text, key in ((LOW, "battery"), (HOME, "home")))
    talk.watcher.wait_for(low, "ACTIVE")
    while_spoken = submit(talk, NEVER, key="battery", throttle=60)
    await_spoken(talk, low, home)
    after = submit(talk, NEVER, key="battery", throttle=60, flush=True)
    for goal in (while_spoken, after):
        assert_rejected(goal, "throttled")
        assert goal["by"] == {"goal": low}
    done = talk.run("say", "--wait", "--key", "home", "--throttle", "60", "--", NEVER)
    assert (done.code, done.out) == (0, "")
    stopped.assert_heard_after_stop(heard(talk), LONG, [LOW, HOME])


def test_row_39_goals_are_ordered_by_priority_and_then_by_arrival(talk: Talk) -> None:
    long = start_short_goal(talk)
    texts = ["battery", "coming", "please", "coming now"]
    zero, five, one, five_again = [
        send(talk, text, priority=priority) for text, priority in zip(texts, (0, 5, 1, 5), strict=True)
    ]
    await_spoken(talk, long, five, five_again, one, zero)
    assert_heard(heard(talk), ESPEAK.render([HELP, texts[1], texts[3], texts[2], texts[0]]))
    assert_event_order(talk)


def test_row_40_a_preempting_goal_does_not_interrupt_a_higher_priority(talk: Talk) -> None:
    long = start_short_goal(talk, priority=5)
    zero = send(talk, HOME)
    high = send(talk, "coming now", priority=3, preempt=True)
    lower, same = (send(talk, NEVER, priority=priority, preempt=True) for priority in (-1, 0))
    low = send(talk, LOW, preempt=True)
    assert talk.watcher.states(long) == ["PENDING", "ACTIVE"]
    assert_recalled(talk, lower, "preempted", by=same)
    assert_recalled(talk, same, "preempted", by=low)
    await_spoken(talk, long, high, low, zero)
    assert_heard(heard(talk), ESPEAK.render([HELP, "coming now", LOW, HOME]))


def test_a_goal_uses_the_settings_at_its_start_except_its_own(talk: Talk) -> None:
    sentences = [
        Sentence(HELP, rate=QUICK),
        Sentence(LOW, rate=300, volume=0.2),
        Sentence(LOW, rate=350, volume=0.5),
    ]
    first = start_short_goal(talk)
    goals = [send(talk, LOW, rate=300, volume=0.2), send(talk, LOW)]
    assert talk.request("set", rate=350, volume=0.5)["settings"]["rate"] == 350
    await_spoken(talk, first, *goals)
    references = ESPEAK.render(sentences)
    assert loudness(references[1]) < 0.6 * loudness(references[2])
    assert_heard(heard(talk), references)


@with_both
def test_row_03_the_cancel_command_returns_after_the_sound_has_stopped(talk: Talk, voice: Voice) -> None:
    goal = start_goal(talk, LONG)
    canceled = talk.run("cancel", goal)
    returned = time.monotonic()
    assert (canceled.code, canceled.id, canceled.err) == (0, goal, "")
    samples = heard(talk)
    _assert_last_sound_before(talk, returned)
    assert_only_beginning(samples, voice.render([LONG])[0])
    assert talk.watcher.states(goal) == STOPPED
    ended = talk.goal(goal)
    assert (ended["reason"], ended["message"]) == ("canceled", "Talk preempted: the goal was cancelled")
    assert LONG.startswith(ended["spoken"])
    assert "two" in ended["spoken"] != LONG


def test_row_03_a_cancel_is_confirmed_within_150_ms_and_after_the_sound(talk: Talk) -> None:
    with limits():
        for number in (1, 4):
            goal = start_goal(talk, LONG, number=number)
            sent_at = time.monotonic()
            reply = talk.request("cancel", ids=[goal])
            replied_at = time.monotonic()
            assert reply["ok"]
            talk.recording.wait_until(replied_at + 0.1)
            assert_silent(talk.recording.between(replied_at + PRECISION, replied_at + 0.1))
            assert_within(replied_at - sent_at, 0.15, f"the cancel after {number} words")


def test_row_16_a_terminated_server_answers_every_waiting_client(talk: Talk) -> None:
    texts = [LONG, LOW, HOME, HELP]
    waiters = []
    for number, text in enumerate(texts, 1):
        waiters.append(talk.start("--json", "say", "--wait", "--", text))
        talk.watcher.wait_until(partial(_has_goals, talk, number))
    goals = talk.watcher.goals()
    await_word(talk, goals[0])
    talk.stop(timeout=2)
    ended = time.monotonic()
    done = [talk.finish(client, timeout=1) for client in waiters]
    assert [client.code for client in done] == [7, 6, 6, 6]
    results = [json.loads(client.out) for client in done]
    assert [goal["id"] for goal in results] == goals
    assert [goal["text"] for goal in results] == texts
    assert [goal["state"] for goal in results] == ["PREEMPTED", *["RECALLED"] * 3]
    assert {goal["reason"] for goal in results} == {"shutdown"}
    assert talk.watcher.states(goals[0]) == STOPPED
    assert [talk.watcher.states(goal_id) for goal_id in goals[1:]] == [["PENDING", "RECALLED"]] * 3
    assert_only_beginning(heard(talk), ESPEAK.render([LONG])[0])
    _assert_last_sound_before(talk, ended)


def test_row_24_a_preempting_goal_is_heard_after_the_old_one_is_silent(make_talk: MakeTalk, sink: Sink) -> None:
    talk = ESPEAK.serve(make_talk, sink, "--preempt")
    goal, first = start_goal_with_client(talk, LONG)
    second = talk.run("say", "--wait", "--", LOW)
    preempted = talk.finish(first)
    assert (preempted.code, preempted.id) == (7, goal)
    assert preempted.err == f"talk: {goal}: Talk preempted: interrupted by goal {second.id}\n"
    assert (second.code, second.err) == (0, "")
    assert talk.watcher.states(goal) == STOPPED
    assert talk.watcher.states(second.id) == SPOKEN
    silent = talk.watcher.wait_for(goal, "PREEMPTED")
    assert silent["n"] < talk.watcher.wait_for(second.id, "ACTIVE")["n"]
    ended = talk.goal(goal)
    assert (ended["reason"], ended["by"]) == ("preempted", {"goal": second.id})
    stopped.assert_heard_after_stop(heard(talk), LONG, [LOW])


def test_row_25_a_preempting_goal_goes_before_the_queued_ones(talk: Talk) -> None:
    first, *waiting = [send(talk, text) for text in (LONG, LOW, HELP)]
    await_word(talk, first)
    urgent = talk.run("say", "--preempt", "--wait", "--", HOME)
    assert (urgent.code, urgent.err) == (0, "")
    await_spoken(talk, *waiting)
    assert talk.watcher.states(first) == STOPPED
    stopped.assert_heard_after_stop(heard(talk), LONG, [HOME, LOW, HELP])


def test_row_27_cancel_current_stops_a_goal_and_the_next_is_spoken(talk: Talk) -> None:
    goal, waiter = start_goal_with_client(talk, LONG, "--queue")
    waiting = send(talk, LOW)
    canceled = talk.run("cancel", "--current")
    assert (canceled.code, canceled.id) == (0, goal)
    done = talk.finish(waiter)
    assert done.code == 7
    assert "Talk preempted" in done.err
    assert talk.watcher.states(goal) == STOPPED
    assert talk.watcher.wait_for_terminal(waiting) == "SUCCEEDED"
    assert talk.watcher.states(waiting) == SPOKEN
    stopped.assert_heard_after_stop(heard(talk), LONG, [LOW])


def _assert_last_sound_before(talk: Talk, moment: float) -> None:
    last = talk.recording.last_sound()
    assert last is not None
    assert last < moment + PRECISION


def _has_goals(talk: Talk, number: int, _: Message) -> bool:
    return len(talk.watcher.goals()) == number
