"""Reads plain command lines, those that there is nothing to say about, as click would. Pure: it carries out nothing.

Both read the same rows, and a value by the same function. Whatever this does not know for certain, it leaves to click:
a word that is no option, flags in one word, a value that is none, options that contradict each other.
"""

from __future__ import annotations

from talkcli.cli import values
from talkcli.cli.command import COMMON, FILE
from talkcli.cli.commands import COMMANDS
from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.goals.option import FLAG

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from typing import Any

    from talkcli.cli.command import Command
    from talkcli.goals.option import Option

    #: By each spelling: the option, and the value of a flag.
    Spellings = dict[str, tuple[Option, bool]]

_COMMON = {each.name for each in COMMON}


@frozen
class Plain:
    """A command line that was read."""

    command: Command
    #: the command's options and arguments, by their names
    given: dict[str, Any]
    #: those of every command that were given
    common: dict[str, Any]
    #: the options that stand on the command line
    typed: frozenset[str]


def read(arguments: list[str], environment: Mapping[str, str]) -> Plain | None:
    """Return what a command line says; None where click has to read it."""
    try:
        return _read(arguments, environment)
    except ValueError:
        return None


def _read(arguments: list[str], environment: Mapping[str, str]) -> Plain | None:
    command: Command | None = None
    words: list[str] = []
    given: dict[str, Any] = {}
    options, rest = _spellings(COMMON), iter(arguments)
    for word in rest:
        if command is None and word in COMMANDS:
            command = COMMANDS[word]
            if not command.plain:
                return None
            options |= _spellings(command.options)
        elif word == "--" and command:
            words += rest
        elif word[:1] != "-" or word == "-":
            if command is None:
                return None
            words.append(word)
        elif not _take(options, word, rest, given):
            return None
    return None if command is None else _complete(command, given, words, environment)


def _spellings(options: Iterable[Option]) -> Spellings:
    found: Spellings = {}
    for option in options:
        yes, _, no = option.flags.partition("/")
        found |= dict.fromkeys(yes.split(", "), (option, True))
        if no:
            found[no] = option, False
    return found


def _take(options: Spellings, word: str, rest: Iterator[str], given: dict[str, Any]) -> bool:
    """Take an option, whose value may be the next word; False, or ValueError for its value, where it isn't plain."""
    name, equals, text = word.partition("=")
    if name not in options or (equals and name[:2] != "--"):
        return False
    option, value = options[name]
    if option.kind is FILE or (option.kind is FLAG and equals):
        return False
    try:
        given[option.name] = value if option.kind is FLAG else values.read(option, text if equals else next(rest))
    except StopIteration:
        return False
    return True


def _complete(
    command: Command, given: dict[str, Any], words: list[str], environment: Mapping[str, str]
) -> Plain | None:
    """Fill in what was not given; None where something contradicts itself, is missing or too much."""
    common = {name: given.pop(name) for name in _COMMON & given.keys()}
    typed = frozenset(given)
    for option in command.options:
        if option.name not in given:
            text = environment.get(option.env) if option.env else None
            given[option.name] = values.read(option, text) if text else option.default
    argument = command.argument
    if argument:
        if len(words) > 1 and not argument.many:
            return None
        given[argument.name] = tuple(words) if argument.many else next(iter(words), None)
    elif words:
        return None
    return None if command.fault(given, typed) else Plain(command, given, common, typed)
