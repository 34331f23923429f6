"""The group of all commands, for click: help, completion, errors, and every command line that is not a plain one.

A command's module is imported when the command is run, so that no command pays for another.
"""

from __future__ import annotations

import importlib
import os
from typing import Any

import click

from talkcli import __version__
from talkcli.cli.common import common_options
from talkcli.cli.ends import OutputClosed, ended
from talkcli.cli.show import Common, show_error
from talkcli.errors import EXIT_ERROR, EXIT_SIGINT, UsageError
from talkcli.printable import printable

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

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        name = args[0] if args else ""
        if ctx.resilient_parsing:  # a shell asks for completion: nothing may be said
            return super().resolve_command(ctx, args)
        if name and not name.startswith("-") and name not in COMMANDS:
            import difflib

            near = difflib.get_close_matches(name, COMMANDS, n=1)
            hint = f"Did you mean {near[0]!r}?" if near else f'To speak it, write: talk say "{" ".join(args)}"'
            raise click.UsageError(f"No such command '{name}'. {hint}", ctx)
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        with formatter.section("Commands"):
            formatter.write_dl(list(COMMANDS.items()))


@click.group(
    cls=_Commands,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="'talk COMMAND --help' says more. Exit codes: 0 succeeded, 3 no server, 4 aborted, 5 rejected, 6 recalled, "
    "7 preempted, 124 timed out; all of them are in the README.",
)
@common_options
@click.version_option(__version__, prog_name="talk", message="%(prog)s %(version)s")
@click.pass_context
def talk(context: click.Context) -> None:
    """Speech for robots: sentences as goals that can be awaited, cancelled and preempted.

    \b
      talk serve &                      one server on the robot
      talk say --wait -- "battery low"  the exit code tells whether it was heard
      talk cancel                       silence, now
      talk status                       what it says, will say, has said
    """
    context.ensure_object(Common)
    if context.invoked_subcommand is None:
        click.echo(context.get_help())


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
    words = printable(error.format_message())
    if json:
        show_error(UsageError(words), json=True)
    else:
        context = getattr(error, "ctx", None)
        if context is not None:
            click.echo(f"{context.get_usage()}\nTry '{context.command_path} --help' for help.\n", err=True)
        click.echo(f"Error: {words}", err=True)
