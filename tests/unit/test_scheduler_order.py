"""The rules of who is spoken when, in one table: each with a script, in the language of `tests.unit.robot`."""

from __future__ import annotations

import pytest

from tests.unit.robot import Robot, play, rules

RULES = """
# priority

goals are spoken first in, first out
    a; b; c; completed a  ->  b ACTIVE; c PENDING; a SUCCEEDED
a higher priority goes first and interrupts nothing
    a; b; c 5; d 1; e 5; f -3  ->  a ACTIVE; c e d b f PENDING
it is spoken first
    a; b; c 5; completed a  ->  c ACTIVE; b PENDING; a SUCCEEDED

# preempt

a goal that preempts stops the active one and goes first
    a; b; c; d preempt  ->  a PREEMPTING preempted by d; d b c PENDING
it starts once the active one is silent
    a; b; c; d preempt; stopped a  ->  d ACTIVE; b c PENDING; a PREEMPTED preempted by d
it starts at once if nothing is spoken
    a preempt  ->  a ACTIVE
the newest of several wins
    a; b; c preempt; d preempt  ->  a PREEMPTING preempted by c; d b PENDING; c RECALLED preempted by d
it recalls those of a lower priority
    a; b -1 preempt; c -1; d preempt  ->  a PREEMPTING preempted by d; d c PENDING; b RECALLED preempted by d
it recalls none of a higher priority
    a 5; b 3 preempt; c 1 preempt  ->  a ACTIVE; b c PENDING
it does not stop a goal of a higher priority
    a 5; b 4 preempt  ->  a ACTIVE; b PENDING
it stops a goal of its own priority
    a 5; b 5 preempt  ->  a PREEMPTING preempted by b; b PENDING
it stops a goal of a lower priority
    a 5; b 6 preempt  ->  a PREEMPTING preempted by b; b PENDING
it goes first among its own priority alone
    a 5; b 1; c 3; d 3 preempt; e 1 preempt  ->  a ACTIVE; d c e b PENDING
a pending goal of a higher priority goes before it
    a; b 2; c preempt; stopped a  ->  b ACTIVE; c PENDING; a PREEMPTED preempted by c
preempt is the server's if the goal brings none
    set preempt=yes; a queue; b queue; c; d queue  ->  a PREEMPTING preempted by c; c b d PENDING
a goal keeps what held when it was accepted
    set preempt=yes; a; b; set preempt=no; c; d preempt
        ->  a PREEMPTING preempted by b; d c PENDING; b RECALLED preempted by d

# flush

flush recalls all goals up to its priority
    a; b; c -1; d queue; e 1; f flush  ->  a PREEMPTING preempted by f; e f PENDING; b c d RECALLED preempted by f
it does not stop a goal of a higher priority
    a 1; b; c flush  ->  a ACTIVE; c PENDING; b RECALLED preempted by c
it counts as preempting for the next one
    a; b flush; c preempt  ->  a PREEMPTING preempted by b; c PENDING; b RECALLED preempted by c
it holds whatever the server's setting
    set preempt=no; a; b flush  ->  a PREEMPTING preempted by b; b PENDING

# key

a goal takes the place of the pending one with its key
    a; b key=k; c; d key=k; e key=k  ->  a ACTIVE; e c PENDING; b RECALLED replaced by d; d RECALLED replaced by e
it replaces none that is spoken
    a key=k; b key=k  ->  a ACTIVE; b PENDING
it replaces none of another key or of none
    a; b key=k; c key=d; d; e key=k  ->  a ACTIVE; e c d PENDING; b RECALLED replaced by e
with a lower priority it is queued by that
    a; b key=k; c; d -1 key=k  ->  a ACTIVE; c d PENDING; b RECALLED replaced by d
with a higher priority it is queued by that
    a; b key=k; c; d 1 key=k  ->  a ACTIVE; d c PENDING; b RECALLED replaced by d
it replaces a goal of a higher priority, too
    a; b 9 key=k; c; d key=k  ->  a ACTIVE; c d PENDING; b RECALLED replaced by d
with preempt it goes first
    a; b; c key=k; d preempt key=k  ->  a PREEMPTING preempted by d; d b PENDING; c RECALLED replaced by d
a goal that would be preempted, too, is replaced
    a; b key=k preempt; c key=k preempt  ->  a PREEMPTING preempted by b; c PENDING; b RECALLED replaced by c
a goal that would be flushed, too, is replaced
    a; b key=k; c key=k flush  ->  a PREEMPTING preempted by c; c PENDING; b RECALLED replaced by c
in the place of a preempting goal it does not count as preempting
    a; b key=k preempt; c key=k; d preempt  ->  a PREEMPTING preempted by b; d c PENDING; b RECALLED replaced by c

# throttle

a key is throttled while it is spoken
    a key=k; pass 99; b key=k throttle=60  ->  a ACTIVE; b REJECTED throttled by a
and for the time after it began
    a key=k; pass 9; completed a; pass 50.9; b key=k throttle=60  ->  a SUCCEEDED; b REJECTED throttled by a
and no longer
    a key=k; completed a; pass 60; b key=k throttle=60  ->  b ACTIVE; a SUCCEEDED
a text is throttled while it is spoken
    a; pass 99; b text=a throttle=60  ->  a ACTIVE; b REJECTED throttled by a
a text is not throttled by another
    a; b throttle=60  ->  a ACTIVE; b PENDING
a goal without a throttle is not throttled but throttles others
    a; b text=a; completed a; completed b; c text=a throttle=60  ->  a b SUCCEEDED; c REJECTED throttled by b
a throttle of 0 holds while it is spoken
    a; b text=a throttle=0  ->  a ACTIVE; b REJECTED throttled by a
a pending goal throttles its text
    a; b; c text=b; d text=b throttle=1  ->  a ACTIVE; b c PENDING; d REJECTED throttled by b
of several, the first is named
    a; b; c 1 text=b; d text=b throttle=1  ->  a ACTIVE; c b PENDING; d REJECTED throttled by c
a pending goal of its key is replaced instead
    a; b key=k; c key=k throttle=60  ->  a ACTIVE; c PENDING; b RECALLED replaced by c
with a key the text does not matter while it is spoken
    a key=k; b text=a key=d throttle=60  ->  a ACTIVE; b PENDING
nor while it waits
    a; b; c text=b key=k throttle=60  ->  a ACTIVE; b c PENDING
nor does it later
    a key=k; completed a; b text=a key=d throttle=60  ->  b ACTIVE; a SUCCEEDED
without a key, a key does not matter
    a key=k; completed a; b text=a throttle=60  ->  a SUCCEEDED; b REJECTED throttled by a
a goal that expired throttles nothing
    a; b key=k ttl=1; wait 1; c key=k throttle=60  ->  a ACTIVE; c PENDING; b RECALLED expired
nor does one that was aborted
    a key=k; heard a; failed a; b key=k throttle=60  ->  b ACTIVE; a ABORTED audio_lost
nor one of which nothing was heard
    a key=k; cancel a; stopped a; b key=k throttle=60  ->  b ACTIVE; a PREEMPTED canceled by door
a goal that was heard in part throttles
    a; heard a; cancel a; stopped a; b text=a throttle=60  ->  a PREEMPTED canceled by door; b REJECTED throttled by a
an aborted one leaves the earlier one remembered
    a; completed a; pass 5; b text=a; failed b; c text=a throttle=60
        ->  a SUCCEEDED; b ABORTED audio_lost; c REJECTED throttled by a
a throttled goal does nothing to others
    a key=k; b key=k; c key=k throttle=1 flush  ->  a ACTIVE; b PENDING; c REJECTED throttled by a

# ttl

a goal waits for less than its time
    a; b ttl=1; wait 0.9  ->  a ACTIVE; b PENDING
a goal whose time is over is recalled
    a; b ttl=1; wait 1  ->  a ACTIVE; b RECALLED expired
a goal that has begun may take its time
    a ttl=1; wait 100  ->  a ACTIVE
it is not started, even if nobody looked at the clock
    a; b ttl=1; c ttl=2; pass 1; completed a  ->  c ACTIVE; a SUCCEEDED; b RECALLED expired
the time of waiting for room counts, and it interrupts nothing
    room 1; a; b; c ttl=1 preempt waited=1  ->  a ACTIVE; b PENDING; c RECALLED expired
nor does a goal that flushes
    room 1; a; b; c ttl=1 flush waited=1  ->  a ACTIVE; b PENDING; c RECALLED expired
nor does it replace
    set ttl=1; a; b key=k; c key=k waited=1  ->  a ACTIVE; b PENDING; c RECALLED expired
one that waited for less is queued
    a; b ttl=1 waited=0.5; wait 0.4  ->  a ACTIVE; b PENDING
and expires when it would have
    a; b ttl=1 waited=0.5; wait 0.5  ->  a ACTIVE; b RECALLED expired
the server's time holds for goals that bring none
    set ttl=5; a; b; c ttl=0; d ttl=9; wait 5  ->  a ACTIVE; c d PENDING; b RECALLED expired
a goal keeps the time with which it was accepted
    set ttl=5; a; b; set ttl=1; c; wait 1  ->  a ACTIVE; b PENDING; c RECALLED expired
it does not start when silence is given up
    a; b ttl=1; cancel a; wait 2  ->  a ABORTED not_silent by door; b RECALLED expired

# pause

the goal that is spoken is held
    a; b; pause; pause  ->  a ACTIVE paused; b PENDING
it goes on
    a; b; pause; resume; resume  ->  a ACTIVE; b PENDING
resume without a pause does nothing
    begin joe; a voice=piper/joe ttl=1; pass 1; resume  ->  a PENDING
goals are accepted and none starts
    pause; a; b  ->  a b PENDING
the first one starts at resume
    pause; a; b; resume  ->  a ACTIVE; b PENDING
a full queue rejects
    room 1; pause; a; b  ->  a PENDING; b REJECTED queue_full
the next one does not start at an end
    a; b; pause; completed a  ->  b PENDING; a SUCCEEDED
it starts at resume
    a; b; pause; completed a; resume  ->  b ACTIVE; a SUCCEEDED
preempt ends the held goal
    a; pause; b preempt  ->  a PREEMPTING preempted by b; b PENDING
and waits
    a; pause; b preempt; stopped a  ->  b PENDING; a PREEMPTED preempted by b
and starts at resume
    a; pause; b preempt; stopped a; resume  ->  b ACTIVE; a PREEMPTED preempted by b
a goal that is being stopped is not held
    a; b; cancel a; pause  ->  a PREEMPTING canceled by door; b PENDING
resume starts none beside it
    a; b; cancel a; pause; resume  ->  a PREEMPTING canceled by door; b PENDING
cancel, ttl and the limit of silence go on
    a; b ttl=1; c; pause; wait 1; cancel c; cancel a; wait 2
        ->  a ABORTED not_silent by door; b RECALLED expired; c RECALLED canceled by door
resume starts none that is too late
    pause; a ttl=1; b; pass 1; resume  ->  b ACTIVE; a RECALLED expired
shutdown ends a held goal, too
    a; b; pause; shutdown; stopped a; resume  ->  a PREEMPTED shutdown; b RECALLED shutdown

# full queue

a queue without places rejects every goal
    room 0; a preempt; b  ->  a b REJECTED queue_full
the newcomer is rejected
    room 2; a; b; c; d  ->  a ACTIVE; b c PENDING; d REJECTED queue_full
the newest of the lowest priority gives way to a higher one
    room 4; a; b; c 1; d; e 2; f 5  ->  a ACTIVE; f e c b PENDING; d RECALLED displaced by f
nothing gives way to its own priority
    room 2; a; b; c 1; d  ->  a ACTIVE; c b PENDING; d REJECTED queue_full
nothing gives way to a lower priority
    room 2; a; b; c 1; d -1 preempt  ->  a ACTIVE; c b PENDING; d REJECTED queue_full
a goal that brings preempt displaces its own priority
    room 2; a 2; b; c; d preempt  ->  a ACTIVE; d b PENDING; c RECALLED displaced by d
with a key, too
    room 2; a 2; b; c; d preempt key=k  ->  a ACTIVE; d b PENDING; c RECALLED displaced by d
while speech is paused, too
    room 2; a 2; b; c; pause; d preempt  ->  a ACTIVE paused; d b PENDING; c RECALLED displaced by d
it displaces of the lowest priority first
    room 4; a 2; b 2; c 1; d 1; e 2; f 2 preempt
        ->  a PREEMPTING preempted by f; f b e c PENDING; d RECALLED displaced by f
it displaces no higher priority
    room 2; a 2; b 1; c 1; d preempt  ->  a ACTIVE; b c PENDING; d REJECTED queue_full
nor does flush
    room 2; a; b 1; c 1; d flush  ->  a ACTIVE; b c PENDING; d REJECTED queue_full
a goal that preempts by the server's setting displaces none
    set preempt=yes; room 2; a queue; b queue; c queue; d  ->  a ACTIVE; b c PENDING; d REJECTED queue_full
a goal that is first may give way, as it is the newest
    room 2; a; b; c preempt; d 1  ->  a PREEMPTING preempted by c; d b PENDING; c RECALLED displaced by d
a goal in the place of another is as new as it is
    room 3; a; b key=k; c; d; e key=k; f 1
        ->  a ACTIVE; f c d PENDING; b RECALLED replaced by e; e RECALLED displaced by f
room is counted after flush
    room 2; a; b -1; c key=k preempt; d flush  ->  a PREEMPTING preempted by c; d PENDING; b c RECALLED preempted by d
room is counted after key, and no more gives way
    room 2; a; b -1; c key=k preempt; d key=k  ->  a PREEMPTING preempted by c; d b PENDING; c RECALLED replaced by d
room is counted after preempt, and no more gives way
    room 2; a; b -1; c preempt; d preempt  ->  a PREEMPTING preempted by c; d b PENDING; c RECALLED preempted by d
the active goal makes no room
    room 1; a; b 1; c preempt  ->  a ACTIVE; b PENDING; c REJECTED queue_full

# cancel

without a selector, everything
    a; b; c; d; cancel  ->  a PREEMPTING canceled by door; b c d RECALLED canceled by door
nothing to cancel
    cancel; cancel current; cancel key=k; a  ->  a ACTIVE
one of three keeps the order of the rest
    a; b; c; d; cancel c  ->  a ACTIVE; b d PENDING; c RECALLED canceled by door
before a goal, all accepted before it
    a 2; b; c; d 1; e 1; f preempt; cancel before=d
        ->  a PREEMPTING canceled by door; e f PENDING; b c d RECALLED canceled by door
selectors add up
    a; b; c; d; e; cancel e current before=b
        ->  a PREEMPTING canceled by door; c d PENDING; b e RECALLED canceled by door
a key, spoken and pending
    a key=k; b key=d; c key=k; cancel key=k  ->  a PREEMPTING canceled by door; b PENDING; c RECALLED canceled by door
a key that no goal has
    a key=d; b; cancel b key=k  ->  a ACTIVE; b RECALLED canceled by door
shutdown ends everything and takes no goal
    a; b; c; shutdown; shutdown; d; stopped a  ->  a PREEMPTED shutdown; b c RECALLED shutdown; d REJECTED shutdown
one that waited for room stops nothing
    room 1; a; b; c flush canceled  ->  a ACTIVE; b PENDING; c RECALLED canceled by door
and is not throttled
    a; b text=a throttle=60 canceled  ->  a ACTIVE; b RECALLED canceled by door

# id

the same id again attaches
    a id=mine; b text=a id=mine  ->  a ACTIVE; b is a
after its end, too
    a id=mine; completed a; b text=a id=mine  ->  a SUCCEEDED; b is a
attaching needs no room and does nothing
    room 1; a; b id=mine; c text=b id=mine throttle=60 flush key=x  ->  a ACTIVE; b PENDING; c is b
attaching goes on after shutdown
    a id=mine; shutdown; b text=a id=mine  ->  a PREEMPTING shutdown; b is a
another text is a conflict
    a id=mine; b id=mine flush  ->  a ACTIVE; b REJECTED id_conflict
after its end, too, another text
    a id=mine; completed a; b id=mine  ->  a SUCCEEDED; b REJECTED id_conflict
an id of the server's attaches to nothing
    a; b text=a id=4k7f-1  ->  a ACTIVE; b REJECTED bad_option
a rejected goal does not use its id up
    a id=mine text=; b id=mine  ->  b ACTIVE; a REJECTED invalid_text
nor does a throttled one
    a; b id=mine text=a throttle=60; c id=mine  ->  a ACTIVE; c PENDING; b REJECTED throttled by a
cancel before an id
    a; b id=mine; c; cancel before=mine  ->  a PREEMPTING canceled by door; c PENDING; b RECALLED canceled by door
a goal that was cancelled before it arrived is recalled
    cancel mine; a id=mine; b text=a id=mine  ->  a RECALLED canceled by door; b is a
by before, too
    cancel before=mine; a id=mine  ->  a RECALLED canceled by door
it needs no room and does nothing
    room 1; a; b key=k; cancel mine; c id=mine key=k flush  ->  a ACTIVE; b PENDING; c RECALLED canceled by door
it is rejected all the same and stays cancelled
    cancel mine; a id=mine text=; b id=mine  ->  a REJECTED invalid_text; b RECALLED canceled by door
it is throttled all the same
    a; cancel mine; b id=mine text=a throttle=60  ->  a ACTIVE; b REJECTED throttled by a
the cancel is remembered for a minute
    cancel mine; pass 59.9; a id=mine  ->  a RECALLED canceled by door
and no longer
    cancel mine; pass 60; a id=mine  ->  a ACTIVE
the cancel of an id of the server's is not remembered
    cancel 4k7f-1; a  ->  a ACTIVE

# engine

a goal that was stopped
    a; cancel a; stopped a  ->  a PREEMPTED canceled by door
though the engine died of it
    a; cancel a; failed a  ->  a PREEMPTED canceled by door
a goal that ends before the stop arrives
    a; cancel a; completed a  ->  a SUCCEEDED
a goal that failed
    a; b; heard a; failed a  ->  b ACTIVE; a ABORTED audio_lost
the first stop gives the reason
    a; cancel a; pass 1.5; b preempt; cancel current; shutdown; stopped a
        ->  a PREEMPTED canceled by door; b RECALLED shutdown
silence is waited for
    a; b; cancel a; wait 1.89  ->  a PREEMPTING canceled by door; b PENDING
and given up
    a; b; cancel a; wait 1.9  ->  b ACTIVE; a ABORTED not_silent by door
and the first stop counts
    a; cancel a; pass 1.5; cancel a; wait 0.5  ->  a ABORTED not_silent by door
silence that the engine can't reach
    a; b; cancel a; deaf a  ->  b ACTIVE; a ABORTED not_silent by door
an undisturbed goal has no limit
    a; wait 1000000  ->  a ACTIVE
without an engine goals wait
    lost; a ttl=1; b; wait 0.5  ->  a b PENDING
and their time runs
    lost; a ttl=1; b; wait 1  ->  b PENDING; a RECALLED expired
they go on with it
    lost; a; b; ready  ->  a ACTIVE; b PENDING
an unheard goal that lost its engine has its time
    a ttl=1; b; wait 2; lost; wait 0  ->  a PREEMPTING expired; b PENDING
one that was heard is not begun anew
    a ttl=1; heard a; lost; wait 20  ->  a ACTIVE
it may end while there is no engine
    a; b; lost; failed a  ->  b PENDING; a ABORTED audio_lost
an engine that does not come costs one goal
    lost; a; b; missing  ->  b PENDING; a ABORTED engine_failed
each time
    lost; a; b; missing; missing  ->  a b ABORTED engine_failed
though its voice was to be loaded
    lost; begin joe; a voice=piper/joe; missing  ->  a ABORTED engine_failed
and none while speech is paused
    lost; a; pause; missing  ->  a PENDING
and none that waits for its voice
    begin joe; a voice=piper/joe; missing  ->  a PENDING
and none once it is there
    a; b; missing  ->  a ACTIVE; b PENDING
"""

REJECTED = {
    "an empty text": ("text=", "invalid_text"),
    "a text that is silent": ("text=\u200b", "invalid_text"),
    "NUL": ("text=a\0", "invalid_text"),
    "half of a surrogate pair": ("text=\ud800", "invalid_text"),
    "100,000 characters": (f"text={'a' * 100_000}", "text_too_long"),
    "another format": ("format=ssml", "bad_option"),
    "a value out of its range": ("rate=1", "bad_option"),
    "a fault of which the server knows": ("fault=unknown_voice", "unknown_voice"),
    "a fault of the text is told before that": ("text= fault=unknown_voice", "invalid_text"),
}


@pytest.mark.parametrize(("script", "outcome"), rules(RULES))
def test_a_rule_holds(script: str, outcome: str) -> None:
    assert play(script).outcome() == outcome


@pytest.mark.parametrize(("options", "reason"), REJECTED.values(), ids=REJECTED.keys())
def test_a_rejected_goal_does_nothing_to_others(options: str, reason: str) -> None:
    robot = play(f"a; b queue; c flush {options}")
    assert robot.outcome() == f"a ACTIVE; b PENDING; c REJECTED {reason}"
    assert robot.seen[-1] == "c REJECTED"
    record = robot.goals["c"]
    assert (record.id, robot.scheduler.find("4k7f-3")) == ("4k7f-3", record)


def test_of_a_thousand_preempting_goals_the_last_is_spoken_whole() -> None:
    robot = Robot()
    goals = [robot.says(f"goal {number}", preempt=True) for number in range(1_000)]
    robot.tells("stopped", goals[0].id)
    robot.tells("completed", goals[-1].id)
    assert [each.state.name for each in goals] == ["PREEMPTED", *["RECALLED"] * 998, "SUCCEEDED"]
    ends = [each for each in robot.seen if each.split()[1] in {"PREEMPTED", "RECALLED", "SUCCEEDED"}]
    assert len(ends) == len(set(ends)) == 1_000
    assert robot.scheduler.unfinished() == []
