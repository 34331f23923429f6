"""A client of the soak test, whose texts grow, and end or break off in all ways."""

from __future__ import annotations

import itertools
import time
from typing import TYPE_CHECKING, Any

from tests.support.watcher import TERMINAL
from tests.tools.soak_clients import PATIENCE_S

if TYPE_CHECKING:
    import random
    import threading
    from collections.abc import Callable

    from tests.support.connection import Message, Wire
    from tests.support.processes import Talk

_STORY = (
    "I found the charger. It is near the door, behind the table, at 3.5 metres. Shall I go there now? Dr. Brown waits "
    "in room 12; he said: “Come in!” One two three four five six seven eight nine ten eleven twelve and so on "
)
_LONGEST = 90
#: Seconds between two pieces of a text.
_INTERVALS_S = (0.0, 0.005, 0.02, 0.1)
#: The usual goals don't preempt those of a higher priority.
_OPTIONS: tuple[dict[str, Any], ...] = (
    *({}, {"preempt": True}, {"ttl": 1}, {"key": "grows"}, {"priority": 5}, {"priority": 5, "voice": "de"}),
    *({"priority": 5, "preempt": True}, {"priority": 5, "preempt": True, "feedback": True}),
)
_numbers = itertools.count()


def send_growing_texts(talk: Talk, rng: random.Random, over: threading.Event) -> None:
    """Send texts in pieces. Each goal must end in time, with the right state."""
    while not over.is_set():
        with talk.connect() as wire:
            while not over.is_set():
                usable = _GrowingText(talk, wire, rng, over).send()
                over.wait(rng.random())
                if not usable or rng.random() < 0.1:
                    break


class _GrowingText:
    """A goal with a growing text."""

    def __init__(self, talk: Talk, wire: Wire, rng: random.Random, over: threading.Event) -> None:
        self._talk, self._wire, self._rng, self._over = talk, wire, rng, over
        self._way = rng.choice(["ended", *_WAYS])
        self._options = rng.choice(_OPTIONS) | {"more": True, "wait": True, "rate": 450, "stall": 1}
        if self._way == "continued" or rng.random() < 0.3:
            self._options["id"] = f"grows/{next(_numbers)}"
        size, start = rng.choice((3, 5, 12)), rng.randrange(len(_STORY) - _LONGEST)
        places = range(start, start + rng.randrange(10, _LONGEST), size)
        self._begin, *self._pieces = [_STORY[at : at + size] for at in places]
        self._id = ""
        #: the text that the server has confirmed, and whether it has confirmed its end
        self._text, self._ended = self._begin, False

    def send(self) -> bool:
        """Send the text, and check its end. Return whether the connection can still be used."""
        goal = self._wire.request("say", text=self._begin, **self._options)["goal"]
        self._id = goal["id"]
        if goal["state"] == "REJECTED":
            self._check(self._result())
            return True
        assert goal["state"] == "PENDING", goal
        usable = all(map(self._append, self._pieces)) and _WAYS[self._way](self)
        self._check(self._result() if usable else self._status())
        if usable:
            reply = self._wire.request("append", id=self._id, text="too late")
            assert reply["error"]["code"] == "goal_ended", reply
        return usable

    def _append(self, text: str = "", **fields: Any) -> bool:
        """Add a piece, and return True."""
        if not self._over.is_set():
            time.sleep(self._rng.choice(_INTERVALS_S))
        reply = self._wire.request("append", id=self._id, text=text, at=len(self._text), **fields)
        if reply["ok"]:
            self._text += text
            self._ended = "end" in fields
            assert reply["length"] == len(self._text), reply
        else:
            assert reply["error"]["code"] == "goal_ended", reply
        return True

    def _result(self) -> Message:
        """Return the goal when its result arrives."""
        goal: Message = {}
        while goal.get("id") != self._id:
            goal = self._wire.receive_event("result", PATIENCE_S)["goal"]
        return goal

    def _status(self) -> Message:
        """Wait on other connections until the goal has ended, and return it."""
        end = time.monotonic() + PATIENCE_S
        while True:
            goal: Message = self._talk.request("status", id=self._id)["goal"]
            if goal["state"] in TERMINAL:
                return goal
            assert time.monotonic() < end, f"{goal}, {self._way}, has not ended: {self._talk.request('status')}"
            time.sleep(0.05)

    def _check(self, goal: Message) -> None:
        details = f"{self._way}, {len(self._text)} characters, {self._ended}: {goal}"
        assert goal["state"] in TERMINAL, details
        assert goal["reason"] != "nothing_to_say", details
        assert goal["reason"] != "broken_off" or self._way in _BREAKS, details
        assert (goal["text"], goal["more"], goal["waits"]) == (self._text, False, False), details
        assert (goal["spoken_end"] or 0) <= len(self._text), details
        assert goal["state"] != "SUCCEEDED" or (self._ended and goal["spoken_end"] == len(self._text)), details

    # -- ways to end a text; each returns whether the connection can still be used

    def _cancel(self) -> bool:
        assert self._wire.request("cancel", ids=[self._id])["ok"]
        return True

    def _preempt(self) -> bool:
        assert self._wire.request("say", text="out of the way", rate=450, preempt=True)["ok"]
        return self._append(end=True)

    def _close(self) -> bool:
        self._wire.close()
        return False

    def _continue(self) -> bool:
        """Close the connection, and continue on another one, with the same first piece."""
        self._wire.close()
        with self._talk.connect() as self._wire:
            reply = self._wire.request("say", text=self._begin, **self._options)
            assert reply.get("attached"), reply
            self._append("and the end.")
            self._append(end=True)
            self._check(self._result())
        return False


_WAYS: dict[str, Callable[[_GrowingText], bool]] = {
    "ended": lambda text: text._append(end=True),
    "stalled": lambda _: True,
    "broken off": lambda text: text._append(broken=True),
    "cancelled": _GrowingText._cancel,
    "preempted": _GrowingText._preempt,
    "closed": _GrowingText._close,
    "continued": _GrowingText._continue,
}
#: What may break a text off.
_BREAKS = frozenset({"broken off", "closed", "continued"})
