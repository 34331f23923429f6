"""The door of a full server: who waits there comes in when another leaves, and is sent away only if none does."""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
from typing import TYPE_CHECKING, Any, cast

from talkcli.server.connection import Connection
from talkcli.server.run import Server, Settings

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

HELLO = b'{"request": "hello"}\n'
URGENT = b'{"request": "hello", "urgent": true}\n'


class Client:
    """A client's end of a connection, in this process."""

    def __init__(self, says: bytes = b"") -> None:
        self.theirs, self.socket = socket.socketpair()
        for each in (self.theirs, self.socket):
            each.setblocking(False)
        self.socket.sendall(says)

    def heard(self) -> list[str]:
        """Return what it was told by now, in a word for each line."""
        told = b""
        with contextlib.suppress(BlockingIOError):
            while data := self.socket.recv(65536):
                told += data
        return [_word(json.loads(line)) for line in told.splitlines()]


class Unused:
    """A listener: who connects here has a socket already."""

    path, mode = "unused", 0o600


def _word(line: dict[str, Any]) -> str:
    return "greeting" if "boot" in line else str(line.get("error") or line["ok"])


@contextlib.contextmanager
def server_for(clients: int) -> Iterator[Callable[[bytes], Client]]:
    """Give what connects a client, which has said something already, to a server with so many places."""
    served = Server(Settings(max_clients=clients), cast("Any", Unused()))
    made: list[Client] = []

    def connect(says: bytes = b"") -> Client:
        client = Client(says)
        made.append(client)
        Connection(served, served.speech.streams, client.theirs).begin()
        return client

    try:
        yield connect
    finally:
        for each in list(served.connections):
            each.stream.abort()
        for client in made:
            client.socket.close()


async def turns() -> None:
    for _ in range(5):
        await asyncio.sleep(0)


def test_who_waits_at_the_door_is_greeted_when_another_leaves() -> None:
    async def play() -> None:
        with server_for(1) as connect:
            first, second, third = connect(b""), connect(b""), connect(b"")
            await turns()
            assert [each.heard() for each in (first, second, third)] == [["greeting"], [], []]
            first.socket.close()
            await turns()
            assert sorted(each.heard() for each in (second, third)) == [[], ["greeting"]]
        await turns()

    asyncio.run(play())


def test_who_comes_as_another_goes_is_not_sent_away() -> None:
    async def play() -> None:
        with server_for(1) as connect:
            first = connect(HELLO)
            await turns()
            first.socket.close()
            second = connect(HELLO)  # nothing was read since
            await turns()
            assert second.heard() == ["greeting", "True"]
        await turns()

    asyncio.run(play())


def test_nobody_is_sent_away_before_a_word_and_who_is_in_a_hurry_gets_in() -> None:
    async def play() -> None:
        with server_for(1) as connect:
            connect(HELLO)
            urgent, other = connect(URGENT), connect(HELLO)
            await turns()
            assert (urgent.heard(), other.heard()) == (["greeting", "True"], ["busy"])
            urgent.socket.close()  # it had no place of its own: nobody comes in for it
            late = connect(b"")
            await turns()
            assert late.heard() == []
        await turns()

    asyncio.run(play())
