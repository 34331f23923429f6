"""What takes the samples of one sentence: the interface of a player, and the errors that end a sentence.

Samples are signed 16 bit, little-endian, one channel; lengths are in bytes. A player never blocks and never waits: it
says what it can take, and what to wait for. Nothing here opens or starts anything.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Protocol
else:
    Protocol = object

#: bytes of one sample: 16 bit, one channel.
SAMPLE = 2

#: Seconds of sound that are offered at once: small, so that little is on its way when it has to be silent.
PIECE = 0.02

#: A file descriptor and the poll events that are waited for on it.
Interest = tuple[int, int]


class AudioFailed(Exception):
    """The sentence cannot be spoken (any further): `reason` is for programs, the text for people."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class Stopped(Exception):
    """The sentence was stopped."""


class CannotEnd(Exception):
    """A player was killed and is not gone: nobody knows whether it is silent, and this process is of no more use."""


class Player(Protocol):
    """Where the samples of one sentence go."""

    #: the player's name, for people and to find it again.
    name: str
    #: True where sound takes as long as it lasts; False for a file, which is done at once.
    real_time: bool
    #: True once it is sure that sound has been taken: from then on it may have been heard, and is not played again.
    proven: bool

    def offer(self, data: memoryview) -> int:
        """Take what fits now and return its length; 0 if it is full. AudioFailed if it takes nothing any more."""

    def consumed(self) -> int:
        """Return how much the player has taken out; the rest waits in the pipe."""

    def close(self) -> None:
        """Take note that no more samples follow."""

    def ended(self) -> bool:
        """Return True when it ended well after `close`, False while it goes on; AudioFailed in any other case."""

    def interests(self) -> Sequence[Interest]:
        """Return what to poll for until it can take more or ends."""

    def wake_at(self) -> float | None:
        """Return the monotonic time at which to look again, whatever poll says; None if poll will tell."""

    def kill(self) -> None:
        """Be silent now, whatever is left."""

    def gone(self) -> bool:
        """Return True once it is silent for certain and everything of it is released."""


#: Waits for one of the interests or a monotonic time, whatever comes first, and may return early. What the server sends
#: meanwhile is carried out inside: a sentence can be stopped when this returns.
Wait = Callable[[Sequence[Interest], "float | None"], None]
