"""What clients are told, in its order, and as fast as they read where it is much: a cancel may end thousands of goals.

It is one line for all clients. What there is to tell is told at once; past a portion the others have their turn, and
those who are told have time to read. It looks at nothing of what is told.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from talkcli.server import log

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable, Iterable

    from talkcli.server.call import Call
    from talkcli.server.stream import Streams

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


class News:
    """What is still to be told to the clients of a server."""

    def __init__(self, loop: asyncio.AbstractEventLoop, streams: Streams) -> None:
        self._loop = loop
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
            log.bug("telling clients", error)
