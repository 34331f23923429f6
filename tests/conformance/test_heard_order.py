"""The order of goals and the settings of each (rows 28, 29, 36 to 40), compared with the sound at the sink."""

from __future__ import annotations

import os
import signal
from typing import TYPE_CHECKING, Any

import pytest

from tests.conformance import stopped
from tests.conformance.hearing import (
    HELP,
    HOME,
    LONG,
    LOW,
    QUICK,
    assert_aborted,
    assert_same,
    begin,
    heard,
    player_process,
    render_quick,
    send,
)
from tests.conformance.told import assert_recalled, assert_rejected, assert_told_in_order, submit
from tests.support.compare import assert_heard, compare, loudness
from tests.support.reference import Sentence

if TYPE_CHECKING:
    from tests.conformance.voices import Voice
    from tests.conftest import MakeTalk
    from tests.support.processes import Talk
    from tests.support.sink import Sink

SPOKEN = ["PENDING", "ACTIVE", "SUCCEEDED"]
NEVER = "never to be heard"


@pytest.fixture
def talk(make_talk: MakeTalk, sink: Sink, voice: Voice) -> Talk:
    return voice.serve(make_talk, sink)


def busy(talk: Talk, **fields: Any) -> str:
    """Send a goal and wait until it is spoken, which leaves half a second for others to come; return its id."""
    return begin(talk, HELP, number=1, **fields)


def end(talk: Talk, *goals: str) -> None:
    """Wait until these goals have ended; all must have been spoken."""
    for each in goals:
        assert talk.watcher.wait_for_terminal(each, 20) == "SUCCEEDED"
        assert talk.watcher.states(each) == SPOKEN


def test_row_28_half_the_volume_is_heard_as_half(make_talk: MakeTalk, sink: Sink, voice: Voice) -> None:
    found = []
    for volume in (0.5, 1.0):
        talk = voice.serve(make_talk, sink, "--volume", str(volume))
        end(talk, send(talk, HELP))
        samples = heard(talk)
        assert_same(samples, voice.render([Sentence(HELP, QUICK, volume)])[0])
        found.append(loudness(samples))
    assert found[0] / found[1] == pytest.approx(0.5, abs=0.1)
    refused = talk.run("--socket", f"{talk.directory}/other", "serve", "--volume", "1.5")
    assert (refused.code, refused.out, "--volume" in refused.err) == (2, "", True)


def test_row_29_half_the_rate_takes_twice_as_long(make_talk: MakeTalk, sink: Sink, voice: Voice) -> None:
    found = []
    for rate in (100, 200):
        talk = voice.serve(make_talk, sink, rate=rate)
        end(talk, send(talk, HOME))
        found.append(assert_same(heard(talk), voice.render([HOME], rate)[0]).heard)
    assert found[0] / found[1] == pytest.approx(2, abs=0.4)


def test_row_36_a_goal_whose_time_is_over_is_never_heard(talk: Talk, voice: Voice) -> None:
    """The goal ends the moment its time runs out, while the sentence of 3 s before it is still being spoken."""
    long = send(talk, LONG, rate=200)
    goal = send(talk, NEVER, ttl=1)
    after = send(talk, LOW)
    assert_recalled(talk, goal, "expired")
    assert talk.watcher.states(long) == ["PENDING", "ACTIVE"]
    expired = talk.goal(goal)
    assert expired["ended_at"] - expired["queued_at"] == pytest.approx(1, abs=0.1)
    assert (expired["ttl"], expired["message"].startswith("Talk recalled: ")) == (1, True)
    end(talk, long, after)
    assert_heard(heard(talk), voice.render([Sentence(LONG, rate=200), LOW]))
    assert_told_in_order(talk)


def test_row_37_of_three_goals_with_one_key_the_newest_is_heard_in_the_first_ones_place(
    talk: Talk, voice: Voice
) -> None:
    """The goal being spoken is not replaced, although it has the same key."""
    long = busy(talk, key="battery")
    first = send(talk, "never the first", key="battery")
    other = send(talk, HOME)
    second = send(talk, "never the second", key="battery")
    newest = send(talk, LOW, key="battery")
    assert_recalled(talk, first, "replaced", by=second)
    assert_recalled(talk, second, "replaced", by=newest)
    end(talk, long, newest, other)
    assert_heard(heard(talk), voice.render([HELP, LOW, HOME]))
    assert_told_in_order(talk)


def test_row_38_only_a_goal_that_was_heard_throttles_the_next(make_talk: MakeTalk, sink: Sink, voice: Voice) -> None:
    """A throttled goal is silent and no failure for a script. One that expired or was aborted throttles nothing."""
    talk = voice.serve(make_talk, sink, "--player", "aplay")
    aborted = begin(talk, LONG, key="battery", throttle=60)
    expired = send(talk, NEVER, key="home", throttle=60, ttl=0.1)
    assert_recalled(talk, expired, "expired")
    os.kill(player_process(talk), signal.SIGKILL)
    assert talk.watcher.wait_for_terminal(aborted) == "ABORTED"
    assert_aborted(talk.goal(aborted), "audio_lost")
    low, home = (send(talk, text, key=key, throttle=60) for text, key in ((LOW, "battery"), (HOME, "home")))
    talk.watcher.wait_for(low, "ACTIVE")
    while_spoken = submit(talk, NEVER, key="battery", throttle=60)
    end(talk, low, home)
    after = submit(talk, NEVER, key="battery", throttle=60, flush=True)
    for each in (while_spoken, after):
        assert_rejected(each, "throttled")
        assert each["by"] == {"goal": low}
    done = talk.run("say", "--wait", "--key", "home", "--throttle", "60", "--", NEVER)
    assert (done.code, done.out) == (0, "")
    stopped.assert_heard_after_stop(heard(talk), LONG, [LOW, HOME], voice=voice)


def test_row_39_higher_priorities_go_first_equal_ones_in_the_order_in_which_they_came(talk: Talk, voice: Voice) -> None:
    long = busy(talk)
    texts = ["battery zero", "coming five", "battery one", "coming five again"]
    zero, five, one, five_again = [
        send(talk, text, priority=each) for text, each in zip(texts, (0, 5, 1, 5), strict=True)
    ]
    end(talk, long, five, five_again, one, zero)
    assert_heard(heard(talk), voice.render([HELP, texts[1], texts[3], texts[2], texts[0]]))
    assert_told_in_order(talk)


def test_row_40_a_lower_priority_does_not_interrupt_and_goes_first_among_its_own(talk: Talk, voice: Voice) -> None:
    long = busy(talk, priority=5)
    zero = send(talk, HOME)
    high = send(talk, "coming now", priority=3, preempt=True)
    lower, same = (send(talk, NEVER, priority=each, preempt=True) for each in (-1, 0))
    low = send(talk, LOW, preempt=True)
    assert talk.watcher.states(long) == ["PENDING", "ACTIVE"]
    assert_recalled(talk, lower, "preempted", by=same)
    assert_recalled(talk, same, "preempted", by=low)
    end(talk, long, high, low, zero)
    assert_heard(heard(talk), voice.render([HELP, "coming now", LOW, HOME]))
    assert_told_in_order(talk)


def test_settings_are_read_when_a_goal_starts_and_its_own_are_gone_after_it(talk: Talk, voice: Voice) -> None:
    """A change holds for the goals that have not begun, except for the values that they were sent with."""
    asked = [
        Sentence(HELP, rate=QUICK),
        Sentence(LOW, rate=300, volume=0.4),
        Sentence(HOME, rate=350, volume=0.5),
        Sentence(HELP, rate=350, volume=0),  # takes its time, in silence
        Sentence(LOW, rate=350, volume=0.5),
    ]
    first = busy(talk)
    goals = [send(talk, LOW, rate=300, volume=0.4), send(talk, HOME), send(talk, HELP, volume=0), send(talk, LOW)]
    assert talk.request("set", rate=350, volume=0.5)["settings"]["rate"] == 350
    end(talk, first, *goals)
    references = voice.render(asked)
    assert loudness(references[1]) < 0.9 * loudness(references[4])
    del references[3]
    assert_heard(heard(talk), references)


@pytest.mark.parametrize("voice", ["espeak"], indirect=True)
def test_a_goals_own_pitch_and_voice_are_heard_and_gone_after_it(talk: Talk) -> None:
    end(talk, send(talk, LOW, pitch=80), send(talk, HOME, voice="de"), send(talk, LOW))
    own = Sentence(LOW, QUICK, pitch=80)
    assert_heard(heard(talk), render_quick([own, Sentence(HOME, QUICK, voice="de"), LOW]))
    assert not compare(render_quick([LOW])[0], render_quick([own])[0]).same
