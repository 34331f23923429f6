"""Compares what was heard with reference renderings, sample by sample, ends included.

Three traps decide how. A correlation over a whole sentence hardly sees a short last word that was cut, so that the
worst of its tenths of a second counts as well, and where the sound ends. The monitor drops up to 41 samples where a
stream starts and after an underrun, so that each tenth may sit a little beside its place. And on a busy machine a
player runs dry now and then: the sink puts zeros between two samples of the sentence, which is whole all the same. So
what is not the reference as it stands is compared again without the zeros of both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
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
#: Samples by which a part may sit beside the place of the one before it.
_SLACK = 48
#: Samples by which a sentence may be shorter where a stream started and a player ran dry in it.
_DROPPED = 3 * _SLACK
#: Samples before a sentence that may be the beginning of its first sound.
_CLICK = 8
#: So many zeros in a row may be a player that ran dry: fewer, left where one side has them, shift what follows by less
#: than the slack.
_ZEROS = 32
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
    #: samples of the recording and of the reference's sound that were compared, where zeros were left out of both
    places: tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]] | None = None

    @property
    def same(self) -> bool:
        """Whether it is this sentence, whole, and nothing more."""
        return self.correlation >= SAME and self.worst >= SAME_PART and abs(self.heard - self.expected) <= EXTENT

    @property
    def end(self) -> int:
        """The sample of the recording after the last that was compared."""
        return int(self.places[0][-1]) + 1 if self.places else self.offset + round(self.expected * RATE)


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
    result = _at(samples, wanted, offset, (found[1] - found[0]) / RATE)
    if result.same:
        return result
    without = _without_zeros(samples, wanted, max(0, found[0] - _LOST))
    alone = without and extent(samples[without.end + _SLACK :]) is None
    return without if without and without.same and alone else result


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
        each = _next(samples, wanted, start)
        assert each.same, f"sentence {number} of {len(references)} was not heard as it should: {_told(samples, [each])}"
        cursor = min(len(samples), each.end + _SLACK)
        result.append(each)
    assert extent(samples[cursor:]) is None, (
        f"more was heard than {len(references)} sentences: {_told(samples[cursor:], [])}"
    )
    return result


def _next(samples: Samples, wanted: Samples, start: int) -> Comparison:
    """Compare what begins with the sound at `start`: before it there is silence, so a sentence begins there."""
    first = max(0, start - _LOST)
    nearby = samples[first : start + len(wanted) + _SLACK].astype(np.float64)
    offset = first + _align(nearby, wanted, _LOST + _SLACK)
    inside = extent(samples[max(0, offset - _SLACK) : offset + len(wanted) + _SLACK])
    result = _at(samples, wanted, offset, (inside[1] - inside[0]) / RATE if inside else 0.0)
    if result.same:
        return result
    without = _without_zeros(samples, wanted, first)
    return without if without and without.same else result


def _without_zeros(samples: Samples, wanted: Samples, first: int) -> Comparison | None:
    """Compare what begins at most `_LOST` samples after `first` without its zeros; None where too little is left."""
    kept, own = first + _sounding(samples[first:]), _sounding(wanted)
    sound, reference = samples[kept], wanted[own]
    start = extent(sound)
    if start is None or len(sound) - start[0] < len(reference) - RATE * EXTENT:
        return None
    nearby = sound[: start[0] + len(reference) + _SLACK].astype(np.float64)
    offset = _align(nearby, reference, start[0] + _SLACK)
    if extent(sound[: max(0, offset - _CLICK)]):
        return None  # a click before it is no part of it
    inside = extent(sound[max(0, offset - _SLACK) : offset + len(reference) + _SLACK])
    length = (inside[1] - inside[0]) / RATE if inside else 0.0
    result = _at(sound, reference, offset, length)
    places = kept[offset : offset + len(reference)]
    return replace(result, offset=int(places[0]), places=(places, own[: len(places)]))


def _sounding(samples: Samples) -> npt.NDArray[np.intp]:
    """Return the places of all samples that are not in a long run of zeros."""
    silent = np.concatenate([[False], samples == 0, [False]])
    edges = np.flatnonzero(np.diff(silent.astype(np.int8)))
    keep = np.ones(len(samples), bool)
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        if end - begin >= _ZEROS:
            keep[begin:end] = False
    return np.flatnonzero(keep)


def assert_begun(heard: Recording | Samples, reference: Samples, shortest: float = 0.1) -> float:
    """Assert that a beginning of the reference was heard, and nothing else; return its seconds.

    For a sentence that was stopped: what was heard of it, at least `shortest` seconds, is the same as the reference.
    """
    samples = heard.samples if isinstance(heard, Recording) else heard
    found = extent(samples)
    assert found is not None, "nothing was heard"
    wanted = _sound(reference)
    places = np.arange(len(wanted))
    sound = samples[found[0] : found[1]]
    if len(sound) > len(wanted) + _SLACK or not _next(samples, wanted[: len(sound)], found[0]).same:
        places = _sounding(wanted)  # the player ran dry, or it is another sentence
        sound = sound[_sounding(sound)]
    assert len(sound) <= len(places) + _SLACK, f"more was heard than the sentence: {_told(samples, [])}"
    places = places[: len(sound)]
    assert_heard(sound, [wanted[places]])
    seconds = float(places[-1] + 1) / RATE
    assert seconds >= shortest, f"only {seconds:.3f} s were heard"
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
    try:
        _assert_parts(first, second, wanted, twice)
    except AssertionError:
        without = _without_zeros(samples, wanted, max(0, int(loud[0]) - _LOST))  # the player ran dry, or it is wrong
        if not (without and without.same and abs(without.heard - without.expected) <= _DROPPED / RATE):
            raise
    return held


def _assert_parts(first: Samples, second: Samples, wanted: Samples, twice: float) -> None:
    assert max(len(first), len(second)) <= len(wanted), "more was heard than the sentence"
    assert_heard(first, [wanted[: len(first)]])
    assert_heard(second, [wanted[-len(second) :]])
    missing = wanted[len(first) + _SLACK : -len(second) - _SLACK]
    assert extent(missing) is None, f"{len(missing) / RATE:.3f} s at the pause were never heard"
    again = (len(first) + len(second) - len(wanted)) / RATE
    assert again <= twice + _SLACK / RATE, f"{again:.3f} s at the pause were heard twice"


def time_heard(recording: Recording, compared: Comparison, reference: Samples, position: float) -> float:
    """Return the monotonic time at which a position of the reference, in seconds from its start, was heard."""
    found = extent(reference)
    assert found is not None, "the reference is silence"
    place = round(position * RATE) - found[0]
    if compared.places is None:
        return recording.time_of(compared.offset + place)
    heard, own = compared.places
    return recording.time_of(int(heard[min(int(np.searchsorted(own, place)), len(heard) - 1)]))


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
        product, energy, _ = _best(around, part)
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
    """Compare `wanted` with the samples at an offset, part by part, each close to the one before it."""
    reference = wanted.astype(np.float64)
    dots, energies, worst = 0.0, 0.0, 1.0
    place = offset
    for start in range(0, len(reference), _PART):
        part = reference[start : start + _PART]
        around = _around(samples, place + start, len(part), _SLACK)
        product, energy, beside = _best(around, part)
        own = float(part @ part)
        if product < SAME_PART * np.sqrt(own * energy):
            product, energy, beside = _best_in_two(around, part)
        dots += product
        energies += energy
        if own > len(part) * LOUD**2:
            worst = min(worst, product / float(np.sqrt(own * max(energy, 1.0))))
            place += min(0, beside - _SLACK)  # what was lost is never found again
    whole = float(np.sqrt(float(reference @ reference) * max(energies, 1.0)))
    return Comparison(dots / whole, worst, offset, heard, len(wanted) / RATE)


def _around(samples: Samples | Floats, offset: int, length: int, slack: int) -> Floats:
    """Return the samples from an offset on, with `slack` of them on either side; zeros where there are none."""
    padded = np.zeros(length + 2 * slack)
    begin = max(0, offset - slack)
    piece = samples[begin : offset + length + slack]
    padded[begin - (offset - slack) :][: len(piece)] = piece
    return padded


def _best(around: Floats, part: Floats) -> tuple[float, float, int]:
    """Return the product with a part where that resembles most, the energy of what it resembles there, and where."""
    products = np.correlate(around, part, "valid")
    squares = np.concatenate([[0.0], np.cumsum(around**2)])
    energy = squares[len(part) :] - squares[: -len(part)]
    best = int(np.argmax(products / np.sqrt(np.maximum(energy, 1.0))))
    return float(products[best]), float(energy[best]), best


def _best_in_two(around: Floats, part: Floats) -> tuple[float, float, int]:
    """As `_best`, of a part in whose middle the monitor may have dropped some samples."""
    found = []
    for cut in range(len(part) // 8, len(part), max(1, len(part) // 8)):
        first = _best(around[: cut + 2 * _SLACK], part[:cut])
        second = _best(around[cut:], part[cut:])
        found.append((first[0] + second[0], first[1] + second[1], second[2]))
    return max(found or [_best(around, part)], key=lambda each: each[0] / float(np.sqrt(max(each[1], 1.0))))


def _told(samples: Samples, compared: Sequence[Comparison]) -> str:
    found = extent(samples)
    sound = f"sound from {found[0] / RATE:.3f} to {found[1] / RATE:.3f} s" if found else "silence"
    return "; ".join([f"{sound} in {len(samples) / RATE:.3f} s recorded", *(str(each) for each in compared)])
