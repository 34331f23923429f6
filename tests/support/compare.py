"""Compares what was heard with reference renderings, sample by sample, ends included.

Two traps decide how. A correlation over a whole sentence hardly sees a short last word that was cut, so that the worst
of its tenths of a second counts as well, and where the sound ends. And the monitor drops up to 41 samples where a
stream starts and after an underrun, so that each tenth may sit a little beside its place.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tests.support.espeak import RATE
from tests.support.recording import LOUD, Recording

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    Samples = npt.NDArray[np.int16]
    Floats = npt.NDArray[np.float64]

#: The right sentence has 1.0, one with another word about 0.4.
SAME = 0.95
#: The worst tenth of a second of the right sentence has 1.0; of one with a word cut or changed, less than this.
SAME_PART = 0.8
#: Seconds by which the extent of the right sound may differ: what the monitor drops, and a block of silence.
EXTENT = 0.02
_PART = RATE // 10
#: Samples by which a part may sit beside its place.
_SLACK = 48
#: Samples by which a quarter of a second may come later, where a player ran dry before it.
_NEARBY = RATE // 20
#: Samples that the monitor may lose where a stream starts: up to 211 were seen to be.
_LOST = 256


@dataclass(frozen=True, slots=True)
class Comparison:
    """How a sound that was heard resembles a reference."""

    correlation: float  # normalised, over all of the reference; 1.0 is the same
    worst: float  # the same of its worst tenth of a second that is sound
    offset: int  # sample of the recording at which the reference's first sound is
    heard: float  # seconds from the first to the last sample that is sound
    expected: float  # the same of the reference

    @property
    def same(self) -> bool:
        """Whether it is this sentence, whole, and nothing more."""
        return self.correlation >= SAME and self.worst >= SAME_PART and abs(self.heard - self.expected) <= EXTENT


def extent(samples: Samples, loud: int = LOUD) -> tuple[int, int] | None:
    """Return the first sample that is sound and the one after the last; None if there is no sound."""
    found = np.flatnonzero(np.abs(samples.astype(np.int32)) > loud)
    return (int(found[0]), int(found[-1]) + 1) if len(found) else None


def compare(heard: Recording | Samples, reference: Samples) -> Comparison:
    """Compare all that was heard with one reference, aligned where they resemble each other most."""
    samples = heard.samples if isinstance(heard, Recording) else heard
    wanted = _sound(reference)
    found = extent(samples)
    if found is None:
        return Comparison(0.0, 0.0, 0, 0.0, len(wanted) / RATE)
    offset = _align(samples.astype(np.float64), wanted)
    return _at(samples, wanted, offset, (found[1] - found[0]) / RATE)


def assert_heard(heard: Recording | Samples, references: Sequence[Samples]) -> list[Comparison]:
    """Assert that these references were heard whole, in order, each once, with nothing but silence beside them.

    Returns how each compares. A pause that ends a sentence may have been cut short, never a sample that is sound.
    """
    samples = heard.samples if isinstance(heard, Recording) else heard
    result: list[Comparison] = []
    cursor = 0
    for number, reference in enumerate(references, 1):
        wanted = _sound(reference)
        found = extent(samples[cursor:])
        assert found is not None, f"sentence {number} of {len(references)} was not heard: {_told(samples, result)}"
        start = cursor + found[0]
        # What is between two sentences is silence, so this one's sound begins where the next sound does.
        nearby = samples[max(0, start - _LOST) : start + len(wanted) + _SLACK].astype(np.float64)
        offset = max(0, start - _LOST) + _align(nearby, wanted, _LOST + _SLACK)
        cursor = min(len(samples), offset + len(wanted) + _SLACK)
        inside = extent(samples[max(0, offset - _SLACK) : cursor])
        length = (inside[1] - inside[0]) / RATE if inside else 0.0
        each = _at(samples, wanted, offset, length)
        assert each.same, f"sentence {number} of {len(references)} was not heard as it should: {_told(samples, [each])}"
        result.append(each)
    assert extent(samples[cursor:]) is None, (
        f"more was heard than {len(references)} sentences: {_told(samples[cursor:], [])}"
    )
    return result


def assert_begun(heard: Recording | Samples, reference: Samples, shortest: float = 0.1) -> float:
    """Assert that a beginning of the reference was heard, and nothing else; return its seconds.

    For a sentence that was stopped: what was heard of it, at least `shortest` seconds, is the same as the reference.
    """
    samples = heard.samples if isinstance(heard, Recording) else heard
    found = extent(samples)
    assert found is not None, "nothing was heard"
    seconds = (found[1] - found[0]) / RATE
    assert seconds >= shortest, f"only {seconds:.3f} s were heard"
    wanted = _sound(reference)
    assert found[1] - found[0] <= len(wanted) + _SLACK, f"more was heard than the sentence: {_told(samples, [])}"
    assert_heard(samples, [wanted[: found[1] - found[0]]])
    return seconds


def assert_resumed(heard: Recording | Samples, reference: Samples, pause: float, twice: float = 0.0) -> float:
    """Assert that the reference was heard whole, held once in its middle for at least `pause` seconds.

    Nothing of it may be missing, and at most `twice` seconds may have been said again after the pause. Returns for how
    many seconds it was held.
    """
    samples = heard.samples if isinstance(heard, Recording) else heard
    loud = np.flatnonzero(np.abs(samples.astype(np.int32)) > LOUD)
    assert len(loud) > 1, f"no sentence was heard: {_told(samples, [])}"
    gap = int(np.argmax(np.diff(loud)))
    first, second = samples[loud[0] : loud[gap] + 1], samples[loud[gap + 1] : loud[-1] + 1]
    held = float(loud[gap + 1] - loud[gap]) / RATE
    assert held >= pause, f"held for {held:.3f} s: {_told(samples, [])}"
    wanted = _sound(reference)
    assert max(len(first), len(second)) <= len(wanted), f"more was heard than the sentence: {_told(samples, [])}"
    assert_heard(first, [wanted[: len(first)]])
    assert_heard(second, [wanted[-len(second) :]])
    missing = wanted[len(first) + _SLACK : -len(second) - _SLACK]
    assert extent(missing) is None, f"{len(missing) / RATE:.3f} s at the pause were never heard"
    again = (len(first) + len(second) - len(wanted)) / RATE
    assert again <= twice + _SLACK / RATE, f"{again:.3f} s at the pause were heard twice"
    return held


def time_heard(recording: Recording, compared: Comparison, reference: Samples, position: float) -> float:
    """Return the monotonic time at which a position of the reference, in seconds from its start, was heard."""
    found = extent(reference)
    assert found is not None, "the reference is silence"
    return recording.time_of(compared.offset - found[0] + round(position * RATE))


def alike(heard: Recording | Samples, reference: Samples) -> float:
    """Return how a sound resembles a reference quarter second by quarter second, each where it resembles most nearby.

    For what can't be the same: a library that has spoken already does not repeat itself, and a player that ran dry for
    a moment plays the rest later. At 450 words a minute a sentence again has 0.35 to 1.0, another one 0.27 at most (250
    of each, with a gap of 10 to 40 ms somewhere in it); at 200 another one reached 0.31. 0.0 where nothing was heard.
    """
    samples = heard.samples if isinstance(heard, Recording) else heard
    wanted = _sound(reference)
    if extent(samples) is None:
        return 0.0
    floats = samples.astype(np.float64)
    offset = _align(floats, wanted)
    dots, energies = 0.0, 0.0
    length = RATE // 4
    for start in range(0, len(wanted), length):
        part = wanted[start : start + length].astype(np.float64)
        around = _around(floats, offset + start, len(part), _NEARBY)
        product, energy = _best(around, part)
        dots += product
        energies += energy
    own = wanted.astype(np.float64)
    return dots / float(np.sqrt(float(own @ own) * max(energies, 1.0)))


def assert_silent(heard: Recording | Samples) -> None:
    """Assert that nothing was heard."""
    samples = heard.samples if isinstance(heard, Recording) else heard
    assert len(samples), "nothing was recorded, not even silence"
    assert extent(samples) is None, f"sound where silence should be: {_told(samples, [])}"


def loudness(samples: Samples) -> float:
    """Return the root mean square of a sound, from its first to its last sample that is sound; 0.0 for silence."""
    found = extent(samples)
    return 0.0 if found is None else float(np.sqrt(np.mean(samples[found[0] : found[1]].astype(np.float64) ** 2)))


def _sound(reference: Samples) -> Samples:
    found = extent(reference)
    assert found is not None, "the reference is silence"
    return reference[found[0] : found[1]]


def _align(samples: Floats, wanted: Samples, last: int | None = None) -> int:
    """Return the offset, up to `last`, at which samples resemble `wanted` most (cross-correlation by FFT)."""
    size = 1 << (len(samples) + len(wanted)).bit_length()
    product = np.fft.rfft(samples, size) * np.conj(np.fft.rfft(wanted.astype(np.float64), size))
    correlation = np.fft.irfft(product, size)
    return int(np.argmax(correlation[: (len(samples) if last is None else last) + 1]))


def _at(samples: Samples, wanted: Samples, offset: int, heard: float) -> Comparison:
    """Compare `wanted` with the samples at an offset, part by part."""
    padded = _around(samples, offset, len(wanted), _SLACK)
    reference = wanted.astype(np.float64)
    dots, energies, worst = 0.0, 0.0, 1.0
    for start in range(0, len(reference), _PART):
        part = reference[start : start + _PART]
        around = padded[start : start + len(part) + 2 * _SLACK]
        product, energy = _best(around, part)
        own = float(part @ part)
        dots += product
        energies += energy
        if own > len(part) * LOUD**2:
            worst = min(worst, product / float(np.sqrt(own * max(energy, 1.0))))
    whole = float(np.sqrt(float(reference @ reference) * max(energies, 1.0)))
    return Comparison(dots / whole, worst, offset, heard, len(wanted) / RATE)


def _around(samples: Samples | Floats, offset: int, length: int, slack: int) -> Floats:
    """Return the samples from an offset on, with `slack` of them on either side; zeros where there are none."""
    padded = np.zeros(length + 2 * slack)
    begin = max(0, offset - slack)
    piece = samples[begin : offset + length + slack]
    padded[begin - (offset - slack) :][: len(piece)] = piece
    return padded


def _best(around: Floats, part: Floats) -> tuple[float, float]:
    """Return the product with a part where that resembles most, and the energy of what it resembles there."""
    products = np.correlate(around, part, "valid")
    squares = np.concatenate([[0.0], np.cumsum(around**2)])
    energy = squares[len(part) :] - squares[: -len(part)]
    best = int(np.argmax(products / np.sqrt(np.maximum(energy, 1.0))))
    return float(products[best]), float(energy[best])


def _told(samples: Samples, compared: Sequence[Comparison]) -> str:
    found = extent(samples)
    sound = f"sound from {found[0] / RATE:.3f} to {found[1] / RATE:.3f} s" if found else "silence"
    return "; ".join([f"{sound} in {len(samples) / RATE:.3f} s recorded", *(str(each) for each in compared)])
