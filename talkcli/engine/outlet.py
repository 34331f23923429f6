"""Where the sound goes: opens a sink for each sentence, as `--player` and `--device` say.

It remembers which player worked, and nothing else: no device is open between two sentences.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from talkcli.engine.nullsink import NullSink
from talkcli.engine.pipe import PlayerPipe
from talkcli.engine.players import commands, on_path
from talkcli.engine.sink import AudioFailed
from talkcli.engine.wavefile import WavFile

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from talkcli.engine.sink import Sink

_FILE = "file:"


class Outlet:
    """The player setting of one engine process."""

    def __init__(self, player: str | None, device: str | None, inherited: Sequence[int] = ()) -> None:
        """`inherited` are descriptors that every player program gets."""
        self._player = player
        self._device = device
        self._inherited = inherited
        self._worked: str | None = None

    def candidates(self, rate: int) -> list[Callable[[], Sink]]:
        """Return what opens the sinks to try for a sentence, best first; AudioFailed if there is none."""
        if self._player == "null":
            return [partial(NullSink, rate)]
        if self._player is not None and self._player.startswith(_FILE):
            return [partial(WavFile, self._player[len(_FILE) :], rate)]
        found = commands(self._player, self._device, rate, on_path, self._worked)
        return [partial(PlayerPipe, command, self._inherited) for command in found]

    def worked(self, name: str) -> None:
        """Take note that a sentence was played whole by the player of this name."""
        self._worked = name

    def first(self) -> str | None:
        """Return the name of what is tried first, for people; None if nothing is found."""
        if self._player is not None:
            return self._player
        try:
            return commands(None, None, 1, on_path, self._worked)[0].name
        except AudioFailed:
            return None
