"""Sentences that are interrupted at the end of a word, and continued by another `Speak`."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from talkcli.engine import protocol
from talkcli.install import NEURAL_PACKAGES
from tests.engine.process import Engine
from tests.engine.programs import Player, sound
from tests.engine.test_drivers import TIMED_DRIVER
from tests.support import tiny_voice
from tests.support.surroundings import needs_packages
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from pathlib import Path

TEXT = "one two three, four five six"


def _rest(engine: Engine, ended: protocol.Ended) -> dict[str, Any]:
    """Return the fields of the `Speak` that continues an interrupted goal."""
    assert ended.outcome == protocol.OUTCOME_INTERRUPTED, ended
    words = engine.words()
    end = words[-1].end if words else 0
    return {"start": ended.rest, "heard_end": end, "heard_words": len(words), "heard": ended.heard}


def _interrupt(engine: Engine, number: int) -> protocol.Ended:
    """Interrupt the goal at a word, and return its end."""
    if number:
        engine.until_word(number)
    engine.send(protocol.Interrupt("g1"))
    return engine.until(protocol.Ended)


def _speak(text: str = TEXT, rate: int = 450, **fields: Any) -> protocol.Speak:
    return protocol.Speak("g1", text, rate, 1.0, fields.pop("voice", None), 50, **fields)


def _words(engine: Engine) -> list[tuple[int, int, int]]:
    return [(word.start, word.end, word.number) for word in engine.words()]


def _continue_to_the_end(engine: Engine, ended: protocol.Ended, **fields: Any) -> protocol.Ended:
    engine.send(_speak(**fields, **_rest(engine, ended)))
    ended = engine.until(protocol.Ended)
    assert ended.outcome == protocol.OUTCOME_COMPLETED, ended
    times = [word.time for word in engine.words()]
    assert times == sorted(times)
    return ended


def _tiny_voice(folder: Path) -> dict[str, str]:
    """Install the neural voice "piper/tiny", and return the environment for its engine."""
    needs_packages(*NEURAL_PACKAGES)
    tiny_voice.put(folder / "voices", "tiny")
    return {"TALK_VOICES": str(folder / "voices"), "XDG_CACHE_HOME": str(folder / "cache")}


@pytest.mark.parametrize("voice", [None, "piper/tiny"])
def test_the_parts_of_an_interrupted_sentence_have_its_words_and_its_length(tmp_path: Path, voice: str | None) -> None:
    environment = _tiny_voice(tmp_path) if voice else {}
    given: dict[str, Any] = {"text": "one two, three", "voice": voice, "voice_only": voice is not None}
    given["rate"] = 450 if voice else 200  # the tiny voice speaks slowly
    with Engine(environment=environment) as engine:
        engine.send(_speak(**given))
        whole, words = engine.until(protocol.Ended), _words(engine)
        engine.events.clear()
        engine.send(_speak(**given))
        ended = _interrupt(engine, 1)
        engine.send(_speak(**given, **_rest(engine, ended)))
        ended = _continue_to_the_end(engine, _interrupt(engine, 2), **given)
        assert _words(engine) == words
        assert ended.heard == pytest.approx(whole.heard, abs=0.2)
        assert ended.duration == pytest.approx(ended.heard, abs=0.001)


def test_a_word_ends_with_a_fade(player: Player) -> None:
    with limits(), Engine(player.plays()) as engine:
        engine.say(TEXT)
        engine.until_word(4)
        requested_at = time.monotonic()
        ended = _interrupt(engine, 0)
        assert_within(time.monotonic() - requested_at, 0.5, "the end of the word")
        assert ended.rest == engine.words()[-1].end + 1
    heard, whole = (np.frombuffer(each, "<i2") for each in (player.heard.read_bytes(), sound(TEXT)))
    faded = round(0.005 * 22050)
    assert np.array_equal(heard[:-faded], whole[: len(heard) - faded])
    assert abs(int(heard[-1])) < np.abs(whole).max() / 100
    assert len(heard) / 22050 == pytest.approx(ended.heard, abs=0.011)  # zeros at the beginning may be skipped


def test_a_sentence_is_interrupted_at_once_if_nothing_was_heard() -> None:
    with Engine() as engine:
        engine.send(_speak(), protocol.Interrupt("g1"))
        ended = engine.until(protocol.Ended)
        assert (ended.outcome, ended.rest, ended.heard) == (protocol.OUTCOME_INTERRUPTED, 0, 0)
        rest: dict[str, Any] = {"start": 4, "heard_end": 3, "heard_words": 1, "heard": 0.2}
        engine.send(_speak(**rest), protocol.Interrupt("g1"))
        ended = engine.until(protocol.Ended)
        assert (ended.outcome, ended.rest, ended.heard) == (protocol.OUTCOME_INTERRUPTED, 4, 0.2)


def test_an_early_interruption_is_no_failure_of_a_neural_voice(tmp_path: Path) -> None:
    with Engine(environment=_tiny_voice(tmp_path)) as engine:
        engine.send(_speak("a", voice="piper/tiny", voice_only=True))  # this loads the voice
        engine.until(protocol.Ended)
        engine.send(_speak(voice="piper/tiny"), protocol.Interrupt("g1"))
        assert engine.until(protocol.Ended).outcome == protocol.OUTCOME_INTERRUPTED
        assert {each.voice for each in engine.events if isinstance(each, protocol.VoiceChosen)} == {"piper/tiny"}


def test_a_sentence_ends_as_usual_if_no_word_follows() -> None:
    with Engine() as engine:
        engine.say("one two")
        assert _interrupt(engine, 2).outcome == protocol.OUTCOME_COMPLETED


def test_a_long_word_is_cut_off_and_repeated_but_reported_once() -> None:
    soon = "from talkcli.engine.child import runner; runner.WORD_END_LIMIT_S = 0.2"
    text = "go 1234 now"
    with limits(), Engine(before=soon) as engine:
        engine.send(_speak(text))
        engine.until_word(2)
        interrupted_at = time.monotonic()
        ended = _interrupt(engine, 0)
        assert_within(time.monotonic() - interrupted_at, 0.5, "the end of a long word")
        assert ended.rest == 3
        _continue_to_the_end(engine, ended, text=text)
        assert [text[start:end] for start, end, _ in _words(engine)] == text.split()
        assert [number for *_, number in _words(engine)] == [1, 2, 3]


def test_a_stop_ends_an_interrupted_word() -> None:
    with limits(), Engine() as engine:
        engine.send(_speak("go 12345678 now"))
        engine.until_word(2)
        engine.send(protocol.Interrupt("g1"))
        assert_within(engine.stop(), 0.05, "the stop")


def test_a_growing_text_is_interrupted_in_a_part_between_parts_and_while_text_is_missing() -> None:
    with Engine() as engine:
        engine.send(_speak("One two. Three ", more=True))
        ended = _interrupt(engine, 2)
        assert ended.rest == 8  # the end of the first sentence, because the second one is incomplete
        engine.send(_speak("One two. Three four. Five", more=True, **_rest(engine, ended)))
        ended = _interrupt(engine, 3)
        engine.send(_speak("One two. Three four. Five", more=True, **_rest(engine, ended)))
        while not engine.until(protocol.TextMissing).missing:
            pass
        ended = _interrupt(engine, 0)
        assert (ended.rest, len(engine.words())) == (21, 4)
        engine.send(_speak("One two. Three four. Five", more=True, **_rest(engine, ended)))
        engine.send(protocol.Append("g1", " six. Seven", end=True))
        assert engine.until(protocol.Ended).outcome == protocol.OUTCOME_COMPLETED
        assert [number for *_, number in _words(engine)] == list(range(1, 8))


@pytest.mark.parametrize(
    ("text", "fields", "words"),
    [
        ("One two. Three four. Five", {"broken": True}, "One two Three four"),
        ("**One** two [three](http://a.b) four", {"format": "markdown"}, "One two three four"),
    ],
)
def test_a_broken_text_or_markdown_continues_in_its_place(text: str, fields: dict[str, Any], words: str) -> None:
    with Engine() as engine:
        engine.send(_speak(text, **({"more": True} if "broken" in fields else fields)))
        _continue_to_the_end(engine, _interrupt(engine, 1), text=text, **fields)
        assert [text[start:end] for start, end, _ in _words(engine)] == words.split()


def test_a_third_party_driver_stops_at_once_and_repeats_the_word() -> None:
    with limits(), Engine(driver="timed", before=TIMED_DRIVER) as engine:
        engine.send(_speak(rate=200))
        engine.until_word(3)
        interrupted_at = time.monotonic()
        ended = _interrupt(engine, 0)
        assert_within(time.monotonic() - interrupted_at, 0.4, "the end of the driver, which takes 0.2 s")
        assert ended.rest == TEXT.index("three")
        ended = _continue_to_the_end(engine, ended, rate=200)
        assert [number for *_, number in _words(engine)] == list(range(1, 7))
        engine.send(_speak(rate=200), protocol.Interrupt("g1"))
        assert engine.until(protocol.Ended).rest == 0
        engine.leave()
        assert engine.errors().splitlines() == [TEXT, TEXT[TEXT.index("three") :]]
