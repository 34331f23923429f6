"""A relay before the socket of a PulseAudio that delays, cuts or changes the answers of the server.

Nothing in it waits: `pump` forwards what has come, and no more than the test allows.
"""

from __future__ import annotations

import contextlib
import select
import socket
import struct

#: The header of a frame: length, channel, two halves of an offset, flags.
_HEADER = struct.Struct(">5I")
#: The channel of messages.
_CONTROL = 0xFFFFFFFF
#: A 32 bit number in a message, and the commands, which are the first number.
_NUMBER = struct.Struct(">cI")
_ERROR, _REPLY = 0, 2


class Relay(contextlib.AbstractContextManager["Relay"]):
    """Listens at the socket `path`, and relays one client to the server at `server`."""

    def __init__(self, path: str, server: str) -> None:
        #: bytes that are forwarded at once
        self.piece = 65536
        #: bytes from the server after which the connection is cut, or becomes silent
        self.cut_at: int | None = None
        self.silent_at: int | None = None
        #: the number, from 0, of the reply that becomes an error, and the code of the error
        self.error: tuple[int, int] | None = None
        #: bytes from the server that were forwarded, and replies
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
        """Forward data in both directions, as far as it is allowed."""
        if self._client is None:
            self._accept()
        if self._client is None or self._up is None:
            return
        try:
            self._to_server += _read(self._client)
            self._frames += _read(self._up)
            self._take_frames()
            _write(self._up, self._to_server, self.piece)
            limits = [each - self.forwarded for each in (self.cut_at, self.silent_at) if each is not None]
            self.forwarded += _write(self._client, self._to_client, max(0, min([self.piece, *limits])))
        except ConnectionError:
            self._hang_up()
        if self.cut_at is not None and self.forwarded >= self.cut_at:
            self._hang_up()

    def register(self, poll: select.poll) -> None:
        """Register the sockets on which data may come."""
        for each in (self._listening,) if self._client is None or self._up is None else (self._up, self._client):
            poll.register(each, select.POLLIN)

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
        """Take whole frames of the server, and change a reply into an error if the test asks for it."""
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
        told = b"".join(_NUMBER.pack(b"L", each) for each in (_ERROR, tag, self.error[1]))
        return _HEADER.pack(len(told), _CONTROL, 0, 0, 0) + told

    def _hang_up(self) -> None:
        for each in (self._client, self._up):
            if each is not None:
                each.close()
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


def _write(target: socket.socket, data: bytearray, most: int) -> int:
    sent = 0
    with contextlib.suppress(BlockingIOError):
        sent = target.send(data[:most]) if data and most else 0
        del data[:sent]
    return sent
