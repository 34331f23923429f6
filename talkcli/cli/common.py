"""What the commands share in their declaration for click: options before and after the command, checks of values."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, TypeVar

import click
from click.core import ParameterSource

from talkcli.cli import complete
from talkcli.cli.show import Common
from talkcli.cli.usage import Command, Number
from talkcli.cli.utf8 import decoded, unreadable

if TYPE_CHECKING:
    from collections.abc import Callable

    from talkcli.cli.usage import Codes

_F = TypeVar("_F", bound="Callable[..., Any]")


def talk_command(
    name: str, *, examples: str, exit_codes: Codes, cls: type[Command] = Command
) -> Callable[[Callable[..., Any]], Command]:
    """Make a command of a function: its docstring says what it is for. See `Command` for the rest."""
    return click.command(name, cls=cls, examples=examples, exit_codes=exit_codes)


def common(context: click.Context) -> Common:
    """Return the options that hold for this run of the command."""
    return context.find_root().ensure_object(Common)


def _store(context: click.Context, parameter: click.Parameter, value: object) -> None:
    if value == "":
        raise _wrong(_EMPTY, context, parameter)
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
                help="Socket of the server.  [env var: TALK_SOCKET; default: the usual places, as 'talk doctor' lists]",
            ),
            click.option(
                "--json",
                is_flag=True,
                expose_value=False,
                callback=_store,
                help="For programs: one JSON object a line; errors, too.",
            ),
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
        raise click.BadParameter(f"{value!r} is not a number", context, parameter)
    return value


def seconds(context: click.Context, parameter: click.Parameter, value: float | None) -> float | None:
    """Refuse what is no length of time: NaN, and infinity, for which there is another word: no limit is 0."""
    if value is not None and math.isinf(value):
        raise click.BadParameter("no limit is 0", context, parameter)
    return number(context, parameter, value)


#: What is said of an empty word: it comes from a variable that isn't set, and selects nothing.
_EMPTY = "empty; is the variable set that it comes from?"


def word(context: click.Context, parameter: click.Parameter, value: str | None) -> str | None:
    """Refuse an empty word, and bytes that are no UTF-8: others would be shown what they can't read."""
    if value is None:
        return None
    value = decoded(value)
    if not value:
        raise _wrong(_EMPTY, context, parameter)
    byte = unreadable(value)
    if byte is not None:
        raise _wrong(f"the byte 0x{byte:02x} in it is not UTF-8", context, parameter)
    return value


def _wrong(words: str, context: click.Context, parameter: click.Parameter) -> click.BadParameter:
    """Return the error that names where the value came from: the option, or a variable instead of it."""
    source = context.get_parameter_source(parameter.name or "")
    named = f"{parameter.envvar} in the environment" if source is ParameterSource.ENVIRONMENT else parameter.opts[-1]
    return click.BadParameter(words, context, parameter, named)


def timeout_option(words: str) -> Callable[[_F], _F]:
    """Return the option --timeout; `words` is its help: what the command does when the time is over."""
    above_zero = Number(0, min_open=True)
    return click.option("-t", "--timeout", type=above_zero, callback=number, metavar="SEC", help=words)
