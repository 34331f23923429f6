"""Compares recorded sound with reference renderings, sample by sample, including the ends.

Three traps decide how. A correlation over a whole sentence hardly shows a short last word that was cut, so the worst of
its tenths of a second counts as well, and the place where the sound ends. The monitor drops samples at the start of a
stream, so each tenth may sit a little beside its place. On a busy machine a player sometimes runs dry: the sink puts
zeros between two samples of the sentence, and the monitor drops some of those behind, although the sentence is whole.
So the sound is first followed sample by sample, which forgives just these, and otherwise judged by its correlation.
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
#: Seconds by which the extent of the right sound may differ: the monitor's loss and a block of silence.
EXTENT_TOLERANCE_S = 0.02
_PART = RATE // 10
#: Samples by which a part may sit beside the place of the one before it.
_SLACK = 48
#: Samples in a row that are the same when the sentence goes on after a player ran dry, and zeros that show that it did.
_RUN = 32
#: Samples by which a quarter of a second may come later, if a player ran dry before it.
_NEARBY = RATE // 20
#: Samples of silence that players that ran dry may put into one sentence.
_DRY = RATE // 2
#: Samples that the monitor may lose at the start of a stream, and when a player ran dry: up to 217 were seen. And those
#: that it may lose once in a sentence without any zeros: up to 110 were seen, when a busy machine kept the engine
#: waiting for 48 ms. The sound server ran dry for 0.3 ms, and took back the sound that it had rendered.
_LOST, _LOST_ONCE = 256, 128


@dataclass(frozen=True, slots=True)
class Comparison:
    """How a recorded sound resembles a reference."""

    correlation: float  # normalised, over all of the reference; 1.0 is the same
    worst: float  # the same of its worst tenth of a second that is sound
    offset: int  # sample of the recording at which the reference's first sound is
    heard: float  # seconds from the first to the last sample that is sound
    expected: float  # the same of the reference
    #: the compared samples of the recording and of the reference's sound, if zeros were left out of both
    places: tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]] | None = None

    @property
    def same(self) -> bool:
        """Whether it is this sentence, whole, and nothing more."""
        return (
            self.correlation >= SAME
            and self.worst >= SAME_PART
            and abs(self.heard - self.expected) <= EXTENT_TOLERANCE_S
        )

    @property
    def end(self) -> int:
        """The sample of the recording after the last that was compared."""
        return int(self.places[0][-1]) + 1 if self.places else self.offset + round(self.expected * RATE)


def _samples(heard: Recording | Samples) -> Samples:
    return heard.samples if isinstance(heard, Recording) else heard


def extent(samples: Samples, loud: int = LOUD) -> tuple[int, int] | None:
    """Return the first sample that is sound and the one after the last; None if there is no sound."""
    found = np.flatnonzero(np.abs(samples.astype(np.int32)) > loud)
    return (int(found[0]), int(found[-1]) + 1) if len(found) else None


def compare(heard: Recording | Samples, reference: Samples) -> Comparison:
    """Compare all that was heard with one reference, aligned where they resemble each other most."""
    samples = _samples(heard)
    wanted = _sound(reference)
    found = extent(samples)
    if found is None:
        return Comparison(0.0, 0.0, 0, 0.0, len(wanted) / RATE)
    exact = _exact(samples, wanted, found[0])
    if exact and extent(samples[exact.end + _SLACK :]) is None:
        return exact
    offset = _align(samples.astype(np.float64), wanted)
    return _at(samples, wanted, offset, (found[1] - found[0]) / RATE)


def assert_heard(heard: Recording | Samples, references: Sequence[Samples]) -> list[Comparison]:
    """Assert that these references were heard whole, in order, once each, with only silence beside them.

    Returns how each compares. A pause at the end of a sentence may be shorter.
    """
    samples = _samples(heard)
    result: list[Comparison] = []
    cursor = 0
    for number, reference in enumerate(references, 1):
        wanted = _sound(reference)
        found = extent(samples[cursor:])
        assert found is not None, f"sentence {number} of {len(references)} was not heard: {_told(samples, result)}"
        start = cursor + found[0]
        each = _next(samples, wanted, start)
        assert each.same, (
            f"sentence {number} of {len(references)} was not heard as it should: {_told(samples, [each])}; "
            f"sample by sample (heard at, its own, so many): {_walk(samples, wanted, start)} of {len(wanted)}"
        )
        cursor = min(len(samples), each.end + _SLACK)
        result.append(each)
    assert extent(samples[cursor:]) is None, (
        f"more was heard than {len(references)} sentences: {_told(samples[cursor:], [])}"
    )
    return result


def _next(samples: Samples, wanted: Samples, start: int) -> Comparison:
    """Compare the sentence that begins with the sound at `start`, behind silence."""
    exact = _exact(samples, wanted, start)
    if exact:
        return exact
    first = max(0, start - _LOST)
    nearby = samples[first : start + len(wanted) + _SLACK].astype(np.float64)
    offset = first + _align(nearby, wanted, _LOST + _SLACK)
    inside = extent(samples[max(0, offset - _SLACK) : offset + len(wanted) + _SLACK])
    return _at(samples, wanted, offset, (inside[1] - inside[0]) / RATE if inside else 0.0)


def _exact(samples: Samples, wanted: Samples, start: int) -> Comparison | None:
    """Compare the sound at `start` sample by sample; None if it is not the whole sentence.

    If a player ran dry, zeros were put in, and the monitor may have lost some samples behind them.
    """
    runs = _walk(samples, wanted, start)
    if not runs or not _nearly_whole(runs, wanted):
        return None
    length = len(wanted) / RATE
    return Comparison(1.0, 1.0, runs[0][0] - runs[0][1], length, length, _places(runs))


def _walk(samples: Samples, wanted: Samples, place: int, ahead: int = 0) -> list[tuple[int, int, int]]:
    """Return the runs in which both are the same: the place of each in the samples, its own place, and its length.

    Between two of them there are only zeros in the samples, and at most the lost samples are left out of those wanted.
    The first run may begin `ahead` samples later in the latter.
    """
    runs: list[tuple[int, int, int]] = []
    own = 0
    while True:
        sound = place + _leading_zeros(samples[place:])
        dry = sound - place >= _RUN or not runs
        lost = (_LOST if dry else _LOST_ONCE) + (0 if runs else ahead)
        skipped = _find(samples[sound : sound + _RUN], wanted[own:], lost + sound - place)
        if skipped is None or np.count_nonzero(wanted[own : own + skipped]) > lost:
            return runs
        own += skipped
        length = _same_length(samples[sound:], wanted[own:])
        runs.append((sound, own, length))
        place, own = sound + length, own + length


def _nearly_whole(runs: Sequence[tuple[int, int, int]], wanted: Samples) -> bool:
    """Return whether no more was lost and put in than a busy machine does to a sentence."""
    reached = [0, *(own + length for _, own, length in runs)]
    begins = [*(own for _, own, _ in runs), len(wanted)]
    lost = [int(np.count_nonzero(wanted[a:b])) for a, b in zip(reached, begins, strict=True)]
    longer = runs[-1][0] - runs[0][0] - (runs[-1][1] - runs[0][1])
    # Without zeros between them, samples are missing that the player had: few, which the monitor lost.
    wet = [
        missing
        for missing, before, after in zip(lost[1:-1], runs, runs[1:], strict=False)
        if missing and after[0] - before[0] - before[2] < _RUN
    ]
    return max(lost) <= _LOST and sum(lost) <= 3 * _LOST and len(wet) <= 1 and longer <= _DRY


def _leading_zeros(samples: Samples) -> int:
    found = np.flatnonzero(samples)
    return int(found[0]) if len(found) else len(samples)


def _find(piece: Samples, wanted: Samples, last: int) -> int | None:
    """Return the first place, up to `last`, of the piece in `wanted`, at whose end it may be shorter."""
    for place in np.flatnonzero(wanted[: last + 1] == piece[0]) if len(piece) else ():
        rest = wanted[place : place + len(piece)]
        if np.array_equal(piece[: len(rest)], rest):
            return int(place)
    return None


def _same_length(samples: Samples, wanted: Samples) -> int:
    """Return for how many samples both are the same."""
    length = min(len(samples), len(wanted))
    different = np.flatnonzero(samples[:length] != wanted[:length])
    return int(different[0]) if len(different) else length


def _places(runs: Sequence[tuple[int, int, int]]) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    heard, own = zip(*((np.arange(a, a + length), np.arange(b, b + length)) for a, b, length in runs), strict=True)
    return np.concatenate(heard), np.concatenate(own)


def assert_only_beginning(heard: Recording | Samples, reference: Samples, shortest: float = 0.1) -> float:
    """Assert that only a beginning of the reference was heard, at least `shortest` seconds; return its seconds."""
    samples = _samples(heard)
    found = extent(samples)
    assert found is not None, "nothing was heard"
    wanted = _sound(reference)
    sound = samples[found[0] : found[1]]
    last = _walk(sound, wanted, 0)[-1:]  # the player may have run dry
    if last and last[0][0] + last[0][2] == len(sound):
        seconds = (last[0][1] + last[0][2]) / RATE
    else:
        assert len(sound) <= len(wanted) + _SLACK, f"more was heard than the sentence: {_told(samples, [])}"
        assert_heard(sound, [wanted[: len(sound)]])
        seconds = len(sound) / RATE
    assert seconds >= shortest, f"only {seconds:.3f} s were heard"
    return seconds


def matching_length(samples: Samples, reference: Samples) -> int:
    """Return the place behind the last sample, from the first sound on, that is the same as the reference; else 0."""
    found = extent(samples)
    last = _walk(samples, _sound(reference), found[0])[-1:] if found else []
    return last[0][0] + last[0][2] if last else 0


def assert_resumed(heard: Recording | Samples, reference: Samples, pause: float, repeated: float = 0.0) -> float:
    """Assert that the reference was heard whole, held once in its middle for at least `pause` seconds.

    At most `repeated` seconds may have been said again after the pause. Returns the seconds of the pause.
    """
    samples = _samples(heard)
    loud = np.flatnonzero(np.abs(samples.astype(np.int32)) > LOUD)
    assert len(loud) > 1, f"no sentence was heard: {_told(samples, [])}"
    # A pause is only zeros; other quiet samples belong to the sentence.
    sound = loud[0] + np.flatnonzero(samples[loud[0] : loud[-1] + 1])
    gap = int(np.argmax(np.diff(sound)))
    end, again = int(sound[gap]) + 1, int(sound[gap + 1])
    first, second = samples[loud[0] : end], samples[again : loud[-1] + 1]
    held = (again - end + 1) / RATE
    assert held >= pause, f"held for {held:.3f} s: {_told(samples, [])}"
    wanted = _sound(reference)
    try:
        _assert_parts(first, second, wanted, repeated)
    except AssertionError as error:
        # Zeros of the sentence beside the pause look like the pause.
        if not _ran_dry(first, samples[end : loud[-1] + 1], wanted, round(repeated * RATE)):
            runs = [_walk(each, wanted, 0, ahead=len(wanted)) for each in (first, second)]
            told = f"parts of {len(first)} and {len(second)} samples, sample by sample (heard at, its own, so many)"
            raise AssertionError(f"{error}; {told}: {runs[0]} and {runs[1]} of {len(wanted)}") from error
    return held


def find_part(part: Samples, wanted: Samples, reached: int, back: int) -> tuple[int, int] | None:
    """Return the places in a sentence's sound where a part of it begins and ends; None if it is no part.

    `reached`: samples that were heard before, of which it may say the last `back` again.
    """
    begins = max(0, reached - back)
    runs = _walk(part, wanted[begins:], 0, ahead=reached - begins)
    if not runs or runs[-1][0] + runs[-1][2] < len(part):
        return None
    return begins + runs[0][1], begins + runs[-1][1] + runs[-1][2]


def _ran_dry(first: Samples, second: Samples, wanted: Samples, repeated: int) -> bool:
    """Return whether these are the two parts of a sentence in which a player ran dry, see `_exact`."""
    runs = _walk(first, wanted, 0)
    if not runs or runs[-1][0] + runs[-1][2] < len(first):
        return False
    reached = runs[-1][1] + runs[-1][2]
    back = min(reached, repeated + _SLACK)
    rest = _walk(second, wanted[reached - back :], 0, ahead=back)
    if not rest or len(wanted) - (reached - back + rest[-1][1] + rest[-1][2]) > _LOST:
        return False
    # A stream that goes on loses nothing at the pause; a stream that was started again or ran dry may.
    between = int(np.count_nonzero(wanted[reached : reached - back + rest[0][1]]))
    return between <= (_LOST if repeated or len(runs) + len(rest) > 2 else 2 * _SLACK)


def _assert_parts(first: Samples, second: Samples, wanted: Samples, repeated: float) -> None:
    assert max(len(first), len(second)) <= len(wanted), "more was heard than the sentence"
    # The monitor may have dropped the first samples.
    lost = next((own for _, own, _ in _walk(first, wanted, 0)), 0)
    reached = lost + len(first)
    assert_heard(first, [wanted[lost:reached]])
    assert_heard(second, [wanted[-len(second) :]])
    missing = wanted[reached + _SLACK : -len(second) - _SLACK]
    assert extent(missing) is None, f"{len(missing) / RATE:.3f} s at the pause were never heard"
    again = (reached + len(second) - len(wanted)) / RATE
    assert again <= repeated + _SLACK / RATE, f"{again:.3f} s at the pause were heard twice"


def time_heard(recording: Recording, compared: Comparison, reference: Samples, position: float) -> float:
    """Return the monotonic time at which a position of the reference, in seconds from its start, was heard."""
    found = extent(reference)
    assert found is not None, "the reference is silence"
    place = round(position * RATE) - found[0]
    if compared.places is None:
        return recording.time_of(compared.offset + place)
    heard, own = compared.places
    return recording.time_of(int(heard[min(int(np.searchsorted(own, place)), len(heard) - 1)]))


def similarity(heard: Recording | Samples, reference: Samples) -> float:
    """Return how a sound resembles a reference by quarter seconds, each at the best place nearby; 0.0 for silence.

    This is for sound that can't be the same: a library that has spoken already does not repeat itself, and a player
    that ran dry plays the rest later. At 450 words a minute the same sentence has 0.35 to 1.0, another one 0.27 at most
    (250 of each, with a gap of 10 to 40 ms somewhere in it); at 200 another one reached 0.31.
    """
    samples = _samples(heard)
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
    samples = _samples(heard)
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
            place += min(0, beside - _SLACK)  # lost samples never come back
    whole = float(np.sqrt(float(reference @ reference) * max(energies, 1.0)))
    return Comparison(dots / whole, worst, offset, heard, len(wanted) / RATE)


def _around(samples: Samples | Floats, offset: int, length: int, slack: int) -> Floats:
    """Return the samples from an offset on, with `slack` of them on either side, filled up with zeros."""
    padded = np.zeros(length + 2 * slack)
    begin = max(0, offset - slack)
    piece = samples[begin : offset + length + slack]
    padded[begin - (offset - slack) :][: len(piece)] = piece
    return padded


def _best(around: Floats, part: Floats) -> tuple[float, float, int]:
    """Return the product with a part at the best place, the energy of the samples there, and that place."""
    products = np.correlate(around, part, "valid")
    squares = np.concatenate([[0.0], np.cumsum(around**2)])
    energy = squares[len(part) :] - squares[: -len(part)]
    best = int(np.argmax(products / np.sqrt(np.maximum(energy, 1.0))))
    return float(products[best]), float(energy[best]), best


def _best_in_two(around: Floats, part: Floats) -> tuple[float, float, int]:
    """Return the same as `_best` for a part in whose middle the monitor may have dropped samples."""
    found = []
    for cut in range(max(1, len(part) // 8), len(part), max(1, len(part) // 8)):
        first = _best(around[: cut + 2 * _SLACK], part[:cut])
        second = _best(around[cut:], part[cut:])
        found.append((first[0] + second[0], first[1] + second[1], second[2]))
    return max(found or [_best(around, part)], key=lambda each: each[0] / float(np.sqrt(max(each[1], 1.0))))


def _told(samples: Samples, compared: Sequence[Comparison]) -> str:
    found = extent(samples)
    sound = f"sound from {found[0] / RATE:.3f} to {found[1] / RATE:.3f} s" if found else "silence"
    return "; ".join([f"{sound} in {len(samples) / RATE:.3f} s recorded", *(str(each) for each in compared)])
