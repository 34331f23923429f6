"""Who is heard, in which order, and who is not: rows 36 to 40 and settings that change, compared at the sink."""

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
    await_word,
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
STOPPED = ["PENDING", "ACTIVE", "PREEMPTING", "PREEMPTED"]
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


# -- row 36: ttl


def test_row_36_a_goal_whose_time_is_over_is_never_heard(talk: Talk, voice: Voice) -> None:
    """It ends the moment its time runs out, while the sentence of 3 s before it is still being spoken."""
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


def test_row_36_a_goal_that_has_begun_in_time_is_heard_to_its_end(talk: Talk, voice: Voice) -> None:
    end(talk, begin(talk, LONG, ttl=1))
    assert_heard(heard(talk), voice.render([LONG]))


# -- row 37: key


def test_row_37_of_three_goals_with_one_key_the_newest_is_heard_in_the_first_ones_place(
    talk: Talk, voice: Voice
) -> None:
    long = busy(talk)
    first = send(talk, "never the first", key="battery")
    other = send(talk, HOME)
    second = send(talk, "never the second", key="battery")
    newest = send(talk, LOW, key="battery")
    assert_recalled(talk, first, "replaced", by=second)
    assert_recalled(talk, second, "replaced", by=newest)
    end(talk, long, newest, other)
    assert_heard(heard(talk), voice.render([HELP, LOW, HOME]))
    assert_told_in_order(talk)


def test_row_37_the_goal_that_is_spoken_is_not_replaced_by_its_key(talk: Talk, voice: Voice) -> None:
    first = busy(talk, key="battery")
    second = send(talk, LOW, key="battery")
    end(talk, first, second)
    assert_heard(heard(talk), voice.render([HELP, LOW]))


def test_row_37_with_another_priority_it_is_queued_by_its_own_rules(talk: Talk, voice: Voice) -> None:
    long = busy(talk)
    old = send(talk, NEVER, key="battery")
    other = send(talk, HOME, priority=1)
    newest = send(talk, LOW, key="battery", priority=2)
    assert_recalled(talk, old, "replaced", by=newest)
    end(talk, long, newest, other)
    assert_heard(heard(talk), voice.render([HELP, LOW, HOME]))


# -- row 38: throttle


def test_row_38_the_second_is_throttled_and_silent(talk: Talk, voice: Voice) -> None:
    first = busy(talk, key="battery", throttle=60)
    while_spoken = submit(talk, NEVER, key="battery", throttle=60)
    end(talk, first)
    after = submit(talk, NEVER, key="battery", throttle=60, flush=True)
    for each in (while_spoken, after):
        assert_rejected(each, "throttled")
        assert each["by"] == {"goal": first}
    assert_heard(heard(talk), voice.render([HELP]))


def test_row_38_throttled_is_no_failure_for_a_script(talk: Talk, voice: Voice) -> None:
    words = ["say", "--wait", "--key", "battery", "--throttle", "60", "--", LOW]
    first = talk.run(*words)
    assert (first.code, first.err) == (0, "")
    second = talk.run(*words)
    assert (second.code, second.out) == (0, "")
    assert_heard(heard(talk), voice.render([LOW]))


def test_row_38_a_first_one_that_expired_throttles_nothing(talk: Talk, voice: Voice) -> None:
    long = busy(talk)
    first = send(talk, NEVER, key="battery", throttle=60, ttl=0.2)
    assert_recalled(talk, first, "expired")
    second = send(talk, LOW, key="battery", throttle=60)
    end(talk, long, second)
    assert_heard(heard(talk), voice.render([HELP, LOW]))


def test_row_38_a_first_one_that_was_aborted_throttles_nothing(make_talk: MakeTalk, sink: Sink, voice: Voice) -> None:
    talk = voice.serve(make_talk, sink, "--player", "aplay")
    first = begin(talk, LONG, key="battery", throttle=60)
    os.kill(player_process(talk), signal.SIGKILL)
    assert talk.watcher.wait_for_terminal(first) == "ABORTED"
    assert_aborted(talk.goal(first), "audio_lost")
    second = send(talk, LOW, key="battery", throttle=60)
    end(talk, second)
    stopped.assert_heard_after_stop(heard(talk), LONG, [LOW], voice=voice)


def test_row_38_without_a_key_the_text_is_what_counts(talk: Talk, voice: Voice) -> None:
    long = busy(talk)
    waiting = send(talk, LOW, throttle=60)
    same = submit(talk, LOW, throttle=60)
    assert_rejected(same, "throttled")
    assert same["by"] == {"goal": waiting}
    other = send(talk, HOME, throttle=60)
    end(talk, long, waiting, other)
    assert_rejected(submit(talk, LOW, throttle=60), "throttled")
    assert_heard(heard(talk), voice.render([HELP, LOW, HOME]))


# -- rows 39 and 40: priority


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
    low = send(talk, LOW, preempt=True)
    assert talk.watcher.states(long) == ["PENDING", "ACTIVE"]
    end(talk, long, high, low, zero)
    assert_heard(heard(talk), voice.render([HELP, "coming now", LOW, HOME]))
    assert_told_in_order(talk)


def test_row_40_it_recalls_the_preempting_ones_up_to_its_own_priority(talk: Talk, voice: Voice) -> None:
    long = busy(talk, priority=5)
    sent = ((HOME, 3), (NEVER, -1), (NEVER, 0))
    higher, lower, same = [send(talk, text, priority=each, preempt=True) for text, each in sent]
    newcomer = send(talk, LOW, preempt=True)
    assert_recalled(talk, lower, "preempted", by=same)
    assert_recalled(talk, same, "preempted", by=newcomer)
    end(talk, long, higher, newcomer)
    assert_heard(heard(talk), voice.render([HELP, HOME, LOW]))


def test_row_40_the_same_priority_interrupts(talk: Talk, voice: Voice) -> None:
    long = begin(talk, LONG, priority=5)
    newcomer = send(talk, LOW, preempt=True, priority=5)
    end(talk, newcomer)
    assert talk.watcher.states(long) == STOPPED
    stopped.assert_heard_after_stop(heard(talk), LONG, [LOW], voice=voice)


def test_flush_is_heard_alone(talk: Talk, voice: Voice) -> None:
    long = begin(talk, LONG)
    waiting = [send(talk, NEVER) for _ in range(3)]
    newcomer = send(talk, LOW, flush=True)
    for each in waiting:
        assert_recalled(talk, each, "preempted", by=newcomer)
    end(talk, newcomer)
    assert talk.watcher.states(long) == STOPPED
    stopped.assert_heard_after_stop(heard(talk), LONG, [LOW], voice=voice)


# -- settings


def test_set_changes_the_next_sentence_not_the_one_that_is_spoken(talk: Talk, voice: Voice) -> None:
    first = send(talk, HELP)
    second = send(talk, HOME)
    await_word(talk, first)
    assert talk.request("set", rate=300, volume=0.5)["settings"]["rate"] == 300
    end(talk, first, second)
    assert_heard(heard(talk), voice.render([HELP, Sentence(HOME, rate=300, volume=0.5)]))


def test_a_goals_own_rate_and_volume_are_gone_after_it(talk: Talk, voice: Voice) -> None:
    own = Sentence(LOW, rate=350, volume=0.4)
    first = send(talk, LOW, rate=own.rate, volume=own.volume)
    second = send(talk, LOW)
    end(talk, first, second)
    references = voice.render([own, LOW])
    assert loudness(references[0]) < 0.6 * loudness(references[1])
    assert_heard(heard(talk), references)


@pytest.mark.parametrize("voice", ["espeak"], indirect=True)
def test_a_goals_own_pitch_is_heard(talk: Talk) -> None:
    end(talk, send(talk, LOW, pitch=80))
    assert_heard(heard(talk), render_quick([Sentence(LOW, QUICK, pitch=80)]))
    assert compare(render_quick([LOW])[0], render_quick([Sentence(LOW, QUICK, pitch=80)])[0]).same is False


@pytest.mark.parametrize("voice", ["espeak"], indirect=True)
def test_a_goals_own_voice_is_gone_after_it(talk: Talk) -> None:
    first = send(talk, HOME, voice="de")
    second = send(talk, HOME)
    end(talk, first, second)
    assert_heard(heard(talk), render_quick([Sentence(HOME, QUICK, voice="de"), HOME]))


def test_settings_are_read_when_a_goal_starts(talk: Talk, voice: Voice) -> None:
    """A goal's own rate stays its own, whatever was set meanwhile; the other one has what was set last."""
    first = busy(talk)
    own, general = send(talk, LOW, rate=300), send(talk, HOME)
    assert talk.request("set", rate=350)["ok"]
    end(talk, first, own, general)
    assert_heard(heard(talk), voice.render([HELP, Sentence(LOW, rate=300), Sentence(HOME, rate=350)]))


def test_a_volume_of_zero_is_silent_and_takes_as_long(talk: Talk, voice: Voice) -> None:
    end(talk, send(talk, LONG, volume=0), send(talk, LOW))
    assert_same(heard(talk), voice.render([Sentence(LONG, QUICK, volume=0), LOW])[1])
