"""Who is at the other end of a Unix socket, as the kernel tells it. Light: clients import it at every start.

`_socket` is what `socket` is made of, without the enums that the latter makes of all its constants whenever it is
imported: a tenth of the life of a command that sends one request. It has all that is needed here.
"""

from __future__ import annotations

import _socket
import sys

#: Characters of a command line that are kept: enough for an interpreter, a script and its first arguments.
MAX_COMMAND = 200

#: Programs that start another one and wait for it. The script that called them is above them.
_STARTERS = frozenset({b"timeout", b"time", b"flock", b"xargs", b"sudo"})
#: Processes that are looked at above a client, at most.
_MAX_PARENTS = 8

_LOCAL_PEERCRED = 0x001  # <sys/un.h> on macOS
_LOCAL_PEERPID = 0x002
_SOL_LOCAL = 0


def credentials(peer: _socket.socket) -> tuple[int, int]:
    """Return process id and user id of whoever connected, or of whoever listened, at that moment."""
    if hasattr(_socket, "SO_PEERCRED"):
        found = peer.getsockopt(_socket.SOL_SOCKET, _socket.SO_PEERCRED, 12)  # struct ucred: pid, uid, gid
        return _integer(found[:4]), _integer(found[4:8])
    # struct xucred: version, uid, number of groups, sixteen groups
    uid = _integer(peer.getsockopt(_SOL_LOCAL, _LOCAL_PEERCRED, 76)[4:8])
    return _integer(peer.getsockopt(_SOL_LOCAL, _LOCAL_PEERPID, 4)), uid


def _integer(data: bytes) -> int:
    return int.from_bytes(data, sys.byteorder)


def command_of(pid: int) -> str | None:
    """Return the name of the program that runs as this process, or None if it can't be known."""
    line = contents(f"/proc/{pid}/comm")
    return line.decode(errors="replace").rstrip("\n") if line else None


def parent_command_of(pid: int) -> str | None:
    """Return the command line of the process that started this one, or None if it can't be known.

    `timeout 5 talk say …` and its like are passed over: the script that called them is the sender.
    """
    line = None
    for _ in range(_MAX_PARENTS):
        parent = stat_of(pid)[1:2]
        pid = int(parent[0]) if parent else 0
        above = contents(f"/proc/{pid}/cmdline")
        if not above or (line and pid == 1):
            break
        line = above
        program, *arguments = (each.rpartition(b"/")[2] for each in line.split(b"\0"))
        if program not in _STARTERS or b"talk" not in arguments:
            break
    return line.rstrip(b"\0").replace(b"\0", b" ").decode(errors="replace")[:MAX_COMMAND] if line else None


def stat_of(pid: int) -> list[bytes]:
    """Return what /proc says of a process: state, parent, group, session, and more; empty if it can't be known."""
    stat = contents(f"/proc/{pid}/stat") or b""
    # Before these is the program's name, in brackets; it may itself hold blanks and brackets.
    return stat.rpartition(b")")[2].split()


def contents(path: str, most: int = 4096) -> bytes | None:
    """Return the start of a file under /proc, at most so many bytes, all of it for -1; None where it isn't there, or
    is another user's.
    """
    try:
        with open(path, "rb", buffering=0) as file:
            return file.read(most)
    except OSError:  # which may come of reading, too: the process is gone by now
        return None
