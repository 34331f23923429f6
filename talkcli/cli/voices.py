"""`talk voices` as click reads it: its option and its help. What it does is in `asking`."""

from __future__ import annotations

import click

from talkcli.cli.asking import voices
from talkcli.cli.common import common, common_options, talk_command
from talkcli.cli.usage import ASKING


@talk_command(
    "voices",
    examples="""
        talk voices --language en
        talk serve --voice en-us
        talk say --voice en-us+f3 "a variant"
    """,
    exit_codes={
        **ASKING,
        0: "listed",
        1: "no voice speaks that language, or the engine can't list them",
    },
)
@click.option("--language", metavar="CODE", help="Only this language, with its variants: en, pt-br.")
@common_options
@click.pass_context
def command(context: click.Context, language: str | None) -> int:
    """List the voices of the server's engine: id, language, name. Any of the three can be given as a voice.

    At the end of the list are variants: each goes behind any voice.
    """
    return voices(common(context), language)
