"""`talk resume`."""

from __future__ import annotations

import click

from talkcli.cli.common import common, common_options
from talkcli.cli.pause import tell
from talkcli.errors import EXIT_OK
from talkcli.printable import printable


@click.command("resume")
@common_options
@click.pass_context
def command(context: click.Context) -> int:
    """Go on where 'talk pause' held speech. Twice is success, and so is without a pause.

    \b
      talk resume

    Exit codes: 0 speech goes on; 3 no server.
    """
    options = common(context)
    with options.connect() as client:
        goal = client.resume()
    words = f"speech goes on with {printable(goal.id)}" if goal else "speech goes on"
    tell(options, goal, paused=False, words=words)
    return EXIT_OK
