"""Standard input, where `say` is told to read it: as one text, or line by line. It never holds more than one text."""

from __future__ import annotations

import os
import select
import time
from typing import TYPE_CHECKING

from talkcli.client.connect import ready
from talkcli.errors import EXIT_TIMEOUT, TalkError, UsageError
from talkcli.frozen import frozen
from talkcli.goals.options import MAX_BYTES, MAX_CHARACTERS
from talkcli.goals.states import EXIT_CODES, State
from talkcli.splitter import Cut, LineSplitter

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

#: Bytes that are read at once: what a pipe holds.
_CHUNK = 65_536
#: Bytes that are read of one text: the longest one, and the end of its line.
_MOST = MAX_BYTES + len("\r\n")


class InputLate(TalkError):
    """What should be spoken was not there in time."""

    code = "timeout"
    exit_code = EXIT_TIMEOUT


class InputTooLong(TalkError):
    """There is more on standard input than one text may have."""

    code = "text_too_long"
    exit_code = EXIT_CODES[State.REJECTED]


@frozen
class Line:
    """A line of standard input, without its end."""

    #: 1 for the first
    number: int
    #: None where it is longer than any text may be
    text: str | None
    #: bytes that it has
    size: int


def read_text(end: float | None, interrupt: Mapping[int, int], *, whole: bool = False) -> str:
    """Return standard input as one text; InputTooLong for more than the longest one, which is not read to its end.

    `end`: the monotonic time by which it must have been read, else InputLate; `interrupt`: what ends the reading with
    Interrupted, as in `connect.ready`; `whole`: read all of it, for no goal.
    """
    data = bytearray()
    while whole or len(data) <= _MOST:
        if not ready({0: select.POLLIN}, None if end is None else max(0.0, end - time.monotonic()), interrupt):
            raise InputLate("standard input has not ended within the time: nothing was sent")
        more = _read(_CHUNK if whole else _MOST + 1 - len(data))
        if more == b"":
            return _decoded(bytes(data))
        data += more or b""
    raise InputTooLong(
        f"standard input has more than {MAX_BYTES:,} bytes, and a text at most {MAX_CHARACTERS:,} characters: "
        "'talk say --lines' speaks it line by line"
    )


class LineReader:
    """Cuts standard input into lines. A line that is too long is read to its end, counted and not kept."""

    def __init__(self, interrupt: Mapping[int, int]) -> None:
        """`interrupt`: what ends the reading with Interrupted, as in `connect.ready`."""
        self._interrupt = interrupt
        # One byte above the longest text: the CR of a line that ends in CRLF.
        self._splitter = LineSplitter(MAX_BYTES + 1)
        self._number = 0

    def lines(self) -> Iterator[Line]:
        """Iterate over the lines, each as soon as its newline has come; the last one may lack it."""
        while True:
            ready({0: select.POLLIN}, None, self._interrupt)
            data = _read(_CHUNK)
            if data is None:
                continue
            if not data:
                break
            for each in self._splitter.feed(data):
                yield self._line(each)
        if self._splitter.size:
            yield self._line(self._splitter.end())

    def _line(self, line: bytes) -> Line:
        self._number += 1
        if isinstance(line, Cut):
            return Line(self._number, None, line.size)
        return Line(self._number, _decoded(line), len(line))


def _read(count: int) -> bytes | None:
    """Return what there is of standard input, at most so many bytes; b"" at its end, None if there was nothing yet."""
    try:
        return os.read(0, count)
    except BlockingIOError:  # whoever started this has made it so
        return None
    except OSError as error:
        raise UsageError(f"standard input cannot be read: {error.strerror}") from error


def _decoded(data: bytes) -> str:
    # What is not UTF-8 stays recognisable, as in arguments: see `utf8`.
    return data.decode(errors="surrogateescape").rstrip("\r\n")
