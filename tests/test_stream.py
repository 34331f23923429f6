"""The streams of clients: input is read at once, output is sent in one piece, and the end is reported once.

The tests count turns of the event loop and system calls, not time.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import socket
from typing import TYPE_CHECKING

import pytest

from talkcli.server import stream
from talkcli.server.stream import Acceptor, ClientStream, ClientStreams
from tests.support.loop import in_loop

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path


class CountingSocket(socket.socket):
    """A socket that counts its `send` calls."""

    sent = 0

    def send(self, data: bytes, flags: int = 0, /) -> int:  # type: ignore[override]
        self.sent += 1
        return super().send(data, flags)


class Recorder(asyncio.Protocol):
    """A protocol that records the calls of its stream."""

    def __init__(self) -> None:
        self.data = b""
        self.ends = 0
        self.congested: list[bool] = []
        self.lost: list[Exception | None] = []
        self.fault: Exception | None = None

    def data_received(self, data: bytes) -> None:
        self.data += data
        if self.fault:
            raise self.fault

    def eof_received(self) -> None:
        self.ends += 1

    def pause_writing(self) -> None:
        self.congested.append(True)

    def resume_writing(self) -> None:
        self.congested.append(False)

    def connection_lost(self, error: Exception | None) -> None:
        self.lost.append(error)


class Pair:
    """A stream, its recorded calls, and the client's end of the socket."""

    def __init__(self) -> None:
        server_end, self.client = socket.socketpair()
        self.socket = CountingSocket(fileno=server_end.detach())
        for end in (self.socket, self.client):
            end.setblocking(False)
        self.recorder = Recorder()
        self.stream = ClientStream(ClientStreams(), self.socket, self.recorder)

    def receive(self) -> bytes:
        """Return the bytes that the client has received."""
        received = b""
        with contextlib.suppress(BlockingIOError, ConnectionResetError):
            while data := self.client.recv(1 << 20):
                received += data
        return received


@contextlib.asynccontextmanager
async def paired() -> AsyncIterator[Pair]:
    pair = Pair()
    try:
        yield pair
    finally:
        pair.client.close()
        pair.stream.abort()
        await turn()


async def turn() -> None:
    """Let the event loop run the callbacks that are due, and the callbacks that these schedule."""
    await asyncio.sleep(0)
    await asyncio.sleep(0)


async def until_lost(pair: Pair) -> None:
    for _ in range(100):
        if pair.recorder.lost:
            return
        await asyncio.sleep(0.01)
    pytest.fail("the end of the stream wasn't reported")


@in_loop
async def test_begin_reads_waiting_input_and_sends_waiting_output_at_once() -> None:
    async with paired() as pair:
        pair.client.send(b"hello\n")
        pair.stream.write(b"greeting\n")
        pair.stream.begin()
        assert (pair.recorder.data, pair.receive()) == (b"hello\n", b"greeting\n")


@in_loop
async def test_the_output_of_one_turn_is_sent_in_one_piece() -> None:
    async with paired() as pair:
        pair.stream.begin()
        for number in range(5):
            pair.stream.write(b"%d\n" % number)
        assert (pair.receive(), pair.socket.sent) == (b"", 0)
        await turn()
        assert (pair.receive(), pair.socket.sent) == (b"0\n1\n2\n3\n4\n", 1)
        await turn()
        assert pair.socket.sent == 1


@in_loop
async def test_large_output_is_sent_before_the_turn_ends() -> None:
    async with paired() as pair:
        pair.stream.begin()
        pair.stream.write(b"x" * 65_536)
        assert len(pair.receive()) == 65_536


@in_loop
async def test_congestion_is_reported_once_and_all_output_arrives() -> None:
    async with paired() as pair:
        pair.stream.begin()
        written = b""
        while not pair.recorder.congested:
            written += b"%08d" % len(written) * 1_000
            pair.stream.write(written[-8_000:])
        assert pair.stream.unsent_bytes > stream.CONGESTION_BYTES
        written += b"the rest"
        pair.stream.write(b"the rest")
        received = b""
        while len(received) < len(written):
            received += pair.receive()
            await turn()
        assert received == written
        assert (pair.recorder.congested, pair.stream.unsent_bytes) == ([True, False], 0)


@in_loop
async def test_reading_can_be_paused_and_resumed() -> None:
    async with paired() as pair:
        pair.stream.begin()
        pair.stream.pause_reading()
        pair.client.send(b"hello\n")
        await turn()
        assert pair.recorder.data == b""
        for _ in range(2):
            pair.stream.resume_reading()
        await turn()
        assert pair.recorder.data == b"hello\n"


@in_loop
async def test_the_end_of_input_is_reported_once_and_replies_are_still_sent() -> None:
    async with paired() as pair:
        pair.stream.begin()
        pair.client.shutdown(socket.SHUT_WR)
        await turn()
        pair.stream.pause_reading()
        pair.stream.resume_reading()
        await turn()
        assert (pair.recorder.ends, pair.recorder.lost, pair.stream.closing) == (1, [], False)
        pair.stream.write(b"answer\n")
        pair.stream.close()
        await until_lost(pair)
        assert (pair.receive(), pair.recorder.lost) == (b"answer\n", [None])


def test_close_sends_the_remaining_output_and_abort_does_not() -> None:
    async def play(*, abort: bool) -> int:
        async with paired() as pair:
            pair.stream.begin()
            pair.stream.write(b"x" * 1_000_000)
            pair.stream.close()
            if abort:
                pair.stream.abort()
            pair.stream.write(b"not any more")
            received = 0
            while not pair.recorder.lost:
                received += len(pair.receive())
                await turn()
            pair.stream.close()
            pair.stream.abort()
            await turn()
            assert pair.recorder.lost == [None]
            return received + len(pair.receive())

    assert asyncio.run(play(abort=False)) == 1_000_000
    assert asyncio.run(play(abort=True)) < 1_000_000


@in_loop
async def test_input_can_be_read_after_a_write_to_a_closed_client_failed() -> None:
    async with paired() as pair:
        pair.stream.begin()
        pair.stream.pause_reading()
        pair.client.send(b"a last request\n")
        pair.client.close()
        pair.stream.write(b"answer\n")
        last = []
        pair.recorder.connection_lost = lambda error: last.append((error, pair.socket.recv(100)))  # type: ignore[method-assign]
        await turn()
        ((error, received),) = last
        assert isinstance(error, BrokenPipeError)
        assert received == b"a last request\n"
        assert pair.socket.fileno() == -1


@in_loop
async def test_a_bug_in_the_receiver_ends_the_connection() -> None:
    errors = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: errors.append(context["exception"]))
    async with paired() as pair:
        pair.recorder.fault = ZeroDivisionError("a bug")
        pair.stream.begin()
        pair.client.send(b"hello\n")
        await until_lost(pair)
    assert [type(error) for error in errors] == [ZeroDivisionError]


@in_loop
async def test_one_callback_sends_the_output_of_all_streams() -> None:
    loop = asyncio.get_running_loop()
    calls = []
    streams = ClientStreams()
    call = loop.call_soon
    async with paired() as first, paired() as second:
        pairs = [first, second]
        for pair in pairs:
            pair.stream = ClientStream(streams, pair.socket, pair.recorder)
        loop.call_soon = lambda *values, **named: calls.append(call(*values, **named))  # type: ignore[assignment, method-assign]
        for _ in range(3):
            for pair in pairs:
                pair.stream.write(b"word\n")
        loop.call_soon = call  # type: ignore[method-assign]
        assert len(calls) == 1
        await turn()
        assert [pair.receive() for pair in pairs] == [b"word\n" * 3] * 2


@in_loop
async def test_the_client_with_the_largest_backlog_is_dropped_at_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    streams = ClientStreams()
    async with contextlib.AsyncExitStack() as stack:
        pairs = [await stack.enter_async_context(paired()) for _ in range(3)]
        for pair in pairs:
            pair.stream = ClientStream(streams, pair.socket, pair.recorder)
            pair.stream.write(b"x" * 1_000_000)  # exceeds the socket's buffer
        taken = 1_000_000 - pairs[0].stream.unsent_bytes
        monkeypatch.setattr(stream, "MAX_TOTAL_OUTPUT_BYTES", streams.unread_bytes + 3_000)
        pairs[0].stream.write(b"x" * 1_000)
        pairs[1].stream.adjust_held_bytes(1_500)  # like a list that the client doesn't read
        pairs[1].stream.adjust_held_bytes(500)
        assert not any(pair.stream.closing for pair in pairs)
        pairs[2].stream.write(b"x" * 1_000)
        await until_lost(pairs[1])
        assert [pair.stream.closing for pair in pairs] == [False, True, False]
        assert streams.unread_bytes == 2 * (1_000_000 - taken) + 2_000
        pairs[1].stream.adjust_held_bytes(-2_000)  # must have no effect after the stream has ended
        assert len(pairs[0].receive()) == taken
        await turn()
        assert streams.unread_bytes == pairs[0].stream.unsent_bytes + pairs[2].stream.unsent_bytes
        for pair in (pairs[0], pairs[2]):
            pair.stream.abort()
        assert (streams.unread_bytes, streams.open) == (0, set())


class FullSocket(socket.socket):
    """A listening socket that accepts no connection at first, because no file descriptor is free."""

    failures = 1

    def accept(self) -> tuple[socket.socket, str]:
        if self.failures:
            self.failures -= 1
            raise OSError(errno.EMFILE, "Too many open files")
        return super().accept()


@in_loop
async def test_connections_are_accepted_when_a_descriptor_is_free_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(stream, "ACCEPT_RETRY_S", 0.01)
    accepted: asyncio.Queue[socket.socket] = asyncio.Queue()
    with FullSocket(socket.AF_UNIX) as listening, socket.socket(socket.AF_UNIX) as client:
        listening.bind(str(tmp_path / "s"))
        listening.listen()
        listening.setblocking(False)
        client.connect(str(tmp_path / "s"))
        acceptor = Acceptor(accepted.put_nowait, 10_000)
        acceptor.open(listening)
        await turn()
        assert (listening.failures, accepted.qsize()) == (0, 0)
        (await asyncio.wait_for(accepted.get(), 10)).close()
        acceptor.close()
