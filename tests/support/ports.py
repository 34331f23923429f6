"""A TCP port on 127.0.0.1 that a test owns, whether or not a program listens there."""

from __future__ import annotations

import contextlib
import socket
import sys

HOST = "127.0.0.1"


class Port(contextlib.AbstractContextManager["Port"]):
    """A free port, `number`, for a program that sets SO_REUSEADDR before it binds, as mosquitto does.

    On Linux a socket stays bound to the port and never listens. So a connection is refused while a broker is down;
    otherwise the client might be given this port for its own end, and be connected to itself.
    """

    def __init__(self) -> None:
        self._held = bound_socket(0)
        self.number: int = self._held.getsockname()[1]
        if sys.platform != "linux":  # elsewhere the one that holds it would keep it from all others
            self._held.close()

    def __exit__(self, *_error: object) -> None:
        self._held.close()


def bound_socket(port: int) -> socket.socket:
    """Return a socket that is bound to a port of this machine's own, any if it is 0."""
    result = socket.socket()
    try:
        result.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        result.bind((HOST, port))
    except OSError:
        result.close()
        raise
    return result
