"""From nothing to a server that has greeted: every place tried, why each failed, and the first request sent at once.

In two stages. Of the first a connection is made by `reach`, and whoever knows already what to ask sends it by `ask`,
before the rest of the client is imported: the server works meanwhile. It imports next to nothing itself, not even
`socket` and `json`, which together take as long as the interpreter's start, and knows only the plain case, a server of
this protocol that answers at once. The second, `connect`, takes over from wherever that ended: it waits, tries the
other places, and says what is wrong. Nothing is sent twice that could have an effect.
"""

from __future__ import annotations

import _socket  # see `peers`
import os
import time

from talkcli import paths
from talkcli.frozen import TYPE_CHECKING, frozen, replace
from talkcli.polling import wait_ready

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from talkcli.errors import AccessDenied, TalkError
    from talkcli.goals.goal import JsonObject

#: How a server of this protocol begins its greeting, as `protocol.lines` writes it; a test compares the two.
GREETING = b'{"talk": 1, "version": '
#: The number of the first request on a connection.
FIRST = 1
#: Seconds in which a server greets that is up and has time; whoever waits longer wants to be able to interrupt it.
AT_ONCE = 0.2
#: Seconds for which a client stands back at most.
_BACK = 0.2
#: What is in the answer to a request after which there is nothing to wait for.
_REFUSED = (b'"ok": false', b'"state": "REJECTED"')
#: Seconds in which a server greets, and answers each request.
ANSWER_LIMIT = 5.0
#: Seconds for which a client tries again where the server is full or its backlog is; with jitter, so that many clients
#: that were turned away together don't come back together.
BUSY_LIMIT = 5.0
_BUSY_PAUSE = (0.02, 0.2)
#: Seconds between two tries to reach a server that is not there yet: the first pause, which doubles up to the second.
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.02, 0.25
#: What to do next where nobody answers.
_START = "start one with: talk serve"
_LET_IN = "have its owner let you in, with `talk serve --socket-mode 0660` and the socket's group"
_OWN = "or start your own with: talk serve"


@frozen
class Begun:
    """A connection as the first stage leaves it, or that there is none."""

    #: not blocking; None where no place has anybody who could be asked
    socket: _socket.socket | None
    #: the place that it leads to
    path: str = ""
    #: the places before it, each with what is wrong there: the system's error, or that it belongs to somebody else
    failures: tuple[tuple[str, Exception], ...] = ()
    #: whether `hello` was said
    greeted: bool = False
    #: what the server has said that nobody has read: less than its greeting, or more
    received: bytes = b""
    #: what was sent of the first request
    sent: bytes = b""
    #: once its greeting is read, the server's boot id, the first half of its goals' ids, and its process
    boot: str = ""
    pid: int | None = None

    @property
    def full(self) -> bool:
        """Whether the last place has a server that takes up no connection at this moment."""
        return self.socket is None and bool(self.failures) and isinstance(self.failures[-1][1], BlockingIOError)


def reach(named: str | None, failures: tuple[tuple[str, Exception], ...] = ()) -> Begun:
    """Return a connection to the first place that takes one, on which nothing has been said.

    `named`: the only socket to try, or None for the list; `failures`: what is wrong with the first places of that,
    which are not tried again.
    """
    for path in paths.client_sockets(named)[len(failures) :]:
        connected = _socket.socket(_socket.AF_UNIX, _socket.SOCK_STREAM)
        # Not blocking: a server that is stopped and whose backlog is full would hold the client for ever.
        connected.setblocking(False)
        wrong: Exception | None
        try:
            connected.connect(path)
            wrong = None if named or path == paths.SYSTEM_SOCKET else _foreign(connected)
        except OSError as error:
            wrong = error
        if wrong is None:
            return Begun(connected, path, failures)
        connected.close()
        failures = (*failures, (path, wrong))
        if isinstance(wrong, BlockingIOError):  # a server that is there is the one, not the next
            break
    return Begun(None, failures=failures)


def _foreign(connected: _socket.socket) -> AccessDenied | None:
    """Return what is wrong with a server that somebody else has put where ours belongs: it would hear all."""
    from talkcli import peers

    _, uid = peers.credentials(connected)
    if uid in {os.getuid(), 0}:
        return None
    from talkcli.errors import AccessDenied

    return AccessDenied(f"belongs to uid {uid}; to use it all the same, name it with --socket")


def ask(begun: Begun, hello: JsonObject, request: JsonObject, before: Callable[[], None]) -> Begun | None:
    """Say hello, and send the first request as soon as the server has greeted; return how far that has come.

    None where the connection broke before: nothing was sent that could have an effect. `before`: called before the
    request is sent, which is not done where the server greets otherwise, or not at once.
    """
    from talkcli.protocol.lines import request_line

    connected, line = begun.socket, request_line({"seq": FIRST, **request})
    assert connected
    received = sent = b""
    connected.settimeout(AT_ONCE)
    try:
        connected.sendall(request_line(hello))
        received = connected.recv(65536)
        if received.startswith(GREETING) and b"\n" in received:
            before()
            sent = line[: connected.send(line)]
    except TimeoutError:
        pass  # it may have more to do than to greet
    except OSError:
        connected.close()
        return None
    connected.setblocking(False)
    return replace(begun, greeted=True, received=received, sent=sent)


def stand_back(begun: Begun, timeout: float | None) -> Begun:
    """Leave the processor to the server for a while, and return the connection with what the server says meanwhile.

    For who waits for a goal to end and has nothing to do before. Until the first sound, server, engine, player and
    sound server take about the processor time that this process has had so far, whatever the machine; the rest of the
    client, imported in that time, made it 1.4 times as long where both cores of two had other work as well.

    `timeout`: the seconds that the whole command may take, or None.
    """
    end = time.monotonic() + min(time.process_time(), _BACK, _BACK if timeout is None else timeout)
    connected, received = begun.socket, begun.received
    assert connected
    try:
        while (left := end - time.monotonic()) > 0:
            connected.settimeout(left)
            said = connected.recv(65536)
            received += said
            if not said or any(each in said for each in _REFUSED):
                break
    except OSError:  # the time is up; or the connection has broken, which whoever reads on will find
        pass
    connected.setblocking(False)
    return replace(begun, received=received)


def sender(name: str | None) -> str | None:
    """Return what a sender calls itself: by this name, or else by that of TALK_NAME."""
    # Bytes in a variable that are no UTF-8 keep nobody from cancelling.
    called = os.environ.get("TALK_NAME", "").encode(errors="surrogateescape").decode(errors="replace")
    return name or called or None


def hello(name: str | None, *, urgent: bool) -> JsonObject:
    """Return what is said first: `requests.Hello`, as it is written, without the import; a test compares the two."""
    return {"request": "hello", **({"name": name} if name else {}), **({"urgent": True} if urgent else {})}


def connect(
    named: str | None,
    hello: JsonObject,
    patience: float = ANSWER_LIMIT,
    interrupt: Mapping[int, int] | None = None,
    begun: Begun | None = None,
    keep_trying: float = 0.0,
    end: float | None = None,
) -> Begun:
    """Return a connection to the first server that answers, with its greeting read.

    Args:
        named: the only socket to try, or None for the list.
        hello: the first request.
        patience: seconds in which the server must greet.
        interrupt: what ends it with Interrupted, as in `ready`.
        begun: how far the connection has come already.
        keep_trying: seconds for which a server that is not there yet is tried again, and for which it may greet.
        end: the monotonic time by which the server must have greeted in any case, or None.

    Raises:
        ServerUnavailable, AccessDenied, ProtocolMismatch, Busy: there is no server that can be used.
    """
    from talkcli.errors import AccessDenied, Busy, ServerUnavailable

    give_up = time.monotonic() + (keep_trying or min(BUSY_LIMIT, patience))
    begun, next_pause = begun or reach(named), _FIRST_PAUSE_S
    while True:
        error: TalkError | None = None
        busy = begun.full
        again = busy or (keep_trying > 0 and _may_come(begun))
        if begun.socket:
            greet_by = time.monotonic() + patience
            if keep_trying:
                greet_by = max(greet_by, give_up)
                greet_by = greet_by if end is None else min(greet_by, end)
            try:
                return _greet(begun, begun.socket, hello, greet_by, interrupt)
            except AccessDenied as denied:
                if begun.sent:
                    raise
                begun = reach(named, (*begun.failures, (begun.path, denied)))
                continue
            except Busy as refused:
                error, again, busy = refused, True, True
            except ConnectionError:
                error = ServerUnavailable(f"the server at {begun.path} closed the connection before it answered")
                again = keep_trying > 0
        left = give_up - time.monotonic()
        if not again or begun.sent or left <= 0:
            raise error or _nobody(begun, named)
        pause = next_pause
        if busy:
            import random

            pause = random.uniform(*_BUSY_PAUSE)
        else:
            next_pause = min(2 * pause, _LONGEST_PAUSE_S)
        wait_ready({}, min(pause, left), interrupt)
        begun = reach(named)


def _may_come(begun: Begun) -> bool:
    """Whether a server may still start at one of the places that were tried in vain."""
    found = (paths.describe_place(path, error) for path, error in begun.failures if isinstance(error, OSError))
    return any(each in {paths.PLACE_ABSENT, paths.PLACE_STALE} for each in found)


def _greet(
    begun: Begun, connected: _socket.socket, hello: JsonObject, end: float, interrupt: Mapping[int, int] | None
) -> Begun:
    """Greet, unless that has been done, and be greeted by `end`; the connection is closed if that fails.

    ConnectionError if the server hangs up first.
    """
    from talkcli.protocol.lines import request_line

    received = begun.received
    try:
        if not begun.greeted:
            try:
                connected.send(request_line(hello))
            except (BrokenPipeError, ConnectionResetError):
                pass  # it has hung up already, but it may have said why
        while b"\n" not in received:
            received += _heard(connected, begun.path, end, interrupt)
        line, _, received = received.partition(b"\n")
        greeting = _checked(line, begun.path)
    except BaseException:
        connected.close()
        raise
    boot, pid = greeting.get("boot"), greeting.get("pid")
    return replace(
        begun,
        received=received,
        boot=boot if isinstance(boot, str) else "",
        pid=pid if isinstance(pid, int) else None,
    )


def _heard(connected: _socket.socket, path: str, end: float, interrupt: Mapping[int, int] | None) -> bytes:
    """Return what a server says that has not greeted yet; `end`: until when it may take for that."""
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


def _checked(line: bytes, path: str) -> JsonObject:
    """Return a greeting; ServerUnavailable, ProtocolMismatch, Busy or AccessDenied for what greets nobody."""
    from talkcli import __version__
    from talkcli.errors import AccessDenied, BadRequest, ServerUnavailable
    from talkcli.protocol.events import check_greeting
    from talkcli.protocol.lines import decode

    try:
        greeting = decode(line)
    except BadRequest:
        greeting = {}
    if "talk" not in greeting:
        raise ServerUnavailable(f"what answers at {path} is no talk server")
    check_greeting(greeting, __version__)
    if "error" in greeting:
        from talkcli.terminal.text import printable  # no start pays for it

        raise AccessDenied(f"the server refuses: {printable(str(greeting.get('message') or greeting['error']))}")
    return greeting


def _nobody(begun: Begun, named: str | None) -> TalkError:
    """Return the error that says what was tried."""
    from talkcli.errors import AccessDenied, ServerUnavailable

    if begun.full:
        path = begun.failures[-1][0]
        return ServerUnavailable(f"the server at {path} does not take up connections: restart it if it hangs")
    tried = ""
    found = ""  # at the last place, the only one where one was named
    denied = False
    for path, error in begun.failures:
        words = str(error)
        if isinstance(error, OSError):
            words = found = paths.describe_place(path, error)
            if found == paths.PLACE_DIRECTORY:
                words += f": name the one in it, {_inside(path)}"
        denied = denied or isinstance(error, AccessDenied) or found == paths.PLACE_FORBIDDEN
        tried += f"  {path}: {words}\n"
    step = _named_step(named, found, denied=denied) if named else f"{_LET_IN}\n{_OWN}" if denied else _START
    hint = paths.sudo_hint()
    if hint and not os.environ.get("TALK_SOCKET"):
        step += f"\nthe server of the user who called sudo would be reached with: talk --socket {hint}"
    if denied:
        return AccessDenied(f"no server that may be used, tried:\n{tried}{step}")
    return ServerUnavailable(f"no server, tried:\n{tried}{step}")


def _named_step(named: str, found: str, *, denied: bool) -> str:
    """Return what to do next where the only place was one that the user named."""
    import shlex  # it loads `re`

    from talkcli.terminal.text import printable

    by_variable = named == os.environ.get("TALK_SOCKET")
    place = shlex.quote(printable(_inside(named) if found == paths.PLACE_DIRECTORY else named))
    if denied:
        step = _LET_IN if by_variable else f"{_LET_IN}\n{_OWN}"
    elif found == paths.PLACE_FILE:
        step = "name a socket" if by_variable else "name a socket, or leave out --socket"
    elif by_variable:
        step = f"set TALK_SOCKET to {place}" if found == paths.PLACE_DIRECTORY else _START
    else:
        step = f"{_START} --socket {place}"
    return f"{step}\nor unset TALK_SOCKET, which names this place: no other was tried" if by_variable else step


def _inside(directory: str) -> str:
    """Return the socket in a directory that was named in its place."""
    return f"{directory.rstrip('/')}/{paths.SOCKET_NAME}"
