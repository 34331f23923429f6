"""The benchmark's arithmetic: medians, percentiles, ratios, and where sound begins and ends in samples.

Pure: numbers go in, numbers come out, so that the tests can say what must come out. Positions are counted in samples.
"""

from __future__ import annotations

import math
import statistics
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from tests.support.recording import LOUD

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    Samples = npt.NDArray[np.int16]


def median(values: Sequence[float]) -> float:
    """Return the middle value, or the mean of the two in the middle."""
    return statistics.median(values)


def percentile(values: Sequence[float], part: float) -> float:
    """Return the least value that so many percent of the values do not exceed: one that was measured, never between.

    Of fewer than a hundred values the 99th percentile is the greatest.
    """
    ordered = sorted(values)
    return ordered[max(0, math.ceil(len(ordered) * part / 100) - 1)]


def ratio(value: float, other: float) -> float:
    """Return how many times the other the value is; infinite where the other is nothing."""
    return value / other if other else math.inf


def first_sound(samples: Samples, level: int = LOUD) -> int | None:
    """Return where the first sample above this level is."""
    found = np.flatnonzero(_above(samples, level))
    return int(found[0]) if len(found) else None


def last_sound(samples: Samples, level: int = LOUD) -> int | None:
    """Return where the last sample above this level is."""
    found = np.flatnonzero(_above(samples, level))
    return int(found[-1]) if len(found) else None


def silences(samples: Samples, shortest: int, level: int = LOUD) -> list[tuple[int, int]]:
    """Return the stretches of at least so many samples, none above the level, between two that are above it.

    Each is the place of its first quiet sample and of the first sound after it. What is quiet before the first sound
    and after the last one is no silence between sounds.
    """
    found = np.flatnonzero(_above(samples, level))
    steps = np.diff(found)
    return [(int(found[each]) + 1, int(found[each + 1])) for each in np.flatnonzero(steps > shortest)]


def edges(samples: Samples, level: int = LOUD) -> tuple[int, int]:
    """Return how many samples are quiet before the first sound, and after the last one."""
    first, last = first_sound(samples, level), last_sound(samples, level)
    if first is None or last is None:
        raise ValueError("there is no sound in these samples")
    return first, len(samples) - 1 - last


def beyond_own_pause(heard: Samples, references: Sequence[Samples], shortest: int) -> list[int]:
    """Return by how many samples each silence between sentences is longer than the sentences themselves make it.

    `references`: what the synthesiser makes of these sentences, in their order; the quiet at the end of one and at the
    beginning of the next is their own pause. ValueError where there are not as many sentences in what was heard.
    """
    between = silences(heard, shortest)
    if len(between) != len(references) - 1:
        raise ValueError(f"{len(between) + 1} sentences are heard, {len(references)} were said")
    own = [edges(first)[1] + edges(second)[0] for first, second in pairwise(references)]
    return [end - start - expected for (start, end), expected in zip(between, own, strict=True)]


def _above(samples: Samples, level: int) -> npt.NDArray[np.bool_]:
    result: npt.NDArray[np.bool_] = np.abs(samples.astype(np.int32)) > level
    return result
