"""The resources that a server and its processes use, read from /proc (Linux only)."""

from __future__ import annotations

import contextlib
import os
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tests.support.surroundings import command_line

if TYPE_CHECKING:
    from collections.abc import Callable

#: Time for ended processes and connections to disappear.
_SETTLE_LIMIT_S = 5.0


@dataclass(frozen=True, slots=True)
class Usage:
    """The resources that a server uses at one time."""

    processes: int  # the server and all its descendants
    descriptors: int  # of the server
    threads: int  # of the server
    memory: int  # kB of private memory of all processes


def count(pid: int) -> Usage:
    """Return the resources that a running server uses."""
    below = descendants(pid)
    return Usage(
        processes=1 + len(below),
        descriptors=len(os.listdir(f"/proc/{pid}/fd")),
        threads=len(os.listdir(f"/proc/{pid}/task")),
        memory=sum(_private_kb(process) for process in (pid, *below)),
    )


def wait_until(pid: int, wanted: Callable[[Usage], bool], within: float = _SETTLE_LIMIT_S) -> Usage:
    """Wait until the usage is as wanted or the time is over, and return it."""
    end = time.monotonic() + within
    while not wanted(now := count(pid)) and time.monotonic() < end:
        time.sleep(0.05)  # the end of a connection sends no event to others
    return now


def assert_not_grown(pid: int, before: Usage, memory: int) -> Usage:
    """Assert that a server has no more processes, descriptors and threads, and at most `memory` kB more than before."""

    def fits(now: Usage) -> bool:
        return all(getattr(now, name) <= getattr(before, name) for name in ("processes", "descriptors", "threads"))

    now = wait_until(pid, fits)
    assert fits(now), f"before: {before}; now: {now}; {describe(pid)}"
    assert now.memory <= before.memory + memory, f"before: {before}; now: {now}"
    return now


def descriptors(pid: int) -> dict[int, str]:
    """Return the open descriptors of a process with their targets."""
    folder = f"/proc/{pid}/fd"
    targets = {}
    for name in os.listdir(folder):
        with contextlib.suppress(FileNotFoundError):
            targets[int(name)] = os.readlink(f"{folder}/{name}")
    return targets


def descendants(pid: int) -> list[int]:
    """Return the ids of all processes that descend from a process."""
    parents: dict[int, list[int]] = {}
    for name in os.listdir("/proc"):
        if name.isdigit():
            with contextlib.suppress(OSError), open(f"/proc/{name}/stat", "rb") as file:
                # The name in brackets may contain any character, even brackets.
                parents.setdefault(int(file.read().rpartition(b")")[2].split()[1]), []).append(int(name))
    below, due = [], [pid]
    while due:
        children = parents.get(due.pop(), [])
        below += children
        due += children
    return below


def _private_kb(pid: int) -> int:
    with contextlib.suppress(OSError), open(f"/proc/{pid}/smaps_rollup", encoding="utf-8") as file:
        return next((int(line.split()[1]) for line in file if line.startswith("Private_Dirty:")), 0)
    return 0  # it has ended


def describe(pid: int) -> str:
    """Return the descendants and descriptors of a process, for messages."""
    targets = [f"{number} → {target}" for number, target in descriptors(pid).items()]
    return "; ".join([*(command_line(child) for child in descendants(pid)), *sorted(targets)])
