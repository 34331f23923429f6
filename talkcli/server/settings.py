"""What `talk serve` is told by its command line."""

from __future__ import annotations

from talkcli.frozen import frozen
from talkcli.goals.options import INITIAL, Set

#: Clients at once. Each takes a descriptor of the 1,024 that a process usually has.
MAX_CLIENTS = 256
#: Goals that may wait: at two seconds a sentence, more than three minutes of speech that nobody can still want to hear.
MAX_QUEUE = 100


@frozen
class Settings:
    """Options of `serve`, with their defaults."""

    #: of goals that bring none of their own; all of them are given
    goals: Set = INITIAL
    max_queue: int = MAX_QUEUE
    max_text: int = 10_000  # characters
    max_clients: int = MAX_CLIENTS
    player: str | None = None
    device: str | None = None
    lead_in: int = 0  # milliseconds of silence before a sentence, where the device has been idle
    driver: str | None = None
    socket: str | None = None
    socket_mode: int = 0o600
    greeting: str | None = None

    @property
    def for_player(self) -> list[str]:
        """The options that were given and are a player's."""
        given = {"--player": self.player, "--device": self.device, "--lead-in": self.lead_in}
        return [name for name, value in given.items() if value]
