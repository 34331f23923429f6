"""Bytes that are no UTF-8, in what is to be spoken and in other words that were typed. Pure."""

from __future__ import annotations

#: Stands for what could not be read; the engine takes it for a blank.
_UNREADABLE = "\ufffd"
#: How Python shows the bytes from 0x80 on where they are no UTF-8, in arguments and with `surrogateescape`.
_FIRST, _LAST = "\udc80", "\udcff"


def decoded(text: str) -> str:
    """Return a text that came as bytes, read as UTF-8 even where the locale made Python take arguments for ASCII."""
    return text.encode(errors="surrogateescape").decode(errors="surrogateescape")


def unreadable(text: str) -> int | None:
    """Return the first byte of such a text that is no UTF-8, if there is one."""
    return next((ord(each) - 0xDC00 for each in text if _FIRST <= each <= _LAST), None)


def readable(text: str, line: int = 1) -> tuple[str, str | None]:
    """Return a text with U+FFFD for each byte that is no UTF-8, and what is said of them, if there are any.

    `line`: the number of its first line.
    """
    text = decoded(text)
    found = [place for place, each in enumerate(text) if _FIRST <= each <= _LAST]
    if not found:
        return text, None
    first = found[0]
    line += text.count("\n", 0, first)
    column = first - text.rfind("\n", 0, first)
    words = f"line {line}, column {column}: the byte 0x{ord(text[first]) - 0xDC00:02x} is not UTF-8, and is not spoken"
    if len(found) > 1:
        words += f" (the first of {len(found):,})"
    return "".join(_UNREADABLE if _FIRST <= each <= _LAST else each for each in text), words
