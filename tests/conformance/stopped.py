"""Compares the sound of sentences after a stopped one; and the program that renders their references.

A sentence that follows a stopped one differs from the same sentence elsewhere, but it depends only on the place where
the synthesis was stopped, which is between two pieces of the library's sound. So there is a reference for each piece,
and the heard sentence must be one of them, sample by sample.

The program reads a list on standard input, the words per minute and the texts. It stops the first text after each of
its pieces in turn, and writes the other texts for each turn: a line with the number of samples, then these, 16 bit.
"""

from __future__ import annotations

import functools
import json
import os
import sys
from typing import TYPE_CHECKING

import numpy as np

from tests.conformance.hearing import QUICK
from tests.conformance.voices import ESPEAK
from tests.support.compare import assert_heard, assert_only_beginning, assert_silent, extent, matching_length
from tests.support.espeak import Library
from tests.support.recording import LOUD
from tests.support.reference import run

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    import numpy.typing as npt

    from tests.conformance.voices import Voice
    from tests.support.compare import Comparison
    from tests.support.recording import Recording

    Samples = npt.NDArray[np.int16]

#: Samples by which a sentence may begin before the place where it fits best, as the monitor may have dropped them. At
#: least `_SILENCE` samples are left of the silence between two sentences.
DROPPED = 240
_SILENCE = 64
#: Samples in a row that are the same at the beginning of a sentence.
_SAME = 32


def assert_heard_after_stop(
    heard: Recording | Samples,
    stopped: str,
    following: Sequence[str],
    *,
    begun: bool = True,
    voice: Voice = ESPEAK,
) -> list[Comparison]:
    """Assert that a beginning of a fresh engine's first sentence was heard, then the following ones whole.

    If it had not `begun`, nothing of it may have been heard. Returns how the following ones compare. One place of the
    stop has to be right; the place after which the next sentence is the same for longest comes first.
    """
    samples = heard if isinstance(heard, np.ndarray) else heard.samples
    wrong: AssertionError | None = None
    turns = [voice.render(following, QUICK)] if voice.repeats else _render_after_stop((stopped, *following), QUICK)
    beginning = voice.render([stopped], QUICK)[0]
    # The sound server may join the rest of the first sentence and the next one, with no silence between them.
    for start, references in likeliest(samples, turns, [matching_length(samples, beginning)] if begun else []):
        try:
            if begun:
                assert_only_beginning(samples[:start], beginning)
            elif start:  # otherwise it is the first recorded sample
                assert_silent(samples[:start])
            return assert_heard(samples[start:], references)
        except AssertionError as error:
            wrong = wrong or error
    assert wrong, f"{following[0]!r} was not heard behind silence, wherever {stopped!r} was stopped"
    raise wrong


def likeliest(
    samples: Samples, turns: Sequence[list[Samples]], ends: Sequence[int] = ()
) -> Iterator[tuple[int, list[Samples]]]:
    """Yield the places where the next sentence may begin, with the references of that turn.

    That is behind silence, or with the first sound behind one of the `ends` of the sentence before it.
    """
    loud = np.flatnonzero(np.abs(samples.astype(np.int32)) > LOUD)
    silence = np.diff(loud, prepend=-DROPPED)
    may = silence >= _SILENCE
    may[[place for place in np.searchsorted(loud, ends) if place < len(loud)]] = True
    begins = loud[may]
    before = np.minimum(silence[may] - 1, DROPPED)
    candidates = []
    for references in turns:
        first, last = extent(references[0]) or (0, 0)
        wanted = references[0][first:last]
        for begin, quiet in zip(begins.tolist(), before.tolist(), strict=True):
            same = _same(samples[begin : begin + len(wanted)], wanted)
            candidates += [(same, max(0, begin - quiet), references)] if same else []
    for _, start, references in sorted(candidates, key=lambda place: -place[0]):
        yield start, references


def _same(samples: Samples, wanted: Samples) -> int:
    """Return for how long samples are the same as those wanted, of which the first may have been dropped."""
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
    """Return the sentences that follow the first text, for each place where it can be stopped."""
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
    """Render the texts of standard input; each turn is a child, forked where it stops, so that it has that memory."""
    rate, first, *following = json.load(sys.stdin)
    pieces: list[bytes] = []
    stopping: bool | None = False  # None once nothing is to be stopped any more

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
    """Return True in a child, and False in the parent once the child has ended."""
    child = os.fork()
    if child:
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        if status:
            print(f"a rendering ended with {status}", file=sys.stderr, flush=True)
            os._exit(1)  # an exception within a call of the library would be ignored
    return child == 0


if __name__ == "__main__":
    main()
