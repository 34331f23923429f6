"""The data class that describes a command.

Help, completion, both parsers and the tables in the documentation are generated from these descriptions.

This module also parses option values, and texts that may contain invalid UTF-8. The commands themselves are in
`commands`. The module has no side effects and doesn't use click, because it is imported before a request is sent.
"""

from __future__ import annotations

from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.goals.options import FLAG, ID, MOMENT, PATH, SECONDS, SENDER_NAME, WORD, Kind, Option
from talkcli.paths import named_robot

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from typing import Any

    from talkcli.cli.show import CommonOptions

    ExitCodes = Mapping[int | str, str]
    #: A function that returns an error message if options can't be combined. It receives the values of all options by
    #: name, and the names of the options that were given.
    Rule = Callable[[Mapping[str, Any], frozenset[str]], str | None]

#: The path of an output file.
OUTPUT_FILE = Kind("string", (str,), "must be a string")
#: File permissions in octal.
FILE_MODE = Kind("string", (str,), "must be a string", "MODE")
#: How many seconds a command waits. The time may be infinite.
TIME_LIMIT = Kind("number", (int, float), "must be a number", "TIME", time_unit="s")

#: The units of time that can follow a number, with their lengths in milliseconds.
_TIME_UNITS_MS = {"ms": 1, "s": 1_000, "m": 60_000, "h": 3_600_000}
#: Error messages for a value that is not a time, by the unit of the option.
_NOT_A_TIME = {
    "s": "must be a time such as 5s, 500ms, 2m or 1h",
    "ms": "must be a time in whole milliseconds, such as 300ms or 0.3s",
}

#: Words for a day, with the number of days before today. An empty word means today.
_DAYS_AGO = {"": 0, "today": 0, "yesterday": 1}
#: Options that can't be used with several robots.
_SINGLE_ROBOT_OPTIONS = ("lines", "ahead", "stream", "feedback", "output", "list", "pronounce", "dry_run")

#: All exit codes, for `talk --help`. The help of some commands describes them more specifically.
ALL_EXIT_CODES: ExitCodes = {
    0: "the goal was accepted; with --wait: it was played to the end",
    1: "any other error; if it is a bug in talk, TALK_DEBUG=1 prints a traceback",
    2: "wrong usage",
    3: "no server, no broker, or the robot is offline; nothing was spoken, so you can try again",
    4: "aborted: the engine or the sound failed, or the text is incomplete or can't be spoken",
    5: "rejected: the goal was never queued (bad text, full queue, too many clients)",
    6: "recalled: the goal was removed from the queue before it was spoken",
    7: "preempted: the goal was stopped while it was being spoken",
    8: "unknown goal",
    9: "the server's version is incompatible with this client",
    10: "permission denied",
    11: "serve: the socket is in use or its directory isn't safe; bridge: another robot has this name",
    12: "lost: the connection was lost after the goal was sent, so it may still be spoken",
    13: "several robots failed with different exit codes",
    124: "timed out",
    "128+n": "ended by signal n; 141 means that standard output was closed",
}


@frozen
class Command:
    """The description of a command: its options, help texts, exit codes and functions."""

    name: str
    #: a one-line summary for the list of commands
    summary: str
    #: the description to show in the command's help
    description: str
    #: example command lines, one per line
    examples: str
    #: the function that runs the command, as "module:name". If empty, the function in `ask` with the command's name is
    #: used. Its arguments are the common options and the command's own.
    function: str = ""
    options: tuple[Option, ...] = ()
    #: the positional argument, which takes any number of words if its metavar ends with "..."
    argument: Option | None = None
    #: whether the command may connect even if the server has reached its client limit
    urgent: bool = False
    #: a hint to add to the error message for an unknown option
    unknown_option_hint: str = ""
    #: whether the command uses a server, on this machine or on a robot of a fleet
    uses_server: bool = True
    #: whether --connect-timeout can be used with the command
    connects: bool = True
    #: the function that sends the command to several robots, as "module:name"
    fleet_function: str = ""
    #: the function that checks which options can be combined
    rule: Rule | None = None
    #: the exit codes to show in the help, with their meanings
    exit_codes: ExitCodes | None = None

    def usage_fault(self, values: Mapping[str, Any], typed: frozenset[str], common: Mapping[str, Any]) -> str | None:
        """Return an error message if the options are invalid or can't be combined.

        Args:
            values: the values of the command's own options and of its argument, by name.
            typed: the names of the options on the command line.
            common: the values of the common options on the command line, by name.
        """
        robot, socket, connect_timeout = (common.get(each) for each in ("robot", "socket", "connect_timeout"))
        if robot is not None and socket:
            return "--robot and --socket can't be combined; leave out one of them"
        is_local = self._runs_without_server(values)
        local_name = f"{self.name}{' --output' * (values.get('output') is not None)}"
        if is_local and robot is not None:
            return f"'talk {local_name}' only works on this machine; leave out --robot"
        if connect_timeout is not None and (is_local or not self.connects):
            return f"'talk {local_name}' does not wait for a server; leave out --connect-timeout"
        robot = None if is_local else named_robot(robot, socket)
        if robot and (fault := self._robot_fault(robot, values, connect_timeout)):
            return fault
        for each in self.options:
            if fault := each.value_error(values[each.name]):
                return fault
        return self.rule(values, typed) if self.rule else None

    def _runs_without_server(self, values: Mapping[str, Any]) -> bool:
        """Return whether the command runs without a server, as `talk say --output` does."""
        return not self.uses_server or values.get("output") is not None

    def _robot_fault(self, selection: str, values: Mapping[str, Any], connect_timeout: float | None) -> str | None:
        """Return an error message if the command can't be sent to the selected robots."""
        from talkcli.fleet.desk.request import Selection, selects_several

        if values.get("while_connected"):
            return "--while only works on this machine, because a broker can't tell when a program ends; use --for"
        if selects_several(selection):
            single = [f"--{each.replace('_', '-')}" for each in _SINGLE_ROBOT_OPTIONS if values.get(each)]
            if single or not self.fleet_function:
                what = " ".join([self.name, *single])
                return f"'talk {what}' only works with one robot; name it, or try 'talk fleet status' for several"
            if connect_timeout is not None:
                return "--connect-timeout only works with one robot; name it, or leave out --connect-timeout"
        return Selection(selection).fault

    def run(self, options: CommonOptions, values: Mapping[str, Any]) -> int | None:
        """Run the command on this machine or on robots. Return its exit code, if any."""
        options.urgent = self.urgent
        function = self.function or f"ask:{self.name}"
        robot = None if self._runs_without_server(values) else named_robot(options.robot, options.socket)
        if robot:
            from talkcli.fleet.desk.request import selects_several

            if selects_several(robot):
                function = self.fleet_function
                values = {name: value for name, value in values.items() if name not in _SINGLE_ROBOT_OPTIONS}
        module, _, name = function.partition(":")
        run: Callable[..., int | None] = getattr(__import__(f"talkcli.cli.{module}", fromlist=[name]), name)
        return run(options, **values)


def option(flags: str, kind: Kind, help_text: str, **more: Any) -> Option:
    """Create an option that is named after its long flag.

    Args:
        flags: the option's flags, as click expects them.
        kind: the type of its values.
        help_text: its help text.
        more: further fields of `Option`.
    """
    name = flags.rpartition("--")[2].replace("-", "_")
    default = False if kind is FLAG else None
    return Option(name, kind, special_flags=flags, help=help_text, **{"default": default, **more})


#: The options that every command accepts, before or after the command's name.
COMMON_OPTIONS = (
    option(
        "--socket",
        PATH,
        "Set the path of the server's socket.  [env var: TALK_SOCKET; default: the usual places, see 'talk doctor']",
        completion="files",
    ),
    option(
        "--robot",
        WORD,
        "Use this robot through the broker TALK_BROKER. A pattern, @GROUP or @all selects several robots.  "
        "[env var: TALK_ROBOT]",
        metavar="NAME",
        completion="robots",
    ),
    option(
        "--connect-timeout",
        TIME_LIMIT,
        "Keep trying to reach the server for TIME, such as 10s. With --robot, also wait until the robot is online.",
        limits=(0, None),
        excludes_minimum=True,
    ),
    option("--insecure", FLAG, "Send the password to the broker without TLS."),
    option("--json", FLAG, "Print results and errors as JSON objects, one per line."),
    option("-q, --quiet", FLAG, "Print no ids, notes or results of goals."),
)


def long_flag(option: Option, value: object = None) -> str:
    """Return an option's long flag, such as --preempt, or its negative form if `value` is False."""
    forms = option.flags.split("/")
    return (forms[-1] if value is False else forms[0]).split(", ")[-1]


def read_value(option: Option, text: str) -> Any:
    """Convert the text of an option to its value. Raise ValueError if it is invalid.

    The error message says why.
    """
    kind = option.kind
    if kind is MOMENT:
        return _parse_moment(text)
    if int in kind.types:
        return _parse_number(option, text)
    if kind is FILE_MODE:
        return _parse_file_mode(text)
    if kind in (WORD, ID, SENDER_NAME):
        text = _as_utf8(text)
        bad = next(filter(_is_bad_byte, text), None)
        if bad:
            raise ValueError(f"the byte {_format_byte(bad)} is not valid UTF-8")
    if option.choices and text not in option.choices:
        raise ValueError(f"must be one of {', '.join(option.choices)}, got '{text}'")
    if not text and kind in (WORD, ID, PATH, SENDER_NAME):  # an empty value usually comes from an unset variable
        raise ValueError("must not be empty; check the variable that should contain the value")
    return text


def _parse_number(option: Option, text: str) -> float:
    """Parse a number or a duration for this option. Raise ValueError if it is invalid."""
    unit, whole = option.kind.time_unit, float not in option.kind.types
    wanted = _NOT_A_TIME.get(unit) or f"must be a {'whole ' * whole}number"
    try:
        if unit and text.endswith(("h", "m", "s")):
            value = _parse_duration(text, unit)
        else:
            value = int(text) if whole else float(text)
        if value != value or (whole and value != int(value)):  # NaN is the only value that differs from itself
            raise ValueError
    except (LookupError, OverflowError, ValueError):
        raise ValueError(f"{wanted}, got '{text}'") from None
    if option.kind is SECONDS and value == float("inf"):
        raise ValueError("must not be infinite; 0 means no limit")
    if option.is_out_of_range(value):
        raise ValueError(f"must be {option.range}{option.unit}, got {text}")
    return int(value) if whole else value


def _parse_duration(text: str, unit: str) -> float:
    """Convert a duration such as 2m to this unit. Raise LookupError or ValueError if it is malformed."""
    number = text.rstrip("hms")
    return round(float(number) * _TIME_UNITS_MS[text[len(number) :]] / _TIME_UNITS_MS[unit], 6)


def _parse_moment(text: str) -> float:
    """Convert a local date or time, or a duration before now, to seconds since 1970.

    Raises:
        ValueError: the text is malformed.
    """
    from datetime import datetime, timedelta  # rarely needed, and slow to import

    now = datetime.now()
    day, _, clock = text.rpartition(" ") if ":" in text else (text or "?", "", "00:00")
    try:
        if text.endswith(("h", "m", "s")):
            # Without a time zone, the difference would be wrong if daylight saving time has begun or ended since then.
            return (now.astimezone() - timedelta(seconds=_parse_duration(text, "s"))).timestamp()
        date = now - timedelta(_DAYS_AGO[day]) if day in _DAYS_AGO else datetime.strptime(day, "%Y-%m-%d")
        time = datetime.strptime(clock, "%H:%M:%S" if clock.count(":") > 1 else "%H:%M").time()
        return datetime.combine(date, time).timestamp()
    except (LookupError, OverflowError, ValueError):
        words = f"must be a time such as 2h, 14:00, yesterday or '2026-11-24 14:00', got '{text}'"
        raise ValueError(words) from None


def _parse_file_mode(text: str) -> int:
    """Parse an octal file mode. Raise ValueError if it is invalid or unsuitable for a socket.

    The owner must be able to read and write, and nobody may have execute permission.
    """
    digits = 3 <= len(text) <= 4 and set(text) <= set("01234567")
    mode = int(text, 8) if digits else 0
    if mode & ~0o666 or mode & 0o600 != 0o600:
        raise ValueError(f"must be a mode such as 0600 (only you), 0660 (your group) or 0666 (everybody), got {text!r}")
    return mode


def _as_utf8(text: str) -> str:
    """Decode a command-line argument as UTF-8, even if Python has used another encoding."""
    return text.encode(errors="surrogateescape").decode(errors="surrogateescape")


def _is_bad_byte(character: str) -> bool:
    """Return whether a character is a surrogate that represents an invalid byte."""
    return "\udc80" <= character <= "\udcff"


def _format_byte(character: str) -> str:
    """Format the invalid byte that a surrogate represents, such as 0xff."""
    return f"0x{ord(character) - 0xDC00:02x}"


def replace_bad_bytes(text: str, first_line_number: int = 1) -> tuple[str, str | None]:
    """Replace invalid bytes in a text with U+FFFD. Return the text, and a message if there were any.

    Args:
        text: the text, with invalid bytes decoded to surrogates.
        first_line_number: the number of the text's first line.

    Returns:
        The text and the message. The message is None if all bytes were valid.
    """
    if text.isascii():
        return text, None
    text = _as_utf8(text)
    found = [place for place, each in enumerate(text) if _is_bad_byte(each)]
    if not found:
        return text, None
    first = found[0]
    line = first_line_number + text.count("\n", 0, first)
    column = first - text.rfind("\n", 0, first)
    words = f"line {line}, column {column}: the byte {_format_byte(text[first])} is not valid UTF-8 and is skipped"
    if len(found) > 1:
        words += f" ({len(found) - 1:,} more like it)"
    # The engine treats the replacement character U+FFFD as a space.
    return "".join("\ufffd" if _is_bad_byte(each) else each for each in text), words


def nearest(word: str, known: Iterable[str]) -> str | None:
    """Return the closest match among the known words, if there is one."""
    import difflib

    by_name = {each.lower(): each for each in known}
    found = difflib.get_close_matches(word.lower(), by_name, n=1)
    return by_name[found[0]] if found else None
