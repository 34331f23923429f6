"""A private sound server with one null sink, which plays in real time and is recorded.

The sink has espeak-ng's format (22,050 Hz, one channel, 16 bit), so the samples aren't changed. Its home, runtime
directory and socket are in a private directory, so the user's sound server isn't used.
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
from tests.support.resources import Resource
from tests.support.surroundings import clean_environment, dying_with_parent, needs, short_directory, stop_child

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

#: The programs that a sink needs.
PROGRAMS = ("pulseaudio", "pactl", "parec", "pacat", "aplay")
_NAME = "null"
_NULL_SINK = ["module-null-sink", f"sink_name={_NAME}", f"rate={RATE}", "channels=1", "format=s16le"]
_RAW = ["--raw", "--format=s16le", f"--rate={RATE}", "--channels=1"]
#: Time limit of a warm-up, in seconds. The first sound of a new null sink is 1 to 2 s late.
_WARM_UP = 20.0
#: A sink is warm after it has sent blocks for this time (in seconds) without longer gaps.
_STEADY, _STEADY_GAP = 0.5, 0.08
_LIMIT_S = 10.0
#: Delay of a distant sink in milliseconds.
LATENCY = 200


def pactl(env: Mapping[str, str], *arguments: str) -> str:
    """Run pactl in an environment and return its output."""
    done = subprocess.run(["pactl", *arguments], env=env, capture_output=True, text=True, timeout=_LIMIT_S, check=False)
    if done.returncode != 0:
        raise AssertionError(f"pactl {' '.join(arguments)}: {done.stderr.strip()}")
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
    """Start PulseAudio with its socket in a directory, and wait until it listens."""
    path = f"{directory}/pulse.sock"
    with contextlib.suppress(FileNotFoundError):
        os.unlink(path)
    options = ["-n", "--daemonize=no", "--exit-idle-time=-1", "--use-pid-file=no", "--disable-shm=yes"]
    options += ["--log-target=stderr", "--log-level=warn"]
    for module in (*modules, f"module-native-protocol-unix auth-anonymous=1 auth-cookie-enabled=0 socket={path}"):
        options += ["-L", module]
    with open(f"{directory}/log", "ab") as log:
        server = subprocess.Popen(
            dying_with_parent(["pulseaudio", *options]),
            env=clean_environment(directory, {**env, "XDG_RUNTIME_DIR": directory}),
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
        )
    end = time.monotonic() + _LIMIT_S
    while True:
        with socket.socket(socket.AF_UNIX) as probe, contextlib.suppress(OSError):
            probe.connect(path)
            return server
        if server.poll() is not None or time.monotonic() > end:
            server.kill()
            server.wait()
            with open(f"{directory}/log", encoding="utf-8", errors="replace") as log:
                raise AssertionError(f"pulseaudio does not start: {log.read()}")
        time.sleep(0.01)  # a new socket sends no event


class Sink(Resource):
    """A running sound server."""

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
            server = f'type pulse server "unix:{self.socket}"'
            settings = {
                ".asoundrc": f"pcm.!default {{ {server} }}\nctl.!default {{ {server} }}\n",
                "client.conf": "autospawn = no\nenable-shm = no\n",
            }
            for name, text in settings.items():
                with open(f"{self.directory}/{name}", "w", encoding="utf-8") as file:
                    file.write(text)
            stack.callback(self._end)
            self.start_server()
            self._stack = stack.pop_all()

    @property
    def env(self) -> dict[str, str]:
        """The variables that make aplay and pacat play to this sink."""
        return {
            **_environment(self.directory),
            "PULSE_CLIENTCONFIG": f"{self.directory}/client.conf",
            "PIPEWIRE_RUNTIME_DIR": self.directory,
        }

    @property
    def pid(self) -> int:
        return self._running().pid

    @contextlib.contextmanager
    def record(self) -> Iterator[Recording]:
        """Record the sound until the end of the `with` block, including the last block of the sink."""
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
        command = ["aplay", "-q", "-t", "raw", "-f", "S16_LE", "-r", str(RATE), "-c", "1", "-"]
        subprocess.run(command, env=self._child_env(), input=samples.tobytes(), check=True, timeout=60)

    def suspend(self) -> None:
        """Suspend the sink. It accepts no data from players, and nothing is heard."""
        self.pactl("suspend-sink", _NAME, "1")

    def resume(self) -> None:
        self.pactl("suspend-sink", _NAME, "0")

    def unload(self) -> None:
        """Remove the sink as if a device were unplugged. Its streams are killed, and there is no other sink."""
        self.pactl("unload-module", self._module)
        self._module = ""
        self._end_monitor()

    def reload(self, *, warm: bool = True) -> None:
        """Load the sink again after `unload()`. Recordings continue.

        If it isn't `warm`, its first sound is 1 to 2 s late, as on a robot.
        """
        self._module = self.pactl("load-module", *_NULL_SINK).strip()
        self._monitor = _Monitor(self._child_env(), self._taps, self._changed)
        if warm:
            self._warm_up()

    def freeze(self) -> None:
        """Stop the sound server (SIGSTOP), and wait until all its threads have stopped."""
        stop_child(self.pid)

    def thaw(self) -> None:
        """Continue the sound server (SIGCONT)."""
        self._running().send_signal(signal.SIGCONT)

    def kill_server(self) -> None:
        """Kill the sound server as if it had crashed."""
        self._running()
        self._end()

    def start_server(self, *, warm: bool = True) -> None:
        """Start the sound server and its sink, also after `kill_server()`. See `reload()` for `warm`."""
        self._server = _start_pulseaudio(self.directory, self.env)
        self.reload(warm=warm)

    def pactl(self, *arguments: str) -> str:
        return pactl(self._child_env(), *arguments)

    def _running(self) -> subprocess.Popen[bytes]:
        if self._server is None:
            raise RuntimeError("the sound server was killed and not restarted")
        return self._server

    def _child_env(self) -> dict[str, str]:
        return clean_environment(self.directory, self.env)

    def _warm_up(self) -> None:
        """Play a tone until it is heard and the monitor sends small blocks steadily. Then wait for silence.

        The sink has already begun a block of two seconds, which it drops when it is suspended.
        """
        end = time.monotonic() + _LIMIT_S
        while not self.pactl("list", "short", "source-outputs"):
            assert time.monotonic() < end, f"the monitor is not connected within {_LIMIT_S} s"
        self.suspend()
        self.resume()
        tone = f"{self.directory}/tone"
        wave = 3000 * np.sin(np.arange(int(_WARM_UP * RATE)) * (2 * np.pi * 441 / RATE))
        with open(tone, "wb") as file:
            file.write(wave.astype("<i2").tobytes())
        command = dying_with_parent(["pacat", *_RAW, "--latency-msec=30", tone])
        with self.record() as recording:
            player = subprocess.Popen(command, env=self._child_env(), stderr=subprocess.DEVNULL)
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
    """A `parec` at the sink's monitor, and a thread that adds its samples to the recordings until the sink is removed.

    It runs all the time: a null sink renders blocks of two seconds unless a client records with a low latency.
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
        """Return the seconds, up to the last block, in which blocks have arrived without a gap."""
        return self._last - self._steady_since if self._last else 0.0

    def running(self) -> bool:
        """Return whether the thread still runs. It ends with the sink."""
        return self._thread.is_alive()

    def close(self) -> None:
        """End the thread. The recordings keep their samples."""
        self._parec.kill()
        self._parec.wait()
        self._thread.join()
        if self._parec.stdout:
            self._parec.stdout.close()

    def _read(self) -> None:
        assert self._parec.stdout
        rest = b""
        while data := os.read(self._parec.stdout.fileno(), 65536):
            arrived = time.monotonic()
            data = rest + data
            even = len(data) // 2 * 2
            block, rest = np.frombuffer(data[:even], dtype="<i2").astype(np.int16), data[even:]
            with self._changed:
                if arrived - self._last > _STEADY_GAP:
                    self._steady_since = arrived
                self._last = arrived
                for tap in self._taps:
                    tap.add(block, arrived)
                self._changed.notify_all()


class DistantSink(Resource):
    """A second PulseAudio with a tunnel to a sink, which delays the sound by 200 ms, like Bluetooth loudspeakers."""

    def __init__(self, sink: Sink) -> None:
        with contextlib.ExitStack() as stack:
            self.directory = stack.enter_context(short_directory("distant-"))
            self.env = {**sink.env, **_environment(self.directory)}
            tunnel = f"module-tunnel-sink server=unix:{sink.socket} sink={_NAME} latency_msec={LATENCY}"
            server = _start_pulseaudio(self.directory, self.env, tunnel)
            stack.callback(server.wait)
            stack.callback(server.kill)
            self._stack = stack.pop_all()
