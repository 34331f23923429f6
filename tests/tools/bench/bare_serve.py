"""A bare server that does only the minimum for each goal. `throughput` compares talk with it.

For each goal, it reads one line of JSON and writes the five lines that a client receives: reply, PENDING, ACTIVE,
SUCCEEDED and result. Meanwhile, it sends a line to an engine process, whose reply comes through a thread, one goal at a
time. It doesn't check, store or log goals. With `--no-engine`, there is no thread and no engine process.
"""

from __future__ import annotations

import asyncio
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
from talkcli.protocol.lines import MAX_LINE_BYTES, LineSplitter, encode

#: Code of an engine process that ends each sentence at once.
_ENGINE = "import os\nwhile data := os.read(0, 65536):\n    os.write(0, data)"


class Server:
    """The queue of goals. The first goal is active."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._goals: deque[tuple[str, Client]] = deque()
        self._count = 0
        self._engine: socket.socket | None = None
        if "--no-engine" not in sys.argv:
            self._engine, engine_end = socket.socketpair()
            self._process = subprocess.Popen([sys.executable, "-S", "-c", _ENGINE], stdin=engine_end.fileno())
            engine_end.close()
            threading.Thread(target=self._read, args=(self._engine,), daemon=True).start()

    def submit(self, client: Client, seq: int) -> None:
        self._count += 1
        goal_id = f"bare-{self._count}"
        client.send({"seq": seq, "ok": True, "goal": _goal(goal_id, State.PENDING)}, _event(goal_id, State.PENDING))
        self._goals.append((goal_id, client))
        if len(self._goals) == 1:
            self._begin()

    def _begin(self) -> None:
        goal_id, client = self._goals[0]
        if self._engine:
            self._engine.send(json.dumps({"kind": "Say", "id": goal_id, "text": "length=0 words=0"}).encode() + b"\n")
        else:
            self._loop.call_soon(self._end, goal_id)
        client.send(_event(goal_id, State.ACTIVE))

    def _read(self, engine: socket.socket) -> None:
        while data := engine.recv(65536):
            self._loop.call_soon_threadsafe(self._end, json.loads(data)["id"])

    def _end(self, goal_id: str) -> None:
        first, client = self._goals.popleft()
        assert first == goal_id
        if self._goals:
            self._begin()
        state = State.SUCCEEDED
        client.send(_event(goal_id, state), {"event": "result", "goal": _goal(goal_id, state)})


class Client(asyncio.Protocol):
    """A client's connection."""

    def __init__(self, server: Server) -> None:
        self._server = server
        self._transport: asyncio.Transport
        self._lines = LineSplitter(MAX_LINE_BYTES - 1)

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
                self.send(events.ok(request.get("seq")))

    def send(self, *messages: dict[str, object]) -> None:
        """Send messages in one write."""
        self._transport.write(b"".join(map(encode, messages)))


def _goal(goal_id: str, state: State) -> dict[str, object]:
    return Goal(goal_id, state, "length=0 words=0", client=Sender(1, 1, "bench", "bench", "bench")).to_json()


def _event(goal_id: str, state: State) -> dict[str, object]:
    return {"event": "state", "id": goal_id, "state": state.name, "n": 1, "at": 1.5e9}


async def main() -> None:
    loop, path = asyncio.get_running_loop(), os.environ["TALK_SOCKET"]
    server, ended = Server(loop), asyncio.Event()
    loop.add_signal_handler(signal.SIGTERM, ended.set)
    await loop.create_unix_server(lambda: Client(server), path)
    await ended.wait()
    os.unlink(path)


if __name__ == "__main__":
    asyncio.run(main())
