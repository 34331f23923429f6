"""What is heard of sentences after one that was stopped; and what libespeak-ng itself makes of them: a program.

A sentence that follows a stopped one differs from the same sentence in any other place, but it depends on nothing but
where the synthesis was stopped, which is between two of the pieces that the library hands over. So there are as many
references as pieces, and what was heard must be one of them, sample by sample.

The program reads a list on standard input, the words per minute and the texts. It stops the first text after each of
its pieces in turn, and writes for each turn the other texts: for each a line with its number of samples, then these, 16
bit.
"""

from __future__ import annotations

import ctypes
import functools
import json
import os
import subprocess
import sys
import tempfile
from typing import TYPE_CHECKING

import numpy as np

from tests.conformance.hearing import QUICK
from tests.conformance.voices import ESPEAK
from tests.support.compare import assert_begun, assert_heard, assert_silent, extent, same_until
from tests.support.espeak import _Callback, load
from tests.support.recording import LOUD
from tests.support.surroundings import clean_environment

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    import numpy.typing as npt

    from tests.conformance.voices import Voice
    from tests.support.compare import Comparison
    from tests.support.espeak import _Event
    from tests.support.recording import Recording

    Samples = npt.NDArray[np.int16]

#: Samples by which a sentence may begin before the place where it fits best: what the monitor may have dropped of it.
#: Between two sentences there is more silence than this, of which as much may have been dropped.
DROPPED = 240
_SILENCE = 64
#: Samples in a row that are the same where a sentence begins.
_SAME = 32
_SYNCHRONOUS = 2
_DONT_EXIT = 0x8000
_UTF8_AND_END_PAUSE = 0x1001
_RATE = 1


def assert_heard_after_stop(
    heard: Recording | Samples,
    stopped: str,
    following: Sequence[str],
    *,
    begun: bool = True,
    rate: int = QUICK,
    voice: Voice = ESPEAK,
) -> list[Comparison]:
    """Assert that a beginning of a fresh engine's first sentence was heard, then the following ones whole.

    Where it had not `begun`, nothing of it may have been heard. Returns how the following ones compare. One place where
    it can have been stopped has to be right: the one after which the next sentence is the same for longest comes first.
    """
    samples = heard if isinstance(heard, np.ndarray) else heard.samples
    wrong: AssertionError | None = None
    turns = [voice.render(following, rate)] if voice.repeats else _render_after_stop((stopped, *following), rate)
    beginning = voice.render([stopped], rate)[0]
    # The sound server may join what is left of the one and the next, with no silence between them.
    for start, references in likeliest(samples, turns, [same_until(samples, beginning)] if begun else []):
        try:
            if begun:
                assert_begun(samples[:start], beginning)
            elif start:  # else it is the first that was recorded
                assert_silent(samples[:start])
            return assert_heard(samples[start:], references)
        except AssertionError as error:
            wrong = wrong or error
    assert wrong, f"{following[0]!r} was not heard behind silence, wherever {stopped!r} was stopped"
    raise wrong


def likeliest(
    samples: Samples, turns: Sequence[list[Samples]], ends: Sequence[int] = ()
) -> Iterator[tuple[int, list[Samples]]]:
    """Yield where the next sentence may begin, and what it and those behind it sound like then.

    That is behind silence, or with the first sound behind one of the `ends` of the one before it.
    """
    loud = np.flatnonzero(np.abs(samples.astype(np.int32)) > LOUD)
    silence = np.diff(loud, prepend=-DROPPED)
    may = silence >= _SILENCE
    may[[place for place in np.searchsorted(loud, ends) if place < len(loud)]] = True
    begins = loud[may]
    before = np.minimum(silence[may] - 1, DROPPED)
    found = []
    for references in turns:
        first, last = extent(references[0]) or (0, 0)
        wanted = references[0][first:last]
        for begin, quiet in zip(begins.tolist(), before.tolist(), strict=True):
            same = _same(samples[begin : begin + len(wanted)], wanted)
            found += [(same, max(0, begin - quiet), references)] if same else []
    for _, start, references in sorted(found, key=lambda each: -each[0]):
        yield start, references


def _same(samples: Samples, wanted: Samples) -> int:
    """Return for how long samples are the same as what is wanted, of which the first may have been dropped."""
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
    """Return what follows the first text, for each place where that can be stopped."""
    done = subprocess.run(
        [sys.executable, "-m", __name__],
        input=json.dumps([rate, *texts]).encode(),
        capture_output=True,
        timeout=60,
        env=clean_environment(tempfile.gettempdir()),
        check=False,
    )
    assert done.returncode == 0, f"no reference rendering: {done.stderr.decode(errors='replace')}"
    found: list[Samples] = []
    rest = done.stdout
    while rest:
        line, _, rest = rest.partition(b"\n")
        end = 2 * int(line)
        found.append(np.frombuffer(rest[:end], "<i2").astype(np.int16))
        rest = rest[end:]
    each = len(texts) - 1
    return [found[start : start + each] for start in range(0, len(found), each)]


def main() -> None:
    """Write what standard input asks for; each turn in a child that stops, forked where it does: it has that memory."""
    rate, first, *following = json.load(sys.stdin)
    library, data = load()
    if library.espeak_Initialize(_SYNCHRONOUS, 0, data, _DONT_EXIT) <= 0:
        sys.exit("libespeak-ng cannot be initialised: its data is missing")
    pieces: list[bytes] = []
    stopping: bool | None = False  # None where nothing is to be stopped any more

    def take(wav: ctypes._Pointer[ctypes.c_short], count: int, _: ctypes._Pointer[_Event]) -> int:
        nonlocal stopping
        if wav and count > 0:
            pieces.append(ctypes.string_at(wav, count * 2))
            stopping = stopping if stopping is not False else _turn()
        return int(stopping is True)

    callback = _Callback(take)  # kept for as long as the library may call it
    library.espeak_SetSynthCallback(callback)
    library.espeak_SetVoiceByName(b"en")
    library.espeak_SetParameter(_RATE, rate, 0)
    _speak(library, first)
    if not stopping:
        return
    stopping = None
    for text in following:
        pieces.clear()
        _speak(library, text)
        sound = b"".join(pieces)
        sys.stdout.buffer.write(b"%d\n" % (len(sound) // 2) + sound)
    sys.stdout.buffer.flush()
    os._exit(0)


def _turn() -> bool:
    """Return True in a child, and False when that has ended."""
    child = os.fork()
    if child:
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        if status:
            print(f"a rendering ended with {status}", file=sys.stderr, flush=True)
            os._exit(1)  # what is raised here, within a call of the library, would be ignored
    return child == 0


def _speak(library: ctypes.CDLL, text: str) -> None:
    data = text.encode()
    library.espeak_Synth(data, ctypes.c_size_t(len(data) + 1), 0, 0, 0, _UTF8_AND_END_PAUSE, None, None)


if __name__ == "__main__":
    main()
