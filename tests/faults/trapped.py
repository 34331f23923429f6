"""Runs a program that cannot be reaped for some seconds after it was killed, as if it hung in a device driver.

Usage: `python trapped.py SECONDS PROGRAM ARGUMENT…`. The kernel waits for a tracer before it frees a killed process.
A program that exits normally is reaped at once.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import time

_SEIZE, _CONTINUE, _EVENT_MESSAGE = 0x4206, 7, 0x4201
_TRACE_EXIT, _EXIT_EVENT = 0x40, 6
_SET_PTRACER, _ANY = 0x59616D61, 2**64 - 1
_ALL_CHILDREN = 0x40000000


def main() -> None:
    """Start a tracer for this process, and execute the program."""
    libc = ctypes.CDLL(None, use_errno=True)
    libc.ptrace.argtypes = [ctypes.c_ulong] * 4
    libc.ptrace.restype = ctypes.c_long
    libc.prctl(_SET_PTRACER, ctypes.c_ulong(_ANY), 0, 0, 0)
    player = os.getpid()
    traced, tell = os.pipe()
    if os.fork() == 0:
        _trace(libc, player, tell, float(sys.argv[1]))
    os.close(tell)
    os.read(traced, 1)
    os.close(traced)
    os.execvp(sys.argv[2], sys.argv[2:])


def _trace(libc: ctypes.CDLL, player: int, tell: int, seconds: float) -> None:
    """Delay the end of the player if it is killed, without keeping any of its descriptors open."""
    os.setsid()
    nothing = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(nothing, descriptor)
    os.closerange(3, tell)
    os.closerange(tell + 1, 1024)
    libc.ptrace(_SEIZE, player, 0, _TRACE_EXIT)
    os.close(tell)
    while True:
        try:
            _, status = os.waitpid(player, _ALL_CHILDREN)
        except ChildProcessError:  # tracing is not allowed
            os._exit(1)
        if not os.WIFSTOPPED(status):
            os._exit(0)
        if status >> 16 == _EXIT_EVENT:
            end = ctypes.c_ulong()
            libc.ptrace(_EVENT_MESSAGE, player, 0, ctypes.addressof(end))
            if os.WIFSIGNALED(end.value) and os.WTERMSIG(end.value) == signal.SIGKILL:
                time.sleep(seconds)
                os._exit(0)
        libc.ptrace(_CONTINUE, player, 0, 0 if status >> 16 else os.WSTOPSIG(status))


if __name__ == "__main__":
    main()
