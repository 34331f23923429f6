"""The command line. Only this package uses click, and only this package prints or exits.

Scripts often call `say`, `wait`, `cancel` and `status`, and importing click takes longer than a server takes to answer.
So `plain` parses simple command lines of these commands, sends their requests, and imports the rest of the program only
then. Click handles all other lines, all errors in command lines, and all help.
"""

from __future__ import annotations

import os
import sys

from talkcli.frozen import TYPE_CHECKING

if TYPE_CHECKING:
    from typing import NoReturn


def main() -> NoReturn:
    """Run the command line of this process, and exit."""
    try:
        code = _run_plain(sys.argv[1:])
    except KeyboardInterrupt:  # nothing has been started yet
        code = 128 + 2
    if code is None:
        sys.exit(_run_with_click(sys.argv[1:]))
    # All output is written. The interpreter's own cleanup would take an eighth of the command's time.
    os._exit(code)


def run(arguments: list[str]) -> int:
    """Run a command line, and return its exit code."""
    code = _run_plain(arguments)
    return _run_with_click(arguments) if code is None else code


def _run_plain(arguments: list[str]) -> int | None:
    """Run a plain command line, and return its exit code. Return None for any other."""
    _prepare_streams()
    if "_TALK_COMPLETE" in os.environ:
        return None
    from talkcli.cli import plain

    command = plain.read(arguments, os.environ)
    return None if command is None else plain.run(command)


def _run_with_click(arguments: list[str]) -> int:
    from talkcli.cli import click_app

    return click_app.run(arguments)


def _prepare_streams() -> None:
    """Open closed standard streams as /dev/null, and escape characters that the locale can't encode.

    If 0, 1 or 2 stayed closed, a socket or a lock could get this descriptor, and notes would be written to it.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest free descriptor, which is this one
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
