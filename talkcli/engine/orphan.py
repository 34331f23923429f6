"""Dies with its parent: asks the kernel to kill a process when the thread that started it is gone.

Linux only (prctl); elsewhere nothing is asked, and the end of the command socket has to do. It must not import anything
that only Linux has before it is called, and what runs between fork and exec must not import at all.
"""

from __future__ import annotations

import os
import signal
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

_PR_SET_PDEATHSIG = 1


def die_with_parent() -> None:
    """Have this process killed as soon as its parent's starting thread ends."""
    _death_request()()


def prepare_child() -> Callable[[], None]:
    """Return what a child calls between fork and exec, so that it dies with this process.

    It leads a process group of its own, so that whatever it starts itself can be killed with it.

    All that it needs is looked up here: the child of a fork must not import or allocate more than it has to. The parent
    may have died between the fork and the request, so the child looks afterwards who its parent is.
    """
    request = _death_request()
    parent = os.getpid()

    def in_child() -> None:
        os.setpgid(0, 0)
        request()
        if os.getppid() != parent:
            os._exit(1)

    return in_child


def _death_request() -> Callable[[], None]:
    if not sys.platform.startswith("linux"):
        return lambda: None
    import ctypes

    prctl = ctypes.CDLL(None, use_errno=True).prctl
    kill = int(signal.SIGKILL)

    def request() -> None:
        if prctl(_PR_SET_PDEATHSIG, kill, 0, 0, 0) != 0:
            raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG) failed")

    return request
