"""A conversation with one engine process of one's own: texts in their order, and every way in which it fails."""

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


pytestmark = pytest.mark.usefixtures("scripted_process")


def say(number: int, text: str) -> protocol.Say:
    return protocol.Say(f"{number}", text, 200, 1.0, None, 50)


def conversation(texts: list[str]) -> list[protocol.Ended]:
    """Return how the texts ended."""
    ended = []
    waiting = iter(texts)
    with Conversation(CONFIGURE) as engine:
        for event in engine.events:
            if isinstance(event, protocol.Ended):
                ended.append(event)
            if isinstance(event, protocol.Ready | protocol.Ended):
                text = next(waiting, None)
                if text is None:
                    break
                engine.say(say(len(ended) + 1, text))
        process = engine._process
    with pytest.raises(ProcessLookupError):
        os.kill(process.pid, 0)
    return ended


def test_texts_are_spoken_in_their_order_and_the_process_is_gone_then() -> None:
    assert conversation(["length=0.1", "length=0", "length=0.2"]) == [
        protocol.Ended(f"{number}", protocol.COMPLETED, duration=length)
        for number, length in enumerate((0.1, 0.0, 0.2), 1)
    ]


def test_saying_something_to_a_process_that_has_died_raises_how_it_died() -> None:
    with Conversation(CONFIGURE) as engine:
        events = engine.events
        assert isinstance(next(events), protocol.Ready)
        os.kill(engine._process.pid, 9)
        os.waitid(os.P_PID, engine._process.pid, os.WEXITED | os.WNOWAIT)
        with pytest.raises(EngineFailed, match=r"^it was killed by SIGKILL$") as failed:
            engine.say(say(1, "length=0"))
        assert failed.value.reason == "engine_crashed"


def test_a_deadline_ends_a_conversation_in_which_there_is_much_to_hear() -> None:
    with Conversation(CONFIGURE, deadline=time.monotonic() + 0.7) as engine:
        heard: list[protocol.Event] = []
        events = engine.events
        assert isinstance(next(events), protocol.Ready)
        engine.say(say(1, "never-ends"))
        with pytest.raises(TimeoutError):
            heard.extend(events)
        assert any(isinstance(event, protocol.Word) for event in heard)


# What doctor makes of it


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
