"""A sound server's socket with a relay before it: what it answers comes late, in pieces, as an error, or not at all.

Behind it is a real PulseAudio. Nothing in here waits: `pump` hands on what has come, and no more than the test lets it.
"""

from __future__ import annotations

import contextlib
import select
import socket
import struct

#: What a frame of PulseAudio's native protocol begins with: length, channel, two halves of an offset, flags.
_HEADER = struct.Struct(">5I")
#: The channel of what is no sound.
_CONTROL = 0xFFFFFFFF
#: A 32 bit number in a message, and the commands that are its first.
_NUMBER = struct.Struct(">cI")
_ERROR, _REPLY = 0, 2


class Relay(contextlib.AbstractContextManager["Relay"]):
    """Takes one client for the server whose socket is at `server`, at a socket of its own, `path`."""

    def __init__(self, path: str, server: str) -> None:
        #: bytes that are handed on at once, to either side
        self.piece = 65536
        #: bytes of the server's after which the connection is cut, or says nothing any more
        self.cut_at: int | None = None
        self.hushed_at: int | None = None
        #: the number, from 0, of the answer that becomes an error, and the error's number
        self.error: tuple[int, int] | None = None
        #: bytes of the server's that were handed on, and answers that were
        self.handed_on = self.answers = 0
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
        """Hand on, to each side, what has come from the other, as far as it may."""
        if self._client is None:
            self._accept()
        if self._client is None or self._up is None:
            return
        try:
            self._to_server += _read(self._client)
            self._frames += _read(self._up)
        except ConnectionError:
            self._hang_up()
            return
        self._take_frames()
        _write(self._up, self._to_server, self.piece)
        room = self.piece
        for limit in (self.cut_at, self.hushed_at):
            if limit is not None:
                room = min(room, max(0, limit - self.handed_on))
        try:
            self.handed_on += _write(self._client, self._to_client, room)
        except ConnectionError:
            self._hang_up()
        if self.cut_at is not None and self.handed_on >= self.cut_at:
            self._hang_up()

    def register(self, poll: select.poll) -> None:
        """Have the poll wake for what could be handed on."""
        if self._client is None or self._up is None:
            poll.register(self._listening, select.POLLIN)
            return
        poll.register(self._up, select.POLLIN)
        poll.register(self._client, select.POLLIN)

    @property
    def waiting(self) -> int:
        """Bytes that were not handed on yet."""
        return len(self._to_client) + len(self._to_server)

    def _accept(self) -> None:
        with contextlib.suppress(BlockingIOError):
            self._client, _ = self._listening.accept()
            self._client.setblocking(False)
            self._up = socket.socket(socket.AF_UNIX)
            self._up.connect(self._server)
            self._up.setblocking(False)

    def _take_frames(self) -> None:
        """Take whole frames of the server's; one of its answers may become an error."""
        while len(self._frames) >= _HEADER.size:
            length, channel, *_ = _HEADER.unpack_from(self._frames)
            end = _HEADER.size + length
            if len(self._frames) < end:
                return
            frame = bytes(self._frames[:end])
            del self._frames[:end]
            if channel == _CONTROL:
                frame = self._change(frame)
            self._to_client += frame

    def _change(self, frame: bytes) -> bytes:
        (_, command), (_, tag) = _NUMBER.iter_unpack(frame[_HEADER.size : _HEADER.size + 2 * _NUMBER.size])
        if command != _REPLY:
            return frame
        number, self.answers = self.answers, self.answers + 1
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
    with contextlib.suppress(BlockingIOError):
        data = source.recv(65536)
        if not data:
            raise ConnectionResetError
        return data
    return b""


def _write(target: socket.socket, data: bytearray, most: int) -> int:
    sent = 0
    with contextlib.suppress(BlockingIOError):
        sent = target.send(data[:most]) if data and most else 0
        del data[:sent]
    return sent
