"""The resources of a server and its processes, counted from outside: from /proc, on Linux alone."""

from __future__ import annotations

import contextlib
import os
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tests.support.surroundings import command_line

if TYPE_CHECKING:
    from collections.abc import Callable

#: Seconds in which ended processes have been cleared away.
_SETTLED = 5.0


@dataclass(frozen=True, slots=True)
class Usage:
    """One count of a server."""

    processes: int  # the server and all below it
    descriptors: int  # of the server
    threads: int  # of the server
    memory: int  # kB that each of them has written to and does not share


def count(pid: int) -> Usage:
    """Count a running server."""
    family = descendants(pid)
    return Usage(
        processes=1 + len(family),
        descriptors=len(os.listdir(f"/proc/{pid}/fd")),
        threads=len(os.listdir(f"/proc/{pid}/task")),
        memory=sum(_own(each) for each in (pid, *family)),
    )


def wait_until(pid: int, wanted: Callable[[Usage], bool], within: float = _SETTLED) -> Usage:
    """Return the first count that is as wanted, or the last one within these seconds."""
    end = time.monotonic() + within
    while not wanted(found := count(pid)) and time.monotonic() < end:
        time.sleep(0.05)  # the end of a connection sends no event to others
    return found


def assert_not_grown(pid: int, before: Usage, memory: int) -> Usage:
    """Assert that a server has no more processes, descriptors and threads than before, and at most so many kB more."""

    def fits(now: Usage) -> bool:
        return all(getattr(now, each) <= getattr(before, each) for each in ("processes", "descriptors", "threads"))

    found = wait_until(pid, fits)
    assert fits(found), f"before: {before}; now: {found}; {describe(pid)}"
    assert found.memory <= before.memory + memory, f"before: {before}; now: {found}"
    return found


def descriptors(pid: int) -> dict[int, str]:
    """Return the open descriptors of a process with their targets."""
    folder = f"/proc/{pid}/fd"
    found = {}
    for name in os.listdir(folder):
        with contextlib.suppress(FileNotFoundError):
            found[int(name)] = os.readlink(f"{folder}/{name}")
    return found


def descendants(pid: int) -> list[int]:
    """Return the ids of all processes below one."""
    parents: dict[int, list[int]] = {}
    for name in os.listdir("/proc"):
        if name.isdigit():
            with contextlib.suppress(OSError), open(f"/proc/{name}/stat", "rb") as file:
                # The name in brackets may hold any character, even brackets.
                parents.setdefault(int(file.read().rpartition(b")")[2].split()[1]), []).append(int(name))
    found, due = [], [pid]
    while due:
        below = parents.get(due.pop(), [])
        found += below
        due += below
    return found


def _own(pid: int) -> int:
    with contextlib.suppress(OSError), open(f"/proc/{pid}/smaps_rollup", encoding="utf-8") as file:
        return next((int(each.split()[1]) for each in file if each.startswith("Private_Dirty:")), 0)
    return 0  # it has ended


def describe(pid: int) -> str:
    """Return the descendants and descriptors of a process, for messages."""
    targets = [f"{number} → {target}" for number, target in descriptors(pid).items()]
    return "; ".join([*(command_line(each) for each in descendants(pid)), *sorted(targets)])
