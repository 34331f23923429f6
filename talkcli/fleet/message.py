"""What came from the broker: one message, as whoever judges it needs it. Pure, and of no MQTT library."""

from __future__ import annotations

from talkcli.frozen import frozen


@frozen
class Message:
    """What came in."""

    topic: str
    payload: bytes
    #: whether it was kept for those who come later, or asked to be
    retained: bool = False
    response: str | None = None
    correlation: bytes | None = None
    #: seconds that are left of its life, None for no limit
    expiry: int | None = None
