"""Texts in Markdown sound like the same texts without marks, in an engine process and in a file."""

from __future__ import annotations

import contextlib
import wave
from typing import TYPE_CHECKING

import pytest

from talkcli.engine import protocol
from talkcli.engine.parent.render import render
from talkcli.goals.reasons import Reason
from tests.engine.process import FAST, Engine, SharedEngine

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

TEXT = "## Battery\n**Low**, at `nine`. 😀\n\n```py\nx = 1. y\n```\nSee [the charger](http://a.b/c.d).\n- Now\n"
#: The same text without marks, but with the pauses that they stand for.
CLEAN = "Battery。Low, at nine.\n\nSee the charger.\nNow"
WORDS = ["Battery", "Low", "at", "nine", "See", "the", "charger", "Now"]


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SharedEngine]:
    target = tmp_path_factory.mktemp("markdown") / "out.wav"  # a file is faster than real time
    with contextlib.closing(SharedEngine(lambda: Engine(f"file:{target}"))) as shared:
        yield shared


def speak(
    engine: Engine, *pieces: str, goal: str = "g1", voice: str | None = None, last: bool = True
) -> protocol.Ended:
    """Speak a text in Markdown that arrives in pieces, and return how the goal ended."""
    first = protocol.Speak(
        goal, pieces[0], FAST, 1.0, voice, 50, voice_only=voice is not None, format="markdown", more=len(pieces) > 1
    )
    engine.send(first)
    for number, piece in enumerate(pieces[1:], 2):
        engine.send(protocol.Append(goal, piece, end=number == len(pieces), broken=number == len(pieces) and not last))
    return engine.until(protocol.Ended)


def heard(engine: Engine, text: str, goal: str = "g1") -> list[str]:
    return [text[word.start : word.end] for word in engine.words(goal)]


def test_marks_are_not_spoken_and_words_have_the_offsets_of_the_text(engine: Engine) -> None:
    clean = engine.spoken(CLEAN, "g0", rate=FAST)
    ended = speak(engine, TEXT)
    assert ended.duration == pytest.approx(clean.duration, abs=0.05)
    assert heard(engine, TEXT) == WORDS


def test_a_text_that_grows_is_spoken_alike(engine: Engine) -> None:
    ended = speak(engine, *TEXT, "")
    assert ended.outcome == protocol.OUTCOME_COMPLETED
    assert heard(engine, TEXT) == WORDS


def test_marks_without_text_are_nothing_to_say(engine: Engine) -> None:
    for goal, pieces in (("g1", ["---"]), ("g2", ["**", "**\n", "---"])):
        ended = speak(engine, *pieces, goal=goal)
        assert (ended.outcome, ended.reason) == (protocol.OUTCOME_FAILED, Reason.NOTHING_TO_SAY)


def test_an_incomplete_link_of_a_broken_text_is_not_spoken(engine: Engine) -> None:
    text = ["**One.** Two. ", "See [the docs](http"]
    assert speak(engine, *text, last=False).outcome == protocol.OUTCOME_COMPLETED
    assert heard(engine, "".join(text)) == ["One", "Two"]


def test_a_file_has_the_samples_of_the_text_without_marks(tmp_path: Path) -> None:
    samples = []
    for text, markdown in (
        ("*Battery* `low`, [see the docs](http://a.b).", True),
        ("Battery low, see the docs.", False),
    ):
        render(text, str(tmp_path / "x.wav"), markdown=markdown)
        with wave.open(str(tmp_path / "x.wav")) as file:
            samples.append(file.readframes(file.getnframes()))
    assert samples[0] == samples[1]
