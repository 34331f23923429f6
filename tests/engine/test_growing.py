"""Texts that grow while an engine process speaks them. They sound like whole texts, and report the same words."""

from __future__ import annotations

import contextlib
import time
from typing import TYPE_CHECKING

import pytest

from talkcli.engine import protocol
from talkcli.goals.reasons import Reason
from tests.engine.process import Engine, SharedEngine
from tests.support.compare import assert_heard
from tests.support.reference import Sentence, render
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from tests.support.sink import Sink

TEXT = "I found it. Shall I go there?"
RATE = 450


def grow(engine: Engine, text: str, goal: str = "g1", *, interval_s: float = 0.0, end: bool = True) -> None:
    """Send a text in tokens of four characters."""
    tokens = [text[at : at + 4] for at in range(0, len(text), 4)]
    engine.send(protocol.Speak(goal, tokens[0], RATE, 1.0, None, 50, more=True))
    for token in tokens[1:]:
        time.sleep(interval_s)
        engine.send(protocol.Append(goal, token, end=False))
    if end:
        engine.send(protocol.Append(goal, "", end=True))


@pytest.fixture(scope="module")
def shared() -> Iterator[SharedEngine]:
    with contextlib.closing(SharedEngine(Engine)) as shared:
        yield shared


def test_a_growing_text_is_heard_like_a_whole_one(sink: Sink) -> None:
    with Engine("pulse", environment=sink.env) as engine, sink.record() as recording:
        grow(engine, TEXT, interval_s=0.02)
        ended = engine.until(protocol.Ended)
        recording.wait_until_quiet(0.3)
    assert (ended.outcome, ended.gaps) == (protocol.OUTCOME_COMPLETED, 0)
    assert_heard(recording, render([Sentence(TEXT, rate=RATE)]))


def test_words_have_their_places_in_the_whole_text(tmp_path: Path) -> None:
    with Engine(f"file:{tmp_path / 'out.wav'}") as engine:
        whole = engine.spoken(TEXT)
        grow(engine, TEXT, "g2")
        ended = engine.until(protocol.Ended)
        words, grown = engine.words(), engine.words("g2")
    assert [(word.start, word.end, word.number) for word in grown] == [
        (word.start, word.end, word.number) for word in words
    ]
    assert [word.time for word in grown] == pytest.approx([word.time for word in words], abs=0.03)
    assert ended.duration == pytest.approx(whole.duration, abs=0.03)


def test_missing_text_is_reported_once_and_so_is_its_end(engine: Engine) -> None:
    grow(engine, "One. ", end=False)
    missing = [engine.until(protocol.TextMissing).missing]  # nothing can be spoken yet
    missing += [engine.until(protocol.TextMissing).missing for _ in range(2)]
    engine.send(protocol.Append("g1", "Two.", end=True))
    missing.append(engine.until(protocol.TextMissing).missing)
    ended = engine.until(protocol.Ended)
    assert missing == [True, False, True, False]
    assert (ended.outcome, ended.gaps, len(engine.words())) == (protocol.OUTCOME_COMPLETED, 0, 2)


def test_missing_text_is_reported_if_the_silence_at_the_end_is_held_back(sink: Sink) -> None:
    before = "from talkcli.engine.child.players import chooser; chooser.HandoverTimes.silence_to_cut = lambda *_: 1.0"
    with Engine("aplay", environment=sink.env, before=before) as engine:
        grow(engine, "One. ", end=False)
        assert [engine.until(protocol.TextMissing).missing for _ in range(3)] == [True, False, True]


def test_the_end_of_a_text_may_come_after_all_of_it_was_heard(engine: Engine) -> None:
    grow(engine, "One.", end=False)
    assert [engine.until(protocol.TextMissing).missing for _ in range(3)] == [True, False, True]
    engine.send(protocol.Append("g1", " ", end=True))
    assert engine.until(protocol.Ended).outcome == protocol.OUTCOME_COMPLETED


def test_a_goal_that_waits_for_text_can_be_stopped_and_paused(engine: Engine) -> None:
    with limits():
        for goal in ("g1", "g2"):
            grow(engine, "One.", goal, end=False)
            assert [engine.until(protocol.TextMissing).missing for _ in range(3)] == [True, False, True]
            if goal == "g1":
                assert_within(engine.stop(goal), 0.05, "a stop while text is missing")
        assert_within(engine.pause("g2"), 0.2, "a pause while text is missing")
        engine.send(protocol.Append("g2", " Two.", end=True))
        engine.resume("g2")
        assert engine.until(protocol.Ended).outcome == protocol.OUTCOME_COMPLETED
        assert [word.number for word in engine.words("g2")] == [1, 2]
        grow(engine, "One", "g3", end=False)
        engine.until(protocol.TextMissing)
        engine.pause("g3")
        engine.send(protocol.Append("g3", ".", end=True))
        engine.resume("g3")
        event = engine.event()
        assert isinstance(event, protocol.TextMissing), "text from a pause is spoken only after a sign of life"
        engine.until(protocol.Ended)


@pytest.mark.parametrize("whole", [False, True], ids=["appended", "sent again"])
def test_an_incomplete_sentence_at_the_end_of_a_broken_text_is_not_spoken(engine: Engine, whole: bool) -> None:
    text = "One two. Three fo"
    if whole:
        engine.send(protocol.Speak("g1", text, RATE, 1.0, None, 50, broken=True))
    else:
        grow(engine, text, end=False)
        engine.send(protocol.Append("g1", "", end=True, broken=True))
    assert engine.until(protocol.Ended).outcome == protocol.OUTCOME_COMPLETED
    assert [text[word.start : word.end] for word in engine.words()] == ["One", "two"]


def test_text_for_a_goal_that_has_ended_is_ignored(engine: Engine) -> None:
    grow(engine, "One.")
    engine.until(protocol.Ended)
    engine.send(protocol.Append("g1", " Two.", end=True))
    assert engine.spoken("Three.", "g2").outcome == protocol.OUTCOME_COMPLETED
    assert len(engine.words("g1")) == len(engine.words("g2")) == 1


def test_another_driver_refuses_a_growing_text() -> None:
    with Engine(driver="dummy") as engine:
        grow(engine, "One. Two.")
        ended = engine.until(protocol.Ended)
        assert (ended.outcome, ended.reason) == (protocol.OUTCOME_FAILED, Reason.BAD_OPTION)
        assert ended.message == "this driver can't speak growing texts; send the text when it is complete"
        assert engine.spoken("Three.", "g2").outcome == protocol.OUTCOME_COMPLETED
