"""`talk set`."""

from __future__ import annotations

import click

from talkcli import output
from talkcli.admission import PITCHES, RATES, VOLUMES
from talkcli.cli import complete
from talkcli.cli.common import common, common_options, filled, number, seconds, show, show_json
from talkcli.errors import EXIT_OK


@click.command("set")
@click.option("--rate", type=click.IntRange(*RATES), help="Words per minute.")
@click.option("--volume", type=click.FloatRange(*VOLUMES), callback=number, help="Loudness.")
@click.option(
    "--voice",
    callback=filled,
    shell_complete=complete.voices,
    help="Voice by id, name or language: see 'talk voices'; 'default' is the engine's own.",
)
@click.option("--pitch", type=click.IntRange(*PITCHES), help="Pitch of the voice; 50 is its own.")
@click.option(
    "--preempt/--no-preempt",
    default=None,
    help="Every goal stops the one before it, unless it says --queue; or goals queue.",
)
@click.option(
    "--ttl",
    type=click.FloatRange(0),
    callback=seconds,
    metavar="SEC",
    help="A goal that has not begun after SEC seconds is recalled; 0: no limit.",
)
@common_options
@click.pass_context
def command(context: click.Context, /, **changes: object) -> int:
    """Change settings of the running server; without an option, print them.

    They hold for each goal that doesn't bring its own, from the next one that begins; --preempt and --ttl from the
    next one that is sent. A server that is started anew has those of its command line.

    \b
      talk set
      talk set --rate 150 --volume 0.5
      talk set --voice en-us --no-preempt

    Exit codes: 0 done; 2 a value out of its range, or an unknown voice: nothing was changed; 3 no server.
    """
    options = common(context)
    asked = {name: value for name, value in changes.items() if value is not None}
    with options.connect() as client:
        settings = client.set(**asked) if asked else client.settings()  # type: ignore[arg-type]
    if options.json:
        show_json(settings)
    elif not asked:
        for line in output.setting_lines(settings):
            show(line)
    return EXIT_OK
