"""Bytes that are no UTF-8 in what is to be spoken: each becomes U+FFFD, and words say where the first one is. Pure."""

from __future__ import annotations

#: Stands for what could not be read; the engine takes it for a blank.
_UNREADABLE = "\ufffd"
#: How Python shows the bytes from 0x80 on where they are no UTF-8, in arguments and with `surrogateescape`.
_FIRST, _LAST = "\udc80", "\udcff"


def readable(text: str, line: int = 1) -> tuple[str, str | None]:
    """Return a text without bytes that are no UTF-8, of the same length, and what is said of them, if there are any.

    `line`: the number of its first line.
    """
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
