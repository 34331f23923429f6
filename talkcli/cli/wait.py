"""`talk wait` as click reads it: its options and its help. What it does is in `waiting`."""

from __future__ import annotations

import click

from talkcli.cli import complete
from talkcli.cli.common import common, common_options, talk_command, timeout_option
from talkcli.cli.usage import ASKING
from talkcli.cli.waiting import wait


@talk_command(
    "wait",
    examples="""
        id=$(talk say "moving back")
        move_back
        talk wait "$id"
    """,
    exit_codes={
        **ASKING,
        0: "all succeeded; or no ID was given, and all have ended",
        4: "aborted; 4 to 7 are those of the first goal in order that did not succeed",
        5: "rejected; or the server has as many clients as it takes",
        6: "recalled",
        7: "preempted",
        8: "unknown goal",
        12: "lost: the server went away",
        124: "timed out; the goals go on",
        "128+n": "ended by signal n, 141: whoever read its output went away meanwhile; the goals go on",
    },
)
@click.argument("ids", nargs=-1, metavar="[ID]...", shell_complete=complete.goal_ids)
@timeout_option("Wait no longer than SEC seconds; the goals go on; exit code 124.")
@click.option("-f", "--feedback", is_flag=True, help="Show each word as it is heard.")
@common_options
@click.pass_context
def command(context: click.Context, ids: tuple[str, ...], timeout: float | None, feedback: bool) -> int:
    """Wait until these goals have ended, whoever sent them; without an ID, all that are active or pending now.

    It only watches: Ctrl-C and --timeout cancel nothing. A goal that has ended already is answered at once.
    """
    return wait(common(context), ids, timeout, feedback=feedback)
