"""A function that waits until file descriptors are ready or the time is up.

Other descriptors can interrupt the wait. A coroutine that waits with a `WaitReady` function works without an event
loop, too: `run_blocking` runs it with `block_until_ready`, which blocks.
"""

from __future__ import annotations

from talkcli.frozen import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine, Mapping
    from typing import Any, TypeVar

    _T = TypeVar("_T")
    #: A coroutine function with the parameters and the result of `wait_ready`.
    WaitReady = Callable[[Mapping[int, int], float | None, Mapping[int, int] | None], Awaitable[set[int]]]

#: The deadline of a wait without a time limit.
NEVER = float("inf")


class Interrupted(Exception):
    """Raised by `wait_ready` if one of the interrupting descriptors is ready."""


def wait_ready(
    watched: Mapping[int, int], timeout: float | None, interrupt: Mapping[int, int] | None = None
) -> set[int]:
    """Wait until a descriptor is ready or the time is up. Return the descriptors that are ready.

    Args:
        watched: the poll events to wait for, by descriptor. Errors and hang-ups always count.
        timeout: the longest wait in seconds, or None for no limit.
        interrupt: more descriptors with their events.

    Raises:
        Interrupted: one of the descriptors in `interrupt` is ready.
    """
    # Imported here, because commands that never wait don't need these modules.
    import math
    import select

    interrupt = interrupt or {}
    poll = select.poll()  # unlike select(), poll() supports more than 1,024 descriptors
    for fd, events in (*watched.items(), *interrupt.items()):
        poll.register(fd, events)
    # poll() takes a C int of milliseconds, which is at most 24 days. If the timeout is longer, the caller waits again.
    milliseconds = None if timeout is None else math.ceil(min(max(0.0, timeout * 1000), 2**31 - 1))
    found = {fd for fd, _ in poll.poll(milliseconds)}
    if not found.isdisjoint(interrupt):
        raise Interrupted
    return found


async def block_until_ready(
    watched: Mapping[int, int], timeout: float | None, interrupt: Mapping[int, int] | None = None
) -> set[int]:
    """Call the blocking function `wait_ready`, for coroutines that run without an event loop."""
    return wait_ready(watched, timeout, interrupt)


def run_blocking(coroutine: Coroutine[Any, Any, _T]) -> _T:
    """Run a coroutine that blocks instead of suspending. Return its result."""
    try:
        coroutine.send(None)
    except StopIteration as end:
        return end.value  # type: ignore[no-any-return]
    raise AssertionError(f"{coroutine!r} was suspended before it returned")
