"""Log messages about goals, engines and senders. `talkcli.daemon.log` writes them.

Text from clients is escaped, so that it can neither forge log lines nor send control codes to a terminal.
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

#: Maximum length of a program's name or command line in the log.
_MAX_LOGGED_COMMAND_CHARS = 80
_NO_PLAYER_NEEDED = "which plays by itself"


def goal_ended(record: Record, seconds: float) -> None:
    """Log that a goal has ended. `seconds` is how long it was active."""
    took = "" if record.started_at is None else f" after {seconds:.1f} s"
    how = f"{record.id} {record.state.name}{took}"
    if record.state is not State.SUCCEEDED:
        how += f" ({record.reason}{_cause(record.by)})"
    detail = f"; {sanitize(record.message)}" if record.state is State.ABORTED and record.message else ""
    write(f'{how}: "{sanitize(record.text or "")}" from {describe_sender(record.sender)}{detail}')


def engine_ready(engine: Ready, player_options: Sequence[str]) -> None:
    """Log that the engine is ready.

    Args:
        engine: the engine's description of itself.
        player_options: the names of the player options that were given.
    """
    version = f", {sanitize(engine.version)}" if engine.version else ""
    sound = describe_sound(engine)
    words = f"engine ready: driver {engine.driver}{version}, {sound}"
    if player_options and sound == _NO_PLAYER_NEEDED:
        words += f": {' and '.join(player_options)} {'has' if len(player_options) == 1 else 'have'} no effect"
    write(words)


def voice_load_ended(voice: VoiceLoaded) -> None:
    """Log that a neural voice was loaded, or that loading it failed."""
    if voice.error is None:
        write(f"voice {sanitize(voice.voice)} loaded in {voice.seconds:.1f} s")
    else:
        write(f"voice {sanitize(voice.voice)} cannot be loaded, espeak speaks where it may: {sanitize(voice.error)}")


def describe_sound(engine: Ready) -> str:
    """Return a short description of the engine's audio output."""
    if engine.player:
        return f"player {engine.player}"
    return NO_PLAYER if is_own_driver(engine.driver) else _NO_PLAYER_NEEDED


def describe_sender(sender: Sender) -> str:
    """Return a short description of the program that sent a request."""
    parts = [] if sender.uid is None else [f"uid {sender.uid}"]
    if sender.pid is not None:
        parts.append(f"pid {sender.pid}")
    if sender.command:
        parts.append(printable(sender.command, _MAX_LOGGED_COMMAND_CHARS))
    if sender.parent:
        parts.append(f"started by {printable(sender.parent, _MAX_LOGGED_COMMAND_CHARS)}")
    if sender.name:
        parts.append(f'calls itself "{printable(sender.name)}"')
    return ", ".join(parts) or "nobody known"


def _cause(by: By | None) -> str:
    """Return a short description of what ended a goal, or an empty string if it is unknown."""
    if by is None:
        return ""
    return f" by {by.goal}" if by.goal else f" by {describe_sender(by.client)}" if by.client else ""
