"""Which neural voice is loaded next, which are dropped for it, and what becomes of one that fails."""

from __future__ import annotations

import pytest

from talkcli.server.voices import DEATHS, RETRY_AFTER, RETRY_AT_LAST, Readiness, Voices

A, B, C, D = (f"piper/{each}" for each in "abcd")


class Asked(Voices):
    """Voices of one megabyte each, of which two may be kept."""

    def __init__(self, memory: int = 2) -> None:
        super().__init__(memory)

    @staticmethod
    def _size(_: str) -> int:
        return 1

    def wants(self, *voices: str, now: float = 0.0) -> None:
        for each in voices:
            self.want(each, now)

    def loads(self, *voices: str) -> None:
        for each in voices:
            self.wants(each)
            assert self.next([each]) == (each, ())
            self.loaded(each, None, 0.0)

    def states(self) -> dict[str, str]:
        return {voice: each.state.value for voice, each in self.neural.items()}


def test_one_voice_is_loaded_at_a_time_in_the_order_of_the_goals() -> None:
    voices = Asked()
    voices.wants(B, A)
    assert voices.next([A, B]) == (A, ())
    assert voices.next([A, B]) is None
    assert voices.states() == {B: "waiting", A: "loading"}
    voices.loaded(A, None, 1.0)
    assert voices.next([A, B]) == (B, ())
    voices.loaded(B, None, 2.0)
    assert (voices.lacking, voices.next([A, B])) == (False, None)
    assert voices.to_json() == {each: {"state": "loaded", "why": None} for each in (B, A)}


def test_what_nobody_needs_any_more_is_not_loaded() -> None:
    voices = Asked()
    voices.wants(A)
    assert voices.next([]) is None
    assert voices.next([A]) is None
    voices.wants(A)
    assert voices.next([A]) == (A, ())


def test_the_one_asked_for_least_makes_room() -> None:
    voices = Asked()
    voices.loads(A, B)
    voices.wants(A, C)
    assert voices.next([C]) == (C, (B,))
    assert voices.states() == {A: "loaded", C: "loading"}


def test_no_voice_is_dropped_that_is_needed_before() -> None:
    voices = Asked()
    voices.loads(A, B)
    voices.wants(C)
    assert voices.next([A, B, C]) is None
    assert voices.next([B, C]) == (C, (A,))


def test_one_that_is_dropped_and_needed_later_is_to_be_loaded_again() -> None:
    voices = Asked(1)
    voices.loads(A)
    voices.wants(B)
    assert voices.next([B, A]) == (B, (A,))
    voices.loaded(B, None, 0.0)
    assert voices.states() == {B: "loaded", A: "waiting"}
    assert voices.next([B, A]) is None
    assert voices.next([A]) == (A, (B,))


def test_what_is_larger_than_the_limit_is_loaded_alone() -> None:
    voices = Asked(0)
    voices.wants(A)
    assert voices.next([A]) == (A, ())


def test_what_voices_take_counts_as_the_engine_measures_it() -> None:
    voices = Asked(100)
    voices.loads(A, B, C)
    voices.grown(A, 40)
    voices.grown(B, 80)
    assert voices.excess(B, [B]) == ()
    voices.grown(C, 125)
    assert voices.excess(C, [C]) == (A,)
    assert voices.states() == {B: "loaded", C: "loaded"}
    assert voices.excess(C, [C]) == (), "the engine has not told yet what it got back"
    voices.grown("", 85)
    assert voices.excess(C, [C]) == ()
    voices.wants(A)
    assert voices.next([A]) == (A, (B,)), "what it took is remembered"
    voices.grown(A, 86)
    voices.loaded(A, None, 0.0)
    voices.engine_lost(0.0)
    voices.wants(D, B)
    assert voices.next([D, B]) == (D, ())


def test_what_the_engine_did_not_get_back_counts_too() -> None:
    voices = Asked(100)
    voices.loads(A, B)
    voices.grown(A, 30)
    voices.grown(B, 60)
    voices.unloaded(A, [])
    voices.grown("", 58)
    voices.wants(C)
    voices.neural[C].size = 50
    assert voices.next([B, C]) is None, "28 + 30 + 50"


@pytest.mark.parametrize(
    ("first", "needed", "dropped", "states"),
    [
        ("", [], (A, B), {C: "loaded"}),
        (A, [], (B, C), {A: "loaded"}),
        (A, [C, B], (B, C), {A: "loaded", B: "waiting", C: "waiting"}),
        (C, [C, A], (B, A), {C: "loaded", A: "waiting"}),
    ],
)
def test_the_voice_that_is_needed_last_is_dropped_first(
    first: str, needed: list[str], dropped: tuple[str, ...], states: dict[str, str]
) -> None:
    voices = Asked(50)
    voices.loads(A, B, C)
    for number, each in enumerate((A, B, C), 1):
        voices.grown(each, 60 * number)
    assert voices.excess(first, needed) == dropped
    assert voices.states() == states


def test_a_voice_that_is_too_large_alone_stays_and_that_is_told_once() -> None:
    voices = Asked(100_000_000)
    voices.loads(A)
    voices.grown(A, 99_000_000)
    assert voices.too_large() is None
    voices.grown(A, 120_000_000)
    assert voices.excess(A, [A]) == ()
    why = "it takes 120 MB, more than --voice-memory 100"
    assert voices.too_large() == f"voice {A}: {why}"
    assert voices.too_large() is None
    assert voices.to_json() == {A: {"state": "loaded", "why": why}}
    alone = Asked(0)
    alone.loads(A)
    assert alone.too_large() is None, "who allows 0 wants one at a time"


def test_one_that_fails_is_tried_again_where_it_is_asked_for_later_and_later() -> None:
    voices = Asked()
    now, waited = 100.0, []
    for _ in range(14):
        voices.wants(A, now=now)
        assert voices.next([A]) == (A, ())
        voices.loaded(A, "no json", now)
        assert voices.to_json() == {A: {"state": "failed", "why": "no json"}}
        again = voices.neural[A].again_at
        voices.wants(A, now=again - 0.001)
        assert voices.next([A]) is None
        waited.append(again - now)
        now = again
    assert waited[:3] == pytest.approx([RETRY_AFTER, 2 * RETRY_AFTER, 4 * RETRY_AFTER])
    assert waited[-1] == pytest.approx(RETRY_AT_LAST)
    voices.forgive(A)
    assert voices.want(A, now) is Readiness.WAITING


def test_while_it_is_tried_again_it_has_failed() -> None:
    voices = Asked()
    voices.wants(A)
    voices.next([A])
    voices.loaded(A, "no json", 0.0)
    assert voices.want(A, RETRY_AFTER) is Readiness.FAILED
    assert voices.next([A]) == (A, ())
    assert voices.want(A, 1000.0) is Readiness.FAILED
    assert not voices.lacking
    voices.loaded(A, None, 1000.0)
    assert voices.to_json() == {A: {"state": "loaded", "why": None}}


def test_an_engine_that_is_lost_has_nothing_loaded_and_what_it_loaded_is_suspected() -> None:
    voices = Asked()
    voices.loads(A)
    for death in range(1, DEATHS + 1):
        voices.wants(B)
        assert voices.next([B]) == (B, ())
        voices.engine_lost(0.0)
        assert voices.states() == {B: "waiting" if death < DEATHS else "failed"}
    assert voices.to_json()[B] == {"state": "failed", "why": "the engine process ended while it was being loaded"}
    voices.engine_lost(0.0)
    assert voices.states() == {B: "failed"}, "it was not what was being loaded"


def test_one_death_is_forgotten_once_it_is_loaded() -> None:
    voices = Asked()
    for _ in range(3):
        voices.wants(A)
        voices.next([A])
        voices.engine_lost(0.0)
        voices.loads(A)
        voices.engine_lost(0.0)
    assert voices.states() == {}


def test_what_the_engine_loads_of_itself_is_known_and_stops_no_other() -> None:
    voices = Asked()
    voices.wants(A)
    voices.next([A])
    voices.loaded(D, None, 0.0)
    assert voices.states() == {A: "loading", D: "loaded"}
    assert not voices.lacking


def test_nothing_is_dropped_for_the_server_s_own_while_no_goal_needs_it() -> None:
    voices = Asked(1)
    voices.loads(A)
    voices.wants(B)
    assert voices.next([], B) is None
    assert voices.next([B], B) == (B, (A,))
    alone = Asked(0)
    alone.wants(A)
    assert alone.next([], A) == (A, ())


def test_what_was_asked_for_by_a_goal_that_was_refused_keeps_nobody_looking() -> None:
    voices = Asked()
    voices.wants(A)
    assert voices.next([], B) is None
    assert (voices.lacking, voices.states()) == (False, {})
    voices.wants(A)
    voices.next([A])
    voices.loaded(A, "no json", 0.0)
    voices.wants(A, now=RETRY_AFTER)
    assert voices.lacking
    assert voices.next([]) is None
    assert (voices.lacking, voices.states()) == (False, {A: "failed"})
