"""A private PipeWire with a PulseAudio server and a session manager, but without sound cards.

Its only output is a dummy until `load` adds a sink that counts as a device.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from typing import TYPE_CHECKING

from tests.support.resources import Resource
from tests.support.sink import pactl
from tests.support.surroundings import clean_environment, dying_with_parent, needs, short_directory, stop_child

if TYPE_CHECKING:
    from collections.abc import Callable

#: The programs that it needs. wireplumber needs a message bus.
PROGRAMS = ("pipewire", "pipewire-pulse", "wireplumber", "dbus-daemon", "pactl")
#: Time for a start, or for a change of the default sink.
_LIMIT_S = 20.0


class PipeWire(Resource):
    """A running PipeWire. `with` ends all its processes and removes its directory."""

    def __init__(self) -> None:
        needs(*PROGRAMS)
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        with contextlib.ExitStack() as stack:
            self.directory = stack.enter_context(short_directory("pipewire-"))
            self.socket = f"{self.directory}/pulse/native"
            bus = f"{self.directory}/bus"
            self.env = {
                "HOME": self.directory,
                "XDG_RUNTIME_DIR": self.directory,
                "PIPEWIRE_RUNTIME_DIR": self.directory,
                "PULSE_RUNTIME_PATH": f"{self.directory}/pulse",
                "PULSE_SERVER": f"unix:{self.socket}",
                "DBUS_SESSION_BUS_ADDRESS": f"unix:path={bus}",
            }
            stack.callback(self._end)
            self._start("dbus-daemon", "--session", "--nofork", "--nopidfile", f"--address=unix:path={bus}")
            self._await("the message bus", lambda: os.path.exists(bus))
            self._start("pipewire")
            self._await("the socket", lambda: os.path.exists(f"{self.directory}/pipewire-0"))
            self._start("wireplumber")
            self._start("pipewire-pulse")
            self._await("a sink", lambda: os.path.exists(self.socket) and self._default() not in {"", "@DEFAULT_SINK@"})
            self._stack = stack.pop_all()

    def load(self, name: str) -> str:
        """Add a sink that isn't a dummy, wait until it is the default, and return its module."""
        module = self.pactl("load-module", "module-null-sink", f"sink_name={name}", "rate=22050", "channels=1").strip()
        self.pactl("set-default-sink", name)
        self._await(f"the sink {name}", lambda: self._default() == name)
        return module

    def freeze(self, program: str = "pipewire-pulse") -> None:
        """Stop one of its processes (SIGSTOP), and wait until all threads have stopped."""
        stop_child(self._running[program].pid)

    def thaw(self, program: str = "pipewire-pulse") -> None:
        """Continue a stopped process (SIGCONT)."""
        self._running[program].send_signal(signal.SIGCONT)

    def pactl(self, *arguments: str) -> str:
        return pactl(clean_environment(self.directory, self.env), *arguments)

    def _default(self) -> str:
        with contextlib.suppress(AssertionError):
            for line in self.pactl("info").splitlines():
                if line.startswith("Default Sink: "):
                    return line.removeprefix("Default Sink: ")
        return ""

    def _start(self, *command: str) -> None:
        env = clean_environment(self.directory, self.env)
        with open(f"{self.directory}/log", "ab") as log:
            self._running[command[0]] = subprocess.Popen(
                dying_with_parent(list(command)), env=env, stdin=subprocess.DEVNULL, stdout=log, stderr=log
            )

    def _await(self, name: str, exists: Callable[[], bool]) -> None:
        end = time.monotonic() + _LIMIT_S
        while not exists():
            if time.monotonic() > end or any(process.poll() is not None for process in self._running.values()):
                raise AssertionError(f"PipeWire: {name} is missing: {self.log}")
            time.sleep(0.02)  # PipeWire sends no event

    def _end(self) -> None:
        for process in reversed(self._running.values()):
            process.kill()
            process.wait()
