"""A shell for the README's examples: `talk` is a program in it, and what a test must not touch has a stand-in.

A stand-in writes down what it was called with. ssh's does what ssh does to a command: it joins the words with blanks
and gives them to a shell, so that a mistake in quoting shows.
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

#: Longest time for one example.
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
    PYTHON RELAY "${forward%%:*}" "${forward#*:}" < /dev/null > /dev/null 2>&1 &
    until [ -S "${forward%%:*}" ]; do sleep 0.02; done
    exit
fi
exec sh -c "$*"
"""

#: What ssh -L does, for one user and one machine.
_RELAY = """
import asyncio, sys

async def pump(reader, writer):
    while data := await reader.read(65536):
        writer.write(data)
        await writer.drain()
    writer.close()

async def accept(reader, writer):
    far_reader, far_writer = await asyncio.open_unix_connection(sys.argv[2])
    await asyncio.gather(pump(reader, far_writer), pump(far_reader, writer), return_exceptions=True)

async def main():
    async with await asyncio.start_unix_server(accept, sys.argv[1]) as server:
        await server.serve_forever()

asyncio.run(main())
"""

#: The filters of the README, for a machine that has no jq.
_JQ = """
import json, sys
wanted = sys.argv[-1]
for line in sys.stdin:
    each = json.loads(line)
    if wanted == 'select(.event == "state").state' and each["event"] == "state":
        print(each["state"], flush=True)
    elif wanted == 'select(.event == "word").word' and each["event"] == "word":
        print(each["word"], flush=True)
    elif wanted == ".server.socket":
        print(each["server"]["socket"])
    elif wanted.startswith("select(.exit_code != 0)"):
        if each["exit_code"]:
            print(each["robot"], each["error"]["message"])
    elif wanted.startswith(".recent[]"):
        for goal in each["recent"]:
            print(goal["state"], goal["client"]["parent"], goal["text"])
"""


class Shell:
    """Runs examples in a directory of their own; `close()` ends what still runs."""

    def __init__(self, directory: Path, env: Mapping[str, str], *, talk: bool = True) -> None:
        """With `talk` this checkout's is on the PATH."""
        self.directory = directory
        self._bin = directory / "bin"
        self._bin.mkdir()
        self.env = {**env, "PATH": f"{self._bin}:{os.environ['PATH']}", "HOME": str(directory)}
        self._running: list[subprocess.Popen[str]] = []
        if talk:
            self.program("talk", f'exec {sys.executable} -m talkcli "$@"')
        if shutil.which("jq") is None:
            self._python("jq", _JQ)

    def program(self, name: str, script: str, where: Path | None = None) -> None:
        """Put a program on the PATH, or elsewhere."""
        path = (where or self._bin) / name
        path.write_text(f"#!/bin/sh\n{script}\n", encoding="utf-8")
        path.chmod(0o755)

    def stand_in(self, name: str, then: str = "exit 0", where: Path | None = None) -> None:
        """Put a program on the PATH that writes down its arguments, and then does something else."""
        calls = self.directory / f"{name}.calls"
        self.program(name, f"{{ printf '%s\\037' \"$@\"; echo; }} >> {calls}\n{then}", where)

    def ssh(self) -> None:
        """Put an ssh on the PATH that runs the command here."""
        relay = self.directory / "relay.py"
        relay.write_text(_RELAY, encoding="utf-8")
        self.stand_in("ssh", _SSH.replace("PYTHON", sys.executable).replace("RELAY", str(relay)))

    def calls(self, name: str) -> list[list[str]]:
        """Return the arguments of each call of a stand-in."""
        path = self.directory / f"{name}.calls"
        lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        return [each.split("\037")[:-1] for each in lines]

    def run(self, script: str, *arguments: str, limit: float = LIMIT, **env: str) -> subprocess.CompletedProcess[str]:
        """Run a script to its end, which must come within `limit` seconds."""
        began = self.start(script, *arguments, **env)
        # Its number stays its group's until it is reaped, so what it leaves behind can be ended by that.
        wait_until(lambda: os.waitid(os.P_PID, began.pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is not None, limit)
        os.killpg(began.pid, signal.SIGKILL)
        out, err = began.communicate(timeout=LIMIT)
        assert "Traceback" not in err, err
        return subprocess.CompletedProcess(script, began.returncode, out, err)

    def start(self, script: str, *arguments: str, **env: str) -> subprocess.Popen[str]:
        """Start a script in a session of its own."""
        began = subprocess.Popen(
            ["sh", "-c", script, "sh", *arguments],
            env={**self.env, **env},
            cwd=self.directory,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        self._running.append(began)
        return began

    def wait_for_call(self, name: str, count: int) -> list[list[str]]:
        """Wait until a stand-in was called so many times; return the calls."""
        wait_until(lambda: len(self.calls(name)) >= count)
        return self.calls(name)

    def close(self) -> None:
        for each in self._running:
            if each.returncode is None:
                os.killpg(each.pid, signal.SIGKILL)
                each.communicate()

    def _python(self, name: str, code: str) -> None:
        path = self.directory / f"{name}.py"
        path.write_text(code, encoding="utf-8")
        self.program(name, f'exec {sys.executable} -u {path} "$@"')


def wait_until(true: Callable[[], bool], seconds: float = PATIENCE) -> None:
    """Wait for what no event tells: a file that a program writes, a program's end."""
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.02)


def wait_for_watcher(talk: Talk) -> None:
    """Wait until somebody watches beside the test's own watcher."""
    with talk.connect() as wire:  # one connection, so that none that is just closing is counted
        wait_until(lambda: wire.request("status")["server"]["clients"] > 2)
