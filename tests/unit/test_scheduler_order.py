"""All rules about the order of goals in one table. Each rule has a script for `tests.unit.robot`."""

from __future__ import annotations

import pytest

from tests.unit.robot import Robot, play, rules

RULES = """
# priority

goals are spoken first in, first out
    a; b; c; completed a  ->  b ACTIVE; c PENDING; a SUCCEEDED
a higher priority goes first and interrupts nothing
    a; b; c 5; d 1; e 5; f -3  ->  a ACTIVE; c e d b f PENDING

# preempt

a goal that preempts stops the active one and goes first
    a; b; c; d preempt  ->  a PREEMPTING preempted by d; d b c PENDING
the goal that preempts starts once the active one is silent
    a; b; c; d preempt; stopped a  ->  d ACTIVE; b c PENDING; a PREEMPTED preempted by d
the newest of several goals that preempt wins
    a; b; c preempt; d preempt  ->  a PREEMPTING preempted by c; d b PENDING; c RECALLED preempted by d
preempt recalls preempting goals of a lower priority
    a; b -1 preempt; c -1; d preempt  ->  a PREEMPTING preempted by d; d c PENDING; b RECALLED preempted by d
preempt stops a goal of a lower priority
    a 5; b 6 preempt  ->  a PREEMPTING preempted by b; b PENDING
a goal that preempts goes first only among goals of its own priority
    a 5; b 1; c 3; d 3 preempt; e 1 preempt  ->  a ACTIVE; d c e b PENDING
a pending goal of a higher priority goes before one that preempts
    a; b 2; c preempt; stopped a  ->  b ACTIVE; c PENDING; a PREEMPTED preempted by c
the server's setting applies to a goal without a preempt option
    set preempt=yes; a queue; b queue; c; d queue  ->  a PREEMPTING preempted by c; c b d PENDING
a goal keeps the setting with which it was accepted
    set preempt=yes; a; b; set preempt=no; c; d preempt
        ->  a PREEMPTING preempted by b; d c PENDING; b RECALLED preempted by d

# flush

flush recalls all goals up to its priority
    a; b; c -1; d queue; e 1; f flush  ->  a PREEMPTING preempted by f; e f PENDING; b c d RECALLED preempted by f
flush does not stop a goal of a higher priority
    a 1; b; c flush  ->  a ACTIVE; c PENDING; b RECALLED preempted by c
a goal that flushes counts as preempting for the next one
    a; b flush; c preempt  ->  a PREEMPTING preempted by b; c PENDING; b RECALLED preempted by c
flush preempts whatever the server's setting is
    set preempt=no; a; b flush  ->  a PREEMPTING preempted by b; b PENDING

# key

a goal takes the place of the pending one with its key
    a; b key=k; c; d key=k; e key=k  ->  a ACTIVE; e c PENDING; b RECALLED replaced by d; d RECALLED replaced by e
a key does not replace the active goal
    a key=k; b key=k  ->  a ACTIVE; b PENDING
a key does not replace a goal with another key or none
    a; b key=k; c key=d; d; e key=k  ->  a ACTIVE; e c d PENDING; b RECALLED replaced by e
a goal of a higher priority does not take the same place
    a; b key=k; c; d 1 key=k  ->  a ACTIVE; d c PENDING; b RECALLED replaced by d
a goal replaces one of a higher priority, too
    a; b 9 key=k; c; d key=k  ->  a ACTIVE; c d PENDING; b RECALLED replaced by d
a goal with a key that preempts goes first
    a; b; c key=k; d preempt key=k  ->  a PREEMPTING preempted by d; d b PENDING; c RECALLED replaced by d
a goal that is both replaced and preempted counts as replaced
    a; b key=k preempt; c key=k preempt  ->  a PREEMPTING preempted by b; c PENDING; b RECALLED replaced by c
a goal in the place of a preempting one does not count as preempting
    a; b key=k preempt; c key=k; d preempt  ->  a PREEMPTING preempted by b; d c PENDING; b RECALLED replaced by c

# throttle

a key is throttled for the time since the first goal started
    a key=k; pass 9; completed a; pass 50.9; b key=k throttle=60  ->  a SUCCEEDED; b REJECTED throttled by a
a key is not throttled after that time
    a key=k; completed a; pass 60; b key=k throttle=60  ->  b ACTIVE; a SUCCEEDED
a sound is throttled by its name
    a format=sound; b text=a format=sound throttle=60  ->  a ACTIVE; b REJECTED throttled by a
a pending sound throttles its name
    a; b text=c format=sound; c format=sound throttle=9  ->  a ACTIVE; b PENDING; c REJECTED throttled by b
a sound is throttled after it was played
    a format=sound; completed a; b text=a format=sound throttle=60  ->  a SUCCEEDED; b REJECTED throttled by a
a sound and a text that is its name don't throttle each other
    a; b text=a format=sound throttle=9; c text=b; d text=b format=sound throttle=9  ->  a ACTIVE; b c d PENDING
a goal without a throttle is not throttled but throttles others
    a; b text=a; completed a; completed b; c text=a throttle=60  ->  a b SUCCEEDED; c REJECTED throttled by b
a throttle of 0 holds while it is spoken
    a; b text=a throttle=0  ->  a ACTIVE; b REJECTED throttled by a
a pending goal throttles its text
    a; b; c text=b; d text=b throttle=1  ->  a ACTIVE; b c PENDING; d REJECTED throttled by b
the first of several pending goals of a text is named
    a; b; c 1 text=b; d text=b throttle=1  ->  a ACTIVE; c b PENDING; d REJECTED throttled by c
a pending goal of the same key is replaced and throttles nothing
    a; b key=k; c key=k throttle=60  ->  a ACTIVE; c PENDING; b RECALLED replaced by c
the active goal's text does not throttle a goal with a key
    a key=k; b text=a key=d throttle=60  ->  a ACTIVE; b PENDING
a pending goal's text does not throttle a goal with a key
    a; b; c text=b key=k throttle=60  ->  a ACTIVE; b c PENDING
a text spoken before does not throttle a goal with a key
    a key=k; completed a; b text=a key=d throttle=60  ->  b ACTIVE; a SUCCEEDED
a goal without a key is throttled by its text, whatever the first goal's key is
    a key=k; completed a; b text=a throttle=60  ->  a SUCCEEDED; b REJECTED throttled by a
a goal that expired throttles nothing
    a; b key=k ttl=1; wait 1; c key=k throttle=60  ->  a ACTIVE; c PENDING; b RECALLED expired
a goal that was not heard throttles nothing
    a key=k; cancel a; stopped a; b key=k throttle=60  ->  b ACTIVE; a PREEMPTED canceled by door
a goal that was heard in part throttles
    a; heard a; cancel a; stopped a; b text=a throttle=60  ->  a PREEMPTED canceled by door; b REJECTED throttled by a
after an aborted goal the earlier one still throttles
    a; completed a; pass 5; b text=a; failed b; c text=a throttle=60
        ->  a SUCCEEDED; b ABORTED audio_lost; c REJECTED throttled by a
a throttled goal does not affect others
    a key=k; b key=k; c key=k throttle=1 flush  ->  a ACTIVE; b PENDING; c REJECTED throttled by a

# ttl

a goal waits while its ttl lasts
    a; b ttl=1; wait 0.9  ->  a ACTIVE; b PENDING
a goal whose ttl is over is recalled
    a; b ttl=1; wait 1  ->  a ACTIVE; b RECALLED expired
a goal that has started does not expire
    a ttl=1; wait 100  ->  a ACTIVE
an expired goal is not started, even without a tick
    a; b ttl=1; c ttl=2; pass 1; completed a  ->  c ACTIVE; a SUCCEEDED; b RECALLED expired
a goal that expired while it waited for room replaces nothing
    set ttl=1; a; b key=k; c key=k waited=1  ->  a ACTIVE; b PENDING; c RECALLED expired
a goal that waited for room for less than its ttl is queued
    a; b ttl=1 waited=0.5; wait 0.4  ->  a ACTIVE; b PENDING
the time spent waiting for room counts
    a; b ttl=1 waited=0.5; wait 0.5  ->  a ACTIVE; b RECALLED expired
the server's ttl applies to goals without one
    set ttl=5; a; b; c ttl=0; d ttl=9; wait 5  ->  a ACTIVE; c d PENDING; b RECALLED expired
a goal keeps the ttl with which it was accepted
    set ttl=5; a; b; set ttl=1; c; wait 1  ->  a ACTIVE; b PENDING; c RECALLED expired
an expired goal does not start after the wait for silence
    a; b ttl=1; cancel a; wait 2  ->  a ABORTED not_silent by door; b RECALLED expired

# pause

the active goal is paused
    a; b; pause; pause  ->  a ACTIVE paused; b PENDING
the paused goal continues at resume
    a; b; pause; resume; resume  ->  a ACTIVE; b PENDING
resume without a pause does nothing
    a voice=piper/joe ttl=1; pass 1; resume  ->  a PENDING
goals are accepted and none starts while speech is paused
    pause; a; b  ->  a b PENDING
the first goal starts at resume
    pause; a; b; resume  ->  a ACTIVE; b PENDING
the next goal does not start when the paused one ends
    a; b; pause; completed a  ->  b PENDING; a SUCCEEDED
the next goal starts at resume
    a; b; pause; completed a; resume  ->  b ACTIVE; a SUCCEEDED
a goal that has preempted the paused one waits
    a; pause; b preempt; stopped a  ->  b PENDING; a PREEMPTED preempted by b
a goal that has preempted the paused one starts at resume
    a; pause; b preempt; stopped a; resume  ->  b ACTIVE; a PREEMPTED preempted by b
the paused goal is the current one for a cancel
    a; b; pause; cancel current; stopped a  ->  b PENDING; a PREEMPTED canceled by door
a cancel of all goals up to one includes the paused goal
    a; b; c; pause; cancel before=b; stopped a  ->  c PENDING; a PREEMPTED canceled by door; b RECALLED canceled by door
a goal that is being stopped is not paused
    a; b; cancel a; pause  ->  a PREEMPTING canceled by door; b PENDING
cancel, ttl and the silence limit work while speech is paused
    a; b ttl=1; c; pause; wait 1; cancel c; cancel a; wait 2
        ->  a ABORTED not_silent by door; b RECALLED expired; c RECALLED canceled by door
resume starts no expired goal
    pause; a ttl=1; b; pass 1; resume  ->  b ACTIVE; a RECALLED expired
shutdown ends a paused goal, too
    a; b; pause; shutdown; stopped a; resume  ->  a PREEMPTED shutdown; b RECALLED shutdown

# pauses that end

a pause ends after its time
    a; pause seconds=5; wait 4.9; b; pause seconds=0.1; wait 0.1  ->  a ACTIVE; b PENDING
the next goal starts when the pause ends
    pause seconds=5; a; b; wait 5  ->  a ACTIVE; b PENDING
a pause ends even if the tick is late
    pause seconds=5; a; b ttl=1; pass 9; wait 0  ->  a ACTIVE; b RECALLED expired
a connection without a pause ends no pause
    a; pause connection=x seconds=600; gone y  ->  a ACTIVE paused
speech is paused while one of two listeners is left
    a; pause connection=x seconds=600; pause connection=y seconds=600; gone x  ->  a ACTIVE paused
speech goes on when both listeners are gone
    a; pause connection=x seconds=600; pause connection=y seconds=600; gone x; gone y  ->  a ACTIVE
a listener that is gone ends only its own pause
    a; pause connection=x seconds=9; pause connection=y seconds=5; gone x; wait 4.9  ->  a ACTIVE paused
speech goes on when one listener is gone and the other one's limit is over
    a; pause connection=x seconds=9; pause connection=y seconds=5; wait 6; gone x  ->  a ACTIVE
a connection can replace its limit
    a; pause connection=x seconds=9; pause connection=x seconds=2; wait 2  ->  a ACTIVE
a pause without a limit outlasts listeners and times
    a; pause; pause connection=x seconds=600; pause seconds=5; gone x; wait 999  ->  a ACTIVE paused
a pause without a limit follows one with a time
    a; pause seconds=5; pause; wait 999  ->  a ACTIVE paused
speech is paused until the last of several pauses ends
    a; pause connection=x seconds=5; pause connection=y seconds=9; wait 6  ->  a ACTIVE paused
the longer of two times counts
    a; pause seconds=9; pause seconds=5; wait 8.9  ->  a ACTIVE paused
resume ends all pauses
    a; pause; pause connection=x seconds=600; pause seconds=5; resume  ->  a ACTIVE
a listener whose pause was ended by resume ends no later pause
    a; pause connection=x seconds=600; resume; pause; gone x; wait 600  ->  a ACTIVE paused
a time that was ended by resume ends no later pause
    a; pause seconds=5; resume; pause; wait 5  ->  a ACTIVE paused
pauses that were ended by resume prolong no later pause
    a; pause; pause connection=x seconds=600; resume; pause seconds=5; wait 5  ->  a ACTIVE
a goal that is being stopped stays so when a pause ends
    a; b; pause seconds=1; cancel a; wait 1  ->  a PREEMPTING canceled by door; b PENDING

# full queue

a queue without places rejects every goal
    room 0; a preempt; b  ->  a b REJECTED queue_full
the newest goal of the lowest priority is displaced by a higher one
    room 4; a; b; c 1; d; e 2; f 5  ->  a ACTIVE; f e c b PENDING; d RECALLED displaced by f
no goal is displaced by its own priority
    room 2; a; b; c 1; d  ->  a ACTIVE; c b PENDING; d REJECTED queue_full
no goal is displaced by a lower priority
    room 2; a; b; c 1; d -1 preempt  ->  a ACTIVE; c b PENDING; d REJECTED queue_full
a goal with the preempt option displaces its own priority
    room 2; a 2; b; c; d preempt  ->  a ACTIVE; d b PENDING; c RECALLED displaced by d
a goal with the preempt option displaces its own priority while speech is paused
    room 2; a 2; b; c; pause; d preempt  ->  a ACTIVE paused; d b PENDING; c RECALLED displaced by d
a goal with the preempt option displaces the newest of the lowest priority
    room 4; a 2; b 2; c 1; d 1; e 2; f 2 preempt
        ->  a PREEMPTING preempted by f; f b e c PENDING; d RECALLED displaced by f
a goal with the preempt option displaces no higher priority
    room 2; a 2; b 1; c 1; d preempt  ->  a ACTIVE; b c PENDING; d REJECTED queue_full
a goal that flushes displaces no higher priority
    room 2; a; b 1; c 1; d flush  ->  a ACTIVE; b c PENDING; d REJECTED queue_full
a goal that preempts by the server's setting displaces none
    set preempt=yes; room 2; a queue; b queue; c queue; d  ->  a ACTIVE; b c PENDING; d REJECTED queue_full
a goal that is first in the queue is displaced if it is the newest
    room 2; a; b; c preempt; d 1  ->  a PREEMPTING preempted by c; d b PENDING; c RECALLED displaced by d
a goal in the place of another counts as new
    room 3; a; b key=k; c; d; e key=k; f 1
        ->  a ACTIVE; f c d PENDING; b RECALLED replaced by e; e RECALLED displaced by f
room is counted after flush
    room 2; a; b -1; c key=k preempt; d flush  ->  a PREEMPTING preempted by c; d PENDING; b c RECALLED preempted by d
room is counted after key, and no other goal is displaced
    room 2; a; b -1; c key=k preempt; d key=k  ->  a PREEMPTING preempted by c; d b PENDING; c RECALLED replaced by d
room is counted after preempt, and no other goal is displaced
    room 2; a; b -1; c preempt; d preempt  ->  a PREEMPTING preempted by c; d b PENDING; c RECALLED preempted by d
the active goal makes no room
    room 1; a; b 1; c preempt  ->  a ACTIVE; b PENDING; c REJECTED queue_full

# cancel

without a selector, cancel ends everything
    a; b; c; d; cancel  ->  a PREEMPTING canceled by door; b c d RECALLED canceled by door
cancel with nothing to cancel does nothing
    cancel; cancel current; cancel key=k; a  ->  a ACTIVE
cancel of one goal keeps the order of the rest
    a; b; c; d; cancel c  ->  a ACTIVE; b d PENDING; c RECALLED canceled by door
cancel before a goal ends it and all accepted before it
    a 2; b; c; d 1; e 1; f preempt; cancel before=d
        ->  a PREEMPTING canceled by door; e f PENDING; b c d RECALLED canceled by door
the selectors of a cancel add up
    a; b; c; d; e; cancel e current before=b
        ->  a PREEMPTING canceled by door; c d PENDING; b e RECALLED canceled by door
cancel of a key ends the active and the pending goal
    a key=k; b key=d; c key=k; cancel key=k  ->  a PREEMPTING canceled by door; b PENDING; c RECALLED canceled by door
cancel of a key that no goal has ends nothing
    a key=kk; b key=K; c; cancel c key=k  ->  a ACTIVE; b PENDING; c RECALLED canceled by door
shutdown ends everything and accepts no goal
    a; b; c; shutdown; shutdown; d; stopped a  ->  a PREEMPTED shutdown; b c RECALLED shutdown; d REJECTED shutdown
a goal that was cancelled while it waited for room stops nothing
    room 1; a; b; c flush canceled  ->  a ACTIVE; b PENDING; c RECALLED canceled by door
a goal that was cancelled while it waited for room is not throttled
    a; b text=a throttle=60 canceled  ->  a ACTIVE; b RECALLED canceled by door

# id

a goal with a known id attaches to the first
    a id=mine; b text=a id=mine  ->  a ACTIVE; b is a
a goal attaches to one that has ended
    a id=mine; completed a; b text=a id=mine  ->  a SUCCEEDED; b is a
attaching needs no room and changes nothing
    room 1; a; b id=mine; c text=b id=mine throttle=60 flush key=x  ->  a ACTIVE; b PENDING; c is b
attaching still works after shutdown
    a id=mine; shutdown; b text=a id=mine  ->  a PREEMPTING shutdown; b is a
another text with the same id is a conflict
    a id=mine; b id=mine flush  ->  a ACTIVE; b REJECTED id_conflict
a sound and a text with the same id are a conflict
    a id=mine; b id=mine text=a format=sound  ->  a ACTIVE; b REJECTED id_conflict
another text is a conflict after the end of the first
    a id=mine; completed a; b id=mine  ->  a SUCCEEDED; b REJECTED id_conflict
an id of the server's form attaches to nothing
    a; b text=a id=4k7f-1  ->  a ACTIVE; b REJECTED bad_option
a rejected goal does not use up its id
    a id=mine text=; b id=mine  ->  b ACTIVE; a REJECTED invalid_text
a throttled goal does not use up its id
    a; b id=mine text=a throttle=60; c id=mine  ->  a ACTIVE; c PENDING; b REJECTED throttled by a
cancel before an id ends that goal and all accepted before it
    a; b id=mine; c; cancel before=mine  ->  a PREEMPTING canceled by door; c PENDING; b RECALLED canceled by door
a goal that was cancelled before it arrived is recalled
    cancel mine; a id=mine; b text=a id=mine  ->  a RECALLED canceled by door; b is a
a goal that was cancelled early by before is recalled
    cancel before=mine; a id=mine  ->  a RECALLED canceled by door
a goal that was cancelled before it arrived needs no room and changes nothing
    room 1; a; b key=k; cancel mine; c id=mine key=k flush  ->  a ACTIVE; b PENDING; c RECALLED canceled by door
a rejected goal leaves its id cancelled
    cancel mine; a id=mine text=; b id=mine  ->  a REJECTED invalid_text; b RECALLED canceled by door
a goal that was cancelled before it arrived may be throttled
    a; cancel mine; b id=mine text=a throttle=60  ->  a ACTIVE; b REJECTED throttled by a
an early cancel is remembered for a minute
    cancel mine; pass 59.9; a id=mine  ->  a RECALLED canceled by door
an early cancel is forgotten after a minute
    cancel mine; pass 60; a id=mine  ->  a ACTIVE
an early cancel of an id of the server's form is not remembered
    cancel 4k7f-1; a  ->  a ACTIVE

# engine

a goal that was stopped is preempted even if the engine died
    a; cancel a; failed a  ->  a PREEMPTED canceled by door
a goal that ends before the stop arrives has succeeded
    a; cancel a; completed a  ->  a SUCCEEDED
after a goal that failed the next one starts
    a; b; heard a; failed a  ->  b ACTIVE; a ABORTED audio_lost
the first stop gives the reason
    a; cancel a; pass 1.5; b preempt; cancel current; shutdown; stopped a
        ->  a PREEMPTED canceled by door; b RECALLED shutdown
the next goal waits for silence
    a; b; cancel a; wait 1.89  ->  a PREEMPTING canceled by door; b PENDING
the wait for silence ends at the limit, and the next goal starts
    a; b; cancel a; wait 1.9  ->  b ACTIVE; a ABORTED not_silent by door
the limit counts from the first stop
    a; cancel a; pass 1.5; cancel a; wait 0.5  ->  a ABORTED not_silent by door
if the engine reports that it can't be silent, the goal is aborted
    a; b; cancel a; deaf a  ->  b ACTIVE; a ABORTED not_silent by door
a goal that is not stopped has no limit
    a; wait 1000000  ->  a ACTIVE
goals expire while there is no engine
    lost; a ttl=1; b; wait 1  ->  b PENDING; a RECALLED expired
the next goal starts when there is an engine
    lost; a; b; ready  ->  a ACTIVE; b PENDING
a goal that lost its engine before it was heard expires
    a ttl=1; b; wait 2; lost; wait 0  ->  a PREEMPTING expired; b PENDING
a goal that lost its engine after it was heard does not expire
    a ttl=1; heard a; lost; wait 20  ->  a ACTIVE
a goal may end while there is no engine
    a; b; lost; failed a  ->  b PENDING; a ABORTED audio_lost
a missing engine aborts one goal
    lost; a; b; missing  ->  b PENDING; a ABORTED engine_failed
each report of a missing engine aborts one goal
    lost; a; b; missing; missing  ->  a b ABORTED engine_failed
a missing engine aborts a goal that waits for its voice
    lost; a voice=piper/joe; missing  ->  a ABORTED engine_failed
a missing engine aborts no goal while speech is paused
    lost; a; pause; missing  ->  a PENDING
a present engine aborts no goal that waits for its voice
    a voice=piper/joe; missing  ->  a PENDING
a present engine aborts no goal
    a; b; missing  ->  a ACTIVE; b PENDING
"""

REJECTED = {
    "an empty text": ("text=", "invalid_text"),
    "an invisible text": ("text=\u200b", "invalid_text"),
    "NUL": ("text=a\0", "invalid_text"),
    "half of a surrogate pair": ("text=\ud800", "invalid_text"),
    "100,000 characters": (f"text={'a' * 100_000}", "text_too_long"),
    "another format": ("format=ssml", "bad_option"),
    "a value out of its range": ("rate=1", "bad_option"),
    "a reason given by the server": ("fault=unknown_voice", "unknown_voice"),
    "a faulty text and a reason given by the server": ("text= fault=unknown_voice", "invalid_text"),
}


@pytest.mark.parametrize(("script", "outcome"), rules(RULES))
def test_a_rule_holds(script: str, outcome: str) -> None:
    assert play(script).outcome() == outcome


@pytest.mark.parametrize(("options", "reason"), REJECTED.values(), ids=REJECTED.keys())
def test_a_rejected_goal_does_not_affect_others(options: str, reason: str) -> None:
    robot = play(f"a; b queue key=k; c flush key=k {options}")
    assert robot.outcome() == f"a ACTIVE; b PENDING; c REJECTED {reason}"
    assert robot.seen[-1] == "c REJECTED"
    record = robot.goals["c"]
    assert (record.id, robot.scheduler.find("4k7f-3")) == ("4k7f-3", record)


def test_the_last_of_a_thousand_preempting_goals_is_spoken_completely() -> None:
    robot = Robot()
    goals = [robot.say(f"goal {number}", preempt=True) for number in range(1_000)]
    robot.report("stopped", goals[0].id)
    robot.report("completed", goals[-1].id)
    assert [record.state.name for record in goals] == ["PREEMPTED", *["RECALLED"] * 998, "SUCCEEDED"]
    ends = [effect for effect in robot.seen if effect.split()[1] in {"PREEMPTED", "RECALLED", "SUCCEEDED"}]
    assert len(ends) == len(set(ends)) == 1_000
    assert robot.scheduler.unfinished() == []
