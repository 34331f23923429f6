"""What was heard in a while: samples, and when each of them was heard.

A recording is filled by the thread that reads the sink's monitor and read by the test. Its times are of the monotonic
clock, good to about one block of the monitor (10 ms): a block cannot arrive before it was played, only later, so the
earliest of the blocks that follow a sample tells when it was.
"""

from __future__ import annotations

import bisect
import time
from typing import TYPE_CHECKING

import numpy as np

from tests.support.espeak import RATE

if TYPE_CHECKING:
    import threading

    import numpy.typing as npt

    Samples = npt.NDArray[np.int16]

#: Above this a sample is sound: espeak-ng's own pause after a sentence stays below it, a null sink's silence is zero.
LOUD = 50
#: Seconds of blocks, from a sample's own onwards, among which the one that arrived earliest tells the sample's time.
_WINDOW = 0.25


class Recording:
    """Samples of a sink's monitor from `Sink.record()` on; every method may be called while it is still running."""

    def __init__(self, changed: threading.Condition) -> None:
        #: monotonic time at which the recording began
        self.began = time.monotonic()
        self._changed = changed
        self._blocks: list[Samples] = []
        self._ends: list[int] = []  # number of samples up to and including each block
        self._times: list[float] = []  # arrival of each block
        self._first_loud: int | None = None
        self._last_loud: int | None = None

    def add(self, block: Samples, arrived: float) -> None:
        """Take a block from the monitor; the caller holds the condition and notifies."""
        start = len(self)
        self._blocks.append(block)
        self._ends.append(start + len(block))
        self._times.append(arrived)
        loud = np.flatnonzero(np.abs(block.astype(np.int32)) > LOUD)
        if len(loud):
            self._last_loud = start + int(loud[-1])
            if self._first_loud is None:
                self._first_loud = start + int(loud[0])

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    @property
    def samples(self) -> Samples:
        """A copy of all samples so far."""
        with self._changed:
            return np.concatenate([np.zeros(0, np.int16), *self._blocks])

    def between(self, start: float, end: float) -> Samples:
        """Return the samples heard between two monotonic times."""
        samples = self.samples
        return samples[self.sample_at(start) : self.sample_at(end)]

    def time_of(self, sample: int) -> float:
        """Return the monotonic time at which a sample was heard; a negative one is that many before the recording."""
        with self._changed:
            block = bisect.bisect_right(self._ends, sample)
            if block == len(self._ends):
                raise IndexError(f"sample {sample} of {len(self)}")
            until = self._times[block] + _WINDOW
            candidates = []
            while block < len(self._ends) and self._times[block] <= until:
                candidates.append(self._times[block] - (self._ends[block] - sample) / RATE)
                block += 1
            return min(candidates)

    def sample_at(self, moment: float) -> int:
        """Return the first sample heard at or after a monotonic time; the recording's length if none was yet."""
        low, high = 0, len(self)
        while low < high:
            middle = (low + high) // 2
            if self.time_of(middle) < moment:
                low = middle + 1
            else:
                high = middle
        return low

    def first_sound(self) -> float | None:
        """Return the monotonic time of the first sample that is sound, or None if nothing was heard."""
        return None if self._first_loud is None else self.time_of(self._first_loud)

    def last_sound(self) -> float | None:
        """Return the monotonic time of the last sample that is sound so far, or None if nothing was heard."""
        return None if self._last_loud is None else self.time_of(self._last_loud)

    def wait_for_sound(self, timeout: float = 10) -> float:
        """Wait until something new is heard, and return the monotonic time of its first sample.

        New is what arrives after this call. TimeoutError if that takes longer than `timeout` seconds.
        """
        with self._changed:
            start = len(self)
            if not self._changed.wait_for(lambda: self._last_loud is not None and self._last_loud >= start, timeout):
                raise TimeoutError(f"nothing was heard within {timeout} s")
            heard = np.concatenate([*self._blocks])[start:]
            return self.time_of(start + int(np.flatnonzero(np.abs(heard.astype(np.int32)) > LOUD)[0]))

    def wait_until_quiet(self, quiet: float = 0.5, timeout: float = 30) -> float | None:
        """Wait until nothing was heard for `quiet` seconds, counted from this call at the earliest.

        Returns the monotonic time of the last sound, None if there was none. It is counted in samples, so a sink that
        is suspended or frozen is never quiet: TimeoutError after `timeout` seconds.
        """
        with self._changed:
            start = len(self)
            if not self._changed.wait_for(
                lambda: len(self) - max(start, (self._last_loud or 0) + 1) >= quiet * RATE, timeout
            ):
                raise TimeoutError(f"not quiet for {quiet} s within {timeout} s, of which {len(self) - start} samples")
            return self.last_sound()

    def wait_until(self, moment: float, timeout: float = 1) -> bool:
        """Wait until what was heard up to a monotonic time has arrived; False if the sink gave nothing that late."""
        with self._changed:
            return self._changed.wait_for(lambda: bool(self._times) and self._times[-1] >= moment, timeout)
