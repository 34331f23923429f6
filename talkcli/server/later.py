"""Requests that can't be carried out yet: they wait until the voices are known, or for room in the queue.

It decides nothing about them: it keeps them in their order, counts them as owed to their clients, and lets them go.
"""

from __future__ import annotations

import sys
from collections import Counter, deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

from talkcli.frozen import fields
from talkcli.goals.options import Say
from talkcli.goals.selection import select_waiting

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable

    from talkcli.goals.effects import Submitted
    from talkcli.goals.goal import By
    from talkcli.goals.options import Cancel
    from talkcli.goals.record import Record
    from talkcli.protocol.requests import Request
    from talkcli.server.connection import Connection
    from talkcli.server.stream import Streams
    from talkcli.server.subscribers import Subscribers

#: Seconds for which the voices are awaited; a client gives up after five.
VOICES_LIMIT = 4.0
#: Requests that wait for one client; the wire names it. Each is kept with its text, and a client is read from all the
#: while, because a cancel may come behind them.
MAX_WAITING = 1_000
#: Bytes of all the requests that wait, as of the output that waits.
ALL_WAITING = 64 * 1024 * 1024
#: Bytes that each is counted with besides what it carries. It takes a tenth of that; but so no more than 8,000 wait,
#: and a cancel of so many is answered within 2 s, too.
EACH = 8 * 1024
#: Goals that are ended before others have their turn: three milliseconds.
_PORTION = 64
#: Bytes of what is told of them that may wait for the clients before they are given time to read it: a client is let
#: go for four times as much.
_PORTION_OUTPUT = 1024 * 1024
#: Seconds that they are given, unless they have read it before, and seconds between two looks whether they have.
_PATIENCE = 0.05
_LOOK_AGAIN = 0.002


@dataclass(slots=True, eq=False)
class Waiting:
    """A request that waits."""

    connection: Connection
    request: Request
    #: carries it out; with a `By`, a goal is submitted as one that was cancelled meanwhile
    go: Callable[[By | None], Submitted | None]
    size: int
    #: the loop's time at which it goes anyway, where it waits for the voices
    until: float | None = None
    #: who cancelled it, and what became of it by that
    by: By | None = None
    ended: Record | None = None


class Later:
    """The requests that wait. Whatever waits keeps its connection open, and is forgotten with it."""

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        streams: Streams,
        subscribers: Subscribers,
        has_room: Callable[[Say], bool],
        failed: Callable[[str, Exception], None],
    ) -> None:
        """`has_room`: whether a goal need wait no longer; `failed` is told of what could not be carried out for a
        reason of the server's own.
        """
        self._loop = loop
        self._streams = streams
        self._failed = failed
        self._has_room = has_room
        self._subscribers = subscribers
        self._for_voices: deque[Waiting] = deque()
        self._for_room: deque[Waiting] = deque()
        #: goals that don't wait any more and are to be told so, and whom to call when those before have been
        self._ending: deque[Waiting | Callable[[], None]] = deque()
        self._ends = False
        #: how many wait, by connection: of all, and of those for the voices
        self._count: Counter[Connection] = Counter()
        self._await_voices: Counter[Connection] = Counter()
        self._size = 0
        self._turn: asyncio.Handle | None = None

    @property
    def awaits_voices(self) -> bool:
        """Whether something waits for the voices: a goal that comes after it must not overtake it."""
        return bool(self._for_voices)

    @property
    def ends_goals(self) -> bool:
        """Whether goals that don't wait any more have still to be told so."""
        return bool(self._ending)

    def holds(self, connection: Connection) -> bool:
        """Whether a request of this connection waits for the voices: what comes after it must not overtake it."""
        return self._await_voices[connection] > 0

    def too_many(self, connection: Connection, request: Request) -> tuple[str, str] | None:
        """Return reason and words why this request can't wait, too; None if it can."""
        if self._count[connection] >= MAX_WAITING:
            return "queue_full", f"{MAX_WAITING:,} requests of this connection are waiting already"
        if self._size + _size_of(request) > ALL_WAITING:
            return "queue_full", f"{ALL_WAITING >> 20} MiB of requests are waiting already"
        return None

    def until_voices(
        self, connection: Connection, request: Request, go: Callable[[By | None], Submitted | None]
    ) -> None:
        """Carry it out as soon as the voices are known, at the latest after VOICES_LIMIT seconds."""
        until = self._loop.time() + VOICES_LIMIT
        self._await_voices[connection] += 1
        self._for_voices.append(self._owe(connection, request, go, until))
        self._loop.call_at(until, self._give_up_voices)

    def until_room(self, connection: Connection, say: Say, go: Callable[[By | None], Submitted | None]) -> None:
        """Submit a goal as soon as it has room; the client is told meanwhile that the server is alive."""
        self._for_room.append(self._owe(connection, say, go, None))
        self._subscribers.keep_waiting(connection)

    def voices_known(self) -> None:
        """Carry out what waits for the voices, known or not."""
        due, self._for_voices = self._for_voices, deque()
        for each in due:
            self._go(each)

    def hurry(self, connection: Connection) -> None:
        """Carry out what of this connection waits for the voices; the others' know nothing of what hurries."""
        if not self.holds(connection):
            return
        due = [each for each in self._for_voices if each.connection is connection]
        self._for_voices = deque(each for each in self._for_voices if each.connection is not connection)
        for each in due:
            self._go(each)

    def look(self) -> None:
        """Let go, soon, what may go now that a goal has come to the queue, or left it."""
        if self._for_room and self._turn is None:
            # Soon, not at once: whoever changed something may be in the middle of other changes.
            self._turn = self._loop.call_soon(self._let_go)

    def look_now(self) -> None:
        """Let go at once what would go soon: a goal that comes now must not take the room of one that waits."""
        if self._turn:
            self._turn.cancel()
            self._let_go()

    def choose(self, selection: Cancel, by: By | None) -> list[Waiting]:
        """Have the goals that are selected wait no more, and return them; `end` tells them so."""
        ending = [each for each in self._ending if isinstance(each, Waiting)]
        goals, says = [], []
        for each in (*ending, *self._for_room, *self._for_voices):
            if isinstance(each.request, Say):
                goals.append(each)
                says.append(each.request)
        chosen = [goals[place] for place in select_waiting(selection, says)]
        # Who has hung up has taken its request back, and is about to be forgotten.
        chosen = [each for each in chosen if not each.connection.has_hung_up()]
        gone = set(chosen).difference(ending)
        if gone:
            self._take_out(gone)
        for each in chosen:
            if each in gone:
                each.by = by
                if each.until is not None:  # what comes after it need not wait for the voices, too
                    each.until = None
                    self._await_voices[each.connection] -= 1
                    self._subscribers.keep_waiting(each.connection)
                self._ending.append(each)
        return chosen

    def end(self, then: Callable[[], None]) -> None:
        """Submit the goals that were chosen as cancelled, and do `then`: at once where they are few, else as fast as
        their clients, and who watches, read what is told of them.
        """
        if not self._ending:
            then()
            return
        self._ending.append(then)
        if not self._ends:
            self._ends = True
            self._end_some(self._streams.waiting)

    def left(self, connection: Connection) -> None:
        """Forget what waits for a client that is gone."""
        self._await_voices.pop(connection, None)
        if not self._count.pop(connection, 0):
            return
        waiting = (each for each in (*self._for_voices, *self._for_room, *self._ending) if isinstance(each, Waiting))
        gone = {each for each in waiting if each.connection is connection}
        self._size -= sum(each.size for each in gone)
        self._take_out(gone)
        self._ending = deque(each for each in self._ending if each not in gone)

    # -- inside

    def _take_out(self, gone: set[Waiting]) -> None:
        self._for_room = deque(each for each in self._for_room if each not in gone)
        self._for_voices = deque(each for each in self._for_voices if each not in gone)

    def _owe(
        self,
        connection: Connection,
        request: Request,
        go: Callable[[By | None], Submitted | None],
        until: float | None,
    ) -> Waiting:
        waiting = Waiting(connection, request, go, _size_of(request), until)
        connection.owed += 1
        self._count[connection] += 1
        self._size += waiting.size
        return waiting

    def _give_up_voices(self) -> None:
        while self._for_voices and (self._for_voices[0].until or 0) <= self._loop.time():
            self._go(self._for_voices.popleft())

    def _let_go(self) -> None:
        self._turn = None
        waiting, self._for_room = self._for_room, deque()
        stay = []
        full: set[object] = set()
        for each in waiting:
            say = each.request
            assert isinstance(say, Say)
            # All that room depends on, but for an id: where a thousand lack it, one is asked for.
            kind = (say.priority, say.key, say.flush, say.preempt) if say.id is None else None
            if kind in full or not self._has_room(say):
                stay.append(each)
                if kind:
                    full.add(kind)
            elif each.connection.has_hung_up():
                stay.append(each)
            else:
                self._go(each)
                full.clear()
        self._for_room.extendleft(reversed(stay))
        if len(stay) < len(waiting):
            self.look()  # those that went may have made room for others

    def _end_some(self, before: int) -> None:
        """Tell goals that they wait no more; `before`: bytes that waited for clients before what these have to read."""
        for _ in range(_PORTION):
            if not self._ending:
                self._ends = False
                return
            if self._streams.waiting > before + _PORTION_OUTPUT:
                self._await_readers(before, self._loop.time() + _PATIENCE)
                return
            first = self._ending.popleft()
            if isinstance(first, Waiting):
                self._go(first)
            else:
                self._do(first)
        self._loop.call_soon(self._end_some, min(before, self._streams.waiting))

    def _await_readers(self, before: int, until: float) -> None:
        """Go on when what was written has been read, or by then; who doesn't read must not keep others waiting."""
        if self._streams.waiting > before and self._loop.time() < until:
            self._loop.call_later(_LOOK_AGAIN, self._await_readers, before, until)
        else:
            self._end_some(self._streams.waiting)

    def _do(self, then: Callable[[], None]) -> None:
        try:
            then()
        except Exception as error:  # noqa: BLE001 - those behind it must not wait for ever because of it
            self._failed("an answer that had to wait", error)

    def _go(self, waiting: Waiting) -> None:
        connection = waiting.connection
        self._count[connection] -= 1
        self._size -= waiting.size
        if waiting.until is None:
            self._subscribers.answered(connection)
        else:
            self._await_voices[connection] -= 1
        try:
            done = waiting.go(waiting.by)
            if done and not done.attached and done.record.by is waiting.by:
                waiting.ended = done.record
        except Exception as error:  # noqa: BLE001 - as above
            self._failed("a request that had to wait", error)
            connection.drop()
        finally:
            connection.settle()


def _size_of(request: Request) -> int:
    return EACH + sum(map(_bytes_of, fields(request).values()))


def _bytes_of(value: object) -> int:
    """Return the bytes that a value from a request takes in memory: small lists take many times their JSON."""
    inside = value.values() if isinstance(value, dict) else value if isinstance(value, (list, tuple)) else ()
    return sys.getsizeof(value) + sum(map(_bytes_of, inside))
