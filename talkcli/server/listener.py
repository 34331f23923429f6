"""The listening socket, and the lock that allows only one server per path.

Only the server that holds the lock may bind the socket and remove an old socket file. If the socket file is removed
while the server runs, for example by a cleaner of temporary directories, the socket is bound again. `run` decides when
to check this.

The lock file contains the process id of its holder, and is kept after the server has ended. If it is removed, the first
server that creates and locks a new one continues, and the other server ends. Another user may have put something else
in the place of the lock file, so only a regular file without other hard links is opened.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import socket
import stat
import time
from typing import TYPE_CHECKING

from talkcli import paths, peers
from talkcli.client.connect import connect, hello
from talkcli.errors import AccessDenied, AddressInUse, ServerUnavailable, TalkError, UsageError
from talkcli.polling import run_blocking

if TYPE_CHECKING:
    from collections.abc import Iterator

#: Maximum number of connections waiting to be accepted. The system also has a limit (net.core.somaxconn).
MAX_BACKLOG_CONNECTIONS = 1024
#: How long to wait for another server to write its process id to the lock file.
HOLDER_ID_S = 1.0
#: The first file descriptor passed by systemd (SD_LISTEN_FDS_START).
_FIRST_PASSED_FD = 3
_RESTART_SOCKET = "restart it with: systemctl restart talk.socket"
#: Errors that may be temporary: not enough memory, disk space or file descriptors, or a read-only file system.
_TEMPORARY_ERRORS = {errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ENOBUFS, errno.ENOSPC, errno.EDQUOT, errno.EROFS}


class Listener:
    """A listening socket bound by this server, and its lock."""

    #: whether systemd passed the socket and owns the socket file
    passed = False

    def __init__(self, path: str | None, mode: int) -> None:
        """Bind the socket.

        Args:
            path: the path of the socket file, or None for the usual place.
            mode: the mode of the socket file, which determines the users that may connect.

        Raises:
            AddressInUse: if another server uses the path, or the directory is not safe.
        """
        self.mode = mode
        self.path = paths.server_socket(path)
        #: absolute form of the given path, because the current directory may change later
        self._named_path = self.path if path else None
        _prepare_directory(os.path.dirname(self.path))
        _refuse_other_file(self.path)
        _refuse_second_server(self._named_path)
        self._lock = _acquire_lock(self.path)
        self.socket = _bind(self.path, mode)
        self._identity = _identity(self.path)

    def in_place(self) -> bool:
        """Return whether the socket file and the lock file still belong to this server."""
        # A new file can't have the same inode number, because both files are still open.
        return _identity(self.path) == self._identity and _is_lock_of(self.path, self._lock)

    def bind_again(self) -> socket.socket | None:
        """Recreate a missing socket or lock file. Return the replaced socket, if any.

        Returns:
            The old socket, which the caller must close, or None if it is still in use.

        Raises:
            AddressInUse: if another server or file is in the way. In this case, the old socket is kept.
        """
        path = paths.server_socket(self._named_path)
        _prepare_directory(os.path.dirname(path))
        if not _is_lock_of(path, self._lock):
            former_lock, self._lock = self._lock, _acquire_lock(path)
            os.close(former_lock)
        if _identity(path) == self._identity:
            return None
        _refuse_live_socket(path)
        former, self.socket = self.socket, _bind(path, self.mode)
        self.path, self._identity = path, _identity(path)
        return former

    def close(self) -> None:
        """Close the socket, remove its file unless it was replaced, and release the lock."""
        if _identity(self.path) == self._identity:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(self.path)
        self.socket.close()
        os.close(self._lock)


class InheritedListener:
    """A listening socket passed by systemd (LISTEN_FDS).

    Only systemd removes the socket file.
    """

    passed = True

    def __init__(self, fd: int) -> None:
        os.set_inheritable(fd, False)
        self.socket = socket.socket(fileno=fd)
        self.socket.setblocking(False)
        self.path = _path_of(self.socket)
        self._identity = _identity(self.path)
        if self._identity is None:
            raise AddressInUse(f"the socket {self.path} was removed; {_RESTART_SOCKET}")
        self.mode = stat.S_IMODE(os.lstat(self.path).st_mode)

    def in_place(self) -> bool:
        """Return whether the socket file is still in place."""
        return _identity(self.path) == self._identity

    def bind_again(self) -> socket.socket | None:
        """Raise AddressInUse, because only systemd can create the socket file again.

        If only the server were restarted, systemd would pass the old socket again.
        """
        raise AddressInUse(f"the socket {self.path} was removed or replaced; {_RESTART_SOCKET}")

    def close(self) -> None:
        """Close the socket without removing its file."""
        self.socket.close()


def listen(path: str | None, mode: int) -> Listener | InheritedListener:
    """Return the listening socket passed by systemd, or bind a new one at this path.

    The passed socket is used only if it has this path.

    Args:
        path: the path of the socket file. With None, any passed socket is used, or else the usual place.
        mode: the mode of a new socket file.
    """
    passed = os.environ.get("LISTEN_FDS")
    if passed and os.environ.get("LISTEN_PID") == str(os.getpid()):
        if passed != "1":
            raise UsageError(f"systemd passed {passed} sockets (LISTEN_FDS), but talk can serve only one")
        inherited = InheritedListener(_FIRST_PASSED_FD)
        if not path or paths.server_socket(path) == inherited.path:
            return inherited
        inherited.close()
    return Listener(path, mode)


def is_temporary(error: AddressInUse) -> bool:
    """Return whether another attempt to bind the socket may succeed."""
    return isinstance(error.__cause__, OSError) and error.__cause__.errno in _TEMPORARY_ERRORS


@contextlib.contextmanager
def _raise_in_use(problem: str) -> Iterator[None]:
    """Turn an OSError in a `with` block into AddressInUse."""
    try:
        yield
    except OSError as error:
        raise AddressInUse(f"{problem}: {error.strerror or error}") from error


def _identity(path: str) -> tuple[int, int] | None:
    """Return the device and inode numbers of a file, if it can be accessed."""
    try:
        status = os.lstat(path)
    except OSError:
        return None
    return status.st_dev, status.st_ino


def _already_served(pid: int | None, path: str, *, on_this_machine: bool) -> AddressInUse:
    """Return an error that says which server uses a path, and how to stop the server.

    `pid` is the id of its process, if known. It can be killed only on this machine.
    """
    name = "unknown" if pid is None else pid
    stop = f"with: kill {pid}" if on_this_machine else "first"
    return AddressInUse(f"a server (pid {name}) is already running at {path}; use it, or stop it {stop}")


# -- the socket


def _path_of(passed: socket.socket) -> str:
    """Return the path of a socket passed by systemd. Raise UsageError if it has none.

    It must be a listening Unix socket.
    """
    if passed.family != socket.AF_UNIX:
        raise UsageError("the socket from systemd (LISTEN_FDS) is not a Unix socket; use ListenStream=/path")
    if passed.type != socket.SOCK_STREAM or not passed.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN):
        raise UsageError(
            "the socket from systemd (LISTEN_FDS) is not a listening socket; use ListenStream= and Accept=no"
        )
    name = passed.getsockname()
    if not isinstance(name, str) or not os.path.isabs(name):
        raise UsageError("the socket from systemd (LISTEN_FDS) has no path; use ListenStream=/path")
    return name


def _refuse_second_server(path: str | None) -> None:
    """Raise AddressInUse if clients can already reach another server."""
    try:
        found = run_blocking(connect(path, hello(None, urgent=True)))
    except (ServerUnavailable, AccessDenied):
        return  # this user can't reach any server
    except TalkError as error:
        raise AddressInUse(f"a server is already running: {error}") from error
    assert found.socket
    here, _ = peers.credentials(found.socket)  # this is the process id of ssh if ssh forwards the socket
    found.socket.close()
    pid = found.server.pid if found.server else None
    raise _already_served(pid, found.path, on_this_machine=here == pid)


def _refuse_live_socket(path: str) -> None:
    """Raise AddressInUse if another program listens at the path without holding the lock.

    Its clients could no longer reach it if the path were bound again.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(path)
        except BlockingIOError:
            pass  # a program listens, but its backlog is full
        except OSError:
            return
    raise AddressInUse(f"another program is now listening at {path}")


def _prepare_directory(directory: str) -> None:
    """Create the socket's directory if necessary. Raise AddressInUse if it isn't safe.

    It isn't safe if other users could replace the socket in it.
    """
    with _raise_in_use(f"can't create the socket's directory {directory}"), contextlib.suppress(FileExistsError):
        os.mkdir(directory, 0o700)
    status = os.lstat(directory)
    if stat.S_ISLNK(status.st_mode):
        raise AddressInUse(f"the socket's directory {directory} is a symbolic link; use the directory it points to")
    if not stat.S_ISDIR(status.st_mode):
        raise AddressInUse(f"{directory} is not a directory; choose another path for the socket")
    if status.st_uid not in {os.getuid(), 0}:
        raise AddressInUse(
            f"the socket's directory {directory} belongs to uid {status.st_uid}; choose another directory"
        )
    if status.st_mode & 0o022 and not status.st_mode & stat.S_ISVTX:
        raise AddressInUse(
            f"other users can write to the socket's directory {directory} (mode {stat.S_IMODE(status.st_mode):04o}); "
            f"run: chmod go-w {directory}"
        )


def _refuse_other_file(path: str) -> None:
    """Raise AddressInUse if the path exists but is not a socket."""
    try:
        mode = os.lstat(path).st_mode
    except OSError:
        return
    if stat.S_ISDIR(mode):
        inside = os.path.join(path, paths.SOCKET_NAME)
        raise AddressInUse(f"{path} is a directory, not a socket; use --socket {inside}")
    if not stat.S_ISSOCK(mode):
        remove = "remove it, or " if stat.S_ISREG(mode) or stat.S_ISLNK(mode) else ""
        raise AddressInUse(f"{path} exists, but is not a socket; {remove}choose another path")


def _bind(path: str, mode: int) -> socket.socket:
    """Remove an old socket file. Return a new socket that listens at the path.

    The caller must hold the lock.
    """
    _refuse_other_file(path)
    with _raise_in_use(f"can't remove the old socket {path}"), contextlib.suppress(FileNotFoundError):
        os.unlink(path)
    with _raise_in_use(f"can't listen at {path}"):
        listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        listening.setblocking(False)
        listening.bind(path)
        os.chmod(path, mode)  # nobody can connect before `listen`
        listening.listen(MAX_BACKLOG_CONNECTIONS)
        return listening


# -- the lock


def _acquire_lock(path: str) -> int:
    """Lock a socket's path, or raise AddressInUse. Return the descriptor of the lock file.

    The file contains the id of this process. Closing the descriptor ends the lock.
    """
    while True:
        fd = _open_lock(f"{path}.lock")
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            holder = _read_holder(fd)
            raise _already_served(holder, path, on_this_machine=holder is not None) from None
        if _is_lock_of(path, fd):
            break
        os.close(fd)  # the file was removed before it was locked, so try again
    os.ftruncate(fd, 0)
    with contextlib.suppress(OSError):  # the disk may be full, but nothing depends on the process id
        os.write(fd, f"{os.getpid()}\n".encode())
    return fd


def _is_lock_of(path: str, fd: int) -> bool:
    """Return whether a descriptor refers to the lock file of a path."""
    status = os.fstat(fd)
    return _identity(f"{path}.lock") == (status.st_dev, status.st_ino)


def _open_lock(path: str) -> int:
    """Open or create a lock file. Return its descriptor.

    Raises AddressInUse if it isn't a plain file.
    """
    flags = os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    while True:
        with _raise_in_use(f"can't open the lock file {path}"):
            with contextlib.suppress(FileExistsError):
                return os.open(path, flags | os.O_CREAT | os.O_EXCL, 0o600)
            with contextlib.suppress(FileNotFoundError):  # the file has just been removed, so try again
                # Check before opening the file, because opening a device may have side effects.
                _refuse_irregular_lock(path, os.lstat(path))
                fd = os.open(path, flags)
                _refuse_irregular_lock(path, os.fstat(fd))
                return fd


def _refuse_irregular_lock(path: str, status: os.stat_result) -> None:
    """Raise AddressInUse unless the lock file is a regular file without other hard links."""
    if stat.S_ISLNK(status.st_mode):
        what = "a symbolic link"
    elif not stat.S_ISREG(status.st_mode):
        what = "not a regular file"
    elif status.st_nlink > 1:
        what = "a hard link to another file"
    else:
        return
    raise AddressInUse(f"the lock file {path} is {what}; remove it, or choose another socket with --socket")


def _process_exists(pid: int) -> bool:
    """Return whether a process with this id exists."""
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass  # the process belongs to another user
    return True


def _read_holder(fd: int) -> int | None:
    """Wait briefly for a running process's id in a lock file. Return the id, if any.

    The id of a process that no longer exists was written by an earlier server, and is ignored.
    """
    end = time.monotonic() + HOLDER_ID_S
    while True:
        words = os.pread(fd, 32, 0).decode(errors="replace")
        if words.endswith("\n") and words.strip().isdecimal() and _process_exists(int(words)):
            return int(words)
        if time.monotonic() > end:
            return None
        time.sleep(0.01)
