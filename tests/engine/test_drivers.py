"""Tests for pyttsx3's drivers: third-party drivers in an engine process, and talk's own driver in pyttsx3."""

from __future__ import annotations

import contextlib
import os
import select
import time
from array import array
from typing import TYPE_CHECKING, Any, cast

import pytest
import pyttsx3.engine

from talkcli import install
from talkcli.engine import protocol
from talkcli.engine.child.driver import register_driver
from talkcli.engine.child.players.base import CannotSpeak
from talkcli.engine.child.players.chooser import PlayerChooser
from talkcli.engine.pronunciation import Pronunciations
from talkcli.engine.voices import UnknownVoice
from talkcli.frozen import replace
from tests.engine.process import Engine, SharedEngine
from tests.engine.test_synthesizer_contract import Scripted
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from typing import Any

    from talkcli.engine.child.cutting import GrowingText
    from talkcli.engine.child.players.base import EndedEarly, Interest
    from talkcli.engine.child.runner import GoalRunner
    from talkcli.engine.child.synthesizers.base import SampleSink, SpeechSettings, Synthesizer
    from talkcli.engine.child.words import TimedWord

#: The part that all drivers here share. It has no settable properties, and registers the driver with pyttsx3.
_DRIVER = """
import re, time, types
class Base:
    def __init__(self, proxy):
        self.proxy, self.plan, self.completed = proxy, [], True
    def destroy(self): pass
    def iterate(self):
        self.proxy.setBusy(False)
        while True:
            while self.plan and time.monotonic() >= self.plan[0][0]:
                _, topic, values = self.plan.pop(0)
                self.proxy.notify(topic, **values)
                if topic == "finished-utterance":
                    self.proxy.setBusy(False)
                    break
            yield
    def say(self, text):
        self.proxy.setBusy(True)
        at = time.monotonic()
        for match in re.finditer("[^ ]+", text):
            at += self.WORD
            self.plan.append((at, "started-word", self.word(match)))
        self.plan.append((at + self.END, "finished-utterance", dict(completed=True)))
    def stop(self):
        if self.plan:
            self.plan = [(time.monotonic() + self.STOP, "finished-utterance", dict(completed=False))]
    def getProperty(self, name):
        return {{"voices": [], "voice": "only"}}[name]
    def setProperty(self, name, value):
        raise KeyError(f"unknown property {{name}}")
{driver}
module = types.ModuleType("pyttsx3.drivers.{name}")
module.buildDriver = Driver
sys.modules[module.__name__] = module
"""

#: A driver like that of macOS. It plays the sound itself, names the words, and takes some time to confirm a stop.
SLOW_DRIVER = _DRIVER.format(
    name="slow",
    driver="""
class Driver(Base):
    WORD, END, STOP = 0, 0.4, 0.03
    def word(self, match):
        return dict(name=match.group(), location=match.start(), length=len(match.group()))
    def say(self, text):
        super().say(text)
        if text == "raise":
            self.plan.clear()
            raise RuntimeError("no tongue")
""",
)

#: A driver that speaks a word in 0.1 s, reports it, and writes each text to standard error.
TIMED_DRIVER = _DRIVER.format(
    name="timed",
    driver="""
class Driver(Base):
    WORD, END, STOP = 0.1, 0.1, 0.2
    def word(self, match):
        return dict(name=None, location=match.start(), length=len(match.group()))
    def say(self, text):
        print(text, file=sys.stderr, flush=True)
        super().say(text)
""",
)

#: Code that hides the system's libespeak-ng.
NO_LIBRARY = """
import ctypes
class Missing(ctypes.CDLL):
    def __init__(self, name, *rest, **options):
        if name == "libespeak-ng.so.1":
            raise OSError("libespeak-ng.so.1: cannot open shared object file: No such file or directory")
        super().__init__(name, *rest, **options)
ctypes.CDLL = Missing
"""


@pytest.fixture(scope="module")
def shared() -> Iterator[SharedEngine]:
    with contextlib.closing(SharedEngine(lambda: Engine(driver="dummy"))) as shared:
        yield shared


def test_the_dummy_driver_lists_its_voices() -> None:
    with Engine(driver="dummy") as engine:
        ready = engine.until(protocol.Ready)
        assert (ready.driver, ready.player) == ("dummy", None)
        assert engine.until(protocol.VoiceList).voices[0].id == "dummy.voice1"


@pytest.mark.parametrize(("driver", "before"), [("dummy", ""), ("slow", SLOW_DRIVER)])
def test_a_driver_finishes_each_sentence_and_reports_its_words(driver: str, before: str) -> None:
    with Engine(driver=driver, before=before) as engine:
        for goal in ("g1", "g2"):
            assert engine.spoken("battery low", goal).outcome == protocol.OUTCOME_COMPLETED
            assert [(word.start, word.end) for word in engine.words(goal)] == [(0, 7), (8, 11)]


def test_a_driver_gets_a_text_in_markdown_without_its_marks() -> None:
    with Engine(driver="slow", before=SLOW_DRIVER) as engine:
        engine.send(protocol.Speak("g1", "**battery** `low`", 200, 1.0, None, 50, format="markdown"))
        assert engine.until(protocol.Ended).outcome == protocol.OUTCOME_COMPLETED
        assert [(word.start, word.end) for word in engine.words()] == [(2, 9), (13, 16)]


@pytest.mark.parametrize(
    ("more", "reason", "message"),
    [
        ({"pitch": 80}, "bad_option", "the driver dummy cannot set pitch to 80: unknown property pitch"),
        ({"lead_in": 400}, "bad_option", "this driver plays the sound itself, so lead_in can't be used"),
        ({"voice": "dummy.voice9"}, "unknown_voice", "'dummy.voice2'"),
        (
            {"voice": "piper/en_US-joe-medium"},
            "unknown_voice",
            '"piper/en_US-joe-medium" is a neural voice, which the driver',
        ),
    ],
)
def test_a_goal_fails_if_the_driver_lacks_one_of_its_options(
    engine: Engine, more: dict[str, Any], reason: str, message: str
) -> None:
    ended = engine.spoken("yes", **more)
    assert (ended.outcome, ended.reason) == (protocol.OUTCOME_FAILED, reason)
    assert ended.message is not None
    assert message in ended.message
    assert engine.spoken("yes", "g2", rate=150, lead_in=0).outcome == protocol.OUTCOME_COMPLETED


@limits()
def test_a_slow_driver_confirms_a_stop_and_its_error_fails_only_one_goal() -> None:
    with Engine(driver="slow", before=SLOW_DRIVER) as engine:
        engine.say("battery low")
        engine.until_word()
        assert_within(engine.stop(), 0.15, "the stop")
        ended = engine.spoken("raise", "g2")
        assert (ended.reason, ended.message) == ("engine_failed", "RuntimeError: no tongue")
        assert engine.spoken("yes", "g3").outcome == protocol.OUTCOME_COMPLETED


def _start_timed_driver(text: str = "battery low, please come home") -> Engine:
    engine = Engine(driver="timed", before=TIMED_DRIVER, alive_every=0.3)
    engine.until(protocol.VoiceList)
    engine.say(text)
    return engine


def _driver_texts(engine: Engine) -> list[str]:
    """Wait for the end of the process, and return the texts that the driver got."""
    engine.leave()
    return engine.errors().splitlines()


def test_a_driver_without_pauses_resumes_at_the_last_reported_word() -> None:
    with _start_timed_driver() as engine:
        for number in (2, 4):
            engine.until_word(number)
            assert engine.pause() >= 0.2, "the pause was confirmed before the driver was silent"
            assert isinstance(engine.event(), protocol.Alive)
            engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.OUTCOME_COMPLETED
        assert [word.start for word in engine.words()] == [0, 8, 13, 20, 25]
        assert [word.number for word in engine.words()] == [1, 2, 3, 4, 5]
        assert engine.words()[-1].time < 0.5 + 2 * (0.2 + 0.1 + 0.15), "the word times include the pauses"
        assert _driver_texts(engine) == ["battery low, please come home", "low, please come home", "come home"]


def test_a_driver_paused_before_the_first_word_speaks_the_whole_text() -> None:
    with _start_timed_driver() as engine:
        engine.until(protocol.Started)
        engine.pause()
        engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.OUTCOME_COMPLETED
        assert len(engine.words()) == 5
        assert set(_driver_texts(engine)) == {"battery low, please come home"}


def test_a_driver_resumed_before_it_is_silent_continues_once_it_is() -> None:
    with _start_timed_driver() as engine:
        engine.until(protocol.Word)
        engine.send(protocol.Hold("g1", 1))
        engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.OUTCOME_COMPLETED
        assert len(engine.words()) == 5
        assert not any(isinstance(event, protocol.Held) for event in engine.events)


@pytest.mark.parametrize("silent", [True, False])
def test_a_stop_ends_a_paused_driver(silent: bool) -> None:
    with _start_timed_driver() as engine:
        engine.until(protocol.Word)
        if silent:
            engine.pause()
        else:
            engine.send(protocol.Hold("g1", 1))
        engine.send(protocol.Stop("g1"))
        ended = engine.until(protocol.Ended)
        assert replace(ended, heard=None) == protocol.Ended("g1", protocol.OUTCOME_STOPPED)
        assert ended.heard is not None
        assert ended.heard > 0
        assert engine.spoken("yes", "g2").outcome == protocol.OUTCOME_COMPLETED
        assert _driver_texts(engine) == ["battery low, please come home", "yes"]


@limits()
def test_signs_of_life_stop_if_the_driver_never_finishes() -> None:
    patience = (
        "from talkcli.engine.child import runner\nrunner.DRIVER_LIMIT_S, runner.MAX_WORDS_PER_CHARACTER = 0.7, 0\n"
    )
    never = "Driver.stop = lambda self: None\nDriver.END = 1e9\n"
    with Engine(driver="slow", before=patience + SLOW_DRIVER + never) as engine:
        engine.until(protocol.VoiceList)
        engine.say("battery low")
        engine.until_word(2)
        started_at = time.monotonic()
        alive = 0
        while select.select([engine._socket], [], [], 2 * protocol.ALIVE_INTERVAL_S + 0.2)[0]:
            assert isinstance(engine.event(), protocol.Alive)
            elapsed = time.monotonic() - started_at
            assert_within(elapsed, 0.7 + protocol.ALIVE_INTERVAL_S + 0.2, "the last sign of life")
            alive += 1
        assert alive == 1
        assert _processor_seconds(engine.process.pid) < 0.5, "it waits busily"
        engine.process.kill()
        assert engine.errors() == "the driver did not finish a text that takes less than 1 s\n"


def _processor_seconds(pid: int) -> float:
    with open(f"/proc/{pid}/stat", encoding="ascii", errors="replace") as file:
        fields = file.read().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def test_the_library_from_the_wheel_is_used_if_the_system_has_none() -> None:
    with Engine(before=NO_LIBRARY) as engine:
        version = engine.until(protocol.Ready).version
        assert version is not None
        assert version.endswith("(espeakng-loader)")
        assert engine.spoken("yes").outcome == protocol.OUTCOME_COMPLETED


#: Code that makes even the default voice unavailable in libespeak-ng.
WITHOUT_ENGLISH = """
from talkcli.engine.child.synthesizers import espeak
load_library = espeak.load_library
def without_english():
    library, *more = load_library()
    library.SetVoiceByName = lambda _: library.EE_OK + 1
    return library, *more
espeak.load_library = without_english
"""


@pytest.mark.parametrize(
    ("options", "parts", "fields"),
    [
        (
            {"before": NO_LIBRARY + "sys.modules['espeakng_loader'] = None"},
            ["libespeak-ng is missing (libespeak-ng.so.1: ", f"); install it with: {install.espeak_command()}"],
            {"permanent": True},
        ),
        (
            {"before": NO_LIBRARY + "import espeakng_loader; espeakng_loader.get_data_path = lambda: '/nowhere'"},
            ["espeak-ng data is missing; install it with: ", "espeak-ng-data"],
            {"permanent": True},
        ),
        (
            {"before": WITHOUT_ENGLISH},
            ['the driver "talk_espeak" could not be started: UnknownVoice: en'],
            {"permanent": False},
        ),
        (
            {"before": "sys.modules['pyttsx3'] = None"},
            ["pyttsx3 is missing (", f"); install it with: {install.command('pyttsx3')}"],
            {"permanent": True},
        ),
        ({"driver": "parrot"}, ['unknown driver "parrot"; available drivers: ', "dummy"], {"usage_error": True}),
        (
            {"driver": "nsss"},
            ["the driver \"nsss\" could not be loaded: No module named 'objc'"],
            {"usage_error": True},
        ),
        (
            {"driver": "slow", "before": SLOW_DRIVER + "\nDriver.iterate = lambda self: None"},
            ['the driver "slow" cannot be used', "leave out --driver"],
            {"usage_error": True},
        ),
        (
            {"voice": "en-uss"},
            ["did you mean 'en-us'"],
            {"reason": "unknown_voice", "permanent": True, "usage_error": True},
        ),
        (
            {"driver": "dummy", "voice": "piper/en_US-joe-medium"},
            ['is a neural voice, which the driver "dummy" does not support; leave out --driver'],
            {"reason": "unknown_voice", "permanent": True, "usage_error": True},
        ),
    ],
)
def test_a_failed_start_reports_what_to_install_or_change(
    options: dict[str, Any], parts: list[str], fields: dict[str, Any]
) -> None:
    with Engine(**options) as engine:
        failed = engine.until(protocol.StartFailed)
        assert engine.event() is None
        assert engine.process.wait(5) == 0
    assert all(part in failed.message for part in parts), failed
    assert {name: getattr(failed, name) for name in fields} == fields
    assert failed.reason == fields.get("reason", "engine_failed")


def test_espeak_means_talks_own_driver() -> None:
    with Engine(driver="espeak") as engine:
        assert engine.until(protocol.Ready).driver == "espeak"
        assert engine.spoken("yes").outcome == protocol.OUTCOME_COMPLETED


# -- talk's own driver


_NAME = "talk_scripted"


class Recorder:
    """A pyttsx3 engine with talk's own driver. It replaces the runner, and records all notifications."""

    def __init__(self, player: str = "null", synthesizer: Synthesizer | None = None) -> None:
        self.notifications: list[tuple[str, dict[str, Any]]] = []
        self.word: TimedWord | None = None
        self.ended_early: EndedEarly | None = None
        self.word_end_due: float | None = None
        self.text_start = 0
        self.duration: float | None = None
        self.heard: float | None = None
        self.growing_text: GrowingText | None = None
        self.pronunciations = Pronunciations({})
        self.sound = None
        #: the position and the duration at each notification
        self.times: list[tuple[float | None, float | None]] = []
        #: called for each word, and after each wait
        self.at_word: Callable[[], None] = lambda: None
        self.at_wait: Callable[[], None] = lambda: None
        self.players = PlayerChooser(protocol.Configure(0, None, player, None, None))
        self.hold_number = 0
        register_driver(_NAME, synthesizer or Scripted(), cast("GoalRunner", self))
        self.engine: Any = pyttsx3.engine.Engine(_NAME)
        for topic in ("started-utterance", "started-word", "finished-utterance", "error"):
            self.engine.connect(topic, self._make_callback(topic))
        self.engine.startLoop(False)

    def _make_callback(self, topic: str) -> Callable[..., None]:
        def record(**values: object) -> None:
            self.notifications.append((topic, values))
            self.times.append((self.word.position if self.word else None, self.duration))
            if topic == "started-word":
                self.at_word()

        return record

    def wait(self, interests: Sequence[Interest], until: float | None) -> None:
        poll = select.poll()
        for descriptor, events in interests:
            poll.register(descriptor, events)
        poll.poll(None if until is None else max(0.0, until - time.monotonic()) * 1000)
        self.at_wait()

    def find_word(self, location: int, length: int) -> tuple[int, int, int]:
        return location, location + length, 1

    def report_voice(self, _voice: str, _fallback_reason: str | None) -> None:
        pass

    def spoken(self, text: str, name: str) -> list[tuple[str, dict[str, Any]]]:
        """Speak a text as the runner does, and return the notifications."""
        self.notifications.clear()
        self.times.clear()
        self.engine.say(text, name)
        while not any(topic == "finished-utterance" for topic, _ in self.notifications):
            self.engine.iterate()
        return self.notifications


@pytest.fixture
def recorder() -> Recorder:
    return Recorder()


def _word(name: str, location: int, length: int) -> tuple[str, dict[str, object]]:
    return ("started-word", {"name": name, "location": location, "length": length})


def test_a_sentence_sends_pyttsx3s_notifications_and_sets_the_times(recorder: Recorder) -> None:
    assert recorder.spoken("ab c", "g1") == [
        ("started-utterance", {"name": "g1"}),
        _word("g1", 0, 2),
        _word("g1", 3, 1),
        ("finished-utterance", {"name": "g1", "completed": True}),
    ]
    assert [position for position, _ in recorder.times[1:3]] == [0.0, 0.1]
    assert recorder.times[3][1] == pytest.approx(0.15)
    assert recorder.spoken("a", "g2")[-1] == ("finished-utterance", {"name": "g2", "completed": True})
    assert recorder.times[-1][1] == pytest.approx(0.05)


def test_a_stopped_sentence_is_not_completed_and_has_no_duration(recorder: Recorder) -> None:
    recorder.spoken("a", "g1")
    recorder.at_word = recorder.engine.stop
    assert recorder.spoken("abcdefgh i", "g2") == [
        ("started-utterance", {"name": "g2"}),
        _word("g2", 0, 8),
        ("finished-utterance", {"name": "g2", "completed": False}),
    ]
    assert recorder.times[-1][1] is None


def test_an_error_is_reported_before_the_end_of_the_sentence() -> None:
    recorder = Recorder("no-such-player-anywhere")
    started, (topic, values), finished = recorder.spoken("a", "g1")
    assert started == ("started-utterance", {"name": "g1"})
    assert (topic, {*values}, values["name"]) == ("error", {"name", "exception"}, "g1")
    assert isinstance(values["exception"], CannotSpeak)
    assert finished == ("finished-utterance", {"name": "g1", "completed": False})
    assert recorder.times[-1][1] is None


def test_the_properties_are_those_of_pyttsx3_and_pitch(recorder: Recorder) -> None:
    engine = recorder.engine
    engine.iterate()
    assert [(voice.id, voice.name, voice.languages) for voice in engine.getProperty("voices")] == [
        ("one", "One", ["en"]),
        ("two", "Two", []),
    ]
    names = ("voice", "rate", "volume", "pitch")
    assert [engine.getProperty(name) for name in names] == ["one", 200, 1.0, 50]
    for name, value in zip(names, ("two", 300, 0.5, 60), strict=True):
        engine.setProperty(name, value)
    assert [engine.getProperty(name) for name in names] == ["two", 300, 0.5, 60]
    assert recorder.notifications == []
    recorder.spoken("ab", "g1")
    assert recorder.times[-1][1] == pytest.approx(0.1 * 200 / 300, rel=0.01)


@pytest.mark.parametrize(
    ("name", "value", "kind"), [("speed", 3, KeyError), ("voice", "three", UnknownVoice), ("rate", "fast", ValueError)]
)
def test_an_invalid_property_is_an_error_and_changes_nothing(
    recorder: Recorder, name: str, value: object, kind: type[Exception]
) -> None:
    recorder.engine.iterate()
    recorder.engine.setProperty(name, value)
    ((topic, values),) = recorder.notifications
    assert (topic, {*values}) == ("error", {"name", "exception"})
    assert type(values["exception"]) is kind
    assert [recorder.engine.getProperty(name) for name in ("voice", "rate")] == ["one", 200]


class Thinking(Scripted):
    """A synthesizer that writes a few samples, and then computes for a long time."""

    def speak(self, text: str, sound: SpeechSettings, output: SampleSink) -> None:  # noqa: ARG002 - no text is spoken
        output.begin(self._RATE, "scripted")
        tone = array("h", [9000 if index % 100 < 50 else -9000 for index in range(self._RATE // 5)]).tobytes()
        output.word(0, 1, 0.0)
        output.word(2, 1, 0.16)  # heard after all samples have been accepted
        output.write(tone)
        for _ in range(200):
            output.write(b"")
            time.sleep(0.005)  # as if it computed


@limits()
def test_words_are_reported_and_a_stop_works_during_a_long_computation() -> None:
    recorder, word_times = Recorder(synthesizer=Thinking()), list[float]()

    def record_word() -> None:
        word_times.append(time.monotonic() - started_at)
        if len(word_times) == 2:
            recorder.at_wait = recorder.engine.stop

    recorder.at_word = record_word
    started_at = time.monotonic()
    assert recorder.spoken("a b c", "g1")[-1] == ("finished-utterance", {"name": "g1", "completed": False})
    assert len(word_times) == 2
    assert word_times[1] >= 0.15
    assert_within(word_times[1], 0.3, "the word before the gap")
