"""`talk status`."""

from __future__ import annotations

import click

from talkcli import output
from talkcli.cli import complete
from talkcli.cli.common import common, common_options, screen, show, show_json
from talkcli.errors import EXIT_OK


@click.command("status")
@click.argument("goal_id", required=False, metavar="[ID]", shell_complete=complete.known_ids)
@common_options
@click.pass_context
def command(context: click.Context, goal_id: str | None) -> int:
    """Show what is being said, what will be and what was; with an ID, all that is known of that goal.

    \b
      talk status
      talk status 12                          goal 12 of this server
      talk --json status | jq .active.text

    Exit codes: 0 the server runs; 3 no server; 8 unknown goal.
    """
    options = common(context)
    with options.connect(urgent=True) as client:
        if goal_id is not None:
            goal = client.goal(goal_id)
            if options.json:
                show_json(goal.to_json())
            else:
                _show_lines(output.goal_lines(goal, screen()))
            return EXIT_OK
        status = client.status()
    if options.json:
        show_json(status.to_json())
    else:
        _show_lines(output.status_lines(status, screen()))
    return EXIT_OK


def _show_lines(lines: list[str]) -> None:
    for line in lines:
        show(line)
