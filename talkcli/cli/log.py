"""`talk log` as click reads it: its option and its help. What it does is in `asking`."""

from __future__ import annotations

import click

from talkcli.cli.asking import log
from talkcli.cli.common import common, common_options, talk_command
from talkcli.cli.usage import ASKING, WholeNumber
from talkcli.goals.requests import MAX_LOG


@talk_command(
    "log",
    examples="""
        talk log
        talk log -n 100 | grep patrol
        talk --json log | jq -r 'select(.state == "ABORTED").message'
    """,
    exit_codes={
        **ASKING,
        0: "listed",
    },
)
@click.option(
    "-n",
    "--count",
    type=WholeNumber(1, MAX_LOG),
    default=20,
    show_default=True,
    metavar="N",
    help="The last N goals that ended.",
)
@common_options
@click.pass_context
def command(context: click.Context, count: int) -> int:
    """Show what was said: when and how each goal ended, its text, who sent it, and why it ended; the newest last.

    Who sent it is the program that called talk, the process id of talk itself, and after "as" what the sender calls
    itself. Rejected goals are listed, too.
    """
    return log(common(context), count)
