"""Entry point of the engine process, which speaks through pyttsx3.

The server starts the process in a session of its own. The standard input of the process is the socket to the server,
which the process both reads and writes. The server may kill the process at any time, because the process has no state
worth keeping. If the server exits, the process and its player must exit too.
"""

from __future__ import annotations

import os
import resource
import signal
import sys

from talkcli.engine import protocol

#: Lower bound of the memory limit, for small machines. With a voice of 63 MB, the process uses 0.4 GB.
_MIN_MEMORY_BYTES = 1 << 30
#: The prctl operation that requests a signal when the parent thread exits (Linux only).
_PR_SET_PDEATHSIG = 1


def main() -> None:
    """Run the engine process until the server disconnects or an error makes it exit."""
    _die_with_parent()
    _limit_core_dump()
    _limit_memory()
    # Only the server reacts to Ctrl-C and to the closing of its terminal. SIGPIPE is ignored, so that writing raises an
    # error if the server or the player has stopped reading.
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGPIPE):
        signal.signal(number, signal.SIG_IGN)
    # The parent may have ignored SIGCHLD. In that case, the exit status of a player could not be read.
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    # These slow imports come after `_die_with_parent`, because the server may exit while they run.
    from talkcli.engine.child.driver import CannotStart, start
    from talkcli.engine.child.players.base import CannotKillPlayer
    from talkcli.engine.child.players.chooser import PlayerChooser
    from talkcli.engine.child.runner import Channel, GoalRunner
    from talkcli.engine.sounds import SoundLibrary

    channel = Channel()
    configure = None
    while configure is None and not channel.closed:
        configure = next(iter(channel.receive()), None)
    # The server may have exited before `_die_with_parent` took effect.
    if not isinstance(configure, protocol.Configure) or os.getppid() != configure.server_pid:
        return
    liveness = int(os.environ[protocol.LIVENESS_VARIABLE])
    os.set_inheritable(liveness, False)  # if the descriptor isn't open, fail now instead of at every sentence
    runner = GoalRunner(channel, PlayerChooser(configure, [liveness]), SoundLibrary(configure.sounds))
    try:
        channel.send(start(configure, runner))
        runner.run(send_voices=configure.list_voices)
    except CannotStart as error:
        channel.send(error.failure)
    except CannotKillPlayer as error:  # the server detects that a player is still running, and starts another process
        sys.stderr.write(f"{error}\n")
    threading = sys.modules.get("threading")
    if threading and threading.active_count() > 1:  # a thread may still be loading a voice or running a model
        sys.stderr.flush()
        os._exit(0)


def _die_with_parent() -> None:
    """Have the kernel kill this process when the thread that started it exits.

    That thread may have exited before this call, so the caller must check the parent's ID afterwards. Only Linux
    supports this. On other systems, the process exits when the server's end of the socket is closed.
    """
    if not sys.platform.startswith("linux"):
        return
    import ctypes

    prctl = ctypes.CDLL(None, use_errno=True).prctl
    if prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG) failed")


def _limit_core_dump() -> None:
    """Limit core dumps to one byte, in case a text crashes the speech library.

    A dump takes longer than a restart, and wears out SD cards. With a limit of 0, the kernel
    would still pipe the core to a program that collects cores.
    """
    _, hard = resource.getrlimit(resource.RLIMIT_CORE)
    resource.setrlimit(resource.RLIMIT_CORE, (1 if hard else 0, hard))


def _limit_memory() -> None:
    """Limit this process to half of the machine's memory, or to 1 GiB if that is more.

    If a voice model needs more, the library reports an error. Without the limit, the machine would stall.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    limit = max(_MIN_MEMORY_BYTES, os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2)
    if soft == resource.RLIM_INFINITY or soft > limit:
        resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))
