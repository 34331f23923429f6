"""A server that keeps none of talk's promises: the least that any server of this shape does for a goal, and no more.

What it takes is the floor of the rows of `throughput`. For each goal it reads one line of JSON, writes the five that a
client is told (reply, PENDING, ACTIVE, SUCCEEDED, result), and between them hands a line to an engine process, whose
answer comes back by way of a thread, one goal at a time. It checks nothing, remembers nothing, logs nothing, and knows
no limit. With `--alone` there is no thread and no process: what a server could do that speaks in its own.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections import deque

from talkcli.goals.goal import Goal, Sender
from talkcli.goals.states import State
from talkcli.protocol import events
from talkcli.protocol.lines import MAX_LINE, LineSplitter, encode

#: An engine process that ends each sentence at once.
_ENGINE = "import os\nwhile data := os.read(0, 65536):\n    os.write(0, data)"
_READY = {"server": {"engine": "ready"}, "active": None}


class Engine:
    """An engine process, and a thread that reads what it says: `ended` is called in the loop for each line."""

    def __init__(self, loop: asyncio.AbstractEventLoop, server: Server) -> None:
        self._loop, self._server = loop, server
        self._socket, theirs = socket.socketpair()
        self._process = subprocess.Popen([sys.executable, "-S", "-c", _ENGINE], stdin=theirs.fileno())
        theirs.close()
        threading.Thread(target=self._run, daemon=True).start()

    def say(self, goal_id: str) -> None:
        """Hand a goal to the process."""
        self._socket.send(json.dumps({"kind": "Say", "id": goal_id, "text": "length=0 words=0"}).encode() + b"\n")

    def _run(self) -> None:
        while data := self._socket.recv(65536):
            self._loop.call_soon_threadsafe(self._server.ended, json.loads(data)["id"])


class Alone:
    """No engine: every goal has ended in the next turn of the loop."""

    def __init__(self, loop: asyncio.AbstractEventLoop, server: Server) -> None:
        self._loop, self._server = loop, server

    def say(self, goal_id: str) -> None:
        """End a goal."""
        self._loop.call_soon(self._server.ended, goal_id)


class Server:
    """The queue: the first goal of it is with the engine."""

    def __init__(self, loop: asyncio.AbstractEventLoop, engine: type[Engine | Alone]) -> None:
        self._engine = engine(loop, self)
        self._goals: deque[tuple[str, Client]] = deque()
        self._count = 0

    def submit(self, client: Client, seq: int) -> None:
        """Accept a goal."""
        self._count += 1
        goal_id = f"bare-{self._count}"
        client.send({"seq": seq, "ok": True, "goal": _goal(goal_id, State.PENDING)}, _event(goal_id, State.PENDING))
        self._goals.append((goal_id, client))
        if len(self._goals) == 1:
            self._begin()

    def ended(self, goal_id: str) -> None:
        """End the goal that the engine had, and begin the next."""
        first, client = self._goals.popleft()
        assert first == goal_id
        if self._goals:
            self._begin()
        state = State.SUCCEEDED
        client.send(_event(goal_id, state), {"event": "result", "goal": _goal(goal_id, state)})

    def _begin(self) -> None:
        goal_id, client = self._goals[0]
        self._engine.say(goal_id)
        client.send(_event(goal_id, State.ACTIVE))


class Client(asyncio.Protocol):
    """A client."""

    def __init__(self, server: Server) -> None:
        self._server = server
        self._transport: asyncio.Transport
        self._lines = LineSplitter(MAX_LINE - 1)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        self.send(events.greeting("0", os.getpid(), "bare"))

    def data_received(self, data: bytes) -> None:
        for line in self._lines.feed(data):
            request = json.loads(line)
            if request["request"] == "say":
                self._server.submit(self, request["seq"])
            else:
                self.send(events.ok(request.get("seq"), **_READY))

    def send(self, *messages: dict[str, object]) -> None:
        """Write these lines in one piece."""
        self._transport.write(b"".join(map(encode, messages)))


def _goal(goal_id: str, state: State) -> dict[str, object]:
    return Goal(goal_id, state, "length=0 words=0", client=Sender(1, 1, "bench", "bench", "bench")).to_json()


def _event(goal_id: str, state: State) -> dict[str, object]:
    return {"event": "state", "id": goal_id, "state": state.name, "n": 1, "at": 1.5e9}


async def main() -> None:
    """Serve until SIGTERM."""
    loop = asyncio.get_running_loop()
    server = Server(loop, Alone if "--alone" in sys.argv else Engine)
    ended = asyncio.Event()
    loop.add_signal_handler(signal.SIGTERM, ended.set)
    with contextlib.closing(socket.socket(socket.AF_UNIX)) as listening:
        listening.bind(os.environ["TALK_SOCKET"])
        await loop.create_unix_server(lambda: Client(server), sock=listening)
        await ended.wait()


if __name__ == "__main__":
    asyncio.run(main())
