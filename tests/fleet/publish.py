"""What a bridge publishes for a robot, published by a test."""

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
    """Publish that a robot is online, or that it has gone."""
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
    """Publish the goal that a robot speaks, and the last goal, which ended an hour ago."""
    ended = {"id": last, "state": state, "reason": None, "text": "said before", "at": time.time() - 3600}
    payload = {"active": active, "text": text, "pending": pending, "paused": paused, "last": ended if last else None}
    publisher.publish(f"talk/robot/{name}/status", payload, retain=True)


def event(publisher: Listener, name: str, goal: str, state: str, text: str | None = None) -> None:
    """Publish a state of a goal, with the whole goal if there is a text."""
    payload: dict[str, Any] = {"event": "state", "id": goal, "state": state, "n": 1, "at": time.time()}
    if text is not None:
        payload["goal"] = {"id": goal, "state": state, "text": text}
    publisher.publish(f"talk/robot/{name}/event/state", payload)
