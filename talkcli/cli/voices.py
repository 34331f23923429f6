"""`talk voices`."""

from __future__ import annotations

import click

from talkcli import output
from talkcli.cli.common import common, common_options, note, show, show_json
from talkcli.errors import EXIT_OK


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
    options = common(context)
    with options.connect() as client:
        voices = client.voices()
    if language:
        wanted = language.lower()
        voices = [each for each in voices if _language(each) == wanted or _language(each).startswith(f"{wanted}-")]
        if not voices and not options.quiet:
            note(f"no voice speaks {language!r}: 'talk voices' lists all")
    if options.json:
        for voice in voices:
            show_json(voice)
    else:
        for line in output.voice_lines(voices):
            show(line)
    return EXIT_OK


def _language(voice: dict[str, object]) -> str:
    return str(voice.get("language") or "").lower()
