"""`talk wait`."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import click

from talkcli.cli import complete
from talkcli.cli.common import Common, common, common_options, note, timeout_option
from talkcli.cli.interrupts import Interrupts
from talkcli.cli.outcome import report, rest
from talkcli.dial import ANSWER_LIMIT, Interrupted
from talkcli.errors import EXIT_OK, EXIT_TIMEOUT
from talkcli.states import State

if TYPE_CHECKING:
    from talkcli.cli.feedback import Feedback
    from talkcli.client import GoalHandle


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
    end = None if timeout is None else time.monotonic() + timeout
    patience = ANSWER_LIMIT if timeout is None else min(ANSWER_LIMIT, timeout)
    options = common(context)
    with Interrupts() as interrupts:
        try:
            with options.connect(interrupt=interrupts.descriptor, patience=patience) as client:
                goals = client.follow(ids or None, feedback=feedback)
                shown = _show(goals, end, options) if feedback else None
                return _wait(goals, end, options, shown, named=bool(ids))
        except Interrupted:
            return interrupts.exit_code
        except TimeoutError as error:
            note(str(error))
            return EXIT_TIMEOUT


def _show(goals: list[GoalHandle], end: float | None, options: Common) -> Feedback:
    """Show what happens to the goals until all have ended."""
    from talkcli.cli.feedback import feedback
    from talkcli.following import merged

    shown = feedback(options)
    try:
        shown.begin([each.goal for each in goals])
        for goal, event in merged(goals, rest(end)):
            shown.show(goal.goal, event)
    finally:
        shown.close()
    return shown


def _wait(goals: list[GoalHandle], end: float | None, options: Common, shown: Feedback | None, *, named: bool) -> int:
    """Wait for the goals in their order; how those ended that were not named is nobody's failure."""
    first_failure = EXIT_OK
    for goal in goals:
        ended = goal.wait(rest(end))
        counts = named or ended.state is State.LOST
        code = report(ended, options, shown) if counts or options.json else EXIT_OK
        if counts:
            first_failure = first_failure or code
    return first_failure
