"""The goal that the engine thread has in hand: what it was told, and how far it has come. It does nothing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from talkcli.engine.protocol import Ended, Say
    from talkcli.engine.spawn import EngineProcess


@dataclass(slots=True, eq=False)
class Handed:
    """A goal from the moment it is handed in until its `Ended` is posted."""

    say: Say
    #: when the process last gave a sign of life for it; None while it waits for a process
    heard_at: float | None = None
    #: whether the process said that it has begun with it
    started: bool = False
    #: whether a process that had it died before it began with it
    again: bool = False
    #: when the process was told to stop it
    stop_at: float | None = None
    #: the number of the pause that it is to be held for, by the process that speaks it, else by the thread
    pause: int | None = None
    #: when a process was told of it, until it is confirmed
    pause_at: float | None = None
    #: how it ended, once the process that spoke it is known to be gone
    verdict: Ended | None = None
    #: … and that process
    verdict_on: EngineProcess | None = None

    @property
    def id(self) -> str:
        """The goal's id."""
        return self.say.id

    @property
    def spoken(self) -> bool:
        """Whether a process has it."""
        return self.heard_at is not None

    @property
    def ending(self) -> bool:
        """Whether it was told to stop, or has lost its process."""
        return self.stop_at is not None or self.verdict is not None
