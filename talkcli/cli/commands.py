"""The group of all commands, for click: help, completion, errors, and every command line that is not a plain one.

A command's module is imported when the command is run, so that no command pays for another.
"""

from __future__ import annotations

import importlib
import os
from typing import TYPE_CHECKING, Any

import click

from talkcli import __version__
from talkcli.cli.common import common_options
from talkcli.cli.ends import OutputClosed, ended
from talkcli.cli.show import Common, note, show_error
from talkcli.cli.usage import (
    told,
    unknown_command,
    with_short_help,
    write_examples,
    write_exit_codes,
    write_lines,
    write_options,
)
from talkcli.errors import EXIT_ERROR, EXIT_SIGINT, UsageError
from talkcli.terminal.printable import printable

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

#: The commands, in the order in which help lists them: what a newcomer needs first comes first.
COMMANDS = {
    "serve": "Run the server, in the foreground.",
    "say": "Speak a sentence.",
    "wait": "Wait until goals have ended.",
    "cancel": "Stop speaking: everything, or what is named.",
    "status": "What is being said, what will be, what was.",
    "watch": "Follow all goals as they happen.",
    "log": "What was said: when, by whom, how it ended.",
    "pause": "Hold speech where it is.",
    "resume": "Go on where speech was held.",
    "set": "Change the running server's settings, or print them.",
    "voices": "List the voices.",
    "doctor": "Check everything between a sentence and a loudspeaker.",
    "completion": "Print the completion script of a shell.",
}


_EXAMPLES = """
    talk serve &                      one server on the robot
    talk say --wait -- "battery low"  the exit code tells whether it was heard
    talk cancel                       silence, now
    talk doctor                       silent? what to do next
"""
#: All of them, as the README's table has them; each command's help says which are its own.
ALL_EXIT_CODES: dict[int | str, str] = {
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


class _Commands(click.Group):
    """Loads the module of a command when it is needed; lists them all without."""

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
        if cmd_name not in COMMANDS:
            return None
        command: click.Command = importlib.import_module(f"talkcli.cli.{cmd_name}").command
        return command

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        from click.shell_completion import CompletionItem

        named = [CompletionItem(name, help=words) for name, words in COMMANDS.items() if name.startswith(incomplete)]
        return named + with_short_help(click.Command.shell_complete(self, ctx, incomplete))

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        name = args[0] if args else ""
        if ctx.resilient_parsing:  # a shell asks for completion: nothing may be said
            return super().resolve_command(ctx, args)
        if name and not name.startswith("-") and name not in COMMANDS:
            raise click.UsageError(unknown_command(args, COMMANDS), ctx)
        return super().resolve_command(ctx, args)

    def format_help_text(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        super().format_help_text(ctx, formatter)
        write_examples(_EXAMPLES, formatter)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        self.format_commands(ctx, formatter)
        write_options(self, ctx, formatter, "Options, before or after the command")

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        with formatter.section("Commands"):
            formatter.write_dl(list(COMMANDS.items()))

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        write_exit_codes(ALL_EXIT_CODES, formatter)


@click.group(
    cls=_Commands,
    invoke_without_command=True,
    subcommand_metavar="COMMAND [ARGS]...",
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@common_options
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
        write_lines(_EXAMPLES, formatter)
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
    from talkcli.cli import shells

    shells.register()
    try:
        talk.main([], prog_name="talk", standalone_mode=False, obj=options)  # ends by itself
    except Exception:
        if os.environ.get("TALK_DEBUG"):
            raise
    return EXIT_ERROR


def _show_click_error(error: click.ClickException, *, json: bool) -> None:
    """Show a usage error. What was typed may be text of somebody else's, so its controls are escaped."""
    words = printable(told(error))
    if json:
        show_error(UsageError(words), json=True)
        return
    note(words)
    if "--help" not in words:
        context = getattr(error, "ctx", None)
        note(f"see '{context.command_path if context else 'talk'} --help'")
