"""Robots by the hundred in one process: real bridges, each over a server whose engine is made up.

    python -m tests.fleet.simulated --robots 250 --first 1 --broker mqtt://127.0.0.1:1883 --group warehouse

Robots are sim-0001 and on. Of a robot's server all is real that lives in its event loop: connections, requests, the
scheduler, who is told what. There is no sound and no engine process: a sentence takes a second, or as long as
`length=SECONDS` in its text says, and no word of it is told. When all can be asked it says so in a line on standard
output. What begins to be spoken goes to the file of `--spoken`, an object a line: robot, id, text, and the monotonic
time, which is the same in all processes of a machine. SIGTERM ends them all, each with its goodbye.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import gc
import json
import os
import random
import re
import signal
import socket
import string
import tempfile
import time
from typing import TYPE_CHECKING, Any, cast

from talkcli import __version__
from talkcli.daemon import log
from talkcli.engine import protocol
from talkcli.fleet.bridge import Bridge, Settings
from talkcli.fleet.broker import from_environment
from talkcli.fleet.policy import ASKABLE
from talkcli.goals.goal import Sender
from talkcli.goals.options import as_shown
from talkcli.goals.scheduler import Scheduler
from talkcli.protocol.events import greeting
from talkcli.protocol.lines import encode
from talkcli.server.connection import Connection
from talkcli.server.requests import Requests
from talkcli.server.speech import Speech
from talkcli.server.stream import Acceptor, make_room

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import TextIO

    from talkcli.fleet.broker import Broker
    from talkcli.goals.goal import JsonObject

#: Seconds that a sentence takes which doesn't say.
LENGTH = 1.0
#: Descriptors of one robot: its listening socket, both ends of the connections of its bridge and of two askers, the
#: broker's, and two that paho wakes itself by.
_DESCRIPTORS = 12
#: Seconds between two looks whether all can be asked.
_LOOK_EVERY = 0.05
_LENGTH = re.compile(r"\blength=(\d+(?:\.\d+)?)")


def name_of(number: int) -> str:
    """Return what a simulated robot is called."""
    return f"sim-{number:04d}"


class Engine:
    """Takes the time that a sentence would: what a `Supervisor` is to a server, without a thread and a process."""

    def __init__(self, report: Callable[[Any], None], spoken: Callable[[str, str], None]) -> None:
        """`spoken` is called with id and text of each goal that begins."""
        self._report, self._spoken = report, spoken
        self._loop = asyncio.get_running_loop()
        self._goal = ""
        self._length = self._left = 0.0
        #: when it is over, by the loop's clock
        self._due = 0.0
        self._timer: asyncio.TimerHandle | None = None

    def say(self, say: protocol.Say) -> None:
        """Begin with a goal."""
        self._spoken(say.id, say.text)
        found = _LENGTH.search(say.text)
        self._goal, self._length = say.id, float(found.group(1)) if found else LENGTH
        self._left = self._length
        self._go_on()

    def stop(self, goal_id: str) -> None:
        """Be silent at once."""
        if goal_id == self._goal:
            self._end(protocol.STOPPED)

    def pause(self, goal_id: str, number: int) -> None:
        """Hold it where it is."""
        if goal_id == self._goal and self._timer:
            self._left = max(0.0, self._due - self._loop.time())
            self._halt()
            self._report(protocol.Paused(goal_id, number))

    def resume(self, goal_id: str) -> None:
        """Go on with what is held."""
        if goal_id == self._goal and not self._timer:
            self._go_on()

    def follow(self, goal_id: str, followed: bool, by_neural: bool) -> None:
        """Take note of what makes no difference here."""

    def _go_on(self) -> None:
        self._due = self._loop.time() + self._left
        self._timer = self._loop.call_at(self._due, self._end, protocol.COMPLETED)

    def _halt(self) -> None:
        if self._timer:
            self._timer.cancel()
        self._timer = None

    def _end(self, outcome: str) -> None:
        self._halt()
        goal, self._goal = self._goal, ""
        length = self._length if outcome == protocol.COMPLETED else None
        self._report(protocol.Ended(goal, outcome, duration=length))


class Server:
    """A robot's server, listening. It is the handler of its connections, and lets everybody in."""

    def __init__(self, path: str, spoken: Callable[[str, str], None], descriptors: int) -> None:
        loop = asyncio.get_running_loop()
        choice = random.choice
        boot = "".join(choice(each) for each in (string.digits, string.ascii_lowercase) * 2)
        self._path = path
        self._scheduler = Scheduler(boot, max_queue=100)
        self._speech = speech = Speech(self._scheduler)
        speech.engine = cast("Any", Engine(speech.report, spoken))
        speech.report(protocol.Ready("made-up", None, "none"))
        speech.report(protocol.Voices((protocol.Voice("en", "en", "made-up"),)))
        self._requests = Requests(speech, self._describe)
        self.handle, self.owes, self.left = self._requests.handle, self._requests.owes, self._requests.left
        self.greeting = encode(greeting(__version__, os.getpid(), boot))
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.setblocking(False)
        self._socket.bind(path)
        self._socket.listen()
        self._acceptor = Acceptor(loop, lambda each: Connection(self, speech.streams, each).begin(), descriptors)
        self._acceptor.open(self._socket)

    def joined(self, connection: Connection) -> None:
        """Let a client in."""
        connection.sender = Sender()
        connection.admit()

    def close(self) -> None:
        """Take up no more clients."""
        self._acceptor.close()
        self._socket.close()

    def _describe(self) -> JsonObject:
        scheduler = self._scheduler
        return {
            "pid": os.getpid(),
            "version": __version__,
            "boot": scheduler.boot,
            "socket": self._path,
            "engine": self._speech.engine_words,
            **as_shown(scheduler.settings),
            "paused": scheduler.paused,
            "pending": scheduler.pending_count,
        }


class Robots:
    """All robots of this process."""

    def __init__(self, broker: Broker, groups: tuple[str, ...], spoken: TextIO | None) -> None:
        self._broker, self._groups, self._spoken = broker, groups, spoken
        self._servers: list[Server] = []
        self._bridges: list[Bridge] = []

    async def run(self, names: list[str], directory: str) -> None:
        """Have them all there until the process is told to end."""
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(log.loop_bug)
        descriptors = make_room(_DESCRIPTORS * len(names))
        for each in names:
            path = f"{directory}/{each}"
            self._servers.append(Server(path, self._witness(each), descriptors))
            settings = Settings(each, self._broker, ASKABLE, self._groups, path)
            self._bridges.append(Bridge(settings, lambda: self._broker))
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, self._end)
        self._look = loop.call_later(_LOOK_EVERY, self._tell_ready)
        try:
            await asyncio.gather(*(each.run() for each in self._bridges))
        finally:
            self._look.cancel()
            for server in self._servers:
                server.close()

    def _witness(self, robot: str) -> Callable[[str, str], None]:
        def note(goal_id: str, text: str) -> None:
            if self._spoken:
                line = {"robot": robot, "id": goal_id, "text": text, "at": time.monotonic()}
                self._spoken.write(json.dumps(line) + "\n")

        return note

    def _tell_ready(self) -> None:
        if not all(each.ready for each in self._bridges):
            self._look = asyncio.get_running_loop().call_later(_LOOK_EVERY, self._tell_ready)
            return
        # What it has by now stays: to look at all of it again and again would keep hundreds of robots waiting.
        gc.collect()
        gc.freeze()
        print(f"{len(self._bridges)} robots are there", flush=True)

    def _end(self) -> None:
        for each in self._bridges:
            each.end()


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser("python -m tests.fleet.simulated", description="Robots by the hundred.")
    parser.add_argument("--robots", type=int, default=100, help="how many (%(default)s)")
    parser.add_argument("--first", type=int, default=1, help="the number of the first (%(default)s)")
    parser.add_argument("--broker", required=True, metavar="URL")
    parser.add_argument("--group", action="append", default=[], help="that they are in, besides all")
    parser.add_argument("--spoken", metavar="FILE", help="where what they speak is noted")
    asked = parser.parse_args()
    broker = from_environment({"TALK_BROKER": asked.broker})
    names = [name_of(each) for each in range(asked.first, asked.first + asked.robots)]
    with contextlib.ExitStack() as stack:
        directory = stack.enter_context(tempfile.TemporaryDirectory(prefix="sim-"))
        # A line is whole in the file as soon as it is written.
        spoken = stack.enter_context(open(asked.spoken, "a", 1, encoding="utf-8")) if asked.spoken else None
        asyncio.run(Robots(broker, tuple(asked.group), spoken).run(names, directory))


if __name__ == "__main__":
    main()
