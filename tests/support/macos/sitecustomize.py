"""Make Python behave as on macOS if this directory is on its path (for `tests/test_portable.py`).

It removes everything that CPython only has on Linux, before anything else is imported, and changes functions that
behave differently on macOS. It emulates only what talk needs.
"""

from __future__ import annotations

import _signal
import _socket
import builtins
import ctypes
import errno
import fcntl
import os
import select
import signal
import stat
import sys
import time
from typing import Any

#: Prefixes of the names that CPython doesn't have on macOS.
_MISSING = {
    fcntl: ("F_SETSIG", "F_GETSIG", "F_SETPIPE_SZ", "F_GETPIPE_SZ", "F_NOTIFY", "F_SETLEASE", "F_OFD_", "DN_"),
    os: (
        *("pidfd_", "P_PIDFD", "PIDFD_", "sched_", "SCHED_", "pipe2", "memfd_", "MFD_", "eventfd", "EFD_", "timerfd_"),
        *("splice", "copy_file_range", "getrandom", "GRND_", "setns", "unshare", "CLONE_", "posix_fadvise"),
        *("posix_fallocate", "O_PATH", "O_TMPFILE", "O_NOATIME", "O_DIRECT", "getresuid", "getxattr", "setresuid"),
        *("waitid", "WNOWAIT", "WEXITED"),
    ),
    select: ("epoll", "EPOLL", "POLLRDHUP"),
    signal: ("pidfd_", "sigtimedwait", "sigwaitinfo", "SIGRT", "SIGPOLL", "SIGPWR", "SIGSTKFLT", "SIGCLD"),
    _signal: ("pidfd_", "sigtimedwait", "sigwaitinfo", "SIGRT", "SIGPOLL", "SIGPWR", "SIGSTKFLT", "SIGCLD"),
    time: ("CLOCK_BOOTTIME", "CLOCK_TAI", "pthread_getcpuclockid"),
    _socket: (
        *("SO_PEERCRED", "SO_PASSCRED", "SO_PASSSEC", "SO_DOMAIN", "SO_PROTOCOL", "SO_BINDTODEVICE", "SCM_CRED"),
        *("SOCK_CLOEXEC", "SOCK_NONBLOCK", "MSG_CMSG_CLOEXEC", "MSG_NOSIGNAL", "AF_NETLINK", "AF_PACKET", "AF_VSOCK"),
    ),
}
_os_fchmod = os.fchmod
_SO_PEERCRED = _socket.SO_PEERCRED
#: Constants from <sys/un.h>: the level, and the two options for the peer's credentials.
_SOL_LOCAL, _LOCAL_PEERCRED, _LOCAL_PEERPID = 0, 0x001, 0x002


class _Socket(_socket.socket):
    __slots__ = ()

    def getsockopt(self, level: int, option: int, size: int = 0) -> Any:
        if level != _SOL_LOCAL:
            return super().getsockopt(level, option, size) if size else super().getsockopt(level, option)
        pid, uid, gid = (super(_Socket, self).getsockopt(1, _SO_PEERCRED, 12)[at : at + 4] for at in (0, 4, 8))
        if option == _LOCAL_PEERPID:
            return pid
        assert (option, size) == (_LOCAL_PEERCRED, 76)  # struct xucred
        return b"\0" * 4 + uid + (1).to_bytes(4, sys.byteorder) + gid + b"\0" * 60


def _without_proc(function: Any) -> Any:
    """Wrap a function so that /proc doesn't exist for it."""

    def wrapped(path: Any = ".", *arguments: Any, **extra: Any) -> Any:
        if isinstance(path, str) and (path == "/proc" or path.startswith("/proc/")):
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), path)
        return function(path, *arguments, **extra)

    return wrapped


def _fchmod(fd: int, mode: int) -> None:
    if stat.S_ISSOCK(os.fstat(fd).st_mode):
        raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
    _os_fchmod(fd, mode)


class _Library(ctypes.CDLL):
    def __getattr__(self, name: str) -> Any:
        if name == "prctl":
            raise AttributeError(name)
        return super().__getattr__(name)


for _module, _prefixes in _MISSING.items():
    for _name in [name for name in dir(_module) if name.startswith(_prefixes)]:
        delattr(_module, _name)
for _module, _name in ((builtins, "open"), (os, "open"), (os, "listdir"), (os, "scandir"), (os, "stat"), (os, "lstat")):
    setattr(_module, _name, _without_proc(getattr(_module, _name)))
os.process_cpu_count = os.cpu_count  # type: ignore[attr-defined,unused-ignore]  # from 3.13 on, it uses sched_…
_socket.socket = _Socket  # type: ignore[misc]
# At the end, because the modules imported above may be Linux's. With "linux", talk uses its Linux code without these
# names.
sys.platform = os.environ.get("TALK_TEST_PLATFORM", "darwin")
if sys.platform == "darwin":
    os.fchmod = _fchmod
    ctypes.CDLL = _Library  # type: ignore[misc]
