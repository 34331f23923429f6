"""What takes the samples of one sentence: the interface of a player, its contract, and the errors that end a sentence.

Samples are signed 16 bit, little-endian, one channel; lengths are in bytes. Nothing here opens or starts anything.
`tests/engine/test_player_contract.py` puts every player through what `Player` says.
"""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Protocol

    from talkcli.goals.goal import Output
else:
    Protocol = object

#: bytes of one sample: 16 bit, one channel.
SAMPLE = 2

#: Seconds of sound that are offered at once: small, so that little is on its way when it has to be silent.
PIECE = 0.02

#: A file descriptor and the poll events that are waited for on it.
Interest = tuple[int, int]


class CannotSpeak(Exception):
    """The sentence cannot be spoken (any further): `reason` is for programs, the text for people.

    `final`: no other player would be heard either, so none is tried.
    """

    def __init__(self, reason: str, message: str, *, final: bool = False) -> None:
        super().__init__(message)
        self.reason = reason
        self.final = final


class Stopped(Exception):
    """The sentence was stopped."""


class CannotEnd(Exception):
    """A player was killed and is not gone: nobody knows whether it is silent, and this process is of no more use."""


class Player(Protocol):
    """Where the samples of one sentence go: opened for it, and never used again after it.

    What opens a player raises CannotSpeak (`no_player`, `audio_device`) where that is impossible, and leaves nothing
    open then. From there on the playback alone calls it, in one thread: `offer` as long as there are samples, then
    `close` once, then `ended` until it is true; `consumed` and `proven` in between, at any time. `interests` and
    `wake_at` are asked right before each wait. A sentence may end at any point of this, by a stop or an error; last
    comes `kill`, however it ended, and `gone` until it is true.

    Nothing in a player blocks or waits: what would is done in another thread or process of its own, which wakes the
    playback by a descriptor. But for `kill`: it may take some milliseconds where silence is certain then. It plays
    what it took, all of it, in order and once, without silence of its own. A mistake of the world (a device that is
    unplugged, a full disk) is CannotSpeak; any other exception is a mistake of the player's.
    """

    #: the player's name, for people, and to find it again among those that worked. It never changes.
    name: str
    #: True where sound takes as long as it lasts, so that a player which takes none is stuck; False for a file, which
    #: is done at once and never heard. It never changes.
    real_time: bool
    #: True once it is sure that sound has been taken: from then on it may have been heard, and is not played again.
    #: Before that, the sentence goes to the next player if this one fails. Up to date after `consumed`, and never False
    #: again; a player that never lets go of what it was offered may be born with it.
    proven: bool

    @property
    def output(self) -> Output | None:
        """Where the sound goes, and how loud; None as long as that isn't known, for ever where it can't be."""
        return None

    def offer(self, data: memoryview) -> int:
        """Take what fits now and return its length, which may end within a sample; 0 if it is full.

        `data` is never empty, no longer than a piece, and is not to be kept: it is overwritten afterwards. CannotSpeak
        if the player takes nothing any more, then and each time from then on.
        """

    def consumed(self) -> int:
        """Return how much of what `offer` took has left for the device; the rest waits, and could still be lost.

        It never shrinks, is never more than was taken, and comes to all of it by the time that `ended` is true; after
        `close` it may count what the player has still to take. The word clock starts where it begins to grow, and is
        held back by it.
        """

    def heard(self) -> float | None:
        """Return the seconds of its stream that are heard by now, where the output has a clock; None where it has none.

        0 until it begins to be heard. Words and pauses go by this then, and not by what was consumed.
        """
        return None

    def close(self) -> None:
        """Take note that no more samples follow: what was taken is played to its end. CannotSpeak if that is lost."""

    def ended(self) -> bool:
        """Return True when all was played and it ended well after `close`, False while it goes on.

        CannotSpeak in any other case, before `close` as well: one that knows itself lost says so here, without a sample
        to be offered.
        """

    def interests(self) -> Sequence[Interest]:
        """Return what to poll for until it can take more, or fails, or ends: open descriptors.

        Room for more is POLLOUT and nothing beside it: that is left out where there is nothing to be offered.
        """

    def wake_at(self) -> float | None:
        """Return the monotonic time at which to look again, whatever poll says; None if poll will tell."""

    def kill(self) -> None:
        """Be silent now, whatever is left, and release what can be; never raises, and may be called again."""

    def gone(self) -> bool:
        """Return True once it is silent for certain and everything of it is released: descriptors, processes, threads.

        Asked after `kill` alone, every 20 ms; after a second the whole engine process is given up.
        """


class BuiltIn(Player):
    """What the players that are no programs have in common: what they took is gone at once, and so are they."""

    proven = True

    def __init__(self) -> None:
        self._taken = 0
        self._closed = False

    def consumed(self) -> int:
        """Return what was taken."""
        return self._taken

    def close(self) -> None:
        """Take note that the sound ends here."""
        self._closed = True

    def ended(self) -> bool:
        """Return True once it is closed."""
        return self._closed

    def interests(self) -> Sequence[Interest]:
        """Return nothing."""
        return ()

    def wake_at(self) -> float | None:
        """Return "at once"."""
        return 0.0

    def kill(self) -> None:
        """Take no more: there is nothing to silence."""
        self._closed = True

    def gone(self) -> bool:
        """Return True: nothing is ever left."""
        return True
