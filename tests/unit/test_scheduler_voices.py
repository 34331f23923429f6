"""How long a goal waits for its voice to be loaded: one row for each rule, in the language of `tests.unit.robot`."""

from __future__ import annotations

import pytest

from tests.unit.robot import play

JOE, AMY = "voice=piper/joe", "voice=piper/amy"

RULES = {
    "a goal waits for its voice, and so do those behind it": (f"begin joe; a {JOE}; b", "a b PENDING"),
    "a speaker is of its voice": (f"begin joe; a {JOE}#3; b; wait 9.9; end amy", "a b PENDING"),
    "it begins once the voice is loaded": (f"begin joe; a {JOE}#3; b; end joe", "a ACTIVE; b PENDING"),
    "another voice is not waited for": (f"begin joe; a {AMY}", "a ACTIVE"),
    "a goal without a voice waits for the server's": (f"begin joe; set {JOE}; a; b voice=en", "a b PENDING"),
    "a goal with a voice does not": (f"begin joe; set {JOE}; a voice=en; b", "a ACTIVE; b PENDING"),
    "the server's may change": (f"begin joe; set {JOE}; a; set voice=en; wait 0", "a ACTIVE"),
    "it waits ten seconds from when loading began": (f"begin joe; wait 4; a {JOE}; wait 5.9", "a PENDING"),
    "and no longer": (f"begin joe; wait 4; a {JOE}; wait 6", "a ACTIVE"),
    "if loading has not begun, from its turn": (
        f"a; expect joe; b {JOE}; wait 60; completed a; wait 9.9",
        "b PENDING; a SUCCEEDED",
    ),
    "or no longer than that": (f"a; expect joe; b {JOE}; wait 60; completed a; wait 10", "b ACTIVE; a SUCCEEDED"),
    "a turn may come by a cancel": (
        f"begin joe; expect amy; a {JOE}; b {AMY}; wait 3; cancel a; wait 0; wait 10",
        "b ACTIVE; a RECALLED canceled by door",
    ),
    "a goal that preempts does not wait": (f"begin joe; a {JOE}; b {JOE} preempt", "b ACTIVE; a PENDING"),
    "nor does one that flushes": (f"begin joe; a {JOE}; b {JOE} flush", "b ACTIVE; a RECALLED preempted by b"),
    "nor one of a higher priority": (f"begin joe; a {JOE}; b {JOE} 1", "b ACTIVE; a PENDING"),
    "one of a lower priority does": (f"begin joe; a {JOE} -1", "a PENDING"),
    "a goal waits while more than half a second of its time is left": (
        f"begin joe; a {JOE} ttl=2; wait 1.4",
        "a PENDING",
    ),
    "then it begins": (f"begin joe; a {JOE} ttl=2; wait 1.5", "a ACTIVE"),
    "or at once": (f"begin joe; a {JOE} ttl=0.5", "a ACTIVE"),
    "a goal that insists waits until the voice is loaded": (f"begin joe; a {JOE} voice_only; wait 60", "a PENDING"),
    "though it preempts": (f"begin joe; a {JOE} voice_only preempt; wait 60", "a PENDING"),
    "though its priority is high": (f"begin joe; a {JOE} voice_only 5; wait 60; end joe", "a ACTIVE"),
    "and expires like any other": (f"begin joe; a {JOE} voice_only ttl=3; b; wait 3", "b ACTIVE; a RECALLED expired"),
    "a goal behind one that was cancelled begins": (
        f"begin joe; a {JOE}; b; cancel a; wait 0",
        "b ACTIVE; a RECALLED canceled by door",
    ),
    "a loaded voice starts none beside the active goal": (f"a; begin joe; b {JOE}; end joe", "a ACTIVE; b PENDING"),
    "nor while speech is paused": (f"begin joe; a {JOE}; pause; end joe", "a PENDING"),
    "an engine that is lost loads nothing": (f"begin joe; a {JOE}; lost; wait 20; ready", "a ACTIVE"),
}

DEADLINES = {
    f"begin joe; wait 4; a {JOE}": 110,
    f"begin joe; wait 4; expect joe; a {JOE}": 110,
    f"a; expect joe; b {JOE}; wait 60": None,
    f"a; expect joe; b {JOE}; wait 60; completed a": 170,
    f"a; expect joe; b {JOE}; wait 60; completed a; wait 4; begin joe": 174,
    f"begin joe; expect amy; a {JOE}; b {AMY}; wait 3; cancel a": 0,
    f"begin joe; expect amy; a {JOE}; b {AMY}; wait 3; cancel a; wait 0": 113,
    f"begin joe; a {JOE} ttl=2": 101.5,
    f"begin joe; a {JOE} ttl=99": 110,
    f"begin joe; a {JOE} voice_only": None,
    f"begin joe; a {JOE} voice_only ttl=3": 103,
    f"begin joe; a {JOE}; end joe": None,
    f"a; begin joe; b {JOE}": None,
    f"begin joe; a {JOE}; pause": None,
    f"begin joe; a {JOE}; lost": None,
    f"begin joe; set {JOE}; a; set voice=en": 0,
}


@pytest.mark.parametrize(("script", "outcome"), RULES.values(), ids=RULES.keys())
def test_a_rule_holds(script: str, outcome: str) -> None:
    assert play(script).outcome() == outcome


@pytest.mark.parametrize("script", DEADLINES)
def test_the_deadline_is_the_end_of_the_wait(script: str) -> None:
    assert play(script).scheduler.deadline() == DEADLINES[script]
