"""How a client gets from nothing to a server that has greeted it: every place tried, and why each failed.

It sends nothing but `hello`, so whatever fails here is safe to try again.
"""

from __future__ import annotations

import _socket  # see `peers`
import math
import os
import select
import time

from talkcli import paths, peers
from talkcli.errors import AccessDenied, BadRequest, Busy, ServerUnavailable, TalkError
from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.paths import DIRECTORY, FILE, FORBIDDEN
from talkcli.protocol import replies
from talkcli.protocol.lines import decode
from talkcli.protocol.requests import Hello, request_line
from talkcli.splitter import LineSplitter

if TYPE_CHECKING:
    from collections.abc import Mapping

    from talkcli.client.opening import Opened

#: Seconds in which a server greets, and answers each request.
ANSWER_LIMIT = 5.0
#: Seconds for which a client tries again where the server is full or its backlog is; with jitter, so that many clients
#: that were turned away together don't come back together.
BUSY_LIMIT = 5.0
_BUSY_PAUSE = (0.02, 0.2)
#: What to do next where nobody answers.
_START = "start one with: talk serve"
_LET_IN = "have its owner let you in, with `talk serve --socket-mode 0660` and the socket's group"
_OWN = "or start your own with: talk serve"


@frozen
class Line:
    """A connection to a server that has greeted, and what was read of it beyond the greeting."""

    socket: _socket.socket
    path: str
    #: the server's boot id: the first half of its goals' ids
    boot: str
    #: the server's process id and version
    pid: int | None
    version: str | None
    splitter: LineSplitter
    #: lines that came with the greeting
    lines: list[bytes]


class Interrupted(Exception):
    """One of the caller's own descriptors became ready while something was awaited."""


class _BacklogFull(ServerUnavailable):
    """More clients connect than the server takes at this moment."""


def dial(
    named: str | None,
    hello: Hello,
    version: str,
    patience: float = ANSWER_LIMIT,
    interrupt: Mapping[int, int] | None = None,
    opened: Opened | None = None,
) -> Line:
    """Return a connection to the first server that answers.

    `named`: the only socket to try, or None for the list; `hello`: what is said to it; `version`: the client's own;
    `patience`: seconds in which the server must greet; `interrupt`: what ends it with Interrupted, as in `ready`;
    `opened`: a connection on which `hello` was sent already.

    ServerUnavailable, AccessDenied, ProtocolMismatch or Busy where there is none.
    """
    end = time.monotonic() + min(BUSY_LIMIT, patience)
    if opened:
        connected = _socket.socket(fileno=opened.descriptor)
        try:
            return _greet(connected, opened.path, None, version, patience, interrupt, opened.received)
        except BaseException as error:
            connected.close()
            if opened.sent or not isinstance(error, Busy | AccessDenied):
                raise
    while True:
        try:
            return _try_all(named, hello, version, patience, interrupt)
        except (Busy, _BacklogFull):
            if time.monotonic() >= end:
                raise
            import random

            ready({}, random.uniform(*_BUSY_PAUSE), interrupt)


def ready(watched: Mapping[int, int], timeout: float | None, interrupt: Mapping[int, int] | None = None) -> set[int]:
    """Return the descriptors that are ready for what they are watched for, waiting at most `timeout` seconds.

    Each comes with poll's events; that it is broken or hung up counts in any case. `interrupt`: others, of which
    each ends it with Interrupted as soon as it is ready.
    """
    interrupt = interrupt or {}
    poll = select.poll()  # not select(), which fails in a program that has more than 1,024 descriptors
    for fd, events in (*watched.items(), *interrupt.items()):
        poll.register(fd, events)
    # poll takes a C int of milliseconds, 24 days at most: whoever waits that long is woken, and looks again
    milliseconds = None if timeout is None else math.ceil(min(max(0.0, timeout * 1000), 2**31 - 1))
    found = {fd for fd, _ in poll.poll(milliseconds)}
    if not found.isdisjoint(interrupt):
        raise Interrupted
    return found


def _try_all(
    named: str | None, hello: Hello, version: str, patience: float, interrupt: Mapping[int, int] | None
) -> Line:
    failures: list[str] = []
    found: str = ""
    denied = False
    for path in paths.client_sockets(named):
        try:
            connected = _connect(path)
        except OSError as error:
            found = paths.found_at(path, error)
            denied = denied or found == FORBIDDEN
            hint = f": name the one in it, {_inside(path)}" if found == DIRECTORY else ""
            failures.append(f"{path}: {found}{hint}")
            continue
        try:
            _check_owner(connected, path, named is not None)
            return _greet(connected, path, hello, version, patience, interrupt)
        except AccessDenied as error:
            connected.close()
            denied = True
            failures.append(f"{path}: {error}")
        except BaseException:
            connected.close()
            raise
    raise _nobody(failures, named, found, denied=denied)


def _connect(path: str) -> _socket.socket:
    connected = _socket.socket(_socket.AF_UNIX, _socket.SOCK_STREAM)
    try:
        # Not blocking: a server that is stopped and whose backlog is full would hold the client for ever.
        connected.setblocking(False)
        connected.connect(path)
    except BlockingIOError:
        connected.close()
        raise _BacklogFull(f"the server at {path} does not take up connections: restart it if it hangs") from None
    except BaseException:
        connected.close()
        raise
    return connected


def _check_owner(connected: _socket.socket, path: str, named: bool) -> None:
    """Refuse a server that somebody else has put where ours would be: it would hear every sentence."""
    _, uid = peers.credentials(connected)
    if uid not in {os.getuid(), 0} and not named and path != paths.SYSTEM_SOCKET:
        raise AccessDenied(f"belongs to uid {uid}; to use it all the same, name it with --socket")


def _greet(
    connected: _socket.socket,
    path: str,
    hello: Hello | None,
    version: str,
    patience: float,
    interrupt: Mapping[int, int] | None,
    received: bytes = b"",
) -> Line:
    """Greet, unless that has been done, and be greeted; `received`: what has been read of that."""
    splitter = LineSplitter()
    lines = splitter.feed(received)
    try:
        try:
            if hello:
                connected.send(request_line(hello))
        except BrokenPipeError:
            pass  # it has hung up already, but it may have said why
        end = time.monotonic() + patience
        while not lines:
            if not ready({connected.fileno(): select.POLLIN}, end - time.monotonic(), interrupt):
                raise ServerUnavailable(f"the server at {path} does not answer; {_next_step(connected)}")
            data = connected.recv(65536)
            if not data:
                raise ServerUnavailable(f"the server at {path} closed the connection before it answered")
            lines = splitter.feed(data)
    except (BrokenPipeError, ConnectionResetError):
        raise ServerUnavailable(f"the server at {path} closed the connection before it answered") from None
    try:
        greeting = decode(lines.pop(0))
    except BadRequest:
        raise ServerUnavailable(f"what answers at {path} is no talk server") from None
    if "talk" not in greeting:
        raise ServerUnavailable(f"what answers at {path} is no talk server")
    replies.check_greeting(greeting, version)
    if "error" in greeting:
        from talkcli.terminal.text import printable  # no start pays for it

        raise AccessDenied(f"the server refuses: {printable(str(greeting.get('message') or greeting['error']))}")
    boot, pid, server_version = greeting.get("boot"), greeting.get("pid"), greeting.get("version")
    return Line(
        connected,
        path,
        boot if isinstance(boot, str) else "",
        pid if isinstance(pid, int) else None,
        server_version if isinstance(server_version, str) else None,
        splitter,
        lines,
    )


def _next_step(connected: _socket.socket) -> str:
    pid, _ = peers.credentials(connected)
    return f"look at process {pid}, and restart it if it hangs"


def _nobody(failures: list[str], named: str | None, found: str, *, denied: bool) -> TalkError:
    """Return the error; `found`: what is at the last place, the only one where one was named."""
    tried = "\n".join(f"  {each}" for each in failures)
    step = _named_step(named, found, denied=denied) if named else f"{_LET_IN}\n{_OWN}" if denied else _START
    hint = paths.sudo_hint()
    if hint and not os.environ.get("TALK_SOCKET"):
        step += f"\nthe server of the user who called sudo would be reached with: talk --socket {hint}"
    if denied:
        return AccessDenied(f"no server that may be used, tried:\n{tried}\n{step}")
    return ServerUnavailable(f"no server, tried:\n{tried}\n{step}")


def _named_step(named: str, found: str, *, denied: bool) -> str:
    """Return what to do next where the only place was one that the user named."""
    import shlex  # it loads `re`

    from talkcli.terminal.text import printable

    by_variable = named == os.environ.get("TALK_SOCKET")
    place = shlex.quote(printable(_inside(named) if found == DIRECTORY else named))
    if denied:
        step = _LET_IN if by_variable else f"{_LET_IN}\n{_OWN}"
    elif found == FILE:
        step = "name a socket" if by_variable else "name a socket, or leave out --socket"
    elif by_variable:
        step = f"set TALK_SOCKET to {place}" if found == DIRECTORY else _START
    else:
        step = f"{_START} --socket {place}"
    return f"{step}\nor unset TALK_SOCKET, which names this place: no other was tried" if by_variable else step


def _inside(directory: str) -> str:
    """Return the socket in a directory that was named in its place."""
    return f"{directory.rstrip('/')}/{paths.SOCKET}"
