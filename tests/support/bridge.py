"""A robot's `talk bridge` and a desk, as processes of a test."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
import uuid
from typing import TYPE_CHECKING, Any

from tests.support.forking import Forked, can_fork
from tests.support.mqtt import Listener
from tests.support.processes import Clients, Finished
from tests.support.surroundings import MARK, assert_none_left, clean_environment, dying_with_parent, short_directory

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from tests.support.broker import Broker
    from tests.support.mqtt import Message
    from tests.support.processes import Process, Talk

#: Seconds in which a started bridge is online: it may have to ask whether another one has its name.
ONLINE_LIMIT = 10.0
#: Seconds in which it ends after SIGTERM.
STOP_LIMIT = 5.0


class Bridge(contextlib.AbstractContextManager["Bridge"]):
    """A `talk bridge`, started. It is online after `await_online()`, and killed by `close()` or `with`.

    The user, the password and the certificate are as in `Broker.env`. The test looks at the robot's presence as the
    user `observer`. The port is that of a proxy before the broker.
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
        self._broker, self._observer = broker, observer
        self._mark = uuid.uuid4().hex
        self._words = ["bridge", "--name", name, *(["--group", ",".join(groups)] if groups else []), *options]
        to = {"TALK_BROKER": broker.url_at(port)} if port else {}
        self._env = talk.env | broker.env(user, password, cert) | to | dict(env or {}) | {MARK: self._mark}
        self._process: Process | None = None
        #: the sessions that were seen online, and those of them from before the last start
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
        self._stack.close()

    @property
    def pid(self) -> int:
        return self._started().pid

    @property
    def running(self) -> bool:
        return self._process is not None and self._process.poll() is None

    @property
    def log(self) -> str:
        with open(f"{self._directory}/log", encoding="utf-8", errors="replace") as file:
            return file.read()

    def start(self) -> None:
        assert not self.running, f"the bridge {self.name} runs"
        self._earlier = set(self._sessions)
        with open(f"{self._directory}/log", "ab") as log:
            to = log.fileno()
            if can_fork(self._env):
                self._process = Forked(self._words, self._env, stdout=to, stderr=to)
            else:
                command = dying_with_parent([sys.executable, "-m", "talkcli", *self._words])
                self._process = subprocess.Popen(
                    command, env=self._env, stdin=subprocess.DEVNULL, stdout=to, stderr=to, text=True
                )

    def await_online(self, within: float = ONLINE_LIMIT) -> dict[str, Any]:
        """Wait until the robot is online with a server after the last start, and return its presence."""
        end = time.monotonic() + within

        def online(message: Message) -> bool:
            told = message.json if message.payload else {}
            return bool(told.get("online") and told.get("server") and told["session"] not in self._earlier)

        with Listener(self._broker, f"talk/robot/{self.name}/presence", user=self._observer) as listener:
            # The broker doesn't tell that the process has ended.
            while not (found := listener.find(online, 0.1)):
                code = self._started().poll()
                assert code is None, f"the bridge {self.name} ended with {code}: {self.log}"
                told = f"{self.log}{listener.messages}"
                assert time.monotonic() < end, f"{self.name} is not online within {within} s: {told}"
        self._sessions.add(found.json["session"])
        return found.json

    def await_log(self, words: str, within: float = ONLINE_LIMIT) -> str:
        """Return the first line of the log with these words."""
        end = time.monotonic() + within
        while not (found := [each for each in self.log.splitlines() if words in each]):
            assert time.monotonic() < end, f"no '{words}' of the bridge {self.name} within {within} s: {self.log}"
            time.sleep(0.01)  # nothing tells when a file grows
        return found[0]

    def wait(self, timeout: float = STOP_LIMIT) -> int:
        try:
            return self._started().wait(timeout)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"the bridge {self.name} did not end within {timeout} s: {self.log}") from None

    def terminate(self) -> int:
        """End the bridge by SIGTERM, check that nothing is left of it, and return the exit code."""
        self._started().terminate()
        code = self.wait()
        assert_none_left(self._mark, STOP_LIMIT)
        assert "Traceback" not in self.log, self.log
        return code

    def kill(self) -> None:
        self._started().kill()
        self._started().wait()

    def stop_process(self) -> None:
        """Stop the process (SIGSTOP), and wait until it has stopped."""
        os.kill(self.pid, signal.SIGSTOP)
        while self._state() not in "TZ":
            time.sleep(0.001)  # the kernel tells only the parent

    def resume_process(self) -> None:
        os.kill(self.pid, signal.SIGCONT)

    def _state(self) -> str:
        with open(f"/proc/{self.pid}/stat", encoding="ascii", errors="replace") as file:
            return file.read().rpartition(") ")[2][0]

    def _started(self) -> Process:
        assert self._process
        return self._process

    def _end(self) -> None:
        if self.running:
            self.kill()
        assert_none_left(self._mark, 1.0)


class Desk(Clients, contextlib.AbstractContextManager["Desk"]):
    """Clients with a broker and without a server. `close()` or `with` ends those that still run."""

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
        self._stack.close()

    @property
    def env(self) -> dict[str, str]:
        return self._env

    @property
    def log(self) -> str:
        return self._broker.log


def desk(broker: Broker, robot: str, *words: str, user: str | None = None, timeout: float = 20) -> Finished:
    """Run one command at a desk: `desk(broker, "anna", "say", "--wait", "--", "battery low")`."""
    with Desk(broker, user=user) as somebody:
        return somebody.run("--robot", robot, *words, timeout=timeout)
