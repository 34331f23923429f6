"""`talk pause`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from talkcli.cli.common import Common, common, common_options, note, show_json
from talkcli.errors import EXIT_OK
from talkcli.printable import printable

if TYPE_CHECKING:
    from talkcli.messages import Goal

#: Characters of what was heard last that are shown.
_MAX_SPOKEN = 40


@click.command("pause")
@common_options
@click.pass_context
def command(context: click.Context) -> int:
    """Hold speech where it is, until 'talk resume'. Returns when it is silent; twice is success.

    Nothing is spoken until then, whoever sends it and however urgent it is. Goals can be sent and cancelled.

    \b
      talk pause; listen_to_the_operator; talk resume

    Exit codes: 0 speech is held; 3 no server.
    """
    options = common(context)
    with options.connect() as client:
        held = client.pause()
    heard = held.spoken[-_MAX_SPOKEN:] if held and held.spoken else ""
    where = f', after "{printable(heard)}"' if heard else ""
    tell(
        options,
        held,
        paused=True,
        words=f"{printable(held.id)} is held{where}" if held else "nothing is being spoken, and nothing will be",
    )
    return EXIT_OK


def tell(options: Common, goal: Goal | None, *, paused: bool, words: str) -> None:
    """Tell what became of speech, and of the goal that was held."""
    if options.json:
        show_json({"paused": paused, "goal": None if goal is None else goal.to_json()})
    elif not options.quiet:
        note(f"{words}; 'talk resume' goes on" if paused else words)
