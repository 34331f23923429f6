"""Requests that can't be carried out yet: they wait until the voices are known, or for room in the queue.

It decides nothing about them: it keeps them in their order, counts them as owed to their clients, and lets them go.
"""

from __future__ import annotations

from collections import deque
from math import inf
from typing import TYPE_CHECKING

from talkcli.values import frozen

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable

    from talkcli.server.audience import Audience
    from talkcli.server.connection import Connection

#: Seconds for which the voices are awaited; a client gives up after five.
VOICES_LIMIT = 4.0
#: Requests that wait for one client; one more is carried out as things are.
MAX_WAITING = 64


@frozen
class _Waiting:
    connection: Connection
    carry_out: Callable[[], None]
    may_go: Callable[[], bool]
    #: the loop's time at which it goes anyway
    until: float


class Later:
    """The requests that wait. Whatever waits keeps its connection open, and is forgotten with it."""

    def __init__(
        self, loop: asyncio.AbstractEventLoop, audience: Audience, failed: Callable[[str, Exception], None]
    ) -> None:
        """`failed` is told of what could not be carried out for a reason of the server's own."""
        self._loop = loop
        self._failed = failed
        self._audience = audience
        self._for_voices: deque[_Waiting] = deque()
        self._for_room: deque[_Waiting] = deque()
        self._turn: asyncio.Handle | None = None

    @property
    def awaits_voices(self) -> bool:
        """Whether something waits for the voices: what comes after it must not overtake it."""
        return bool(self._for_voices)

    def until_voices(self, connection: Connection, carry_out: Callable[[], None]) -> None:
        """Carry it out as soon as the voices are known, at the latest after VOICES_LIMIT seconds."""
        until = self._loop.time() + VOICES_LIMIT
        if self._add(self._for_voices, _Waiting(connection, carry_out, lambda: True, until)):
            self._loop.call_at(until, self._give_up_voices)

    def until_room(self, connection: Connection, carry_out: Callable[[], None], may_go: Callable[[], bool]) -> None:
        """Carry it out as soon as it may go; the client is told meanwhile that the server is alive."""
        if self._add(self._for_room, _Waiting(connection, carry_out, may_go, inf)):
            self._audience.keep_waiting(connection)

    def voices_known(self) -> None:
        """Carry out what waits for the voices, known or not."""
        due, self._for_voices = self._for_voices, deque()
        for each in due:
            self._go(each)

    def look(self) -> None:
        """Let go, soon, what may go now that something has changed."""
        if self._for_room and self._turn is None:
            # Soon, not at once: whoever changed something may be in the middle of other changes.
            self._turn = self._loop.call_soon(self._let_go)

    def left(self, connection: Connection) -> None:
        """Forget what waits for a client that is gone."""
        self._for_voices = deque(each for each in self._for_voices if each.connection is not connection)
        self._for_room = deque(each for each in self._for_room if each.connection is not connection)

    def _give_up_voices(self) -> None:
        while self._for_voices and self._for_voices[0].until <= self._loop.time():
            self._go(self._for_voices.popleft())

    def _add(self, line: deque[_Waiting], waiting: _Waiting) -> bool:
        if sum(each.connection is waiting.connection for each in line) >= MAX_WAITING:
            waiting.carry_out()
            return False
        waiting.connection.owed += 1
        line.append(waiting)
        return True

    def _let_go(self) -> None:
        self._turn = None
        waiting, self._for_room = self._for_room, deque()
        stay = []
        for each in waiting:
            # Who has hung up has taken its request back, and is about to be forgotten.
            if not each.connection.has_hung_up() and each.may_go():
                self._audience.answered(each.connection)
                self._go(each)
            else:
                stay.append(each)
        self._for_room.extendleft(reversed(stay))
        if len(stay) < len(waiting):
            self.look()  # those that went may have made room for others

    def _go(self, waiting: _Waiting) -> None:
        try:
            waiting.carry_out()
        except Exception as error:  # noqa: BLE001 - those behind it must not wait for ever because of it
            self._failed("a request that had to wait", error)
            waiting.connection.drop()
        finally:
            waiting.connection.settle()
