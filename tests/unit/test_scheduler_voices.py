"""Which voices the scheduler loads, and how long goals wait for them. The scripts are for `tests.unit.robot`."""

from __future__ import annotations

from math import inf

import pytest

from tests.unit.robot import play, rules

RULES = """
a goal waits for its voice, and later goals wait, too
    a voice=piper/joe; b  ->  a b PENDING
a goal with a speaker waits for the speaker's voice
    a voice=piper/joe#3; b; wait 9.9; loaded amy  ->  a b PENDING
a goal starts once its voice is loaded
    a voice=piper/joe#3; b; loaded joe  ->  a ACTIVE; b PENDING
a goal starts if its voice can't be loaded
    a voice=piper/joe; b; unloadable joe  ->  a ACTIVE; b PENDING
a goal does not wait for a voice that has failed before
    a voice=piper/joe; unloadable joe; completed a; b voice=piper/joe  ->  b ACTIVE; a SUCCEEDED
a goal does not wait for a voice that is loaded
    a voice=piper/joe; loaded joe; completed a; b voice=piper/joe  ->  b ACTIVE; a SUCCEEDED
a goal does not wait for the voice of another goal
    a voice=piper/joe; loaded joe; b voice=piper/amy; completed a; loaded amy  ->  b ACTIVE; a SUCCEEDED
a goal without a voice waits for the server's voice
    set voice=piper/joe; a; b voice=en  ->  a b PENDING
a goal with a voice does not wait for the server's voice
    set voice=piper/joe; a voice=en; b  ->  a ACTIVE; b PENDING
a goal without a voice starts if the server's voice changes
    set voice=piper/joe; a; set voice=en  ->  a ACTIVE
a goal starts once loading has taken ten seconds
    set voice=piper/joe; wait 4; a voice=piper/joe; wait 6  ->  a ACTIVE
a sound does not wait for the server's voice
    set voice=piper/joe; a format=sound; b  ->  a ACTIVE; b PENDING
a goal that preempts does not wait
    a voice=piper/joe; b voice=piper/joe preempt  ->  b ACTIVE; a PENDING
a goal that flushes does not wait
    a voice=piper/joe; b voice=piper/joe flush  ->  b ACTIVE; a RECALLED preempted by b
a goal of a higher priority does not wait
    a voice=piper/joe; b voice=piper/joe 1  ->  b ACTIVE; a PENDING
a goal that expires in half a second starts at once
    a voice=piper/joe ttl=0.5  ->  a ACTIVE
a goal with voice_only waits until the voice is loaded
    a voice=piper/joe voice_only; wait 60  ->  a PENDING
a goal with voice_only waits even if it preempts
    a voice=piper/joe voice_only preempt; wait 60  ->  a PENDING
a goal with voice_only expires like any other goal
    a voice=piper/joe voice_only ttl=3; b; wait 3  ->  b ACTIVE; a RECALLED expired
a goal starts if the goal before it is cancelled
    a voice=piper/joe; b; cancel a; wait 0  ->  b ACTIVE; a RECALLED canceled by door
a loaded voice starts no goal beside the active one
    a; b voice=piper/joe; loaded joe  ->  a ACTIVE; b PENDING
a loaded voice starts no goal while speech is paused
    a voice=piper/joe; pause; loaded joe  ->  a PENDING
a goal waits for its voice again if a new engine has to load it
    a voice=piper/joe; lost; wait 3; ready  ->  a PENDING
a goal that has waited ten seconds for an engine does not wait for its voice
    a voice=piper/joe; lost; wait 20; ready  ->  a ACTIVE
goals wait for no voice if there is no engine to load it
    a voice=piper/joe; lost; unavailable  ->  a ACTIVE
"""

#: The time at which the next goal stops waiting, in monotonic seconds. A script starts at 100.
DEADLINES = {
    "set voice=piper/joe; wait 4; a voice=piper/joe": 110,
    "a; b voice=piper/joe; wait 60": inf,
    "a; b voice=piper/joe; wait 60; completed a": 170,
    "a; b voice=piper/joe; wait 60; completed a; wait 4; loaded amy": 170,
    "a voice=piper/joe; b voice=piper/amy; wait 3; cancel a": 0,
    "a voice=piper/joe; b voice=piper/amy; wait 3; cancel a; wait 0": 113,
    "a voice=piper/joe ttl=2": 101.5,
    "a voice=piper/joe ttl=99": 110,
    "a voice=piper/joe voice_only": inf,
    "a voice=piper/joe voice_only ttl=3": 103,
    "a voice=piper/joe; loaded joe": inf,
    "a voice=piper/joe; pause": inf,
    "a voice=piper/joe; lost": inf,
    "set voice=piper/joe; a; pause; set voice=en; resume": inf,
}

#: Orders to load and to drop voices. The robot's voices may take 10 bytes.
ORDERS = {
    "a voice=piper/joe": "load piper/joe",
    "a voice=piper/joe; b voice=piper/amy": "load piper/joe",
    "a voice=piper/joe; b voice=piper/amy; loaded joe": "load piper/joe, load piper/amy",
    "a; b voice=piper/joe": "",  # loading would import the libraries while a goal is active
    "a; b voice=piper/joe; completed a": "load piper/joe",
    "a voice=piper/joe; loaded joe; b voice=piper/amy": "load piper/joe, load piper/amy",
    "set voice=piper/joe": "load piper/joe",
    "set voice=piper/joe; unloadable joe; set voice=piper/joe": "load piper/joe, load piper/joe",
    "a voice=piper/joe; unloadable joe; wait 1; b voice=piper/joe": "load piper/joe",
    "a voice=piper/joe; unloadable joe; wait 5; b voice=piper/joe": "load piper/joe, load piper/joe",
    "a voice=piper/joe; measured joe 8; loaded joe; chosen a joe; completed a; b voice=piper/amy; measured amy 16; "
    "loaded amy": "load piper/joe, load piper/amy, drop piper/joe",
    "a voice=piper/joe; measured joe 8; loaded joe; b voice=piper/amy; measured amy 16; loaded amy": (
        "load piper/joe, load piper/amy, drop piper/amy"  # amy is needed later
    ),
    "a voice=piper/joe; measured joe 10; loaded joe; b voice=piper/amy": "load piper/joe",
    "a voice=piper/joe; measured joe 10; loaded joe; b voice=piper/amy; chosen a joe": (
        "load piper/joe, drop piper/joe, load piper/amy"
    ),
    "a voice=piper/joe; loaded joe; completed a; unloaded joe": "load piper/joe",
    "a voice=piper/joe; loaded joe; b voice=piper/joe; unloaded joe": "load piper/joe, load piper/joe",
    "a voice=piper/joe; lost; ready": "load piper/joe, load piper/joe",
    "a voice=piper/joe; shutdown; loaded joe": "load piper/joe",
}


@pytest.mark.parametrize(("script", "outcome"), rules(RULES))
def test_a_rule_holds(script: str, outcome: str) -> None:
    assert play(script).outcome() == outcome


@pytest.mark.parametrize("script", DEADLINES)
def test_the_deadline_is_the_end_of_the_wait(script: str) -> None:
    assert play(script).scheduler.deadline() == DEADLINES[script]


@pytest.mark.parametrize("script", ORDERS)
def test_voices_are_loaded_and_dropped_in_the_order_of_the_goals(script: str) -> None:
    orders = [effect for effect in play(script).seen if effect.startswith(("load", "drop"))]
    assert ", ".join(orders) == ORDERS[script]
