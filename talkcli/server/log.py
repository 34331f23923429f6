"""What the server's log says of goals, engines and who sent what; a line is written by `talkcli.daemon.log`.

Nothing that a client sends can forge a line or reach a terminal raw: all of it goes through `printable`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from talkcli.daemon.log import sanitize, write
from talkcli.engine.players import NO_PLAYER
from talkcli.engine.voices import is_own_driver
from talkcli.goals.states import State
from talkcli.terminal.text import printable

if TYPE_CHECKING:
    from collections.abc import Sequence

    from talkcli.engine.protocol import Ready, VoiceLoaded
    from talkcli.goals.goal import By, Sender
    from talkcli.goals.record import Record

#: Characters of a program's name or command line in the log.
_MAX_COMMAND = 80
#: What plays where a driver needs no player.
_BY_ITSELF = "which plays by itself"


def ended(record: Record, seconds: float) -> None:
    """Write the line of a goal that has ended; `seconds`: since it began to be spoken, if it did."""
    took = "" if record.started_at is None else f" after {seconds:.1f} s"
    how = f"{record.id} {record.state.name}{took}"
    if record.state is not State.SUCCEEDED:
        how += f" ({record.reason}{_by(record.by)})"
    detail = f"; {sanitize(record.message)}" if record.state is State.ABORTED and record.message else ""
    write(f'{how}: "{sanitize(record.text or "")}" from {who(record.sender)}{detail}')


def ready(engine: Ready, for_player: Sequence[str]) -> None:
    """Write the line of an engine that is ready; `for_player`: the options that were given for a player."""
    version = f", {sanitize(engine.version)}" if engine.version else ""
    sound = sound_of(engine)
    words = f"engine ready: driver {engine.driver}{version}, {sound}"
    if for_player and sound == _BY_ITSELF:
        words += f": {' and '.join(for_player)} {'has' if len(for_player) == 1 else 'have'} no effect"
    write(words)


def loaded(voice: VoiceLoaded) -> None:
    """Write the line of a neural voice that can be spoken with from now on, or can't."""
    if voice.error is None:
        write(f"voice {sanitize(voice.voice)} loaded in {voice.seconds:.1f} s")
    else:
        write(f"voice {sanitize(voice.voice)} cannot be loaded, espeak speaks where it may: {sanitize(voice.error)}")


def sound_of(engine: Ready) -> str:
    """Return what plays, for people."""
    if engine.player:
        return f"player {engine.player}"
    return NO_PLAYER if is_own_driver(engine.driver) else _BY_ITSELF


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
