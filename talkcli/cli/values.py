"""What words mean that were typed: read alike wherever they are read. Pure, and without click.

The value of an option; a text, which may hold bytes that are no UTF-8; and what was probably meant by a word that isn't
known.
"""

from __future__ import annotations

from talkcli.cli.command import MODE
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.option import ID, INTEGER, NUMBER, PATH, SECONDS, WORD

if TYPE_CHECKING:
    from collections.abc import Iterable
    from typing import Any

    from talkcli.goals.option import Option

#: What is said of an empty word: it comes from a variable that isn't set, and selects nothing.
_EMPTY = "empty; is the variable set that it comes from?"
#: Stands for what could not be read; the engine takes it for a blank.
_REPLACEMENT = "\ufffd"
#: How Python shows the bytes from 0x80 on where they are no UTF-8, in arguments and with `surrogateescape`.
_FIRST, _LAST = "\udc80", "\udcff"


def read(option: Option, text: str) -> Any:
    """Return the value that a text stands for; ValueError, with what is wrong for people, where it stands for none."""
    kind = option.kind
    if kind in (INTEGER, NUMBER, SECONDS):
        return _number(option, text)
    if kind is MODE:
        return _mode(text)
    names = kind in (WORD, ID)
    if names:
        text = _decoded(text)
    if not text and (names or kind is PATH):
        raise ValueError(_EMPTY)
    byte = _unreadable(text) if names else None
    if byte is not None:
        raise ValueError(f"the byte 0x{byte:02x} in it is not UTF-8")
    return text


def limits(option: Option) -> str:
    """Return the limits of a number as help has them, "" where it has none."""
    return f"from {option.range}" if option.limits[1] is not None else option.range


def _number(option: Option, text: str) -> float:
    whole = option.kind is INTEGER
    what = "a whole number" if whole else "a number"
    wanted = f"{what} {limits(option)}" if option.range else "a valid integer" if whole else what
    try:
        value = int(text) if whole else float(text)
    except ValueError:
        raise ValueError(f"'{text}' is not {wanted}") from None
    if value != value:  # NaN
        raise ValueError(f"{value!r} is not a number")
    if option.kind is SECONDS and value == float("inf"):
        raise ValueError("no limit is 0")
    if option.outside(value):
        raise ValueError(f"'{text}' is not {wanted}")
    return value


def _mode(text: str) -> int:
    """Return the mode of a file; the owner must be able to use the socket, and nobody executes it."""
    digits = 3 <= len(text) <= 4 and set(text) <= set("01234567")
    mode = int(text, 8) if digits else 0
    if mode & ~0o666 or mode & 0o600 != 0o600:
        raise ValueError(f"{text!r} is not a mode such as 0600 (mine alone), 0660 (my group's) or 0666")
    return mode


def _decoded(text: str) -> str:
    """Return a text that came as bytes, read as UTF-8 even where the locale made Python take arguments for ASCII."""
    return text.encode(errors="surrogateescape").decode(errors="surrogateescape")


def _unreadable(text: str) -> int | None:
    """Return the first byte of such a text that is no UTF-8, if there is one."""
    return next((ord(each) - 0xDC00 for each in text if _FIRST <= each <= _LAST), None)


def readable(text: str, line: int = 1) -> tuple[str, str | None]:
    """Return a text with U+FFFD for each byte that is no UTF-8, and what is said of them, if there are any.

    `line`: the number of its first line.
    """
    text = _decoded(text)
    found = [place for place, each in enumerate(text) if _FIRST <= each <= _LAST]
    if not found:
        return text, None
    first = found[0]
    line += text.count("\n", 0, first)
    column = first - text.rfind("\n", 0, first)
    words = f"line {line}, column {column}: the byte 0x{ord(text[first]) - 0xDC00:02x} is not UTF-8, and is not spoken"
    if len(found) > 1:
        words += f" (the first of {len(found):,})"
    return "".join(_REPLACEMENT if _FIRST <= each <= _LAST else each for each in text), words


def nearest(word: str, known: Iterable[str]) -> str | None:
    """Return the one of these that was most likely meant, None where none is near."""
    import difflib

    by_name = {each.lower(): each for each in known}
    found = difflib.get_close_matches(word.lower(), by_name, n=1)
    return by_name[found[0]] if found else None
