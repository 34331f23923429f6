"""Functions that read and write lines of JSON. Each line contains one object.

Rules for this file: no I/O. It knows lines and their limits, but not what a request means. Any received bytes become an
object or a BadRequest. The functions that need `json` or the errors import them, for two reasons: a client writes its
first request before most of its modules are imported, and the engine process only splits lines.
"""

from __future__ import annotations

import sys

from talkcli.frozen import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any

    from talkcli.goals.goal import JsonObject
    from talkcli.protocol.requests import Request

#: Maximum length of a request, including its newline. The longest text has 10,000 characters, which take 40,000 bytes
#: of UTF-8, or 60,000 bytes if all of them are escaped as \uXXXX.
MAX_LINE_BYTES = 64 * 1024

#: The number of the first request on a connection.
FIRST_SEQ = 1

#: Maximum number of digits in a JSON integer. Converting thousands of digits would take quadratic time.
MAX_DIGITS = 20


class TruncatedLine(bytes):
    """The beginning of a line that is too long."""

    #: length of the complete line in bytes
    size: int


class LineSplitter:
    """Splits a stream of bytes into lines.

    It keeps at most the first `max_bytes` bytes of a line.
    """

    __slots__ = ("_max_bytes", "_rest", "size")

    def __init__(self, max_bytes: int = sys.maxsize) -> None:
        self._max_bytes = max_bytes
        self._rest = bytearray()
        #: length of the incomplete line in bytes, including the bytes that are not kept
        self.size = 0

    def feed(self, data: bytes) -> list[bytes]:
        """Add received bytes. Return the lines that are now complete.

        The lines don't contain their newlines. A line that is too long is truncated.
        """
        *lines, rest = data.split(b"\n")
        for place, line in enumerate(lines):
            if self.size or len(line) > self._max_bytes:
                self._append(line)
                lines[place] = self.take_rest()
        self._append(rest)
        return lines

    def take_rest(self) -> bytes:
        """Remove and return the incomplete line.

        Return b"" if there is none.
        """
        line = bytes(self._rest)
        if self.size > self._max_bytes:
            line = TruncatedLine(line)
            line.size = self.size
        self._rest.clear()
        self.size = 0
        return line

    def _append(self, data: bytes) -> None:
        """Append bytes to the incomplete line, or only count them if the line is too long."""
        self.size += len(data)
        self._rest += data[: self._max_bytes - len(self._rest)]


def request_to_json(request: Request) -> JsonObject:
    """Return a request as a JSON object, without default values."""
    message: JsonObject = {"request": request.kind}
    for option in request.options:
        value = getattr(request, option.name)
        if value != option.default or option.default_words == "required":
            message[option.name] = list(value) if isinstance(value, tuple) else value
    return message


def request_line(message: JsonObject) -> bytes:
    """Encode a request as a line of JSON, without importing `json` if possible."""
    try:
        shown = ", ".join(f'"{name}": {_encode_simple(value)}' for name, value in message.items())
        return f"{{{shown}}}\n".encode()
    except (TypeError, UnicodeEncodeError):
        return encode(message)


def _encode_simple(value: object) -> str:
    """Encode a simple value as JSON. Raise TypeError for a value that needs the `json` module."""
    if isinstance(value, str):
        if value.isprintable() and '"' not in value and "\\" not in value:
            return f'"{value}"'
        from _json import encode_basestring  # slow to import, and not needed for most texts

        return encode_basestring(value)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return int.__repr__(value)
    if isinstance(value, float) and _is_finite(value):
        return float.__repr__(value)
    if isinstance(value, list):
        return f"[{', '.join(map(_encode_simple, value))}]"
    raise TypeError


def encode(message: JsonObject) -> bytes:
    """Encode an object as a line of JSON. Raise ValueError or TypeError if this is impossible.

    Text is written as UTF-8. Only lone surrogates, which UTF-8 can't hold, are escaped.
    """
    try:
        line: bytes = _json_function("encode")(message).encode()
    except UnicodeEncodeError:
        line = _json_function("escape")(message).encode()
    return line + b"\n"


def decode(line: bytes) -> JsonObject:
    """Decode a line that contains a JSON object. Raise BadRequest if it is malformed or too long."""
    from talkcli.errors import BadRequest, LineTooLong

    if isinstance(line, TruncatedLine):
        raise LineTooLong(f"the line is too long (at most {MAX_LINE_BYTES:,} bytes)")
    try:
        value = _json_function("decode")(line.decode())
    except UnicodeDecodeError as error:
        raise BadRequest(f"the line is not valid UTF-8 (byte {error.start})", "bad_encoding") from None
    except RecursionError:
        raise BadRequest("the JSON is nested too deeply", "bad_json") from None
    except ValueError as error:
        raise BadRequest(f"the line is not a JSON object: {error}", "bad_json") from None
    if not isinstance(value, dict):
        raise BadRequest(f"the line must be a JSON object, got {type(value).__name__}", "bad_json")
    return value


#: Functions that encode and decode JSON. They are created once, because `json.dumps` and `json.loads` create new ones
#: for every call that has options, which is slow.
_json_functions: dict[str, Callable[[Any], Any]] = {}


def _json_function(name: str) -> Callable[[Any], Any]:
    """Return the JSON function `decode`, `encode` or `escape`. The first call creates all three."""
    if not _json_functions:
        import json

        reading = json.JSONDecoder(
            object_pairs_hook=_create_object,
            parse_constant=_refuse_constant,
            parse_int=_parse_integer,
            parse_float=_parse_float,
        )
        writing, escaping = json.JSONEncoder(ensure_ascii=False, allow_nan=False), json.JSONEncoder(allow_nan=False)
        _json_functions.update(decode=reading.decode, encode=writing.encode, escape=escaping.encode)
    return _json_functions[name]


def _create_object(pairs: list[tuple[str, object]]) -> JsonObject:
    """Return an object with these keys and values. Raise ValueError if a key appears twice."""
    fields = dict(pairs)
    if len(fields) != len(pairs):
        raise ValueError("a key appears twice")
    return fields


def _refuse_constant(name: str) -> object:
    """Raise ValueError, because `NaN` and `Infinity` are not valid JSON."""
    raise ValueError(f"{name} is not allowed")


def _parse_integer(digits: str) -> int:
    """Convert digits to an integer. Raise ValueError if there are too many digits."""
    if len(digits) > MAX_DIGITS:
        raise ValueError(f"an integer has {len(digits):,} digits, but at most {MAX_DIGITS} are allowed")
    return int(digits)


def _parse_float(digits: str) -> float:
    """Convert digits to a float. Raise ValueError if the number is too large."""
    number = float(digits)
    if not _is_finite(number):
        raise ValueError("a number is too large")
    return number


def _is_finite(number: float) -> bool:
    """Return whether a number is finite."""
    return number - number == 0
