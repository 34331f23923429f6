"""The client library for asyncio.

    from talkcli.aio import Client

    async with Client(name="patrol") as talk:
        goal = await talk.say("battery low")

It has the names, options and errors of the blocking library. `connection` runs the blocking library's connections in an
event loop, and `client` has the client and its handles. Both libraries share the coroutines in `talkcli.client`. This
package must not decide what is sent, or when to reconnect.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from talkcli.aio.client import Client, GoalHandle, SpeechStream

if TYPE_CHECKING:
    from talkcli.fleet.aio import Fleet

__all__ = ["Client", "Fleet", "GoalHandle", "SpeechStream"]


def __getattr__(name: str) -> object:
    if name != "Fleet":  # only fleets need paho-mqtt
        raise AttributeError(f"module 'talkcli.aio' has no attribute {name!r}")
    from talkcli.fleet.aio import Fleet

    return Fleet
