"""Compare recorded sound with reference renderings, sample by sample, including both ends.

Three problems make this difficult:

- The correlation of a whole sentence hardly changes if a short last word is cut. So each tenth of a second is also
  compared, and the place where the sound ends.
- The monitor drops samples at the start of a stream. So each tenth of a second may be slightly displaced.
- On a busy machine, a player sometimes runs dry. The sink then inserts zeros into the sentence, and the monitor may
  drop some of the samples after them, although the sentence is complete.

So the samples are first compared one by one, except for inserted zeros and dropped samples. If this fails, the
correlation decides.
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

#: Correlation of the right sentence. It is usually 1.0, and about 0.4 if a word is different.
SAME = 0.95
#: Correlation of the worst tenth of a second of the right sentence. It is lower if a word was cut or changed.
SAME_PART = 0.8
#: Difference in length that the monitor's dropped samples and a block of silence can cause.
EXTENT_TOLERANCE_S = 0.02
_PART = RATE // 10
#: Samples by which a part may be displaced, relative to the part before it.
_SLACK = 48
#: Equal samples that show where the sentence continues, and zeros that show that a player ran dry.
_RUN = 32
#: Samples by which a quarter of a second may be late because a player ran dry before it.
_NEARBY = RATE // 20
#: Most samples of silence that may be inserted into one sentence because players ran dry.
_DRY = RATE // 2
#: Samples that the monitor may drop at the start of a stream, or after a player ran dry (up to 217 were measured), and
#: samples that it may drop once in a sentence without inserted zeros. Up to 110 were measured when the engine had
#: waited 48 ms for the processor: the sound server ran dry for 0.3 ms and discarded the sound that it had rendered.
_LOST, _LOST_ONCE = 256, 128


@dataclass(frozen=True, slots=True)
class Comparison:
    """The result of comparing a recorded sound with a reference."""

    correlation: float  # normalised, over the whole reference; 1.0 if equal
    worst: float  # lowest correlation of a tenth of a second that isn't silent
    offset: int  # sample of the recording at which the reference's sound starts
    heard: float  # seconds from the first to the last sound in the recording
    expected: float  # seconds from the first to the last sound in the reference
    #: indexes of the equal samples in the recording and in the reference's sound, if they were compared one by one
    indexes: tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]] | None = None

    @property
    def same(self) -> bool:
        """Whether exactly this sentence was heard, complete."""
        return (
            self.correlation >= SAME
            and self.worst >= SAME_PART
            and abs(self.heard - self.expected) <= EXTENT_TOLERANCE_S
        )

    @property
    def end(self) -> int:
        """The index after the last compared sample of the recording."""
        return int(self.indexes[0][-1]) + 1 if self.indexes else self.offset + round(self.expected * RATE)


def _samples(heard: Recording | Samples) -> Samples:
    return heard.samples if isinstance(heard, Recording) else heard


def extent(samples: Samples, loud: int = LOUD) -> tuple[int, int] | None:
    """Return the index of the first sound and the index after the last sound, or None for silence."""
    sound = np.flatnonzero(np.abs(samples.astype(np.int32)) > loud)
    return (int(sound[0]), int(sound[-1]) + 1) if len(sound) else None


def compare(heard: Recording | Samples, reference: Samples) -> Comparison:
    """Compare the whole recording with one reference, at the offset where they are most similar."""
    samples = _samples(heard)
    wanted = _sound(reference)
    found = extent(samples)
    if found is None:
        return Comparison(0.0, 0.0, 0, 0.0, len(wanted) / RATE)
    exact = _compare_exactly(samples, wanted, found[0])
    if exact and extent(samples[exact.end + _SLACK :]) is None:
        return exact
    offset = _align(samples.astype(np.float64), wanted)
    return _compare_at(samples, wanted, offset, (found[1] - found[0]) / RATE)


def assert_heard(heard: Recording | Samples, references: Sequence[Samples]) -> list[Comparison]:
    """Assert that these references were heard completely, once and in order, and nothing else. Return the comparisons.

    The silence at the end of a sentence may be shorter.
    """
    samples = _samples(heard)
    result: list[Comparison] = []
    cursor = 0
    for number, reference in enumerate(references, 1):
        wanted = _sound(reference)
        found = extent(samples[cursor:])
        assert found is not None, f"sentence {number} of {len(references)} was not heard: {_describe(samples, result)}"
        start = cursor + found[0]
        comparison = _compare_next(samples, wanted, start)
        assert comparison.same, (
            f"sentence {number} of {len(references)} was not heard correctly: {_describe(samples, [comparison])}; "
            f"equal samples (recording, reference, count): {_equal_runs(samples, wanted, start)} of {len(wanted)}"
        )
        cursor = min(len(samples), comparison.end + _SLACK)
        result.append(comparison)
    assert extent(samples[cursor:]) is None, (
        f"more was heard than {len(references)} sentences: {_describe(samples[cursor:], [])}"
    )
    return result


def _compare_next(samples: Samples, wanted: Samples, start: int) -> Comparison:
    """Compare the sentence whose first sound is at `start`, after silence."""
    exact = _compare_exactly(samples, wanted, start)
    if exact:
        return exact
    first = max(0, start - _LOST)
    nearby = samples[first : start + len(wanted) + _SLACK].astype(np.float64)
    offset = first + _align(nearby, wanted, _LOST + _SLACK)
    inside = extent(samples[max(0, offset - _SLACK) : offset + len(wanted) + _SLACK])
    return _compare_at(samples, wanted, offset, (inside[1] - inside[0]) / RATE if inside else 0.0)


def _compare_exactly(samples: Samples, wanted: Samples, start: int) -> Comparison | None:
    """Compare the sound at `start` sample by sample. Return None if it isn't the complete sentence.

    If a player ran dry, zeros were inserted, and the monitor may have dropped some samples after them.
    """
    runs = _equal_runs(samples, wanted, start)
    if not runs or not _nearly_whole(runs, wanted):
        return None
    length = len(wanted) / RATE
    return Comparison(1.0, 1.0, runs[0][0] - runs[0][1], length, length, _indexes(runs))


def _equal_runs(samples: Samples, wanted: Samples, index: int, ahead: int = 0) -> list[tuple[int, int, int]]:
    """Return the runs of equal samples: their start in the recording, their start in the reference, and their length.

    Between two runs, the recording only has zeros, and at most the samples that the monitor may drop are missing. The
    first run may start up to `ahead` samples later in the reference.
    """
    runs: list[tuple[int, int, int]] = []
    ref = 0
    while True:
        sound = index + _leading_zeros(samples[index:])
        dry = sound - index >= _RUN or not runs
        lost = (_LOST if dry else _LOST_ONCE) + (0 if runs else ahead)
        skipped = _find(samples[sound : sound + _RUN], wanted[ref:], lost + sound - index)
        if skipped is None or np.count_nonzero(wanted[ref : ref + skipped]) > lost:
            return runs
        ref += skipped
        length = _same_length(samples[sound:], wanted[ref:])
        runs.append((sound, ref, length))
        index, ref = sound + length, ref + length


def _nearly_whole(runs: Sequence[tuple[int, int, int]], wanted: Samples) -> bool:
    """Return whether no more samples were dropped and inserted than on a busy machine."""
    reached = [0, *(ref + length for _, ref, length in runs)]
    starts = [*(ref for _, ref, _ in runs), len(wanted)]
    lost = [int(np.count_nonzero(wanted[a:b])) for a, b in zip(reached, starts, strict=True)]
    longer = runs[-1][0] - runs[0][0] - (runs[-1][1] - runs[0][1])
    # Samples that are missing without inserted zeros: the monitor dropped them, although no player ran dry.
    lost_without_zeros = [
        missing
        for missing, before, after in zip(lost[1:-1], runs, runs[1:], strict=False)
        if missing and after[0] - before[0] - before[2] < _RUN
    ]
    return max(lost) <= _LOST and sum(lost) <= 3 * _LOST and len(lost_without_zeros) <= 1 and longer <= _DRY


def _leading_zeros(samples: Samples) -> int:
    others = np.flatnonzero(samples)
    return int(others[0]) if len(others) else len(samples)


def _find(piece: Samples, wanted: Samples, last: int) -> int | None:
    """Return the first index, up to `last`, of the piece in `wanted`. The end of `wanted` may cut the piece off."""
    for index in np.flatnonzero(wanted[: last + 1] == piece[0]) if len(piece) else ():
        rest = wanted[index : index + len(piece)]
        if np.array_equal(piece[: len(rest)], rest):
            return int(index)
    return None


def _same_length(samples: Samples, wanted: Samples) -> int:
    """Return the number of equal samples at the start."""
    length = min(len(samples), len(wanted))
    different = np.flatnonzero(samples[:length] != wanted[:length])
    return int(different[0]) if len(different) else length


def _indexes(runs: Sequence[tuple[int, int, int]]) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    heard, ref = zip(*((np.arange(a, a + length), np.arange(b, b + length)) for a, b, length in runs), strict=True)
    return np.concatenate(heard), np.concatenate(ref)


def assert_only_beginning(heard: Recording | Samples, reference: Samples, shortest: float = 0.1) -> float:
    """Assert that only a beginning of the reference was heard, of at least `shortest` seconds. Return its length."""
    samples = _samples(heard)
    found = extent(samples)
    assert found is not None, "nothing was heard"
    wanted = _sound(reference)
    sound = samples[found[0] : found[1]]
    last = _equal_runs(sound, wanted, 0)[-1:]  # the player may have run dry
    if last and last[0][0] + last[0][2] == len(sound):
        seconds = (last[0][1] + last[0][2]) / RATE
    else:
        assert len(sound) <= len(wanted) + _SLACK, f"more was heard than the sentence: {_describe(samples, [])}"
        assert_heard(sound, [wanted[: len(sound)]])
        seconds = len(sound) / RATE
    assert seconds >= shortest, f"only {seconds:.3f} s were heard"
    return seconds


def matching_length(samples: Samples, reference: Samples) -> int:
    """Return the index in the recording up to which it is equal to the reference, or 0 if it isn't from the start."""
    found = extent(samples)
    last = _equal_runs(samples, _sound(reference), found[0])[-1:] if found else []
    return last[0][0] + last[0][2] if last else 0


def assert_resumed(heard: Recording | Samples, reference: Samples, pause: float, repeated: float = 0.0) -> float:
    """Assert that the reference was heard completely, with one pause of at least `pause` seconds. Return its length.

    At most `repeated` seconds may be heard again after the pause.
    """
    samples = _samples(heard)
    loud = np.flatnonzero(np.abs(samples.astype(np.int32)) > LOUD)
    assert len(loud) > 1, f"no sentence was heard: {_describe(samples, [])}"
    # A pause consists of zeros. Other quiet samples belong to the sentence.
    sound = loud[0] + np.flatnonzero(samples[loud[0] : loud[-1] + 1])
    gap = int(np.argmax(np.diff(sound)))
    end, again = int(sound[gap]) + 1, int(sound[gap + 1])
    first, second = samples[loud[0] : end], samples[again : loud[-1] + 1]
    length = (again - end + 1) / RATE
    assert length >= pause, f"paused for only {length:.3f} s: {_describe(samples, [])}"
    wanted = _sound(reference)
    try:
        _assert_parts(first, second, wanted, repeated)
    except AssertionError as error:
        # Zeros of the sentence next to the pause look like a part of the pause.
        if not _ran_dry(first, samples[end : loud[-1] + 1], wanted, round(repeated * RATE)):
            runs = [_equal_runs(part, wanted, 0, ahead=len(wanted)) for part in (first, second)]
            parts = f"parts of {len(first)} and {len(second)} samples, equal samples (recording, reference, count)"
            raise AssertionError(f"{error}; {parts}: {runs[0]} and {runs[1]} of {len(wanted)}") from error
    return length


def _ran_dry(first: Samples, second: Samples, wanted: Samples, repeated: int) -> bool:
    """Return whether these are the two parts of a sentence in which a player ran dry (see `_compare_exactly`)."""
    runs = _equal_runs(first, wanted, 0)
    if not runs or runs[-1][0] + runs[-1][2] < len(first):
        return False
    reached = runs[-1][1] + runs[-1][2]
    back = min(reached, repeated + _SLACK)
    rest = _equal_runs(second, wanted[reached - back :], 0, ahead=back)
    if not rest or len(wanted) - (reached - back + rest[-1][1] + rest[-1][2]) > _LOST:
        return False
    # A stream that continues drops nothing at the pause. A stream that was restarted or ran dry may drop samples.
    between = int(np.count_nonzero(wanted[reached : reached - back + rest[0][1]]))
    return between <= (_LOST if repeated or len(runs) + len(rest) > 2 else 2 * _SLACK)


def _assert_parts(first: Samples, second: Samples, wanted: Samples, repeated: float) -> None:
    assert max(len(first), len(second)) <= len(wanted), "more was heard than the sentence"
    # The monitor may have dropped the first samples.
    lost = next((ref for _, ref, _ in _equal_runs(first, wanted, 0)), 0)
    reached = lost + len(first)
    assert_heard(first, [wanted[lost:reached]])
    assert_heard(second, [wanted[-len(second) :]])
    missing = wanted[reached + _SLACK : -len(second) - _SLACK]
    assert extent(missing) is None, f"{len(missing) / RATE:.3f} s at the pause were not heard"
    again = (reached + len(second) - len(wanted)) / RATE
    assert again <= repeated + _SLACK / RATE, f"{again:.3f} s at the pause were heard twice"


def time_heard(recording: Recording, compared: Comparison, reference: Samples, position: float) -> float:
    """Return the monotonic time at which a position of the reference (in seconds) was heard."""
    found = extent(reference)
    assert found is not None, "the reference is silence"
    index = round(position * RATE) - found[0]
    if compared.indexes is None:
        return recording.time_of(compared.offset + index)
    heard, ref = compared.indexes
    return recording.time_of(int(heard[min(int(np.searchsorted(ref, index)), len(heard) - 1)]))


def similarity(heard: Recording | Samples, reference: Samples) -> float:
    """Return the correlation of a sound with a reference, or 0.0 for silence. Each quarter of a second is aligned.

    Use this for sound that can't be equal: libespeak-ng renders a sentence differently after another one, and a player
    that ran dry plays the rest later. At 450 words per minute, the same sentence had 0.35 to 1.0, and another sentence
    at most 0.27 (250 of each, with a gap of 10 to 40 ms). At 200 words per minute, another sentence reached 0.31.
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
        product, energy, _ = _best_match(around, part)
        dots += product
        energies += energy
    ref = wanted.astype(np.float64)
    return dots / float(np.sqrt(float(ref @ ref) * max(energies, 1.0)))


def assert_silent(heard: Recording | Samples) -> None:
    """Assert that nothing was heard."""
    samples = _samples(heard)
    assert len(samples), "nothing was recorded, not even silence"
    assert extent(samples) is None, f"something was heard: {_describe(samples, [])}"


def loudness(samples: Samples) -> float:
    """Return the root mean square of a sound without the silence at its ends, or 0.0 for silence."""
    found = extent(samples)
    return 0.0 if found is None else float(np.sqrt(np.mean(samples[found[0] : found[1]].astype(np.float64) ** 2)))


def _sound(reference: Samples) -> Samples:
    found = extent(reference)
    assert found is not None, "the reference is silence"
    return reference[found[0] : found[1]]


def _align(samples: Floats, wanted: Samples, last: int | None = None) -> int:
    """Return the offset, up to `last`, at which samples are most similar to `wanted` (cross-correlation by FFT)."""
    size = 1 << (len(samples) + len(wanted)).bit_length()
    product = np.fft.rfft(samples, size) * np.conj(np.fft.rfft(wanted.astype(np.float64), size))
    correlation = np.fft.irfft(product, size)
    return int(np.argmax(correlation[: (len(samples) if last is None else last) + 1]))


def _compare_at(samples: Samples, wanted: Samples, offset: int, heard: float) -> Comparison:
    """Compare `wanted` with the samples at an offset, part by part. Each part may be slightly displaced."""
    reference = wanted.astype(np.float64)
    dots, energies, worst = 0.0, 0.0, 1.0
    index = offset
    for start in range(0, len(reference), _PART):
        part = reference[start : start + _PART]
        around = _around(samples, index + start, len(part), _SLACK)
        product, energy, best = _best_match(around, part)
        expected = float(part @ part)
        if product < SAME_PART * np.sqrt(expected * energy):
            product, energy, best = _best_match_in_two_parts(around, part)
        dots += product
        energies += energy
        if expected > len(part) * LOUD**2:
            worst = min(worst, product / float(np.sqrt(expected * max(energy, 1.0))))
            index += min(0, best - _SLACK)  # after dropped samples, all later parts come earlier
    whole = float(np.sqrt(float(reference @ reference) * max(energies, 1.0)))
    return Comparison(dots / whole, worst, offset, heard, len(wanted) / RATE)


def _around(samples: Samples | Floats, offset: int, length: int, slack: int) -> Floats:
    """Return the samples at an offset with `slack` samples on both sides. Missing samples are zeros."""
    padded = np.zeros(length + 2 * slack)
    begin = max(0, offset - slack)
    piece = samples[begin : offset + length + slack]
    padded[begin - (offset - slack) :][: len(piece)] = piece
    return padded


def _best_match(around: Floats, part: Floats) -> tuple[float, float, int]:
    """Return the product with a part at the best index, the energy of the samples there, and the index."""
    products = np.correlate(around, part, "valid")
    squares = np.concatenate([[0.0], np.cumsum(around**2)])
    energy = squares[len(part) :] - squares[: -len(part)]
    best = int(np.argmax(products / np.sqrt(np.maximum(energy, 1.0))))
    return float(products[best]), float(energy[best]), best


def _best_match_in_two_parts(around: Floats, part: Floats) -> tuple[float, float, int]:
    """Do the same as `_best_match` for a part in which the monitor may have dropped samples."""
    results = []
    for cut in range(max(1, len(part) // 8), len(part), max(1, len(part) // 8)):
        first = _best_match(around[: cut + 2 * _SLACK], part[:cut])
        second = _best_match(around[cut:], part[cut:])
        results.append((first[0] + second[0], first[1] + second[1], second[2]))
    return max(
        results or [_best_match(around, part)], key=lambda result: result[0] / float(np.sqrt(max(result[1], 1.0)))
    )


def _describe(samples: Samples, comparisons: Sequence[Comparison]) -> str:
    found = extent(samples)
    sound = f"sound from {found[0] / RATE:.3f} to {found[1] / RATE:.3f} s" if found else "silence"
    return "; ".join([f"{sound} in a recording of {len(samples) / RATE:.3f} s", *map(str, comparisons)])
