"""The server's log: lines on standard error, for people and for journald. It never blocks and never fails.

Nothing that a client sends can forge a line or reach a terminal raw: all of it goes through `printable`.
"""

from __future__ import annotations

import os
import select
import sys
import time
import traceback
from typing import TYPE_CHECKING

from talkcli.engine.players import NO_PLAYER
from talkcli.engine.process import Quota
from talkcli.engine.synthesizers import is_own
from talkcli.goals.states import State
from talkcli.terminal.text import printable

if TYPE_CHECKING:
    from collections.abc import Sequence

    from talkcli.engine.protocol import Loaded, Ready
    from talkcli.goals.goal import By, Sender
    from talkcli.goals.record import Record

#: Bytes of one line at most: a pipe that poll calls writable takes as many without blocking (PIPE_BUF on Linux).
_MAX_LINE = 4096
#: Characters of a text in the log.
_MAX_TEXT = 200
#: Characters of a program's name or command line in the log.
_MAX_COMMAND = 80

#: What plays where a driver needs no player.
_BY_ITSELF = "which plays by itself"
#: Seconds between two lines of the same kind, of what may happen many times a second.
_SELDOM = 60.0

_lost = 0
_seldom: dict[str, Quota] = {}


def line(words: str) -> None:
    """Write one line; where standard error is closed or its reader is stuck, the line is lost and speech goes on."""
    global _lost  # noqa: PLW0603
    if _lost:
        words = f"{words} ({_lost} lines before this one could not be written)"
    data = f"talk: {words}\n".encode(errors="backslashreplace")
    if len(data) > _MAX_LINE:
        data = data[: _MAX_LINE - 1] + b"\n"
    try:
        fd = sys.stderr.fileno() if sys.stderr else 2
        poll = select.poll()
        poll.register(fd, select.POLLOUT)
        if not poll.poll(0):
            _lost += 1
            return
        os.write(fd, data)
        _lost = 0
    except (OSError, ValueError):
        _lost += 1


def seldom(kind: str, words: str) -> None:
    """Write a line at most once a minute for each kind; the next one says how often it was not written."""
    more = _seldom.setdefault(kind, Quota(1, _SELDOM)).take(time.monotonic())
    if more is not None:
        line(f"{words} ({more} more of these were not logged)" if more else words)


def bug(what: str, error: Exception) -> None:
    """Write a line of a bug, with the place where it is."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f" at {os.path.basename(frames[-1].filename)}:{frames[-1].lineno}" if frames else ""
    line(f"a bug in {what}{place}: {shown(f'{type(error).__name__}: {error}')}")


def ended(record: Record, seconds: float) -> None:
    """Write the line of a goal that has ended; `seconds`: since it began to be spoken, if it did."""
    took = "" if record.started_at is None else f" after {seconds:.1f} s"
    how = f"{record.id} {record.state.name}{took}"
    if record.state is not State.SUCCEEDED:
        how += f" ({record.reason}{_by(record.by)})"
    detail = f"; {shown(record.message)}" if record.state is State.ABORTED and record.message else ""
    line(f'{how}: "{shown(record.text or "")}" from {who(record.sender)}{detail}')


def ready(engine: Ready, for_player: Sequence[str]) -> None:
    """Write the line of an engine that is ready; `for_player`: the options that were given for a player."""
    version = f", {shown(engine.version)}" if engine.version else ""
    sound = sound_of(engine)
    words = f"engine ready: driver {engine.driver}{version}, {sound}"
    if for_player and sound == _BY_ITSELF:
        words += f": {' and '.join(for_player)} {'has' if len(for_player) == 1 else 'have'} no effect"
    line(words)


def loaded(voice: Loaded) -> None:
    """Write the line of a neural voice that can be spoken with from now on, or can't."""
    if voice.error is None:
        line(f"voice {shown(voice.voice)} loaded in {voice.seconds:.1f} s")
    else:
        line(f"voice {shown(voice.voice)} cannot be loaded, espeak speaks where it may: {shown(voice.error)}")


def sound_of(engine: Ready) -> str:
    """Return what plays, for people."""
    if engine.player:
        return f"player {engine.player}"
    return NO_PLAYER if is_own(engine.driver) else _BY_ITSELF


def shown(words: str) -> str:
    """Return words that may hold text from elsewhere, fit for one line of the log."""
    return printable(words, _MAX_TEXT)


def who(sender: Sender) -> str:
    """Return the sender in a few words."""
    parts = [] if sender.uid is None else [f"uid {sender.uid}"]
    if sender.pid is not None:
        parts.append(f"pid {sender.pid}")
    if sender.command:
        parts.append(printable(sender.command, _MAX_COMMAND))
    if sender.parent:
        parts.append(f"started by {printable(sender.parent, _MAX_COMMAND)}")
    if sender.name:
        parts.append(f'calls itself "{printable(sender.name)}"')
    return ", ".join(parts) or "nobody known"


def _by(by: By | None) -> str:
    if by is None:
        return ""
    return f" by {by.goal}" if by.goal else f" by {who(by.client)}" if by.client else ""
