"""`talk wait`."""

from __future__ import annotations

import time

import click

from talkcli.cli.common import common, common_options, note
from talkcli.cli.interrupts import Interrupts
from talkcli.cli.say import report
from talkcli.connection import Interrupted
from talkcli.dial import ANSWER_LIMIT
from talkcli.errors import EXIT_OK, EXIT_TIMEOUT
from talkcli.states import State


@click.command("wait")
@click.argument("ids", nargs=-1, metavar="[ID]...")
@click.option(
    "-t",
    "--timeout",
    type=click.FloatRange(0, min_open=True),
    metavar="SEC",
    help="Wait no longer than SEC seconds; the goals go on; exit code 124.",
)
@common_options
@click.pass_context
def command(context: click.Context, ids: tuple[str, ...], timeout: float | None) -> int:
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
    first_failure = EXIT_OK
    with (
        Interrupts() as interrupts,
        options.connect(interrupt=interrupts.descriptor, patience=patience) as client,
    ):
        try:
            for goal in client.follow(ids or None):
                ended = goal.wait(None if end is None else max(0.0, end - time.monotonic()))
                code = report(ended, options) if ids or ended.state is State.LOST or options.json else EXIT_OK
                if ids or ended.state is State.LOST:
                    first_failure = first_failure or code
        except Interrupted:
            return interrupts.exit_code
        except TimeoutError as error:
            note(str(error))
            return EXIT_TIMEOUT
    return first_failure
