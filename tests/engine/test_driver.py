"""Our driver as pyttsx3 sees it, with pyttsx3's own engine: its notifications, and its properties."""

from __future__ import annotations

import select
import time
from array import array
from typing import TYPE_CHECKING, Any, cast

import pytest
from pyttsx3.engine import Engine

from talkcli.engine import protocol
from talkcli.engine.driver import register
from talkcli.engine.players.base import CannotSpeak
from talkcli.engine.players.choice import Players
from talkcli.engine.synthesizers.base import UnknownVoice
from tests.engine.test_synthesizer_contract import Scripted
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from talkcli.engine.players.base import Interest
    from talkcli.engine.session import Session
    from talkcli.engine.synthesizers.base import Output, Sound, Synthesizer

_NAME = "talk_scripted"


class Told:
    """An engine of pyttsx3's with our driver, and all that it has notified, with the times that went beside it.

    For the driver it is the session.
    """

    def __init__(self, player: str = "null", synthesizer: Synthesizer | None = None) -> None:
        self.told: list[tuple[str, dict[str, Any]]] = []
        self.position: float | None = None
        self.duration: float | None = None
        self.beside: list[tuple[float | None, float | None]] = []
        #: called when a word is told, and in each wait
        self.at_word: Callable[[], None] = lambda: None
        self.at_wait: Callable[[], None] = lambda: None
        self.players = Players(protocol.Configure(0, None, player, None, None))
        self.held = 0
        register(_NAME, synthesizer or Scripted(), cast("Session", self))
        self.engine: Any = Engine(_NAME)
        for topic in ("started-utterance", "started-word", "finished-utterance", "error"):
            self.engine.connect(topic, self._note(topic))
        self.engine.startLoop(False)

    def _note(self, topic: str) -> Callable[..., None]:
        def note(**values: object) -> None:
            self.told.append((topic, values))
            self.beside.append((self.position, self.duration))
            if topic == "started-word":
                self.at_word()

        return note

    def wait(self, interests: Sequence[Interest], until: float | None) -> None:
        poll = select.poll()
        for descriptor, events in interests:
            poll.register(descriptor, events)
        poll.poll(None if until is None else max(0.0, until - time.monotonic()) * 1000)
        self.at_wait()

    def tell_voice(self, _voice: str, _why: str | None) -> None:
        pass

    def spoken(self, text: str, name: str) -> list[tuple[str, dict[str, Any]]]:
        """Speak as talk does, and return what was told of it."""
        self.told.clear()
        self.beside.clear()
        self.engine.say(text, name)
        while not any(topic == "finished-utterance" for topic, _ in self.told):
            self.engine.iterate()
        return self.told


@pytest.fixture
def told() -> Told:
    return Told()


def _word(name: str, location: int, length: int) -> tuple[str, dict[str, object]]:
    return ("started-word", {"name": name, "location": location, "length": length})


def test_a_sentence_is_told_in_pyttsx3s_form_and_its_times_beside_that(told: Told) -> None:
    assert told.spoken("ab c", "g1") == [
        ("started-utterance", {"name": "g1"}),
        _word("g1", 0, 2),
        _word("g1", 3, 1),
        ("finished-utterance", {"name": "g1", "completed": True}),
    ]
    assert [word for word, _ in told.beside[1:3]] == [0.0, 0.1]
    assert told.beside[3][1] == pytest.approx(0.15)
    assert told.spoken("a", "g2")[-1] == ("finished-utterance", {"name": "g2", "completed": True})
    assert told.beside[-1][1] == pytest.approx(0.05)


def test_a_sentence_that_is_stopped_is_not_completed_and_has_no_duration(told: Told) -> None:
    told.spoken("a", "g1")
    told.at_word = told.engine.stop
    assert told.spoken("abcdefgh i", "g2") == [
        ("started-utterance", {"name": "g2"}),
        _word("g2", 0, 8),
        ("finished-utterance", {"name": "g2", "completed": False}),
    ]
    assert told.beside[-1][1] is None


def test_an_error_is_told_before_the_end() -> None:
    told = Told("no-such-player-anywhere")
    started, (topic, values), finished = told.spoken("a", "g1")
    assert started == ("started-utterance", {"name": "g1"})
    assert (topic, {*values}, values["name"]) == ("error", {"name", "exception"}, "g1")
    assert isinstance(values["exception"], CannotSpeak)
    assert finished == ("finished-utterance", {"name": "g1", "completed": False})
    assert told.beside[-1][1] is None


def test_its_properties_are_pyttsx3s_and_pitch(told: Told) -> None:
    engine = told.engine
    engine.iterate()
    assert [(each.id, each.name, each.languages) for each in engine.getProperty("voices")] == [
        ("one", "One", ["en"]),
        ("two", "Two", []),
    ]
    names = ("voice", "rate", "volume", "pitch")
    assert [engine.getProperty(each) for each in names] == ["one", 200, 1.0, 50]
    for name, value in zip(names, ("two", 300, 0.5, 60), strict=True):
        engine.setProperty(name, value)
    assert [engine.getProperty(each) for each in names] == ["two", 300, 0.5, 60]
    assert told.told == []
    told.spoken("ab", "g1")
    assert told.beside[-1][1] == pytest.approx(0.1 * 200 / 300, rel=0.01)


@pytest.mark.parametrize(
    ("name", "value", "kind"), [("speed", 3, KeyError), ("voice", "three", UnknownVoice), ("rate", "fast", ValueError)]
)
def test_a_wrong_property_is_an_error(told: Told, name: str, value: object, kind: type[Exception]) -> None:
    """And changes nothing."""
    told.engine.iterate()
    told.engine.setProperty(name, value)
    ((topic, values),) = told.told
    assert (topic, {*values}) == ("error", {"name", "exception"})
    assert type(values["exception"]) is kind
    assert [told.engine.getProperty(each) for each in ("voice", "rate")] == ["one", 200]


class Thinking(Scripted):
    """Has a little, and then nothing for ever: as a synthesizer that computes may."""

    def speak(self, text: str, sound: Sound, output: Output) -> None:  # noqa: ARG002 - no text is spoken
        output.begin(self._RATE, "scripted")
        tone = array("h", [9000 if each % 100 < 50 else -9000 for each in range(self._RATE // 10)])
        for start in (0, 2):
            output.word(start, 1, start / 20)
            output.write(tone.tobytes())
        while True:
            output.write(b"")
            time.sleep(0.005)  # it computes


@limits()
def test_words_are_told_as_they_are_heard_while_the_rest_is_computed_and_a_stop_comes_in() -> None:
    told, at = Told(synthesizer=Thinking()), list[float]()

    def hear() -> None:
        at.append(time.monotonic() - began)
        if len(at) == 2:
            told.at_wait = told.engine.stop

    told.at_word = hear
    began = time.monotonic()
    assert told.spoken("a b c", "g1")[-1] == ("finished-utterance", {"name": "g1", "completed": False})
    assert len(at) == 2
    assert at[1] >= 0.1
    assert_within(at[1], 0.3, "the word before the gap")
