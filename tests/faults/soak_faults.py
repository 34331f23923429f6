"""The faults of a soak: one after the other, of every kind in turn, each with what brings the world back in order."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import time
from collections import Counter
from typing import TYPE_CHECKING

from tests.conformance.rawsocket import Raw
from tests.faults.test_clients_many import crowd
from tests.support.census import descendants
from tests.support.surroundings import command_line

if TYPE_CHECKING:
    import random
    from collections.abc import Callable, Iterator, Sequence

    from tests.support.processes import Talk
    from tests.support.sink import Sink


#: Seconds after which a sink that was disturbed plays and is recorded as before.
_WARM = 3.0

#: Seconds between two kills of an engine process, and between two where the next one is to be met in its start.
KILLS = (0.12, 5.0)
_IN_ITS_START = (0.0, 0.08)


def in_turn(
    kinds: Sequence[Callable[[], None]], chance: random.Random, every: float, over: Callable[[], bool]
) -> Iterator[Callable[[], None]]:
    """Yield one of these every so many seconds, more or less, each kind as often as the others, until it is over."""
    left: list[Callable[[], None]] = []
    while True:
        due = time.monotonic() + every * chance.uniform(0.5, 1.5)
        while time.monotonic() < due:
            time.sleep(0.1)
            if over():
                return
        if not left:
            left = list(kinds)
            chance.shuffle(left)
        yield left.pop()


class Faults:
    """Injects a fault every few seconds, in the thread that calls: what it starts would end with any other."""

    def __init__(self, talk: Talk, sink: Sink, chance: random.Random, every: float) -> None:
        self._talk = talk
        self._sink = sink
        self._chance = chance
        self._every = every
        #: how many of each kind there were
        self.done: Counter[str] = Counter()
        #: the last fault, for messages
        self.last = "none"
        self._disturbed_until = 0.0
        self._hit = 0
        #: engine processes that were killed, of which each may have cost a goal
        self.deaths = 0
        self._kinds: list[Callable[[], None]] = [
            self.engine_killed,
            self.engine_segfaults,
            self.player_killed,
            self.engine_frozen,
            self.player_frozen,
            self.sink_suspended,
            self.sink_unplugged,
            self.sound_server_frozen,
            self.sound_server_killed,
            self.client_killed,
            self.clients_frozen,
            self.clients_by_the_hundred,
            self.bad_lines,
            self.server_hung_up,
            self.paused,
            self.everything_cancelled,
        ]

    def run(self, seconds: float, least: int, enough: Callable[[], bool]) -> None:
        """Inject faults for so long, and until there were so many; or until it is enough."""
        end = time.monotonic() + seconds

        def over() -> bool:
            return enough() or (time.monotonic() >= end and self.done.total() >= least)

        for kind in in_turn(self._kinds, self._chance, self._every, over):
            self.last = kind.__name__
            kind()
            self.done[kind.__name__] += 1

    def kill_engines(self, seconds: float, enough: Callable[[], bool]) -> None:
        """Do nothing else for so long but kill engine processes, those that are being started too."""
        end = time.monotonic() + seconds
        self.last, self._disturbed_until = "engines killed", float("inf")
        while time.monotonic() < end and not enough():
            time.sleep(self._chance.uniform(*KILLS))
            self._kill_next("ready")
            for _ in range(self._chance.choice((0, 0, 1, 2))):
                time.sleep(self._chance.uniform(*_IN_ITS_START))
                self._kill_next("soon after a kill")

    def _kill_next(self, when: str) -> None:
        self._signal("talkcli.engine", signal.SIGKILL)
        self.done[f"engine killed {when}"] += 1
        self.deaths += 1

    def calm_since(self, moment: float) -> bool:
        """Whether all that was said from this monotonic time on must have been heard as it was said."""
        return self._disturbed_until + _WARM < moment

    # -- engine and player

    def engine_killed(self) -> None:
        self._signal("talkcli.engine", signal.SIGKILL)

    def engine_segfaults(self) -> None:
        self._signal("talkcli.engine", signal.SIGSEGV)

    def engine_frozen(self) -> None:
        self._signal("talkcli.engine", signal.SIGSTOP)

    def player_killed(self) -> None:
        self._signal("aplay", signal.SIGKILL)

    def player_frozen(self) -> None:
        self._signal("aplay", signal.SIGSTOP)

    def _signal(self, name: str, number: signal.Signals) -> None:
        """Send a signal to the process of that name, as soon as there is one that did not have one before."""
        end = time.monotonic() + 20
        while time.monotonic() < end:
            for pid in descendants(self._talk.pid):
                if name in command_line(pid) and pid != self._hit:
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(pid, number)
                        self._hit = pid
                        return
            time.sleep(0.001)  # a process that is started is no event

    # -- sound

    @contextlib.contextmanager
    def _disturbance(self) -> Iterator[None]:
        self._disturbed_until = float("inf")
        try:
            yield
        finally:
            self._disturbed_until = time.monotonic()

    def sink_suspended(self) -> None:
        with self._disturbance():
            self._sink.suspend()
            time.sleep(self._chance.uniform(0.2, 5))
            self._sink.resume()

    def sink_unplugged(self) -> None:
        with self._disturbance():
            self._sink.unload()
            time.sleep(self._chance.uniform(0.2, 3))
            self._sink.reload()

    def sound_server_frozen(self) -> None:
        with self._disturbance():
            self._sink.freeze()
            time.sleep(self._chance.uniform(0.2, 5))
            self._sink.thaw()

    def sound_server_killed(self) -> None:
        with self._disturbance():
            self._sink.kill_server()
            time.sleep(self._chance.uniform(0.2, 3))
            self._sink.start_server()

    # -- clients

    def client_killed(self) -> None:
        client = self._talk.start("say", "--wait", "--priority", "5", "--", "nobody waits for this any more")
        time.sleep(self._chance.uniform(0.1, 0.5))
        client.kill()
        client.wait()

    def clients_frozen(self) -> None:
        with crowd(self._talk, 20, json.dumps({"seq": 1, "request": "watch"})) as clients:
            clients.send_signal(signal.SIGSTOP)
            time.sleep(self._chance.uniform(0.5, 3))

    def clients_by_the_hundred(self) -> None:
        with contextlib.ExitStack() as stack:
            for _ in range(300):
                each = stack.enter_context(socket.socket(socket.AF_UNIX))
                each.settimeout(5)
                each.connect(self._talk.socket)

    def bad_lines(self) -> None:
        for data in (self._chance.randbytes(3000), b"[" * 60_000 + b"\n", b"a" * 100_000, b'{"request": "say", "te'):
            with Raw(self._talk.socket) as raw:
                raw.send(data)

    # -- the server

    def server_hung_up(self) -> None:
        for _ in range(100):
            os.kill(self._talk.pid, signal.SIGHUP)

    def paused(self) -> None:
        with self._disturbance():
            reply = self._talk.request("pause")
            assert reply["ok"] or reply["error"]["code"] == "not_silent", reply  # a frozen engine doesn't confirm it
            time.sleep(self._chance.uniform(0.05, 2))
            assert self._talk.request("resume")["ok"]

    def everything_cancelled(self) -> None:
        assert self._talk.request("cancel")["ok"]
