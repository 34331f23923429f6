"""What all commands share: the options before and after the command, how they print, how they connect."""

from __future__ import annotations

import math
import os
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import click

from talkcli import wire
from talkcli.cli import complete

if TYPE_CHECKING:
    from collections.abc import Callable

    from talkcli.client import Client
    from talkcli.columns import Screen
    from talkcli.errors import TalkError
    from talkcli.messages import JsonObject

#: Columns of a terminal that doesn't say how many it has.
_USUAL_WIDTH = 80

_F = TypeVar("_F", bound="Callable[..., Any]")


@dataclass(slots=True)
class Common:
    """The options that every command has."""

    socket: str | None = None
    json: bool = False
    quiet: bool = False

    def connect(self, **options: Any) -> Client:
        """Return a client connected to the server; see `Client` for the options."""
        from talkcli.client import Client

        return Client(self.socket, **options)


def common(context: click.Context) -> Common:
    """Return the options that hold for this run of the command."""
    return context.find_root().ensure_object(Common)


def _store(context: click.Context, parameter: click.Parameter, value: object) -> None:
    if value:
        setattr(common(context), parameter.name or "", value)


def common_options(command: _F) -> _F:
    """Add the options that may stand before and after a command."""
    for option in reversed(
        (
            click.option(
                "--socket",
                metavar="PATH",
                expose_value=False,
                callback=_store,
                shell_complete=complete.files,
                help="Socket of the server. [env: TALK_SOCKET; default: the usual places, see the README]",
            ),
            click.option("--json", is_flag=True, expose_value=False, callback=_store, help="One JSON object a line."),
            click.option(
                "-q",
                "--quiet",
                is_flag=True,
                expose_value=False,
                callback=_store,
                help="No ids, no notes.",
            ),
        )
    ):
        command = option(command)
    return command


def number(context: click.Context, parameter: click.Parameter, value: float | None) -> float | None:
    """Refuse NaN, which compares with nothing and so is in any range."""
    if value is not None and math.isnan(value):
        raise click.BadParameter(f"{value!r} is not a number.", context, parameter)
    return value


def seconds(context: click.Context, parameter: click.Parameter, value: float | None) -> float | None:
    """Refuse what is no length of time: NaN, and infinity, for which there is another word: no limit is 0."""
    if value is not None and math.isinf(value):
        raise click.BadParameter("no limit is 0.", context, parameter)
    return number(context, parameter, value)


def filled(context: click.Context, parameter: click.Parameter, value: str | None) -> str | None:
    """Refuse an empty word: it comes from a variable that isn't set, and selects nothing."""
    if value == "":
        raise click.BadParameter("is empty: is the variable set that it comes from?", context, parameter)
    return value


def timeout_option(words: str) -> Callable[[_F], _F]:
    """Return the option --timeout; `words` is its help: what the command does when the time is over."""
    above_zero = click.FloatRange(0, min_open=True)
    return click.option("-t", "--timeout", type=above_zero, callback=number, metavar="SEC", help=words)


def show(line: str) -> None:
    """Write a line of data to standard output, at once; BrokenPipeError where that is closed."""
    if sys.stdout is None:
        raise BrokenPipeError("standard output is closed")
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def show_json(message: JsonObject) -> None:
    """Write an object as a line of JSON, in UTF-8 whatever the locale is; BrokenPipeError as `show`."""
    if sys.stdout is None:
        raise BrokenPipeError("standard output is closed")
    sys.stdout.flush()
    sys.stdout.buffer.write(wire.encode(message))
    sys.stdout.buffer.flush()


def note(words: str) -> None:
    """Write something for people to standard error."""
    click.echo(f"talk: {words}", err=True)


def show_error(error: TalkError, *, json: bool) -> None:
    """Write an error to standard error."""
    if json:
        fields = {"code": error.code, "exit": error.exit_code, "message": error.message}
        click.echo(wire.encode({"error": fields}), err=True, nl=False)
    else:
        note(error.message)


def colourful() -> bool:
    """Whether standard output takes colour."""
    return sys.stdout.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"


def screen() -> Screen:
    """Return what standard output is at this moment: how wide, if it is a terminal, and whether it takes colour."""
    from talkcli.columns import Screen

    if sys.stdout is None or not sys.stdout.isatty():
        return Screen()
    # The terminal first: a COLUMNS that a shell once exported knows nothing of a window that was resized.
    try:
        width = os.get_terminal_size(sys.stdout.fileno()).columns
    except OSError:
        width = 0
    if not width:
        told = os.environ.get("COLUMNS", "")
        width = int(told) if told.isascii() and told.isdecimal() else 0
    return Screen(width or _USUAL_WIDTH, colourful())
