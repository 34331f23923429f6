"""Rows of texts that grow while they are spoken: first sound, additions, silence and memory."""

from __future__ import annotations

import time
from functools import partial
from typing import TYPE_CHECKING

from tests.support import usage
from tests.support.connection import Wire
from tests.support.surroundings import short_directory
from tests.tools.bench.stage import VOICED, serving
from tests.tools.bench.table import Limit, Row

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.tools.bench.stage import Stage

#: A sentence, its last token, and the token after it.
_SENTENCE, _STOP, _NEXT = ("I", " found", " the", " charger"), ".", " It"
#: Seconds between two tokens, and seconds in which nothing follows.
_INTERVAL_S, _NOTHING_S = 0.03, 0.5
#: As many tokens as the longest text may have, and one of them.
TOKENS, _TOKEN = 10_000, "word "
_MORE_ROUNDS = 2
_PATIENCE_S = 120.0


def growing(stage: Stage) -> list[Row]:
    """Measure what is heard of growing texts, beside a text that is sent as a whole, and how long an addition takes."""
    with Wire(stage.talk.socket) as wire:
        sound: dict[str, Callable[[], float]] = {
            name: partial(_sentence_begins, stage, wire, following)
            for name, following in {"next": _NEXT, "nothing": ""}.items()
        }
        times = stage.in_turn(sound | {"append": partial(_addition, wire)})
        silence = {each: partial(_silence, stage, wire, more=each == "growing") for each in ("growing", "whole")}
        times |= stage.in_turn(silence, stage.options.rounds * _MORE_ROUNDS)
    end = "last token of a growing text's first sentence"
    return [
        Row(f"{end} → first sample, if the next one follows after 30 ms", "ms", times["next"], limits=[_median(45)]),
        Row(f"{end} → first sample, if nothing follows", "ms", times["nothing"], limits=[_median(115)]),
        Row("`append` of a token → reply", "ms", times["append"], limits=[_median(2)]),
        Row("cancel of a growing text → silence", "ms", times["growing"], "whole text", times["whole"], [_median(2)]),
        Row(f"memory of {TOKENS:,} tokens, in the server and its engine", "MB", [_memory()], limits=[_median(4)]),
    ]


def _median(bound: float) -> Limit:
    return Limit("median", bound)


def _begin(wire: Wire, text: str) -> str:
    reply = wire.request("say", text=text, more=True, wait=True)
    return str(reply["goal"]["id"])


def _append(wire: Wire, goal: str, text: str = "", **fields: bool) -> None:
    reply = wire.request("append", timeout=_PATIENCE_S, id=goal, text=text, **fields)
    assert reply["ok"], reply


def _finish(wire: Wire, goal: str, wanted: str = "SUCCEEDED") -> None:
    while (result := wire.receive_event("result", _PATIENCE_S)["goal"])["id"] != goal:
        pass
    assert result["state"] == wanted, result


def _sentence_begins(stage: Stage, wire: Wire, following: str) -> float:
    """Return the seconds from the last token of the first sentence to the first sound."""
    goal = _begin(wire, _SENTENCE[0])
    for token in _SENTENCE[1:]:
        time.sleep(_INTERVAL_S)
        _append(wire, goal, token)

    def add() -> Callable[[], object]:
        _append(wire, goal, _STOP)
        time.sleep(_INTERVAL_S if following else _NOTHING_S)
        _append(wire, goal, following)
        return end

    def end() -> None:
        _append(wire, goal, end=True)
        _finish(wire, goal)

    return stage.until_sound(add)


def _addition(wire: Wire) -> float:
    """Return the seconds in which a token is added to a text that is being spoken."""
    goal = _begin(wire, f"{VOICED}. And ")
    time.sleep(_INTERVAL_S)
    began = time.monotonic()
    _append(wire, goal, _TOKEN)
    seconds = time.monotonic() - began
    assert wire.request("cancel", ids=[goal])["ok"]
    _finish(wire, goal, "PREEMPTED")
    return seconds


def _silence(stage: Stage, wire: Wire, *, more: bool) -> float:
    """Return the seconds from a cancel to silence."""
    goals = []

    def say() -> Callable[[], object]:
        goals.append(str(wire.request("say", text=f"{VOICED}. And ", more=more, wait=True)["goal"]["id"]))
        if more:
            _append(wire, goals[0], _TOKEN)
        return partial(_finish, wire, goals[0], "PREEMPTED")

    def stop() -> Callable[[], object]:
        assert wire.request("cancel", ids=goals)["ok"]
        return int

    return stage.until_silence(say, stop)


def _memory() -> float:
    """Return by how many megabytes a server and its engine grow through the longest text."""
    with (
        short_directory() as place,
        serving("--player", f"file:{place}/x.wav", "--rate", "450") as talk,
        Wire(talk.socket) as wire,
    ):
        _append(wire, goal := _begin(wire, "Word. "), "Word.", end=True)
        _finish(wire, goal)
        before = usage.count(talk.pid).memory
        goal = _begin(wire, _TOKEN)
        for _ in range(TOKENS - 1):
            _append(wire, goal, _TOKEN)
        grown = usage.count(talk.pid).memory - before
        _append(wire, goal, end=True)
        _finish(wire, goal)
        grown = max(grown, usage.count(talk.pid).memory - before)
    return grown / 1024
