"""An independent recognizer understands the speech.

It hears what a player gets, and chooses among twenty sentences. By chance, it would get one of them right.
"""

from __future__ import annotations

import wave
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.support.espeak import RATE
from tests.support.neural_server import serve_with_voice
from tests.support.real_voice import REAL_VOICE, real_voice
from tests.support.recognizer import PACKAGE, recognize
from tests.support.surroundings import needs_packages

if TYPE_CHECKING:
    from pathlib import Path

    from tests.conftest import MakeTalk

SENTENCES = """
battery low
please step aside
emergency stop activated
i am returning to the charging station
the door is blocked
following you now
obstacle detected ahead
your delivery has arrived
please take your package
i have lost my position
task completed
waiting for the elevator
turning left
turning right
please keep your distance
the gripper is empty
connection to the server lost
going to the kitchen
hello how can i help you
speech volume is now at fifty percent
""".strip().splitlines()
#: An id, because the language "en" would select the neural voice if the server uses one.
ESPEAK = "gmw/en"


def count_understood(make_talk: MakeTalk, directory: Path, voice: str, sentences: list[str]) -> int:
    """Speak sentences to a file, which is faster than real time, and return how many of them are recognized."""
    real_voice()
    needs_packages(PACKAGE)
    path = directory / "speech.wav"
    env = {"XDG_CACHE_HOME": str(directory / "cache")}
    talk = serve_with_voice(make_talk, REAL_VOICE, "--player", f"file:{path}", sink=None, env=env)
    before, understood = 0, 0
    for sentence in sentences:
        done = talk.run("say", "--wait", "--voice", voice, "--", sentence)
        assert (done.code, talk.goal(done.id)["voice"]) == (0, voice), done
        with wave.open(str(path)) as file:
            samples = np.frombuffer(file.readframes(file.getnframes()), "<i2").astype(np.int16)
        understood += recognize(samples[before:], SENTENCES) == sentence
        before = len(samples)
    return understood


def test_sentences_of_a_neural_voice_are_understood(make_talk: MakeTalk, tmp_path: Path) -> None:
    assert count_understood(make_talk, tmp_path, REAL_VOICE, SENTENCES[::4]) == len(SENTENCES[::4])


@pytest.mark.slow
def test_a_neural_voice_is_understood_as_well_as_espeak(make_talk: MakeTalk, tmp_path: Path) -> None:
    neural, espeak = (count_understood(make_talk, tmp_path, voice, SENTENCES) for voice in (REAL_VOICE, ESPEAK))
    assert neural >= max(len(SENTENCES) - 1, espeak)


def test_no_sentence_is_recognised_in_noise() -> None:
    noise = np.random.default_rng(3).normal(0, 3000, 2 * RATE).astype(np.int16)
    assert recognize(noise, SENTENCES) == ""
