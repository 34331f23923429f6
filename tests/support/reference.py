"""Reference renderings of sentences, made by libespeak-ng without talk.

In one process, libespeak-ng renders the same sentence differently each time. But each new process makes the same
samples for the same texts in the same order. So each reference is rendered in a new process, with the same texts and
settings.
"""

from __future__ import annotations

import functools
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tests.support.espeak import RATE
from tests.support.surroundings import clean_environment

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    Samples = npt.NDArray[np.int16]

__all__ = ["RATE", "Rendering", "Sentence", "render", "render_with_words", "without_leading_zeros"]

_PROGRAM = os.path.join(os.path.dirname(os.path.abspath(__file__)), "espeak.py")


@dataclass(frozen=True, slots=True)
class Sentence:
    """A text and its settings, which have talk's defaults."""

    text: str
    rate: int = 200  # words per minute
    volume: float = 1.0  # 0 to 1
    voice: str = "en"
    pitch: int = 50  # 0 to 100


@dataclass(frozen=True, slots=True)
class Rendering:
    """The sound of a sentence, and the times of its words."""

    samples: Samples
    #: start and end of each word in the text, and its time in seconds. libespeak-ng joins some neighbouring words
    words: tuple[tuple[int, int, float], ...]


def render(
    sentences: Sequence[str | Sentence],
    *,
    rate: int = 200,
    volume: float = 1.0,
    voice: str = "en",
    pitch: int = 50,
    timeout: float = 30,
) -> list[Samples]:
    """Return the samples of each sentence (22,050 Hz), rendered in order in one new process.

    The settings apply to sentences that are plain strings.
    """
    plain = Sentence("", rate, volume, voice, pitch)
    complete = [replace(plain, text=item) if isinstance(item, str) else item for item in sentences]
    return [rendering.samples for rendering in render_with_words(complete, timeout=timeout)]


def without_leading_zeros(samples: Samples) -> Samples:
    """Return the samples from the first one that isn't zero, as talk plays the first sentence of a server."""
    return samples[np.argmax(samples != 0) :]


def render_with_words(sentences: Sequence[str | Sentence], *, timeout: float = 30) -> list[Rendering]:
    """Return the rendering of each sentence, as `render` does, with its words."""
    return list(_rendered(tuple(Sentence(item) if isinstance(item, str) else item for item in sentences), timeout))


@functools.cache
def _rendered(sentences: tuple[Sentence, ...], timeout: float) -> tuple[Rendering, ...]:
    result: list[Rendering] = []
    rest = run([_PROGRAM], json.dumps([asdict(sentence) for sentence in sentences]), timeout)
    for _ in sentences:
        line, _newline, rest = rest.partition(b"\n")
        head = json.loads(line)
        end = head["samples"] * 2
        samples = np.frombuffer(rest[:end], dtype="<i2").astype(np.int16)
        samples.flags.writeable = False  # all tests share the array
        result.append(Rendering(samples, tuple((start, stop, at) for start, stop, at in head["words"])))
        rest = rest[end:]
    return tuple(result)


def run(program: Sequence[str], request: str, timeout: float) -> bytes:
    """Run a Python program that renders sentences, and return its output."""
    env = clean_environment(tempfile.gettempdir())
    done = subprocess.run(
        [sys.executable, *program], input=request.encode(), capture_output=True, timeout=timeout, env=env, check=False
    )
    assert done.returncode == 0, f"no reference was rendered: {done.stderr.decode(errors='replace').strip()}"
    return done.stdout
