"""What a server and all that it started take of the machine, counted from outside: from /proc, on Linux alone."""

from __future__ import annotations

import contextlib
import os
import time
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

from tests.support.surroundings import command_line

if TYPE_CHECKING:
    from collections.abc import Callable

#: Seconds in which what ended has been cleared away.
_SETTLED = 5.0


@dataclass(frozen=True, slots=True)
class Census:
    """One count of a server."""

    processes: int  # the server and all below it
    descriptors: int  # of the server
    threads: int  # of the server
    memory: int  # kB of all of them that each has written to and shares with nobody

    def __str__(self) -> str:
        return ", ".join(f"{each.name} {getattr(self, each.name)}" for each in fields(self))


def count(pid: int) -> Census:
    """Count a server that runs."""
    family = descendants(pid)
    return Census(
        processes=1 + len(family),
        descriptors=len(os.listdir(f"/proc/{pid}/fd")),
        threads=len(os.listdir(f"/proc/{pid}/task")),
        memory=sum(_own(each) for each in (pid, *family)),
    )


def settled(pid: int, wanted: Callable[[Census], bool], within: float = _SETTLED) -> Census:
    """Return the first count that is as wanted, or the last one: what is closed goes in its own time."""
    end = time.monotonic() + within
    while not wanted(found := count(pid)) and time.monotonic() < end:
        time.sleep(0.05)  # that a process or a connection is gone is no event for others
    return found


def assert_as_before(pid: int, before: Census, memory: int) -> Census:
    """Assert that a server has no more processes, descriptors and threads than before, and so many kB more at most."""
    found = settled(pid, lambda now: _fits(now, before))
    assert _fits(found, before), f"before: {before}; now: {found}; {told(pid)}"
    assert found.memory <= before.memory + memory, f"before: {before}; now: {found}"
    return found


def descriptors(pid: int) -> dict[int, str]:
    """Return what a process has open, but for what it closes meanwhile."""
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
                # The name in brackets may hold anything, brackets too.
                parents.setdefault(int(file.read().rpartition(b")")[2].split()[1]), []).append(int(name))
    found, due = [], [pid]
    while due:
        below = parents.get(due.pop(), [])
        found += below
        due += below
    return found


def _fits(now: Census, before: Census) -> bool:
    return now.processes <= before.processes and now.descriptors <= before.descriptors and now.threads <= before.threads


def _own(pid: int) -> int:
    with contextlib.suppress(OSError), open(f"/proc/{pid}/smaps_rollup", encoding="utf-8") as file:
        return next((int(each.split()[1]) for each in file if each.startswith("Private_Dirty:")), 0)
    return 0  # it has ended


def told(pid: int) -> str:
    """Return what a process has, for messages."""
    targets = [f"{number} → {target}" for number, target in descriptors(pid).items()]
    return "; ".join([*(command_line(each) for each in descendants(pid)), *sorted(targets)])
