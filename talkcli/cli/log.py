"""`talk log`."""

from __future__ import annotations

import click

from talkcli.cli.asking import log
from talkcli.cli.common import common, common_options
from talkcli.requests import MAX_LOG


@click.command("log")
@click.option(
    "-n",
    "--count",
    type=click.IntRange(1, MAX_LOG),
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

    \b
      talk log
      talk log -n 100 | grep patrol
      talk --json log | jq -r 'select(.state == "ABORTED").message'

    Exit codes: 0 listed; 3 no server.
    """
    return log(common(context), count)
