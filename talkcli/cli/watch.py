"""`talk watch`: shows what happens until it is interrupted, or until nobody reads any more.

What a line says is in `transcript`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from talkcli.cli.interrupts import Interrupts, has_reader
from talkcli.cli.show import Common, screen, show, show_json
from talkcli.client.connect import Interrupted
from talkcli.errors import EXIT_SIGPIPE
from talkcli.terminal.transcript import Transcript

if TYPE_CHECKING:
    from collections.abc import Mapping


def watch(options: Common, words: bool) -> int:
    """Show all goals as they happen, and each word as it is heard, too, if asked for; return the exit code."""
    if not has_reader():
        return EXIT_SIGPIPE
    with Interrupts() as interrupts:
        interrupts.watch_output()  # in `talk watch | head`, the next event may be far
        try:
            _watch(options, interrupts.watched, words=words)
        except Interrupted:
            interrupts.look()
    return interrupts.exit_code


def _watch(options: Common, interrupt: Mapping[int, int], *, words: bool) -> None:
    transcript = Transcript(full=screen().width is None, words=words)
    with options.connect(interrupt=interrupt) as client:
        for event in client.events():
            if options.json:
                show_json(event.to_json())
                continue
            for line in transcript.lines(event, screen()):
                show(line)
