"""How loud and how fast it is, measured where it is heard."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.conformance.hearing import HELP, HOME, QUICK, assert_same, heard
from tests.support.compare import loudness
from tests.support.reference import Sentence

if TYPE_CHECKING:
    from tests.conformance.voices import Voice
    from tests.conftest import MakeTalk
    from tests.support.processes import Talk
    from tests.support.sink import Sink


def test_row_28_half_the_volume_is_heard_as_half(make_talk: MakeTalk, sink: Sink, voice: Voice) -> None:
    found = []
    for volume in (0.5, 1.0):
        talk = voice.serve(make_talk, sink, "--volume", str(volume))
        assert talk.run("say", "--wait", "--", HELP).code == 0
        samples = heard(talk)
        assert_same(samples, voice.render([Sentence(HELP, QUICK, volume)])[0])
        found.append(loudness(samples))
        talk.stop()
    assert found[0] / found[1] == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize("volume", ["1.5", "-0.1", "nan", "loud"])
def test_row_28_a_volume_out_of_range_is_a_usage_error(talk: Talk, volume: str) -> None:
    refused = talk.run("--socket", f"{talk.directory}/other", "serve", "--volume", volume)
    assert (refused.code, refused.out) == (2, "")
    assert "--volume" in refused.err


def test_row_29_half_the_rate_takes_twice_as_long(make_talk: MakeTalk, sink: Sink, voice: Voice) -> None:
    found = []
    for rate in (100, 200):
        talk = voice.serve(make_talk, sink, rate=rate)
        assert talk.run("say", "--wait", "--", HOME).code == 0
        found.append(assert_same(heard(talk), voice.render([HOME], rate)[0]).heard)
        talk.stop()
    assert found[0] / found[1] == pytest.approx(2, abs=0.4)
