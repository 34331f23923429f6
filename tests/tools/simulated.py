"""Hundreds of robots in one process, with real bridges and servers, but with engines that make no sound.

    python -m tests.tools.simulated --robots 250 --first 1 --broker mqtt://127.0.0.1:1883

The robots are called sim-0001 and so on. A sentence takes one second, or SECONDS if its text contains `length=SECONDS`.
When all robots are online, the program prints a line. For each sentence that starts, it writes a JSON line with the
robot, id, text and monotonic time to the file given with `--spoken`. SIGTERM ends the robots.
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
from talkcli.fleet.bridge.main import Bridge, BridgeSettings
from talkcli.fleet.bridge.policy import ALLOWABLE_REQUESTS
from talkcli.fleet.broker import from_environment
from talkcli.goals.goal import Sender
from talkcli.goals.options import shown_settings
from talkcli.goals.scheduler import Scheduler
from talkcli.protocol.events import greeting
from talkcli.protocol.lines import encode
from talkcli.server.connection import ClientConnection
from talkcli.server.requests import Requests
from talkcli.server.speech import Speech
from talkcli.server.stream import Acceptor, raise_descriptor_limit

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import TextIO

    from talkcli.goals.goal import JsonObject

_DEFAULT_LENGTH_S = 1.0
_LENGTH = re.compile(r"\blength=(\d+(?:\.\d+)?)")
#: Descriptors per robot: its socket, both ends of three connections, the broker's connection, and those of paho.
_DESCRIPTORS = 12
_POLL_INTERVAL_S = 0.05


class SilentEngine:
    """A replacement for a server's `Supervisor`. It only waits for the length of each sentence."""

    def __init__(self, report: Callable[[Any], None], on_start: Callable[[str, str], None]) -> None:
        """`on_start` is called with the id and the text of each goal that starts."""
        self._report, self._on_start = report, on_start
        self._goal = ""

    def speak(self, command: protocol.Speak) -> None:
        self._on_start(command.id, command.text)
        match = _LENGTH.search(command.text)
        length = float(match.group(1)) if match else _DEFAULT_LENGTH_S
        self._goal = command.id
        asyncio.get_running_loop().call_later(length, self._end, command.id, protocol.OUTCOME_COMPLETED, length)

    def stop(self, goal_id: str) -> None:
        self._end(goal_id, protocol.OUTCOME_STOPPED, None)

    def announce_next(self, goal_id: str, next_waits: bool, next_is_neural: bool) -> None:
        pass

    def _end(self, goal_id: str, outcome: str, length: float | None) -> None:
        if goal_id == self._goal:
            self._goal = ""
            self._report(protocol.Ended(goal_id, outcome, duration=length))


class Server:
    """A robot's server, which accepts all clients."""

    def __init__(self, path: str, on_start: Callable[[str, str], None], descriptors: int) -> None:
        boot = "".join(random.choice(characters) for characters in (string.digits, string.ascii_lowercase) * 2)
        self._path = path
        self._scheduler = Scheduler(boot, max_queue=100)
        self._speech = speech = Speech(self._scheduler)
        speech.engine = cast("Any", SilentEngine(speech.report, on_start))
        speech.report(protocol.Ready("simulated", None, "none"))
        speech.report(protocol.VoiceList((protocol.Voice("en", "en", "simulated"),)))
        self._requests = Requests(speech, self._describe)
        self.input_ended = self._requests.input_ended
        self.handle, self.is_waiting, self.left = self._requests.handle, self._requests.is_waiting, self._requests.left
        self.greeting = encode(greeting(__version__, os.getpid(), boot))
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.setblocking(False)
        self._socket.bind(path)
        self._socket.listen()
        self._acceptor = Acceptor(lambda client: ClientConnection(self, speech.streams, client).begin(), descriptors)
        self._acceptor.open(self._socket)

    def joined(self, connection: ClientConnection) -> None:
        connection.client = Sender()
        connection.admit()

    def close(self) -> None:
        self._acceptor.close()
        self._socket.close()

    def _describe(self) -> JsonObject:
        scheduler = self._scheduler
        return {
            "pid": os.getpid(),
            "version": __version__,
            "boot": scheduler.boot,
            "socket": self._path,
            "engine": self._speech.engine_status,
            **shown_settings(scheduler.settings),
            "paused": scheduler.paused,
            "pending": len(scheduler.pending),
        }


async def run(names: list[str], broker_url: str, directory: str, spoken: TextIO) -> None:
    loop = asyncio.get_running_loop()
    loop.set_exception_handler(log.handle_loop_error)
    descriptors = raise_descriptor_limit(_DESCRIPTORS * len(names))
    broker = from_environment({"TALK_BROKER": broker_url})

    def note(robot: str, goal_id: str, text: str) -> None:
        spoken.write(json.dumps({"robot": robot, "id": goal_id, "text": text, "at": time.monotonic()}) + "\n")

    servers = [Server(f"{directory}/{name}", lambda *goal, name=name: note(name, *goal), descriptors) for name in names]
    bridges = [
        Bridge(BridgeSettings(name, ALLOWABLE_REQUESTS, (), f"{directory}/{name}"), lambda: broker) for name in names
    ]

    timer: asyncio.TimerHandle | None = None

    def report_online() -> None:
        nonlocal timer
        if not all(bridge._online and bridge._publisher.server for bridge in bridges):
            timer = loop.call_later(_POLL_INTERVAL_S, report_online)
            return
        # Later garbage collections of all objects would delay hundreds of robots.
        gc.collect()
        gc.freeze()
        print(f"{len(bridges)} robots are online", flush=True)

    def end() -> None:
        for bridge in bridges:
            bridge.end()

    report_online()
    loop.add_signal_handler(signal.SIGTERM, end)
    try:
        await asyncio.gather(*(bridge.run() for bridge in bridges))
    finally:
        if timer:
            timer.cancel()
        for server in servers:
            server.close()


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--robots", type=int, default=100, help="number of robots (%(default)s)")
    parser.add_argument("--first", type=int, default=1, help="the number of the first robot (%(default)s)")
    parser.add_argument("--broker", required=True, metavar="URL")
    parser.add_argument("--spoken", default=os.devnull, metavar="FILE", help="file for the sentences that start")
    options = parser.parse_args()
    names = [f"sim-{number:04d}" for number in range(options.first, options.first + options.robots)]
    with contextlib.ExitStack() as stack:
        directory = stack.enter_context(tempfile.TemporaryDirectory(prefix="sim-"))
        spoken = stack.enter_context(open(options.spoken, "a", 1, encoding="utf-8"))  # line by line
        asyncio.run(run(names, options.broker, directory, spoken))


if __name__ == "__main__":
    main()
