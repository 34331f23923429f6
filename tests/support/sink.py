"""A private sound server with one null sink, which plays in real time and records what it plays.

The sink runs at espeak-ng's own 22,050 Hz, one channel, 16 bit, so what is recorded is sample for sample what was made.
Nothing of the user's sound server is seen or touched: home, runtime directory and socket are in a directory of its own.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import threading
import time
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from tests.support.espeak import RATE
from tests.support.monitor import Monitor
from tests.support.recording import Recording
from tests.support.surroundings import clean_environment, dying_with_parent, needs, short_directory, stop_child

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

#: What a machine needs for a sink.
PROGRAMS = ("pulseaudio", "pactl", "parec", "pacat", "aplay")
_NAME = "null"
_NULL_SINK = ["module-null-sink", f"sink_name={_NAME}", f"rate={RATE}", "channels=1", "format=s16le"]
#: The first sound of a cold null sink comes 1 to 2 s late; all of a warm-up may take this many seconds.
_WARM_UP = 20.0
#: Blocks must have come steadily for so many seconds, with sound in them, before a sink is warm.
_STEADY = 0.5
_START = 10.0


def pactl(env: Mapping[str, str], *words: str) -> str:
    """Run pactl in an environment and return what it printed."""
    done = subprocess.run(["pactl", *words], env=env, capture_output=True, text=True, timeout=_START, check=False)
    if done.returncode != 0:
        raise AssertionError(f"pactl {' '.join(words)}: {done.stderr.strip()}")
    return done.stdout


class Sink(contextlib.AbstractContextManager["Sink"]):
    """A running sound server; `close()` or `with` ends all that it started and removes its directory."""

    def __init__(self) -> None:
        needs(*PROGRAMS)
        self._changed = threading.Condition(threading.RLock())
        self._taps: list[Recording] = []
        self._monitor: Monitor | None = None
        self._server: subprocess.Popen[bytes] | None = None
        self._module = ""
        with contextlib.ExitStack() as stack:
            self.directory = stack.enter_context(short_directory("sink-"))
            self.socket = f"{self.directory}/pulse.sock"
            self._write_settings()
            stack.callback(self._end)
            self.start_server()
            self._stack = stack.pop_all()

    def __exit__(self, *_error: object) -> None:
        self.close()

    def close(self) -> None:
        """End the sound server and remove its directory; a second time is nothing."""
        self._stack.close()

    @property
    def env(self) -> dict[str, str]:
        """The variables with which a child's aplay and pacat play into this sink."""
        return {
            "HOME": self.directory,
            "PULSE_SERVER": f"unix:{self.socket}",
            "PULSE_RUNTIME_PATH": self.directory,
            "PULSE_STATE_PATH": self.directory,
            "PULSE_COOKIE": f"{self.directory}/cookie",
            "PULSE_CLIENTCONFIG": f"{self.directory}/client.conf",
            "PIPEWIRE_RUNTIME_DIR": self.directory,
        }

    @property
    def pid(self) -> int:
        """Process id of the sound server."""
        return self._running().pid

    @contextlib.contextmanager
    def record(self) -> Iterator[Recording]:
        """Record what is played from now to the end of the block, the very last block played included."""
        recording = Recording(self._changed)
        with self._changed:
            self._taps.append(recording)
        try:
            yield recording
        finally:
            if self._monitor and self._monitor.running():
                recording.wait_until(time.monotonic() + 0.03)
            with self._changed:
                self._taps.remove(recording)

    def play(self, samples: npt.NDArray[np.int16]) -> None:
        """Play samples to their end."""
        command = ["aplay", "-q", "-t", "raw", "-f", "S16_LE", "-r", str(RATE), "-c", "1", "-"]
        subprocess.run(command, env=self._child(), input=samples.tobytes(), check=True, timeout=60)

    def suspend(self) -> None:
        """Suspend the sink: players' data is taken no more, nothing is heard."""
        self.pactl("suspend-sink", _NAME, "1")

    def resume(self) -> None:
        """Let a suspended sink go on."""
        self.pactl("suspend-sink", _NAME, "0")

    def unload(self) -> None:
        """Take the sink away, as if a device were unplugged: its streams are killed, there is no other sink."""
        self.pactl("unload-module", self._module)
        self._module = ""
        if self._monitor:
            self._monitor.close()
            self._monitor = None

    def reload(self, *, warm: bool = True) -> None:
        """Bring the sink back after `unload()`; a recording that is running goes on with it.

        One that is not `warm` is there at once, as a robot would find it: its first sound comes 1 to 2 s late.
        """
        self._module = self.pactl("load-module", *_NULL_SINK).strip()
        self._monitor = Monitor(self._child(), f"{_NAME}.monitor", self._taps, self._changed)
        if warm:
            self._warm_up()

    def freeze(self) -> None:
        """Stop the sound server as it is (SIGSTOP); it has stopped when this returns, with all its threads."""
        stop_child(self.pid)

    def thaw(self) -> None:
        """Let a frozen sound server go on (SIGCONT)."""
        self._running().send_signal(signal.SIGCONT)

    def kill_server(self) -> None:
        """Kill the sound server, as if it had crashed."""
        server = self._running()
        server.kill()
        server.wait()
        self._server = None
        if self._monitor:
            self._monitor.close()
            self._monitor = None

    def start_server(self, *, warm: bool = True) -> None:
        """Start the sound server and its sink, as `reload()` does; again after `kill_server()`."""
        with contextlib.suppress(FileNotFoundError):
            os.unlink(self.socket)
        options = ["-n", "--daemonize=no", "--exit-idle-time=-1", "--use-pid-file=no", "--disable-shm=yes"]
        native = f"module-native-protocol-unix auth-anonymous=1 auth-cookie-enabled=0 socket={self.socket}"
        with open(f"{self.directory}/log", "ab") as log:
            self._server = subprocess.Popen(
                dying_with_parent(["pulseaudio", *options, "--log-target=stderr", "--log-level=warn", "-L", native]),
                env=self._child() | {"XDG_RUNTIME_DIR": self.directory},
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )
        self._await_socket()
        self.reload(warm=warm)

    def _running(self) -> subprocess.Popen[bytes]:
        if self._server is None:
            raise RuntimeError("the sound server was killed, and not started again")
        return self._server

    def _child(self) -> dict[str, str]:
        return clean_environment(self.directory, self.env)

    def _write_settings(self) -> None:
        with open(f"{self.directory}/.asoundrc", "w", encoding="utf-8") as file:
            where = f'type pulse server "unix:{self.socket}"'
            file.write(f"pcm.!default {{ {where} }}\nctl.!default {{ {where} }}\n")
        with open(f"{self.directory}/client.conf", "w", encoding="utf-8") as file:
            file.write("autospawn = no\nenable-shm = no\n")

    def pactl(self, *words: str) -> str:
        """Run pactl and return what it printed."""
        return pactl(self._child(), *words)

    def _await_socket(self) -> None:
        end = time.monotonic() + _START
        while True:
            with socket.socket(socket.AF_UNIX) as probe, contextlib.suppress(OSError):
                probe.connect(self.socket)
                return
            if self._running().poll() is not None or time.monotonic() > end:
                with open(f"{self.directory}/log", encoding="utf-8", errors="replace") as log:
                    raise AssertionError(f"pulseaudio does not start: {log.read()}")
            time.sleep(0.01)  # it says nowhere when it begins to listen

    def _warm_up(self) -> None:
        """Play a tone until it is heard and blocks come in small and steadily; then wait until it is over."""
        tone = f"{self.directory}/tone"
        wave = 3000 * np.sin(np.arange(int(_WARM_UP * RATE)) * (2 * np.pi * 441 / RATE))
        with open(tone, "wb") as file:
            file.write(wave.astype("<i2").tobytes())
        command = ["pacat", "--raw", "--format=s16le", f"--rate={RATE}", "--channels=1", "--latency-msec=30", tone]
        with self.record() as recording:
            player = subprocess.Popen(dying_with_parent(command), env=self._child(), stderr=subprocess.DEVNULL)
            try:
                recording.wait_for_sound(_WARM_UP)
                with self._changed:
                    monitor = self._monitor
                    assert monitor
                    steady = self._changed.wait_for(lambda: monitor.steady_for() > _STEADY, _WARM_UP)
            finally:
                player.kill()
                player.wait()
            assert steady, f"the null sink does not render steadily within {_WARM_UP} s"
            recording.wait_until_quiet(0.2)

    def _end(self) -> None:
        if self._server is not None:
            self._server.kill()
            self._server.wait()
            self._server = None
        if self._monitor:
            self._monitor.close()
            self._monitor = None
