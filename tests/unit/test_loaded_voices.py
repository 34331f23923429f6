"""Which neural voice is loaded next, which voices are dropped for it, and how failures are handled."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import pytest

from talkcli.goals.voices import (
    MAX_ENGINE_DEATHS,
    MAX_VOICE_RETRY_S,
    MIN_VOICE_RETRY_S,
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
# the next voice

one voice is loaded at a time, in the order of the goals
    want b a; next a b  ->  a; b waiting, a loading
the next voice waits for the one that is loading
    want b a; next a b; next a b  ->  nothing; b waiting, a loading
the next voice is loaded after the first one
    want b a; next a b; loaded a; next a b  ->  b; b loading, a loaded
no voice is next once all are loaded
    want b a; next a b; loaded a; next a b; loaded b; next a b  ->  nothing; b loaded, a loaded
a voice that no goal needs any more is forgotten
    want a; next  ->  nothing; none
a forgotten voice is not loaded later
    want a; next; next a  ->  nothing; none
a forgotten voice is loaded if a goal requests it again
    want a; next; want a; next a  ->  a; a loading
the least recently requested voice is dropped for a new one
    load a b; want a c; next c  ->  c, b dropped; a loaded, c loading
a voice that is needed earlier is not dropped
    load a b; want c; next a b c  ->  nothing; a loaded, b loaded, c waiting
a voice that is not needed is dropped
    load a b; want c; next b c  ->  c, a dropped; b loaded, c loading
a dropped voice that is needed later waits again
    memory 1; load a; want b; next b a; loaded b  ->  b, a dropped; b loaded, a waiting
a dropped voice is not loaded before it is needed
    memory 1; load a; want b; next b a; loaded b; next b a  ->  nothing; b loaded, a waiting
a dropped voice is loaded once it is needed
    memory 1; load a; want b; next b a; loaded b; next a  ->  a, b dropped; a loading
a voice larger than the limit is loaded as the only one
    memory 0; want a; next a  ->  a; a loading
no voice is dropped for the server's own voice before a goal needs that
    memory 1; load a; want b; next : b  ->  nothing; a loaded, b waiting
a voice is dropped for the server's own voice once a goal needs that
    memory 1; load a; want b; next b : b  ->  b, a dropped; b loading
the server's own voice is loaded if no other voice is loaded
    memory 0; want a; next : a  ->  a; a loading
a voice that the engine loads by itself does not delay others
    want a; next a; loaded d  ->  a; a loading, d loaded

# memory

no voice is dropped below the limit
    memory 100; load a b c; grown a 40; grown b 80; excess b : b  ->  nothing; a loaded, b loaded, c loaded
the memory of a voice may grow
    memory 100; load a b c; grown a 40; grown a 60; grown b 100; grown c 130; excess c : c
        ->  a dropped; b loaded, c loaded
memory measured while a voice is loading replaces the size of its file
    memory 100; want a; next a; grown a 50; loaded a; want b; next b; grown b 100; loaded b; excess b : b
        ->  nothing; a loaded, b loaded
a dropped voice no longer counts, even before the engine reports its memory again
    memory 100; load a b c; grown a 40; grown b 80; grown c 125; excess c : c; excess c : c
        ->  nothing; b loaded, c loaded
no other voice is dropped after the engine reports less memory
    memory 100; load a b; grown a 60; grown b 120; excess b : b; grown - 60; excess b : b  ->  nothing; b loaded
the memory of a dropped voice is remembered
    memory 100; load a b; grown a 60; grown b 110; excess b : b; grown - 50; want a; next a
        ->  a, b dropped; a loading
memory that the engine did not free counts, too
    memory 100; load a b; grown a 30; grown b 60; unloaded a; grown - 99; want c; next b c  ->  c; b loaded, c loading
memory that the engine did not free may leave no room for a voice
    memory 100; load a b; grown a 30; grown b 60; unloaded a; grown - 100; want c; next b c
        ->  nothing; b loaded, c waiting
the memory of a lost engine no longer counts
    memory 100; load a b; grown a 99; lost; want d c; next d c; loaded d; next d c  ->  c; d loaded, c loading
the voice that is speaking is kept
    memory 50; load a b c; grown a 60; grown b 120; grown c 180; excess a :  ->  b c dropped; a loaded
without a speaking voice, the last one is kept
    memory 50; load a b c; grown a 60; grown b 120; grown c 180; excess - :  ->  a b dropped; c loaded
the voice that is needed last is dropped first
    memory 50; load a b c; grown a 60; grown b 120; grown c 180; excess a : c b
        ->  b c dropped; a loaded, b waiting, c waiting
a voice that is not needed is dropped before one that is
    memory 50; load a b c; grown a 60; grown b 120; grown c 180; excess c : c a  ->  b a dropped; c loaded, a waiting

# a lost engine

all voices of a lost engine are forgotten
    load a b; lost  ->  b; none
a voice that was loading is waiting again
    want b; next b; lost  ->  b; b waiting
a voice that has failed is not blamed for a third death
    want b; next b; lost; want b; next b; lost; lost; want b; next b  ->  nothing; b failed
a death is forgotten once the voice is loaded
    want a; next a; lost; load a; lost; want a; next a; lost  ->  a; a waiting
"""


class ScriptedVoices(VoiceScheduler):
    """A voice scheduler that plays scripts. Every voice file has a size of one byte."""

    answer = "nothing"
    warnings: tuple[str, ...] | list[str] = ()

    def __init__(self, memory: int = 2) -> None:
        super().__init__(memory, lambda _: 1)

    def play(self, script: str, now: float = 0.0) -> ScriptedVoices:
        for step in script.split("; "):
            verb, *words = step.split()
            self._do(verb, words, now)
        return self

    def _do(self, verb: str, words: list[str], now: float) -> None:
        place = words.index(":") if ":" in words else len(words)
        before, after = (["" if word == "-" else word for word in part] for part in (words[:place], words[place + 1 :]))
        steps: dict[str, Callable[[], object]] = {
            "memory": lambda: setattr(self, "_limit_bytes", int(words[0])),
            "want": lambda: list(map(partial(self.request, now=now), words)),
            "next": lambda: self._load_next(before, after, now),
            "load": lambda: [self.play(f"want {voice}; next {voice}; loaded {voice}") for voice in words],
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
        self._set_answer(order.voice if order else "", order.dropped if order else ())

    def _drop_excess(self, first: str, needed: list[str]) -> None:
        orders = self.drop_excess(first, needed)
        self._set_answer("", tuple(order.voice for order in orders if isinstance(order, VoiceDropOrder)))
        self.warnings = [order.message for order in orders if isinstance(order, VoiceWarning)]

    def _set_answer(self, voice: str, dropped: tuple[str, ...]) -> None:
        parts = [voice, f"{' '.join(dropped)} dropped" if dropped else ""]
        self.answer = ", ".join(filter(None, parts)) or "nothing"

    def outcome(self) -> str:
        states = ", ".join(f"{voice} {neural_voice.state.value}" for voice, neural_voice in self._voices.items())
        return f"{self.answer}; {states or 'none'}"


@pytest.mark.parametrize(("script", "outcome"), rules(RULES))
def test_a_rule_holds(script: str, outcome: str) -> None:
    assert ScriptedVoices().play(script).outcome() == outcome


def test_a_single_voice_that_is_too_large_stays_with_one_warning() -> None:
    voices = ScriptedVoices(100_000_000).play("load a; grown a 99000000; excess a : a")
    assert voices.warnings == []
    voices.play("grown a 120000000; excess a : a")
    why = "it uses 120 MB, more than --voice-memory 100 allows"
    assert (voices.answer, voices.warnings) == ("nothing", [f"voice a: {why}"])
    assert voices.play("excess a : a").warnings == []
    assert voices.to_json() == {"a": {"state": "loaded", "why": why}}
    assert ScriptedVoices(0).play("load a; excess a : a").warnings == [], "a limit of 0 means one voice at a time"


def test_a_failed_voice_is_retried_at_growing_intervals() -> None:
    voices = ScriptedVoices()
    now, delays = 100.0, []
    for _ in range(14):
        voices.play("want a; next a; failed a", now)
        assert (voices.answer, voices.failure("a")) == ("a", "no json")
        retry_at = voices._voices["a"].retry_at
        assert voices.play("want a; next a", retry_at - 0.001).outcome() == "nothing; a failed"
        delays.append(retry_at - now)
        now = retry_at
    assert delays[:3] == pytest.approx([MIN_VOICE_RETRY_S, 2 * MIN_VOICE_RETRY_S, 4 * MIN_VOICE_RETRY_S])
    assert delays[-1] == pytest.approx(MAX_VOICE_RETRY_S)
    voices.forget_failure("a")
    assert voices.play("want a", now).outcome() == "nothing; a waiting"


def test_a_voice_still_counts_as_failed_while_it_is_retried() -> None:
    voices = ScriptedVoices().play("want a; next a; failed a")
    assert voices.play("want a; next a", MIN_VOICE_RETRY_S).outcome() == "a; a failed"
    assert voices.play("want a", 1000.0)._voices["a"].state is VoiceState.FAILED
    assert not voices.can_load
    assert voices.play("loaded a").to_json() == {"a": {"state": "loaded", "why": None}}


def test_no_load_is_pending_once_no_goal_needs_the_voice() -> None:
    voices = ScriptedVoices().play("want a; next : b")
    assert (voices.can_load, voices.outcome()) == (False, "nothing; none")
    voices.play("want a; next a; failed a").play("want a", MIN_VOICE_RETRY_S)
    assert voices.can_load
    assert (voices.play("next").outcome(), voices.can_load) == ("nothing; a failed", False)


def test_a_voice_fails_with_a_reason_after_the_engine_died_twice() -> None:
    assert MAX_ENGINE_DEATHS == 2
    voices = ScriptedVoices().play("want a; next a; lost; want a; next a")
    why = "the engine process died while loading the voice"
    assert voices.engine_lost(0.0) == [VoiceWarning(f"voice a is not used: {why}")]
    assert voices.engine_lost(0.0) == []
    assert voices.failure("a") == why
