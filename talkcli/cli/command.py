"""What a command is: one row, from which help, completion, the documents' tables and both readers of lines are made.

It knows no single command; those are in `commands`. It is imported before anything is sent, and knows no click.
"""

from __future__ import annotations

from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.goals.option import FLAG, PATH, Kind, Option

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from collections.abc import Set as AbstractSet
    from typing import Any

    from talkcli.cli.show import Common

    Codes = Mapping[int | str, str]
    #: What contradicts itself in the options that were given, their defaults included, and in those that were typed.
    Rule = Callable[[Mapping[str, Any], AbstractSet[str]], str | None]

#: A file that is to be written, and the mode of one.
FILE = Kind("string", (str,), "must be a string")
MODE = Kind("string", (str,), "must be a string", "MODE")

#: Exit codes of every command that asks the server for something; a command says more of those that mean more to it.
ASKING: Codes = {
    1: "anything not named here; a bug says so",
    2: "usage: what is wrong stands on standard error",
    3: "no server: nothing was sent, so it is safe to try again",
    5: "the server has as many clients as it takes",
    9: "this command and the server speak different versions of the protocol",
    10: "permission denied",
}
#: All of them, as the README's table has them; each command's help says which are its own.
ALL_EXIT_CODES: Codes = {
    0: "accepted; with --wait succeeded: all of it was played",
    1: "anything not named here; a bug says so, and TALK_DEBUG=1 where",
    2: "usage",
    3: "no server: nothing was sent, so it is safe to try again",
    4: "aborted: engine or audio failed, or nothing in the text can be spoken",
    5: "rejected: never queued",
    6: "recalled: taken out of the queue before it was spoken",
    7: "preempted: stopped while it was spoken",
    8: "unknown goal",
    9: "client and server speak different versions of the protocol",
    10: "permission denied",
    11: "the socket is served already, or its directory is not safe",
    12: "lost: it was sent, then the server went away; it may still be spoken",
    124: "timed out",
    "128+n": "ended by signal n; 141: standard output is closed, or its reader went away",
}


@frozen
class Argument:
    """What a command takes besides options."""

    name: str
    metavar: str
    #: whether it takes any number of words
    many: bool = False
    offers: str = ""
    #: the only values that there are; one of them must be given
    choices: tuple[str, ...] = ()


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
    argument: Argument | None = None
    #: whether it finds a place where a server is full
    urgent: bool = False
    #: what is said besides of an option that there isn't
    no_such_option: str = ""
    #: whether scripts call it all the time: a plain line of it is read without click
    plain: bool = False
    rule: Rule | None = None

    def fault(self, given: Mapping[str, Any], typed: AbstractSet[str]) -> str | None:
        """Return what is wrong with values that each can be read, for people, or None."""
        refused = (words for each in self.options if (words := each.refusal(given[each.name])))
        return next(refused, None) or (self.rule(given, typed) if self.rule else None)

    def carry_out(self, options: Common, given: Mapping[str, Any]) -> int | None:
        """Carry it out with what was given, and return the exit code; None for 0."""
        options.urgent = self.urgent
        module, _, name = self.runs.partition(":")
        run: Callable[..., int | None] = getattr(__import__(f"talkcli.cli.{module}", fromlist=[name]), name)
        return run(options, **given)


#: The options that may stand before and after every command.
COMMON = (
    Option(
        "socket",
        PATH,
        flags="--socket",
        help="Socket of the server.  [env var: TALK_SOCKET; default: the usual places, as 'talk doctor' lists]",
        offers="files",
    ),
    Option("json", FLAG, default=False, flags="--json", help="For programs: one JSON object a line; errors, too."),
    Option("quiet", FLAG, default=False, flags="-q, --quiet", help="No ids, no notes."),
)


def spelt(option: Option, value: object = None) -> str:
    """Return an option as it is typed, in its long form: the one that this value stands for."""
    forms = option.flags.split("/")
    return (forms[-1] if value is False else forms[0]).split(", ")[-1]
