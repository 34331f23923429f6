"""Runs the program that is given to `talk pause --while`."""

from __future__ import annotations

import errno
import signal
import subprocess
from functools import partial

from talkcli.errors import EXIT_SIGNAL, TalkError
from talkcli.frozen import TYPE_CHECKING
from talkcli.terminal.text import printable

if TYPE_CHECKING:
    from collections.abc import Sequence

_FROM_TERMINAL = {signal.SIGINT, signal.SIGQUIT}
_HANDLED_SIGNALS = {*_FROM_TERMINAL, signal.SIGTERM, signal.SIGHUP, signal.SIGCHLD}


def run_program(command: Sequence[str]) -> int:
    """Run a program to its end, and pass signals on to it. Return its exit code, as a shell would.

    Raises TalkError with the exit code 126 or 127 if the program can't be started. After this call, this process no
    longer receives the signals.
    """
    signal.signal(signal.SIGCHLD, lambda *_: None)  # some systems can't wait for an ignored signal
    unblocked = signal.pthread_sigmask(signal.SIG_BLOCK, _HANDLED_SIGNALS)
    unblock = partial(signal.pthread_sigmask, signal.SIG_SETMASK, unblocked)
    try:
        process = subprocess.Popen(command, preexec_fn=unblock)  # noqa: PLW1509 - this process has no threads
    except OSError as error:
        failed = TalkError(f"can't run '{printable(command[0])}': {error.strerror}")
        failed.code, failed.exit_code = "not_started", 127 if error.errno == errno.ENOENT else 126  # as in a shell
        raise failed from None
    while process.poll() is None:
        number, by_system = _wait_for_signal()
        if number != signal.SIGCHLD and not by_system:
            process.send_signal(number)
    return process.returncode if process.returncode >= 0 else EXIT_SIGNAL - process.returncode


def _wait_for_signal() -> tuple[int, bool]:
    """Wait for a signal. Return its number, and whether the system sent it.

    On Ctrl-C, the terminal also sends the signal to the program, so it must not be passed on.
    """
    if not hasattr(signal, "sigwaitinfo"):  # the sender is unknown, as on macOS
        number = signal.sigwait(_HANDLED_SIGNALS)
        return number, number in _FROM_TERMINAL
    received = signal.sigwaitinfo(_HANDLED_SIGNALS)
    return received.si_signo, received.si_code > 0
