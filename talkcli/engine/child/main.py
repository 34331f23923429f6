"""The engine process: what the server starts, in a session of its own, to speak through pyttsx3.

Standard input is the socket to the server, both directions. It holds no state that outlives it, so the server may kill
it at any moment; and it must be gone, with its player, when the server is.
"""

from __future__ import annotations

import os
import resource
import signal
import sys

from talkcli.engine import protocol

TYPE_CHECKING = False
if TYPE_CHECKING:
    from talkcli.engine.child.session import Channel

#: Bytes that the process may have at least, whatever the machine has: one with a voice of 63 MB has 0.4 billion.
_LEAST_MEMORY = 1 << 30
#: Linux's: have this process killed when the thread that started it is gone. For what it starts, see `players.child`.
_PR_SET_PDEATHSIG = 1


def main() -> None:
    """Run the engine process to its end."""
    _die_with_parent()
    _leave_no_core()
    _spare_machine()
    # Ctrl-C in the server's terminal and the terminal's end are the server's business. A server or a player that stops
    # reading is seen by the write that fails.
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGPIPE):
        signal.signal(number, signal.SIG_IGN)
    # Who started the server may ignore it, and every player would seem to have ended well then: nothing to reap.
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    from talkcli.engine.child.session import Channel

    channel = Channel()
    configure = _configuration(channel)
    # The server may have died before the kernel was asked to tell.
    if configure is None or os.getppid() != configure.server:
        return
    _serve(channel, configure)
    threading = sys.modules.get("threading")
    if threading and threading.active_count() > 1:  # a voice is being loaded, or a model runs: nobody waits for that
        sys.stderr.flush()
        os._exit(0)


def _die_with_parent() -> None:
    """Have the kernel kill this process as soon as its parent's starting thread ends; afterwards, see who that is.

    Linux alone can do that; elsewhere the end of the socket to the server has to do.
    """
    if not sys.platform.startswith("linux"):
        return
    import ctypes

    prctl = ctypes.CDLL(None, use_errno=True).prctl
    if prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG) failed")


def _leave_no_core() -> None:
    """Have no core written when a text crashes the library: it takes longer than the next start, and wears SD cards.

    One byte, not none: a limit of 0 would still be piped to a program that collects them.
    """
    _, hard = resource.getrlimit(resource.RLIMIT_CORE)
    resource.setrlimit(resource.RLIMIT_CORE, (1 if hard else 0, hard))


def _spare_machine() -> None:
    """Have what needs most of the machine's memory fail, as a voice's model can ask for any amount.

    What a library can't have it says; without a limit the machine would stand still, and end whatever it chooses.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    most = max(_LEAST_MEMORY, os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2)
    if soft == resource.RLIM_INFINITY or soft > most:
        resource.setrlimit(resource.RLIMIT_DATA, (most, hard))


def _configuration(channel: Channel) -> protocol.Configure | None:
    """Wait for the first command; None if the server is gone, or says something else."""
    while not channel.closed:
        for command in channel.receive():
            return command if isinstance(command, protocol.Configure) else None
    return None


def _serve(channel: Channel, configure: protocol.Configure) -> None:
    from talkcli.engine.child.driver import CannotStart, start
    from talkcli.engine.child.players.base import CannotEnd
    from talkcli.engine.child.players.chooser import PlayerChooser
    from talkcli.engine.child.session import Session

    session = Session(channel, PlayerChooser(configure, _inherited()))
    try:
        channel.send(start(configure, session))
    except CannotStart as error:
        channel.send(error.failed)
        return
    try:
        session.run(configure.list_voices)
    except CannotEnd as error:  # the server sees that something is left, and speaks on with another process
        sys.stderr.write(f"{error}\n")


def _inherited() -> list[int]:
    """Return the descriptors that a player must inherit; none when the process was started by hand."""
    value = os.environ.get(protocol.LIVENESS_VARIABLE)
    if value is None:
        return []
    descriptor = int(value)
    os.fstat(descriptor)  # one that is not open would fail every sentence: better to fail now
    os.set_inheritable(descriptor, False)
    return [descriptor]
