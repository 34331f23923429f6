"""Who is told what: those who wait for a goal, those who watch all, and that the server is alive while they do.

What there is to tell is told in its order, and as fast as they read where it is much: a cancel may end thousands of
goals. It knows connections and goals, of the engine what a word is, and of requests that one may wait for the news.
"""

from __future__ import annotations

from collections import deque
from itertools import chain, count
from typing import TYPE_CHECKING

from talkcli.daemon import log
from talkcli.frozen import replace
from talkcli.goals.states import State
from talkcli.protocol.events import PausedChanged, Result, StateChanged, WordHeard
from talkcli.protocol.lines import encode

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable, Iterable

    from talkcli.engine.protocol import Word
    from talkcli.goals.goal import By, JsonObject
    from talkcli.goals.record import Record
    from talkcli.server.call import Call
    from talkcli.server.connection import Connection
    from talkcli.server.stream import Streams

#: Seconds between signs of life to those who wait; a client gives a server up after three of them.
ALIVE_EVERY = 5.0

#: News that are told before others have their turn: three milliseconds.
_PORTION = 64
#: Bytes of them that may wait for the clients before they are given time to read: a client is let go for four times as
#: much.
_PORTION_OUTPUT = 1024 * 1024
#: Seconds that they are given, unless they have read it before, and seconds between two looks whether they have.
_PATIENCE = 0.05
_LOOK_AGAIN = 0.002
#: What is left of that each time that it was in vain, until all is told: 0.8 s in all, so that a cancel of which many
#: are told who don't read is answered within 2 s, too.
_LESS = 0.94


class Subscribers:
    """The connections that have asked to be told."""

    def __init__(self, loop: asyncio.AbstractEventLoop, others: Callable[[], Iterable[Connection]]) -> None:
        """`others`: who else is told that the server is alive, because a request waits."""
        self._loop = loop
        self._others = others
        #: counts the events: a watcher sees by a gap that feedback was dropped
        self._numbers = count(1)
        #: by goal, until its end: those who wait for that, and whether they want its feedback
        self._waiters: dict[str, dict[Connection, bool]] = {}
        self._watchers: dict[Connection, None] = {}
        self._alive: asyncio.TimerHandle | None = None

    def await_result(self, goal_id: str, connection: Connection, *, feedback: bool = False) -> None:
        """Tell this connection of the goal's states, of each word where it wants `feedback`, and at last its result."""
        waiting = self._waiters.setdefault(goal_id, {})
        waiting[connection] = waiting.get(connection, False) or feedback
        self.keep_alive()

    def has(self, connection: Connection) -> bool:
        """Whether this connection is to be told of a goal, or of everything."""
        return connection in self._watchers or any(connection in each for each in self._waiters.values())

    def watch(self, connection: Connection) -> None:
        """Tell this connection of everything."""
        self._watchers[connection] = None
        self.keep_alive()

    def left(self, connection: Connection) -> None:
        """Forget a connection that is gone."""
        self._watchers.pop(connection, None)
        for waiting in self._waiters.values():
            waiting.pop(connection, None)

    def changed(self, record: Record, state: State, at: float) -> None:
        """Publish a goal's new state; with its last one, its result."""
        event = StateChanged(record.id, state, at, next(self._numbers))
        if self._watchers:
            # Its first state, and its last, tell watchers all of it.
            whole = record.snapshot(state) if state is State.PENDING or state.terminal else None
            _publish(replace(event, goal=whole).to_json(), self._watchers)
        if not state.terminal:
            _publish(event.to_json(), self._waiters.get(record.id, ()))
        elif record.id in self._waiters:
            # In one piece: a thousand may wait for it.
            piece = encode(event.to_json()) + encode(Result(record.snapshot()).to_json())
            for connection in self._waiters.pop(record.id):
                connection.publish(piece)

    def heard(self, word: Word, text: str, at: float) -> None:
        """Publish that a word of a goal is being heard; `text`: as it stands there."""
        event = WordHeard(word.id, text, word.start, word.end, word.number, word.time, at, next(self._numbers))
        _publish(event.to_json(), self._listening([self._waiters.get(word.id, {})]), feedback=True)

    def paused(self, held: str | None, *, paused: bool, by: By, at: float) -> None:
        """Publish that speech is held, or goes on: `held` is the goal that was being spoken."""
        event = PausedChanged(paused, held, by, at, next(self._numbers))
        _publish(event.to_json(), self._listening(self._waiters.values()))

    def keep_alive(self) -> None:
        """Tell those who wait for anything, from now on, that the server is alive."""
        if self._alive is None:
            self._alive = self._loop.call_later(ALIVE_EVERY, self._say_alive)

    def _listening(self, waiting: Iterable[dict[Connection, bool]]) -> dict[Connection, None]:
        """Return who hears of these goals' feedback: those of who waits for them that want it, and who watches all."""
        listening = dict(self._watchers)
        for each in waiting:
            listening.update((connection, None) for connection, feedback in each.items() if feedback)
        return listening

    def _say_alive(self) -> None:
        self._alive = None
        listening = dict.fromkeys(chain(self._watchers, self._others(), *self._waiters.values()))
        _publish({"event": "alive"}, listening)
        if listening:
            self.keep_alive()


def _publish(event: JsonObject, connections: Iterable[Connection], *, feedback: bool = False) -> None:
    told = list(connections)
    line = encode(event) if told else b""  # most words are heard by nobody
    for connection in told:
        connection.publish(line, feedback=feedback)


class News:
    """What is still to be told to the clients of a server: one line for all of them.

    What there is to tell is told at once; past a portion the others have their turn, and those who are told have time
    to read. It looks at nothing of what is told.
    """

    def __init__(self, streams: Streams) -> None:
        self._loop = streams.loop
        self._streams = streams
        self._line: deque[Callable[[], None]] = deque()
        self._telling = False
        self._turn: asyncio.Handle | None = None
        self._patience = _PATIENCE

    @property
    def told(self) -> bool:
        """Whether nothing is left to be told."""
        return not self._line

    def tell(self, news: Iterable[Callable[[], None]]) -> None:
        """Do these, each of which tells something, behind all that there is to tell already.

        What comes of one that is being told belongs to it: it is told with it.
        """
        if self._telling:
            for each in news:
                self._do(each)
            return
        self._line.extend(news)
        if self._turn is None:
            self._tell_some(self._streams.waiting)

    async def until_told(self, call: Call) -> None:
        """Wait until all is told that there is to tell by now."""
        if self._line:
            self._line.append(call.resume)
            await call.wait({})

    def _tell_some(self, before: int) -> None:
        """Tell a portion; `before`: bytes that waited for clients before what this one has to be read with."""
        self._turn = None
        self._telling = True
        for _ in range(min(_PORTION, len(self._line))):
            self._do(self._line.popleft())
            if self._streams.waiting > before + _PORTION_OUTPUT:
                break
        self._telling = False
        if not self._line:
            self._patience = _PATIENCE
        elif self._streams.waiting > before + _PORTION_OUTPUT:
            until = self._loop.time() + self._patience
            self._turn = self._loop.call_later(_LOOK_AGAIN, self._await_readers, before, until)
        else:
            self._turn = self._loop.call_soon(self._tell_some, min(before, self._streams.waiting))

    def _await_readers(self, before: int, until: float) -> None:
        """Go on when what was written has been read, or by then: who doesn't read must not keep others waiting."""
        if self._streams.waiting <= before:
            self._tell_some(before)
        elif self._loop.time() < until:
            self._turn = self._loop.call_later(_LOOK_AGAIN, self._await_readers, before, until)
        else:
            self._patience *= _LESS
            self._tell_some(self._streams.waiting)

    def _do(self, telling: Callable[[], None]) -> None:
        try:
            telling()
        except Exception as error:  # noqa: BLE001 - those behind it must not wait for ever because of it
            log.write_bug("telling clients", error)
