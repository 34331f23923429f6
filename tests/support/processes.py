"""A server process for a test, and the client processes that use it."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
import uuid
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from tests.support.connection import PATIENCE, Message, Wire
from tests.support.forking import Forked, can_fork
from tests.support.resources import Resource
from tests.support.surroundings import MARK, assert_none_left, clean_environment, dying_with_parent, short_directory
from tests.support.watcher import Watcher

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from tests.support.recording import Recording
    from tests.support.sink import Sink

#: Time limits until a server sends its greeting, and until it has ended after SIGTERM.
START_LIMIT = 10.0
STOP_LIMIT = 5.0
#: A client or server process.
Process = subprocess.Popen[str] | Forked
#: The program that runs `talk serve` with the scripted engine.
SCRIPTED = os.path.join(os.path.dirname(os.path.abspath(__file__)), "scripted_serve.py")


@dataclass(frozen=True, slots=True)
class Finished:
    """A client that has ended."""

    command: tuple[str, ...]
    code: int  # exit code, or the negative number of the signal that killed it
    out: str
    err: str
    seconds: float  # from its start to its end

    @property
    def id(self) -> str:
        """The goal's id, if the client printed nothing else."""
        return self.out.strip()


def children(pid: int) -> list[int]:
    """Return the children of a process, started by any of its threads."""
    while True:
        pids: list[int] = []
        threads = os.listdir(f"/proc/{pid}/task")
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            for thread in threads:
                with open(f"/proc/{pid}/task/{thread}/children", encoding="ascii") as file:
                    pids += map(int, file.read().split())
        # If a thread has ended meanwhile, its children belong to another thread, which may have been read already.
        if set(threads) <= set(os.listdir(f"/proc/{pid}/task")):
            return pids


def start_talk(arguments: Sequence[str], env: Mapping[str, str], stdin: int = subprocess.DEVNULL) -> Process:
    """Start `talk` with these arguments, and with pipes for its output."""
    if can_fork(env):
        return Forked(arguments, env, stdin=stdin, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    return subprocess.Popen(
        [sys.executable, "-m", "talkcli", *arguments],
        env=env,
        stdin=stdin,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        encoding="utf-8",
        errors="replace",
    )


def run_talk(arguments: Sequence[str], env: Mapping[str, str], timeout: float) -> tuple[int, str, str]:
    """Run `talk`, and return its exit code and output. Kill it after the timeout."""
    process = start_talk(arguments, env)
    try:
        out, err = process.communicate(timeout=timeout)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        raise
    return process.wait(), out, err


class Clients:
    """Runs clients in the environment `env`. If a client fails, `log` is added to the message."""

    def __init__(self) -> None:
        self._clients: list[Process] = []

    @property
    def env(self) -> dict[str, str]:
        raise NotImplementedError

    @property
    def log(self) -> str:
        raise NotImplementedError

    def start(self, *arguments: str, stdin: int = subprocess.DEVNULL) -> Process:
        """Start a client in the background, with pipes for its output. `finish()` waits for it."""
        client = start_talk(arguments, self.env, stdin)
        self._clients.append(client)
        return client

    def finish(self, client: Process, timeout: float = 20, stdin: str | None = None) -> Finished:
        """Wait for a client to end without a traceback. `Finished.seconds` counts from this call."""
        started_at = time.monotonic()
        assert isinstance(client.args, list)
        command = tuple(map(str, client.args[2:]))
        try:
            out, err = client.communicate(stdin, timeout=timeout)
        except subprocess.TimeoutExpired:
            client.kill()
            out, err = client.communicate()
            raise AssertionError(
                f"{' '.join(command)} did not end within {timeout} s\nout: {out}\nerr: {err}\nlog: {self.log}"
            ) from None
        result = Finished(command, client.wait(), out, err, time.monotonic() - started_at)
        assert "Traceback" not in err, f"{' '.join(command)}: {err}"
        return result

    def run(self, *arguments: str, timeout: float = 20, stdin: str | None = None) -> Finished:
        """Run a client until it ends: `talk.run("say", "--wait", "--", "battery low")`."""
        started_at = time.monotonic()
        client = self.start(*arguments, stdin=subprocess.DEVNULL if stdin is None else subprocess.PIPE)
        return replace(self.finish(client, timeout, stdin), seconds=time.monotonic() - started_at)

    def _end_clients(self) -> None:
        for client in self._clients:
            if client.poll() is None:
                client.kill()
            client.wait()
            for pipe in (client.stdin, client.stdout, client.stderr):
                if pipe:
                    with contextlib.suppress(BrokenPipeError):
                        pipe.close()


class Talk(Resource, Clients):
    """A server that is ready, with a watcher that sees all its goals. `stop()` ends it and checks everything.

    `unfinished` contains the goals that may have no terminal event at the end. True means all goals.
    """

    def __init__(
        self,
        options: Sequence[str] = (),
        *,
        scripted: bool = False,
        program: str | None = None,
        sink: Sink | None = None,
        driver: str | None = None,
        env: Mapping[str, str] | None = None,
        watched: bool = True,
        forked: bool = True,
    ) -> None:
        """Start the server. It may be forked, and `program` is a Python program to run instead of `talk serve`."""
        super().__init__()
        self.unfinished: Collection[str] | bool = False
        self._mark = uuid.uuid4().hex
        self._server: subprocess.Popen[bytes] | Forked | None = None
        self._watcher: Watcher | None = None
        self._recording: Recording | None = None
        self._extra = dict(env or {})
        self._sink = sink
        self._watched = watched
        self._program = SCRIPTED if scripted else program
        self._forked = forked and program is None
        self._arguments = [*(["--driver", driver] if driver else []), *options]
        with contextlib.ExitStack() as stack:
            self.directory = stack.enter_context(short_directory())
            if sink:
                self._recording = stack.enter_context(sink.record())
            stack.callback(self._end)
            self.socket = self._extra.get("TALK_SOCKET") or f"{self.directory}/s"
            self.start_server()
            self._stack = stack.pop_all()

    @property
    def pid(self) -> int:
        """The server's process id, also after its end."""
        assert self._server
        return self._server.pid

    @property
    def env(self) -> dict[str, str]:
        return self._environment(f"{self._mark}-client")

    @property
    def running(self) -> bool:
        return self._server is not None and self._server.poll() is None

    @property
    def recording(self) -> Recording:
        """The sound that the sink has played since the start of the server."""
        assert self._recording, "this server has no sink"
        return self._recording

    @property
    def watcher(self) -> Watcher:
        assert self._watcher, "this server is not watched"
        return self._watcher

    def start_server(self) -> None:
        """Start or restart the server with a new watcher, and wait for its greeting.

        The scripted engine is then ready. The real engine may still be starting.
        """
        env = self._environment(self._mark)
        with open(f"{self.directory}/log", "ab") as log:
            if self._forked and can_fork(env):
                arguments, scripted, output = ["serve", *self._arguments], self._program == SCRIPTED, log.fileno()
                streams = {"stdout": output, "stderr": output}
                self._server = Forked(arguments, env, scripted=scripted, **streams, start_new_session=True)
            else:
                program = [self._program] if self._program else ["-m", "talkcli", "serve"]
                self._server = subprocess.Popen(
                    dying_with_parent([sys.executable, *program, *self._arguments]),
                    env=env,
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    start_new_session=True,
                )
        self._await_greeting()
        if self._watcher:
            self._watcher.close()
            self.unfinished = False
        self._watcher = Watcher(self.socket) if self._watched else None
        if self._program == SCRIPTED and "SCRIPTED_START" not in self._extra:
            self.request("voices")  # waits for the engine, so that the first goal becomes ACTIVE at once

    def script_start(self, behaviour: str) -> None:
        """Set the behaviour of the scripted engine's next starts (see `script`). "" is a normal start."""
        with open(f"{self.directory}/start", "w", encoding="utf-8") as file:
            file.write(behaviour)

    def connect(self) -> Wire:
        return Wire(self.socket)

    def request(self, request: str, /, timeout: float = PATIENCE, **fields: object) -> Message:
        """Send one request on a new connection, and return the reply."""
        with self.connect() as wire:
            return wire.request(request, timeout=timeout, **fields)

    def goal(self, goal_id: str) -> Message:
        reply = self.request("status", id=goal_id)
        assert reply["ok"], reply
        goal: Message = reply["goal"]
        return goal

    def freeze(self) -> None:
        """Stop the server's process (SIGSTOP)."""
        os.kill(self.pid, signal.SIGSTOP)

    def thaw(self) -> None:
        """Continue the server's process (SIGCONT)."""
        os.kill(self.pid, signal.SIGCONT)

    def kill(self) -> float:
        """Kill the server, so that its goals get no end. Return the seconds until all its processes have ended."""
        assert self._server
        killed_at = time.monotonic()
        self._server.kill()
        self._server.wait()
        self.unfinished = True
        assert_none_left(self._mark, 2.0)
        seconds = time.monotonic() - killed_at
        self.check()
        return seconds

    def stop(self, *, timeout: float = STOP_LIMIT, gone_within: float = 2.0) -> None:
        """End the server with SIGTERM. Assert exit code 0, no socket, no process, and one end for each goal."""
        assert self._server
        if self.running:
            self._server.send_signal(signal.SIGCONT)
            self._server.send_signal(signal.SIGTERM)
        try:
            code = self._server.wait(timeout)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"the server did not end within {timeout} s of SIGTERM: {self.log}") from None
        assert code == 0, f"the server ended with {code}: {self.log}"
        assert not os.path.lexists(self.socket), "the server left its socket behind"
        assert_none_left(self._mark, gone_within)
        self.check()

    def check(self) -> None:
        """Assert that an ended server's log has no traceback, and that each watched goal has one terminal state."""
        assert "Traceback" not in self.log, self.log
        if self._watcher:
            self._watcher.wait_for_end()
            self._watcher.check(self.unfinished)

    def _environment(self, mark: str) -> dict[str, str]:
        server = {"TALK_SOCKET": self.socket, "SCRIPTED_START_FILE": f"{self.directory}/start", MARK: mark}
        sound = self._sink.env if self._sink else {}
        return clean_environment(self.directory, {**sound, **server, **self._extra})

    def _await_greeting(self) -> None:
        assert self._server
        end = time.monotonic() + START_LIMIT
        while True:
            with contextlib.suppress(OSError, EOFError):
                wire = Wire(self.socket)
                wire.close()
                assert wire.greeting.get("talk") == 1, wire.greeting
                return
            code = self._server.poll()
            assert code is None, f"the server ended with {code} before its greeting: {self.log}"
            assert time.monotonic() < end, f"no greeting within {START_LIMIT} s: {self.log}"
            time.sleep(0.01)  # a new socket sends no event

    def _end(self) -> None:
        self._end_clients()
        if self._server:
            self._server.kill()
            self._server.wait()
        if self._watcher:
            self._watcher.close()
        with contextlib.suppress(AssertionError):
            assert_none_left(self._mark, 0.5)
            assert_none_left(f"{self._mark}-client", 0.5)
