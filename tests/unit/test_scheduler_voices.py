"""How long a goal waits for its voice to be loaded: each rule with a script, in the language of `tests.unit.robot`."""

from __future__ import annotations

import pytest

from tests.unit.robot import play, rules

RULES = """
a goal waits for its voice, and so do those behind it
    begin joe; a voice=piper/joe; b  ->  a b PENDING
a goal with a speaker waits for the speaker's voice
    begin joe; a voice=piper/joe#3; b; wait 9.9; end amy  ->  a b PENDING
a goal begins once its voice is loaded
    begin joe; a voice=piper/joe#3; b; end joe  ->  a ACTIVE; b PENDING
a goal does not wait for another voice
    begin joe; a voice=piper/amy  ->  a ACTIVE
a goal without a voice waits for the server's
    begin joe; set voice=piper/joe; a; b voice=en  ->  a b PENDING
a goal with a voice does not wait for the server's
    begin joe; set voice=piper/joe; a voice=en; b  ->  a ACTIVE; b PENDING
a goal without a voice begins if the server's voice changes
    begin joe; set voice=piper/joe; a; set voice=en; wait 0  ->  a ACTIVE
a goal waits ten seconds from when loading began
    begin joe; wait 4; a voice=piper/joe; wait 5.9  ->  a PENDING
a goal begins ten seconds after loading began
    begin joe; wait 4; a voice=piper/joe; wait 6  ->  a ACTIVE
a goal that preempts does not wait
    begin joe; a voice=piper/joe; b voice=piper/joe preempt  ->  b ACTIVE; a PENDING
a goal that flushes does not wait
    begin joe; a voice=piper/joe; b voice=piper/joe flush  ->  b ACTIVE; a RECALLED preempted by b
a goal of a higher priority does not wait
    begin joe; a voice=piper/joe; b voice=piper/joe 1  ->  b ACTIVE; a PENDING
a goal of a lower priority waits
    begin joe; a voice=piper/joe -1  ->  a PENDING
a goal of which half a second is left begins at once
    begin joe; a voice=piper/joe ttl=0.5  ->  a ACTIVE
a goal that insists waits until the voice is loaded
    begin joe; a voice=piper/joe voice_only; wait 60  ->  a PENDING
a goal that insists waits even if it preempts
    begin joe; a voice=piper/joe voice_only preempt; wait 60  ->  a PENDING
a goal that insists waits even if its priority is high
    begin joe; a voice=piper/joe voice_only 5; wait 60; end joe  ->  a ACTIVE
a goal that insists expires like any other
    begin joe; a voice=piper/joe voice_only ttl=3; b; wait 3  ->  b ACTIVE; a RECALLED expired
a goal behind one that was cancelled begins
    begin joe; a voice=piper/joe; b; cancel a; wait 0  ->  b ACTIVE; a RECALLED canceled by door
a loaded voice starts none beside the active goal
    a; begin joe; b voice=piper/joe; end joe  ->  a ACTIVE; b PENDING
a loaded voice starts no goal while speech is paused
    begin joe; a voice=piper/joe; pause; end joe  ->  a PENDING
an engine that is lost loads nothing
    begin joe; a voice=piper/joe; lost; wait 20; ready  ->  a ACTIVE
"""

#: When the goal whose turn it is waits no longer, in monotonic seconds; a script begins at 100.
DEADLINES = {
    "begin joe; wait 4; a voice=piper/joe": 110,
    "begin joe; wait 4; expect joe; a voice=piper/joe": 110,
    "a; expect joe; b voice=piper/joe; wait 60": None,
    "a; expect joe; b voice=piper/joe; wait 60; completed a": 170,
    "a; expect joe; b voice=piper/joe; wait 60; completed a; wait 4; begin joe": 174,
    "begin joe; expect amy; a voice=piper/joe; b voice=piper/amy; wait 3; cancel a": 0,
    "begin joe; expect amy; a voice=piper/joe; b voice=piper/amy; wait 3; cancel a; wait 0": 113,
    "begin joe; a voice=piper/joe ttl=2": 101.5,
    "begin joe; a voice=piper/joe ttl=99": 110,
    "begin joe; a voice=piper/joe voice_only": None,
    "begin joe; a voice=piper/joe voice_only ttl=3": 103,
    "begin joe; a voice=piper/joe; end joe": None,
    "a; begin joe; b voice=piper/joe": None,
    "begin joe; a voice=piper/joe; pause": None,
    "begin joe; a voice=piper/joe; lost": None,
    "begin joe; set voice=piper/joe; a; set voice=en": 0,
}


@pytest.mark.parametrize(("script", "outcome"), rules(RULES))
def test_a_rule_holds(script: str, outcome: str) -> None:
    assert play(script).outcome() == outcome


@pytest.mark.parametrize("script", DEADLINES)
def test_the_deadline_is_the_end_of_the_wait(script: str) -> None:
    assert play(script).scheduler.deadline() == DEADLINES[script]
