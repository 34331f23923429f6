"""Reads a null sink's monitor as it plays, without a pause, for as long as the sink is there.

A null sink that nobody records with low latency renders in blocks of two seconds, so one reader stays attached from
the start, and a recording is only a tap on it.
"""

from __future__ import annotations

import os
import subprocess
import threading
import time
from typing import TYPE_CHECKING

import numpy as np

from tests.support.espeak import RATE
from tests.support.surroundings import dying_with_parent

if TYPE_CHECKING:
    from tests.support.recording import Recording

#: Seconds between two blocks at most, for the sink to count as rendering in small blocks.
_STEADY_GAP = 0.08


class Monitor:
    """A `parec` and the thread that reads it into the recordings of `taps`."""

    def __init__(self, env: dict[str, str], source: str, taps: list[Recording], changed: threading.Condition) -> None:
        command = ["parec", "-d", source, "--raw", "--format=s16le", f"--rate={RATE}", "--channels=1"]
        self._parec = subprocess.Popen(
            dying_with_parent([*command, "--latency-msec=10"]),
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
        """Return whether it still reads; it ends when its sink is unloaded or the sound server is gone."""
        return self._thread.is_alive()

    def close(self) -> None:
        """End the reader; what it read so far is in the recordings."""
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
