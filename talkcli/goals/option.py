"""What an option is: one row, of a goal's options or of a command's, from which all that is said of it is made.

Two things may be wrong with a value: its form (`fault`: a request with it is an error, nothing is done), and that there
is no such value (`refusal`: a goal with it is REJECTED).

It knows no single option; those of goals and servers are in `options`, those of a command beside it. A client imports
it before it sends anything, so it imports nothing heavy.
"""

from __future__ import annotations

from talkcli.frozen import TYPE_CHECKING, frozen, replace

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any

    from talkcli.goals.goal import JsonObject

#: An id is at most this long; a longer one names no goal that could exist.
MAX_ID = 64
#: Ids in one request; more would not fit into a line anyway.
MAX_IDS = 4096
#: What a sender calls itself is shown on one line of a terminal.
MAX_NAME = 64
#: `data` that travels with a goal, in bytes of JSON: a label for programs, not something that the server has to store.
MAX_DATA = 1024
#: Goals that one request for the log asks for: as many as are kept.
MAX_LOG = 2_200
_DIGITS = frozenset("0123456789")
_LETTERS = frozenset("abcdefghijklmnopqrstuvwxyz")
_OF_AN_ID = _DIGITS | _LETTERS | frozenset("ABCDEFGHIJKLMNOPQRSTUVWXYZ._:/-")
#: sys.float_info.max: NaN is no number of seconds, nor is an integer that is past every float.
_LARGEST = 1.7976931348623157e308


@frozen
class Kind:
    """A kind of value."""

    #: as the wire's table has it
    name: str
    types: tuple[type, ...]
    #: what is said of a value of another type
    wrong: str
    #: what stands for the value in help
    metavar: str = ""
    #: what is wrong with a value of these types wherever it stands, for people, or None
    fault: Callable[[Any], str | None] | None = None


def _bad_id(value: str) -> str | None:
    return None if 0 < len(value) <= MAX_ID else f"must be an id of 1 to {MAX_ID} characters"


def is_clients_id(goal_id: str) -> bool:
    """Whether this is an id as a client may choose it: no server ever gives one of this form."""
    if not (0 < len(goal_id) <= MAX_ID and _OF_AN_ID.issuperset(goal_id)) or goal_id[0] == "-":
        return False
    boot, dash, number = goal_id.partition("-")
    if not dash:
        return not _DIGITS.issuperset(goal_id)
    # A boot id and a number. Digits first and third: so nobody names a goal (`goal-1`, `2024-12`).
    servers = len(boot) == 4 and _DIGITS.issuperset(boot[::2]) and _LETTERS.issuperset(boot[1::2])
    return not (servers and number and _DIGITS.issuperset(number))


def _bad_ids(value: list[object]) -> str | None:
    if len(value) > MAX_IDS:
        return IDS.wrong
    return next((words for each in value if (words := _bad_id(each) if isinstance(each, str) else ID.wrong)), None)


def _bad_data(value: JsonObject) -> str | None:
    import json

    try:
        return None if len(json.dumps(value)) <= MAX_DATA else DATA.wrong
    except RecursionError:
        return DATA.wrong


def figure(value: object) -> str:
    """Return a value for people: a number has at most four decimals."""
    return f"{round(value, 4):.12g}" if isinstance(value, float) else str(value)


FLAG = Kind("boolean", (bool,), "must be true or false")
TEXT = Kind("string", (str,), "must be a string", "TEXT")
#: a text that names something: on a command line it is never empty, and it is UTF-8
WORD = Kind("string", (str,), "must be a string")
#: a file or a socket by its path, which may be any bytes but not empty
PATH = Kind("string", (str,), "must be a string", "PATH")
INTEGER = Kind("integer", (int,), "must be an integer", "N")
NUMBER = Kind("number", (int, float), "must be a number", "X")
#: a length of time from 0 on
SECONDS = Kind("number", (int, float), "must be a number", "SEC")
DATA = Kind("object", (dict,), f"must be an object of at most {MAX_DATA} bytes", fault=_bad_data)
ID = Kind("id", (str,), "must be a string", "ID", _bad_id)
IDS = Kind("list", (list, tuple), f"must be a list of at most {MAX_IDS} ids", "[ID]...", _bad_ids)


@frozen
class Setting:
    """The server's own value of an option, for goals that bring none."""

    initial: Any
    #: the value that is shown as null: there is none
    none: Any = None
    #: what `set` on the wire makes of it, where that isn't what the option means
    meaning: str = ""
    #: help of `talk set` and of `talk serve`, where they don't say what `talk say` does; the spellings for `talk set`
    to_set: str = ""
    at_start: str = ""
    flags: str = ""
    #: how people are told its value, and that there is none
    told: str = ""
    told_none: str = ""


@frozen
class Option:
    """An option, of a goal or of a command: what it is called, what it may be, what is said of it."""

    name: str
    kind: Kind
    #: what it means on the wire; this, `form` and `absent` are for documents alone
    meaning: str = ""
    #: what it is where it isn't given; where that is None, a request may have null, too
    default: Any = None
    #: the least and the most that it may be; None for no limit
    limits: tuple[float | None, float | None] = (None, None)
    #: whether it must be more than the least
    above: bool = False
    unit: str = ""
    #: the only values that there are
    choices: tuple[str, ...] = ()
    #: what else is wrong with its value, for people, or None
    refuses: Callable[[Any], str | None] | None = None
    #: what its value may be besides; what holds where it isn't given
    form: str = ""
    absent: str = ""
    #: spellings on a command line, "-w, --wait"; the first for yes, the second for no: "--preempt/--queue"
    flags: str = ""
    metavar: str = ""
    help: str = ""
    #: the variable of the environment that stands for it
    env: str = ""
    #: what a shell offers for its value: a function of `cli.completion`
    offers: str = ""
    #: what it is for a server, where one has a value of its own for it
    setting: Setting | None = None
    #: whether the engine is told; whether a goal shows it
    engine: bool = False
    shown: bool = False

    def fault(self, value: Any) -> str | None:
        """Return what is wrong with the form of a value, as in "'rate' of say must be an integer", or None."""
        if value is None and self.default is None:
            return None
        kind = self.kind
        if not isinstance(value, kind.types) or (isinstance(value, bool) and kind is not FLAG):
            return kind.wrong
        return kind.fault(value) if kind.fault else None

    def outside(self, value: float) -> bool:
        """Whether a number is not within the limits."""
        low, high = self.limits
        if self.kind is SECONDS and high is None:
            high = _LARGEST
        # Written so that NaN, which compares with nothing, is outside.
        above = low is None or (value > low if self.above else value >= low)
        return not (above and (high is None or value <= high))

    def refusal(self, value: Any) -> str | None:
        """Return why a value of the right form can't be had, for people, or None."""
        if value is None:
            return None
        if self.limits != (None, None) and self.outside(value):
            wanted = "no number of seconds" if self.kind is SECONDS else "not"
            wanted = wanted if self.limits[1] is None else "not within"
            return f"the {self.name} {value} is {wanted} {self.range}{self.unit}"
        return self.refuses(value) if self.refuses else None

    def to_set(self) -> Option:
        """Return a setting as `talk set` takes it: without a default, as what isn't given stays."""
        setting = self.setting
        assert setting
        return replace(self, env="", flags=setting.flags or self.flags, help=setting.to_set or self.help)

    def at_start(self) -> Option:
        """Return a setting as `talk serve` takes it."""
        setting = self.setting
        assert setting
        flags = (setting.flags or self.flags).split("/")[0]
        return replace(self, default=setting.initial, flags=flags, help=setting.at_start or self.help)

    @property
    def range(self) -> str:
        """The limits in words, "" where there are none."""
        low, high = self.limits
        if low is None:
            return ""
        if high is not None:
            return f"{low:g} to {high:g}"
        return f"above {low:g}" if self.above else f"from {low:g} on"
