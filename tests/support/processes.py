"""One server for a test, as a process of its own, with the clients that the test runs against it."""

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
from tests.support.surroundings import MARK, assert_none_left, clean_environment, dying_with_parent, short_directory
from tests.support.watcher import Watcher

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from tests.support.recording import Recording
    from tests.support.sink import Sink

#: Seconds in which a server must greet, and in which it must have ended after SIGTERM.
START_LIMIT = 10.0
STOP_LIMIT = 5.0
#: A client or a server, started or forked.
Process = subprocess.Popen[str] | Forked
#: The program that is `talk serve` with the scripted engine.
SCRIPTED = os.path.join(os.path.dirname(os.path.abspath(__file__)), "scripted_serve.py")


@dataclass(frozen=True, slots=True)
class Finished:
    """A client that has ended."""

    command: tuple[str, ...]
    code: int  # exit code; negative for a signal that killed it
    out: str
    err: str
    seconds: float  # from its start to its end

    @property
    def id(self) -> str:
        """The goal's id, if the client printed nothing else."""
        return self.out.strip()


def children(pid: int) -> list[int]:
    """Return the children of a process, whichever of its threads started them."""
    while True:
        found: list[int] = []
        threads = os.listdir(f"/proc/{pid}/task")
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            for thread in threads:
                with open(f"/proc/{pid}/task/{thread}/children", encoding="ascii") as file:
                    found += map(int, file.read().split())
        # If a thread has ended meanwhile, its children belong to another one, which may have been read before.
        if set(threads) <= set(os.listdir(f"/proc/{pid}/task")):
            return found


def start_talk(words: Sequence[str], env: Mapping[str, str], stdin: int = subprocess.DEVNULL) -> Process:
    """Start `talk` with these words, its output in pipes."""
    if can_fork(env):
        return Forked(words, env, stdin=stdin, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    return subprocess.Popen(
        [sys.executable, "-m", "talkcli", *words],
        env=env,
        stdin=stdin,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        encoding="utf-8",
        errors="replace",
    )


def run_talk(words: Sequence[str], env: Mapping[str, str], timeout: float) -> tuple[int, str, str]:
    """Run `talk` to its end; return its exit code and its output. A process that takes longer is killed."""
    process = start_talk(words, env)
    try:
        out, err = process.communicate(timeout=timeout)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        raise
    return process.wait(), out, err


class Clients:
    """Runs clients for a test, in the environment `env`; `log` is added to the message if one goes wrong."""

    def __init__(self) -> None:
        self._clients: list[Process] = []

    @property
    def env(self) -> dict[str, str]:
        raise NotImplementedError

    @property
    def log(self) -> str:
        raise NotImplementedError

    def start(self, *words: str, stdin: int = subprocess.DEVNULL) -> Process:
        """Start a client in the background, its output in pipes; `finish()` waits for it."""
        client = start_talk(words, self.env, stdin)
        self._clients.append(client)
        return client

    def finish(self, client: Process, timeout: float = 20, stdin: str | None = None) -> Finished:
        """Wait for a client to end without a traceback; the seconds count from this call."""
        began = time.monotonic()
        assert isinstance(client.args, list)
        command = tuple(str(each) for each in client.args[2:])
        try:
            out, err = client.communicate(stdin, timeout=timeout)
        except subprocess.TimeoutExpired:
            client.kill()
            out, err = client.communicate()
            raise AssertionError(
                f"{' '.join(command)} did not end within {timeout} s\nout: {out}\nerr: {err}\nlog: {self.log}"
            ) from None
        result = Finished(command, client.wait(), out, err, time.monotonic() - began)
        assert "Traceback" not in err, f"{' '.join(command)}: {err}"
        return result

    def run(self, *words: str, timeout: float = 20, stdin: str | None = None) -> Finished:
        """Run a client to its end: `talk.run("say", "--wait", "--", "battery low")`."""
        began = time.monotonic()
        client = self.start(*words, stdin=subprocess.DEVNULL if stdin is None else subprocess.PIPE)
        return replace(self.finish(client, timeout, stdin), seconds=time.monotonic() - began)

    def _end_clients(self) -> None:
        for client in self._clients:
            if client.poll() is None:
                client.kill()
            client.wait()
            for pipe in (client.stdin, client.stdout, client.stderr):
                if pipe:
                    with contextlib.suppress(BrokenPipeError):
                        pipe.close()


class Talk(Clients):
    """A server, greeted and watched from before its first goal; `stop()` ends it and asserts that all is well.

    `unfinished`: the goals that may have no terminal event when the watcher is checked (True: any).
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
        """Start the server; `program` replaces `talk serve`, and a server not `forked` has its own command line."""
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
        self._words = [*(["--driver", driver] if driver else []), *options]
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
        """The server's process id, even after its end."""
        assert self._server
        return self._server.pid

    @property
    def env(self) -> dict[str, str]:
        return self._environment(f"{self._mark}-client")

    @property
    def log(self) -> str:
        """The server's standard error so far."""
        with open(f"{self.directory}/log", encoding="utf-8", errors="replace") as file:
            return file.read()

    @property
    def running(self) -> bool:
        return self._server is not None and self._server.poll() is None

    @property
    def recording(self) -> Recording:
        """The sound that the sink has played since the server was started."""
        assert self._recording, "this server has no sink"
        return self._recording

    @property
    def watcher(self) -> Watcher:
        assert self._watcher, "this server is not watched"
        return self._watcher

    def start_server(self) -> None:
        """Start the server and wait for its greeting; again after it has ended, then with a new watcher.

        The scripted engine is ready then, the real one may not be yet.
        """
        env = self._environment(self._mark)
        with open(f"{self.directory}/log", "ab") as log:
            if self._forked and can_fork(env):
                words, scripted, to = ["serve", *self._words], self._program == SCRIPTED, log.fileno()
                self._server = Forked(words, env, scripted=scripted, stdout=to, stderr=to, start_new_session=True)
            else:
                program = [self._program] if self._program else ["-m", "talkcli", "serve"]
                self._server = subprocess.Popen(
                    dying_with_parent([sys.executable, *program, *self._words]),
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
            self.request("voices")  # so that the engine is ready, and the first goal ACTIVE at once

    def script_start(self, behaviour: str) -> None:
        """Tell the scripted engine how each of its next starts goes, see `script`; "" for a good one."""
        with open(f"{self.directory}/start", "w", encoding="utf-8") as file:
            file.write(behaviour)

    def connect(self) -> Wire:
        """Return a raw connection."""
        return Wire(self.socket)

    def request(self, request: str, /, timeout: float = PATIENCE, **fields: object) -> Message:
        """Send one request over a connection of its own, and return the reply."""
        with self.connect() as wire:
            return wire.request(request, timeout=timeout, **fields)

    def goal(self, goal_id: str) -> Message:
        """Return a goal as the server has it now."""
        reply = self.request("status", id=goal_id)
        assert reply["ok"], reply
        goal: Message = reply["goal"]
        return goal

    def freeze(self) -> None:
        """Stop the server's process as it is (SIGSTOP)."""
        os.kill(self.pid, signal.SIGSTOP)

    def thaw(self) -> None:
        """Let a frozen server go on (SIGCONT)."""
        os.kill(self.pid, signal.SIGCONT)

    def kill(self) -> float:
        """Kill the server outright; return the seconds until nothing of it is left. Its goals have no end."""
        assert self._server
        killed = time.monotonic()
        self._server.kill()
        self._server.wait()
        self.unfinished = True
        assert_none_left(self._mark, 2.0)
        gone = time.monotonic() - killed
        self.check()
        return gone

    def stop(self, *, timeout: float = STOP_LIMIT, gone_within: float = 2.0) -> None:
        """End the server by SIGTERM; assert exit 0, no socket, no process, and one end of each goal."""
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
        """Assert that an ended server's log has no traceback, and every watched goal has one terminal state."""
        assert "Traceback" not in self.log, self.log
        if self._watcher:
            self._watcher.wait_for_end()
            self._watcher.check(self.unfinished)

    def close(self) -> None:
        """End all processes of this test, and remove its directory."""
        self._stack.close()

    def _environment(self, mark: str) -> dict[str, str]:
        own = {"TALK_SOCKET": self.socket, "SCRIPTED_START_FILE": f"{self.directory}/start", MARK: mark}
        sound = self._sink.env if self._sink else {}
        return clean_environment(self.directory, {**sound, **own, **self._extra})

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
            assert code is None, f"the server ended with {code} before it served: {self.log}"
            assert time.monotonic() < end, f"no greeting within {START_LIMIT} s: {self.log}"
            time.sleep(0.01)  # a socket's appearance is no event

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
