"""`talk watch`: shows what happens until it is interrupted, or until nobody reads any more.

What a line says is in `transcript`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from talkcli.cli.common import common, common_options, talk_command
from talkcli.cli.interrupts import Interrupts, has_reader
from talkcli.cli.show import Common, screen, show, show_json
from talkcli.cli.usage import ASKING
from talkcli.client.dial import Interrupted
from talkcli.errors import EXIT_SIGPIPE
from talkcli.terminal.transcript import Transcript

if TYPE_CHECKING:
    from collections.abc import Mapping


@talk_command(
    "watch",
    examples="""
        talk watch
        ssh robot talk watch
        talk --json watch | jq -r 'select(.event == "word").word'
    """,
    exit_codes={
        **ASKING,
        12: "lost: the server went away",
        "128+n": "ended by signal n: 130 by Ctrl-C, 141 where its reader is gone",
    },
)
@click.option("-f", "--words", is_flag=True, help="A line for each word as it is heard, too.")
@common_options
@click.pass_context
def command(context: click.Context, words: bool) -> int:
    """Show all goals as they happen, from now on: who says what, how it ends and why. Ctrl-C ends it.

    It begins with what is being said and what waits. On a terminal, what is over at once is left out: that a goal
    waits where nothing is before it, that one is being stopped. In a pipe, each event is a line.

    With --json each event is an object a line, words included; the first is {"event": "snapshot", ...}.
    """
    if not has_reader():
        return EXIT_SIGPIPE
    with Interrupts() as interrupts:
        interrupts.watch_output()  # in `talk watch | head`, the next event may be far
        try:
            _watch(common(context), interrupts.watched, words=words)
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
