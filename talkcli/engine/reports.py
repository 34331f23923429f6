"""What the engine thread reports of the engine process, beside what that says itself. It does nothing."""

from __future__ import annotations

from talkcli.engine import protocol
from talkcli.frozen import frozen


@frozen
class EngineDied:
    """The engine process ended, or had to be ended; for the log."""

    words: str


@frozen
class EngineMissing:
    """There has been no ready engine process for long, and one more start failed: the next goal ends for it."""

    words: str


@frozen
class EngineSaid:
    """A line that the engine process wrote to standard error; for the log. It may hold what a goal's text says."""

    words: str


@frozen
class ThreadDied:
    """A bug ended the engine thread: nothing will be spoken any more."""

    words: str


Report = protocol.Event | EngineDied | EngineMissing | EngineSaid | ThreadDied
