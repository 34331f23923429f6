"""The `talk` command line.

Only this package uses click, prints to the terminal or exits the process.

Scripts often call `say`, `wait`, `cancel` and `status`, and importing click takes longer than the server takes to
answer. So `plain` parses simple command lines. If it can, it sends the request first, and imports the rest of the
program afterwards. Click handles all other command lines, all errors and all help.
"""

from __future__ import annotations

import _signal
import os
import sys

from talkcli.frozen import TYPE_CHECKING

if TYPE_CHECKING:
    from typing import NoReturn


def main() -> NoReturn:
    """Run the command line in `sys.argv`, and exit with its exit code."""
    try:
        code = run(sys.argv[1:])
    except KeyboardInterrupt:  # no command has been started yet
        code = 128 + 2
    # All output has been written. Skip the interpreter's cleanup, which would take an eighth of the command's run time.
    os._exit(code)


def run(arguments: list[str]) -> int:
    """Run a command line. Return its exit code."""
    _prepare_streams()
    # The parent process may have left SIGCHLD ignored. The exit statuses of child processes would then be lost.
    _signal.signal(_signal.SIGCHLD, _signal.SIG_DFL)
    if "_TALK_COMPLETE" not in os.environ:
        from talkcli.cli import plain

        command = plain.read(arguments, os.environ)
        if command is not None:
            return plain.run(command)
    from talkcli.cli import click_app

    return click_app.run(arguments)


def _prepare_streams() -> None:
    """Open closed standard streams as /dev/null, and escape characters that the locale can't encode.

    If file descriptor 0, 1 or 2 stayed closed, the next socket or lock file would get its number, and messages would be
    written to it.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # `open` returns the lowest free descriptor, which is the closed one
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
