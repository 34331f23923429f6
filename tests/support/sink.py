"""A private sound server with one null sink, which plays in real time and records the sound.

The sink runs at espeak-ng's own 22,050 Hz, one channel, 16 bit, so the recording is the same sample for sample. Home,
runtime directory and socket are in a directory of its own, so the user's sound server is neither seen nor touched.
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
from tests.support.recording import Recording
from tests.support.surroundings import clean_environment, dying_with_parent, needs, short_directory, stop_child

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

#: The programs that a sink needs.
PROGRAMS = ("pulseaudio", "pactl", "parec", "pacat", "aplay")
_NAME = "null"
_NULL_SINK = ["module-null-sink", f"sink_name={_NAME}", f"rate={RATE}", "channels=1", "format=s16le"]
_RAW = ["--raw", "--format=s16le", f"--rate={RATE}", "--channels=1"]
#: The first sound of a cold null sink comes 1 to 2 s late; all of a warm-up may take this many seconds.
_WARM_UP = 20.0
#: Seconds of steady blocks, with sound in them, after which a sink is warm; and the longest time between such blocks.
_STEADY, _STEADY_GAP = 0.5, 0.08
_START = 10.0
#: Milliseconds that a distant sink is away.
LATENCY = 200


def pactl(env: Mapping[str, str], *words: str) -> str:
    """Run pactl in an environment and return its output."""
    done = subprocess.run(["pactl", *words], env=env, capture_output=True, text=True, timeout=_START, check=False)
    if done.returncode != 0:
        raise AssertionError(f"pactl {' '.join(words)}: {done.stderr.strip()}")
    return done.stdout


def _environment(directory: str) -> dict[str, str]:
    return {
        "HOME": directory,
        "PULSE_SERVER": f"unix:{directory}/pulse.sock",
        "PULSE_RUNTIME_PATH": directory,
        "PULSE_STATE_PATH": directory,
        "PULSE_COOKIE": f"{directory}/cookie",
    }


def _start_pulseaudio(directory: str, env: Mapping[str, str], *modules: str) -> subprocess.Popen[bytes]:
    """Start a PulseAudio that listens in a directory, and wait until it does."""
    path = f"{directory}/pulse.sock"
    with contextlib.suppress(FileNotFoundError):
        os.unlink(path)
    options = ["-n", "--daemonize=no", "--exit-idle-time=-1", "--use-pid-file=no", "--disable-shm=yes"]
    options += ["--log-target=stderr", "--log-level=warn"]
    for each in (*modules, f"module-native-protocol-unix auth-anonymous=1 auth-cookie-enabled=0 socket={path}"):
        options += ["-L", each]
    with open(f"{directory}/log", "ab") as log:
        server = subprocess.Popen(
            dying_with_parent(["pulseaudio", *options]),
            env=clean_environment(directory, {**env, "XDG_RUNTIME_DIR": directory}),
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
        )
    end = time.monotonic() + _START
    while True:
        with socket.socket(socket.AF_UNIX) as probe, contextlib.suppress(OSError):
            probe.connect(path)
            return server
        if server.poll() is not None or time.monotonic() > end:
            server.kill()
            server.wait()
            with open(f"{directory}/log", encoding="utf-8", errors="replace") as log:
                raise AssertionError(f"pulseaudio does not start: {log.read()}")
        time.sleep(0.01)  # a socket's appearance is no event


class Sink(contextlib.AbstractContextManager["Sink"]):
    """A running sound server; `close()` or `with` ends all its processes and removes its directory."""

    def __init__(self) -> None:
        needs(*PROGRAMS)
        self._changed = threading.Condition(threading.RLock())
        self._taps: list[Recording] = []
        self._monitor: _Monitor | None = None
        self._server: subprocess.Popen[bytes] | None = None
        self._module = ""
        with contextlib.ExitStack() as stack:
            self.directory = stack.enter_context(short_directory("sink-"))
            self.socket = f"{self.directory}/pulse.sock"
            where = f'type pulse server "unix:{self.socket}"'
            settings = {
                ".asoundrc": f"pcm.!default {{ {where} }}\nctl.!default {{ {where} }}\n",
                "client.conf": "autospawn = no\nenable-shm = no\n",
            }
            for name, text in settings.items():
                with open(f"{self.directory}/{name}", "w", encoding="utf-8") as file:
                    file.write(text)
            stack.callback(self._end)
            self.start_server()
            self._stack = stack.pop_all()

    def __exit__(self, *_error: object) -> None:
        self.close()

    def close(self) -> None:
        """End the sound server and remove its directory; closing twice is no error."""
        self._stack.close()

    @property
    def env(self) -> dict[str, str]:
        """The variables with which a child's aplay and pacat play into this sink."""
        return {
            **_environment(self.directory),
            "PULSE_CLIENTCONFIG": f"{self.directory}/client.conf",
            "PIPEWIRE_RUNTIME_DIR": self.directory,
        }

    @property
    def pid(self) -> int:
        """Process id of the sound server."""
        return self._running().pid

    @contextlib.contextmanager
    def record(self) -> Iterator[Recording]:
        """Record the sound from now to the end of the block, including the very last block played."""
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
        """Suspend the sink: it takes no more data from players, and nothing is heard."""
        self.pactl("suspend-sink", _NAME, "1")

    def resume(self) -> None:
        """Let a suspended sink go on."""
        self.pactl("suspend-sink", _NAME, "0")

    def unload(self) -> None:
        """Take the sink away, as if a device were unplugged: its streams are killed, there is no other sink."""
        self.pactl("unload-module", self._module)
        self._module = ""
        self._end_monitor()

    def reload(self, *, warm: bool = True) -> None:
        """Bring the sink back after `unload()`; a running recording goes on with it.

        The first sound of a sink that is not `warm` comes 1 to 2 s late, as on a robot.
        """
        self._module = self.pactl("load-module", *_NULL_SINK).strip()
        self._monitor = _Monitor(self._child(), self._taps, self._changed)
        if warm:
            self._warm_up()

    def freeze(self) -> None:
        """Stop the sound server (SIGSTOP); all its threads have stopped when this returns."""
        stop_child(self.pid)

    def thaw(self) -> None:
        """Let a frozen sound server go on (SIGCONT)."""
        self._running().send_signal(signal.SIGCONT)

    def kill_server(self) -> None:
        """Kill the sound server, as if it had crashed."""
        self._running()
        self._end()

    def start_server(self, *, warm: bool = True) -> None:
        """Start the sound server and its sink, as `reload()` does; again after `kill_server()`."""
        self._server = _start_pulseaudio(self.directory, self.env)
        self.reload(warm=warm)

    def pactl(self, *words: str) -> str:
        """Run pactl and return its output."""
        return pactl(self._child(), *words)

    def _running(self) -> subprocess.Popen[bytes]:
        if self._server is None:
            raise RuntimeError("the sound server was killed, and not started again")
        return self._server

    def _child(self) -> dict[str, str]:
        return clean_environment(self.directory, self.env)

    def _warm_up(self) -> None:
        """Play a tone until it is heard and blocks come in small and steadily; then wait until it is over."""
        tone = f"{self.directory}/tone"
        wave = 3000 * np.sin(np.arange(int(_WARM_UP * RATE)) * (2 * np.pi * 441 / RATE))
        with open(tone, "wb") as file:
            file.write(wave.astype("<i2").tobytes())
        command = dying_with_parent(["pacat", *_RAW, "--latency-msec=30", tone])
        with self.record() as recording:
            player = subprocess.Popen(command, env=self._child(), stderr=subprocess.DEVNULL)
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
        self._end_monitor()

    def _end_monitor(self) -> None:
        if self._monitor:
            self._monitor.close()
            self._monitor = None


class _Monitor:
    """A `parec` at the sink's monitor and the thread that reads it into the recordings, as long as the sink exists.

    A null sink renders in blocks of two seconds unless a client records with low latency, so this one stays attached.
    """

    def __init__(self, env: dict[str, str], taps: list[Recording], changed: threading.Condition) -> None:
        self._parec = subprocess.Popen(
            dying_with_parent(["parec", "-d", f"{_NAME}.monitor", *_RAW, "--latency-msec=10"]),
            env=env,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            bufsize=0,
        )
        self._taps = taps
        self._changed = changed
        self._steady_since = 0.0
        self._last = 0.0
        self._thread = threading.Thread(target=self._read, name="monitor", daemon=True)
        self._thread.start()

    def steady_for(self) -> float:
        """Return for how many seconds, up to the last block, blocks have arrived without a gap."""
        return self._last - self._steady_since if self._last else 0.0

    def running(self) -> bool:
        """Return whether it still reads; it ends with its sink."""
        return self._thread.is_alive()

    def close(self) -> None:
        """End the reader; the recordings keep the sound."""
        self._parec.kill()
        self._parec.wait()
        self._thread.join()
        if self._parec.stdout:
            self._parec.stdout.close()

    def _read(self) -> None:
        assert self._parec.stdout
        odd = b""
        while data := os.read(self._parec.stdout.fileno(), 65536):
            arrived = time.monotonic()
            data = odd + data
            even = len(data) // 2 * 2
            block, odd = np.frombuffer(data[:even], dtype="<i2").astype(np.int16), data[even:]
            with self._changed:
                if arrived - self._last > _STEADY_GAP:
                    self._steady_since = arrived
                self._last = arrived
                for tap in self._taps:
                    tap.add(block, arrived)
                self._changed.notify_all()


class DistantSink(contextlib.AbstractContextManager["DistantSink"]):
    """A second PulseAudio, 200 ms away from a sink, as loudspeakers by Bluetooth are: a tunnel to it."""

    def __init__(self, sink: Sink) -> None:
        with contextlib.ExitStack() as stack:
            self.directory = stack.enter_context(short_directory("distant-"))
            self.env = {**sink.env, **_environment(self.directory)}
            tunnel = f"module-tunnel-sink server=unix:{sink.socket} sink={_NAME} latency_msec={LATENCY}"
            server = _start_pulseaudio(self.directory, self.env, tunnel)
            stack.callback(server.wait)
            stack.callback(server.kill)
            self._stack = stack.pop_all()

    def __exit__(self, *_error: object) -> None:
        self._stack.close()
