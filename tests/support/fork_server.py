"""Forks processes that run `talk`, all of it imported already: the program behind `tests.support.forking`.

It reads requests from the socket whose number is its argument: eight bytes of length, with the descriptors for standard
input, output and error and one for the child's exit status; then so many bytes of JSON. It answers with the child's id.
It ends with its socket, and each child with it.

A child leaves `_serve` and runs to the end of this file. Its interpreter isn't cleaned up, which would take longer than
most commands. No thread is started here, as a fork would leave it behind.
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

_KILLED_WITH_PARENT = 1  # PR_SET_PDEATHSIG
#: Modules that no client and no server imports.
_LEFT_OUT = ("talkcli.__main__", "talkcli.engine.child.main", "talkcli.engine.child.synthesizers")


def _import_talk() -> None:
    for each in pkgutil.walk_packages(talkcli.__path__, "talkcli."):
        if not each.name.startswith(_LEFT_OUT):
            importlib.import_module(each.name)


def _serve(channel: socket.socket) -> dict[str, Any]:
    """Fork a child for each request; return the request in the child, and never in the parent."""
    own = os.getpid()
    ended: dict[int, tuple[int, int]] = {}  # by the child's pidfd: its id, and the descriptor for its exit status
    poll = select.poll()
    poll.register(channel, select.POLLIN)
    while True:
        for descriptor, _ in poll.poll():
            if descriptor != channel.fileno():
                poll.unregister(descriptor)
                child, told = ended.pop(descriptor)
                _tell(told, os.waitpid(child, 0)[1])
                os.close(descriptor)
                continue
            asked, given = _receive(channel)
            child = os.fork()
            if child == 0:
                channel.detach()
                _become(asked, given, own)
                return asked
            for each in given[:3]:
                os.close(each)
            watched = os.pidfd_open(child)
            ended[watched] = (child, given[3])
            poll.register(watched, select.POLLIN)
            channel.sendall(struct.pack("<q", child))


def _end(code: object) -> None:
    """End this process with its output written; return if a thread still runs or the output can't be written."""
    with contextlib.suppress(OSError, ValueError):
        if threading.active_count() == 1 and isinstance(code, int):
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)


def _receive(channel: socket.socket) -> tuple[dict[str, Any], list[int]]:
    head, given, _, _ = socket.recv_fds(channel, 8, 4)
    length = struct.unpack("<q", head)[0] if head else 0
    text = channel.recv(length, socket.MSG_WAITALL)
    if not text or len(text) < length:
        os._exit(0)  # the tests are over
    return json.loads(text), given


def _tell(told: int, status: int) -> None:
    with contextlib.suppress(BrokenPipeError):  # nobody waits for it any more
        os.write(told, struct.pack("<i", status))
    os.close(told)


def _become(asked: dict[str, Any], given: list[int], parent: int) -> None:
    """Give this child the words, environment, directory and descriptors of a process of its own."""
    ctypes.CDLL(None).prctl(_KILLED_WITH_PARENT, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(0)  # the parent had ended before
    if asked["session"]:
        os.setsid()
    for number, each in enumerate(given[:3]):
        os.dup2(each, number)
    os.closerange(3, max(map(int, os.listdir("/proc/self/fd"))) + 1)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    os.environ.clear()
    os.environ.update(asked["env"])
    os.chdir(asked["directory"])
    # As Python opens them if the locale is C.UTF-8; `__stdout__` and the like stay as they were, and are not used.
    sys.stdin, sys.stdout = _stream(0, "r", "surrogateescape"), _stream(1, "w", "surrogateescape")
    sys.stderr = _stream(2, "w", "backslashreplace")
    sys.stderr.reconfigure(line_buffering=True)
    sys.argv = ["talk", *asked["words"]]
    if asked["scripted"]:
        scripted_serve.replace_engine()


def _stream(descriptor: int, mode: str, errors: str) -> io.TextIOWrapper:
    raw = open(descriptor, f"{mode}b", closefd=False)  # noqa: SIM115 - it lives as long as the process
    return io.TextIOWrapper(raw, "utf-8", errors, line_buffering=os.isatty(descriptor))


if __name__ == "__main__":
    _import_talk()
    gc.collect()
    gc.freeze()  # so that no child copies objects that none of them frees
    # Python forgets, in the child, the signals that came during a fork: this one waits until the child is itself.
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    request = _serve(socket.socket(fileno=int(sys.argv[1])))

    from talkcli.cli import main

    try:
        main()
    except SystemExit as end:
        _end(end.code)
        raise
