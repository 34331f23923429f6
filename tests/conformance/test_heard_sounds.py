"""Sounds at the sound server, beside sentences."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.conformance.hearing import LOW, heard
from tests.support.compare import assert_heard
from tests.support.recording import LOUD
from tests.support.reference import RATE, render
from tests.support.wav import pitch, write_tone

if TYPE_CHECKING:
    from pathlib import Path

    from tests.conftest import MakeTalk
    from tests.support.sink import Sink


def test_a_sound_is_heard_and_a_sentence_follows(make_talk: MakeTalk, sink: Sink, tmp_path: Path) -> None:
    write_tone(tmp_path / "tone.wav", 0.5, 44_100, channels=2, bits=24)
    talk = make_talk("--sounds", str(tmp_path), sink=sink)
    sound = talk.run("play", "tone").id
    assert talk.run("say", "--wait", "--", LOW).code == 0
    assert talk.watcher.states(sound) == ["PENDING", "ACTIVE", "SUCCEEDED"]
    goal = talk.goal(sound)
    assert (goal["format"], goal["text"], goal["message"]) == ("sound", "tone", "Talk completed successfully")
    assert (goal["spoken"], goal["spoken_end"], goal["voice"]) == (None, None, None)
    assert (goal["duration"], goal["heard"]) == pytest.approx((0.5, 0.5), abs=0.001)
    samples = heard(talk)
    loud = np.flatnonzero(np.abs(samples.astype(int)) > LOUD)
    end = loud[np.flatnonzero(np.diff(loud) > 0.1 * RATE)[0]] + 1
    tone = samples[loud[0] : end]
    assert len(tone) / RATE == pytest.approx(0.5, abs=0.02)
    assert pitch(tone, RATE) == pytest.approx(1_000, rel=0.01)
    assert_heard(samples[end:], render([LOW]))
