"""The lock beside a socket: who holds it serves there. It knows nothing of the socket.

The file of the lock stays when a server ends, and names the process that holds it. Where somebody else has removed it,
the server that comes first to lock a new one goes on, and the other ends. Nothing but a plain file of one name is
opened or written to: what has the lock's name may be another's doing.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import stat
import time
from typing import TYPE_CHECKING

from talkcli.errors import AddressInUse

if TYPE_CHECKING:
    from collections.abc import Iterator

#: Seconds in which the holder of the lock has written its process id.
_NAMES_HOLDER = 1.0


class Lock:
    """The lock of a socket's path, held. AddressInUse, naming the holder, if another server holds it."""

    def __init__(self, path: str) -> None:
        self._path = path
        while True:
            self._fd, self._made = _open(_name(path))
            try:
                fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                holder = _holder(self._fd)
                os.close(self._fd)
                raise serves_already(holder, path, here=holder is not None) from None
            if self.in_place(path):
                break
            os.close(self._fd)  # it was removed between the two steps: who locks the next one serves
        os.ftruncate(self._fd, 0)
        with contextlib.suppress(OSError):  # a full disk: the lock holds without the number, which is for people
            os.write(self._fd, f"{os.getpid()}\n".encode())

    def in_place(self, path: str) -> bool:
        """Whether the file that is held is still the lock of this path."""
        status = os.fstat(self._fd)
        return identity(_name(path)) == (status.st_dev, status.st_ino)

    def undo(self) -> None:
        """Let the lock go, and remove its file if that was made for it.

        Who holds it can do so: another server that has opened it sees, once it is locked, that it is not in place.
        """
        if self._made and self.in_place(self._path):
            with contextlib.suppress(OSError):
                os.unlink(_name(self._path))
        self.close()

    def close(self) -> None:
        """Let the lock go; its file stays."""
        os.close(self._fd)


@contextlib.contextmanager
def refusing(what: str) -> Iterator[None]:
    """Raise AddressInUse, with the system's words, where it lets none of this be done."""
    try:
        yield
    except OSError as error:
        raise AddressInUse(f"{what}: {error.strerror or error}") from error


def identity(path: str) -> tuple[int, int] | None:
    """Return what tells a file from another of its name; None if there is none, or it can't be seen."""
    try:
        status = os.lstat(path)
    except OSError:
        return None
    return status.st_dev, status.st_ino


def serves_already(pid: int | None, path: str, *, here: bool) -> AddressInUse:
    """Return the error; `here`: whether that process is one of this machine."""
    name = "unknown" if pid is None else pid
    how = f" (kill {pid})" if here else ""
    return AddressInUse(f"a server (pid {name}) serves {path} already: use it, or end it first{how}")


def _name(path: str) -> str:
    return f"{path}.lock"


def _open(name: str) -> tuple[int, bool]:
    """Return the descriptor of the lock's file, and whether it was made now."""
    flags = os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    while True:
        with refusing(f"the lock {name} can't be opened"):
            with contextlib.suppress(FileExistsError):
                return os.open(name, flags | os.O_CREAT | os.O_EXCL, 0o600), True
            try:
                _refuse_other_file(name, os.lstat(name))  # before it is opened, which may do something to a device
                fd = os.open(name, flags)
            except FileNotFoundError:
                continue  # it was removed meanwhile
        try:
            _refuse_other_file(name, os.fstat(fd))
        except AddressInUse:
            os.close(fd)
            raise
        return fd, False


def _refuse_other_file(name: str, status: os.stat_result) -> None:
    if stat.S_ISLNK(status.st_mode):
        what = "a symbolic link"
    elif not stat.S_ISREG(status.st_mode):
        what = "no regular file"
    elif status.st_nlink > 1:
        what = "a hard link, another name of some file"
    else:
        return
    raise AddressInUse(f"the lock {name} is {what}: remove it, or name another socket with --socket")


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass  # another user's
    return True


def _holder(fd: int) -> int | None:
    """Return the process id that the holder wrote, which it may be about to; None if it doesn't.

    What is there until then may be the number of a server before it, which is gone.
    """
    end = time.monotonic() + _NAMES_HOLDER
    while True:
        words = os.pread(fd, 32, 0).decode(errors="replace")
        if words.endswith("\n") and words.strip().isdecimal() and _lives(int(words)):
            return int(words)
        if time.monotonic() > end:
            return None
        time.sleep(0.01)
