"""How a client connects: it tries the usual places, explains failures, and may send its first request early.

There are two stages. `reach` opens a connection, and a caller that already knows its request sends it with
`send_early`, before the rest of the client is imported: the server works meanwhile. This stage imports next to nothing,
not even `socket` and `json`, which together take as long as the interpreter's start. It covers only the plain case, a
server of this protocol that answers at once. The second stage, `connect`, takes over wherever the first one ended. It
waits, tries the other places, and explains what is wrong. A request that could have an effect is never sent twice.
"""

from __future__ import annotations

import _socket  # lighter than `socket`, see `peers`
import os
import time

from talkcli import paths
from talkcli.frozen import TYPE_CHECKING, frozen, replace
from talkcli.polling import wait_ready

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from talkcli.errors import AccessDenied, TalkError
    from talkcli.goals.goal import JsonObject

#: The beginning of the greeting of a server of this protocol, as `protocol.lines` writes it; a test compares the two.
GREETING_START = b'{"talk": 1, "version": '
#: Seconds in which an idle server greets. A longer wait must be interruptible.
GREETING_WAIT_S = 0.2
#: The longest time for which a client leaves the processor to the server.
_LONGEST_YIELD_S = 0.2
#: Parts of an answer after which there is nothing to wait for.
_REFUSED = (b'"ok": false', b'"state": "REJECTED"')
#: Seconds in which a server must greet, and must answer each request.
ANSWER_LIMIT_S = 5.0
#: Seconds for which a server that is full, or whose backlog is full, is tried again.
BUSY_LIMIT_S = 5.0
#: The least and the longest pause between two of these attempts. It is random, so that many clients that were turned
#: away together don't come back together.
BUSY_PAUSE_S = (0.02, 0.2)
#: Seconds between two attempts to reach a server that is not there yet: the first pause, which doubles up to the
#: second.
_FIRST_RETRY_PAUSE_S, _LONGEST_RETRY_PAUSE_S = 0.02, 0.25
#: The next step if there is no server, and if the server refuses this user.
_START_STEP = "start one with: talk serve"
_LET_IN_STEP = "have its owner let you in, with `talk serve --socket-mode 0660` and the socket's group"
_START_OWN_STEP = "or start your own with: talk serve"


@frozen
class ConnectionAttempt:
    """The progress of connecting to a server."""

    #: non-blocking; None if no place has accepted a connection
    socket: _socket.socket | None
    #: the place of the socket
    path: str = ""
    #: the places that failed before it, each with its error
    failures: tuple[tuple[str, Exception], ...] = ()
    #: whether `hello` was sent
    hello_sent: bool = False
    #: received bytes that have not been processed; before the greeting was read, they begin with it
    received: bytes = b""
    #: the part of the first request that has been sent
    request_sent: bytes = b""
    #: the server's boot id, the first half of the ids that it gives; empty until the greeting is read
    boot: str = ""
    #: the process id that the server reports
    pid: int | None = None

    @property
    def backlog_full(self) -> bool:
        """Whether the server at the last place has a full backlog and accepts no connection now."""
        return self.socket is None and bool(self.failures) and isinstance(self.failures[-1][1], BlockingIOError)


def reach(
    named: str | None, failures: tuple[tuple[str, Exception], ...] = (), only: str | None = None
) -> ConnectionAttempt:
    """Open a connection to the first place that accepts one. Nothing is sent.

    Args:
        named: the only socket to try, as the user named it; None for the usual places.
        failures: the errors of the first of these places, which are not tried again.
        only: the only one of the usual places to try.
    """
    for path in [only] if only else paths.client_sockets(named)[len(failures) :]:
        connected = _socket.socket(_socket.AF_UNIX, _socket.SOCK_STREAM)
        # Non-blocking: a stopped server whose backlog is full would hold the client for ever.
        connected.setblocking(False)
        error: Exception | None
        try:
            connected.connect(path)
            error = None if named or path == paths.SYSTEM_SOCKET else _foreign(connected)
        except OSError as failed:
            error = failed
        if error is None:
            return ConnectionAttempt(connected, path, failures)
        connected.close()
        failures = (*failures, (path, error))
        if isinstance(error, BlockingIOError):  # a busy server is still the right one
            break
    return ConnectionAttempt(None, failures=failures)


def _foreign(connected: _socket.socket) -> AccessDenied | None:
    """Return an error if another user has put a server where this user's belongs: it would hear everything."""
    from talkcli import peers

    _, uid = peers.credentials(connected)
    if uid in {os.getuid(), 0}:
        return None
    from talkcli.errors import AccessDenied

    return AccessDenied(f"belongs to uid {uid}; to use it all the same, name it with --socket")


def send_early(
    attempt: ConnectionAttempt, hello: JsonObject, request: JsonObject, before: Callable[[], None]
) -> ConnectionAttempt | None:
    """Send hello, and the first request as soon as the server has greeted.

    The request is not sent if the greeting is late, or differs from the expected one.

    Args:
        attempt: an open connection.
        hello: the first line.
        request: the first request.
        before: called before the request is sent.

    Returns:
        The connection; None if it broke before a request was sent.
    """
    from talkcli.protocol.lines import FIRST_NUMBER, request_line

    connected, line = attempt.socket, request_line({"seq": FIRST_NUMBER, **request})
    assert connected
    received = sent = b""
    connected.settimeout(GREETING_WAIT_S)
    try:
        connected.sendall(request_line(hello))
        received = connected.recv(65536)
        if received.startswith(GREETING_START) and b"\n" in received:
            before()
            sent = line[: connected.send(line)]
    except TimeoutError:
        pass  # the server may be busy
    except OSError:
        connected.close()
        return None
    connected.setblocking(False)
    return replace(attempt, hello_sent=True, received=received, request_sent=sent)


def yield_processor(attempt: ConnectionAttempt, timeout: float | None) -> ConnectionAttempt:
    """Leave the processor to the server for a moment. Return the connection with the bytes received in that time.

    It is for a client that waits for its goal to end and has nothing else to do. Until the first sound, the server, the
    engine, the player and the sound server together take about as much processor time as this process has taken so far,
    on any machine. With the client's other imports in that time, the first sound took 1.4 times as long on two busy
    cores.

    Args:
        attempt: a connection on which a request was sent.
        timeout: seconds that the whole command may take; None for no limit.
    """
    longest = _LONGEST_YIELD_S if timeout is None else min(_LONGEST_YIELD_S, timeout)
    end = time.monotonic() + min(time.process_time(), longest)
    connected, received = attempt.socket, attempt.received
    assert connected
    try:
        while (left := end - time.monotonic()) > 0:
            connected.settimeout(left)
            data = connected.recv(65536)
            received += data
            if not data or any(each in data for each in _REFUSED):
                break
    except OSError:  # the time is up, or the connection broke, as the next read will show
        pass
    connected.setblocking(False)
    return replace(attempt, received=received)


def sender_name(name: str | None) -> str | None:
    """Return the name that a sender goes by: the given one, or else TALK_NAME."""
    # A variable that is not UTF-8 must not make a cancel fail.
    variable = os.environ.get("TALK_NAME", "").encode(errors="surrogateescape").decode(errors="replace")
    return name or variable or None


def hello(name: str | None, *, urgent: bool) -> JsonObject:
    """Return the first message of a client. It avoids importing `requests.Hello`; a test compares the two."""
    return {"request": "hello", **({"name": name} if name else {}), **({"urgent": True} if urgent else {})}


def connect(
    named: str | None,
    hello: JsonObject,
    patience: float = ANSWER_LIMIT_S,
    interrupt: Mapping[int, int] | None = None,
    attempt: ConnectionAttempt | None = None,
    keep_trying: float = 0.0,
    end: float | None = None,
) -> ConnectionAttempt:
    """Return a connection to the first server that answers, with its greeting read.

    Args:
        named: the only socket to try, or None for the usual places.
        hello: the first message.
        patience: seconds in which the server must greet.
        interrupt: descriptors with the poll events that interrupt the wait, as in `polling.wait_ready`.
        attempt: a connection that has already been opened.
        keep_trying: seconds for which to try again if there is no server yet, and in which a server may greet.
        end: the monotonic time by which the server must have greeted in any case, or None.

    Raises:
        ServerUnavailable, AccessDenied, ProtocolMismatch, Busy: there is no server that can be used.
    """
    from talkcli.errors import AccessDenied, Busy, ServerUnavailable

    give_up = time.monotonic() + (keep_trying or min(BUSY_LIMIT_S, patience))
    attempt, next_pause = attempt or reach(named), _FIRST_RETRY_PAUSE_S
    while True:
        error: TalkError | None = None
        busy = attempt.backlog_full
        again = busy or (keep_trying > 0 and _may_start(attempt))
        if attempt.socket:
            greet_by = time.monotonic() + patience
            if keep_trying:
                greet_by = max(greet_by, give_up)
                greet_by = greet_by if end is None else min(greet_by, end)
            try:
                return _greet(attempt, attempt.socket, hello, greet_by, interrupt)
            except AccessDenied as denied:
                if attempt.request_sent:
                    raise
                attempt = reach(named, (*attempt.failures, (attempt.path, denied)))
                continue
            except Busy as refused:
                error, again, busy = refused, True, True
            except ConnectionError:
                error = ServerUnavailable(f"the server at {attempt.path} closed the connection before it answered")
                again = keep_trying > 0
        left = give_up - time.monotonic()
        if not again or attempt.request_sent or left <= 0:
            raise error or unreachable(attempt, named)
        pause = next_pause
        if busy:
            import random

            pause = random.uniform(*BUSY_PAUSE_S)
        else:
            next_pause = min(2 * pause, _LONGEST_RETRY_PAUSE_S)
        wait_ready({}, min(pause, left), interrupt)
        attempt = reach(named)


def _may_start(attempt: ConnectionAttempt) -> bool:
    """Return whether a server may soon start at one of the places that were tried."""
    found = (paths.describe_place(path, error) for path, error in attempt.failures if isinstance(error, OSError))
    return any(each in {paths.PLACE_ABSENT, paths.PLACE_STALE} for each in found)


def _greet(
    attempt: ConnectionAttempt,
    connected: _socket.socket,
    hello: JsonObject,
    end: float,
    interrupt: Mapping[int, int] | None,
) -> ConnectionAttempt:
    """Send hello, unless that was done, and read the greeting by `end`. Close the connection if that fails.

    Raises:
        ConnectionError: the server hangs up first.
        ServerUnavailable, AccessDenied, ProtocolMismatch, Busy: the server can't be used.
    """
    from talkcli import __version__
    from talkcli.client.core import identity, read_greeting
    from talkcli.protocol.lines import request_line

    received = attempt.received
    try:
        if not attempt.hello_sent:
            try:
                connected.send(request_line(hello))
            except (BrokenPipeError, ConnectionResetError):
                pass  # the server has closed it, but its reason can be read
        while b"\n" not in received:
            received += _receive(connected, attempt.path, end, interrupt)
        line, _, received = received.partition(b"\n")
        boot, pid = identity(read_greeting(line, attempt.path, __version__))
    except BaseException:
        connected.close()
        raise
    return replace(attempt, received=received, boot=boot, pid=pid)


def _receive(connected: _socket.socket, path: str, end: float, interrupt: Mapping[int, int] | None) -> bytes:
    """Return the next bytes of a greeting, which must be received by `end`."""
    from select import POLLIN

    from talkcli import peers
    from talkcli.errors import ServerUnavailable

    if not wait_ready({connected.fileno(): POLLIN}, end - time.monotonic(), interrupt):
        pid, _ = peers.credentials(connected)
        hint = f"look at process {pid}, and restart it if it hangs"
        raise ServerUnavailable(f"the server at {path} does not answer; {hint}")
    data = connected.recv(65536)
    if not data:
        raise ConnectionResetError
    return data


def unreachable(attempt: ConnectionAttempt, named: str | None) -> TalkError:
    """Return an error that lists the places that were tried, and the next step."""
    from talkcli.errors import AccessDenied, ServerUnavailable

    if attempt.backlog_full:
        path = attempt.failures[-1][0]
        return ServerUnavailable(f"the server at {path} does not take up connections: restart it if it hangs")
    tried = ""
    found = ""  # at the last place, which is the only one if the user named it
    denied = False
    for path, error in attempt.failures:
        words = str(error)
        if isinstance(error, OSError):
            words = found = paths.describe_place(path, error)
            if found == paths.PLACE_DIRECTORY:
                words += f": name the one in it, {_inside(path)}"
        denied = denied or isinstance(error, AccessDenied) or found == paths.PLACE_FORBIDDEN
        tried += f"  {path}: {words}\n"
    step = f"{_LET_IN_STEP}\n{_START_OWN_STEP}" if denied else _START_STEP
    if named:
        step = _named_step(named, found, denied=denied)
    hint = paths.sudo_hint()
    if hint and not os.environ.get("TALK_SOCKET"):
        step += f"\nthe server of the user who called sudo would be reached with: talk --socket {hint}"
    if denied:
        return AccessDenied(f"no server that may be used, tried:\n{tried}{step}")
    return ServerUnavailable(f"no server, tried:\n{tried}{step}")


def _named_step(named: str, found: str, *, denied: bool) -> str:
    """Return the next step if only the place that the user named was tried."""
    import shlex  # slow to import

    from talkcli.terminal.text import printable

    by_variable = named == os.environ.get("TALK_SOCKET")
    place = shlex.quote(printable(_inside(named) if found == paths.PLACE_DIRECTORY else named))
    if denied:
        step = _LET_IN_STEP if by_variable else f"{_LET_IN_STEP}\n{_START_OWN_STEP}"
    elif found == paths.PLACE_FILE:
        step = "name a socket" if by_variable else "name a socket, or leave out --socket"
    elif by_variable:
        step = f"set TALK_SOCKET to {place}" if found == paths.PLACE_DIRECTORY else _START_STEP
    else:
        step = f"{_START_STEP} --socket {place}"
    return f"{step}\nor unset TALK_SOCKET, which names this place: no other was tried" if by_variable else step


def _inside(directory: str) -> str:
    """Return the path of the socket in a directory."""
    return f"{directory.rstrip('/')}/{paths.SOCKET_NAME}"
