"""What `talk serve` is told by its command line."""

from __future__ import annotations

from talkcli.frozen import frozen

#: Clients at once. Each takes a descriptor of the 1,024 that a process usually has.
MAX_CLIENTS = 256
#: Goals that may wait: at two seconds a sentence, more than three minutes of speech that nobody can still want to hear.
MAX_QUEUE = 100


@frozen
class Settings:
    """Options of `serve`, with their defaults."""

    rate: int = 200  # words per minute
    volume: float = 1.0  # 0.0 to 1.0
    voice: str | None = None  # id, name or language
    pitch: int = 50  # 0 to 100
    preempt: bool = False
    ttl: float = 0.0  # seconds in which a goal must begin; 0 for no limit
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
