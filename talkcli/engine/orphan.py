"""Dies with its parent: asks the kernel to kill this process when the thread that started it is gone.

Linux only (prctl); elsewhere nothing is asked, and the end of the command socket has to do. It must not import anything
that only Linux has before it is called. What this process starts itself is tied to it in another way: see `child`.
"""

from __future__ import annotations

import signal
import sys

_PR_SET_PDEATHSIG = 1


def die_with_parent() -> None:
    """Have this process killed as soon as its parent's starting thread ends; afterwards, see who that is."""
    if not sys.platform.startswith("linux"):
        return
    import ctypes

    prctl = ctypes.CDLL(None, use_errno=True).prctl
    if prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG) failed")
