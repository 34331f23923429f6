"""Speech recognition with pocketsphinx: which of some sentences was spoken, and when was each word spoken?

pocketsphinx needs 16,000 samples per second, and has a resolution of 10 ms. Its wheel includes the model. Only CI
installs it, because 29 MB are too much for `.[test]`.
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
#: A word in lower case.
WORD = re.compile(r"[a-z']+")
#: pocketsphinx's samples and frames per second.
_RECOGNIZER_RATE, _FRAME_RATE = 16000, 100
#: Silence that is added at both ends, because the model needs some.
_PADDING_S = 0.3
#: Level of the noise that is added, as in a quiet room: 64 dB below full scale. The model wasn't trained with digital
#: silence. Without noise, it recognizes only 6 of 20 sentences by libespeak-ng, which is silent between sounds.
_NOISE = 20
#: Wide beams keep unlikely hypotheses. This is affordable, because there are only a few sentences.
_BEAMS = {"beam": 1e-80, "pbeam": 1e-80, "wbeam": 1e-60}
#: Silence is quieter than this level (1/100 of full scale) for this time, which is longer than a closure in a word.
_SILENCE_LEVEL, _SILENCE_S = 327, 0.1
_RANGE = (-32768, 32767)
#: Segments that aren't words.
_NO_WORD = re.compile(r"[<\[]")


class HeardWord(NamedTuple):
    """A word with its begin and end in seconds from the first sample."""

    word: str
    begin: float
    end: float


def recognize(samples: Samples, sentences: Iterable[str]) -> str:
    """Return the sentence that was spoken, or "" if it is none of these. Sentences consist of words in lower case."""
    rules = " | ".join(sentences)
    decoder = _decoder()
    decoder.add_jsgf_string("sentences", f"#JSGF V1.0;\ngrammar sentences;\npublic <one> = {rules} ;\n")
    decoder.activate_search("sentences")
    _process(decoder, samples)
    hypothesis = decoder.hyp()
    return str(hypothesis.hypstr) if hypothesis else ""


def align(samples: Samples, text: str) -> list[HeardWord]:
    """Return the time of each word of a sentence. Raise AssertionError if the sentence wasn't recognized.

    The recognizer counts the silence before a word as a part of it. This function doesn't.
    """
    words = WORD.findall(text.lower())
    decoder = _decoder()
    decoder.set_align_text(" ".join(words))
    _process(decoder, samples)
    heard = [
        HeardWord(
            re.sub(r"\(\d+\)$", "", segment.word),
            _skip_silence(samples, _seconds(segment.start_frame)),
            _seconds(segment.end_frame + 1),
        )
        for segment in decoder.seg() or ()
        if not _NO_WORD.match(segment.word)
    ]
    assert [word.word for word in heard] == words, f"{text!r} was not heard, but {heard}"
    return heard


@functools.cache
def _decoder() -> Any:
    """Return a decoder without a language model, or skip the test if pocketsphinx is not installed."""
    needs_packages(PACKAGE)
    import pocketsphinx

    return pocketsphinx.Decoder(samprate=_RECOGNIZER_RATE, lm=None, loglevel="FATAL", **_BEAMS)


def _process(decoder: Any, samples: Samples) -> None:
    padding = np.zeros(int(_PADDING_S * _RECOGNIZER_RATE), np.int16)
    sound = np.concatenate([padding, resample(samples, RATE, _RECOGNIZER_RATE), padding])
    noise = np.random.default_rng(1).normal(0, _NOISE, len(sound))
    decoder.start_utt()
    decoder.process_raw(np.clip(sound + noise, *_RANGE).astype("<i2").tobytes(), full_utt=True)
    decoder.end_utt()


def _skip_silence(samples: Samples, begin: float) -> float:
    """Return the end of the silence at this time, or the time itself if there is no silence."""
    loud = np.flatnonzero(np.abs(samples.astype(np.int32)) > _SILENCE_LEVEL)
    place = int(np.searchsorted(loud, begin * RATE))
    if place == len(loud):
        return begin
    before = loud[place - 1] if place else -len(samples)
    return float(loud[place]) / RATE if loud[place] - before > _SILENCE_S * RATE else begin


def _seconds(frame: int) -> float:
    return frame / _FRAME_RATE - _PADDING_S


def resample(samples: Samples, rate: int, wanted: int) -> Samples:
    """Return a sound at another sample rate, without frequencies that are too high for it."""
    length = round(len(samples) * wanted / rate)
    spectrum = np.fft.rfft(samples.astype(np.float64))
    result = np.zeros(length // 2 + 1, np.complex128)
    common = min(len(spectrum), len(result))
    result[:common] = spectrum[:common]
    sound = np.fft.irfft(result, length) * (length / len(samples))
    limited: Samples = np.clip(np.round(sound), *_RANGE).astype(np.int16)
    return limited
