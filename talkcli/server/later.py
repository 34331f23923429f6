"""Requests that can't be carried out yet: they wait until the voices are known, or for room in the queue.

It decides nothing about them: it keeps them in their order, counts them as owed to their clients, and lets them go.
"""

from __future__ import annotations

from collections import Counter, deque
from typing import TYPE_CHECKING

from talkcli.selection import select_waiting
from talkcli.values import frozen

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable

    from talkcli.effects import Submitted
    from talkcli.messages import By
    from talkcli.record import Record
    from talkcli.requests import Cancel, Say
    from talkcli.server.audience import Audience
    from talkcli.server.connection import Connection

#: Seconds for which the voices are awaited; a client gives up after five.
VOICES_LIMIT = 4.0
#: Requests that wait for one client; the wire names it. Each is kept with its text, and a client is read from all the
#: while, because a cancel may come behind them.
MAX_WAITING = 1_000


@frozen
class _ForVoices:
    connection: Connection
    carry_out: Callable[[], None]
    #: the loop's time at which it goes anyway
    until: float


@frozen
class _ForRoom:
    connection: Connection
    say: Say
    #: submits the goal; with a `By`, as one that was cancelled meanwhile
    submit: Callable[[By | None], Submitted]


class Later:
    """The requests that wait. Whatever waits keeps its connection open, and is forgotten with it."""

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        audience: Audience,
        has_room: Callable[[Say], bool],
        failed: Callable[[str, Exception], None],
    ) -> None:
        """`has_room`: whether a goal need wait no longer; `failed` is told of what could not be carried out for a
        reason of the server's own.
        """
        self._loop = loop
        self._failed = failed
        self._has_room = has_room
        self._audience = audience
        self._for_voices: deque[_ForVoices] = deque()
        self._for_room: deque[_ForRoom] = deque()
        #: how many wait, by connection
        self._await_voices: Counter[Connection] = Counter()
        self._await_room: Counter[Connection] = Counter()
        self._turn: asyncio.Handle | None = None

    @property
    def awaits_voices(self) -> bool:
        """Whether something waits for the voices: a goal that comes after it must not overtake it."""
        return bool(self._for_voices)

    def holds(self, connection: Connection) -> bool:
        """Whether a request of this connection waits for the voices: what comes after it must not overtake it."""
        return self._await_voices[connection] > 0

    def is_full(self, connection: Connection) -> bool:
        """Whether as many requests of this connection wait as may."""
        return self._await_voices[connection] + self._await_room[connection] >= MAX_WAITING

    def until_voices(self, connection: Connection, carry_out: Callable[[], None]) -> None:
        """Carry it out as soon as the voices are known, at the latest after VOICES_LIMIT seconds."""
        until = self._loop.time() + VOICES_LIMIT
        connection.owed += 1
        self._await_voices[connection] += 1
        self._for_voices.append(_ForVoices(connection, carry_out, until))
        self._loop.call_at(until, self._give_up_voices)

    def until_room(self, connection: Connection, say: Say, submit: Callable[[By | None], Submitted]) -> None:
        """Submit a goal as soon as it has room; the client is told meanwhile that the server is alive."""
        connection.owed += 1
        self._await_room[connection] += 1
        self._for_room.append(_ForRoom(connection, say, submit))
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

    def look_now(self) -> None:
        """Let go at once what would go soon: a goal that comes now must not take the room of one that waits."""
        if self._turn:
            self._turn.cancel()
            self._let_go()

    def cancel(self, selection: Cancel, by: By) -> list[Record]:
        """End the goals that wait for room and are selected, and return those that it ended."""
        # Who has hung up has taken its request back, and is about to be forgotten.
        waiting = [each for each in self._for_room if not each.connection.has_hung_up()]
        chosen = [waiting[index] for index in select_waiting(selection, [each.say for each in waiting])]
        if not chosen:
            return []
        gone = set(map(id, chosen))
        self._for_room = deque(each for each in self._for_room if id(each) not in gone)
        ended = []
        for each in chosen:
            done = self._submit(each, by)
            if done and not done.attached and done.record.by is by:
                ended.append(done.record)
        return ended

    def left(self, connection: Connection) -> None:
        """Forget what waits for a client that is gone."""
        if self._await_voices.pop(connection, 0):
            self._for_voices = deque(each for each in self._for_voices if each.connection is not connection)
        if self._await_room.pop(connection, 0):
            self._for_room = deque(each for each in self._for_room if each.connection is not connection)

    def _give_up_voices(self) -> None:
        while self._for_voices and self._for_voices[0].until <= self._loop.time():
            self._go(self._for_voices.popleft())

    def _let_go(self) -> None:
        self._turn = None
        waiting, self._for_room = self._for_room, deque()
        stay = []
        for each in waiting:
            if self._has_room(each.say) and not each.connection.has_hung_up():
                self._submit(each, None)
            else:
                stay.append(each)
        self._for_room.extendleft(reversed(stay))
        if len(stay) < len(waiting):
            self.look()  # those that went may have made room for others

    def _go(self, waiting: _ForVoices) -> None:
        self._await_voices[waiting.connection] -= 1
        try:
            waiting.carry_out()
        except Exception as error:  # noqa: BLE001 - those behind it must not wait for ever because of it
            self._failed("a request that had to wait", error)
            waiting.connection.drop()
        finally:
            waiting.connection.settle()

    def _submit(self, waiting: _ForRoom, by: By | None) -> Submitted | None:
        self._await_room[waiting.connection] -= 1
        self._audience.answered(waiting.connection)
        try:
            return waiting.submit(by)
        except Exception as error:  # noqa: BLE001 - as above
            self._failed("a goal that had to wait", error)
            waiting.connection.drop()
            return None
        finally:
            waiting.connection.settle()
