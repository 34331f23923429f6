"""A sound server whose only output is 200 ms away, as loudspeakers by Bluetooth are: a tunnel to a recorded sink."""

from __future__ import annotations

import contextlib
import os
import subprocess
import time
from typing import TYPE_CHECKING

from tests.support.surroundings import clean_environment, dying_with_parent, needs, short_directory

if TYPE_CHECKING:
    from tests.support.sink import Sink

#: Milliseconds from what this server takes to what is heard at the other.
LATENCY = 200
#: Seconds in which it must have started.
_START = 10.0


class DistantSink(contextlib.AbstractContextManager["DistantSink"]):
    """A second PulseAudio; what is played to it is heard at `sink`, later."""

    def __init__(self, sink: Sink) -> None:
        needs("pulseaudio")
        with contextlib.ExitStack() as stack:
            self.directory = stack.enter_context(short_directory("distant-"))
            self._sink = sink
            socket = f"{self.directory}/s"
            options = ["-n", "--daemonize=no", "--exit-idle-time=-1", "--use-pid-file=no", "--disable-shm=yes"]
            native = f"module-native-protocol-unix auth-anonymous=1 auth-cookie-enabled=0 socket={socket}"
            tunnel = f"module-tunnel-sink server=unix:{sink.socket} sink=null sink_name=distant latency_msec={LATENCY}"
            server = subprocess.Popen(
                dying_with_parent(["pulseaudio", *options, "--log-level=error", "-L", tunnel, "-L", native]),
                env=clean_environment(self.directory, self.env | {"XDG_RUNTIME_DIR": self.directory}),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            stack.callback(server.wait)
            stack.callback(server.kill)
            end = time.monotonic() + _START
            while not os.path.exists(socket):
                if server.poll() is not None or time.monotonic() > end:
                    raise AssertionError("the second pulseaudio does not start")
                time.sleep(0.01)  # it says nowhere when it begins to listen
            self._stack = stack.pop_all()

    def __exit__(self, *_error: object) -> None:
        self._stack.close()

    @property
    def env(self) -> dict[str, str]:
        """The variables with which a child plays to it."""
        return {
            **self._sink.env,
            "HOME": self.directory,
            "PULSE_SERVER": f"unix:{self.directory}/s",
            "PULSE_RUNTIME_PATH": self.directory,
            "PULSE_STATE_PATH": self.directory,
            "PULSE_COOKIE": f"{self.directory}/cookie",
        }
