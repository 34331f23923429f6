"""The clock of everything that has a limit: a change of the wall clock does not move it, and a suspend counts."""

from __future__ import annotations

import time

#: Linux's monotonic clock stands still while the machine sleeps, the one since the boot does not. Elsewhere, on macOS,
#: the monotonic one goes on.
_CLOCK = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)

#: Seconds after which a timer looks at this clock again: the event loop's own timers stand still in a suspend, and what
#: was due in it must not wait for as long again.
LOOK_EVERY = 1.0


def elapsed() -> float:
    """Return seconds since some moment in the past."""
    return time.clock_gettime(_CLOCK)
