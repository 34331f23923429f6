"""Which voices are being loaded, and for how long a goal waits for its own: no voice is the reason for silence.

Pure: it keeps what it is told; who begins with a voice, and who speaks in its place, is the engine's business. Neural
voices are named by their ids; every other voice is there at once, and never here.
"""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

from talkcli.goals.options import model_of

if TYPE_CHECKING:
    from talkcli.goals.record import Record

#: Seconds after which a goal waits no longer for a voice that is being loaded: on a small machine it takes three.
PATIENCE = 10.0
#: Seconds of a goal's time to live that are left when it waits no longer: enough to begin before it expires.
SPARE = 0.5


class Loading:
    """The voices that are being loaded."""

    def __init__(self) -> None:
        #: since when, in monotonic seconds; inf for one that is yet to be begun with
        self._since: dict[str, float] = {}

    def wait_for(self, voice: str) -> None:
        """Have goals wait for a voice that will be loaded."""
        self._since.setdefault(voice, inf)

    def begin(self, voice: str, now: float) -> None:
        """Have goals wait for a voice that is being loaded from now on."""
        self._since[voice] = now

    def end(self, voice: str) -> None:
        """Have none wait for it any more: it is there, or won't come."""
        self._since.pop(voice, None)

    def clear(self) -> None:
        """Have none wait for any voice."""
        self._since.clear()

    def begins_at(self, record: Record, usual: str | None) -> float:
        """Return the monotonic time from which on a goal may begin whose turn it is; 0 for at once.

        `usual`: the voice of those that have none of their own. Who is urgent waits for no voice, nor who would expire
        meanwhile; who insists on it waits until it is there, or it is known that it won't be. The time counts
        from when the voice was begun with; where it is not, from the goal's turn.
        """
        since = self._since.get(model_of(record.say.voice or usual)) if self._since else None
        if since is None:
            return 0.0
        if record.say.voice_only:
            return inf
        if record.preempt or record.priority > 0:
            return 0.0
        patience = (since if since < inf else record.turn_at) + PATIENCE
        return patience if record.expires_at is None else min(patience, record.expires_at - SPARE)
