"""Processes that die or freeze in mid-sentence: it is silent, the goal's end is true, and the next one is heard."""

from __future__ import annotations

import os
import signal
import time
from typing import TYPE_CHECKING

import pytest

from talkcli.engine.synthesizers.guard import guarded
from tests.conformance import stopped
from tests.conformance.hearing import (
    HOME,
    LONG,
    LOW,
    QUICK,
    assert_aborted,
    assert_same,
    begin,
    begin_with_client,
    engine_process,
    heard,
    player_process,
    quick_talk,
    render_quick,
    send,
)
from tests.support import census
from tests.support.compare import assert_begun, assert_heard, time_heard
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from tests.conformance.hearing import Samples
    from tests.conftest import MakeTalk
    from tests.support.processes import Talk
    from tests.support.recording import Recording
    from tests.support.sink import Sink

#: Seconds that a text takes at most which is spelled instead of crashing the library.
SPELLED = 90
CRASHING = {"initials": "a." * 85, "abbreviations": "e.g. " * 60, "address": "http://" + "x." * 100}


@pytest.fixture
def talk(make_talk: MakeTalk, sink: Sink) -> Talk:
    return quick_talk(make_talk, sink)


@pytest.mark.slow
@pytest.mark.parametrize("name", CRASHING)
def test_a_text_that_would_crash_the_library_is_spoken(talk: Talk, sink: Sink, name: str) -> None:
    text = CRASHING[name]
    assert talk.run("say", "--wait", "--", LOW).code == 0
    assert_same(heard(talk), render_quick([LOW])[0])
    engine = engine_process(talk)
    done = talk.run("say", "--wait", "--", text, timeout=SPELLED)
    assert (done.code, talk.goal(done.id)["spoken"]) == (0, text)
    with sink.record() as recording:
        assert talk.run("say", "--wait", "--", HOME).code == 0
    assert engine_process(talk) == engine
    # The library itself would not survive the text as it is.
    assert_same(recording.samples, render_quick([LOW, guarded(text), HOME])[-1])


def test_a_killed_server_is_silent_and_the_next_one_speaks(make_talk: MakeTalk, sink: Sink) -> None:
    reference, following = render_quick([LONG])[0], render_quick([LOW])[0]
    talk = make_talk("--rate", str(QUICK), sink=sink, forked=False)  # its start is timed

    with limits():
        with sink.record() as recording:
            goal, client = begin_with_client(talk, LONG, number=5)
            killed = time.monotonic()
            gone = talk.kill()
            lost = talk.finish(client)
            last = recording.wait_until_quiet()
        assert (lost.code, lost.id) == (12, goal)
        assert_begun(recording, reference, shortest=0.2)
        assert os.path.lexists(talk.socket), "no stale socket is left, which the next server has to cope with"
        began = time.monotonic()
        talk.start_server()
        served = time.monotonic() - began
        with sink.record() as recording:
            assert talk.run("say", "--wait", "--", LOW).code == 0
        assert_same(recording.samples, following)
        assert last is not None
        assert_within(gone, 0.3, "the end of all processes after the server was killed")
        assert_within(last - killed, 0.3, "the silence after the server was killed")
        assert_within(served, 1, "the start after the server was killed")


def test_a_killed_engine_is_replaced_within_half_a_second(talk: Talk, sink: Sink) -> None:
    reference, following = render_quick([LONG])[0], render_quick([LOW])[0]

    with limits():
        with sink.record() as recording:
            goal, client = begin_with_client(talk, LONG, number=5)
            next_goal = send(talk, LOW)
            killed = time.monotonic()
            os.kill(engine_process(talk), signal.SIGKILL)
            assert talk.watcher.wait_for_terminal(goal) == "ABORTED"
            assert talk.watcher.wait_for_terminal(next_goal) == "SUCCEEDED"
            done = talk.finish(client)
        ended = talk.goal(goal)
        assert_aborted(ended, "engine_crashed", "the engine crashed: it was killed by SIGKILL")
        assert (done.code, ended["message"] in done.err) == (4, True)
        assert ended["spoken"].startswith("two three")
        assert ended["spoken"] != LONG
        start, began = _began(recording, following)
        assert_begun(recording.samples[:start], reference, shortest=0.2)
        assert_within(began - killed, 0.5, "the next goal after a crash")


def test_a_killed_engine_that_was_idle_is_replaced_within_half_a_second(talk: Talk, sink: Sink) -> None:
    (reference,) = render_quick([LOW])

    with limits():
        assert talk.run("voices").code == 0  # they are known when it is ready, and has nothing to do
        engine = engine_process(talk)
        killed = time.monotonic()
        os.kill(engine, signal.SIGKILL)
        # A goal that comes before its end is seen may be given to it, and is ABORTED.
        census.settled(talk.pid, lambda now: now.processes == 2 and engine_process(talk) != engine)
        with sink.record() as recording:
            assert talk.run("say", "--wait", "--", LOW).code == 0
        compared = assert_same(recording.samples, reference)
        assert_within(time_heard(recording, compared, reference, 0) - killed, 0.5, "the next goal after a crash")


def test_a_killed_player_aborts_its_goal_and_no_other(make_talk: MakeTalk, sink: Sink) -> None:
    talk = quick_talk(make_talk, sink, "--player", "aplay")
    engine = engine_process(talk)
    goal, client = begin_with_client(talk, LONG, number=5)
    os.kill(player_process(talk), signal.SIGKILL)
    done = talk.finish(client)
    ended = talk.goal(goal)
    assert_aborted(ended, "audio_lost", "killed by SIGKILL")
    assert (done.code, ended["message"] in done.err) == (4, True)
    assert ended["spoken"].startswith("two three")
    assert ended["spoken"] != LONG
    assert talk.run("say", "--wait", "--", LOW).code == 0
    assert engine_process(talk) == engine
    stopped.assert_heard_after_stop(heard(talk), LONG, [LOW])


def test_a_frozen_engine_is_replaced_within_six_seconds(talk: Talk, sink: Sink) -> None:
    (following,) = render_quick([LOW])

    with limits():
        with sink.record() as recording:
            goal = begin(talk, LONG)
            next_goal = send(talk, LOW)
            frozen = time.monotonic()
            os.kill(engine_process(talk), signal.SIGSTOP)
            assert talk.watcher.wait_for_terminal(goal, 10) == "ABORTED"
            assert talk.watcher.wait_for_terminal(next_goal, 10) == "SUCCEEDED"
        ended = talk.goal(goal)
        assert_aborted(ended, "engine_hung", "the engine gave no sign of life for 3 s")
        assert ended["spoken"].startswith("two three")
        assert ended["spoken"] != LONG
        _, began = _began(recording, following)
        assert_within(began - frozen, 6, "the next goal after a hang")


def test_a_frozen_engine_is_killed_by_a_cancel(talk: Talk, sink: Sink) -> None:
    goal = begin(talk, LONG)
    os.kill(engine_process(talk), signal.SIGSTOP)
    canceled = talk.run("cancel", goal)
    assert (canceled.code, canceled.id) == (0, goal)
    assert talk.goal(goal)["state"] == "PREEMPTED"
    assert talk.goal(goal)["reason"] == "canceled"
    with sink.record() as recording:
        assert talk.run("say", "--wait", "--", LOW).code == 0
    assert_same(recording.samples, render_quick([LOW])[0])


def _began(recording: Recording, whole: Samples) -> tuple[int, float]:
    """Assert that a sentence was heard whole, and last; return the sample and the time at which its sound begins."""
    samples = recording.samples
    start, _ = next(stopped.likeliest(samples, [[whole]]), (0, [whole]))
    assert_heard(samples[start:], [whole])
    return start, recording.time_of(start)
