"""The row that describes a command. Help, completion, the tables in documents and both parsers are made from it.

This module also reads the words of a command line: option values, and texts that may contain bytes that aren't UTF-8.
The commands themselves are in `commands`. This module is pure. It is imported before anything is sent, without click.
"""

from __future__ import annotations

from talkcli.errors import UsageError
from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.goals.options import FLAG, ID, INTEGER, NUMBER, PATH, SECONDS, WORD, Kind, Option
from talkcli.paths import named_robot

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from typing import Any

    from talkcli.cli.show import CommonOptions

    ExitCodes = Mapping[int | str, str]
    #: Returns what is wrong with a combination of options. It is called with the values of all options, by name, and
    #: with the names of the options on the command line.
    Rule = Callable[[Mapping[str, Any], frozenset[str]], str | None]

#: The path of a file to be written.
OUTPUT_FILE = Kind("string", (str,), "must be a string")
#: The permissions of a file, in octal.
FILE_MODE = Kind("string", (str,), "must be a string", "MODE")

#: Options of `say`, `wait` and others that can't be combined with several robots.
_SINGLE_ROBOT_OPTIONS = ("lines", "ahead", "feedback", "output")

#: The exit codes of every command that uses a server. A command can give other meanings to them.
SERVER_EXIT_CODES: ExitCodes = {
    1: "anything not named here; a bug says so",
    2: "usage: what is wrong stands on standard error",
    3: "no server: nothing was sent, so it is safe to try again",
    5: "the server has as many clients as it takes",
    9: "this command and the server speak different versions of the protocol",
    10: "permission denied",
    12: "lost: it was sent, then nothing more was heard; it may have an effect all the same",
}
#: The exit codes of every command that can be sent to several robots.
FLEET_EXIT_CODES: ExitCodes = {
    **SERVER_EXIT_CODES,
    13: "robots differ: those that did not do it failed in more than one way",
}
#: All exit codes, for the general help and the README. The help of each command has its own meanings.
ALL_EXIT_CODES: ExitCodes = {
    **FLEET_EXIT_CODES,
    0: "accepted; with --wait succeeded: all of it was played",
    1: "anything not named here; a bug says so, and TALK_DEBUG=1 where",
    2: "usage",
    4: "aborted: engine or audio failed, or nothing in the text can be spoken",
    5: "rejected: never queued",
    6: "recalled: taken out of the queue before it was spoken",
    7: "preempted: stopped while it was spoken",
    8: "unknown goal",
    9: "client and server speak different versions of the protocol",
    11: "the socket is served already, or its directory is not safe",
    12: "lost: it was sent, then the server went away; it may still be spoken",
    124: "timed out",
    "128+n": "ended by signal n; 141: standard output is closed, or its reader went away",
}


@frozen
class Command:
    """A row that describes a command."""

    name: str
    #: one line for the list of commands
    summary: str
    #: the description in the command's help
    description: str
    #: the function that runs the command, as "module:name"; it is called with `CommonOptions` and the given values
    function: str
    #: example command lines, one on each line
    examples: str
    exit_codes: ExitCodes
    options: tuple[Option, ...] = ()
    #: the positional argument; it takes any number of words if its metavar ends with dots
    argument: Option | None = None
    #: whether it may connect to a server that has reached its client limit
    urgent: bool = False
    #: added to the error for an unknown option
    unknown_option_hint: str = ""
    #: whether the lightweight parser in `plain` may read it, without click
    plain: bool = True
    #: whether it uses a server; this can be the server of a robot in a fleet
    uses_server: bool = True
    #: whether it connects to a single server, for which --connect-timeout can wait
    connects: bool = True
    #: the function that sends the command to several robots, in the form of `function`; empty if there is none
    fleet_function: str = ""
    rule: Rule | None = None

    def usage_fault(self, given: Mapping[str, Any], typed: frozenset[str], common: Mapping[str, Any]) -> str | None:
        """Return what is wrong with a command line whose values are each valid, or None.

        Args:
            given: the values of the command's own options and of its argument, by name.
            typed: the names of the options on the command line.
            common: the values of the common options on the command line, by name.
        """
        robot = common.get("robot")
        if robot is not None and common.get("socket"):
            return "--robot is a robot of a fleet, --socket a server of this machine: leave out one of them"
        if fault := self._connection_fault(given, robot, common.get("connect_timeout")):
            return fault
        for each in self.options:
            if fault := each.value_error(given[each.name]):
                return fault
        return self.rule(given, typed) if self.rule else None

    def _is_local(self, given: Mapping[str, Any]) -> bool:
        """Return whether the command runs without a server, such as `talk say --output`."""
        return not self.uses_server or given.get("output") is not None

    def _connection_fault(
        self, given: Mapping[str, Any], robot: str | None, connect_timeout: float | None
    ) -> str | None:
        """Return what is wrong with naming a robot or waiting for a server, or None."""
        local_name = f"{self.name}{' --output' * (given.get('output') is not None)}"
        is_several = False
        if robot is not None:
            from talkcli.fleet.desk.request import Selection, selects_several

            if self._is_local(given):
                return f"'talk {local_name}' is of this machine alone: leave out --robot"
            is_several = selects_several(robot)
            single = [f"--{each}" for each in _SINGLE_ROBOT_OPTIONS if given.get(each)]
            if is_several and (single or not self.fleet_function):
                what = " ".join([self.name, *single])
                return (
                    f"'talk {what}' is of one robot: name it; 'talk fleet status' and 'talk fleet watch' show several"
                )
            if fault := Selection(robot).fault:
                return fault
        if connect_timeout is None:
            return None
        if self._is_local(given) or not self.connects:
            return f"'talk {local_name}' does not wait for a server: leave out --connect-timeout"
        return "--connect-timeout waits for one robot: name it, or leave out --connect-timeout" if is_several else None

    def run(self, options: CommonOptions, given: Mapping[str, Any]) -> int | None:
        """Run the command with the given values, and return its exit code, or None for 0."""
        options.urgent = self.urgent
        function = self.function
        robot = None if self._is_local(given) else named_robot(options.robot, options.socket)
        if robot:
            # The robot can also come from the environment, so it is checked again.
            if fault := self._connection_fault(given, robot, options.connect_timeout):
                raise UsageError(fault)
            from talkcli.fleet.desk.request import selects_several

            if selects_several(robot):
                function = self.fleet_function
                given = {name: value for name, value in given.items() if name not in _SINGLE_ROBOT_OPTIONS}
        module, _, name = function.partition(":")
        run: Callable[..., int | None] = getattr(__import__(f"talkcli.cli.{module}", fromlist=[name]), name)
        return run(options, **given)


def option(flags: str, kind: Kind, words: str, **more: Any) -> Option:
    """Return an option of a command, named after its long flag. `words` is its help, and `more` has further fields."""
    name = flags.rpartition("--")[2].replace("-", "_")
    return Option(name, kind, flags=flags, help=words, **{"default": False if kind is FLAG else None, **more})


#: The options of every command. They can be written before or after its name.
COMMON_OPTIONS = (
    option(
        "--socket",
        PATH,
        "Socket of the server.  [env var: TALK_SOCKET; default: the usual places, as 'talk doctor' lists]",
        completion="files",
    ),
    option(
        "--robot",
        WORD,
        "A robot of a fleet, by its broker (TALK_BROKER); or several: a glob, @GROUP, @all.  [env var: TALK_ROBOT]",
        metavar="NAME",
        completion="robots",
    ),
    option(
        "--connect-timeout",
        NUMBER,
        "Keep trying to reach the server for SEC seconds; with --robot, until the robot is online.",
        limits=(0, None),
        excludes_minimum=True,
        metavar="SEC",
    ),
    option("--insecure", FLAG, "Send the password to the broker without TLS."),
    option("--json", FLAG, "For programs: one JSON object a line; errors, too."),
    option("-q, --quiet", FLAG, "No ids, no notes."),
)


def spelling(option: Option, value: object = None) -> str:
    """Return the long flag of an option. If the flag has two forms, the value chooses one."""
    forms = option.flags.split("/")
    return (forms[-1] if value is False else forms[0]).split(", ")[-1]


def read_value(option: Option, text: str) -> Any:
    """Return the value of an option from its text.

    Raises:
        ValueError: the text isn't a valid value. The message says why.
    """
    kind = option.kind
    if kind in (INTEGER, NUMBER, SECONDS):
        return _read_number(option, text)
    if kind is FILE_MODE:
        return _read_mode(text)
    if kind in (WORD, ID):
        text = _as_utf8(text)
        bad = next(filter(_is_bad_byte, text), None)
        if bad:
            raise ValueError(f"the byte {_format_byte(bad)} in it is not UTF-8")
    if not text and kind in (WORD, ID, PATH):  # an empty name would select nothing
        raise ValueError("empty; is the variable set that it comes from?")
    return text


def range_help(option: Option) -> str:
    """Return the limits of a number for help; empty if it has none."""
    return f"from {option.range}" if option.limits[1] is not None else option.range


def _read_number(option: Option, text: str) -> float:
    whole = option.kind is INTEGER
    what = "a whole number" if whole else "a number"
    wanted = f"{what} {range_help(option)}" if option.range else "a valid integer" if whole else what
    try:
        value = int(text) if whole else float(text)
    except ValueError:
        raise ValueError(f"'{text}' is not {wanted}") from None
    if value != value:  # only true for NaN
        raise ValueError(f"{value!r} is not a number")
    if option.kind is SECONDS and value == float("inf"):
        raise ValueError("no limit is 0")
    if option.is_out_of_range(value):
        raise ValueError(f"'{text}' is not {wanted}")
    return value


def _read_mode(text: str) -> int:
    """Return the mode of a socket. Its owner must be able to use it, and nobody may execute it."""
    digits = 3 <= len(text) <= 4 and set(text) <= set("01234567")
    mode = int(text, 8) if digits else 0
    if mode & ~0o666 or mode & 0o600 != 0o600:
        raise ValueError(f"{text!r} is not a mode such as 0600 (mine alone), 0660 (my group's) or 0666")
    return mode


def _as_utf8(text: str) -> str:
    """Return a text from the command line, decoded as UTF-8 even if Python has used another encoding."""
    return text.encode(errors="surrogateescape").decode(errors="surrogateescape")


def _is_bad_byte(character: str) -> bool:
    """Return whether a character stands for a byte that isn't UTF-8. Python decodes such bytes to surrogates."""
    return "\udc80" <= character <= "\udcff"


def _format_byte(character: str) -> str:
    return f"0x{ord(character) - 0xDC00:02x}"


def replace_bad_bytes(text: str, line: int = 1) -> tuple[str, str | None]:
    """Replace each byte that isn't UTF-8 by U+FFFD. `line` is the number of the text's first line.

    Returns:
        The text, and a note about the bytes, or None if there are none.
    """
    if text.isascii():
        return text, None
    text = _as_utf8(text)
    found = [place for place, each in enumerate(text) if _is_bad_byte(each)]
    if not found:
        return text, None
    first = found[0]
    line += text.count("\n", 0, first)
    column = first - text.rfind("\n", 0, first)
    words = f"line {line}, column {column}: the byte {_format_byte(text[first])} is not UTF-8, and is not spoken"
    if len(found) > 1:
        words += f" (the first of {len(found):,})"
    # The engine treats U+FFFD as a space.
    return "".join("\ufffd" if _is_bad_byte(each) else each for each in text), words


def nearest(word: str, known: Iterable[str]) -> str | None:
    """Return the known word that was most likely meant, or None if none is similar."""
    import difflib

    by_name = {each.lower(): each for each in known}
    found = difflib.get_close_matches(word.lower(), by_name, n=1)
    return by_name[found[0]] if found else None
