"""`talk voices`."""

from __future__ import annotations

import click

from talkcli.cli.asking import voices
from talkcli.cli.common import common, common_options


@click.command("voices")
@click.option("--language", metavar="CODE", help="Only this language, with its variants: en, pt-br.")
@common_options
@click.pass_context
def command(context: click.Context, language: str | None) -> int:
    """List the voices of the server's engine: id, language, name. Any of the three can be given as a voice.

    At the end of the list are variants: each goes behind any voice.

    \b
      talk voices --language en
      talk serve --voice en-us
      talk say --voice en-us+f3 "a variant"

    Exit codes: 0 listed; 3 no server; 1 the engine can't list them.
    """
    return voices(common(context), language)
