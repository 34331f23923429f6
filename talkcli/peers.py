"""Functions that get information about processes from a Unix socket or from /proc.

Every client imports this module when it starts. It uses `_socket` instead of `socket`, because `socket` makes enums of
all its constants. That takes a tenth of the time of a command that sends one request.
"""

from __future__ import annotations

import _socket
import sys

from talkcli.frozen import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

#: Maximum length of a command line. This is enough for an interpreter, a script and its first arguments.
_MAX_COMMAND_LINE_CHARS = 200

#: Programs that run another program and wait for it. The parent of such a program shows more clearly where a request
#: comes from.
_WRAPPER_PROGRAMS = frozenset({b"timeout", b"time", b"flock", b"xargs", b"sudo"})
#: Maximum number of a process's ancestors to examine. A shell that was started by a script is three levels below cron.
_MAX_ANCESTORS_COUNT = 8

_LOCAL_PEERCRED = 0x001  # <sys/un.h> on macOS
_LOCAL_PEERPID = 0x002
_SOL_LOCAL = 0


def credentials(peer: _socket.socket) -> tuple[int, int]:
    """Return the process id and user id of a socket's peer.

    The kernel recorded them when the peer connected or began to listen.
    """
    if hasattr(_socket, "SO_PEERCRED"):
        found = peer.getsockopt(_socket.SOL_SOCKET, _socket.SO_PEERCRED, 12)  # struct ucred: pid, uid, gid
        return _decode_integer(found[:4]), _decode_integer(found[4:8])
    # struct xucred: version, uid, number of groups, sixteen groups
    uid = _decode_integer(peer.getsockopt(_SOL_LOCAL, _LOCAL_PEERCRED, 76)[4:8])
    return _decode_integer(peer.getsockopt(_SOL_LOCAL, _LOCAL_PEERPID, 4)), uid


def _decode_integer(data: bytes) -> int:
    """Decode an unsigned integer in the native byte order."""
    return int.from_bytes(data, sys.byteorder)


def command_name(pid: int) -> str | None:
    """Return the name of the program that a process runs, if it is known."""
    line = read_proc_file(f"/proc/{pid}/comm")
    return line.decode(errors="replace").rstrip("\n") if line else None


def ancestors(pid: int) -> Iterator[int]:
    """Yield the process ids of up to eight ancestors of a process, starting with its parent."""
    for _ in range(_MAX_ANCESTORS_COUNT):
        stat = process_stat(pid)
        pid = int(stat[1]) if stat else 0
        if pid == 0:
            return
        yield pid


def parent_command_line(pid: int) -> str | None:
    """Return the start of the command line of a process's parent, skipping wrappers such as sudo.

    Wrappers are programs that run another program. For `timeout 5 talk say …`, the result is the script that called
    `timeout`.
    """
    line = None
    for parent in ancestors(pid):
        above = read_proc_file(f"/proc/{parent}/cmdline")
        if not above or (line and parent == 1):
            break
        line = above
        program, *arguments = (each.rpartition(b"/")[2] for each in line.split(b"\0"))
        if program not in _WRAPPER_PROGRAMS or b"talk" not in arguments:
            break
    return line.rstrip(b"\0").replace(b"\0", b" ").decode(errors="replace")[:_MAX_COMMAND_LINE_CHARS] if line else None


def process_stat(pid: int) -> list[bytes]:
    """Return the fields of /proc/PID/stat, starting with the process state.

    Return an empty list if the file can't be read.
    """
    stat = read_proc_file(f"/proc/{pid}/stat") or b""
    # The program's name comes before the state, in brackets. The name itself can contain spaces and brackets.
    return stat.rpartition(b")")[2].split()


def read_proc_file(path: str, max_bytes: int = 4096) -> bytes | None:
    """Return the start of a file in /proc, if it can be read.

    Args:
        path: path to the file.
        max_bytes: how much to read, or -1 for everything.
    """
    try:
        with open(path, "rb", buffering=0) as file:
            return file.read(max_bytes)
    except OSError:  # reading also fails if the process has just ended
        return None
