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
    """Return the limits of a number in words, "" where it has none."""
    low, high = option.limits
    if low is None:
        return ""
    if high is not None:
        return f"from {low:g} to {high:g}"
    return f"above {low:g}" if option.above else f"from {low:g} on"


def _number(option: Option, text: str) -> float:
    whole = option.kind is INTEGER
    wanted = f"{'a whole number' if whole else 'a number'} {limits(option)}" if limits(option) else "a valid integer"
    try:
        value = int(text) if whole else float(text)
    except ValueError:
        raise ValueError(f"'{text}' is not {wanted}") from None
    if value != value:  # NaN, which compares with nothing
        raise ValueError(f"{value!r} is not a number")
    low, high = option.limits
    if (low is not None and (value <= low if option.above else value < low)) or (high is not None and value > high):
        raise ValueError(f"'{text}' is not {wanted}")
    if option.kind is SECONDS and value == float("inf"):
        raise ValueError("no limit is 0")
    return value


def _mode(text: str) -> int:
    """Return the mode of a file; the owner must be able to use the socket, and nobody executes it."""
    digits = 3 <= len(text) <= 4 and set(text) <= set("01234567")
    mode = int(text, 8) if digits else 0
    if mode & ~0o666 or mode & 0o600 != 0o600:
        raise ValueError(f"{text!r} is not a mode such as 0600 (mine alone), 0660 (my group's) or 0666")
    return mode
