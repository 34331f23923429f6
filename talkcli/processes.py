"""Functions that use pipes to find and kill running processes."""

from __future__ import annotations

import contextlib
import itertools
import os
import select
import signal

from talkcli.frozen import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

#: How long to wait for a killed process to close its pipe, which usually takes 1 to 2 ms. If the pipe is still open
#: after this time, other processes must be holding it open.
_RELEASE_S = 0.01


def open_pipes(count: int) -> list[tuple[int, int]]:
    """Open `count` pipes. Return the descriptors of both ends of each pipe.

    If one can't be opened, none is left open.
    """
    with contextlib.ExitStack() as opened:
        pipes = []
        for _ in range(count):
            pipes.append(os.pipe())
            opened.callback(close, *pipes[-1])
        opened.pop_all()
    return pipes


def close(*descriptors: int) -> None:
    """Close the given file descriptors."""
    for each in descriptors:
        os.close(each)


def is_held(pipe: int, seconds: float = 0.0) -> bool:
    """Wait up to `seconds` for the other end of a pipe to close. Return whether it is still open."""
    # Don't use `wait_ready` here, because it imports modules. A player may be killed while the interpreter exits, when
    # modules can't be imported.
    poll = select.poll()
    poll.register(pipe, 0)  # Linux reports that the other end was closed even if no events are requested
    return not poll.poll(seconds * 1000)


def kill_holders(pipe: int) -> bool:
    """Kill all other processes that hold a pipe open. Return whether any was killed.

    Another user's process can't be killed, and without /proc no process can be found.
    """
    if not is_held(pipe, _RELEASE_S):
        return False
    link, own = f"pipe:[{os.fstat(pipe).st_ino}]", os.getpid()
    # Stop as soon as the pipe is closed, because reading all of /proc can take tenths of a second on a busy machine.
    while_held = itertools.takewhile(lambda _: is_held(pipe, 0), process_ids())
    return kill(pid for pid in while_held if pid != own and link in _read_links(f"/proc/{pid}/fd"))


def kill(pids: Iterable[int]) -> bool:
    """Kill the processes. Return whether any was killed.

    A negative id means a process group.
    """
    killed = False
    for pid in pids:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.kill(pid, signal.SIGKILL)
            killed = True
    return killed


def process_ids() -> list[int]:
    """Return the ids of all processes. The list is empty if /proc can't be read."""
    return [int(name) for name in _list_names("/proc") if name.isdigit()]


def _read_links(folder: str) -> Iterator[str]:
    """Yield the targets of all readable symbolic links in a directory."""
    for name in _list_names(folder):
        with contextlib.suppress(OSError):  # the descriptor has been closed in the meantime
            yield os.readlink(f"{folder}/{name}")


def _list_names(folder: str) -> list[str]:
    """Return the names in a directory. The list is empty if the directory can't be read."""
    try:
        return os.listdir(folder)
    except OSError:  # the directory belongs to another user, or doesn't exist
        return []


def signal_name(number: int) -> str:
    """Return the name of a signal, such as SIGTERM.

    If it has no name, return "signal" and the number.
    """
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
