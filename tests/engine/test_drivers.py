"""Tests for pyttsx3's drivers in an engine process: third-party drivers, and talk's own driver."""

from __future__ import annotations

import contextlib
import os
import select
import time
from typing import TYPE_CHECKING, Any
from unittest.mock import Mock

import pytest

from talkcli import install
from talkcli.engine import protocol
from talkcli.engine.child.driver import Driver
from talkcli.frozen import replace
from tests.engine.process import Engine, SharedEngine
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import Any


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


@pytest.mark.parametrize(("driver", "before"), [("dummy", ""), ("slow", SLOW_DRIVER)])
def test_a_driver_finishes_each_sentence_and_reports_its_words(driver: str, before: str) -> None:
    with Engine(driver=driver, before=before) as engine:
        ready = engine.until(protocol.Ready)
        assert (ready.driver, ready.player) == (driver, None)
        for goal in ("g1", "g2"):
            assert engine.spoken("battery low", goal).outcome == protocol.OUTCOME_COMPLETED
            assert [(word.start, word.end) for word in engine.words(goal)] == [(0, 7), (8, 11)]


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
    engine = Engine(driver="timed", before=TIMED_DRIVER, alive_every=0.15)
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
        "from talkcli.engine.child import runner\nrunner.DRIVER_LIMIT_S, runner.MAX_WORDS_PER_CHARACTER = 0.6, 0\n"
    )
    never = "Driver.stop = lambda self: None\nDriver.END = 1e9\n"
    with Engine(driver="slow", before=patience + SLOW_DRIVER + never, alive_every=0.35) as engine:
        engine.until(protocol.VoiceList)
        engine.say("battery low")
        engine.until_word(2)
        started_at = time.monotonic()
        alive = 0
        while select.select([engine._socket], [], [], 2 * 0.35 + 0.2)[0]:
            assert isinstance(engine.event(), protocol.Alive)
            elapsed = time.monotonic() - started_at
            assert_within(elapsed, 0.6 + 0.35 + 0.2, "the last sign of life")
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
            ['the driver "nsss" could not be loaded: No module named '],
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


# -- talk's own driver

#: Code that makes espeak write a few samples, and then compute for a long time.
THINKING = """
import array, time
from talkcli.engine.child.synthesizers import espeak
def speak(self, text, settings, output):
    output.begin(16_000, "en")
    output.word(0, 1, 0.0)
    output.word(2, 1, 0.16)  # heard after all samples have been accepted
    output.write(array.array("h", [9000 if index % 100 < 50 else -9000 for index in range(3_200)]).tobytes())
    for _ in range(400):
        output.write(b"")
        time.sleep(0.005)  # as if it computed
espeak.Espeak.speak = speak
"""


@limits()
def test_words_are_reported_and_a_stop_works_during_a_long_computation() -> None:
    with Engine(before=THINKING) as engine:
        engine.say("a b c")
        engine.until_word()
        first_at = time.monotonic()
        engine.until_word(2)
        elapsed = time.monotonic() - first_at
        assert elapsed > 0.1
        assert_within(elapsed, 0.3, "the word before the gap")
        assert_within(engine.stop(), 0.05, "the stop")


def test_the_properties_are_those_of_pyttsx3_and_pitch() -> None:
    driver = Driver(Mock(), Mock(), Mock())
    names = ("rate", "volume", "pitch")
    assert [driver.getProperty(name) for name in names] == [200, 1.0, 50]
    for name, value in zip(names, ("300", "0.5", "60"), strict=True):
        driver.setProperty(name, value)
    assert [driver.getProperty(name) for name in names] == [300, 0.5, 60]
    with pytest.raises(KeyError):
        driver.setProperty("speed", 1)
