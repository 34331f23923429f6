"""`talk status` as click reads it: its argument and its help. What it does is in `asking`."""

from __future__ import annotations

import click

from talkcli.cli import complete
from talkcli.cli.asking import status
from talkcli.cli.common import common, common_options, talk_command
from talkcli.cli.usage import ASKING


@talk_command(
    "status",
    examples="""
        talk status
        talk status 12                          goal 12 of this server
        talk --json status | jq .active.text
    """,
    exit_codes={
        **ASKING,
        0: "the server runs",
        8: "unknown goal",
    },
)
@click.argument("goal_id", required=False, metavar="[ID]", shell_complete=complete.known_ids)
@common_options
@click.pass_context
def command(context: click.Context, goal_id: str | None) -> int:
    """Show what is being said, what will be and what was; with an ID, all that is known of that goal."""
    return status(common(context), goal_id)
