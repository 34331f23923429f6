"""`talk say -o`: a sentence into a file, by an engine of this command's own. It knows no server."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, Any

import click

from talkcli.cli.interrupts import Interrupts
from talkcli.cli.outcome import regardless, show_if_possible
from talkcli.cli.show import note, show_json
from talkcli.cli.utf8 import readable
from talkcli.client.dial import Interrupted
from talkcli.errors import EXIT_OK, EXIT_TIMEOUT, UsageError

if TYPE_CHECKING:
    from talkcli.cli.show import Common
    from talkcli.goals.goal import JsonObject

#: Settings, and the variables that hold for them where nothing is spoken: a server has its own.
_VARIABLES = {"rate": "TALK_RATE", "volume": "TALK_VOLUME", "voice": "TALK_VOICE", "pitch": None}


def settings(context: click.Context, given: dict[str, Any]) -> dict[str, Any]:
    """Return what to speak with: the options, else the environment; those that neither has are left out."""
    found = {}
    for name, variable in _VARIABLES.items():
        value = given[name]
        if value is None and variable and os.environ.get(variable):
            parameter = next(each for each in context.command.params if each.name == name)
            try:
                value = parameter.process_value(context, os.environ[variable])
            except click.BadParameter as error:
                raise click.UsageError(f"{variable} in the environment: {error.message}", context) from error
        if value is not None:
            found[name] = value
    return found


def render_to(path: str, text: str, chosen: JsonObject, timeout: float | None, options: Common) -> int:
    """Write the text into the file, "-" for standard output, and return the exit code; what goes wrong is raised."""
    from talkcli.engine.render import STANDARD_OUTPUT, render

    if path in STANDARD_OUTPUT:
        if options.json:
            raise UsageError("--json prints to standard output, where the sound goes: leave one of them out")
        if sys.stdout is None:
            raise BrokenPipeError("standard output is closed")
    text, unreadable = readable(text)
    if unreadable and not options.quiet:
        note(unreadable)
    with Interrupts() as interrupts:
        try:
            seconds = render(text, path, timeout=timeout, interrupt=interrupts.descriptor, **chosen)  # type: ignore[arg-type]
        except Interrupted:
            return interrupts.exit_code
        except TimeoutError as error:
            note(str(error))
            return EXIT_TIMEOUT
    if options.json:
        done = {"output": path, "seconds": seconds, "text": text, **chosen}
        regardless(show_if_possible, show_json, done)  # the file is there
    return EXIT_OK
