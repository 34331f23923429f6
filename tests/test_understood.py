"""Speech is understood by somebody who has nothing to do with it: a recognizer, which hears what the loudspeaker gets.

It chooses among twenty sentences of a robot, so by chance one of them would be right.
"""

from __future__ import annotations

import wave
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.support.espeak import RATE
from tests.support.listener import PACKAGE, understand
from tests.support.loaded import serve_with
from tests.support.real_voice import REAL_VOICE, real_voice
from tests.support.surroundings import needs_packages

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tests.conftest import MakeTalk
    from tests.support.processes import Talk
    from tests.support.recording import Samples
    from tests.support.sink import Sink

SENTENCES = [
    "battery low",
    "please step aside",
    "emergency stop activated",
    "i am returning to the charging station",
    "the door is blocked",
    "following you now",
    "obstacle detected ahead",
    "your delivery has arrived",
    "please take your package",
    "i have lost my position",
    "task completed",
    "waiting for the elevator",
    "turning left",
    "turning right",
    "please keep your distance",
    "the gripper is empty",
    "connection to the server lost",
    "going to the kitchen",
    "hello how can i help you",
    "speech volume is now at fifty percent",
]
#: Of twenty, how many are understood at least.
AT_LEAST = 19
#: By its id: "en" is the language, and in such a server the neural voice of it.
ESPEAK = "gmw/en"


def misunderstood(heard: Callable[[str, str], Samples]) -> dict[str, list[tuple[str, str]]]:
    """Return, of each voice, the sentences that were understood as another, and what as.

    `heard`: says a sentence with a voice, and returns what is heard of it. The voices take turns.
    """
    wrong: dict[str, list[tuple[str, str]]] = {ESPEAK: [], REAL_VOICE: []}
    for sentence in SENTENCES:
        for voice, told in wrong.items():
            found = understand(heard(sentence, voice), SENTENCES)
            if found != sentence:
                told.append((sentence, found))
    return wrong


def say(talk: Talk, sentence: str, voice: str) -> None:
    done = talk.run("say", "--wait", "--voice", voice, "--", sentence)
    assert (done.code, talk.goal(done.id)["voice"]) == (0, voice), done


def assert_understood(wrong: dict[str, list[tuple[str, str]]]) -> None:
    print(f"understood of {len(SENTENCES)}: { ({each: len(SENTENCES) - len(told) for each, told in wrong.items()}) }")
    assert len(wrong[REAL_VOICE]) <= len(SENTENCES) - AT_LEAST, wrong
    assert len(wrong[REAL_VOICE]) <= len(wrong[ESPEAK]), wrong


def test_what_a_neural_voice_writes_into_a_file_is_understood(make_talk: MakeTalk, tmp_path: Path) -> None:
    real_voice()
    needs_packages(PACKAGE)
    path = tmp_path / "speech.wav"
    env = {"XDG_CACHE_HOME": str(tmp_path / "cache")}
    talk = serve_with(make_talk, REAL_VOICE, "--player", f"file:{path}", sink=None, env=env)
    before = 0

    def written(sentence: str, voice: str) -> Samples:
        nonlocal before
        say(talk, sentence, voice)
        with wave.open(str(path)) as file:
            samples = np.frombuffer(file.readframes(file.getnframes()), "<i2").astype(np.int16)
        begin, before = before, len(samples)
        return samples[begin:]

    assert_understood(misunderstood(written))


@pytest.mark.slow  # each sentence takes as long as it is, with either voice: a minute and a half
def test_what_is_heard_of_a_neural_voice_is_understood(make_talk: MakeTalk, sink: Sink, tmp_path: Path) -> None:
    real_voice()
    needs_packages(PACKAGE)
    env = {"XDG_CACHE_HOME": str(tmp_path / "cache")}
    talk = serve_with(make_talk, REAL_VOICE, sink=sink, env=env)

    def heard(sentence: str, voice: str) -> Samples:
        with sink.record() as recording:
            say(talk, sentence, voice)
        return recording.samples

    assert_understood(misunderstood(heard))


def test_noise_is_understood_as_nothing() -> None:
    noise = np.random.default_rng(3).normal(0, 3000, 2 * RATE).astype(np.int16)
    assert understand(noise, SENTENCES) == ""
