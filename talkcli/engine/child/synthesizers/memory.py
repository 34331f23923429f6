"""The memory that this process has for itself, and what the C library keeps of it though nobody uses it."""

from __future__ import annotations


def own_bytes() -> int | None:
    """Return the bytes of this process that are no file's and not shared, in memory or swapped out; None if unknown.

    Some sandboxes have no such file.
    """
    try:
        with open("/proc/self/status", "rb") as file:
            told = dict(line.split(b":", 1) for line in file)
        return sum(int(told[each].split()[0]) for each in (b"RssAnon", b"VmSwap")) * 1024
    except (OSError, KeyError, ValueError):
        return None


def give_back() -> None:
    """Return to the system what was freed: glibc keeps most of a dropped model. It takes 1 to 13 ms."""
    import ctypes

    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
