"""`talk watch`: shows what happens until it is interrupted, or until nobody reads any more.

What a line says is in `transcript`.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys
import threading

import click

from talkcli.cli.common import common, common_options, talk_command
from talkcli.cli.interrupts import Interrupts
from talkcli.cli.show import Common, screen, show, show_json
from talkcli.cli.usage import ASKING
from talkcli.dial import Interrupted
from talkcli.errors import EXIT_SIGNAL
from talkcli.transcript import Transcript


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
    options = common(context)
    _end_with_reader()
    with Interrupts() as interrupts, contextlib.suppress(Interrupted):
        _watch(options, interrupts.descriptor, words=words)
    return interrupts.exit_code


def _watch(options: Common, interrupt: int, *, words: bool) -> None:
    transcript = Transcript(full=screen().width is None, words=words)
    with options.connect(interrupt=interrupt) as client:
        for event in client.events():
            if options.json:
                show_json(event.to_json())
                continue
            for line in transcript.lines(event, screen()):
                show(line)


def _end_with_reader() -> None:
    """End the process when whoever reads standard output goes: in `talk watch | head`, the next event may be far."""
    if sys.stdout is None:
        return
    poll = select.poll()
    poll.register(sys.stdout.fileno(), 0)  # nothing but errors and hang-ups, which a file never has

    def wait() -> None:
        (_, found), *_ = poll.poll()
        if found & (select.POLLERR | select.POLLHUP):  # and not POLLNVAL, which is what macOS says of a terminal
            os._exit(EXIT_SIGNAL + signal.SIGPIPE)  # nothing is left to be written or tidied up

    threading.Thread(target=wait, daemon=True).start()
