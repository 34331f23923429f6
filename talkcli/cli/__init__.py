"""The command line. Only this package knows click, and only here is anything printed or exited.

Scripts call `say`, `wait`, `cancel` and `status` all the time, and importing click takes longer than a server takes to
answer. So a plain command line of these is read, its request sent, and the rest of the program imported only then; any
other line, every error in one and all help are click's.
"""

from __future__ import annotations

import os
import sys

from talkcli.frozen import TYPE_CHECKING

if TYPE_CHECKING:
    from typing import NoReturn


def main() -> NoReturn:
    """Run the command line, and exit."""
    try:
        code = _run_plain(sys.argv[1:])
    except KeyboardInterrupt:  # before there was anything to interrupt
        code = 128 + 2
    if code is None:
        sys.exit(_run_by_click(sys.argv[1:]))
    # All is written. To tidy up what ends with it anyway would take the interpreter an eighth of the command's life.
    os._exit(code)


def run(arguments: list[str]) -> int:
    """Run a command line, and return its exit code."""
    code = _run_plain(arguments)
    return _run_by_click(arguments) if code is None else code


def _run_plain(arguments: list[str]) -> int | None:
    """Run a plain command line, and return its exit code; None where it isn't one."""
    _prepare_streams()
    if "_TALK_COMPLETE" in os.environ:
        return None
    from talkcli.cli.plain import carry_out, read

    plain = read(arguments, os.environ)
    return None if plain is None else carry_out(plain)


def _run_by_click(arguments: list[str]) -> int:
    from talkcli.cli.click_app import run as run_by_click

    return run_by_click(arguments)


def _prepare_streams() -> None:
    """Open /dev/null where 0, 1 or 2 is closed: a socket or a lock must not end up as standard error.

    What the locale can't encode is shown escaped.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest that is free: this one
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
