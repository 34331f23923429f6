"""`talk cancel`."""

from __future__ import annotations

import click

from talkcli.cli import complete
from talkcli.cli.common import Common, common, common_options, filled, note, show, show_json
from talkcli.client import Canceled
from talkcli.errors import EXIT_OK, UnknownGoal


@click.command("cancel")
@click.argument("ids", nargs=-1, metavar="[ID]...", shell_complete=complete.goal_ids)
@click.option("--current", is_flag=True, help="The goal that is being spoken.")
@click.option(
    "--before",
    metavar="ID",
    callback=filled,
    shell_complete=complete.goal_ids,
    help="This goal, and all that were accepted before it.",
)
@click.option(
    "--key",
    metavar="KEY",
    callback=filled,
    shell_complete=complete.unfinished_keys,
    help="The goals with this key, spoken or waiting.",
)
@common_options
@click.pass_context
def command(context: click.Context, ids: tuple[str, ...], current: bool, before: str | None, key: str | None) -> int:
    """Stop speaking: the goals that are named, or everything, from every client. Returns when it is silent.

    Prints the ids of the goals that ended because of it. Nothing to cancel is success. Selectors add up.

    \b
      talk cancel                 everything, now
      talk cancel --current       this sentence; the next one follows
      talk cancel --key battery   what was sent with --key battery
      talk cancel 12 13           these goals of this server

    Exit codes: 0 done; 3 no server; 8 an ID is unknown (the others are cancelled all the same).
    """
    options = common(context)
    with options.connect(urgent=True) as client:
        try:
            _show(client.cancel(ids or None, current=current, before=before, key=key), options)
        except UnknownGoal as error:
            _show(Canceled.from_items(error.items), options)
            raise
    return EXIT_OK


def _show(done: Canceled, options: Common) -> None:
    for goal in done.canceled:
        if options.json:
            show_json(goal.to_json())
        elif not options.quiet:
            show(goal.id)
    for goal in done.ended:
        if not options.quiet:
            note(f"{goal.id} had ended already: {goal.state.name}")
