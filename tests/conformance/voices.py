"""The voices of the conformance tests: their servers, and the references for their sound.

libespeak-ng renders a sentence differently if it has spoken before. A neural voice without noise always renders the
same samples, so `say -o` renders its references.
"""

from __future__ import annotations

import functools
import wave
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.conformance.hearing import QUICK
from tests.support.neural_server import serve_with_voice
from tests.support.processes import run_talk
from tests.support.real_voice import REAL_VOICE
from tests.support.reference import Rendering, Sentence, render, render_with_words
from tests.support.surroundings import clean_environment

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import numpy.typing as npt

    from tests.conftest import MakeTalk
    from tests.support.processes import Talk
    from tests.support.sink import Sink

    Samples = npt.NDArray[np.int16]
    Environment = Mapping[str, str] | None

#: Marks a test that runs with both voices.
with_both = pytest.mark.parametrize("voice", ["espeak", "joe"], indirect=True)

#: Limit in seconds for rendering a sentence, including the loading of its voice.
_PATIENCE = 30.0


class Espeak:
    """The voice of libespeak-ng, which renders a repeated sentence differently."""

    def serve(self, make_talk: MakeTalk, sink: Sink, *options: str, rate: int = QUICK, env: Environment = None) -> Talk:
        """Start a server that speaks with this voice to a recorded sink."""
        return make_talk("--rate", str(rate), *options, sink=sink, env=env)

    def render(self, sentences: Sequence[str | Sentence], rate: int = QUICK) -> list[Samples]:
        """Return the samples of each sentence, as a new server's first sentences."""
        return render(sentences, rate=rate)

    def render_with_words(self, sentence: Sentence) -> Rendering:
        """Return the samples and the English words of a new server's first sentence."""
        return render_with_words([sentence])[0]


ESPEAK = Espeak()


@dataclass(frozen=True)
class Joe:
    """A real neural voice without noise. `voices` contains its files, and `cache` its split model."""

    voices: str
    cache: str

    def serve(self, make_talk: MakeTalk, sink: Sink, *options: str, rate: int = QUICK, env: Environment = None) -> Talk:
        env = {**self.places, **(env or {})}
        return serve_with_voice(make_talk, REAL_VOICE, "--rate", str(rate), *options, sink=sink, env=env)

    def render(self, sentences: Sequence[str | Sentence], rate: int = QUICK) -> list[Samples]:
        return [self._rendered(text if isinstance(text, Sentence) else Sentence(text, rate)) for text in sentences]

    @property
    def places(self) -> dict[str, str]:
        return {"TALK_VOICES": self.voices, "XDG_CACHE_HOME": self.cache}

    @functools.cache  # noqa: B019 - there is only one instance
    def _rendered(self, sentence: Sentence) -> Samples:
        path = f"{self.cache}/rendered.wav"
        options = ["--rate", str(sentence.rate), "--volume", str(sentence.volume), "--voice", REAL_VOICE]
        env = clean_environment(self.cache, self.places)
        code, _, error = run_talk(["say", "-o", path, *options, "--", sentence.text], env, _PATIENCE)
        assert code == 0, error
        with wave.open(path) as file:
            samples = np.frombuffer(file.readframes(file.getnframes()), "<i2").astype(np.int16)
        samples.flags.writeable = False
        return samples


Voice = Espeak | Joe
