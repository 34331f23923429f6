"""Who is at the other end of a Unix socket, as the kernel tells it. Light: clients import it at every start."""

from __future__ import annotations

import os
import socket
import struct

#: Characters of a command line that are kept: enough for an interpreter, a script and its first arguments.
MAX_COMMAND = 200

_LOCAL_PEERCRED = 0x001  # <sys/un.h> on macOS
_LOCAL_PEERPID = 0x002
_SOL_LOCAL = 0


def credentials(peer: socket.socket) -> tuple[int, int]:
    """Return process id and user id of whoever connected, or of whoever listened, at that moment."""
    if hasattr(socket, "SO_PEERCRED"):
        pid, uid, _ = struct.unpack("3i", peer.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
        return pid, uid
    # struct xucred: version, uid, number of groups, sixteen groups
    _, uid = struct.unpack_from("II", peer.getsockopt(_SOL_LOCAL, _LOCAL_PEERCRED, 76))
    (pid,) = struct.unpack("i", peer.getsockopt(_SOL_LOCAL, _LOCAL_PEERPID, 4))
    return pid, uid


def command_of(pid: int) -> str | None:
    """Return the name of the program that runs as this process, or None if it can't be known."""
    line = _read(f"/proc/{pid}/comm")
    return line.decode(errors="replace").rstrip("\n") if line else None


def parent_command_of(pid: int) -> str | None:
    """Return the command line of the process that started this one, or None if it can't be known."""
    stat = _read(f"/proc/{pid}/stat")
    if not stat:
        return None
    # The second field is the program's name in brackets and may itself hold blanks and brackets: take what follows it.
    parent = int(stat.rpartition(b")")[2].split()[1])
    line = _read(f"/proc/{parent}/cmdline")
    if not line:
        return None
    return line.rstrip(b"\0").replace(b"\0", b" ").decode(errors="replace")[:MAX_COMMAND]


def _read(path: str) -> bytes | None:
    """Return the start of a file under /proc; None where it isn't there, or is another user's."""
    try:
        fd = os.open(path, os.O_RDONLY)
    except OSError:
        return None
    try:
        return os.read(fd, 4096)
    except ProcessLookupError:
        return None
    finally:
        os.close(fd)
