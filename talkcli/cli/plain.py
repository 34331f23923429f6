"""A lightweight parser for simple command lines, which doesn't need click.

It uses the same table of commands as the click version, and the same function to parse option values. Click handles all
other command lines, such as those with unknown options, combined short flags, invalid values or conflicting options.

Some commands send their request before the rest of the program is imported. They only do this if the request is known
to be valid, so that no error is found after it was sent. It is the same request that the client library would send (a
test compares them), and `SocketConnection` then handles the server's answer.
"""

from __future__ import annotations

import _signal
import time

from talkcli.cli.command import COMMON_OPTIONS, OUTPUT_FILE, read_value
from talkcli.cli.commands import COMMANDS
from talkcli.client.connect import hello, reach, send_early, sender_name, yield_processor
from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.goals.options import MAX_ID_CHARS, MAX_SENDER_NAME_CHARS, MAX_TEXT_CHARS, SOUND, Cancel, Say, key_error
from talkcli.paths import named_robot, named_socket

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from typing import Any

    from talkcli.cli.command import Command
    from talkcli.client.connect import ConnectionAttempt
    from talkcli.goals.goal import JsonObject
    from talkcli.goals.options import Option

    #: Maps each flag to its option, and to the option's value if the flag takes no argument.
    Flags = dict[str, tuple[Option, Any]]

_COMMON_NAMES = {each.name for each in COMMON_OPTIONS}
#: Commands that may send their request before the rest of the program is imported.
_EARLY_COMMANDS = ("say", "play", "cancel", "status", "pause", "resume")
#: Commands that send a goal.
_GOAL_COMMANDS = ("say", "play")


@frozen
class PlainCommand:
    """A command line that was parsed without click."""

    command: Command
    #: the values of the command's own options and its argument, by name
    given: dict[str, Any]
    #: the values of the common options that were given, by name
    common: dict[str, Any]
    #: the names of the command's own options that were given
    typed: frozenset[str]


def read(arguments: list[str], environment: Mapping[str, str]) -> PlainCommand | None:
    """Parse a simple command line. Return None if click has to parse it."""
    try:
        return _parse(arguments, environment)
    except (LookupError, ValueError):  # an option is unknown, or its value is invalid or missing
        return None


def _parse(arguments: list[str], environment: Mapping[str, str]) -> PlainCommand | None:
    """Parse a simple command line. Return None or raise an error if click has to parse it."""
    command: Command | None = None
    words: list[str] = []
    given: dict[str, Any] = {}
    flags, rest = _flag_table(COMMON_OPTIONS), arguments[::-1]
    while rest:
        word = rest.pop()
        if command is None and word in COMMANDS:
            command = COMMANDS[word]
            flags |= _flag_table(command.options)
        elif command and word == "--":
            words += rest[::-1]
            break
        elif command and (word[:1] != "-" or word == "-"):
            words.append(word)
        else:
            _read_option(flags, word, rest, given)
    return _build_command(command, given, words, environment) if command else None


def _flag_table(options: Iterable[Option]) -> Flags:
    """Return a table that maps each flag to its option and the value that it sets."""
    found: Flags = {}
    for option in options:
        yes, _, no = option.flags.partition("/")
        found |= dict.fromkeys(yes.split(", "), (option, option.flag_value or True))
        if no:
            found[no] = option, False
    return found


def _read_option(flags: Flags, word: str, rest: list[str], given: dict[str, Any]) -> None:
    """Parse one option, and store its value in `given`. If necessary, take the value from the end of `rest`.

    Raises:
        LookupError, ValueError: click has to parse the option.
    """
    name, equals, text = word.partition("=")
    option, value = flags[name]
    if option.kind is OUTPUT_FILE or (equals and not (option.takes_argument and name[:2] == "--")):
        raise ValueError(f"the option {word} must be parsed by click")
    takes_argument = option.takes_argument
    if not equals and option.bare_value is not None and (not rest or rest[-1][:1] == "-"):
        takes_argument, value = False, option.bare_value
    given[option.name] = read_value(option, text if equals else rest.pop()) if takes_argument else value


def _build_command(
    command: Command, given: dict[str, Any], words: list[str], environment: Mapping[str, str]
) -> PlainCommand | None:
    """Check a command, and add default values. Return None if click has to parse the command."""
    common = {name: given.pop(name) for name in _COMMON_NAMES & given.keys()}
    typed = frozenset(given)
    for option in command.options:
        if option.name not in given:
            value = (environment.get(option.env) if option.env else None) or option.default
            given[option.name] = read_value(option, value) if isinstance(value, str) else value
    argument = command.argument
    if argument:
        many = argument.metavar.endswith("...")
        if (len(words) > 1 and not many) or (argument.choices and (not words or words[0] not in argument.choices)):
            return None
        given[argument.name] = tuple(words) if many else next(iter(words), None)
    elif words:
        return None
    return None if command.usage_fault(given, typed, common) else PlainCommand(command, given, common, typed)


def run(parsed: PlainCommand) -> int:
    """Run a parsed command, and send its request early if possible. Return its exit code."""
    started_at = time.monotonic()
    command, given = parsed.command.name, parsed.given
    blocked: set[int] = set()

    def block_signals() -> None:
        # A signal must cancel the goal, so block signals until the command is able to do that.
        wanted = {_signal.SIGINT, _signal.SIGTERM, _signal.SIGHUP} if command in _GOAL_COMMANDS else set()
        blocked.update(wanted - _signal.pthread_sigmask(_signal.SIG_BLOCK, wanted))

    early = _connect_early(parsed, block_signals) if may_send_early(parsed) else None
    if early and early.request_sent and given.get("wait") and not given.get("feedback"):
        yield_processor(early, given["timeout"])
    from talkcli.cli.show import CommonOptions, run_command

    options = CommonOptions(
        started_at=started_at, early=early, blocked_signals=blocked, typed=parsed.typed, **parsed.common
    )
    return run_command(lambda: parsed.command.run(options, given), options)


def may_send_early(parsed: PlainCommand) -> bool:
    """Return whether the request may be sent before the rest of the program is imported.

    The command must use the local server, and must not need standard input, which may take any time to arrive. The
    library sends lists of sounds and dry runs.
    """
    if named_robot(parsed.common.get("robot"), parsed.common.get("socket")):
        return False
    takes_time = [parsed.given.get(each) for each in ("lines", "stream", "list", "dry_run")]
    return parsed.command.name in _EARLY_COMMANDS and not any(takes_time) and parsed.given.get("text") != ("-",)


def _connect_early(parsed: PlainCommand, before_sending: Callable[[], None]) -> ConnectionAttempt | None:
    """Connect to the server, and send the request if it is simple. Return the connection attempt.

    Args:
        parsed: the command.
        before_sending: called immediately before the request is sent.

    Returns:
        The connection attempt, or None if the connection broke before anything was sent.
    """
    early = reach(named_socket(parsed.common.get("socket")))
    if early.socket is None:
        return early
    # Connect before creating the messages, so that the server can send its greeting in the meantime.
    messages = early_messages(parsed)
    return send_early(early, *messages, before_sending) if messages else early


def early_messages(parsed: PlainCommand) -> tuple[JsonObject, JsonObject] | None:
    """Return a command's hello and its request if they can be sent before most of talk is imported."""
    command, name = parsed.command, sender_name(parsed.given.get("name"))
    request = _early_request(command.name, parsed.given)
    if request is None or len(name or "") > MAX_SENDER_NAME_CHARS:
        return None
    return hello(name, urgent=command.urgent), request


def _early_request(command: str, given: dict[str, Any]) -> JsonObject | None:
    """Return a command's request message if it is simple enough to send early."""
    from talkcli.protocol.lines import request_to_json

    if command in _GOAL_COMMANDS:
        say = _say_request(given)
        return request_to_json(say) if say else None
    if command == "cancel":
        ids, before, key = given["ids"], given["before"], given["key"]
        # Let the library handle several ids, because there may be duplicates or too many for one request.
        if len(ids) > 1 or not all(map(_is_full_id, [*ids, before or "-"])) or (key and key_error(key)):
            return None
        return request_to_json(Cancel(ids or None, given["current"], before, key))
    if given.get("seconds") or given.get("while_connected"):
        return None
    goal_id = given.get("goal_id")
    if goal_id is None:
        return {"request": command}
    return {"request": command, "id": goal_id} if _is_full_id(goal_id) else None


def _is_full_id(goal_id: str) -> bool:
    """Return whether a goal id is complete and can be sent unchanged.

    A number such as 12 isn't complete, because the library has to add the server's boot id.
    """
    return 0 < len(goal_id) <= MAX_ID_CHARS and not goal_id.isdecimal()


def _say_request(given: dict[str, Any]) -> Say | None:
    """Return the request to speak a text or to play a sound. Return None if the text is invalid or too long."""
    options = {each.name: given[each.name] for each in Say.options if each.name in given}
    if "sound" in given:
        options |= {"text": given["sound"], "format": SOUND}
    else:
        options |= {"text": " ".join(given["text"]), "wait": given["wait"] or given["feedback"]}
    say = Say(**options)
    try:
        say.text.encode()
    except UnicodeEncodeError:
        return None
    # A text of this length fits into one request even if every character has to be escaped.
    return None if len(say.text) + len(say.voice or "") > MAX_TEXT_CHARS else say
