"""Requirements of tests, and private directories, clean environments and leftover checks for their programs."""

from __future__ import annotations

import contextlib
import glob
import os
import shutil
import signal
import site
import socket
import sys
import tempfile
import time
from importlib.util import find_spec
from typing import TYPE_CHECKING, NoReturn

import pytest

import talkcli
from talkcli import paths

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

#: Length limit for the temporary directory, because the path of a Unix socket can have at most 107 bytes.
_TEMPORARY_PATH_BYTES = 50
#: The environment variable that marks a test's processes, so that leftovers are found even without their parent.
MARK = "TALK_TEST_ID"
#: The variables that children inherit. The user's audio, runtime directory and settings aren't inherited.
_INHERITED = ("PATH", "TMPDIR", "SYSTEMROOT", "LD_LIBRARY_PATH", "COVERAGE_PROCESS_START")
#: Directories of system programs.
_SYSTEM_PATH = "/usr/local/sbin:/usr/sbin:/sbin"
#: Time limit until a killed process has disappeared.
_KILL_LIMIT = 2.0


def needs(*programs: str) -> None:
    """Skip the test if a program is missing. In CI, fail it."""
    _skip_without([name for name in programs if find_program(name) is None])


def find_program(name: str) -> str | None:
    """Return the path of a program. Also search system directories, where Debian installs mosquitto."""
    return shutil.which(name) or shutil.which(name, path=_SYSTEM_PATH)


def needs_packages(*names: str) -> None:
    """Skip the test if a Python package (by its name for `import`) is missing. In CI, fail it."""
    _skip_without([name for name in names if find_spec(name) is None])


def needs_no_server() -> None:
    """Skip the test if clients would find a server or its old socket on this machine. In CI, fail it.

    Otherwise, clients without a socket option would make that server speak the texts of the test aloud.
    """
    for path in [*paths.client_sockets(None), *glob.glob(f"/run/user/*/talk/{paths.SOCKET_NAME}")]:
        with socket.socket(socket.AF_UNIX) as probe:
            probe.settimeout(1)
            try:
                probe.connect(path)
                state = "a server runs"
            except OSError as error:
                state = paths.connect_failure(path, error)
        if state != paths.PLACE_ABSENT:
            _skip(f"needs a machine on which no talk server runs; {path}: {state}")


def _skip_without(missing: list[str]) -> None:
    if missing:
        _skip(f"needs {', '.join(missing)}, which is not installed")


def _skip(reason: str) -> NoReturn:
    if os.environ.get("CI"):
        pytest.fail(reason, pytrace=False)
    pytest.skip(reason)


@contextlib.contextmanager
def short_directory(prefix: str = "talk-") -> Iterator[str]:
    """Yield a private directory with a path short enough for sockets, and remove it at the end."""
    base = tempfile.gettempdir()
    if len(os.fsencode(base)) > _TEMPORARY_PATH_BYTES:
        base = "/tmp"
    path = os.path.realpath(tempfile.mkdtemp(prefix=prefix, dir=base))
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)


def clean_environment(home: str, extra: Mapping[str, str] | None = None) -> dict[str, str]:
    """Return an environment for a child, with UTF-8 and this checkout's talkcli, but not the user's sound server."""
    result = {name: os.environ[name] for name in _INHERITED if name in os.environ}
    result |= {
        "HOME": home,
        "LANG": "C.UTF-8",
        "PULSE_SERVER": f"unix:{home}/no-sound-server",
        "PULSE_RUNTIME_PATH": home,
        "PIPEWIRE_RUNTIME_DIR": home,
    }
    root = os.path.dirname(os.path.dirname(os.path.abspath(talkcli.__file__)))
    if root not in site.getsitepackages():
        result["PYTHONPATH"] = root
    return result | dict(extra or {})


def dying_with_parent(command: list[str]) -> list[str]:
    """Return the command changed so that the process is killed when the thread that started it ends."""
    if sys.platform != "linux":
        return command
    needs("setpriv")
    return [shutil.which("setpriv") or "setpriv", "--pdeathsig", "KILL", "--", *command]


def stop_child(pid: int) -> None:
    """Stop a child of this process (SIGSTOP), and wait until it has stopped or ended."""
    os.kill(pid, signal.SIGSTOP)
    os.waitid(os.P_PID, pid, os.WSTOPPED | os.WEXITED | os.WNOWAIT)


def find_marked(mark: str) -> list[int]:
    """Return the ids of the running processes with this mark (none without /proc)."""
    variable = f"{MARK}={mark}".encode()
    pids = []
    for name in os.listdir("/proc") if os.path.isdir("/proc") else []:
        if not name.isdigit():
            continue
        try:
            with open(f"/proc/{name}/environ", "rb") as environ:
                if variable in environ.read().split(b"\0"):
                    pids.append(int(name))
        except OSError:  # has ended, or belongs to another user
            continue
    return pids


def command_line(pid: int) -> str:
    """Return the command line of a process for messages."""
    try:
        with open(f"/proc/{pid}/cmdline", "rb") as file:
            return file.read().replace(b"\0", b" ").decode(errors="replace").strip()
    except OSError:
        return "ended"


def assert_none_left(mark: str, within: float) -> None:
    """Assert that all processes with this mark end within `within` seconds. Kill those that don't."""
    remaining = _wait_for_end(mark, within)
    if not remaining:
        return
    lines = [f"{pid}: {command_line(pid)}" for pid in remaining]
    for pid in remaining:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    lines += [f"{pid}: cannot be killed" for pid in _wait_for_end(mark, _KILL_LIMIT)]
    raise AssertionError("still running:\n" + "\n".join(lines))


def _wait_for_end(mark: str, within: float) -> list[int]:
    """Return the processes that have not ended in time."""
    end = time.monotonic() + within
    while (remaining := find_marked(mark)) and time.monotonic() < end:
        time.sleep(0.01)  # only children report their end
    return remaining
