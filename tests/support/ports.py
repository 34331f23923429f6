"""TCP ports on 127.0.0.1 that are reserved for a test, even while no program listens."""

from __future__ import annotations

import contextlib
import socket
import sys

HOST = "127.0.0.1"


class Port(contextlib.AbstractContextManager["Port"]):
    """A free port for a program that sets SO_REUSEADDR before it binds, such as mosquitto.

    On Linux, a socket stays bound to the port and never listens, so connections are refused while no program listens.
    Without it, the system could choose the same port for the client's end, and connect the client to itself.
    """

    def __init__(self) -> None:
        self._socket = bound_socket(0)
        self.number: int = self._socket.getsockname()[1]
        if sys.platform != "linux":  # other systems would not let the program bind to it
            self._socket.close()

    def __exit__(self, *_error: object) -> None:
        self._socket.close()


def bound_socket(port: int) -> socket.socket:
    """Return a socket that is bound to a port on 127.0.0.1, or to any free port if `port` is 0."""
    result = socket.socket()
    try:
        result.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        result.bind((HOST, port))
    except OSError:
        result.close()
        raise
    return result
