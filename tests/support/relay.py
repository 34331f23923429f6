"""A relay in front of PulseAudio's socket that can delay, cut or change the server's replies.

It never waits. `pump` forwards the data that has come, up to the test's limits.
"""

from __future__ import annotations

import contextlib
import select
import socket
import struct

#: Header of a frame: length, channel, high and low half of an offset, flags.
_HEADER = struct.Struct(">5I")
#: Channel of control messages.
_CONTROL = 0xFFFFFFFF
#: A 32-bit number in a message, and commands. The first number of a message is its command.
_NUMBER = struct.Struct(">cI")
_ERROR, _REPLY = 0, 2


class Relay(contextlib.AbstractContextManager["Relay"]):
    """Accepts one client at the socket `path`, and connects it with the server at `server`."""

    def __init__(self, path: str, server: str) -> None:
        #: bytes that are forwarded in one step
        self.piece = 65536
        #: number of bytes from the server after which the connection is cut, or becomes silent
        self.cut_at: int | None = None
        self.silent_at: int | None = None
        #: index of the reply that is replaced by an error, and the error's code
        self.error: tuple[int, int] | None = None
        #: number of bytes and replies from the server that were forwarded
        self.forwarded = self.replies = 0
        self._server = server
        self._listening = socket.socket(socket.AF_UNIX)
        self._listening.bind(path)
        self._listening.listen(1)
        self._listening.setblocking(False)
        self._client: socket.socket | None = None
        self._up: socket.socket | None = None
        self._to_server, self._to_client, self._frames = bytearray(), bytearray(), bytearray()

    def __exit__(self, *_error: object) -> None:
        self._listening.close()
        self._hang_up()

    def pump(self) -> None:
        """Forward data in both directions, up to the limits."""
        if self._client is None:
            self._accept()
        if self._client is None or self._up is None:
            return
        try:
            self._to_server += _read(self._client)
            self._frames += _read(self._up)
            self._take_frames()
            _write(self._up, self._to_server, self.piece)
            limits = [limit - self.forwarded for limit in (self.cut_at, self.silent_at) if limit is not None]
            self.forwarded += _write(self._client, self._to_client, max(0, min([self.piece, *limits])))
        except ConnectionError:
            self._hang_up()
        if self.cut_at is not None and self.forwarded >= self.cut_at:
            self._hang_up()

    def register(self, poll: select.poll) -> None:
        """Register the sockets that may become readable."""
        for source in (self._listening,) if self._client is None or self._up is None else (self._up, self._client):
            poll.register(source, select.POLLIN)

    @property
    def waiting(self) -> int:
        return len(self._to_client) + len(self._to_server)

    def _accept(self) -> None:
        with contextlib.suppress(BlockingIOError):
            self._client, _ = self._listening.accept()
            self._client.setblocking(False)
            self._up = socket.socket(socket.AF_UNIX)
            self._up.connect(self._server)
            self._up.setblocking(False)

    def _take_frames(self) -> None:
        """Take complete frames from the server, and replace a reply by an error if the test wants this."""
        while len(self._frames) >= _HEADER.size:
            length, channel, *_ = _HEADER.unpack_from(self._frames)
            end = _HEADER.size + length
            if len(self._frames) < end:
                return
            frame = bytes(self._frames[:end])
            del self._frames[:end]
            self._to_client += self._change(frame) if channel == _CONTROL else frame

    def _change(self, frame: bytes) -> bytes:
        (_, command), (_, tag) = _NUMBER.iter_unpack(frame[_HEADER.size : _HEADER.size + 2 * _NUMBER.size])
        if command != _REPLY:
            return frame
        number, self.replies = self.replies, self.replies + 1
        if self.error is None or number != self.error[0]:
            return frame
        message = b"".join(_NUMBER.pack(b"L", value) for value in (_ERROR, tag, self.error[1]))
        return _HEADER.pack(len(message), _CONTROL, 0, 0, 0) + message

    def _hang_up(self) -> None:
        for connection in (self._client, self._up):
            if connection is not None:
                connection.close()
        self._up = None
        self._to_client.clear()


def _read(source: socket.socket) -> bytes:
    try:
        data = source.recv(65536)
    except BlockingIOError:
        return b""
    if not data:
        raise ConnectionResetError
    return data


def _write(target: socket.socket, data: bytearray, limit: int) -> int:
    sent = 0
    with contextlib.suppress(BlockingIOError):
        sent = target.send(data[:limit]) if data and limit else 0
        del data[:sent]
    return sent
