"""A robot's `talk bridge` and a desk, as processes."""

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
from tests.support.resources import Resource
from tests.support.surroundings import MARK, assert_none_left, clean_environment, dying_with_parent, short_directory

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from tests.support.broker import Broker
    from tests.support.mqtt import Message
    from tests.support.processes import Process, Talk

#: Time for a bridge to come online. It may have to ask whether another bridge has its name.
ONLINE_LIMIT = 10.0
#: Time for a bridge to end after SIGTERM.
STOP_LIMIT = 5.0


class Bridge(Resource):
    """A running `talk bridge`, which may not be online before `await_online()`.

    `user`, `password` and `cert` are as in `Broker.env`. `observer` is the user with whom the test reads the robot's
    presence. `port` is the port of a proxy in front of the broker.
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
        self._arguments = ["bridge", "--name", name, *(["--group", ",".join(groups)] if groups else []), *options]
        proxy = {"TALK_BROKER": broker.url_at(port)} if port else {}
        self._env = talk.env | broker.env(user, password, cert) | proxy | dict(env or {}) | {MARK: self._mark}
        self._process: Process | None = None
        #: all sessions that were online, and those before the last start
        self._sessions: set[str] = set()
        self._earlier: set[str] = set()
        with contextlib.ExitStack() as stack:
            self.directory = stack.enter_context(short_directory("bridge-"))
            stack.callback(self._end)
            self.start()
            self._stack = stack.pop_all()

    @property
    def pid(self) -> int:
        return self._started().pid

    @property
    def running(self) -> bool:
        return self._process is not None and self._process.poll() is None

    def start(self) -> None:
        assert not self.running, f"the bridge {self.name} is running already"
        self._earlier = set(self._sessions)
        with open(f"{self.directory}/log", "ab") as log:
            output = log.fileno()
            if can_fork(self._env):
                self._process = Forked(self._arguments, self._env, stdout=output, stderr=output)
            else:
                command = dying_with_parent([sys.executable, "-m", "talkcli", *self._arguments])
                self._process = subprocess.Popen(
                    command, env=self._env, stdin=subprocess.DEVNULL, stdout=output, stderr=output, text=True
                )

    def await_online(self, within: float = ONLINE_LIMIT) -> dict[str, Any]:
        """Wait until the bridge is online with a server after its last start, and return the robot's presence."""
        end = time.monotonic() + within

        def online(message: Message) -> bool:
            presence = message.json if message.payload else {}
            new = presence.get("session") not in self._earlier
            return bool(presence.get("online") and presence.get("server") and new)

        with Listener(self._broker, f"talk/robot/{self.name}/presence", user=self._observer) as listener:
            # The broker doesn't report the end of the process.
            while not (message := listener.find(online, 0.1)):
                code = self._started().poll()
                assert code is None, f"the bridge {self.name} ended with {code}: {self.log}"
                details = f"{self.log}{listener.messages}"
                assert time.monotonic() < end, f"{self.name} is not online within {within} s: {details}"
        self._sessions.add(message.json["session"])
        return message.json

    def await_log(self, text: str, within: float = ONLINE_LIMIT) -> str:
        """Wait for this text in the log, and return the first line that contains it."""
        end = time.monotonic() + within
        while not (lines := [line for line in self.log.splitlines() if text in line]):
            assert time.monotonic() < end, f"no '{text}' of the bridge {self.name} within {within} s: {self.log}"
            time.sleep(0.01)  # a growing file sends no event
        return lines[0]

    def wait(self, timeout: float = STOP_LIMIT) -> int:
        try:
            return self._started().wait(timeout)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"the bridge {self.name} did not end within {timeout} s: {self.log}") from None

    def terminate(self) -> int:
        """End the bridge with SIGTERM, check that no process is left behind, and return the exit code."""
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
            time.sleep(0.001)  # the kernel reports this only to the parent

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


class Desk(Resource, Clients):
    """Clients that have a broker, but no server."""

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
            proxy = {"TALK_BROKER": broker.url_at(port)} if port else {}
            variables = {"TALK_SOCKET": f"{home}/nobody"} | broker.env(user, password, cert) | proxy
            self._env = clean_environment(home, variables | dict(env or {}))
            self._stack = stack.pop_all()

    @property
    def env(self) -> dict[str, str]:
        return self._env

    @property
    def log(self) -> str:
        return self._broker.log


def desk(broker: Broker, robot: str, *arguments: str, user: str | None = None, timeout: float = 20) -> Finished:
    """Run one command at a new desk: `desk(broker, "anna", "say", "--wait", "--", "battery low")`."""
    with Desk(broker, user=user) as clients:
        return clients.run("--robot", robot, *arguments, timeout=timeout)
