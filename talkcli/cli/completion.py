"""`talk completion`: prints the script by which a shell completes `talk`. The files in completions/ are the same."""

from __future__ import annotations

import click

from talkcli.cli.common import common_options, talk_command
from talkcli.cli.shells import SHELLS
from talkcli.cli.show import show


@talk_command(
    "completion",
    examples="""
        eval "$(talk completion bash)"   the last line of ~/.bashrc
        eval "$(talk completion zsh)"    the last line of ~/.zshrc
        talk completion fish | source    the last line of ~/.config/fish/config.fish
    """,
    exit_codes={
        0: "printed",
        1: "anything not named here; a bug says so",
        2: "usage: a shell that there is no script for",
    },
)
@click.argument("shell", type=click.Choice(list(SHELLS)), metavar="SHELL")
@common_options
@click.pass_context
def command(context: click.Context, shell: str) -> None:
    """Print the completion script of a shell: bash, zsh or fish. Its start file loads it.

    Tab then completes commands, options and their values, and what the running server knows: goals, keys, voices.
    """
    show(SHELLS[shell](context.find_root().command, {}, "talk", "_TALK_COMPLETE").source().rstrip("\n"))
