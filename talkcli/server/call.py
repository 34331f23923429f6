"""A request in hand: a coroutine that is carried out on the spot, as far as it goes without waiting for anything.

Where it waits is a place. Whoever brings about what is waited for there resumes it, at once: it is not for a later turn
of the loop, so nothing comes in between, and those in a place go on in their order. A call decides nothing, and knows
no goals.
"""

from __future__ import annotations

import asyncio
import contextlib
from itertools import chain
from types import coroutine
from typing import TYPE_CHECKING

from talkcli.protocol.events import failure, item, ok

if TYPE_CHECKING:
    from collections.abc import Coroutine, Generator, Iterable

    from talkcli.goals.goal import By, JsonObject
    from talkcli.goals.reasons import Refusal
    from talkcli.goals.record import Record
    from talkcli.protocol.requests import Request
    from talkcli.server.connection import Connection

    #: Those who wait for the same, in their order.
    Place = dict["Call", None]
    #: What is sent as fast as the client reads, if there is any.
    _Lines = Iterable[JsonObject]


class Call:
    """One request of one client, until it is answered."""

    __slots__ = ("_steps", "by", "connection", "ended", "fault", "place", "request", "seq", "size")

    def __init__(self, connection: Connection, seq: int | None, request: Request) -> None:
        self.connection = connection
        self.seq = seq
        self.request = request
        #: where it waits
        self.place: Place | None = None
        #: bytes that it is counted with
        self.size = 0
        #: of a goal: reason and words why it can't wait, where it would have to
        self.fault: Refusal | None = None
        #: of a goal: who cancelled it while it waited, and what became of it by that
        self.by: By | None = None
        self.ended: Record | None = None
        self._steps: Coroutine[Place, bool | None, None]

    # -- how it goes on

    def begin(self, steps: Coroutine[Place, bool | None, None]) -> None:
        """Carry it out, up to the first `wait` or the end; `steps` answers it, and lets no error out."""
        self._steps = steps
        self._step(None)

    async def wait(self, place: Place, limit: float | None = None) -> bool:
        """Wait in a place until somebody resumes it, or for so many seconds: then it is False."""
        timer = None if limit is None else asyncio.get_running_loop().call_later(limit, self.resume, False)
        try:
            return await _wait_in(place)
        finally:
            if timer:
                timer.cancel()

    def resume(self, in_time: bool = True) -> None:
        """Have it go on; nothing happens where it waits no more."""
        if self._leave():
            self._step(in_time)

    def move(self, place: Place) -> None:
        """Have it wait there, and nowhere else."""
        self._leave()
        self.place = place
        place[self] = None

    def drop(self) -> None:
        """Forget it: its client is gone."""
        self._leave()
        self._steps.close()

    def _step(self, value: bool | None) -> None:
        with contextlib.suppress(StopIteration):  # it has been answered
            self.move(self._steps.send(value))

    def _leave(self) -> bool:
        """Leave the place where it waits, if it waits."""
        if self.place is None:
            return False
        del self.place[self]
        self.place = None
        return True

    # -- how it is answered

    def answer(self, items: _Lines = (), events: _Lines = (), /, **fields: object) -> None:
        """Reply that it is carried out, and with what; after the lines of a list, and before events that follow it."""
        self._reply(ok(self.seq, **fields), items, events)

    def refuse(self, code: str, words: str, items: _Lines = ()) -> None:
        """Reply that it can't be had, after the lines of a list."""
        self._reply(failure(self.seq, code, words), items)

    def _reply(self, reply: JsonObject, items: _Lines, events: _Lines = ()) -> None:
        if items or events:
            lines = (item(self.seq, **each) for each in items)
            self.connection.send_list(chain(lines, [reply], events))
        else:
            self.connection.send(reply)


def go_on(place: Place) -> None:
    """Have all go on that wait here now, in their order."""
    for each in list(place):
        each.resume()


@coroutine
def _wait_in(place: Place) -> Generator[Place, bool, bool]:
    return (yield place)
