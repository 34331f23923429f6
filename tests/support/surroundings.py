"""The surroundings of the programs that tests start: short private directories, clean environments, no leftovers."""

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

#: The longest path of a temporary directory in bytes that leaves room for a Unix socket's, which has at most 107.
_LONGEST_TEMPORARY = 50
#: The variable that marks a test's processes, so that leftovers are found whichever process is their parent now.
MARK = "TALK_TEST_ID"
#: The variables that a child inherits; the user's audio, runtime directory and settings stay out.
_KEPT = ("PATH", "TMPDIR", "SYSTEMROOT", "LD_LIBRARY_PATH", "COVERAGE_PROCESS_START")
#: Directories of programs that serve a whole machine.
_SYSTEM = "/usr/local/sbin:/usr/sbin:/sbin"
#: Seconds in which a killed process must be gone.
_KILL_LIMIT = 2.0


def needs(*programs: str) -> None:
    """Skip the test if a program is missing; in CI, where nothing may be skipped, fail it."""
    _skip_without([each for each in programs if find_program(each) is None])


def find_program(name: str) -> str | None:
    """Return the path of a program, also if a user's PATH lacks its directory, as for Debian's mosquitto."""
    return shutil.which(name) or shutil.which(name, path=_SYSTEM)


def needs_packages(*names: str) -> None:
    """Skip the test if a Python package is missing, by its name for `import`; in CI, fail it."""
    _skip_without([each for each in names if find_spec(each) is None])


def needs_no_server() -> None:
    """Skip the test if there is or was a server at a place where clients look; in CI, fail it.

    A client that names no socket would have that server say the texts of the test aloud.
    """
    for place in [*paths.client_sockets(None), *glob.glob(f"/run/user/*/talk/{paths.SOCKET_NAME}")]:
        with socket.socket(socket.AF_UNIX) as probe:
            probe.settimeout(1)
            try:
                probe.connect(place)
                found = "there is one"
            except OSError as error:
                found = paths.describe_place(place, error)
        if found != paths.PLACE_ABSENT:
            _skip(f"needs a machine on which no talk server runs; {place}: {found}")


def _skip_without(missing: list[str]) -> None:
    if missing:
        _skip(f"needs {', '.join(missing)}, which is not installed")


def _skip(reason: str) -> NoReturn:
    if os.environ.get("CI"):
        pytest.fail(reason, pytrace=False)
    pytest.skip(reason)


@contextlib.contextmanager
def short_directory(prefix: str = "talk-") -> Iterator[str]:
    """Give a private directory with a path short enough for sockets, removed at the end."""
    base = tempfile.gettempdir()
    if len(os.fsencode(base)) > _LONGEST_TEMPORARY:
        base = "/tmp"
    path = os.path.realpath(tempfile.mkdtemp(prefix=prefix, dir=base))
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)


def clean_environment(home: str, extra: Mapping[str, str] | None = None) -> dict[str, str]:
    """Return an environment for a child: its home, UTF-8, this checkout's talkcli, no user's sound server, `extra`."""
    result = {name: os.environ[name] for name in _KEPT if name in os.environ}
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
    """Return the command so that it is killed with the thread that starts it, as a killed test leaves nothing."""
    if sys.platform != "linux":
        return command
    needs("setpriv")
    return [shutil.which("setpriv") or "setpriv", "--pdeathsig", "KILL", "--", *command]


def stop_child(pid: int) -> None:
    """Stop a child of this process (SIGSTOP); it has stopped or ended when this returns."""
    os.kill(pid, signal.SIGSTOP)
    os.waitid(os.P_PID, pid, os.WSTOPPED | os.WEXITED | os.WNOWAIT)


def find_marked(mark: str) -> list[int]:
    """Return the ids of the living processes whose environment has this mark (none without /proc)."""
    wanted = f"{MARK}={mark}".encode()
    found = []
    for name in os.listdir("/proc") if os.path.isdir("/proc") else []:
        if not name.isdigit():
            continue
        try:
            with open(f"/proc/{name}/environ", "rb") as environ:
                if wanted in environ.read().split(b"\0"):
                    found.append(int(name))
        except OSError:  # ended meanwhile, or another user's
            continue
    return found


def command_line(pid: int) -> str:
    """Return the command line of a process, for messages."""
    try:
        with open(f"/proc/{pid}/cmdline", "rb") as file:
            return file.read().replace(b"\0", b" ").decode(errors="replace").strip()
    except OSError:
        return "ended"


def assert_none_left(mark: str, within: float) -> None:
    """Assert that all processes with this mark end within some seconds; the others are killed."""
    left = _left(mark, within)
    if not left:
        return
    lines = [f"{pid}: {command_line(pid)}" for pid in left]
    for pid in left:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    lines += [f"{pid}: cannot be killed" for pid in _left(mark, _KILL_LIMIT)]
    raise AssertionError("left running:\n" + "\n".join(lines))


def _left(mark: str, within: float) -> list[int]:
    end = time.monotonic() + within
    while (left := find_marked(mark)) and time.monotonic() < end:
        time.sleep(0.01)  # only a child's end is an event
    return left
