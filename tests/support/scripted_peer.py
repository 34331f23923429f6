"""A server for one client that follows a script, to test clients with slow and broken servers.

A script is a function that gets the server's end of the connection, after the greeting.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import socket
import threading
from typing import TYPE_CHECKING, Any

from talkcli.goals.goal import Goal
from talkcli.goals.states import State
from tests.support.connection import PATIENCE
from tests.support.surroundings import short_directory

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

GREETING = b'{"talk": 1, "version": "0", "pid": 1, "boot": "fake", "features": []}\n'
#: The fields of a reply to `watch` or `status`.
OVERVIEW: dict[str, Any] = {"server": {"pid": 1}, "active": None}


def goal(state: str = "SUCCEEDED", goal_id: str = "g") -> dict[str, Any]:
    """Return a goal as the protocol represents it."""
    return Goal(goal_id, State[state], "a b c").to_json()


def result(state: str = "SUCCEEDED") -> dict[str, Any]:
    """Return the result event of the goal `g`."""
    return {"event": "result", "goal": goal(state)}


class Peer:
    """The server's end of a connection, after the greeting and the hello."""

    def __init__(self, connected: socket.socket) -> None:
        self._socket = connected
        self._socket.settimeout(PATIENCE)
        self._file = connected.makefile("rb")
        self._events = itertools.count(1)
        #: size of the longest request in bytes
        self.longest = 0

    def receive(self, kind: str | None = None) -> dict[str, Any]:
        """Return the next request, which must be of this kind."""
        line = self._file.readline()
        assert line, f"the client closed the connection instead of sending {kind}"
        self.longest = max(self.longest, len(line))
        request: dict[str, Any] = json.loads(line)
        assert kind is None or request["request"] == kind, request
        return request

    def send(self, *messages: dict[str, Any]) -> None:
        self._socket.sendall(b"".join(json.dumps(message).encode() + b"\n" for message in messages))

    def accept(self) -> None:
        """Accept the next goal with the id `g`."""
        self.reply("say", goal=goal("PENDING"))

    def reply(self, kind: str, **fields: object) -> None:
        self.send({"seq": self.receive(kind)["seq"], "ok": True, **fields})

    def hang_up(self) -> None:
        self._socket.shutdown(socket.SHUT_RDWR)
        self._file.close()
        self._socket.close()

    def state(self, state: str, **fields: object) -> dict[str, Any]:
        return {"event": "state", "id": "g", "state": state, "n": next(self._events), "at": 1.5, **fields}

    def word(self, number: int = 1) -> dict[str, Any]:
        place = {"start": 0, "end": 1, "number": number, "time": 0.25}
        return {"event": "word", "id": "g", "word": "a", **place, "n": next(self._events), "at": 2.5}


@contextlib.contextmanager
def serving(play: Callable[[Peer], None]) -> Iterator[str]:
    """Serve one client by a script, and yield the path of the socket. At the end, raise the script's exception."""
    failures: list[BaseException] = []

    def serve() -> None:
        try:
            connected, _ = listening.accept()
            with connected:
                connected.sendall(GREETING)
                peer = Peer(connected)
                peer.receive("hello")
                play(peer)
                with contextlib.suppress(OSError):
                    while connected.recv(65536):
                        pass
        except BaseException as error:  # noqa: BLE001 - raised in the test's thread
            failures.append(error)

    with short_directory() as directory, socket.socket(socket.AF_UNIX) as listening:
        listening.bind(f"{directory}/s")
        listening.listen()
        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        try:
            yield f"{directory}/s"
        finally:
            thread.join(2 * PATIENCE)
        assert not thread.is_alive(), "the script has not ended"
        if failures:
            raise failures[0]
