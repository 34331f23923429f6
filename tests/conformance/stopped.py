"""Compare the sound of sentences after a stopped one with references, which this module renders as a program.

libespeak-ng renders a sentence differently after a stopped one. The result depends only on the place where the
synthesis was stopped, which is between two chunks of its sound. So there is a reference for each chunk, and the heard
sentence must equal one of them, sample by sample.

The program reads a JSON list from standard input: the words per minute, and the texts. In each turn, it stops the first
text after one more chunk, and writes the other texts: a line with the number of samples, and then the 16-bit samples.
"""

from __future__ import annotations

import functools
import json
import os
import sys
from typing import TYPE_CHECKING

import numpy as np

from tests.conformance.hearing import QUICK, render_quick
from tests.support.compare import assert_heard, assert_only_beginning, assert_silent, extent, matching_length
from tests.support.espeak import Library
from tests.support.recording import LOUD
from tests.support.reference import run

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    import numpy.typing as npt

    from tests.support.compare import Comparison
    from tests.support.recording import Recording

    Samples = npt.NDArray[np.int16]

#: Maximum number of samples at the start of a sentence that the monitor may have dropped. At least `_SILENCE` samples
#: remain of the silence between two sentences.
DROPPED = 240
_SILENCE = 64
#: Minimum number of equal samples in a row at the start of a sentence.
_SAME = 32


def assert_heard_after_stop(
    heard: Recording | Samples,
    stopped: str,
    following: Sequence[str],
    *,
    first_heard: bool = True,
) -> list[Comparison]:
    """Assert that the beginning of a new engine's first sentence was heard, and then the following ones whole.

    The sound must match the references of one place of the stop. The most similar ones are tried first. Unless
    `first_heard`, nothing of the first sentence may have been heard. Return the comparisons of the following ones.
    """
    samples = heard if isinstance(heard, np.ndarray) else heard.samples
    wrong: AssertionError | None = None
    turns = _render_after_stop((stopped, *following), QUICK)
    (beginning,) = render_quick([stopped])
    # The sound server may join the two sentences without any silence between them.
    for start, references in likeliest(samples, turns, [matching_length(samples, beginning)] if first_heard else []):
        try:
            if first_heard:
                assert_only_beginning(samples[:start], beginning)
            elif start:  # otherwise it is the first recorded sample
                assert_silent(samples[:start])
            return assert_heard(samples[start:], references)
        except AssertionError as error:
            wrong = wrong or error
    assert wrong, f"{following[0]!r} was not heard after a silence, wherever {stopped!r} was stopped"
    raise wrong


def likeliest(
    samples: Samples, turns: Sequence[list[Samples]], ends: Sequence[int] = ()
) -> Iterator[tuple[int, list[Samples]]]:
    """Yield the places where the next sentence may start, with the references of a turn, the best match first.

    A sentence may start after a silence, or with the first sound after one of the `ends` of the previous sentence.
    """
    loud = np.flatnonzero(np.abs(samples.astype(np.int32)) > LOUD)
    silence = np.diff(loud, prepend=-DROPPED)
    possible = silence >= _SILENCE
    possible[[index for index in np.searchsorted(loud, ends) if index < len(loud)]] = True
    starts = loud[possible]
    before = np.minimum(silence[possible] - 1, DROPPED)
    candidates = []
    for references in turns:
        first, last = extent(references[0]) or (0, 0)
        wanted = references[0][first:last]
        for start, quiet in zip(starts.tolist(), before.tolist(), strict=True):
            same = _same(samples[start : start + len(wanted)], wanted)
            candidates += [(same, max(0, start - quiet), references)] if same else []
    for _, start, references in sorted(candidates, key=lambda candidate: -candidate[0]):
        yield start, references


def _same(samples: Samples, wanted: Samples) -> int:
    """Return the number of equal samples, although the first of the wanted ones may have been dropped."""
    for dropped in np.flatnonzero(wanted[:DROPPED] == samples[0]):
        rest = wanted[dropped:]
        length = min(len(samples), len(rest))
        different = np.flatnonzero(samples[:length] != rest[:length])
        same = int(different[0]) if len(different) else length
        if same >= _SAME:
            return same
    return 0


@functools.cache
def _render_after_stop(texts: tuple[str, ...], rate: int) -> list[list[Samples]]:
    """Return the sentences after the first text, for each place where the first can be stopped."""
    sentences: list[Samples] = []
    rest = run(["-m", __name__], json.dumps([rate, *texts]), timeout=60)
    while rest:
        line, _, rest = rest.partition(b"\n")
        end = 2 * int(line)
        sentences.append(np.frombuffer(rest[:end], "<i2").astype(np.int16))
        rest = rest[end:]
    count = len(texts) - 1
    return [sentences[start : start + count] for start in range(0, len(sentences), count)]


def main() -> None:
    """Render the texts of standard input. Each turn is a child process, forked at the place of the stop."""
    rate, first, *following = json.load(sys.stdin)
    pieces: list[bytes] = []
    stopping: bool | None = False  # None while nothing should be stopped any more

    def take(sound: bytes, _: object) -> bool:
        nonlocal stopping
        if sound:
            pieces.append(sound)
            stopping = stopping if stopping is not False else _turn()
        return stopping is True

    library = Library(take)
    library.speak(first, rate=rate)
    if not stopping:
        return
    stopping = None
    for text in following:
        pieces.clear()
        library.speak(text, rate=rate)
        sound = b"".join(pieces)
        sys.stdout.buffer.write(b"%d\n" % (len(sound) // 2) + sound)
    sys.stdout.buffer.flush()
    os._exit(0)


def _turn() -> bool:
    """Fork; return True in the child, and False in the parent after the child has ended."""
    child = os.fork()
    if child:
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        if status:
            print(f"a rendering exited with {status}", file=sys.stderr, flush=True)
            os._exit(1)  # the library would ignore an exception in its callback
    return child == 0


if __name__ == "__main__":
    main()
