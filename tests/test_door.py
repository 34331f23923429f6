"""Admission of clients.

A full server admits waiting clients when others leave, and refuses them only if no place becomes free. A server that
ends answers all requests that it has received.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
from typing import TYPE_CHECKING, Any, cast

from talkcli.server.connection import LINES_PER_TURN, ClientConnection
from talkcli.server.run import Server, ServerSettings
from tests.support.loop import in_loop

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

HELLO = b'{"request": "hello"}\n'
SAY = b'{"request": "say", "text": "hello"}\n'
STATUS = b'{"request": "status"}\n'
URGENT = b'{"request": "hello", "urgent": true}\n'


class Client:
    """The client's end of a connection. The server runs in the same process."""

    def __init__(self, first_bytes: bytes = b"") -> None:
        self.server_end, self.socket = socket.socketpair()
        for end in (self.server_end, self.socket):
            end.setblocking(False)
        self.socket.sendall(first_bytes)

    def heard(self) -> list[str]:
        """Return one word for each received line."""
        received = b""
        with contextlib.suppress(BlockingIOError):
            while data := self.socket.recv(65536):
                received += data
        return [_word(json.loads(line)) for line in received.splitlines()]


class Unused:
    """A placeholder for the listener, because these clients already have connected sockets."""

    path, mode = "unused", 0o600


def _word(line: dict[str, Any]) -> str:
    return "greeting" if "boot" in line else str(line.get("error") or line.get("ok", "goal"))


@contextlib.contextmanager
def server_for(clients: int) -> Iterator[Callable[[bytes], Client]]:
    """Return a function that connects a client to a server with this number of places."""
    served = Server(ServerSettings(max_clients=clients), cast("Any", Unused()))
    made: list[Client] = []

    def connect(first_bytes: bytes = b"") -> Client:
        client = Client(first_bytes)
        made.append(client)
        ClientConnection(served, served.speech.streams, client.server_end).begin()
        return client

    try:
        yield connect
    finally:
        for connection in list(served.connections):
            connection.stream.abort()
        for client in made:
            client.socket.close()


async def turns() -> None:
    for _ in range(5):
        await asyncio.sleep(0)


@in_loop
async def test_a_waiting_client_is_admitted_when_another_leaves() -> None:
    with server_for(1) as connect:
        first, second, third = connect(b""), connect(b""), connect(b"")
        await turns()
        assert [client.heard() for client in (first, second, third)] == [["greeting"], [], []]
        first.socket.close()
        await turns()
        assert sorted(client.heard() for client in (second, third)) == [[], ["greeting"]]
    with server_for(1) as connect:
        first = connect(HELLO)
        await turns()
        first.socket.close()
        second = connect(HELLO)  # the server has read nothing since then
        await turns()
        assert second.heard() == ["greeting", "True"]
    await turns()


@in_loop
async def test_a_full_server_admits_urgent_clients_and_lets_silent_ones_wait() -> None:
    with server_for(1) as connect:
        connect(HELLO)
        urgent, other = connect(URGENT), connect(HELLO)
        await turns()
        assert (urgent.heard(), other.heard()) == (["greeting", "True"], ["busy"])
        urgent.socket.close()  # the client was never admitted, so no place becomes free
        late = connect(b"")
        await turns()
        assert late.heard() == []
    await turns()


@in_loop
async def test_a_server_answers_all_received_requests_before_it_ends() -> None:
    served, count = Server(ServerSettings(), cast("Any", Unused())), 3 * LINES_PER_TURN
    client, idle = Client(SAY * count + STATUS), Client()
    for end in (client, idle):
        ClientConnection(served, served.speech.streams, end.server_end).begin()
    await served._close_connections()
    assert client.heard() == ["greeting", *["True"] * count, *["goal"] * count, "True"]
    for end in (client, idle):
        assert end.server_end.fileno() == -1
        end.socket.close()
