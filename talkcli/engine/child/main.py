"""The engine process: the server starts it, in a session of its own, to speak through pyttsx3.

Its standard input is the socket to the server, which it reads and writes. Its state is of no further use, so the server
may kill it at any time. When the server is gone, the process and its player must end too.
"""

from __future__ import annotations

import os
import resource
import signal
import sys

from talkcli.engine import protocol

#: Memory that the process may use on any machine. With a voice of 63 MB it uses 0.4 billion bytes.
_MIN_MEMORY_BYTES = 1 << 30
#: Linux's number for the prctl that kills this process when the thread that started it ends.
_PR_SET_PDEATHSIG = 1


def main() -> None:
    """Run the engine process to its end."""
    _die_with_parent()
    _limit_core_dump()
    _limit_memory()
    # Ctrl-C in the server's terminal, and the end of that terminal, are for the server to handle. A server or a player
    # that stops reading is noticed by the write that fails.
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGPIPE):
        signal.signal(number, signal.SIG_IGN)
    # The server may have inherited that SIGCHLD is ignored. Then no exit status of a player could be read.
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    # Imported now, because they take some time and the process must not outlive its server meanwhile.
    from talkcli.engine.child.driver import CannotStart, start
    from talkcli.engine.child.players.base import CannotEnd
    from talkcli.engine.child.players.chooser import PlayerChooser
    from talkcli.engine.child.runner import Channel, GoalRunner

    channel = Channel()
    configure = None
    while configure is None and not channel.closed:
        configure = next(iter(channel.receive()), None)
    # The server may have ended before the kernel was asked to watch it.
    if not isinstance(configure, protocol.Configure) or os.getppid() != configure.server_pid:
        return
    runner = GoalRunner(channel, PlayerChooser(configure, _inherited_descriptors()))
    try:
        channel.send(start(configure, runner))
        runner.run(send_voices=configure.list_voices)
    except CannotStart as error:
        channel.send(error.failure)
    except CannotEnd as error:  # the server sees that a player is left, and starts another process
        sys.stderr.write(f"{error}\n")
    threading = sys.modules.get("threading")
    if threading and threading.active_count() > 1:  # don't wait for a voice being loaded or a model being run
        sys.stderr.flush()
        os._exit(0)


def _die_with_parent() -> None:
    """Have the kernel kill this process when the thread that started it ends.

    That thread may have ended before, so the caller must then check who the parent is. Only Linux can do this.
    Elsewhere, the process ends with the socket to the server.
    """
    if not sys.platform.startswith("linux"):
        return
    import ctypes

    prctl = ctypes.CDLL(None, use_errno=True).prctl
    if prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG) failed")


def _limit_core_dump() -> None:
    """Prevent a core dump when a text crashes the library. It would take longer than the restart, and wear SD cards.

    The limit is one byte, because with a limit of 0 the core would still be piped to a program that collects cores.
    """
    _, hard = resource.getrlimit(resource.RLIMIT_CORE)
    resource.setrlimit(resource.RLIMIT_CORE, (1 if hard else 0, hard))


def _limit_memory() -> None:
    """Limit this process to half of the machine's memory, because a voice's model can ask for any amount.

    A library reports memory that it can't have. Without the limit the machine would stall, and the kernel would kill
    some process.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    limit = max(_MIN_MEMORY_BYTES, os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2)
    if soft == resource.RLIM_INFINITY or soft > limit:
        resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))


def _inherited_descriptors() -> list[int]:
    """Return the descriptors that a player must inherit; none if the process was started by hand."""
    value = os.environ.get(protocol.LIVENESS_VARIABLE)
    if value is None:
        return []
    descriptor = int(value)
    os.fstat(descriptor)  # fail now if it isn't open, or every sentence would fail
    os.set_inheritable(descriptor, False)
    return [descriptor]
