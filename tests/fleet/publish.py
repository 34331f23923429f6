"""Functions that publish the messages of a bridge."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tests.support.mqtt import Listener

SERVER = {"boot": "7r2z", "pid": 4711, "version": "0.1.0"}


def presence(
    publisher: Listener,
    name: str,
    *,
    online: bool = True,
    session: str = "5e55",
    groups: Sequence[str] = (),
    server: dict[str, Any] | None = SERVER,
) -> None:
    """Publish that a robot is online or offline."""
    payload: dict[str, Any] = {"talk": 1, "online": online, "session": session, "groups": ["all", *groups]}
    if online:
        payload |= {"version": "0.1.0", "since": time.time() - 7200, "allow": ["say"], "server": server}
    publisher.publish(f"talk/robot/{name}/presence", payload, retain=True)


def status(
    publisher: Listener,
    name: str,
    *,
    active: str | None = None,
    text: str | None = None,
    last: str | None = None,
    state: str = "SUCCEEDED",
    pending: int = 0,
    paused: bool = False,
) -> None:
    """Publish the active goal of a robot, and its last goal, which ended an hour ago."""
    ended = {"id": last, "state": state, "reason": None, "text": "said before", "at": time.time() - 3600}
    payload = {"active": active, "text": text, "pending": pending, "paused": paused, "last": ended if last else None}
    publisher.publish(f"talk/robot/{name}/status", payload, retain=True)


def event(publisher: Listener, name: str, goal: str, state: str, text: str | None = None) -> None:
    """Publish the state of a goal, and the full goal if `text` is given."""
    payload: dict[str, Any] = {"event": "state", "id": goal, "state": state, "n": 1, "at": time.time()}
    if text is not None:
        payload["goal"] = {"id": goal, "state": state, "text": text}
    publisher.publish(f"talk/robot/{name}/event/state", payload)
