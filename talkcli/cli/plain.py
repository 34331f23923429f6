"""Plain command lines, those that there is nothing to say about: read as click would, begun early, and carried out.

Both read the same rows, and a value by the same function. Whatever this does not know for certain, it leaves to click:
a word that is no option, flags in one word, a value that is none, options that contradict each other.

A plain command is begun before the program that carries it out is imported. A request is sent early only where nothing
can be wrong with it, so that no error is found after it was sent. It is the one that the client library sends for the
same command: the library takes it for its own, see `SocketConnection`. A test shows that it is.
"""

from __future__ import annotations

import _signal
import time

from talkcli.cli.command import COMMON, FILE, read_value
from talkcli.cli.commands import COMMANDS
from talkcli.client.connect import ask, hello, reach, sender, stand_back
from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.goals.option import FLAG, MAX_ID, MAX_NAME
from talkcli.goals.options import MAX_CHARACTERS, Cancel, Say, bad_key
from talkcli.paths import named_robot, named_socket

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping
    from typing import Any

    from talkcli.cli.command import Command
    from talkcli.client.connect import Begun
    from talkcli.goals.goal import JsonObject
    from talkcli.goals.option import Option

    #: By each spelling: the option, and the value of a flag.
    Spellings = dict[str, tuple[Option, bool]]

_COMMON = {each.name for each in COMMON}
#: The commands whose request may be sent early.
_EARLY = ("say", "cancel", "status", "pause", "resume")


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
    except (ValueError, StopIteration):  # an option's value is none, or is missing
        return None


def _read(arguments: list[str], environment: Mapping[str, str]) -> Plain | None:
    command: Command | None = None
    words: list[str] = []
    given: dict[str, Any] = {}
    options, rest = _spellings(COMMON), iter(arguments)
    for word in rest:
        if command is None and word in COMMANDS:
            command = COMMANDS[word]
            options |= _spellings(command.options)
        elif word == "--" and command:
            words += rest
        elif word[:1] != "-" or word == "-":
            words.append(word)
        elif not _take(options, word, rest, given):
            return None
        if command is None and words:
            return None
    return _complete(command, given, words, environment) if command and command.plain else None


def _spellings(options: Iterable[Option]) -> Spellings:
    found: Spellings = {}
    for option in options:
        yes, _, no = option.flags.partition("/")
        found |= dict.fromkeys(yes.split(", "), (option, True))
        if no:
            found[no] = option, False
    return found


def _take(options: Spellings, word: str, rest: Iterator[str], given: dict[str, Any]) -> bool:
    """Take an option, whose value may be the next word; False where it isn't plain."""
    name, equals, text = word.partition("=")
    if name not in options or (equals and name[:2] != "--"):
        return False
    option, value = options[name]
    if option.kind is FILE or (option.kind is FLAG and equals):
        return False
    given[option.name] = value if option.kind is FLAG else read_value(option, text if equals else next(rest))
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
            given[option.name] = read_value(option, text) if text else option.default
    argument = command.argument
    if argument:
        many = argument.metavar.endswith("...")
        if (len(words) > 1 and not many) or (
            argument.choices and words[:1] not in ([each] for each in argument.choices)
        ):
            return None
        given[argument.name] = tuple(words) if many else next(iter(words), None)
    elif words:
        return None
    if command.fault(given, typed, common.get("robot"), common.get("socket"), common.get("connect_timeout")):
        return None
    return Plain(command, given, common, typed)


def carry_out(plain: Plain) -> int:
    """Carry out a plain command line, and return its exit code."""
    began = time.monotonic()
    command, given = plain.command.name, plain.given
    held: set[int] = set()

    def hold() -> None:
        # A goal that is on its way is this command's to cancel: a signal waits until there is somebody to do so.
        asked = {_signal.SIGINT, _signal.SIGTERM, _signal.SIGHUP} if command == "say" else set()
        held.update(asked - _signal.pthread_sigmask(_signal.SIG_BLOCK, asked))

    try:
        begun = _begin(plain, hold) if asks_at_once(plain) else None
        if begun and begun.sent and given.get("wait") and not given.get("feedback"):
            begun = stand_back(begun, given["timeout"])
    except KeyboardInterrupt:
        return 128 + int(_signal.SIGINT)  # nothing was sent
    from talkcli.cli.show import Common, ended

    options = Common(began=began, begun=begun, held=held, typed=plain.typed, **plain.common)
    return ended(lambda: plain.command.carry_out(options, given), options)


def asks_at_once(plain: Plain) -> bool:
    """Whether a command begins with a request to this machine's server, and reads no standard input before, which may
    take any time.
    """
    if named_robot(plain.common.get("robot"), plain.common.get("socket")):
        return False
    return plain.command.name in _EARLY and not plain.given.get("lines") and plain.given.get("text") != ("-",)


def _begin(plain: Plain, before: Callable[[], None]) -> Begun | None:
    """Return the command's connection, as far as it comes in no time; `before`: called before its request is sent."""
    begun = reach(named_socket(plain.common.get("socket")))
    if begun.socket is None:
        return begun
    # After it has connected: the server greets meanwhile.
    said = first(plain)
    return ask(begun, *said, before) if said else begun


def first(plain: Plain) -> tuple[JsonObject, JsonObject] | None:
    """Return what a command says first, and its request; None where that may be refused, or only the library knows."""
    command, name = plain.command, sender(plain.given.get("name"))
    request = _request(command.name, plain.given)
    if request is None or len(name or "") > MAX_NAME:
        return None
    return hello(name, urgent=command.urgent), request


def _request(command: str, given: dict[str, Any]) -> JsonObject | None:
    from talkcli.protocol.lines import write_request

    if command == "say":
        say = _say(given)
        return write_request(say) if say else None
    if command == "cancel":
        ids, before, key = given["ids"], given["before"], given["key"]
        # More ids may be too many for a request, or the same.
        if len(ids) > 1 or not all(map(_whole, [*ids, before or "-"])) or (key and bad_key(key)):
            return None
        return write_request(Cancel(ids or None, given["current"], before, key))
    goal_id = given.get("goal_id")
    if goal_id is None:
        return {"request": command}
    return {"request": command, "id": goal_id} if _whole(goal_id) else None


def _whole(goal_id: str) -> bool:
    """Whether an id is one as it stands; numbers stand for goals of a server that the library knows once it greets."""
    return 0 < len(goal_id) <= MAX_ID and not goal_id.isdecimal()


def _say(given: dict[str, Any]) -> Say | None:
    """Return a goal; None where its text isn't sent as it is, or may not fit into a request."""
    options = {each.name: given[each.name] for each in Say.options if each.name in given}
    say = Say(**{**options, "text": " ".join(given["text"]), "wait": given["wait"] or given["feedback"]})
    try:
        say.text.encode()
    except UnicodeEncodeError:
        return None
    # With as much escaped as can be, these and all that is shorter fit.
    return None if len(say.text) + len(say.voice or "") > MAX_CHARACTERS else say
