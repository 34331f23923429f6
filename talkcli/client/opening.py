"""Opens a connection, and sends a request on it, before the rest of the client is imported: the server works meanwhile.

It imports next to nothing itself, not even `socket` and `json`, which together take as long as the interpreter's start.
So it knows only the plain case, a server of this protocol that answers at once. In any other it gives up, having sent
nothing that could have an effect, and `dial` tries again and says what is wrong.
"""

from __future__ import annotations

import _socket
import os
import sys
import time

from talkcli import paths
from talkcli.frozen import TYPE_CHECKING, frozen, replace

if TYPE_CHECKING:
    from collections.abc import Callable

#: How a server of this protocol begins its greeting, as `protocol.lines` writes it; a test compares the two.
GREETING = b'{"talk": 1, "version": '
#: Seconds in which a server greets that is up and has time; whoever waits longer wants to be able to interrupt it.
AT_ONCE = 0.2
#: Seconds for which a client stands back at most.
_BACK = 0.2
#: What is in the answer to a request after which there is nothing to wait for.
_REFUSED = (b'"ok": false', b'"state": "REJECTED"')


@frozen
class Opened:
    """A connection to a server that has been begun."""

    descriptor: int
    path: str
    #: what the server has said: less than its greeting, or more
    received: bytes
    #: what was sent after `hello`: the request, if the greeting was as it should be
    sent: bytes


def open_early(named: str | None, hello: bytes, request: bytes, before: Callable[[], None]) -> Opened | None:
    """Return a connection to the first server that answers, with these lines sent; None where there is no plain case.

    `named`: the only socket to try, or None for the list; `before`: called before the request is sent.
    """
    if not hasattr(_socket, "SO_PEERCRED"):  # as on macOS, where `peers` knows another way
        return None
    for path in paths.client_sockets(named):
        connected = _socket.socket(_socket.AF_UNIX, _socket.SOCK_STREAM)
        connected.settimeout(AT_ONCE)
        try:
            connected.connect(path)
        except BlockingIOError:  # a server that takes up no connection at this moment: it is that one, not the next
            connected.close()
            return None
        except OSError:
            connected.close()
            continue
        try:
            return _begin(connected, path, named is not None, hello, request, before)
        except OSError:
            connected.close()
            return None
    return None


def _begin(
    connected: _socket.socket, path: str, named: bool, hello: bytes, request: bytes, before: Callable[[], None]
) -> Opened | None:
    # The owner's uid, the second of three C ints, as `peers` reads it; whom to trust is `dial`'s rule.
    owner = connected.getsockopt(_socket.SOL_SOCKET, _socket.SO_PEERCRED, 12)[4:8]
    if int.from_bytes(owner, sys.byteorder) not in {os.getuid(), 0} and not named and path != paths.SYSTEM_SOCKET:
        connected.close()
        return None
    connected.sendall(hello)
    received = sent = b""
    try:
        received = connected.recv(65536)
    except TimeoutError:
        pass  # it may have more to do than to greet
    if received.startswith(GREETING) and b"\n" in received:
        before()
        sent = request[: connected.send(request)]
    connected.setblocking(False)
    return Opened(connected.detach(), path, received, sent)


def stand_back(opened: Opened, timeout: float | None) -> Opened:
    """Leave the processor to the server for a while, and return the connection with what the server says meanwhile.

    For who waits for a goal to end and has nothing to do before. Until the first sound, server, engine, player and
    sound server take about the processor time that this process has had so far, whatever the machine; the rest of the
    client, imported in that time, made it 1.4 times as long where both cores of two had other work as well.

    `timeout`: the seconds that the whole command may take, or None.
    """
    end = time.monotonic() + min(time.process_time(), _BACK, _BACK if timeout is None else timeout)
    connected = _socket.socket(fileno=opened.descriptor)
    received = opened.received
    try:
        while (left := end - time.monotonic()) > 0:
            connected.settimeout(left)
            said = connected.recv(65536)
            if not said:
                break
            received += said
            if any(each in said for each in _REFUSED):
                break
    except OSError:  # the time is up; or the connection has broken, which whoever reads on will find
        pass
    connected.setblocking(False)
    return replace(opened, descriptor=connected.detach(), received=received)
