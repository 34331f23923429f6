"""A conversation with an engine process of one's own, and how it fails; `test_render.py` has the rest."""

from __future__ import annotations

import os
import time
from typing import TYPE_CHECKING

import pytest

from talkcli.doctor import sentence, voice
from talkcli.doctor.sentence import Played
from talkcli.doctor.voice import Engine, Setting
from talkcli.engine import process, protocol
from talkcli.engine.process import Conversation, EngineFailed
from talkcli.goals.states import State

if TYPE_CHECKING:
    from pathlib import Path

CONFIGURE = protocol.Configure(os.getpid(), None, None, None, None, list_voices=False)
SAY = protocol.Say("1", "length=0", 200, 1.0, None, 50)


pytestmark = pytest.mark.usefixtures("scripted_process")


def test_saying_something_to_a_process_that_has_died_raises_how_it_died() -> None:
    with Conversation(CONFIGURE) as engine:
        events = engine.events
        assert isinstance(next(events), protocol.Ready)
        os.kill(engine._process.pid, 9)
        os.waitid(os.P_PID, engine._process.pid, os.WEXITED | os.WNOWAIT)
        with pytest.raises(EngineFailed, match=r"^it was killed by SIGKILL$") as failed:
            engine.say(SAY)
        assert failed.value.reason == "engine_crashed"


def test_a_deadline_ends_a_conversation_in_which_there_is_much_to_hear() -> None:
    with Conversation(CONFIGURE, deadline=time.monotonic() + 0.7) as engine:
        heard: list[protocol.Event] = []
        assert isinstance(next(engine.events), protocol.Ready)
        engine.say(protocol.Say("1", "never-ends", 200, 1.0, None, 50))
        with pytest.raises(TimeoutError):
            heard.extend(engine.events)
        assert any(isinstance(event, protocol.Word) for event in heard)


# -- as doctor tells it


def test_doctor_tells_silence_alike_before_and_after_the_start(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(process, "HANG_AFTER", 0.4)
    hung = Played(State.ABORTED, "engine_hung", "the engine process said nothing for 0.4 s")
    assert sentence.by_engine("hang", Setting(), 1.0, 20.0) == hung
    behaviour = tmp_path / "start"
    behaviour.write_text("hang")
    monkeypatch.setenv("SCRIPTED_START_FILE", str(behaviour))
    monkeypatch.setattr(process, "START_LIMIT", 0.3)
    words = "the engine process said nothing for 0.3 s"
    assert voice.look(Setting()) == Engine(reason="engine_hung", words=words)


def test_doctor_tells_how_an_engine_process_died_and_that_a_sentence_takes_too_long() -> None:
    died = Played(State.ABORTED, "engine_crashed", "it was killed by SIGSEGV")
    assert sentence.by_engine("silent-start crash", Setting(), 1.0, 20.0) == died
    late = Played(State.ABORTED, "engine_hung", "it was not over after 0.5 s")
    assert sentence.by_engine("never-ends", Setting(), 1.0, 0.5) == late
