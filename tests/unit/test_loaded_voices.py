"""Which neural voice is loaded next, which voices are dropped for it, and how failures are handled."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import pytest

from talkcli.goals.voices import (
    FIRST_VOICE_RETRY_S,
    LAST_VOICE_RETRY_S,
    MAX_ENGINE_DEATHS,
    VoiceDropOrder,
    VoiceScheduler,
    VoiceState,
    VoiceWarning,
)
from tests.unit.robot import rules

if TYPE_CHECKING:
    from collections.abc import Callable

#: In a script, a goal requests a voice ("want a"). The server asks for the next voice to load and names the voices that
#: goals need ("next a b"), with its own voice after a colon ("next : b"). The engine reports that a voice was loaded
#: ("loaded a"), has failed ("failed a") or was dropped ("unloaded a"), its memory in bytes after a voice was loaded
#: ("grown a 40"), and its death ("lost"). "load a" stands for all steps of loading a voice. "excess a : b c" asks which
#: voices are dropped if a speaks and goals need b and c. "memory 2" sets the limit in bytes. A voice takes one byte
#: until it is measured. The outcome consists of the last answer, the dropped voices, and all states.
RULES = """
# what is next

one voice is loaded at a time, in the order of the goals
    want b a; next a b  ->  a; b waiting, a loading
the next voice waits for the one that is loading
    want b a; next a b; next a b  ->  nothing; b waiting, a loading
the next voice is loaded after it
    want b a; next a b; loaded a; next a b  ->  b; b loading, a loaded
no voice is next once all are loaded
    want b a; next a b; loaded a; next a b; loaded b; next a b  ->  nothing; b loaded, a loaded
a voice that no goal needs any more is forgotten
    want a; next  ->  nothing; none
a forgotten voice is not loaded later
    want a; next; next a  ->  nothing; none
a forgotten voice is loaded if a goal asks for it again
    want a; next; want a; next a  ->  a; a loading
the voice asked for least makes room
    load a b; want a c; next c  ->  c, b dropped; a loaded, c loading
no voice is dropped that is needed before
    load a b; want c; next a b c  ->  nothing; a loaded, b loaded, c waiting
a voice that is not needed is dropped
    load a b; want c; next b c  ->  c, a dropped; b loaded, c loading
a dropped voice that is needed later waits again
    memory 1; load a; want b; next b a; loaded b  ->  b, a dropped; b loaded, a waiting
a dropped voice is not loaded before it is needed
    memory 1; load a; want b; next b a; loaded b; next b a  ->  nothing; b loaded, a waiting
a dropped voice is loaded once it is needed
    memory 1; load a; want b; next b a; loaded b; next a  ->  a, b dropped; a loading
a voice larger than the limit is loaded alone
    memory 0; want a; next a  ->  a; a loading
nothing is dropped for the server's own while no goal needs it
    memory 1; load a; want b; next : b  ->  nothing; a loaded, b waiting
a voice is dropped for the server's own once a goal needs that
    memory 1; load a; want b; next b : b  ->  b, a dropped; b loading
the server's own is loaded if nothing is in its way
    memory 0; want a; next : a  ->  a; a loading
a voice that the engine loads of itself stops no other
    want a; next a; loaded d  ->  a; a loading, d loaded

# what voices take

what is larger than allowed is dropped, the voice that is not needed first
    memory 100; load a b c; grown a 40; grown b 80; grown c 125; excess c : c  ->  a dropped; b loaded, c loaded
nothing is dropped while all fit
    memory 100; load a b c; grown a 40; grown b 80; excess b : b  ->  nothing; a loaded, b loaded, c loaded
what a voice takes may grow
    memory 100; load a b c; grown a 40; grown a 60; grown b 100; grown c 130; excess c : c
        ->  a dropped; b loaded, c loaded
what is measured while a voice is loaded replaces the size of its file
    memory 100; want a; next a; grown a 50; loaded a; want b; next b; grown b 100; loaded b; excess b : b
        ->  nothing; a loaded, b loaded
what was dropped no longer counts, before the engine has told what it got back
    memory 100; load a b c; grown a 40; grown b 80; grown c 125; excess c : c; excess c : c
        ->  nothing; b loaded, c loaded
nothing more is dropped after the engine has told what it got back
    memory 100; load a b; grown a 60; grown b 120; excess b : b; grown - 60; excess b : b  ->  nothing; b loaded
what a voice took is remembered
    memory 100; load a b; grown a 60; grown b 110; excess b : b; grown - 50; want a; next a
        ->  a, b dropped; a loading
what the engine did not get back counts, too
    memory 100; load a b; grown a 30; grown b 60; unloaded a; grown - 99; want c; next b c  ->  c; b loaded, c loading
what the engine did not get back leaves no room for a voice
    memory 100; load a b; grown a 30; grown b 60; unloaded a; grown - 100; want c; next b c
        ->  nothing; b loaded, c waiting
a lost engine has grown by nothing
    memory 100; load a b; grown a 99; lost; want d c; next d c; loaded d; next d c  ->  c; d loaded, c loading
the voice that speaks is kept
    memory 50; load a b c; grown a 60; grown b 120; grown c 180; excess a :  ->  b c dropped; a loaded
without a speaking voice, the last one is kept
    memory 50; load a b c; grown a 60; grown b 120; grown c 180; excess - :  ->  a b dropped; c loaded
the voice that is needed last is dropped first
    memory 50; load a b c; grown a 60; grown b 120; grown c 180; excess a : c b
        ->  b c dropped; a loaded, b waiting, c waiting
a voice that is not needed is dropped before one that is
    memory 50; load a b c; grown a 60; grown b 120; grown c 180; excess c : c a  ->  b a dropped; c loaded, a waiting

# an engine that is lost

nothing is loaded any more
    load a b; lost  ->  b; none
a voice that was being loaded is to be loaded again
    want b; next b; lost  ->  b; b waiting
a voice has failed at the second death of the engine
    want b; next b; lost; want b; next b; lost  ->  b; b failed
a voice that has failed is not blamed for a third death
    want b; next b; lost; want b; next b; lost; lost; want b; next b  ->  nothing; b failed
a death is forgotten once the voice is loaded
    want a; next a; lost; load a; lost; want a; next a; lost  ->  a; a waiting
"""


class Asked(VoiceScheduler):
    """A scheduler of voices whose files have a size of one byte."""

    answer = "nothing"
    warnings: tuple[str, ...] | list[str] = ()

    def __init__(self, memory: int = 2) -> None:
        super().__init__(memory, lambda _: 1)

    def play(self, script: str, now: float = 0.0) -> Asked:
        for step in script.split("; "):
            verb, *words = step.split()
            self._do(verb, words, now)
        return self

    def _do(self, verb: str, words: list[str], now: float) -> None:
        place = words.index(":") if ":" in words else len(words)
        before, after = (["" if each == "-" else each for each in part] for part in (words[:place], words[place + 1 :]))
        steps: dict[str, Callable[[], object]] = {
            "memory": lambda: setattr(self, "_limit_bytes", int(words[0])),
            "want": lambda: list(map(partial(self.request, now=now), words)),
            "next": lambda: self._load_next(before, after, now),
            "load": lambda: [self.play(f"want {each}; next {each}; loaded {each}") for each in words],
            "loaded": lambda: self.load_ended(words[0], None, now),
            "failed": lambda: self.load_ended(words[0], "no json", now),
            "unloaded": lambda: self.unloaded(words[0], []),
            "grown": lambda: self.measured(before[0], int(words[1])),
            "excess": lambda: self._drop_excess(before[0], after),
            "lost": lambda: self.engine_lost(now),
        }
        steps[verb]()

    def _load_next(self, needed: list[str], default: list[str], now: float) -> None:
        order = self.load_next(needed, "".join(default), now) if self.can_load else None
        self._tell(order.voice if order else "", order.dropped if order else ())

    def _drop_excess(self, first: str, needed: list[str]) -> None:
        orders = self.drop_excess(first, needed)
        self._tell("", tuple(each.voice for each in orders if isinstance(each, VoiceDropOrder)))
        self.warnings = [each.message for each in orders if isinstance(each, VoiceWarning)]

    def _tell(self, voice: str, dropped: tuple[str, ...]) -> None:
        told = [voice, f"{' '.join(dropped)} dropped" if dropped else ""]
        self.answer = ", ".join(filter(None, told)) or "nothing"

    def outcome(self) -> str:
        states = ", ".join(f"{voice} {each.state.value}" for voice, each in self._voices.items())
        return f"{self.answer}; {states or 'none'}"


@pytest.mark.parametrize(("script", "outcome"), rules(RULES))
def test_a_rule_holds(script: str, outcome: str) -> None:
    assert Asked().play(script).outcome() == outcome


def test_a_voice_that_is_too_large_alone_stays_and_that_is_told_once() -> None:
    voices = Asked(100_000_000).play("load a; grown a 99000000; excess a : a")
    assert voices.warnings == []
    voices.play("grown a 120000000; excess a : a")
    why = "it uses 120 MB, more than --voice-memory 100 allows"
    assert (voices.answer, voices.warnings) == ("nothing", [f"voice a: {why}"])
    assert voices.play("excess a : a").warnings == []
    assert voices.to_json() == {"a": {"state": "loaded", "why": why}}
    assert Asked(0).play("load a; excess a : a").warnings == [], "a limit of 0 means one voice at a time"


def test_a_voice_that_fails_is_tried_again_later_and_later() -> None:
    voices = Asked()
    now, waited = 100.0, []
    for _ in range(14):
        voices.play("want a; next a; failed a", now)
        assert (voices.answer, voices.failure("a")) == ("a", "no json")
        again = voices._voices["a"].retry_at
        assert voices.play("want a; next a", again - 0.001).outcome() == "nothing; a failed"
        waited.append(again - now)
        now = again
    assert waited[:3] == pytest.approx([FIRST_VOICE_RETRY_S, 2 * FIRST_VOICE_RETRY_S, 4 * FIRST_VOICE_RETRY_S])
    assert waited[-1] == pytest.approx(LAST_VOICE_RETRY_S)
    voices.forget_failure("a")
    assert voices.play("want a", now).outcome() == "nothing; a waiting"


def test_a_voice_has_failed_while_it_is_tried_again() -> None:
    voices = Asked().play("want a; next a; failed a")
    assert voices.play("want a; next a", FIRST_VOICE_RETRY_S).outcome() == "a; a failed"
    assert voices.play("want a", 1000.0)._voices["a"].state is VoiceState.FAILED
    assert not voices.can_load
    assert voices.play("loaded a").to_json() == {"a": {"state": "loaded", "why": None}}


def test_a_voice_that_no_goal_needs_any_more_keeps_nobody_looking() -> None:
    voices = Asked().play("want a; next : b")
    assert (voices.can_load, voices.outcome()) == (False, "nothing; none")
    voices.play("want a; next a; failed a").play("want a", FIRST_VOICE_RETRY_S)
    assert voices.can_load
    assert (voices.play("next").outcome(), voices.can_load) == ("nothing; a failed", False)


def test_an_engine_that_dies_twice_has_its_cause() -> None:
    assert MAX_ENGINE_DEATHS == 2
    voices = Asked().play("want a; next a; lost; want a; next a")
    why = "the engine process died while loading the voice"
    assert voices.engine_lost(0.0) == [VoiceWarning(f"voice a is not used: {why}")]
    assert voices.engine_lost(0.0) == []
    assert voices.failure("a") == why
