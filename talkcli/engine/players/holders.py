"""Who holds a pipe: finds and kills what a player has started out of its process group and session.

Such a process is reached by no signal to the group, and may still be heard. It is known by a pipe that it has
inherited; what closed that has nothing to do with the player any more (a sound server that it started, `ssh -f`) and is
left alone. Linux only, by /proc; elsewhere it lives on.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterator

#: Seconds in which what was killed lets go of a pipe; it takes a millisecond or two. Before that nobody is looked for.
_MOMENT = 0.01


def is_held(pipe: int, seconds: float = 0.0) -> bool:
    """Whether somebody holds the other end of a pipe after so many seconds."""
    poll = select.poll()
    poll.register(pipe, 0)  # that the other end is closed is told unasked
    return not poll.poll(seconds * 1000)


def kill_holders(pipe: int) -> bool:
    """Kill the processes that hold a pipe, but this one, where they don't let go of it in a moment.

    Return whether any of them was killed: others can't be, or can't be found.
    """
    killed = False
    if not is_held(pipe, _MOMENT):
        return killed
    for pid in _holders(f"pipe:[{os.fstat(pipe).st_ino}]"):
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.kill(pid, signal.SIGKILL)
            killed = True
    return killed


def _holders(link: str) -> Iterator[int]:
    own = str(os.getpid())
    for name in _names("/proc"):
        if name.isdigit() and name != own and link in _links(f"/proc/{name}/fd"):
            yield int(name)


def _links(folder: str) -> Iterator[str]:
    for name in _names(folder):
        with contextlib.suppress(OSError):  # it is closed again
            yield os.readlink(f"{folder}/{name}")


def _names(folder: str) -> list[str]:
    try:
        return os.listdir(folder)
    except OSError:  # another user's, or gone; or there is none
        return []
