"""The encoder of a client's requests: values become objects, and objects lines, without `json`.

A client imports it before it sends anything, so it imports nothing heavy. No I/O; how a request is read is `requests`.
"""

from __future__ import annotations

from talkcli.frozen import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from talkcli.goals.goal import JsonObject
    from talkcli.protocol.requests import Request


def write_request(request: Request) -> JsonObject:
    """Return a request as the object that goes over the wire; fields at their defaults are left out."""
    message: JsonObject = {"request": request.kind}
    for option in request.options:
        value = getattr(request, option.name)
        if value != option.default or option.name == "text":
            message[option.name] = list(value) if isinstance(value, tuple) else value
    return message


def request_line(message: JsonObject) -> bytes:
    """Return an object as a line, the same that `lines.encode` returns; ValueError or TypeError where it is no JSON."""
    try:
        return _line(message, _quoted)
    except UnicodeEncodeError:  # only what UTF-8 cannot hold is escaped
        from _json import encode_basestring_ascii

        return _line(message, encode_basestring_ascii)


def _line(message: JsonObject, quoted: Callable[[str], str]) -> bytes:
    shown = ", ".join(f'"{name}": {_value(value, quoted)}' for name, value in message.items())
    return f"{{{shown}}}\n".encode()


def _value(value: object, quoted: Callable[[str], str]) -> str:
    if isinstance(value, str):
        return quoted(value)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return int.__repr__(value)
    if isinstance(value, float) and value - value == 0:  # neither NaN nor infinite
        return float.__repr__(value)
    if isinstance(value, list):
        return f"[{', '.join(_value(each, quoted) for each in value)}]"
    import json

    return json.dumps(value, ensure_ascii=quoted is not _quoted, allow_nan=False)


def _quoted(text: str) -> str:
    if text.isprintable() and '"' not in text and "\\" not in text:
        return f'"{text}"'
    from _json import encode_basestring  # a library of its own, whose loading most texts need not wait for

    return encode_basestring(text)
