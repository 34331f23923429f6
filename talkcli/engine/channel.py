"""The engine process's end of the socket to its server: commands come in, events go out.

It blocks only where it is asked to. A server that is gone is no error here: `closed` says so, and the process ends.
"""

from __future__ import annotations

import os
import time

from talkcli.engine import protocol
from talkcli.splitter import LineSplitter

TYPE_CHECKING = False
if TYPE_CHECKING:
    from talkcli.engine.protocol import Command, Event

#: Bytes read in one go; the longest command, escaped, takes a few of them.
_AT_ONCE = 65536


class Channel:
    """Both directions of one file descriptor."""

    def __init__(self, descriptor: int = 0) -> None:
        self.descriptor = descriptor
        #: True once the server is gone.
        self.closed = False
        #: monotonic time of the last event.
        self.sent_at = time.monotonic()
        self._lines = LineSplitter()

    def send(self, event: Event) -> None:
        """Send an event, waiting until the server takes it."""
        data = memoryview(protocol.encode(event))
        self.sent_at = time.monotonic()
        try:
            while data:
                data = data[os.write(self.descriptor, data) :]
        except (BrokenPipeError, ConnectionResetError):
            self.closed = True

    def receive(self) -> list[Command]:
        """Read once, waiting if there is nothing, and return the commands that are complete."""
        try:
            data = os.read(self.descriptor, _AT_ONCE)
        except ConnectionResetError:
            data = b""
        if not data:
            self.closed = True
            return []
        return [protocol.decode_command(line) for line in self._lines.feed(data)]
