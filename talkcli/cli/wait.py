"""`talk wait`."""

from __future__ import annotations

import click

from talkcli.cli import complete
from talkcli.cli.common import common, common_options, timeout_option
from talkcli.cli.waiting import wait


@click.command("wait")
@click.argument("ids", nargs=-1, metavar="[ID]...", shell_complete=complete.goal_ids)
@timeout_option("Wait no longer than SEC seconds; the goals go on; exit code 124.")
@click.option("-f", "--feedback", is_flag=True, help="Show each word as it is heard.")
@common_options
@click.pass_context
def command(context: click.Context, ids: tuple[str, ...], timeout: float | None, feedback: bool) -> int:
    """Wait until these goals have ended, whoever sent them; without an ID, all that are active or pending now.

    It only watches: Ctrl-C and --timeout cancel nothing. A goal that has ended already is answered at once.

    \b
      id=$(talk say "moving back")
      move_back
      talk wait "$id"

    Exit codes: 0 all succeeded, or no ID was given; else that of the first in order that did not: 4 aborted,
    5 rejected, 6 recalled, 7 preempted; 3 no server; 8 unknown goal; 12 the server went away; 124 timed out.
    """
    return wait(common(context), ids, timeout, feedback=feedback)
