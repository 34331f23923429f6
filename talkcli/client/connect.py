"""Functions that connect a client to the server, and give advice if this fails.

Connecting has two stages. In the first stage, `reach` opens a connection. A caller that already knows its request sends
it with `send_early`, so that the server works on it while the rest of the client is imported. This stage imports next
to nothing, not even `socket` and `json`, which together take as long as the interpreter's start. It handles only the
plain case of a server that has the same protocol and answers at once.

The second stage, `connect`, continues where the first one stopped. It waits for the server, tries the other places, and
explains what is wrong. A request that could have an effect is never sent twice.
"""

from __future__ import annotations

import _socket  # importing `socket` would take longer (see `peers`)
import os
import time

from talkcli import paths, peers
from talkcli.errors import AccessDenied, Busy, ServerUnavailable, TalkError, UsageError
from talkcli.frozen import TYPE_CHECKING, frozen, replace
from talkcli.polling import block_until_ready

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from talkcli.client.core import ServerInfo
    from talkcli.goals.goal import JsonObject
    from talkcli.polling import WaitReady

#: How the greeting of a server with the same protocol begins. A test compares this with a real greeting.
GREETING_START = b'{"talk": 1, "version": '
#: How long to wait for the greeting of an idle server. Longer waits must be interruptible.
GREETING_WAIT_S = 0.2
#: Maximum waiting time of `yield_processor`.
_LONGEST_YIELD_S = 0.2
#: If an answer contains one of these texts, the goal will not be spoken.
_REFUSALS = (b'"ok": false', b'"state": "REJECTED"')
#: Time limit for a greeting, for each answer, and for attempts to reach a busy server.
ANSWER_LIMIT_S = 5.0
#: The minimum and maximum pause before trying again. The pause is random, so that refused clients don't all try again
#: at the same moment.
RETRY_PAUSE_S = (0.02, 0.2)
#: Advice for users who can't connect to a server.
_START_STEP = "start one with: talk serve"
_LET_IN_STEP = "ask its owner to run: talk serve --socket-mode 0660, and to add you to the socket's group"
_MOVE_STEP = "ask its owner to run: talk serve --socket PATH --socket-mode 0660, with a PATH that you can reach"
_START_OWN_STEP = "or start your own server with: talk serve"


@frozen
class ConnectionAttempt:
    """The progress of connecting: the open socket, the paths that failed, and what was sent and received."""

    #: the non-blocking socket, or None if no connection was accepted
    socket: _socket.socket | None
    #: path of the server's socket
    path: str = ""
    #: the paths that could not be used, with the error for each
    failures: tuple[tuple[str, Exception], ...] = ()
    #: whether the hello message was sent
    hello_sent: bool = False
    #: received bytes that have not been processed yet
    received: bytes = b""
    #: the part of the first request that has been sent
    request_sent: bytes = b""
    #: the server's greeting, or None before it has been read
    server: ServerInfo | None = None

    @property
    def backlog_full(self) -> bool:
        """Whether the connection failed because the server's backlog is full."""
        return self.socket is None and bool(self.failures) and isinstance(self.failures[-1][1], BlockingIOError)


def reach(
    named_path: str | None, failures: tuple[tuple[str, Exception], ...] = (), only_path: str | None = None
) -> ConnectionAttempt:
    """Connect to `named_path`, or to the first usable default path not in `failures`. Return the attempt.

    The default paths are tried if `named_path` is None. `failures` are the paths that have already failed, with their
    errors. If `only_path` is given, it is the only path to try. Nothing is sent.
    """
    for path in [only_path] if only_path else paths.client_sockets(named_path)[len(failures) :]:
        connected = _socket.socket(_socket.AF_UNIX, _socket.SOCK_STREAM)
        # Don't block, because a stopped server with a full backlog would block the client for ever.
        connected.setblocking(False)
        try:
            connected.connect(path)
            if not named_path and path != paths.SYSTEM_SOCKET:
                _check_owner(connected)
        except (OSError, AccessDenied) as error:
            connected.close()
            failures = (*failures, (path, error))
            if isinstance(error, BlockingIOError):  # this is the right server, but its backlog is full
                break
        else:
            return ConnectionAttempt(connected, path, failures)
    return ConnectionAttempt(None, failures=failures)


def _check_owner(connected: _socket.socket) -> None:
    """Raise AccessDenied unless the server belongs to this user or to root."""
    _, uid = peers.credentials(connected)
    if uid not in {os.getuid(), 0}:
        raise AccessDenied(f"belongs to uid {uid}; to use it anyway, add --socket")


def send_early(
    attempt: ConnectionAttempt, hello: JsonObject, request: JsonObject, before_request: Callable[[], None]
) -> ConnectionAttempt | None:
    """Send `hello`, and `request` after an immediate greeting. Return the attempt, or None if it failed.

    The request is not sent if the greeting is late or unexpected, or if the server may lack a feature.

    Args:
        attempt: an open connection.
        hello: the hello message.
        request: the first request.
        before_request: called immediately before the request is sent.

    Returns:
        The connection with its progress, or None if the connection broke before a request was sent.
    """
    from talkcli.protocol.features import missing_features
    from talkcli.protocol.lines import FIRST_SEQ, request_line

    connected, line = attempt.socket, request_line({"seq": FIRST_SEQ, **request})
    assert connected
    received = sent = b""
    connected.settimeout(GREETING_WAIT_S)
    try:
        connected.sendall(request_line(hello))
        received = connected.recv(65536)
        known = received.startswith(GREETING_START) and b"\n" in received
        if known and all(f'"{each}"'.encode() in received for each in missing_features(request, ())):
            before_request()
            sent = line[: connected.send(line)]
    except TimeoutError:
        pass  # the server may be busy, so `connect` waits longer
    except OSError:
        connected.close()
        return None
    connected.setblocking(False)
    return replace(attempt, hello_sent=True, received=received, request_sent=sent)


def yield_processor(attempt: ConnectionAttempt, timeout: float | None) -> None:
    """Sleep briefly after sending a goal, so that the server gets the processor.

    Return early if the goal will not be spoken. A client that only waits for the end of its goal calls this before its
    other imports. The server, the engine, the player and the sound server need the processor until the first sound.
    Together they use about as much processor time as this process has used so far, on any machine. On two busy cores,
    the first sound took 1.4 times as long if the client went on importing.

    Args:
        attempt: a connection on which a request was sent. Received bytes can still be read afterwards.
        timeout: time limit of the whole command in seconds; None for no limit.
    """
    longest = _LONGEST_YIELD_S if timeout is None else min(_LONGEST_YIELD_S, timeout)
    pause = min(time.process_time(), longest)
    connected, end = attempt.socket, time.monotonic() + pause
    assert connected
    connected.settimeout(pause)
    try:
        answer = connected.recv(65536, _socket.MSG_PEEK)
    except OSError:  # no answer has arrived; if the connection broke, the next read reports it
        answer = b""
    connected.setblocking(False)
    if answer and not any(each in answer for each in _REFUSALS):
        time.sleep(max(0.0, end - time.monotonic()))


def sender_name(name: str | None) -> str | None:
    """Return the given name, or the value of TALK_NAME by default."""
    # Cancelling must work even if the variable is not valid UTF-8.
    variable = os.environ.get("TALK_NAME", "").encode(errors="surrogateescape").decode(errors="replace")
    return name or variable or None


def hello(name: str | None, *, urgent: bool) -> JsonObject:
    """Return the JSON object of a client's hello message.

    This function doesn't use `requests.Hello`, because importing it takes long. A test compares the results.

    Args:
        name: the sender's name, or None.
        urgent: whether the client sends only `status` and `cancel`.
    """
    return {"request": "hello", **({"name": name} if name else {}), **({"urgent": True} if urgent else {})}


async def connect(
    named_path: str | None,
    hello: JsonObject,
    patience_s: float = ANSWER_LIMIT_S,
    interrupt: Mapping[int, int] | None = None,
    attempt: ConnectionAttempt | None = None,
    keep_trying_s: float = 0.0,
    greeting_deadline: float | None = None,
    wait: WaitReady = block_until_ready,
) -> ConnectionAttempt:
    """Connect to the first usable server, and read its greeting. Return the connection.

    If there is no usable server, try again for a limited time.

    Args:
        named_path: path of the only socket to try; None for the usual places.
        hello: the hello message.
        patience_s: seconds in which the server must send its greeting. If it has too many clients or a full backlog,
            this is also how long to try again.
        interrupt: descriptors that interrupt the wait, with their poll events, as in `polling.wait_ready`.
        attempt: a connection that has already been opened.
        keep_trying_s: seconds for which to try again if there is no server yet. If this time is longer than
            `patience_s`, the server may use the rest of it for its greeting.
        greeting_deadline: with `keep_trying_s`, the monotonic time by which the server must have sent its greeting.
            None for no limit.
        wait: waits until descriptors are ready. By default, it blocks.

    Raises:
        UsageError: `patience_s` is not positive.
        ServerUnavailable, AccessDenied, ProtocolMismatch, Busy: there is no server that can be used.
        Interrupted: one of the interrupting descriptors is ready.
    """
    if not patience_s > 0:
        raise UsageError(f"the timeout must be more than 0, got {patience_s!r}")
    give_up = time.monotonic() + (keep_trying_s or patience_s)
    attempt = attempt or reach(named_path)
    while True:
        error: TalkError | None = None
        again = attempt.backlog_full or (keep_trying_s > 0 and _server_may_start(attempt))
        if attempt.socket:
            greet_by = max(time.monotonic() + patience_s, give_up)
            if keep_trying_s and greeting_deadline is not None:
                greet_by = min(greet_by, greeting_deadline)
            try:
                return await _greet(attempt, hello, greet_by, interrupt, wait)
            except AccessDenied as denied:
                if attempt.request_sent:
                    raise
                attempt = reach(named_path, (*attempt.failures, (attempt.path, denied)))
                continue
            except Busy as refused:
                error, again = refused, True
            except ConnectionError:
                error = ServerUnavailable(f"the server at {attempt.path} closed the connection before it answered")
                again = keep_trying_s > 0
        left = give_up - time.monotonic()
        if not again or attempt.request_sent or left <= 0:
            raise error or unreachable_error(attempt, named_path)
        import random  # this import is slow and rarely needed

        await wait({}, min(random.uniform(*RETRY_PAUSE_S), left), interrupt)
        attempt = reach(named_path)


def _server_may_start(attempt: ConnectionAttempt) -> bool:
    """Return whether a server may still be starting at one of the tried paths."""
    found = {paths.connect_failure(path, error) for path, error in attempt.failures if isinstance(error, OSError)}
    return not found.isdisjoint({paths.PLACE_ABSENT, paths.PLACE_STALE})


async def _greet(
    attempt: ConnectionAttempt, hello: JsonObject, deadline: float, interrupt: Mapping[int, int] | None, wait: WaitReady
) -> ConnectionAttempt:
    """Send the hello message if necessary, and read the server's greeting. Return the updated attempt.

    The connection is closed if the greeting has not arrived by `deadline` (monotonic), and after any other error.

    Raises:
        ConnectionError: the server closed the connection before it sent a greeting.
        ServerUnavailable, AccessDenied, ProtocolMismatch, Busy: the server can't be used.
        Interrupted: one of the interrupting descriptors is ready.
    """
    from select import POLLIN

    from talkcli.client.core import read_greeting
    from talkcli.protocol.lines import request_line

    connected, received = attempt.socket, attempt.received
    assert connected
    try:
        if not attempt.hello_sent:
            try:
                connected.send(request_line(hello))
            except (BrokenPipeError, ConnectionResetError):
                pass  # the server has closed the connection, but its error message can still be read
        while b"\n" not in received:
            if not await wait({connected.fileno(): POLLIN}, deadline - time.monotonic(), interrupt):
                listener, _ = peers.credentials(connected)
                hint = f"check process {listener}, and restart it if it hangs"
                raise ServerUnavailable(f"the server at {attempt.path} doesn't respond; {hint}")
            data = connected.recv(65536)
            if not data:
                raise ConnectionResetError
            received += data
        line, _, received = received.partition(b"\n")
        server = read_greeting(line, attempt.path)
    except BaseException:
        connected.close()
        raise
    return replace(attempt, received=received, server=server)


def unreachable_error(attempt: ConnectionAttempt, named_path: str | None) -> TalkError:
    """Return an error that lists the unusable sockets and gives advice."""
    if attempt.backlog_full:
        path = attempt.failures[-1][0]
        return ServerUnavailable(f"the server at {path} doesn't accept connections; restart it if it hangs")
    tried = ""
    found = ""  # the problem with the last path
    advice = ""  # how to get access to the last path that refused this user
    for path, error in attempt.failures:
        words = str(error)
        if isinstance(error, OSError):
            words = found = paths.connect_failure(path, error)
            if found == paths.PLACE_DIRECTORY:
                words += f"; use {_socket_inside(path)}"
            elif found == paths.PLACE_FORBIDDEN:
                closed = paths.closed_directory(path)
                words += f"; you can't enter {closed}" if closed else ""
                advice = _MOVE_STEP if closed else _LET_IN_STEP
        else:
            advice = _LET_IN_STEP
        tried += f"  {path}: {words}\n"
    step = f"{advice}\n{_START_OWN_STEP}" if advice else _START_STEP
    if named_path:
        step = _advice_for_named_socket(named_path, found, advice)
    hint = paths.sudo_caller_socket()
    if hint and not os.environ.get("TALK_SOCKET") and hint not in dict(attempt.failures):
        step += f"\nto use the server of the user who called sudo, run: talk --socket {hint}"
    if advice:
        return AccessDenied(f"no server that you may use; tried:\n{tried}{step}")
    return ServerUnavailable(f"no server found; tried:\n{tried}{step}")


def _advice_for_named_socket(named_path: str, found: str, access_advice: str) -> str:
    """Return advice for a user who named a socket with an option or a variable.

    Args:
        named_path: the path as the user named it.
        found: what is there, as described by `paths.connect_failure`.
        access_advice: how to get access, or an empty text if this user isn't refused.
    """
    import shlex  # this import is slow and rarely needed

    from talkcli.terminal.text import printable

    by_variable = named_path == os.environ.get("TALK_SOCKET")
    place = shlex.quote(printable(_socket_inside(named_path) if found == paths.PLACE_DIRECTORY else named_path))
    if access_advice:
        step = access_advice if by_variable else f"{access_advice}\n{_START_OWN_STEP}"
    elif found == paths.PLACE_FILE:
        step = "set TALK_SOCKET to a socket" if by_variable else "choose a socket, or leave out --socket"
    elif by_variable:
        step = f"set TALK_SOCKET to {place}" if found == paths.PLACE_DIRECTORY else _START_STEP
    else:
        step = f"{_START_STEP} --socket {place}"
    return f"{step}\nor unset TALK_SOCKET to try the usual places" if by_variable else step


def _socket_inside(directory: str) -> str:
    """Return the path of the socket in a directory."""
    return f"{directory.rstrip('/')}/{paths.SOCKET_NAME}"
