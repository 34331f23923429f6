"""Robots that are told of alone: what a bridge would publish, by a client of a test's own."""

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
    """Say that a robot is there, with a server or without (None), or that it is gone."""
    said: dict[str, Any] = {"talk": 1, "online": online, "session": session, "groups": ["all", *groups]}
    if online:
        said |= {"version": "0.1.0", "since": time.time() - 7200, "allow": ["say"], "server": server}
    publisher.publish(f"talk/robot/{name}/presence", said, retain=True)


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
    """Say what a robot speaks: the goal `active` with a text; and that `last` has ended, an hour ago."""
    ended = {"id": last, "state": state, "reason": None, "text": "said before", "at": time.time() - 3600}
    said = {"active": active, "text": text, "pending": pending, "paused": paused, "last": ended if last else None}
    publisher.publish(f"talk/robot/{name}/status", said, retain=True)


def event(publisher: Listener, name: str, goal: str, state: str, text: str | None = None) -> None:
    """Say that a goal of a robot's is in another state; with a text, the whole goal is told."""
    said: dict[str, Any] = {"event": "state", "id": goal, "state": state, "n": 1, "at": time.time()}
    if text is not None:
        said["goal"] = {"id": goal, "state": state, "text": text}
    publisher.publish(f"talk/robot/{name}/event/state", said)
