"""The samples that a sink has played, and the time at which each of them was heard.

A thread reads the sink's monitor and fills the recording, and the test reads the recording. Times are monotonic, and
as precise as one block of the monitor (10 ms). A block can be late, but never early, so the time of a sample is the
earliest time that the blocks after it allow.
"""

from __future__ import annotations

import bisect
from typing import TYPE_CHECKING

import numpy as np

from tests.support.espeak import RATE

if TYPE_CHECKING:
    import threading

    import numpy.typing as npt

    Samples = npt.NDArray[np.int16]

#: Louder samples are sound. espeak-ng's pauses are quieter, and the silence of a null sink is zero.
LOUD = 50
#: Length of the blocks that determine the time of a sample.
_WINDOW_S = 0.25
#: Time limit until a sink is quiet.
_QUIET_WITHIN_S = 30


class Recording:
    """The samples of a sink's monitor since `Sink.record()`. It can be read while it grows."""

    def __init__(self, changed: threading.Condition) -> None:
        self._changed = changed
        self._blocks: list[Samples] = []
        self._ends: list[int] = []  # total number of samples at the end of each block
        self._times: list[float] = []  # time of arrival of each block
        self._first_loud: int | None = None
        self._last_loud: int | None = None

    def add(self, block: Samples, arrived: float) -> None:
        """Add a block of the monitor. The caller must hold the condition and notify."""
        start = len(self)
        self._blocks.append(block)
        self._ends.append(start + len(block))
        self._times.append(arrived)
        loud = _loud(block)
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
        return self.samples[self.sample_at(start) : self.sample_at(end)]

    def time_of(self, sample: int) -> float:
        """Return the time at which a sample was heard. Negative samples are before the recording."""
        with self._changed:
            first = bisect.bisect_right(self._ends, sample)
            if first == len(self._ends):
                raise IndexError(f"sample {sample} of {len(self)}")
            last = bisect.bisect_right(self._times, self._times[first] + _WINDOW_S)
            return min(self._times[at] - (self._ends[at] - sample) / RATE for at in range(first, last))

    def sample_at(self, moment: float) -> int:
        """Return the first sample at or after a time, or the length of the recording."""
        return bisect.bisect_left(range(len(self)), moment, key=self.time_of)

    def first_sound(self) -> float | None:
        """Return the time of the first sound, or None if nothing was heard."""
        return None if self._first_loud is None else self.time_of(self._first_loud)

    def last_sound(self) -> float | None:
        """Return the time of the last sound so far, or None if nothing was heard."""
        return None if self._last_loud is None else self.time_of(self._last_loud)

    def wait_for_sound(self, timeout: float = 10) -> float:
        """Return the time of the first sound that arrives after this call, or raise TimeoutError."""
        with self._changed:
            start = len(self)
            if not self._changed.wait_for(lambda: self._last_loud is not None and self._last_loud >= start, timeout):
                raise TimeoutError(f"nothing was heard within {timeout} s")
            return self.time_of(start + int(_loud(np.concatenate(self._blocks)[start:])[0]))

    def wait_until_quiet(self, quiet: float = 0.5) -> float | None:
        """Wait for `quiet` seconds of silence after this call, and return the time of the last sound.

        Silence is counted in samples. A suspended sink sends no samples, so the call raises TimeoutError.
        """
        with self._changed:
            start = len(self)
            if not self._changed.wait_for(
                lambda: len(self) - max(start, (self._last_loud or 0) + 1) >= quiet * RATE, _QUIET_WITHIN_S
            ):
                raise TimeoutError(
                    f"not quiet for {quiet} s within {_QUIET_WITHIN_S} s ({len(self) - start} samples came)"
                )
            return self.last_sound()

    def wait_until(self, moment: float, timeout: float = 1) -> bool:
        """Wait until the samples up to a time have arrived, and return False on a timeout."""
        with self._changed:
            return self._changed.wait_for(lambda: bool(self._times) and self._times[-1] >= moment, timeout)


def _loud(samples: Samples) -> npt.NDArray[np.intp]:
    return np.flatnonzero(np.abs(samples.astype(np.int32)) > LOUD)
