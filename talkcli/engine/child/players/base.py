"""The interface of a player, and the exceptions that end a sentence.

Samples are signed 16 bit, little-endian, one channel. Lengths are in bytes. `tests/engine/test_player_contract.py`
tests that every player behaves as `Player` promises.
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

#: A file descriptor and the poll events to wait for.
Interest = tuple[int, int]


class CannotSpeak(Exception):
    """Raised if all or part of the sentence can't be spoken.

    Args:
        reason: The machine-readable reason, such as "audio_lost".
        message: The error message.
        final: Whether no other player should be tried, because it wouldn't be heard either.
    """

    def __init__(self, reason: Reason, message: str, *, final: bool = False) -> None:
        super().__init__(message)
        self.reason = reason
        self.final = final


class Stopped(Exception):
    """Raised by the playback if the sentence was stopped."""


class EndedEarly(Stopped):
    """Raised if an `Interrupt` ends the sentence.

    Args:
        rest: The `start` of the `Speak` that continues the goal, or None to repeat the last word that was heard.
    """

    def __init__(self, rest: int | None = None) -> None:
        super().__init__()
        self.rest = rest


class CannotKillPlayer(Exception):
    """Raised if a killed player has not exited in time.

    The engine process must exit, because it can't guarantee silence.
    """


class Player(Protocol):
    """The interface of a player, which plays the samples of one sentence.

    The constructor raises CannotSpeak (`no_player` or `audio_device`) if the output can't be opened, and then leaves
    nothing open. After that, the playback calls the player from a single thread:

    1. It calls `offer` until there are no more samples, then `close` once, then `ended` until it returns True. It may
       read `consumed` and `proven` at any time, and it calls `interests` and `wake_at` right before each wait.
    2. However the sentence ended, it calls `kill`, and then `gone` until that returns True. A stop or an error can lead
       to this step at any point.

    No method blocks, except that `kill` may take some milliseconds to ensure silence. A player does blocking work in a
    thread or process of its own, which wakes the playback through a descriptor.

    A player plays all accepted samples once and in order, and adds no silence. It raises CannotSpeak for faults outside
    of the program, such as an unplugged device or a full disk. Any other exception is a bug in the player.
    """

    #: the name shown to users, which never changes. It also identifies the player that worked last.
    name: str
    #: whether playing takes as long as the sound lasts. If so, a player that accepts no samples has stalled. A player
    #: that writes to a file isn't real-time. The value never changes.
    real_time: bool
    #: whether sound has certainly reached the output. If the player fails after that, no other player repeats the
    #: sentence, because it may have been heard. The value is up to date after each call of `consumed`, and never goes
    #: back to False. A player that stores all samples may start with True.
    proven: bool

    @property
    def output(self) -> Output | None:
        """The device, volume and mute state of the output, or None if they are unknown."""
        return None

    def offer(self, data: memoryview) -> int:
        """Accept as many samples as there is room for. Return the number of bytes accepted.

        Args:
            data: Between one byte and one piece of samples. The caller reuses this buffer after the call.

        Returns:
            The number of accepted bytes, which may include a part of a sample. It is 0 if the player is full.

        Raises:
            CannotSpeak: The player doesn't accept samples any more. Every later call raises this again.
        """

    def consumed(self) -> int:
        """Return how many of the accepted bytes the device has received.

        The other bytes could still be lost. The number never decreases. It includes all accepted bytes once `ended` has
        returned True. After `close`, it may include bytes that the device hasn't received yet. The word clock starts
        when the number starts to grow, and never runs ahead of it.
        """

    def heard(self) -> float | None:
        """Return how many seconds of the stream have been heard, or None if the output has no clock.

        The result is 0 until the first sample is heard. If there is a clock, words and pauses follow it instead of
        `consumed`.
        """
        return None

    def close(self) -> None:
        """Accept no more samples, and let the accepted ones play to the end.

        Return without waiting.

        Raises:
            CannotSpeak: The accepted samples can't be played to the end.
        """

    def ended(self) -> bool:
        """Return whether the player has played everything. Raise CannotSpeak if it has failed.

        The result is False before `close`.

        Raises:
            CannotSpeak: The player failed. This is also raised before `close`, even if no samples are offered.
        """

    def interests(self) -> Sequence[Interest]:
        """Return the descriptors to poll, each with its poll events.

        These are the open descriptors that report room for samples, a failure or the end of the player. The playback
        ignores descriptors that only wait for POLLOUT while it has no samples to offer.
        """

    def wake_at(self) -> float:
        """Return the time at which to call the player again even if no descriptor is ready.

        The result is a time of the monotonic clock, or NEVER.
        """

    def kill(self) -> None:
        """Stop playing at once, and start releasing all resources.

        This method never raises an exception, and may be called again.
        """

    def gone(self) -> bool:
        """Return whether the player is silent and has released its resources.

        Return True only if the player is certainly silent and its descriptors, processes and threads are gone. This
        method is called every 20 ms after `kill`. If it still returns False after one second, the engine process exits.
        """
