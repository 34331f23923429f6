"""The program that `tests.support.forking` runs: it imports `talk` once, and forks a process for each command.

Its argument is the number of a socket. Each request consists of eight bytes with the length of the rest, and JSON. The
first bytes come with four descriptors: standard input, output and error, and a pipe for the exit status. The reply is
the child's process id. The program ends when the socket is closed, and its children are killed with it.

A child leaves `_serve` and runs to the end of this file. Its interpreter isn't cleaned up, because this would take
longer than most commands. This program must not start threads, because a fork doesn't copy them.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import importlib
import io
import json
import os
import pkgutil
import select
import signal
import socket
import struct
import sys
import threading
from typing import Any

import talkcli
from tests.support import scripted_serve

_PR_SET_PDEATHSIG = 1
#: Modules that neither clients nor servers import.
_NOT_IMPORTED = ("talkcli.__main__", "talkcli.engine.child.main", "talkcli.engine.child.synthesizers")


def _import_talk() -> None:
    for module in pkgutil.walk_packages(talkcli.__path__, "talkcli."):
        if not module.name.startswith(_NOT_IMPORTED):
            importlib.import_module(module.name)


def _serve(channel: socket.socket) -> None:
    """Fork a child for each request. Only return in the children."""
    parent = os.getpid()
    children: dict[int, tuple[int, int]] = {}  # by pidfd: process id, and the pipe for the exit status
    poll = select.poll()
    poll.register(channel, select.POLLIN)
    while True:
        for descriptor, _ in poll.poll():
            if descriptor != channel.fileno():
                poll.unregister(descriptor)
                child, pipe = children.pop(descriptor)
                _send_status(pipe, os.waitpid(child, 0)[1])
                os.close(descriptor)
                continue
            request, descriptors = _receive(channel)
            child = os.fork()
            if child == 0:
                channel.detach()
                _set_up_child(request, descriptors, parent)
                return
            for stream in descriptors[:3]:
                os.close(stream)
            pidfd = os.pidfd_open(child)
            children[pidfd] = (child, descriptors[3])
            poll.register(pidfd, select.POLLIN)
            channel.sendall(struct.pack("<q", child))


def _end(code: object) -> None:
    """Write the output and end this process. Return if a thread still runs or if the output can't be written."""
    with contextlib.suppress(OSError, ValueError):
        if threading.active_count() == 1 and isinstance(code, int):
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)


def _receive(channel: socket.socket) -> tuple[dict[str, Any], list[int]]:
    head, descriptors, _, _ = socket.recv_fds(channel, 8, 4)
    length = struct.unpack("<q", head)[0] if head else 0
    text = channel.recv(length, socket.MSG_WAITALL)
    if not text or len(text) < length:
        os._exit(0)  # the tests have ended
    return json.loads(text), descriptors


def _send_status(pipe: int, status: int) -> None:
    with contextlib.suppress(BrokenPipeError):  # no test waits for it
        os.write(pipe, struct.pack("<i", status))
    os.close(pipe)


def _set_up_child(request: dict[str, Any], descriptors: list[int], parent: int) -> None:
    """Set this child's arguments, environment, directory and descriptors, as for a new process."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(0)  # the parent ended before prctl
    if request["session"]:
        os.setsid()
    for number, stream in enumerate(descriptors[:3]):
        os.dup2(stream, number)
    os.closerange(3, max(map(int, os.listdir("/proc/self/fd"))) + 1)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    os.environ.clear()
    os.environ.update(request["env"])
    os.chdir(request["directory"])
    # Opened as Python does in the locale C.UTF-8. `sys.__stdout__` and the like keep the old streams, but talk doesn't
    # use them.
    sys.stdin, sys.stdout = _stream(0, "r", "surrogateescape"), _stream(1, "w", "surrogateescape")
    sys.stderr = _stream(2, "w", "backslashreplace")
    sys.stderr.reconfigure(line_buffering=True)
    # As `python -m talkcli` sets it, because `talk` alone may be another installation on the PATH.
    sys.argv = [f"{talkcli.__path__[0]}/__main__.py", *request["arguments"]]
    if request["scripted"]:
        scripted_serve.replace_engine()


def _stream(descriptor: int, mode: str, errors: str) -> io.TextIOWrapper:
    raw = open(descriptor, f"{mode}b", closefd=False)  # noqa: SIM115 - stays open until the process ends
    return io.TextIOWrapper(raw, "utf-8", errors, line_buffering=os.isatty(descriptor))


if __name__ == "__main__":
    _import_talk()
    gc.collect()
    gc.freeze()  # so that no child copies these objects
    # A child loses Python signals that arrive during the fork. So SIGINT stays blocked until the child is set up.
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    _serve(socket.socket(fileno=int(sys.argv[1])))

    from talkcli.cli import main

    try:
        main()
    except SystemExit as end:
        _end(end.code)
        raise
