"""A robot's way to a broker, `talk bridge`, as a process of a test's own; and the desk at the other end."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
import uuid
from typing import TYPE_CHECKING, Any

from tests.support.forking import Forked, forks
from tests.support.mqtt import Listener
from tests.support.processes import Clients, Finished
from tests.support.surroundings import (
    MARK,
    assert_none_left,
    clean_environment,
    dying_with_parent,
    short_directory,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from tests.support.broker import Broker
    from tests.support.mqtt import Message
    from tests.support.processes import Process, Talk

#: Seconds in which a bridge that has been started must be there: it may have to ask who else has its name.
ONLINE_LIMIT = 10.0
#: Seconds in which it must have ended after SIGTERM.
STOP_LIMIT = 5.0


class Bridge(contextlib.AbstractContextManager["Bridge"]):
    """A `talk bridge`, started; `close()` or `with` kills it. It is online after `await_online()`.

    `user`, `password` and `cert`: as whom it logs in, as in `Broker.env`; `observer`: as whom the test looks at its
    presence. `port`: that of a proxy before the broker.
    """

    def __init__(
        self,
        talk: Talk,
        broker: Broker,
        name: str,
        *options: str,
        groups: Sequence[str] = (),
        user: str | None = None,
        password: str | bool = True,
        cert: str | None = None,
        observer: str | None = None,
        port: int | None = None,
        env: Mapping[str, str] | None = None,
    ) -> None:
        self.name = name
        self._broker = broker
        self._observer = observer
        self._mark = uuid.uuid4().hex
        self._words = ["bridge", "--name", name, *(["--group", ",".join(groups)] if groups else []), *options]
        to = {"TALK_BROKER": broker.url_at(port)} if port else {}
        self._env = talk.env | broker.env(user, password, cert) | to | dict(env or {}) | {MARK: self._mark}
        self._process: Process | None = None
        #: the sessions that were seen to be online, and those of them that were before the last start
        self._sessions: set[str] = set()
        self._earlier: set[str] = set()
        with contextlib.ExitStack() as stack:
            self._directory = stack.enter_context(short_directory("bridge-"))
            stack.callback(self._end)
            self.start()
            self._stack = stack.pop_all()

    def __exit__(self, *_error: object) -> None:
        self.close()

    def close(self) -> None:
        """Kill it, without a word; a second time is nothing."""
        self._stack.close()

    @property
    def pid(self) -> int:
        """Process id, also of one that has ended."""
        return self._started().pid

    @property
    def running(self) -> bool:
        """Whether the process runs."""
        return self._process is not None and self._process.poll() is None

    @property
    def log(self) -> str:
        """What it wrote so far, to standard output and error."""
        with open(f"{self._directory}/log", encoding="utf-8", errors="replace") as file:
            return file.read()

    def start(self) -> None:
        """Start it; again after it has ended."""
        assert not self.running, f"the bridge {self.name} runs"
        self._earlier = set(self._sessions)
        with open(f"{self._directory}/log", "ab") as log:
            to = log.fileno()
            if forks(self._env):
                self._process = Forked(self._words, self._env, stdout=to, stderr=to)
            else:
                command = dying_with_parent([sys.executable, "-m", "talkcli", *self._words])
                self._process = subprocess.Popen(
                    command, env=self._env, stdin=subprocess.DEVNULL, stdout=to, stderr=to, text=True
                )

    def await_online(self, within: float = ONLINE_LIMIT) -> dict[str, Any]:
        """Wait until the broker keeps that it is online, with a server, since its last start; return its presence."""
        with Listener(self._broker, f"talk/robot/{self.name}/presence", user=self._observer) as listener:
            found = self._await(listener, within)
        self._sessions.add(found["session"])
        return found

    def await_log(self, words: str, within: float = ONLINE_LIMIT) -> str:
        """Wait for a line of its log with these words, and return it."""
        end = time.monotonic() + within
        while True:
            log = self.log
            found = next((each for each in log.splitlines() if words in each), None)
            if found:
                return found
            assert time.monotonic() < end, f"no '{words}' of the bridge {self.name} within {within} s: {log}"
            time.sleep(0.01)  # what a process writes to a file is no event

    def wait(self, timeout: float = STOP_LIMIT) -> int:
        """Wait for its end, and return the exit code; negative for a signal that killed it."""
        try:
            return self._started().wait(timeout)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"the bridge {self.name} did not end within {timeout} s: {self.log}") from None

    def terminate(self) -> int:
        """End it by SIGTERM, and return the exit code; nothing of it may be left, and no traceback in its log."""
        self._started().terminate()
        code = self.wait()
        assert_none_left(self._mark, STOP_LIMIT)
        assert "Traceback" not in self.log, self.log
        return code

    def kill(self) -> None:
        """Kill it outright."""
        self._started().kill()
        self._started().wait()

    def stop_process(self) -> None:
        """Stop its process as it is (SIGSTOP), as a robot that suspends; it has stopped when this returns."""
        os.kill(self.pid, signal.SIGSTOP)
        while self._state() not in "TZ":
            time.sleep(0.001)  # the kernel tells a parent alone, which the test may not be

    def go_on(self) -> None:
        """Let one that was stopped go on (SIGCONT)."""
        os.kill(self.pid, signal.SIGCONT)

    def _state(self) -> str:
        with open(f"/proc/{self.pid}/stat", encoding="ascii", errors="replace") as file:
            return file.read().rpartition(") ")[2][0]

    def _started(self) -> Process:
        assert self._process
        return self._process

    def _await(self, listener: Listener, within: float) -> dict[str, Any]:
        end = time.monotonic() + within

        def online(message: Message) -> bool:
            told = message.json if message.payload else {}
            return bool(told.get("online") and told.get("server") and told["session"] not in self._earlier)

        while True:
            left = end - time.monotonic()
            # The broker doesn't tell that a process has ended.
            found = listener.find(online, min(max(left, 0.0), 0.1))
            if found:
                return found.json
            code = self._started().poll()
            assert code is None, f"the bridge {self.name} ended with {code}: {self.log}"
            assert left > 0, f"{self.name} is not online within {within} s: {self.log}{listener.messages}"

    def _end(self) -> None:
        if self.running:
            self.kill()
        assert_none_left(self._mark, 1.0)


class Desk(Clients, contextlib.AbstractContextManager["Desk"]):
    """Somebody with a broker and no server; `close()` or `with` ends the clients that still run."""

    def __init__(
        self,
        broker: Broker,
        *,
        user: str | None = None,
        password: str | bool = True,
        cert: str | None = None,
        port: int | None = None,
        env: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__()
        self._broker = broker
        with contextlib.ExitStack() as stack:
            home = stack.enter_context(short_directory("desk-"))
            stack.callback(self._end_clients)
            to = {"TALK_BROKER": broker.url_at(port)} if port else {}
            own = {"TALK_SOCKET": f"{home}/nobody"} | broker.env(user, password, cert) | to
            self._env = clean_environment(home, own | dict(env or {}))
            self._stack = stack.pop_all()

    def __exit__(self, *_error: object) -> None:
        self.close()

    def close(self) -> None:
        """End what still runs."""
        self._stack.close()

    @property
    def env(self) -> dict[str, str]:
        """The environment of the desk's clients."""
        return self._env

    @property
    def log(self) -> str:
        """What the broker wrote."""
        return self._broker.log


def desk(broker: Broker, robot: str, *words: str, user: str | None = None, timeout: float = 20) -> Finished:
    """Run one command at a desk to its end: `desk(broker, "anna", "say", "--wait", "--", "battery low")`."""
    with Desk(broker, user=user) as somebody:
        return somebody.run("--robot", robot, *words, timeout=timeout)
