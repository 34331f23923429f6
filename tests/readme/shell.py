"""A shell for the examples, with `talk` on its PATH, and stand-ins for programs that tests must not run.

A stand-in records its arguments. The stand-in for ssh joins the arguments and passes them to a shell, as ssh does, so
quoting mistakes are found.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from typing import TYPE_CHECKING

from tests.support.connection import PATIENCE

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from tests.support.processes import Talk

#: Time limit for an example.
LIMIT = 30.0

_SSH = """
forward=
while getopts nfNo:L: option; do
    case $option in
        L) forward=$OPTARG ;;
        *) ;;
    esac
done
shift $((OPTIND - 1))
shift  # the host
if [ -n "$forward" ]; then
    exec ln -s "${forward#*:}" "${forward%%:*}"
fi
exec sh -c "$*"
"""

#: A replacement for jq that knows the filters of the examples.
_JQ = """
import json, sys
wanted = sys.argv[-1]
for each in map(json.loads, sys.stdin):
    if wanted.startswith("select(.event == "):
        kind = wanted.split('"')[1]
        if each["event"] == kind:
            print(each[kind], flush=True)
    elif wanted == ".server.socket":
        print(each["server"]["socket"])
    elif not wanted.startswith("select("):
        for goal in each["recent"]:
            print(goal["state"], goal["client"]["parent"], goal["text"])
    elif each["exit_code"]:
        print(each["robot"], each["error"]["message"])
"""


class Shell:
    """Runs examples in a directory. `close()` kills running ones."""

    def __init__(self, directory: Path, env: Mapping[str, str], *, talk: bool = True) -> None:
        """If `talk` is true, put the `talk` of this checkout on the PATH."""
        self.directory = directory
        self._bin = directory / "bin"
        self._bin.mkdir()
        self.env = {**env, "PATH": f"{self._bin}:{os.environ['PATH']}", "HOME": str(directory)}
        self._running: list[subprocess.Popen[str]] = []
        if talk:
            self.program("talk", f'exec {sys.executable} -m talkcli "$@"')
        if shutil.which("jq") is None:
            self._python("jq", _JQ)

    def program(self, name: str, script: str, directory: Path | None = None) -> None:
        """Create a program on the PATH or in another directory."""
        path = (directory or self._bin) / name
        path.write_text(f"#!/bin/sh\n{script}\n", encoding="utf-8")
        path.chmod(0o755)

    def stand_in(self, name: str, then: str = "exit 0", directory: Path | None = None) -> None:
        """Create a program that records its arguments, and then runs a script."""
        calls = self.directory / f"{name}.calls"
        self.program(name, f"{{ printf '%s\\037' \"$@\"; echo; }} >> {calls}\n{then}", directory)

    def ssh(self) -> None:
        """Create an `ssh` that runs the command on this machine."""
        self.stand_in("ssh", _SSH)

    def calls(self, name: str) -> list[list[str]]:
        """Return the arguments of each call of a stand-in."""
        path = self.directory / f"{name}.calls"
        lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        return [line.split("\037")[:-1] for line in lines]

    def run(self, script: str, *arguments: str, limit: float = LIMIT, **env: str) -> subprocess.CompletedProcess[str]:
        """Run a script, which must end within `limit` seconds."""
        process = self.start(script, *arguments, **env)
        # Until the process is reaped, its id is valid for its group, so its remaining children can be killed.
        wait_until(lambda: os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is not None, limit)
        os.killpg(process.pid, signal.SIGKILL)
        out, err = process.communicate(timeout=LIMIT)
        assert "Traceback" not in err, err
        return subprocess.CompletedProcess(script, process.returncode, out, err)

    def start(self, script: str, *arguments: str, **env: str) -> subprocess.Popen[str]:
        """Start a script in a new session."""
        process = subprocess.Popen(
            ["sh", "-c", script, "sh", *arguments],
            env={**self.env, **env},
            cwd=self.directory,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        self._running.append(process)
        return process

    def wait_for_call(self, name: str, count: int) -> list[list[str]]:
        """Wait until a stand-in was called `count` times, and return the calls."""
        wait_until(lambda: len(self.calls(name)) >= count)
        return self.calls(name)

    def close(self) -> None:
        for process in self._running:
            if process.returncode is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.communicate()

    def _python(self, name: str, code: str) -> None:
        path = self.directory / f"{name}.py"
        path.write_text(code, encoding="utf-8")
        self.program(name, f'exec {sys.executable} -u {path} "$@"')


def wait_until(condition: Callable[[], bool], seconds: float = PATIENCE) -> None:
    """Poll a condition until it holds."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"the condition did not hold within {seconds} s"
        time.sleep(0.02)


def wait_for_watcher(talk: Talk) -> None:
    """Wait until a client other than the test's own watcher is connected."""
    with talk.connect() as wire:  # one connection, because a closing one would count
        wait_until(lambda: wire.request("status")["server"]["clients"] > 2)
