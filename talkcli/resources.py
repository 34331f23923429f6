"""What the system lets this process have of memory and threads, in words, for errors that come of that."""

from __future__ import annotations

import resource

#: The limits that can be the reason, what each is of, and where it is set: in a shell, in a systemd unit.
_LIMITS = (
    (resource.RLIMIT_DATA, "bytes of memory", "ulimit -d, LimitDATA="),
    (resource.RLIMIT_AS, "bytes of address space", "ulimit -v, LimitAS="),
)


def limits() -> str:
    """Return the first limit that this process runs under, or where else to look: the end of a sentence."""
    for number, what, where in _LIMITS:
        allowed = resource.getrlimit(number)[0]
        if allowed != resource.RLIM_INFINITY:
            return f"it is limited to {allowed:,} {what} ({where})"
    return "see 'free', 'ulimit -u', and MemoryMax= and TasksMax= of its unit"
