"""Lines: one JSON object each, UTF-8. No I/O: bytes go in, objects come out, and back.

Rules for this file: it knows lines and their limits, never what a request means. Anything that comes from outside ends
as an object or as a BadRequest, whatever bytes they were. The engine process and its players cut lines, too, and a
client writes its first request before anything else is there: `json` and the errors are imported by who needs them.
"""

from __future__ import annotations

import sys

from talkcli.frozen import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any

    from talkcli.goals.goal import JsonObject
    from talkcli.protocol.requests import Request

#: Bytes of one request line, its newline included: the longest text (40,000 bytes of UTF-8) fits with room for quotes,
#: and so do 10,000 characters that are all escaped as \uXXXX.
MAX_LINE = 64 * 1024

#: A JSON integer of more digits is no count or time of ours, and converting thousands of digits takes quadratic time.
MAX_DIGITS = 20


class Cut(bytes):
    """The beginning of a line that was longer than what is kept of one."""

    #: bytes that the whole line had
    size: int


class LineSplitter:
    """Takes bytes as they come and gives lines; holds no more than the first `most` bytes of one."""

    __slots__ = ("_begun", "_most", "size")

    def __init__(self, most: int = sys.maxsize) -> None:
        self._most = most
        self._begun = bytearray()
        #: bytes of the line that has begun and not ended, those that are not kept among them
        self.size = 0

    def feed(self, data: bytes) -> list[bytes]:
        """Return the lines that are complete now, without their newlines; those that are too long are `Cut`."""
        *lines, begun = data.split(b"\n")
        for place, line in enumerate(lines):
            if self.size or len(line) > self._most:
                self._add(line)
                lines[place] = self.end()
        self._add(begun)
        return lines

    def end(self) -> bytes:
        """Return the line that has begun and not ended, as if it ended here; empty if there is none."""
        line = bytes(self._begun)
        if self.size > self._most:
            line = Cut(line)
            line.size = self.size
        self._begun.clear()
        self.size = 0
        return line

    def _add(self, data: bytes) -> None:
        self.size += len(data)
        self._begun += data[: self._most - len(self._begun)]


def write_request(request: Request) -> JsonObject:
    """Return a request as the object that goes over the wire; fields at their defaults are left out."""
    message: JsonObject = {"request": request.kind}
    for option in request.options:
        value = getattr(request, option.name)
        if value != option.default or option.name == "text":
            message[option.name] = list(value) if isinstance(value, tuple) else value
    return message


def request_line(message: JsonObject) -> bytes:
    """Return what `encode` does, without `json` where the values are plain."""
    try:
        shown = ", ".join(f'"{name}": {_plain(value)}' for name, value in message.items())
        return f"{{{shown}}}\n".encode()
    except (TypeError, UnicodeEncodeError):
        return encode(message)


def _plain(value: object) -> str:
    if isinstance(value, str):
        if value.isprintable() and '"' not in value and "\\" not in value:
            return f'"{value}"'
        from _json import encode_basestring  # a library of its own, whose loading most texts need not wait for

        return encode_basestring(value)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return int.__repr__(value)
    if isinstance(value, float) and _finite(value):
        return float.__repr__(value)
    if isinstance(value, list):
        return f"[{', '.join(map(_plain, value))}]"
    raise TypeError


def encode(message: JsonObject) -> bytes:
    """Return the object as a line; ValueError or TypeError where it is no JSON.

    Text goes as UTF-8; only what UTF-8 cannot hold (a lone surrogate) is escaped.
    """
    text: str = _json("encode")(message)
    try:
        return text.encode() + b"\n"
    except UnicodeEncodeError:
        text = _json("escape")(message)
        return text.encode() + b"\n"


def decode(line: bytes) -> JsonObject:
    """Return the object in a line; BadRequest, whose code says why, where there is none."""
    from talkcli.errors import BadRequest, LineTooLong

    if isinstance(line, Cut):
        raise LineTooLong(f"a line has at most {MAX_LINE} bytes")
    try:
        value = _json("decode")(line.decode())
    except UnicodeDecodeError as error:
        raise BadRequest(f"a line is UTF-8, but byte {error.start} of this one is not", "bad_encoding") from None
    except RecursionError:
        raise BadRequest("this JSON is nested too deep", "bad_json") from None
    except ValueError as error:
        raise BadRequest(f"a line is one JSON object: {error}", "bad_json") from None
    if not isinstance(value, dict):
        raise BadRequest(f"a line is one JSON object, not {type(value).__name__}", "bad_json")
    return value


#: What writes and reads JSON. `json.dumps` and `json.loads` make new ones for each line that isn't written or read in
#: their own way, which takes half as long as an event's line itself.
_made: dict[str, Callable[[Any], Any]] = {}


def _json(way: str) -> Callable[[Any], Any]:
    """Return one of them, made when the first line needs it."""
    if not _made:
        import json

        reading = json.JSONDecoder(
            object_pairs_hook=_no_duplicates, parse_constant=_no_constant, parse_int=_short_integer, parse_float=_number
        )
        writing, escaping = json.JSONEncoder(ensure_ascii=False, allow_nan=False), json.JSONEncoder(allow_nan=False)
        _made.update(decode=reading.decode, encode=writing.encode, escape=escaping.encode)
    return _made[way]


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


def _number(digits: str) -> float:
    number = float(digits)
    if not _finite(number):
        raise ValueError("a number past every float")
    return number


def _finite(number: float) -> bool:
    """Whether it is neither NaN nor infinite."""
    return number - number == 0
