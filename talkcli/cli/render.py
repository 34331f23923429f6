"""`talk say -o`: a sentence into a file, by an engine of this command's own. It knows no server."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, Any

import click

from talkcli.cli.command import read_value, readable
from talkcli.cli.interrupts import Interrupts
from talkcli.cli.show import note, show_json
from talkcli.cli.wait import regardless, show_if_possible
from talkcli.client.connect import Interrupted
from talkcli.errors import EXIT_OK, EXIT_TIMEOUT, UsageError
from talkcli.goals.options import SOUND

if TYPE_CHECKING:
    from collections.abc import Mapping

    from talkcli.cli.show import Common


def render_to(path: str, text: str, chosen: Mapping[str, Any], timeout: float | None, options: Common) -> int:
    """Write the text into the file, "-" for standard output, and return the exit code; what goes wrong is raised.

    `chosen`: the options of a goal; those that the engine isn't told of mean nothing here. `timeout`: seconds.
    """
    from talkcli.engine.render import STANDARD_OUTPUT, render

    settings = _settings(chosen)
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
            seconds = render(text, path, timeout=timeout, interrupt=interrupts.descriptor, **settings)
        except Interrupted:
            return interrupts.exit_code
        except TimeoutError as error:
            note(str(error))
            return EXIT_TIMEOUT
    if options.json:
        done = {"output": path, "seconds": seconds, "text": text, **settings}
        regardless(show_if_possible, show_json, done)  # the file is there
    return EXIT_OK


def _settings(chosen: Mapping[str, Any]) -> dict[str, Any]:
    """Return what to speak with: the options, else the environment, as a server has its own; none that neither has."""
    found = {}
    for option in SOUND:
        value, text = chosen[option.name], os.environ.get(option.env) if option.env else None
        if value is None and text:
            try:
                value = read_value(option, text)
            except ValueError as error:
                words = f"{option.env} in the environment: {error}"
                raise click.UsageError(words, click.get_current_context()) from error
        if value is not None:
            found[option.name] = value
    return found
