"""Reads plain command lines, those that there is nothing to say about, as click would. Pure: it carries out nothing.

What it knows of the commands is `plain_table`, which is made from click's own declarations. Whatever it does not know
for certain, it leaves to click: an option that isn't in the table, flags in one word, a number in another form, options
that contradict each other. A test shows that both read any command line alike.
"""

from __future__ import annotations

from talkcli.cli.plain_table import COMMANDS, COMMON
from talkcli.frozen import TYPE_CHECKING, frozen

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from typing import Any

#: More digits are left to click: they are within no range.
_MAX_DIGITS = 9


@frozen
class Plain:
    """A command line that was read."""

    command: str
    #: the command's options and arguments, by click's names for them
    given: dict[str, Any]
    #: socket, json, quiet: those that were given
    common: dict[str, Any]


def read(arguments: list[str], environment: Mapping[str, str]) -> Plain | None:
    """Return what a command line says; None where click has to read it."""
    command = None
    words: list[str] = []
    given: dict[str, Any] = {}
    common: dict[str, Any] = {}
    options, rest = COMMON, iter(arguments)
    for word in rest:
        if command is None and word in COMMANDS:
            command = word
            options = {**COMMON, **COMMANDS[word]["options"]}
        elif word == "--" and command:
            words += rest
        elif word[:1] != "-" or word == "-":
            if command is None:
                return None
            words.append(word)
        else:
            found = _option(options, word, rest)
            if found is None:
                return None
            (common if found[0] in ("socket", "json", "quiet") else given)[found[0]] = found[1]
    if command is None:
        return None
    return _complete(command, given, common, words, environment)


def _option(options: dict[str, Any], word: str, rest: Iterator[str]) -> tuple[str, Any] | None:
    """Return the name and the value of an option, which may be the next word."""
    name, equals, text = word.partition("=")
    if name not in options or (equals and name[:2] != "--"):
        return None
    destination, kind, *limits = options[name]
    if kind is True or kind is False:
        return None if equals else (destination, kind)
    value = _value(kind, limits, text if equals else next(rest, ""))
    return None if value is None else (destination, value)


def _value(kind: str, limits: list[float | None], text: str) -> Any:
    """Return the value of an option, None where it isn't plain."""
    if kind == "text":
        return text if text and text[:1] != "-" and text.isprintable() else None  # else it may be no UTF-8
    whole, point, part = text.partition(".")
    digits = whole.removeprefix("-") if kind == "int" else whole
    for each in (digits, part) if point else (digits,):
        if not (each.isascii() and each.isdecimal() and len(each) <= _MAX_DIGITS):
            return None
    if kind == "int" and point:
        return None
    number = int(text) if kind == "int" else float(text)
    low, high = limits
    return number if (low is None or low <= number) and (high is None or number <= high) else None


def _complete(
    command: str, given: dict[str, Any], common: dict[str, Any], words: list[str], environment: Mapping[str, str]
) -> Plain | None:
    """Fill in what was not given; None where something contradicts itself, is missing or too much."""
    table = COMMANDS[command]
    for name, variable in table["environment"].items():
        if name not in given and environment.get(variable):
            given[name] = environment[variable]
            if not given[name].isprintable():
                return None
    given = {**table["defaults"], **given}
    argument, count = table["argument"] or (None, 0)
    if len(words) > count >= 0:
        return None
    if argument:
        given[argument] = tuple(words) if count < 0 else (words[0] if words else None)
    if command == "say":
        given["wait"] = given["wait"] or given["feedback"]
        unclear = not words or words == ["-"]
        contradicts = (given["flush"] and given["preempt"] is False) or (given["timeout"] and not given["wait"])
        if unclear or contradicts:
            return None
    return Plain(command, given, common)
