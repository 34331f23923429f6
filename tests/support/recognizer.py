"""An independent listener: pocketsphinx, a recognizer of speech whose model is in its wheel; it knows nothing of us.

It hears 16,000 samples per second in steps of 10 ms. What it is asked is which of some sentences was said, and when
each word of a sentence that is known was. CI installs it beside the extra; 29 MB are much for `.[test]`.
"""

from __future__ import annotations

import functools
import re
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from tests.support.espeak import RATE
from tests.support.surroundings import needs_packages

if TYPE_CHECKING:
    from collections.abc import Iterable

    import numpy.typing as npt

    Samples = npt.NDArray[np.int16]

PACKAGE = "pocketsphinx"
#: What it takes for a word, in small letters.
WORD = re.compile(r"[a-z']+")
#: Samples per second that it hears, and how many of its frames are a second.
_HEARS, _FRAMES = 16000, 100
#: Seconds of silence put on either side of what it hears: its model wants some.
_BESIDE = 0.3
#: What a quiet room adds to all of it, in samples of 16 bit: 64 dB below full scale. Zeros are nothing that it was
#: trained with: without this it understands 6 of 20 sentences of libespeak-ng's, which are silent between sounds.
_ROOM = 20
#: How unlikely what it has heard so far may be until it is given up: much, as it has few sentences to choose from.
_BEAMS = {"beam": 1e-80, "pbeam": 1e-80, "wbeam": 1e-60}
#: Samples no louder than this, for so many seconds, are silence: a hundredth of full scale; and longer than a closure
#: within a word.
_FAINT, _SILENCE = 327, 0.1
_RANGE = (-32768, 32767)
#: What is told between words.
_NO_WORD = re.compile(r"[<\[]")


class HeardWord(NamedTuple):
    """A word, and when it begins and ends, in seconds from the first sample."""

    word: str
    begin: float
    end: float


def recognize(samples: Samples, sentences: Iterable[str]) -> str:
    """Return which of the sentences, of small letters and blanks, was said; "" where it is none of them."""
    rules = " | ".join(sentences)
    listener = _listener()
    listener.add_jsgf_string("sentences", f"#JSGF V1.0;\ngrammar sentences;\npublic <one> = {rules} ;\n")
    listener.activate_search("sentences")
    _hear(listener, samples)
    found = listener.hyp()
    return str(found.hypstr) if found else ""


def align(samples: Samples, text: str) -> list[HeardWord]:
    """Return when each word of a sentence was said; AssertionError where it was not, as far as it can be heard.

    What is silent before a word counts as a part of it, to the recognizer; here it doesn't.
    """
    words = WORD.findall(text.lower())
    listener = _listener()
    listener.set_align_text(" ".join(words))
    _hear(listener, samples)
    found = [
        HeardWord(
            re.sub(r"\(\d+\)$", "", each.word),
            _behind_silence(samples, _seconds(each.start_frame)),
            _seconds(each.end_frame + 1),
        )
        for each in listener.seg() or ()
        if not _NO_WORD.match(each.word)
    ]
    assert [each.word for each in found] == words, f"{text!r} was not heard, but {found}"
    return found


@functools.cache
def _listener() -> Any:
    """Return the recognizer, without a language of its own; the test is skipped where it is not installed."""
    needs_packages(PACKAGE)
    import pocketsphinx

    return pocketsphinx.Decoder(samprate=_HEARS, lm=None, loglevel="FATAL", **_BEAMS)


def _hear(listener: Any, samples: Samples) -> None:
    beside = np.zeros(int(_BESIDE * _HEARS), np.int16)
    sound = np.concatenate([beside, resample(samples, RATE, _HEARS), beside])
    room = np.random.default_rng(1).normal(0, _ROOM, len(sound))
    listener.start_utt()
    listener.process_raw(np.clip(sound + room, *_RANGE).astype("<i2").tobytes(), full_utt=True)
    listener.end_utt()


def _behind_silence(samples: Samples, begin: float) -> float:
    """Return when the silence is over in which something begins; if there is none, when it begins."""
    loud = np.flatnonzero(np.abs(samples.astype(np.int32)) > _FAINT)
    place = int(np.searchsorted(loud, begin * RATE))
    if place == len(loud):
        return begin
    before = loud[place - 1] if place else -len(samples)
    return float(loud[place]) / RATE if loud[place] - before > _SILENCE * RATE else begin


def _seconds(frame: int) -> float:
    return frame / _FRAMES - _BESIDE


def resample(samples: Samples, rate: int, wanted: int) -> Samples:
    """Return a sound with another number of samples per second, without what such a one can't hold."""
    length = round(len(samples) * wanted / rate)
    spectrum = np.fft.rfft(samples.astype(np.float64))
    kept = np.zeros(length // 2 + 1, np.complex128)
    both = min(len(spectrum), len(kept))
    kept[:both] = spectrum[:both]
    sound = np.fft.irfft(kept, length) * (length / len(samples))
    limited: Samples = np.clip(np.round(sound), *_RANGE).astype(np.int16)
    return limited
