"""The faults of the soak test. Each fault also restores the normal state."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import time
from collections import Counter
from typing import TYPE_CHECKING

from tests.conformance.rawsocket import Raw
from tests.faults.test_clients_many import client_process
from tests.support.surroundings import command_line
from tests.support.usage import descendants

if TYPE_CHECKING:
    import random
    from collections.abc import Callable, Mapping

    from tests.support.processes import Talk
    from tests.support.sink import Sink

#: Time until a disturbed sink plays and is recorded normally again.
_RECOVERY_S = 3.0
_SIGNAL_LIMIT_S = 20.0
#: Time between two kills of an engine process, and between a kill and another kill during the restart.
_KILL_INTERVAL_S, _RESTART_KILL_S = (0.12, 5.0), (0.0, 0.08)


class FaultInjector:
    """Injects faults in the calling thread, all kinds equally often."""

    def __init__(self, rng: random.Random) -> None:
        self.rng = rng
        self.kinds: Mapping[str, Callable[[], object]] = {}
        self.done: Counter[str] = Counter()
        #: the last fault, for messages
        self.last = "none"

    def run(self, every: float, over: Callable[[], bool]) -> None:
        """Inject a fault every `every` seconds on average, until `over` returns True."""
        remaining: list[str] = []
        while True:
            due = time.monotonic() + every * self.rng.uniform(0.5, 1.5)
            while time.monotonic() < due:
                time.sleep(0.1)
                if over():
                    return
            remaining = remaining or self.rng.sample([*self.kinds], len(self.kinds))
            self.inject(remaining.pop())

    def inject(self, kind: str) -> None:
        self.last = kind
        self.kinds[kind]()
        self.done[kind] += 1


class RobotFaults(FaultInjector):
    def __init__(self, talk: Talk, sink: Sink, player: str, rng: random.Random) -> None:
        super().__init__(rng)
        self._talk = talk
        self._disturbed_until = 0.0
        self._last_pid = 0
        self.kinds = {
            "engine killed": lambda: self._signal("talkcli.engine", signal.SIGKILL),
            "engine segfaults": lambda: self._signal("talkcli.engine", signal.SIGSEGV),
            "engine frozen": lambda: self._signal("talkcli.engine", signal.SIGSTOP),
            "player killed": lambda: self._signal(player, signal.SIGKILL),
            "player frozen": lambda: self._signal(player, signal.SIGSTOP),
            "sink suspended": lambda: self._disturb(sink.suspend, sink.resume, 5),
            # The clients speak all the time. They warm the sink up, and it is never quiet.
            "sink unplugged": lambda: self._disturb(sink.unload, lambda: sink.reload(warm=False), 3),
            "sound server frozen": lambda: self._disturb(sink.freeze, sink.thaw, 5),
            "sound server killed": lambda: self._disturb(sink.kill_server, lambda: sink.start_server(warm=False), 3),
            "paused": lambda: self._disturb(self._pause, lambda: self._request("resume"), 2),
            "everything cancelled": lambda: self._request("cancel"),
            "SIGHUPs": self._send_hangups,
            "client killed": self._kill_client,
            "clients frozen": self._freeze_clients,
            "clients by the hundred": self._connect_by_the_hundred,
            "bad lines": self._send_bad_lines,
        }

    def kill_engines(self, over: Callable[[], bool]) -> None:
        """Only kill engine processes, also while they start."""
        self._disturbed_until = float("inf")
        while not over():
            time.sleep(self.rng.uniform(*_KILL_INTERVAL_S))
            self.inject("engine killed")
            for _ in range(self.rng.choice((0, 0, 1, 2))):
                time.sleep(self.rng.uniform(*_RESTART_KILL_S))
                self.inject("engine killed")

    def calm_since(self, moment: float) -> bool:
        """Whether a sentence that started at this monotonic time must have been heard completely."""
        return self._disturbed_until + _RECOVERY_S < moment

    def _signal(self, name: str, number: signal.Signals) -> None:
        """Send a signal to a process with this name, as soon as one exists that didn't get the last signal."""
        end = time.monotonic() + _SIGNAL_LIMIT_S
        while time.monotonic() < end:
            for pid in descendants(self._talk.pid):
                if name in command_line(pid) and pid != self._last_pid:
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(pid, number)
                        self._last_pid = pid
                        return
            time.sleep(0.001)  # a new process sends no event

    def _disturb(self, begin: Callable[[], object], end: Callable[[], object], max_seconds: float) -> None:
        self._disturbed_until = float("inf")
        begin()
        time.sleep(self.rng.uniform(0.1, max_seconds))
        end()
        self._disturbed_until = time.monotonic()

    def _request(self, request: str) -> None:
        assert self._talk.request(request)["ok"]

    def _pause(self) -> None:
        reply = self._talk.request("pause")
        assert reply["ok"] or reply["error"]["code"] == "not_silent", reply  # a frozen engine doesn't confirm it

    def _send_hangups(self) -> None:
        for _ in range(100):
            os.kill(self._talk.pid, signal.SIGHUP)

    def _kill_client(self) -> None:
        client = self._talk.start("say", "--wait", "--priority", "5", "--", "nobody waits for this any more")
        time.sleep(self.rng.uniform(0.1, 0.5))
        client.kill()
        client.wait()

    def _freeze_clients(self) -> None:
        with client_process(self._talk, 20, json.dumps({"seq": 1, "request": "watch"})) as clients:
            clients.send_signal(signal.SIGSTOP)
            time.sleep(self.rng.uniform(0.5, 3))

    def _connect_by_the_hundred(self) -> None:
        with contextlib.ExitStack() as stack:
            for _ in range(300):
                stack.enter_context(Raw(self._talk.socket))

    def _send_bad_lines(self) -> None:
        for data in (self.rng.randbytes(3000), b"[" * 60_000 + b"\n", b"a" * 100_000, b'{"request": "say", "te'):
            with Raw(self._talk.socket) as raw:
                raw.send(data)
