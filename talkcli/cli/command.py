"""What a command is: one row, from which help, completion, the documents' tables and both readers of lines are made.

Besides, what the words of its line mean, read alike wherever they are read: the value of an option; a text, which may
hold bytes that are no UTF-8; and what was probably meant by a word that isn't known.

It knows no single command; those are in `commands`. Pure; it is imported before anything is sent, and knows no click.
"""

from __future__ import annotations

from talkcli.errors import UsageError
from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.goals.option import FLAG, ID, INTEGER, NUMBER, PATH, SECONDS, WORD, Kind, Option
from talkcli.paths import named_robot

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from collections.abc import Set as AbstractSet
    from typing import Any

    from talkcli.cli.show import Common

    Codes = Mapping[int | str, str]
    #: What contradicts itself in the options that were given, their defaults included, and in those that were typed.
    Rule = Callable[[Mapping[str, Any], AbstractSet[str]], str | None]

#: A file that is to be written, and the mode of one.
FILE = Kind("string", (str,), "must be a string")
MODE = Kind("string", (str,), "must be a string", "MODE")

#: Options that go with one robot, or with none, and not with several.
_OF_ONE = ("lines", "ahead", "feedback", "output")

#: Exit codes of every command that asks the server for something; a command says more of those that mean more to it.
ASKING: Codes = {
    1: "anything not named here; a bug says so",
    2: "usage: what is wrong stands on standard error",
    3: "no server: nothing was sent, so it is safe to try again",
    5: "the server has as many clients as it takes",
    9: "this command and the server speak different versions of the protocol",
    10: "permission denied",
    12: "lost: it was sent, then nothing more was heard; it may have an effect all the same",
}
#: … and of those that may ask several robots at once.
ASKING_SEVERAL: Codes = {**ASKING, 13: "robots differ: those that did not do it failed in more than one way"}
#: All of them, as the README's table has them; each command's help says which are its own.
ALL_EXIT_CODES: Codes = {
    **ASKING_SEVERAL,
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
    """A command."""

    name: str
    #: what it does, in the list of all
    summary: str
    #: what it does, in its help
    about: str
    #: the function that carries it out, "module:name": called with a `Common` and what was given, by name
    runs: str
    #: lines, each a command line
    examples: str
    #: what each exit code means after this command
    exit_codes: Codes
    options: tuple[Option, ...] = ()
    #: what it takes besides options; any number of words, where its metavar ends with dots
    argument: Option | None = None
    #: whether it finds a place where a server is full
    urgent: bool = False
    #: what is said besides of an option that there isn't
    no_such_option: str = ""
    #: whether a plain line of it is read without click: scripts call most of them all the time
    plain: bool = True
    #: whether it means a server, which may be a robot's of a fleet, and not this machine alone
    asks: bool = True
    #: whether it connects to one server, which it can wait for
    connects: bool = True
    #: the function that asks several robots at once, as `runs` one, without the options that don't go with that; ""
    #: where the command does not
    several: str = ""
    rule: Rule | None = None

    def fault(
        self,
        given: Mapping[str, Any],
        typed: AbstractSet[str],
        robot: str | None = None,
        socket: str | None = None,
        connect_timeout: float | None = None,
    ) -> str | None:
        """Return what is wrong with values that each can be read, for people, or None.

        `robot`, `socket`, `connect_timeout`: options of every command, as they were typed.
        """
        if robot is not None and (fault := self._stray(given, robot, socket)):
            return fault
        if connect_timeout is not None and (fault := self._waiting_fault(given, robot)):
            return fault
        refused = (words for each in self.options if (words := each.refusal(given[each.name])))
        return next(refused, None) or (self.rule(given, typed) if self.rule else None)

    def _stray(self, given: Mapping[str, Any], robot: str, socket: str | None) -> str | None:
        """Return what is wrong with naming a robot, or several, or None."""
        from talkcli.fleet.desk.selection import Selection, several

        if socket:
            return "--robot is a robot of a fleet, --socket a server of this machine: leave out one of them"
        if not self.asks or given.get("output") is not None:
            what = f"{self.name} --output" if self.asks else self.name
            return f"'talk {what}' is of this machine alone: leave out --robot"
        if several(robot):
            lone = [f"--{each}" for each in _OF_ONE if given.get(each)]
            if not self.several or lone:
                what = " ".join([self.name, *lone])
                return (
                    f"'talk {what}' is of one robot: name it; 'talk fleet status' and 'talk fleet watch' show several"
                )
        return Selection(robot).fault

    def _waiting_fault(self, given: Mapping[str, Any], robot: str | None) -> str | None:
        """Return what is wrong with waiting until the server can be reached, or None."""
        output = given.get("output") is not None
        if not (self.asks and self.connects) or output:
            return f"'talk {self.name}{' --output' * output}' does not wait for a server: leave out --connect-timeout"
        if robot is not None:
            from talkcli.fleet.desk.selection import several

            if several(robot):
                return "--connect-timeout waits for one robot: name it, or leave out --connect-timeout"
        return None

    def carry_out(self, options: Common, given: Mapping[str, Any]) -> int | None:
        """Carry it out with what was given, and return the exit code; None for 0."""
        options.urgent = self.urgent
        runs = self.runs
        robot = named_robot(options.robot, options.socket) if self.asks and given.get("output") is None else None
        if robot:
            fault = self._stray(given, robot, None)
            if fault is None and options.connect_timeout is not None:
                fault = self._waiting_fault(given, robot)
            if fault:
                raise UsageError(fault)
            from talkcli.fleet.desk.selection import several

            if several(robot):
                runs = self.several
                given = {name: value for name, value in given.items() if name not in _OF_ONE}
        module, _, name = runs.partition(":")
        run: Callable[..., int | None] = getattr(__import__(f"talkcli.cli.{module}", fromlist=[name]), name)
        return run(options, **given)


def option(flags: str, kind: Kind, words: str, **more: Any) -> Option:
    """Return an option of commands alone, named as its long form is; `words` is its help. A flag's default is no."""
    name = flags.rpartition("--")[2].replace("-", "_")
    return Option(name, kind, flags=flags, help=words, **{"default": False if kind is FLAG else None, **more})


#: The options that may stand before and after every command.
COMMON = (
    option(
        "--socket",
        PATH,
        "Socket of the server.  [env var: TALK_SOCKET; default: the usual places, as 'talk doctor' lists]",
        offers="files",
    ),
    option(
        "--robot",
        WORD,
        "A robot of a fleet, by its broker (TALK_BROKER); or several: a glob, @GROUP, @all.  [env var: TALK_ROBOT]",
        metavar="NAME",
        offers="robots",
    ),
    option(
        "--connect-timeout",
        NUMBER,
        "Keep trying to reach the server for SEC seconds; with --robot, until the robot is online.",
        limits=(0, None),
        above=True,
        metavar="SEC",
    ),
    option("--insecure", FLAG, "Send the password to the broker without TLS."),
    option("--json", FLAG, "For programs: one JSON object a line; errors, too."),
    option("-q, --quiet", FLAG, "No ids, no notes."),
)


def spelt(option: Option, value: object = None) -> str:
    """Return an option as it is typed, in its long form: the one that this value stands for."""
    forms = option.flags.split("/")
    return (forms[-1] if value is False else forms[0]).split(", ")[-1]


def read_value(option: Option, text: str) -> Any:
    """Return the value that a text stands for; ValueError, with what is wrong for people, where it stands for none."""
    kind = option.kind
    if kind in (INTEGER, NUMBER, SECONDS):
        return _number(option, text)
    if kind is MODE:
        return _mode(text)
    if kind in (WORD, ID):
        text = _decoded(text)
        unreadable = next(filter(_is_byte, text), None)
        if unreadable:
            raise ValueError(f"the byte {_byte(unreadable)} in it is not UTF-8")
    if not text and kind in (WORD, ID, PATH):  # it would select nothing
        raise ValueError("empty; is the variable set that it comes from?")
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


def _is_byte(character: str) -> bool:
    """Whether a character stands for a byte that is no UTF-8: from 0x80 on Python shows them so, as `_decoded` does."""
    return "\udc80" <= character <= "\udcff"


def _byte(character: str) -> str:
    return f"0x{ord(character) - 0xDC00:02x}"


def readable(text: str, line: int = 1) -> tuple[str, str | None]:
    """Return a text with U+FFFD for each byte that is no UTF-8, and what is said of them, if there are any.

    `line`: the number of its first line.
    """
    if text.isascii():
        return text, None
    text = _decoded(text)
    found = [place for place, each in enumerate(text) if _is_byte(each)]
    if not found:
        return text, None
    first = found[0]
    line += text.count("\n", 0, first)
    column = first - text.rfind("\n", 0, first)
    words = f"line {line}, column {column}: the byte {_byte(text[first])} is not UTF-8, and is not spoken"
    if len(found) > 1:
        words += f" (the first of {len(found):,})"
    return "".join("\ufffd" if _is_byte(each) else each for each in text), words  # the engine takes it for a blank


def nearest(word: str, known: Iterable[str]) -> str | None:
    """Return the one of these that was most likely meant, None where none is near."""
    import difflib

    by_name = {each.lower(): each for each in known}
    found = difflib.get_close_matches(word.lower(), by_name, n=1)
    return by_name[found[0]] if found else None
