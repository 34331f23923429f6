"""The interface of a player, and the exceptions that end a sentence.

Samples are signed 16 bit, little-endian, one channel. Lengths are in bytes. `tests/engine/test_player_contract.py`
tests every player against the promises of `Player`.
"""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Protocol

    from talkcli.goals.goal import Output
    from talkcli.goals.reasons import Reason
else:
    Protocol = object

#: A file descriptor, and the poll events to wait for.
Interest = tuple[int, int]


class CannotSpeak(Exception):
    """The sentence, or the rest of it, can't be spoken.

    Args:
        reason: The reason for programs, such as "audio_lost".
        message: The reason for people.
        final: Whether no other player would be heard either, so none is tried.
    """

    def __init__(self, reason: Reason, message: str, *, final: bool = False) -> None:
        super().__init__(message)
        self.reason = reason
        self.final = final


class Stopped(Exception):
    """The sentence was stopped."""


class CannotEnd(Exception):
    """A player survived `kill`, so this process can't promise silence any more and has to end."""


class Player(Protocol):
    """A player for the samples of one sentence; every sentence has a player of its own.

    A constructor that can't open the output raises CannotSpeak (`no_player` or `audio_device`) and leaves nothing
    open. After that, the playback calls the player from a single thread:

    1. `offer` until there are no more samples, then `close` once, then `ended` until it returns True. `consumed` and
       `proven` may be read at any time. `interests` and `wake_at` are called right before each wait.
    2. `kill`, however the sentence ended (a stop and an error may come at any point), then `gone` until it returns
       True.

    No method blocks, except that `kill` may take some milliseconds if silence is certain afterwards. Work that would
    block is done in a thread or process of the player's own, which wakes the playback through a descriptor.

    A player plays everything that it took, in order and once, and adds no silence. If the outside world fails (the
    device is unplugged, the disk is full), it raises CannotSpeak. Any other exception is a bug in the player.
    """

    #: the player's name for people, by which a player that worked is also found again; it never changes
    name: str
    #: whether playing takes as long as the sound lasts, so that a player that takes no samples is stuck. A player that
    #: writes a file is not real-time, and is never heard. It never changes.
    real_time: bool
    #: whether sound has certainly reached the output, so that it may have been heard and is not played again. While it
    #: is False, the next player gets the sentence if this one fails. It is up to date after `consumed`, and stays True
    #: once it is True. A player that keeps all it is offered may start with True.
    proven: bool

    @property
    def output(self) -> Output | None:
        """The output's device, volume and mute state; None if it isn't known."""
        return None

    def offer(self, data: memoryview) -> int:
        """Take as many samples as fit now, and return their length.

        Args:
            data: Between one byte and one piece of samples. The caller overwrites the buffer afterwards.

        Returns:
            The number of bytes taken, which may end within a sample; 0 if the player is full.

        Raises:
            CannotSpeak: The player won't take samples any more. Every later call raises it again.
        """

    def consumed(self) -> int:
        """Return how many of the bytes taken have left for the device; the rest waits and could still be lost.

        The number never shrinks. It reaches all bytes taken by the time `ended` returns True. After `close`, it may
        include bytes that still wait. The word clock starts when it begins to grow, and never runs ahead of it.
        """

    def heard(self) -> float | None:
        """Return how many seconds of the player's stream have been heard; None if the output has no clock.

        It is 0 until the first sample is heard. If there is such a clock, words and pauses follow it instead of
        `consumed`.
        """
        return None

    def close(self) -> None:
        """Take no more samples, and play those already taken to their end.

        Raises:
            CannotSpeak: They can't be played to their end.
        """

    def ended(self) -> bool:
        """Return whether the player was closed and has successfully played everything.

        Raises:
            CannotSpeak: The player failed. This is raised before `close` too, even if no sample is offered.
        """

    def interests(self) -> Sequence[Interest]:
        """Return the open descriptors to poll for room, failure or the end.

        The playback leaves out descriptors that only wait for POLLOUT if it has no samples to offer.
        """

    def wake_at(self) -> float | None:
        """Return the monotonic time at which the player has to be checked again, or None if poll is enough."""

    def kill(self) -> None:
        """Fall silent at once and release what can be released; never raises, and may be called again."""

    def gone(self) -> bool:
        """Return whether the player is certainly silent, and its descriptors, processes and threads are released.

        It is called only after `kill`, every 20 ms. After one second, the whole engine process is given up.
        """
