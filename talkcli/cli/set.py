"""`talk set` as click reads it: its options and its help. What it does is in `asking`."""

from __future__ import annotations

from typing import Any

import click

from talkcli.cli import complete
from talkcli.cli.asking import change
from talkcli.cli.common import common, common_options, number, seconds, talk_command, word
from talkcli.cli.usage import ASKING, Number, WholeNumber
from talkcli.goals.admission import PITCHES, RATES, VOLUMES


@talk_command(
    "set",
    examples="""
        talk set
        talk set --rate 150 --volume 0.5
        talk set --voice en-us --no-preempt
    """,
    exit_codes={
        **ASKING,
        0: "changed, or printed",
        2: "usage: a value out of its range, or an unknown voice; nothing was changed",
    },
)
@click.option("--rate", type=WholeNumber(*RATES), help="Words per minute.")
@click.option("--volume", type=Number(*VOLUMES), callback=number, help="Loudness.")
@click.option(
    "--voice",
    metavar="VOICE",
    callback=word,
    shell_complete=complete.voices,
    help="Voice by id, name or language: see 'talk voices'; 'default' is the engine's own.",
)
@click.option("--pitch", type=WholeNumber(*PITCHES), help="Pitch of the voice; 50 is its own.")
@click.option(
    "--preempt/--no-preempt",
    default=None,
    help="Every goal stops the one before it, or goals queue; one that says --queue stops none.",
)
@click.option(
    "--ttl",
    type=Number(0),
    callback=seconds,
    metavar="SEC",
    help="A goal that has not begun after SEC seconds is recalled; 0: no limit.",
)
@common_options
@click.pass_context
def command(context: click.Context, /, **changes: Any) -> int:
    """Change settings of the running server; without an option, print them.

    They hold for each goal that doesn't bring its own, from the next one that begins; --preempt and --ttl from the
    next one that is sent. A server that is started anew has those of its command line.
    """
    return change(common(context), **changes)
