"""The listening socket: who may serve at a path, and how its file comes and goes.

A lock that is held for life decides who serves; only its holder removes a socket that an ended server left. The file
of the lock stays: removing it would let two servers hold two locks of one name.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
import stat
import sys
import time

from talkcli import __version__, dial, paths
from talkcli.errors import AccessDenied, AddressInUse, ServerUnavailable, TalkError, UsageError
from talkcli.requests import Hello

#: Connections that may wait to be accepted; the system's own limit applies too (net.core.somaxconn).
BACKLOG = 1024
#: Seconds in which the holder of the lock has written its process id.
_LOCK_NAMES_HOLDER = 1.0


class Listener:
    """A bound, listening socket. AddressInUse if it is served already, or its directory is not safe."""

    def __init__(self, path: str, mode: int) -> None:
        self.path = path
        #: who may connect, as the mode of the socket's file
        self.mode = mode
        self._lock = _lock(path)
        try:
            self.socket = _bind(path, mode)
        except BaseException:
            os.close(self._lock)
            raise
        self._identity = _identity(path)

    def close(self) -> None:
        """Remove the socket's file, if it is still this one, and let the lock go."""
        self.socket.close()
        if self._identity is not None and _identity(self.path) == self._identity:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(self.path)
        os.close(self._lock)


class InheritedListener:
    """The socket that systemd bound (LISTEN_FDS): its file is systemd's to remove."""

    def __init__(self, fd: int) -> None:
        self.socket = socket.socket(fileno=fd)
        if self.socket.family != socket.AF_UNIX:
            self.socket.close()
            raise UsageError("the socket that was passed (LISTEN_FDS) is not a Unix socket: use ListenStream=/path")
        self.socket.setblocking(False)
        name = self.socket.getsockname()
        self.path = name if isinstance(name, str) else os.fsdecode(name)
        self.mode = stat.S_IMODE(os.stat(self.path).st_mode)

    def close(self) -> None:
        """Stop listening; the file stays."""
        self.socket.close()


def listen(named: str | None, mode: int) -> Listener | InheritedListener:
    """Return the socket to serve: the one passed by systemd, else at the path that was named, else at the usual one."""
    passed = os.environ.get("LISTEN_FDS")
    if passed and os.environ.get("LISTEN_PID") == str(os.getpid()) and not named:
        if passed != "1":
            raise UsageError(f"{passed} sockets were passed (LISTEN_FDS), talk serves one")
        return InheritedListener(3)  # SD_LISTEN_FDS_START
    path = paths.server_socket(named)
    _check_directory(os.path.dirname(path))
    _refuse_second_server(named)
    return Listener(path, mode)


def _refuse_second_server(named: str | None) -> None:
    """Refuse where clients would find another server before or instead of this one."""
    try:
        found = dial.dial(named, Hello(urgent=True), __version__)
    except (ServerUnavailable, AccessDenied):
        return  # nobody there who would answer our clients
    except TalkError as error:
        raise AddressInUse(f"a server is there already: {error}") from error
    found.socket.close()
    raise AddressInUse(f"a server (pid {found.pid}) serves {found.path} already")


def _check_directory(directory: str) -> None:
    """Make sure that nobody else can put a socket of theirs in this one's place."""
    try:
        os.mkdir(directory, 0o700)
    except FileExistsError:
        pass
    except OSError as error:
        raise AddressInUse(f"the socket's directory {directory} can't be made: {error.strerror}") from error
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


def _lock(path: str) -> int:
    """Return the descriptor of the lock, held; AddressInUse, naming the holder, if another server holds it."""
    name = f"{path}.lock"
    try:
        fd = os.open(name, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    except OSError as error:
        raise AddressInUse(f"the lock {name} can't be opened: {error.strerror}") from error
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        holder = _holder(fd)
        os.close(fd)
        raise AddressInUse(f"a server (pid {holder}) serves {path} already") from None
    os.ftruncate(fd, 0)
    os.write(fd, f"{os.getpid()}\n".encode())
    return fd


def _holder(fd: int) -> str:
    """Return the process id that the holder wrote; it may be about to."""
    end = time.monotonic() + _LOCK_NAMES_HOLDER
    while True:
        words = os.pread(fd, 32, 0).decode(errors="replace")
        if words.endswith("\n") and words.strip().isdecimal():
            return words.strip()
        if time.monotonic() > end:
            return "unknown"
        time.sleep(0.01)


def _bind(path: str, mode: int) -> socket.socket:
    try:
        if not stat.S_ISSOCK(os.lstat(path).st_mode):
            raise AddressInUse(f"{path} exists and is no socket: remove it, or name another one")
        os.unlink(path)  # the lock is ours, so whoever bound it is gone
    except FileNotFoundError:
        pass
    except OSError as error:
        raise AddressInUse(f"the socket {path} of an earlier server can't be removed: {error.strerror}") from error
    listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        listening.setblocking(False)
        # Before bind, so that the file never has any other mode; bind takes the umask away from it.
        if sys.platform.startswith("linux"):  # elsewhere a socket has no mode of its own, and the umask has to do
            os.fchmod(listening.fileno(), mode)
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


def _identity(path: str) -> tuple[int, int] | None:
    try:
        status = os.lstat(path)
    except FileNotFoundError:
        return None
    return status.st_dev, status.st_ino
