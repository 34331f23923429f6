"""What libespeak-ng itself makes of sentences after one that it was told to stop: a program, and what runs it.

A sentence that follows a stopped one differs from the same sentence in any other place, but it depends on nothing but
where the synthesis was stopped, which is between two of the pieces that the library hands over. So there are as many
references as pieces, and what was heard must be one of them, sample by sample.

The program reads a list of texts on standard input, stops the first text after each of its pieces in
turn, and writes for each turn the other texts: for each a line with its number of samples, then these, 16 bit.
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

from tests.support.compare import assert_begun, assert_heard, assert_silent, compare
from tests.support.espeak import _Callback, load
from tests.support.reference import render
from tests.support.surroundings import clean_environment

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from tests.support.compare import Comparison
    from tests.support.espeak import _Event
    from tests.support.recording import Recording

    Samples = npt.NDArray[np.int16]

#: Samples by which a sentence may begin before the place where it fits best: what the monitor may have dropped of it.
#: Between two sentences there is more silence than this.
DROPPED = 240
_SYNCHRONOUS = 2
_DONT_EXIT = 0x8000
_UTF8_AND_END_PAUSE = 0x1001
_RATE = 1
_WORDS_PER_MINUTE = 200


def assert_heard_after_stop(
    heard: Recording | Samples, stopped: str, following: Sequence[str], *, begun: bool = True
) -> list[Comparison]:
    """Assert that a beginning of a fresh engine's first sentence was heard, then the following ones whole.

    Where it had not `begun`, nothing of it may have been heard. Returns how the following ones compare.
    """
    samples = heard if isinstance(heard, np.ndarray) else heard.samples
    best, references = max(
        ((compare(samples, each[0]), each) for each in _render_after_stop((stopped, *following))),
        key=lambda each: each[0].correlation,
    )
    start = max(0, best.offset - DROPPED)
    if begun:
        assert_begun(samples[:start], render([stopped])[0])
    else:
        assert_silent(samples[:start])
    return assert_heard(samples[start:], references)


@functools.cache
def _render_after_stop(texts: tuple[str, ...]) -> list[list[Samples]]:
    """Return what follows the first text, for each place where that can be stopped."""
    done = subprocess.run(
        [sys.executable, "-m", __name__],
        input=json.dumps(texts).encode(),
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
    """Write what standard input asks for; each turn in a fresh child, as the library has a memory."""
    texts = json.load(sys.stdin)
    piece = 1
    while _turn(texts, piece):
        piece += 1


def _turn(texts: list[str], last: int) -> bool:
    """Stop the first text after a number of pieces; False if it has no more than those."""
    child = os.fork()
    if child == 0:
        os._exit(_speak(texts, last))
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if status not in (0, 1):
        sys.exit(f"a rendering ended with {status}")
    return status == 0


def _speak(texts: list[str], last: int) -> int:
    library, data = load()
    if library.espeak_Initialize(_SYNCHRONOUS, 0, data, _DONT_EXIT) <= 0:
        return 2
    pieces: list[bytes] = []
    limit: int | None = last

    def take(wav: ctypes._Pointer[ctypes.c_short], count: int, _: ctypes._Pointer[_Event]) -> int:
        if wav and count > 0:
            pieces.append(ctypes.string_at(wav, count * 2))
        return int(len(pieces) == limit)

    callback = _Callback(take)  # kept for as long as the library may call it
    library.espeak_SetSynthCallback(callback)
    library.espeak_SetVoiceByName(b"en")
    library.espeak_SetParameter(_RATE, _WORDS_PER_MINUTE, 0)
    for text in texts:
        pieces.clear()
        data = text.encode()
        library.espeak_Synth(data, ctypes.c_size_t(len(data) + 1), 0, 0, 0, _UTF8_AND_END_PAUSE, None, None)
        if limit is None:
            sound = b"".join(pieces)
            sys.stdout.buffer.write(b"%d\n" % (len(sound) // 2) + sound)
        elif len(pieces) < limit:
            return 1
        limit = None
    sys.stdout.buffer.flush()
    return 0


if __name__ == "__main__":
    main()
