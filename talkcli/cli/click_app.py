"""The click version of the command line, generated from the table of commands.

It handles help, completion, errors and complex command lines.

A command's function is only imported when the command is run, so that no command has to load the imports of another.
"""

from __future__ import annotations

import os
import re
from inspect import cleandoc
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from talkcli import __version__
from talkcli.cli.command import ALL_EXIT_CODES, COMMON_OPTIONS, OUTPUT_FILE, long_flag, nearest, read_value
from talkcli.cli.commands import COMMANDS
from talkcli.cli.show import CommonOptions, note, run_command, show_error, write_error_line
from talkcli.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from click.shell_completion import CompletionItem

    from talkcli.cli.command import Command, ExitCodes
    from talkcli.goals.options import Option

_EXAMPLES = """
    talk serve &                      start the server
    talk say --wait -- "battery low"  speak; the exit code is the result
    talk doctor                       find out why nothing is heard
"""
#: Command names that users may know from other programs, with the equivalent commands of `talk`.
_FOREIGN_NAMES = {
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


_TIME_HELP = (
    "A TIME is a number with a unit: 500ms, 5s, 2m or 1h. Without a unit, it is in seconds, or in milliseconds for "
    "--lead-in."
)


class _OptionType(click.FloatRange):
    """The click type that parses and checks the value of an option.

    It is derived from a range type so that help shows the limits of numbers.
    """

    def __init__(self, option: Option) -> None:
        self._option = option
        super().__init__(*option.limits, min_open=option.excludes_minimum)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Parse the value of an option. Raise BadParameter if it is invalid."""
        try:
            return read_value(self._option, str(value))
        except ValueError as error:
            if int in self._option.kind.types:
                source = None  # click adds the option's name to the message
            elif ctx and ctx.get_parameter_source(self._option.name) is not ParameterSource.ENVIRONMENT:
                source = long_flag(self._option)
            else:
                source = f"environment variable {self._option.env}"
            raise click.BadParameter(str(error), ctx, param, source) from error

    def _describe_range(self) -> str:
        """Return the range of valid numbers as text for click's help."""
        return self._option.range + self._option.unit * bool(self._option.kind.time_unit)


def _make_click_option(option: Option, *, common: bool = False) -> click.Option:
    """Create a click option from an option's description.

    The value of a common option is stored in CommonOptions.
    """
    flag = not option.takes_argument
    value = option.flag_value or option.bare_value
    flag_value: dict[str, Any] = {"flag_value": value} if value else {}
    return click.Option(
        [*option.flags.split(", "), option.name],
        type=None if flag else _click_type(option),
        is_flag=flag if option.bare_value is None else False,
        **flag_value,
        default=option.default,
        show_default=not flag and option.default is not None,
        metavar=None if flag else option.metavar or option.kind.metavar or option.name.upper(),
        help=option.help,
        envvar=option.env or None,
        show_envvar=bool(option.env),
        shell_complete=_make_completer(option.completion),
        callback=_store_common if common else None,
        expose_value=not common,
    )


def _click_type(option: Option) -> Any:
    """Return the click type that checks and converts the values of an option."""
    if option.choices:
        return click.Choice(option.choices, case_sensitive=False)
    return click.Path(dir_okay=False) if option.kind is OUTPUT_FILE else _OptionType(option)


def _make_click_argument(argument: Option) -> click.Argument:
    """Create a click argument from the description of a positional argument."""
    return click.Argument(
        [argument.name],
        nargs=-1 if argument.metavar.endswith("...") else 1,
        required=bool(argument.choices),
        type=click.Choice(argument.choices) if argument.choices else None,
        metavar=argument.metavar,
        shell_complete=_make_completer(argument.completion),
    )


def _make_completer(completer_name: str) -> Callable[..., list[CompletionItem]] | None:
    """Return a function that click calls to complete values, or None if the name is empty."""

    def complete(context: click.Context, _: click.Parameter, incomplete: str) -> list[CompletionItem]:
        from talkcli.cli import completion

        return completion.complete(completer_name, context.find_root().obj, incomplete)

    return complete if completer_name else None


def _store_common(context: click.Context, parameter: click.Parameter, value: object) -> None:
    """Store the value of a common option in the context's CommonOptions."""
    if value:
        setattr(context.ensure_object(CommonOptions), parameter.name or "", value)


class _HelpfulCommand(click.Command):
    """A click command whose help includes examples and exit codes."""

    examples: str
    exit_codes: ExitCodes | None

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Return the completions, each with only the first sentence of its help text.

        A shell has no room for more.
        """
        found = super().shell_complete(ctx, incomplete)
        for each in found:
            each.help = re.split(r"[.;](?:\s|$)", each.help or "", maxsplit=1)[0] + "."
        return found

    def format_help_text(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the description of the command, followed by the examples."""
        super().format_help_text(ctx, formatter)
        with formatter.section("Examples"):
            _write_lines(self.examples, formatter)

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        """Write the table of exit codes, if there is one."""
        if self.exit_codes:
            with formatter.section("Exit codes"):
                formatter.write_dl([(str(code), words) for code, words in self.exit_codes.items()])

    def write_options(
        self, heading: str, parameters: Iterable[click.Parameter], ctx: click.Context, formatter: click.HelpFormatter
    ) -> None:
        """Write a section with the help texts of these options, if there are any."""
        records = [each.get_help_record(ctx) for each in parameters if isinstance(each, click.Option)]
        if records:
            with formatter.section(heading):
                formatter.write_dl([each for each in records if each])


class ClickCommand(_HelpfulCommand):
    """A click command generated from its entry in the table of commands."""

    def __init__(self, row: Command) -> None:
        self.row = row
        self.examples, self.exit_codes = row.examples, row.exit_codes
        arguments: list[click.Parameter] = [_make_click_argument(row.argument)] if row.argument else []
        own = map(_make_click_option, row.options)
        common = [_make_click_option(each, common=True) for each in COMMON_OPTIONS]
        super().__init__(
            row.name,
            params=[*arguments, *own, *common],
            help=cleandoc(row.description),
            short_help=row.summary,
            callback=self._run,
        )

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the help texts of the command's own options, without the common options."""
        self.write_options("Options", (each for each in self.params if each.expose_value), ctx, formatter)

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the table of exit codes and a reference to `talk --help`."""
        super().format_epilog(ctx, formatter)
        formatter.write("\nCommon options and exit codes: talk --help\n")

    def _run(self, **given: Any) -> int | None:
        """Check the options, and run the command. Return its exit code, if any.

        Raise a click.UsageError if its options can't be combined.
        """
        context = click.get_current_context()
        options: CommonOptions = context.obj
        source = context.get_parameter_source
        options.typed = frozenset(each for each in given if source(each) is ParameterSource.COMMANDLINE)
        fault = self.row.usage_fault(given, options.typed, vars(options))
        if fault:
            raise click.UsageError(fault, context)
        return self.row.run(options, given)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments, and raise a click.UsageError if there are too many."""
        ctx.allow_extra_args = True  # extra arguments are reported below
        try:
            rest = super().parse_args(ctx, args)
        except click.UsageError as error:
            error.ctx = error.ctx or ctx  # lets the error message refer to this command's help
            raise
        if rest and not ctx.resilient_parsing:
            takes = f"nothing after {self.row.argument.metavar.strip('[]')}" if self.row.argument else "no arguments"
            raise click.UsageError(f"'{ctx.command_path}' takes {takes} (got '{' '.join(rest)}')", ctx)
        return rest


class _CommandGroup(_HelpfulCommand, click.Group):
    """The group of all commands. Each command is created only when it is needed."""

    examples, exit_codes = _EXAMPLES, ALL_EXIT_CODES

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        """Return the names of all commands, in the order in which help lists them."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002
        """Create the command with this name. Return None if there is no such command."""
        return ClickCommand(COMMANDS[cmd_name]) if cmd_name in COMMANDS else None

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command in the arguments. Return its name, the command and the remaining arguments.

        Raise click.UsageError for an unknown command.
        """
        unknown = args[0] not in COMMANDS and args[0][:1] not in ("", "-")
        if unknown and not ctx.resilient_parsing:  # errors aren't shown during completion
            raise click.UsageError(_describe_unknown_command(args), ctx)
        return super().resolve_command(ctx, args)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of commands and the help of the common options."""
        self.format_commands(ctx, formatter)
        self.write_options("Common options, before or after the command", self.get_params(ctx), ctx, formatter)
        formatter.write_paragraph()
        formatter.write_text(_TIME_HELP)


@click.group(
    help="Make a robot speak. You can wait for sentences, cancel them and interrupt them.",
    cls=_CommandGroup,
    invoke_without_command=True,
    subcommand_metavar="COMMAND [ARGS]...",
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    params=[_make_click_option(each, common=True) for each in COMMON_OPTIONS],
)
@click.version_option(__version__, prog_name="talk", message="%(prog)s %(version)s")
@click.pass_context
def talk(context: click.Context) -> None:
    """Print an overview if `talk` is run without a command."""
    if context.invoked_subcommand is None:
        click.echo(_format_overview(context))


def _format_overview(context: click.Context) -> str:
    """Return the overview to print if `talk` is run without a command.

    It leaves room for the next shell prompt on a terminal with 24 lines.
    """
    formatter = context.make_formatter()
    formatter.write(f"{talk.help}\n")
    with formatter.indentation():
        _write_lines(_EXAMPLES, formatter)
    talk.format_commands(context, formatter)
    formatter.write("'talk COMMAND --help' explains a command, 'talk --help' lists the exit codes.")
    return formatter.getvalue()


def run(arguments: list[str]) -> int:
    """Run a command line, or print completions for the shell. Return the exit code."""
    options = CommonOptions()
    if "_TALK_COMPLETE" in os.environ:
        from talkcli.cli import completion

        return completion.print_completions(talk, options)
    return run_command(lambda: _run_group(arguments, options), options)


def _run_group(arguments: list[str], options: CommonOptions) -> object:
    """Run a command line with click, and report usage errors. Return the exit code, if any."""
    try:
        with talk.make_context("talk", [*arguments], obj=options) as context:
            return talk.invoke(context)
    except click.exceptions.Exit as end:  # click has printed the help or the version
        return end.exit_code
    except KeyboardInterrupt:
        write_error_line()  # start a new line after the ^C that the terminal has shown
        raise
    except click.ClickException as error:
        from talkcli.terminal.text import printable

        # The error may have occurred before --json was parsed.
        json = options.json or "--json" in arguments
        words = printable(_describe_error(error))  # arguments may contain control characters
        show_error(UsageError(words), json=json)
        if not json and "--help" not in words:
            found = getattr(error, "ctx", None)
            note(f"see '{found.command_path if found else 'talk'} --help'")
        return error.exit_code


def _write_lines(text: str, formatter: click.HelpFormatter) -> None:
    """Write the lines of a text, indented but not wrapped."""
    for line in text.strip().splitlines():
        formatter.write(f"{'':{formatter.current_indent}}{line.strip()}\n")


def _describe_unknown_command(words: list[str]) -> str:
    """Return the error message for an unknown command, with a suggestion."""
    name = words[0]
    if name.lower() == "help":
        meant = next((each for each in words[1:] if each in COMMANDS), None)
        return f"unknown command '{name}'; try 'talk{f' {meant}' if meant else ''} --help'"
    near = _FOREIGN_NAMES.get(name.lower()) or nearest(name, COMMANDS)
    return f"unknown command '{name}'; " + (
        f"did you mean '{near}'?" if near else f"to speak this text, type: talk say {_quote_for_shell(' '.join(words))}"
    )


def _quote_for_shell(text: str) -> str:
    """Quote a text for the shell, in double quotes if possible."""
    import shlex

    return shlex.quote(text) if any(each in text for each in '"$`\\!') else f'"{text}"'


def _describe_error(error: click.ClickException) -> str:
    """Return the message of a click error in the style of `talk`."""
    if isinstance(error, click.NoSuchOption):
        # Leading dashes would make unrelated options look similar.
        near = nearest(error.option_name.lstrip("-"), [each.lstrip("-") for each in error.possibilities or ()])
        words = f"unknown option '{error.option_name}'" + (f"; did you mean '--{near}'?" if near else "")
        command = error.ctx.command if error.ctx else None
        hint = command.row.unknown_option_hint if isinstance(command, ClickCommand) else ""
        stop = "." * (not near)
        return f"{words}{stop} {hint}" if hint else words
    if isinstance(error, click.MissingParameter) and error.param and isinstance(error.param.type, click.Choice):
        return f"{error.param.metavar} is missing; choose one of {', '.join(error.param.type.choices)}"
    words = error.format_message().rstrip(".")
    if isinstance(error, click.BadParameter):
        option, colon, wrong = words.removeprefix("Invalid value for ").partition(": ")
        return option.replace("'", "") + colon + wrong
    return words if words[:2].isupper() else words[:1].lower() + words[1:]
