"""Lines: one JSON object each, UTF-8. No I/O: bytes go in, objects come out, and back.

Rules for this file: it knows lines and their limits, never what a request means. Anything that comes from outside ends
as an object or as a BadRequest, whatever bytes they were.
"""

from __future__ import annotations

import json
import math

from talkcli.errors import BadRequest, LineTooLong
from talkcli.frozen import TYPE_CHECKING
from talkcli.splitter import Cut, LineSplitter

if TYPE_CHECKING:
    from talkcli.goals.goal import JsonObject

#: Bytes of one request line, its newline included: the longest text (40,000 bytes of UTF-8) fits with room for quotes,
#: and so do 10,000 characters that are all escaped as \uXXXX.
MAX_LINE = 64 * 1024

#: A JSON integer of more digits is no count or time of ours, and converting thousands of digits takes quadratic time.
MAX_DIGITS = 20


def encode(message: JsonObject) -> bytes:
    """Return the object as a line. Text goes as UTF-8; only what UTF-8 cannot hold (a lone surrogate) is escaped."""
    try:
        return _ENCODER.encode(message).encode() + b"\n"
    except UnicodeEncodeError:
        return _ASCII_ENCODER.encode(message).encode() + b"\n"


def decode(line: bytes) -> JsonObject:
    """Return the object in a line; BadRequest, whose code says why, where there is none."""
    try:
        value = _DECODER.decode(line.decode())
    except UnicodeDecodeError as error:
        raise BadRequest(f"a line is UTF-8, but byte {error.start} of this one is not", "bad_encoding") from None
    except RecursionError:
        raise BadRequest("this JSON is nested too deep", "bad_json") from None
    except ValueError as error:
        raise BadRequest(f"a line is one JSON object: {error}", "bad_json") from None
    if not isinstance(value, dict):
        raise BadRequest(f"a line is one JSON object, not {type(value).__name__}", "bad_json")
    return value


def _no_duplicates(pairs: list[tuple[str, object]]) -> JsonObject:
    fields = dict(pairs)
    if len(fields) != len(pairs):
        raise ValueError("the same key twice")
    return fields


def _no_constant(name: str) -> object:
    raise ValueError(f"{name} is no JSON")


def _short_integer(digits: str) -> int:
    if len(digits) > MAX_DIGITS:
        raise ValueError(f"an integer of {len(digits)} digits")
    return int(digits)


def _finite(digits: str) -> float:
    number = float(digits)
    if not math.isfinite(number):
        raise ValueError("a number past every float")
    return number


# Made once: `json.dumps` and `json.loads` make a new one for each line that isn't written or read in their own way,
# which takes half as long as an event's line itself.
_ENCODER = json.JSONEncoder(ensure_ascii=False, allow_nan=False)
_ASCII_ENCODER = json.JSONEncoder(allow_nan=False)
_DECODER = json.JSONDecoder(
    object_pairs_hook=_no_duplicates, parse_constant=_no_constant, parse_int=_short_integer, parse_float=_finite
)


class RequestSplitter(LineSplitter):
    """Cuts what comes from a client into lines, none of them past a limit; a server is trusted."""

    __slots__ = ("_limit",)

    def __init__(self, limit: int = MAX_LINE) -> None:
        """`limit`: bytes of a line, its newline included."""
        super().__init__(limit - 1)
        self._limit = limit

    def feed(self, data: bytes) -> list[bytes]:
        """Return the lines that are complete now, without their newlines; LineTooLong, with those before it, past the
        limit.

        After that error the stream cannot be followed any further: the connection has to be closed.
        """
        lines = super().feed(data)
        for place, line in enumerate(lines):
            if isinstance(line, Cut):
                raise LineTooLong(self._limit, lines[:place])
        if self.size >= self._limit:
            raise LineTooLong(self._limit, lines)
        return lines
