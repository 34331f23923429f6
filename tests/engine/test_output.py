"""What an engine process tells of its output where a sentence that was held goes on by another player."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest

from talkcli.engine import protocol
from tests.engine.spawned import Spawned

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.sink import Sink

TEXT = "battery low, please bring this robot back"
#: A player is let go of at once where the sentence is held.
AT_ONCE = {"RELEASE_AFTER": 0.0}


def _held(engine: Spawned) -> list[protocol.Output]:
    """Begin a sentence and hold it behind its second word; return what was told of the output."""
    engine.say(TEXT)
    engine.until_word(2)
    engine.pause()
    return _told(engine)


def _told(engine: Spawned) -> list[protocol.Output]:
    return [each for each in engine.events if isinstance(each, protocol.Output)]


def test_an_output_that_was_muted_for_a_part_of_the_sentence_stays_so(sink: Sink) -> None:
    sink.pactl("set-sink-mute", "null", "1")
    try:
        with Spawned(None, environment=sink.env, limits=AT_ONCE) as engine:
            (told,) = _held(engine)
            muted = {"player": "pulse", "device": "null", "volume": 1.0, "muted": True}
            assert told.output == muted
            sink.pactl("set-sink-mute", "null", "0")
            engine.resume()
            assert engine.until(protocol.Ended).outcome == protocol.COMPLETED
            assert _told(engine) == [told]
    finally:
        sink.pactl("set-sink-mute", "null", "0")


@pytest.mark.parametrize(("alsa", "goes_on"), [(True, True), (False, False)])
def test_nothing_is_told_of_a_program_that_goes_on_and_nothing_new_if_none_can(
    sink: Sink, tmp_path: Path, alsa: bool, goes_on: bool
) -> None:
    """The sound server's socket is gone when the sentence goes on; aplay has a way of its own, by `.asoundrc`."""
    path = tmp_path / "s"
    path.symlink_to(sink.socket)
    environment = {**sink.env, "PULSE_SERVER": f"unix:{path}", **({} if alsa else {"ALSA_CONFIG_PATH": os.devnull})}
    with Spawned(None, environment=environment, limits=AT_ONCE) as engine:
        (told,) = _held(engine)
        assert told.output is not None
        assert told.output["player"] == "pulse"
        os.unlink(path)
        engine.resume()
        assert engine.until(protocol.Ended).outcome == (protocol.COMPLETED if goes_on else protocol.FAILED)
        assert [each.output for each in _told(engine)[1:]] == ([None] if goes_on else [])
