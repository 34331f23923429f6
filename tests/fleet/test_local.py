"""The bridge's connection to its server."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import threading
from typing import TYPE_CHECKING, cast

import pytest

from talkcli import __version__
from talkcli.client.core import Exchange
from talkcli.errors import Busy, ServerUnavailable
from talkcli.fleet.bridge.local import LocalConnection
from talkcli.goals.options import Say
from talkcli.protocol.events import busy_greeting, greeting
from talkcli.protocol.lines import decode, encode
from talkcli.protocol.requests import Status
from tests.fleet.conftest import in_loop
from tests.support.surroundings import needs_packages, short_directory

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

    from talkcli.fleet.link import Link

GREETING = encode(greeting(__version__, 7, "a1b2"))
PATIENCE = 10.0
pytestmark = pytest.mark.timeout(20)


@pytest.fixture
def listening() -> Iterator[socket.socket]:
    """The socket of a server. The test sends the greeting."""
    with short_directory() as directory, socket.socket(socket.AF_UNIX) as listening:
        listening.bind(f"{directory}/s")
        listening.listen()
        listening.settimeout(PATIENCE)
        yield listening


async def accepted(listening: socket.socket) -> socket.socket:
    connected, _ = await asyncio.to_thread(listening.accept)
    connected.settimeout(PATIENCE)
    return connected


@contextlib.asynccontextmanager
async def greeted(listening: socket.socket) -> AsyncIterator[tuple[LocalConnection, socket.socket]]:
    """Connect to the socket, and yield both ends of the connection."""
    dialing = asyncio.create_task(LocalConnection.open(listening.getsockname(), name="bob"))
    with await accepted(listening) as server:
        server.sendall(GREETING)
        yield await dialing, server


def lines(connected: socket.socket, count: int) -> list[bytes]:
    with connected.makefile("rb") as file:
        return [file.readline() for _ in range(count)]


@pytest.mark.parametrize("parts", [(GREETING,), (GREETING[:9], GREETING[9:]), (GREETING + b'{"event": 1}\n',)])
@pytest.mark.parametrize("wait", [0.0, 0.5])
@in_loop
async def test_a_greeting_may_arrive_late_or_in_pieces(
    listening: socket.socket, parts: tuple[bytes, ...], wait: float
) -> None:
    dialing = asyncio.create_task(LocalConnection.open(listening.getsockname(), name="bob"))
    with await accepted(listening) as server:
        for part in parts:
            await asyncio.sleep(wait)
            server.sendall(part)
        local = await dialing
        assert (local.boot, local.server.pid) == ("a1b2", 7)
        assert local.send(Exchange(Status()))
        server.sendall(b"answered\n")
        assert await asyncio.to_thread(lines, server, 2) == [
            encode({"request": "hello", "name": "bob"}),
            encode({"seq": 1, "request": "status"}),
        ]
        received = [line for _ in range(len(parts[-1].splitlines())) for line in await local.read()]
        assert received == [*parts[-1].splitlines()[1:], b"answered"]
        local.close()
        assert server.recv(1) == b""


@in_loop
async def test_lines_that_do_not_fit_into_the_socket_are_sent_later_in_order(listening: socket.socket) -> None:
    texts = [f"{number} " + "x" * 60_000 for number in range(50)]
    async with greeted(listening) as (local, server):
        for text in texts:
            assert local.send(Exchange(Say(text)))
        assert not local.send(Exchange(Say("x" * 70_000)))
        sent = (await asyncio.to_thread(lines, server, 51))[1:]
        assert [decode(line)["text"] for line in sent] == texts
        assert local.send(Exchange(Status()))
        assert decode((await asyncio.to_thread(lines, server, 1))[0])["request"] == "status"
        local.close()


@pytest.mark.parametrize("closed_by", ["server", "bridge"])
@in_loop
async def test_a_read_returns_when_the_connection_ends(listening: socket.socket, closed_by: str) -> None:
    async with greeted(listening) as (local, server):
        reading = asyncio.create_task(local.read())
        await asyncio.sleep(0.05)
        if closed_by == "server":
            server.close()
        else:
            local.abort()
        assert await reading == []
        for _ in range(2):
            local.send(Exchange(Status()))
            local.close()
        assert await local.read() == []


@in_loop
async def test_a_server_that_sends_much_does_not_block_the_loop(listening: socket.socket) -> None:
    async with greeted(listening) as (local, server):
        server.setblocking(False)
        sent = 0
        with contextlib.suppress(BlockingIOError):
            while True:
                sent += server.send(b'{"event": "alive"}\n' * 500)
        turns = reads = received = 0

        def count_turn() -> None:
            nonlocal turns
            turns += 1
            asyncio.get_running_loop().call_soon(count_turn)

        count_turn()
        while received < sent // 19:
            received += len(await local.read())
            reads += 1
        assert turns >= reads > 1
        local.close()


@in_loop
async def test_a_connection_ends_if_a_line_cannot_be_sent(listening: socket.socket) -> None:
    """After a partly sent line, the server would read the next line as part of the same request."""
    async with greeted(listening) as (local, server):
        lines(server, 1)
        reading = asyncio.create_task(local.read())
        await asyncio.sleep(0)
        server.shutdown(socket.SHUT_RD)
        local.send(Exchange(Status()))
        assert await reading == []
        local.send(Exchange(Status()))
        local.close()


@pytest.mark.parametrize("answer", [encode(busy_greeting()), b"220 mail\n", b""])
@in_loop
async def test_a_refused_connection_raises_busy_or_unavailable(listening: socket.socket, answer: bytes) -> None:
    dialing = asyncio.create_task(LocalConnection.open(listening.getsockname(), name="bob", patience_s=0.3))
    with contextlib.suppress(TimeoutError):
        while not dialing.done():  # `open` retries while the server is busy
            listening.settimeout(0.5)
            with await accepted(listening) as server:
                server.sendall(answer)
    with pytest.raises(Busy if answer.startswith(b"{") else ServerUnavailable):
        await dialing


@in_loop
async def test_the_next_socket_is_tried_if_a_server_refuses_this_user(
    listening: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("TALK_SOCKET", raising=False)
    with short_directory() as directory, socket.socket(socket.AF_UNIX) as first:
        first.bind(f"{directory}/s")
        first.listen()
        first.settimeout(PATIENCE)
        sockets = [first.getsockname(), listening.getsockname()]
        monkeypatch.setattr("talkcli.paths.client_sockets", lambda _: sockets)
        dialing = asyncio.create_task(LocalConnection.open(name="bob"))
        with await accepted(first) as refusing:
            refusing.sendall(encode({"talk": 1, "error": "forbidden", "message": "not you"}))
            with await accepted(listening) as server:
                server.sendall(GREETING)
                local = await dialing
                assert local.path == listening.getsockname()
                local.close()


@in_loop
async def test_a_server_that_does_not_greet_in_time_is_unavailable(listening: socket.socket) -> None:
    dialing = asyncio.create_task(LocalConnection.open(listening.getsockname(), name="bob", patience_s=0.2))
    with await accepted(listening) as server:
        server.sendall(GREETING[:9])
        with pytest.raises(ServerUnavailable, match=f"doesn't respond; check process {os.getpid()}"):
            await dialing


@pytest.mark.parametrize("canceled", [False, True])
def test_a_link_is_closed_if_it_opens_after_a_cancel(canceled: bool) -> None:
    needs_packages("paho")
    from talkcli.fleet.link import LinkOpener

    class SlowLink:
        go, closed, done = threading.Event(), threading.Event(), threading.Event()

        def open(self) -> None:
            self.go.wait(PATIENCE)

        def close(self) -> None:
            self.closed.set()

    link = SlowLink()
    opener = LinkOpener(cast("Link", link), link.done.set)
    if canceled:
        opener.cancel()
    link.go.set()
    assert (link.closed if canceled else link.done).wait(PATIENCE)
    assert link.closed.is_set() != link.done.is_set()
