"""Speech recognition with pocketsphinx: which of some sentences was spoken?

pocketsphinx needs 16,000 samples per second. Its wheel includes the model. Only CI
installs it, because 29 MB are too much for `.[test]`.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import numpy as np

from tests.support.espeak import RATE
from tests.support.surroundings import needs_packages

if TYPE_CHECKING:
    from collections.abc import Iterable

    import numpy.typing as npt

    Samples = npt.NDArray[np.int16]

PACKAGE = "pocketsphinx"
#: pocketsphinx's samples per second.
_RECOGNIZER_RATE = 16000
#: Silence that is added at both ends, because the model needs some.
_PADDING_S = 0.3
#: Level of the noise that is added, as in a quiet room: 64 dB below full scale. The model wasn't trained with digital
#: silence. Without noise, it recognizes only 6 of 20 sentences by libespeak-ng, which is silent between sounds.
_NOISE = 20
#: Wide beams keep unlikely hypotheses. This is affordable, because there are only a few sentences.
_BEAMS = {"beam": 1e-80, "pbeam": 1e-80, "wbeam": 1e-60}
_RANGE = (-32768, 32767)


def recognize(samples: Samples, sentences: Iterable[str]) -> str:
    """Return the sentence that was spoken, or "" if it is none of these. Sentences consist of words in lower case."""
    rules = " | ".join(sentences)
    decoder = _decoder()
    decoder.add_jsgf_string("sentences", f"#JSGF V1.0;\ngrammar sentences;\npublic <one> = {rules} ;\n")
    decoder.activate_search("sentences")
    _process(decoder, samples)
    hypothesis = decoder.hyp()
    return str(hypothesis.hypstr) if hypothesis else ""


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
