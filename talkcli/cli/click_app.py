"""The commands as click has them, made from their rows: help, completion, errors, and every line that isn't plain.

What carries a command out is imported when it is run, so that no command pays for another.
"""

from __future__ import annotations

import os
import re
from inspect import cleandoc
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from talkcli import __version__
from talkcli.cli.command import ALL_EXIT_CODES, COMMON, FILE, limits, nearest, read_value, spelt
from talkcli.cli.commands import COMMANDS
from talkcli.cli.show import Common, OutputClosed, ended, note, show_error
from talkcli.errors import EXIT_ERROR, EXIT_SIGINT, UsageError
from talkcli.goals.option import FLAG, INTEGER, NUMBER, SECONDS

if TYPE_CHECKING:
    from collections.abc import Callable

    from click.shell_completion import CompletionItem

    from talkcli.cli.command import Argument, Codes, Command
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


class _Value(click.ParamType):  # type: ignore[type-arg,unused-ignore]
    """The value of an option, as `command` reads it."""

    name = "value"

    def __init__(self, option: Option) -> None:
        self._option = option

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        try:
            return read_value(self._option, str(value))
        except ValueError as error:
            raise click.BadParameter(str(error), ctx, param, self._came_from(ctx)) from error

    def _came_from(self, ctx: click.Context | None) -> str | None:
        """Return where the value came from: the option, or a variable instead of it; None for click's own words."""
        typed = ctx and ctx.get_parameter_source(self._option.name) is not ParameterSource.ENVIRONMENT
        return spelt(self._option) if typed else f"{self._option.env} in the environment"


class _Number(_Value, click.FloatRange):
    """A number: click shows its limits in help."""

    def __init__(self, option: Option) -> None:
        _Value.__init__(self, option)
        click.FloatRange.__init__(self, *option.limits, min_open=option.above)

    def _came_from(self, ctx: click.Context | None) -> str | None:  # noqa: ARG002
        return None

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
    if option.kind is FILE:
        return click.Path(dir_okay=False)
    return _Number(option) if option.kind in (INTEGER, NUMBER, SECONDS) else _Value(option)


def _argument(argument: Argument) -> click.Argument:
    return click.Argument(
        [argument.name],
        nargs=-1 if argument.many else 1,
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
        setattr(common(context), parameter.name or "", value)


def common(context: click.Context) -> Common:
    """Return what holds for this run of the command."""
    return context.find_root().ensure_object(Common)


class ClickCommand(click.Command):
    """A command, as its row says."""

    def __init__(self, row: Command) -> None:
        self.row = row
        arguments: list[click.Parameter] = [_argument(row.argument)] if row.argument else []
        own, shared = map(_option, row.options), [_option(each, common=True) for each in COMMON]
        super().__init__(
            row.name, params=[*arguments, *own, *shared], help=cleandoc(row.about), callback=self._carry_out
        )

    def _carry_out(self, **given: Any) -> int | None:
        context = click.get_current_context()
        options = common(context)
        options.typed = {each for each in given if context.get_parameter_source(each) is ParameterSource.COMMANDLINE}
        fault = self.row.fault(given, options.typed)
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

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        return _with_short_help(super().shell_complete(ctx, incomplete))

    def format_help_text(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        super().format_help_text(ctx, formatter)
        _write_examples(self.row.examples, formatter)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        _write_options(self, ctx, formatter, "Options of every command")

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        _write_exit_codes(self.row.exit_codes, formatter)


class _Commands(click.Group):
    """All of them: each is made of its row when it is needed."""

    def make_context(self, *arguments: Any, **extra: Any) -> click.Context:
        try:
            return super().make_context(*arguments, **extra)
        except BrokenPipeError as error:
            raise OutputClosed from error

    def invoke(self, ctx: click.Context) -> object:
        try:
            return super().invoke(ctx)
        except BrokenPipeError as error:
            raise OutputClosed from error

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002
        return ClickCommand(COMMANDS[cmd_name]) if cmd_name in COMMANDS else None

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        from click.shell_completion import CompletionItem

        rows = [each for each in COMMANDS.values() if each.name.startswith(incomplete)]
        named = [CompletionItem(each.name, help=each.summary) for each in rows]
        return named + _with_short_help(click.Command.shell_complete(self, ctx, incomplete))

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        name = args[0] if args else ""
        if ctx.resilient_parsing:  # a shell asks for completion: nothing may be said
            return super().resolve_command(ctx, args)
        if name and not name.startswith("-") and name not in COMMANDS:
            raise click.UsageError(_unknown_command(args), ctx)
        return super().resolve_command(ctx, args)

    def format_help_text(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        super().format_help_text(ctx, formatter)
        _write_examples(_EXAMPLES, formatter)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        self.format_commands(ctx, formatter)
        _write_options(self, ctx, formatter, "Options, before or after the command")

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        with formatter.section("Commands"):
            formatter.write_dl([(each.name, each.summary) for each in COMMANDS.values()])

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        _write_exit_codes(ALL_EXIT_CODES, formatter)


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
    context.ensure_object(Common)
    if context.invoked_subcommand is None:
        click.echo(_first_screen(context))


def _first_screen(context: click.Context) -> str:
    """Return what a newcomer needs first; with the prompt below it, it fits a terminal of 24 lines."""
    formatter = context.make_formatter()
    formatter.write(f"{talk.help}\n\n")
    with formatter.indentation():
        _write_lines(_EXAMPLES, formatter)
    talk.format_commands(context, formatter)
    formatter.write("\n'talk COMMAND --help' says more of each, 'talk --help' has the exit codes.")
    return formatter.getvalue()


def run(arguments: list[str], options: Common) -> int:
    """Run a command line, or answer a shell that asks for completion, and return the exit code."""
    return _complete(options) if "_TALK_COMPLETE" in os.environ else ended(lambda: _main(arguments, options), options)


def _main(arguments: list[str], options: Common) -> object:
    try:
        return talk.main(arguments, prog_name="talk", standalone_mode=False, obj=options)
    except click.Abort:
        return EXIT_SIGINT
    except click.ClickException as error:
        # The options may not have been read as far as --json when the error was found.
        _show_click_error(error, json=options.json or "--json" in arguments)
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


def _show_click_error(error: click.ClickException, *, json: bool) -> None:
    """Show a usage error. What was typed may be text of somebody else's, so its controls are escaped."""
    from talkcli.terminal.text import printable

    words = printable(_what_is_wrong(error))
    if json:
        show_error(UsageError(words), json=True)
        return
    note(words)
    if "--help" not in words:
        context = getattr(error, "ctx", None)
        note(f"see '{context.command_path if context else 'talk'} --help'")


def _with_short_help(options: list[CompletionItem]) -> list[CompletionItem]:
    """Have a shell show of an option's help what it has room for beside it: what stands before its first stop."""
    for each in options:
        each.help = re.split(r"[.;](?:\s|$)", each.help or "", maxsplit=1)[0] + "."
    return options


def _write_examples(examples: str, formatter: click.HelpFormatter) -> None:
    """Write a section of command lines, as they are."""
    with formatter.section("Examples"):
        _write_lines(examples, formatter)


def _write_lines(text: str, formatter: click.HelpFormatter) -> None:
    """Write lines as they are, indented as the formatter is at this moment."""
    for line in text.strip().splitlines():
        formatter.write(f"{'':{formatter.current_indent}}{line.strip()}\n")


def _write_options(command: click.Command, ctx: click.Context, formatter: click.HelpFormatter, shared: str) -> None:
    """Write the command's own options, and then, under the heading `shared`, those that all have."""
    own: list[tuple[str, str]] = []
    common: list[tuple[str, str]] = []
    for parameter in command.get_params(ctx):
        record = parameter.get_help_record(ctx)
        if record and isinstance(parameter, click.Option):
            (own if parameter.expose_value else common).append(record)
    for heading, records in (("Options", own), (shared, common)):
        if records:
            with formatter.section(heading):
                formatter.write_dl(records)


def _write_exit_codes(exit_codes: Codes, formatter: click.HelpFormatter) -> None:
    """Write a section of exit codes, in their order."""
    rows = sorted(exit_codes.items(), key=lambda row: row[0] if isinstance(row[0], int) else 128)
    with formatter.section("Exit codes"):
        formatter.write_dl([(str(code), words) for code, words in rows])


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
