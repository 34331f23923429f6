"""Rows about growing texts: first sound, additions and silence."""

from __future__ import annotations

import contextlib
import time
from functools import partial
from typing import TYPE_CHECKING

from tests.support.connection import Wire
from tests.tools.bench.harness import VOICED
from tests.tools.bench.table import Limit, Row

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.tools.bench.harness import Harness

#: A sentence, its last token, and the token after it.
_SENTENCE, _STOP, _NEXT = ("I", " found", " the", " charger"), ".", " It"
#: Seconds between two tokens, and seconds in which nothing follows.
_INTERVAL_S, _NOTHING_S = 0.03, 0.5
_MORE_ROUNDS = 2
_PATIENCE_S = 120.0


def growing(harness: Harness) -> list[Row]:
    """Measure growing texts beside a text that is sent as a whole."""
    with contextlib.closing(_Sender(harness.talk.socket)) as sender:
        sounds = {each: partial(_sentence_begins, harness, sender, each) for each in (_NEXT, "")}
        silences = {each: partial(_silence, harness, sender, more=each == "growing") for each in ("growing", "whole")}
        times = harness.in_turn(sounds)
        additions = [1000 * each for each in sender.seconds]
        times |= harness.in_turn(silences, harness.options.rounds * _MORE_ROUNDS)
    end = "last token of a growing text's first sentence"
    limits = {bound: [Limit("median", bound)] for bound in (2, 45, 115)}
    return [
        Row(f"{end} → first sample, if the next one follows after 30 ms", "ms", times[_NEXT], limits=limits[45]),
        Row(f"{end} → first sample, if nothing follows", "ms", times[""], limits=limits[115]),
        Row("`append` of a token → reply", "ms", additions, limits=limits[2]),
        Row("cancel of a growing text → silence", "ms", times["growing"], "whole text", times["whole"], limits[2]),
    ]


class _Sender(Wire):
    """A connection that sends growing texts, and times the replies to additions."""

    def __init__(self, path: str) -> None:
        super().__init__(path)
        self.seconds: list[float] = []

    def say(self, text: str, *, more: bool = True) -> str:
        return str(self.request("say", text=text, more=more, wait=True)["goal"]["id"])

    def append(self, goal: str, text: str = "", **fields: bool) -> None:
        started_at = time.monotonic()
        reply = self.request("append", timeout=_PATIENCE_S, id=goal, text=text, **fields)
        self.seconds.append(time.monotonic() - started_at)
        assert reply["ok"], reply

    def finish(self, goal: str, wanted: str = "SUCCEEDED") -> None:
        """Wait until a goal has ended."""
        while (result := self.receive_event("result", _PATIENCE_S)["goal"])["id"] != goal:
            pass
        assert result["state"] == wanted, result


def _sentence_begins(harness: Harness, sender: _Sender, following: str) -> float:
    """Return the seconds from the last token of the first sentence to the first sound."""
    goal = sender.say(_SENTENCE[0])
    for token in _SENTENCE[1:]:
        time.sleep(_INTERVAL_S)
        sender.append(goal, token)

    def add() -> Callable[[], object]:
        sender.append(goal, _STOP)
        time.sleep(_INTERVAL_S if following else _NOTHING_S)
        sender.append(goal, following)
        sender.append(goal, end=True)
        return partial(sender.finish, goal)

    return harness.until_sound(add)


def _silence(harness: Harness, sender: _Sender, *, more: bool) -> float:
    """Return the seconds from a cancel to silence."""

    def say() -> Callable[[], object]:
        return partial(sender.finish, sender.say(f"{VOICED}. And ", more=more), "PREEMPTED")

    def stop() -> Callable[[], object]:
        assert sender.request("cancel")["ok"]
        return int

    return harness.until_silence(say, stop)
