"""Runs programs of others, each with a limit of time and of output: one that is missing or hangs is an answer, too."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import tempfile
from typing import TYPE_CHECKING

from talkcli.frozen import frozen

if TYPE_CHECKING:
    from collections.abc import Mapping

#: Seconds that a program may take. All of them answer within milliseconds, or wait for a sound server that hangs.
LIMIT = 3.0
#: Bytes of its output that are read: the devices of a large machine take a tenth.
_MOST = 64 * 1024


@frozen
class Said:
    """What a program said."""

    #: its exit status; None where it is not there, cannot be run, or took too long
    code: int | None
    out: str = ""
    err: str = ""
    #: whether it took too long
    late: bool = False

    @property
    def well(self) -> bool:
        return self.code == 0

    @property
    def complaint(self) -> str:
        """The line that says why it failed: the first one that it wrote to standard error."""
        lines = [line.strip() for line in (self.err or self.out).splitlines() if line.strip()]
        return lines[0] if lines else "it said nothing"


def path_of(program: str, env: Mapping[str, str]) -> str | None:
    """Return where a program is on the PATH of an environment; None where it is not."""
    return shutil.which(program, path=env.get("PATH", os.defpath))


def said(program: str, *words: str, env: Mapping[str, str]) -> Said:
    """Run a program to its end, in its own language, and return what it said."""
    path = path_of(program, env)
    if path is None:
        return Said(None)
    # Files, not pipes: what a program leaves running behind it would hold a pipe open.
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        try:
            process = subprocess.Popen(
                [path, *words],
                env={**env, "LC_ALL": "C"},
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=err,
                start_new_session=True,
            )
        except OSError as error:
            return Said(None, err=str(error))
        try:
            code = process.wait(LIMIT)
        except subprocess.TimeoutExpired:
            code = None
        finally:
            _end(process)
        return Said(code, _read(out.fileno()), _read(err.fileno()), late=code is None)


def _end(process: subprocess.Popen[bytes]) -> None:
    if process.returncode is None:
        # Its group is its own, and it is not reaped: nobody else can be hit.
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
        with contextlib.suppress(subprocess.TimeoutExpired):  # it hangs in a driver: init will reap it
            process.wait(1)


def _read(descriptor: int) -> str:
    return os.pread(descriptor, _MOST, 0).decode("utf-8", "replace")
