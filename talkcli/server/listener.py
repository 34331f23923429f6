"""The listening socket: who may serve at a path, and how its file comes and goes.

A lock that is held for life decides who serves; only its holder removes a socket that an ended server left. Cleaners of
temporary directories and people remove the file while it is served: then it is bound again. When to look is the
server's.
"""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import stat
import sys

from talkcli import paths, peers
from talkcli.client.connect import connect, hello
from talkcli.errors import AccessDenied, AddressInUse, ServerUnavailable, TalkError, UsageError
from talkcli.server.lock import Lock, identity, refusing, serves_already

#: Connections that may wait to be accepted; the system's own limit applies too (net.core.somaxconn).
BACKLOG = 1024
#: The first descriptor that systemd passes (SD_LISTEN_FDS_START).
_FIRST_PASSED = 3
_RESTART_SOCKET = "restart the socket's unit (systemctl restart talk.socket)"
#: What passes, so that the next look may well succeed: no room, no descriptor, a disk that is read-only for a while.
_PASSING = {errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ENOBUFS, errno.ENOSPC, errno.EDQUOT, errno.EROFS}


class Listener:
    """A bound, listening socket. AddressInUse if it is served already, or its directory is not safe."""

    #: whether somebody else made the socket, so that its file is not ours
    passed = False

    def __init__(self, named: str | None, mode: int) -> None:
        """`named`: the path that the user named; `mode`: who may connect, as the mode of the socket's file."""
        self.mode = mode
        self.path = paths.server_socket(named)
        #: absolute: the directory that it was relative to may be gone when it is bound again
        self._named = self.path if named else None
        _check_directory(os.path.dirname(self.path))
        _refuse_other_file(self.path)
        _refuse_second_server(self._named)
        self._lock = Lock(self.path)
        try:
            self.socket = _bind(self.path, mode)
        except BaseException:
            self._lock.undo()
            raise
        self._identity = identity(self.path)

    def in_place(self) -> bool:
        """Whether the files of socket and lock are the ones that were made."""
        # Neither inode can be another's meanwhile: an open socket, and an open file, keep theirs.
        return identity(self.path) == self._identity and self._lock.in_place(self.path)

    def bind_again(self) -> socket.socket | None:
        """Make anew what is not in place, by the rules of the start: directory, lock, socket.

        Returns the former socket, to be closed by whoever listens to it; None if it is the same still. AddressInUse if
        another server serves by now, or something else is in the way; then all is as before.
        """
        path = paths.server_socket(self._named)
        _check_directory(os.path.dirname(path))
        lock = self._lock if self._lock.in_place(path) else Lock(path)
        former = None
        try:
            if identity(path) != self._identity:
                _refuse_live_socket(path)
                bound = _bind(path, self.mode)
                former = self.socket
                self.socket, self.path, self._identity = bound, path, identity(path)
        except BaseException:
            if lock is not self._lock:
                lock.undo()
            raise
        if lock is not self._lock:
            self._lock.close()
            self._lock = lock
        return former

    def close(self) -> None:
        """Remove the socket's file, if it is still this one, and let the lock go."""
        if self._identity is not None and identity(self.path) == self._identity:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(self.path)
        self.socket.close()
        self._lock.close()


class InheritedListener:
    """The socket that systemd bound (LISTEN_FDS): its file is systemd's to remove."""

    passed = True

    def __init__(self, fd: int) -> None:
        os.set_inheritable(fd, False)
        self.socket = socket.socket(fileno=fd)
        try:
            self.path = _path_of(self.socket)
            self._identity = identity(self.path)
            if self._identity is None:
                raise AddressInUse(f"the passed socket's file {self.path} is gone: {_RESTART_SOCKET}")
            self.mode = stat.S_IMODE(os.lstat(self.path).st_mode)
        except BaseException:
            self.socket.close()
            raise
        self.socket.setblocking(False)

    def in_place(self) -> bool:
        """Whether the socket's file is the one that was there at the start."""
        return identity(self.path) == self._identity

    def bind_again(self) -> socket.socket | None:
        """Say what to do: whoever passed the socket would pass the old one again."""
        raise AddressInUse(f"the file of the socket {self.path} was removed or replaced: {_RESTART_SOCKET}")

    def close(self) -> None:
        """Stop listening; the file stays."""
        self.socket.close()


def _path_of(passed: socket.socket) -> str:
    """Return the file of a listening Unix socket; UsageError for others, which fail later in ways hard to read."""
    if passed.family != socket.AF_UNIX:
        raise UsageError("the socket that was passed (LISTEN_FDS) is not a Unix socket: use ListenStream=/path")
    if passed.type != socket.SOCK_STREAM or not passed.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN):
        raise UsageError("the socket that was passed (LISTEN_FDS) doesn't listen: use ListenStream= and Accept=no")
    name = passed.getsockname()
    if not isinstance(name, str) or not os.path.isabs(name):
        raise UsageError("the socket that was passed (LISTEN_FDS) has no file: use ListenStream=/path")
    return name


def listen(named: str | None, mode: int) -> Listener | InheritedListener:
    """Return the socket to serve: the one passed by systemd, else at the path that was named, else at the usual one."""
    passed = os.environ.get("LISTEN_FDS")
    if passed and os.environ.get("LISTEN_PID") == str(os.getpid()):
        if passed != "1":
            raise UsageError(f"{passed} sockets were passed (LISTEN_FDS), talk serves one")
        inherited = InheritedListener(_FIRST_PASSED)
        if not named or paths.server_socket(named) == inherited.path:
            return inherited
        inherited.close()
    return Listener(named, mode)


def may_pass(error: AddressInUse) -> bool:
    """Whether it can well be bound at another time."""
    return isinstance(error.__cause__, OSError) and error.__cause__.errno in _PASSING


def _refuse_second_server(named: str | None) -> None:
    """Refuse where clients would find another server before or instead of this one."""
    try:
        found = connect(named, hello(None, urgent=True))
    except (ServerUnavailable, AccessDenied):
        return  # nobody there who would answer our clients
    except TalkError as error:
        raise AddressInUse(f"a server is there already: {error}") from error
    assert found.socket
    here, _ = peers.credentials(found.socket)  # behind a socket that ssh forwards it is a process of another machine's
    found.socket.close()
    raise serves_already(found.pid, found.path, here=here == found.pid)


def _refuse_live_socket(path: str) -> None:
    """Refuse where a program listens without the lock: to remove its socket would take it from its users."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(path)
        except BlockingIOError:
            pass  # its backlog is full
        except OSError:
            return
    raise AddressInUse(f"another program listens at {path} now")


def _check_directory(directory: str) -> None:
    """Make sure that nobody else can put a socket of theirs in this one's place."""
    with refusing(f"the socket's directory {directory} can't be made"), contextlib.suppress(FileExistsError):
        os.mkdir(directory, 0o700)
    status = os.lstat(directory)
    if stat.S_ISLNK(status.st_mode):
        raise AddressInUse(f"the socket's directory {directory} is a symbolic link: name the directory itself")
    if not stat.S_ISDIR(status.st_mode):
        raise AddressInUse(f"{directory} is not a directory")
    if status.st_uid not in {os.getuid(), 0}:
        raise AddressInUse(f"the socket's directory {directory} belongs to uid {status.st_uid}: name another one")
    if status.st_mode & 0o022 and not status.st_mode & stat.S_ISVTX:
        raise AddressInUse(
            f"others may write to the socket's directory {directory} (mode {stat.S_IMODE(status.st_mode):04o}): "
            f"chmod go-w {directory}"
        )


def _refuse_other_file(path: str) -> None:
    """Refuse where something is that no server has made."""
    try:
        mode = os.lstat(path).st_mode
    except OSError:
        return
    if stat.S_ISDIR(mode):
        inside = os.path.join(path, paths.SOCKET_NAME)
        raise AddressInUse(f"{path} exists and is no socket but a directory: name one in it, --socket {inside}")
    if not stat.S_ISSOCK(mode):
        step = "remove it, or name another one" if stat.S_ISREG(mode) or stat.S_ISLNK(mode) else "name another one"
        raise AddressInUse(f"{path} exists and is no socket: {step}")


def _bind(path: str, mode: int) -> socket.socket:
    _refuse_other_file(path)
    with refusing(f"the socket {path} of an earlier server can't be removed"), contextlib.suppress(FileNotFoundError):
        os.unlink(path)  # the lock is ours, so whoever bound it is gone
    listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        listening.setblocking(False)
        if sys.platform.startswith("linux"):
            # Before bind, so that the file never has a wider mode; bind takes the umask away, which chmod gives back.
            # The umask itself stays: it is the whole process's, and the engine may be starting in another thread.
            os.fchmod(listening.fileno(), mode)
            listening.bind(path)
            os.chmod(path, mode)
        else:  # a socket has no mode of its own, and the umask has to do
            umask = os.umask(0o777 & ~mode)
            try:
                listening.bind(path)
            finally:
                os.umask(umask)
        listening.listen(BACKLOG)
    except OSError as error:
        listening.close()
        raise AddressInUse(f"cannot listen at {path}: {error.strerror or error}") from error
    return listening
