"""What the words on a command line mean for an option: read alike wherever they are read. Pure, and without click."""

from __future__ import annotations

from talkcli.cli.command import MODE
from talkcli.cli.utf8 import decoded, unreadable
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.option import ID, INTEGER, NUMBER, PATH, SECONDS, WORD

if TYPE_CHECKING:
    from typing import Any

    from talkcli.goals.option import Option

#: What is said of an empty word: it comes from a variable that isn't set, and selects nothing.
_EMPTY = "empty; is the variable set that it comes from?"


def read(option: Option, text: str) -> Any:
    """Return the value that a text stands for; ValueError, with what is wrong for people, where it stands for none."""
    kind = option.kind
    if kind in (INTEGER, NUMBER, SECONDS):
        return _number(option, text)
    if kind is MODE:
        return _mode(text)
    names = kind in (WORD, ID)
    if names:
        text = decoded(text)
    if not text and (names or kind is PATH):
        raise ValueError(_EMPTY)
    byte = unreadable(text) if names else None
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
