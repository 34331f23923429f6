"""`talk cancel` as click reads it: its options and its help. What it does is in `asking`."""

from __future__ import annotations

import click

from talkcli.cli import complete
from talkcli.cli.asking import cancel
from talkcli.cli.common import common, common_options, talk_command, word
from talkcli.cli.usage import ASKING


@talk_command(
    "cancel",
    examples="""
        talk cancel                 everything, now
        talk cancel --current       this sentence; the next one follows
        talk cancel --key battery   what was sent with --key battery
        talk cancel 12 13           these goals of this server
    """,
    exit_codes={
        **ASKING,
        0: "it is silent, or was already",
        8: "an ID is unknown; the others are cancelled all the same",
    },
)
@click.argument("ids", nargs=-1, metavar="[ID]...", shell_complete=complete.goal_ids)
@click.option("--current", is_flag=True, help="The goal that is being spoken.")
@click.option(
    "--before",
    metavar="ID",
    callback=word,
    shell_complete=complete.goal_ids,
    help="This goal, and all that were accepted before it.",
)
@click.option(
    "--key",
    metavar="KEY",
    callback=word,
    shell_complete=complete.unfinished_keys,
    help="The goals with this key, spoken or waiting.",
)
@common_options
@click.pass_context
def command(context: click.Context, ids: tuple[str, ...], current: bool, before: str | None, key: str | None) -> int:
    """Stop speaking: the goals that are named, or everything, from every client. Returns when it is silent.

    Prints the ids of the goals that ended because of it. Nothing to cancel is success. Selectors add up.
    """
    return cancel(common(context), ids, current, before, key)
