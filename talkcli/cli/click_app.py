"""The commands as click has them, made from their rows: help, completion, errors, and every line that isn't plain.

What carries a command out is imported when it is run, so that no command pays for another.
"""

from __future__ import annotations

import _signal
import os
import re
from inspect import cleandoc
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from talkcli import __version__
from talkcli.cli.command import ALL_EXIT_CODES, COMMON, FILE, limits, nearest, read_value, spelt
from talkcli.cli.commands import COMMANDS
from talkcli.cli.show import Common, end_line, ended, note, show_error
from talkcli.errors import EXIT_ERROR, UsageError
from talkcli.goals.option import FLAG, INTEGER, NUMBER, SECONDS

if TYPE_CHECKING:
    from collections.abc import Callable

    from click.shell_completion import CompletionItem

    from talkcli.cli.command import Codes, Command
    from talkcli.goals.option import Option

_EXAMPLES = """
    talk serve &                      one server on the robot
    talk say --wait -- "battery low"  the exit code tells whether it was heard
    talk cancel                       silence, now
    talk doctor                       silent? what to do next
"""
#: What a command is called elsewhere, where that isn't near to its name here.
_ELSEWHERE = {
    "check": "doctor",
    "follow": "watch",
    "history": "log",
    "kill": "cancel",
    "queue": "status",
    "speak": "say",
    "start": "serve",
    "stop": "cancel",
    "unpause": "resume",
}


class _Value(click.FloatRange):
    """The value of an option, as `command` reads it. Of a number, help shows the limits; others have none."""

    def __init__(self, option: Option) -> None:
        self._option = option
        super().__init__(*option.limits, min_open=option.above)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        try:
            return read_value(self._option, str(value))
        except ValueError as error:
            if self._option.kind in (INTEGER, NUMBER, SECONDS):
                came_from = None  # click's own words say it
            elif ctx and ctx.get_parameter_source(self._option.name) is not ParameterSource.ENVIRONMENT:
                came_from = spelt(self._option)
            else:
                came_from = f"{self._option.env} in the environment"
            raise click.BadParameter(str(error), ctx, param, came_from) from error

    def _describe_range(self) -> str:
        return limits(self._option)


def _option(option: Option, *, common: bool = False) -> click.Option:
    flag = option.kind is FLAG
    return click.Option(
        [*option.flags.split(", "), option.name],
        type=None if flag else _type(option),
        is_flag=flag or None,
        default=option.default,
        show_default=not flag and option.default is not None,
        metavar=None if flag else option.metavar or option.kind.metavar,
        help=option.help,
        envvar=option.env or None,
        show_envvar=bool(option.env),
        shell_complete=_offering(option.offers),
        callback=_store if common else None,
        expose_value=not common,
    )


def _type(option: Option) -> Any:
    if option.choices:
        return click.Choice(option.choices)
    return click.Path(dir_okay=False) if option.kind is FILE else _Value(option)


def _argument(argument: Option) -> click.Argument:
    return click.Argument(
        [argument.name],
        nargs=-1 if argument.metavar.endswith("...") else 1,
        required=bool(argument.choices),
        type=click.Choice(argument.choices) if argument.choices else None,
        metavar=argument.metavar,
        shell_complete=_offering(argument.offers),
    )


def _offering(name: str) -> Callable[..., list[CompletionItem]] | None:
    """Return what offers values to a shell, "" for nothing: that of `completion` of this name, once a shell asks."""

    def offer(*arguments: Any) -> list[CompletionItem]:
        from talkcli.cli import completion

        found: list[CompletionItem] = getattr(completion, name)(*arguments)
        return found

    return offer if name else None


def _store(context: click.Context, parameter: click.Parameter, value: object) -> None:
    if value:
        setattr(context.ensure_object(Common), parameter.name or "", value)


class _Documented(click.Command):
    """Has the sections of our help: examples, its own options, those that all have, and exit codes."""

    examples: str
    exit_codes: Codes
    #: the heading of the options that all have
    shared = "Options of every command"

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Return what is offered, with as much help as a shell has room for: what stands before its first stop."""
        found = super().shell_complete(ctx, incomplete)
        for each in found:
            each.help = re.split(r"[.;](?:\s|$)", each.help or "", maxsplit=1)[0] + "."
        return found

    def format_help_text(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        super().format_help_text(ctx, formatter)
        with formatter.section("Examples"):
            _write_lines(self.examples, formatter)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        sections: dict[str, list[tuple[str, str]]] = {"Options": [], self.shared: []}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record and isinstance(parameter, click.Option):
                sections["Options" if parameter.expose_value else self.shared].append(record)
        for heading, records in sections.items():
            if records:
                with formatter.section(heading):
                    formatter.write_dl(records)

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        rows = sorted(self.exit_codes.items(), key=lambda row: row[0] if isinstance(row[0], int) else 128)
        with formatter.section("Exit codes"):
            formatter.write_dl([(str(code), words) for code, words in rows])


class ClickCommand(_Documented):
    """A command, as its row says."""

    def __init__(self, row: Command) -> None:
        self.row = row
        self.examples, self.exit_codes = row.examples, row.exit_codes
        arguments: list[click.Parameter] = [_argument(row.argument)] if row.argument else []
        own, shared = map(_option, row.options), [_option(each, common=True) for each in COMMON]
        super().__init__(
            row.name,
            params=[*arguments, *own, *shared],
            help=cleandoc(row.about),
            short_help=row.summary,
            callback=self._carry_out,
        )

    def _carry_out(self, **given: Any) -> int | None:
        context = click.get_current_context()
        options: Common = context.obj
        options.typed = {each for each in given if context.get_parameter_source(each) is ParameterSource.COMMANDLINE}
        fault = self.row.fault(given, options.typed, options.robot, options.socket, options.connect_timeout)
        if fault:
            raise click.UsageError(fault, context)
        return self.row.carry_out(options, given)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        ctx.allow_extra_args = True  # so that it is said here what is too much
        try:
            rest = super().parse_args(ctx, args)
        except click.UsageError as error:
            error.ctx = error.ctx or ctx  # the help to look at is this command's
            if isinstance(error, click.NoSuchOption) and self.row.no_such_option:
                words = _what_is_wrong(error)
                stop = "" if words.endswith("?") else "."
                raise click.UsageError(f"{words}{stop} {self.row.no_such_option}", ctx) from error
            raise
        if rest and not ctx.resilient_parsing:
            names = [each.make_metavar(ctx) for each in self.params if isinstance(each, click.Argument)]
            takes = f"nothing after {names[0]}" if names else "options alone"
            raise click.UsageError(f"'{ctx.command_path}' takes {takes}: what is '{' '.join(rest)}'?", ctx)
        return rest


class _Commands(_Documented, click.Group):
    """All of them: each is made of its row when it is needed."""

    examples, exit_codes = _EXAMPLES, ALL_EXIT_CODES
    shared = "Options, before or after the command"

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002
        return ClickCommand(COMMANDS[cmd_name]) if cmd_name in COMMANDS else None

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        unknown = args[0] not in COMMANDS and args[0][:1] not in ("", "-")
        if unknown and not ctx.resilient_parsing:  # a shell that asks for completion is told nothing
            raise click.UsageError(_unknown_command(args), ctx)
        return super().resolve_command(ctx, args)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        self.format_commands(ctx, formatter)
        super().format_options(ctx, formatter)


@click.group(
    cls=_Commands,
    invoke_without_command=True,
    subcommand_metavar="COMMAND [ARGS]...",
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    params=[_option(each, common=True) for each in COMMON],
)
@click.version_option(__version__, prog_name="talk", message="%(prog)s %(version)s")
@click.pass_context
def talk(context: click.Context) -> None:
    """Speech for robots: sentences that can be awaited, cancelled and preempted."""
    if context.invoked_subcommand is None:
        click.echo(_first_screen(context))


def _first_screen(context: click.Context) -> str:
    """Return what a newcomer needs first; with the prompt below it, it fits a terminal of 24 lines."""
    formatter = context.make_formatter()
    formatter.write(f"{talk.help}\n")
    with formatter.indentation():
        _write_lines(_EXAMPLES, formatter)
    talk.format_commands(context, formatter)
    formatter.write("'talk COMMAND --help' says more of each, 'talk --help' has the exit codes.")
    return formatter.getvalue()


def run(arguments: list[str]) -> int:
    """Run a command line, or answer a shell that asks for completion, and return the exit code."""
    # Whoever started this may ignore it, and then no process that is started here leaves an exit status.
    _signal.signal(_signal.SIGCHLD, _signal.SIG_DFL)
    options = Common()
    return _complete(options) if "_TALK_COMPLETE" in os.environ else ended(lambda: _main(arguments, options), options)


def _main(arguments: list[str], options: Common) -> object:
    try:
        with talk.make_context("talk", [*arguments], obj=options) as context:
            return talk.invoke(context)
    except click.exceptions.Exit as end:  # of help, and of the version
        return end.exit_code
    except KeyboardInterrupt:
        end_line()  # that the terminal has shown ^C on
        raise
    except click.ClickException as error:
        from talkcli.terminal.text import printable

        # The options may not have been read as far as --json when the error was found.
        json = options.json or "--json" in arguments
        words = printable(_what_is_wrong(error))  # what was typed may be text of somebody else's
        show_error(UsageError(words), json=json)
        if not json and "--help" not in words:
            found = getattr(error, "ctx", None)
            note(f"see '{found.command_path if found else 'talk'} --help'")
        return error.exit_code


def _complete(options: Common) -> int:
    """Answer a shell that asks for completion: what there is to offer, and never a word besides."""
    from talkcli.cli import completion

    completion.register()
    try:
        talk.main([], prog_name="talk", standalone_mode=False, obj=options)  # ends by itself
    except Exception:
        if os.environ.get("TALK_DEBUG"):
            raise
    return EXIT_ERROR


def _write_lines(text: str, formatter: click.HelpFormatter) -> None:
    """Write lines as they are, indented as the formatter is at this moment."""
    for line in text.strip().splitlines():
        formatter.write(f"{'':{formatter.current_indent}}{line.strip()}\n")


def _unknown_command(words: list[str]) -> str:
    """Return what is said of a command that there isn't: which was meant, or how to speak these words."""
    name = words[0]
    if name.lower() == "help":
        meant = next((each for each in words[1:] if each in COMMANDS), None)
        return f"no such command '{name}': write 'talk{f' {meant}' if meant else ''} --help'"
    near = _ELSEWHERE.get(name.lower()) or nearest(name, COMMANDS)
    return f"no such command '{name}': " + (
        f"did you mean '{near}'?" if near else f"to speak it, write: talk say {_quoted(' '.join(words))}"
    )


def _quoted(text: str) -> str:
    """Return a text as a shell takes it, in the quotes that people write where these do."""
    import shlex

    return shlex.quote(text) if any(each in text for each in '"$`\\!') else f'"{text}"'


def _what_is_wrong(error: click.ClickException) -> str:
    """Return what is wrong with a command line, without the next step."""
    if isinstance(error, click.NoSuchOption):
        # Without the dashes, which make any two of them alike.
        near = nearest(error.option_name.lstrip("-"), [each.lstrip("-") for each in error.possibilities or ()])
        return f"no such option '{error.option_name}'" + (f": did you mean '--{near}'?" if near else "")
    if isinstance(error, click.MissingParameter) and error.param and isinstance(error.param.type, click.Choice):
        return f"{error.param.metavar} is missing: one of {', '.join(error.param.type.choices)}"
    words = error.format_message().rstrip(".")
    if isinstance(error, click.BadParameter):
        option, colon, wrong = words.removeprefix("Invalid value for ").partition(": ")
        return option.replace("'", "") + colon + wrong
    return words if words[:2].isupper() else words[:1].lower() + words[1:]
