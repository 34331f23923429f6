"""The contract of synthesizers: each sentence of `synthesizers.base.Synthesizer`, for each synthesizer.

A new synthesizer is put through it by a row of `SYNTHESIZERS`. The scripted one keeps the suite to the contract: what
it does is all that is asked for.
"""

from __future__ import annotations

import os
import select
import threading
import time
from array import array
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from talkcli.engine.child.players.base import CannotSpeak, Stopped
from talkcli.engine.child.synthesizers.base import SpeechSettings
from talkcli.engine.child.synthesizers.combined import CombinedSynthesizer
from talkcli.engine.child.synthesizers.espeak import Espeak
from talkcli.engine.child.synthesizers.phonemes import split_text
from talkcli.engine.child.synthesizers.piper import Piper
from talkcli.engine.players import SAMPLE_BYTES
from talkcli.engine.protocol import Voice
from talkcli.engine.voices import UnknownVoice
from talkcli.goals.reasons import Reason
from talkcli.install import NEURAL_PACKAGES
from tests.support import tiny_voice
from tests.support.real_voice import REAL_VOICE, link_without_noise, real_voice
from tests.support.surroundings import needs_packages
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from talkcli.engine.child.synthesizers.base import SampleSink, Synthesizer

TEXT = "battery low, please come home"
#: Texts of all kinds.
TEXTS = [
    TEXT,
    "a",
    "I go. This one, on the 1,000th day, is well-known: it's «hello», U.S.A.!",
    "日本語 のテキスト, привет мир 😀 n\u0303 e\u0301",
    "one\x01two\x00three\ttab\nline\r\n\x7f \ud800 \ufffd \u200d",
    "word " * 200,
]
#: Texts in which there is nothing to be spoken.
SILENT = ["", " ", "\n\t ", "...", "\x00"]
#: Seconds by which two renderings of a text may differ: libespeak-ng's noise moves what follows by some samples, and
#: after another script the pause at its first comma is 44 ms longer.
NEAR = 0.05
#: Seconds from the return of an output that raised to that of `speak`.
AT_ONCE = 0.05
#: Seconds in which a voice is loaded.
LOADED = 0.5
#: Seconds after which nothing more is to be expected.
LATE = 20.0
#: Seconds of sound that are written at once, at most: they are heard while the rest is made.
MOST_AT_ONCE = 0.2


class Scripted:
    """A tone for each word, as long as the word is: the least that is a synthesizer."""

    version: str | None = None
    _RATE = 16000

    def __init__(self) -> None:
        self.voice = "one"

    def voices(self) -> tuple[Voice, ...]:
        return (Voice("one", "en", "One"), Voice("two", None, "Two"))

    def load(self, voice: str) -> None:
        if voice not in {each.id for each in self.voices()}:
            raise UnknownVoice("there is no such thing")
        self.voice = voice

    def speak(self, text: str, sound: SpeechSettings, output: SampleSink) -> None:
        output.begin(self._RATE, self.voice)
        end = samples = 0
        for word in text.split():
            start = text.index(word, end)
            end = start + len(word)
            if not any(map(str.isalnum, word)):
                continue
            output.word(start, len(word), samples / self._RATE)
            loud, period = int(9000 * sound.volume), (150 if self.voice == "one" else 90) - sound.pitch
            for _ in word:
                tone = [loud if each % period < period / 2 else -loud for each in range(800 * 200 // sound.rate)]
                output.write(array("h", tone).tobytes())
                samples += len(tone)


@cache
def _espeak() -> Espeak:
    """Return the only one of this process: its library can be loaded once, and hangs if it is to end."""
    return Espeak()


def _piper(voice: str = "piper/tiny") -> Synthesizer:
    """Return a synthesizer with this voice; "tiny" hums, in some milliseconds."""
    needs_packages(*NEURAL_PACKAGES)
    synthesizer = Piper(_espeak())
    synthesizer.load(voice)
    return synthesizer


def _joe() -> Synthesizer:
    """Return a synthesizer with a real voice, without its noise."""
    link_without_noise(real_voice(), Path(os.environ["TALK_VOICES"]))
    return _piper(f"piper/{real_voice().stem}")


def _choice() -> Synthesizer:
    needs_packages(*NEURAL_PACKAGES)
    return CombinedSynthesizer(_espeak())


SYNTHESIZERS: dict[str, Callable[[], Synthesizer]] = {
    "espeak": _espeak,
    "scripted": Scripted,
    "piper": _piper,
    "joe": _joe,
    "choice": _choice,
}
#: Those that take half a minute, as they compute.
SLOW = {"joe"}
#: Those that have no pitch but their own.
UNPITCHED = {"piper", "joe"}


@pytest.fixture(scope="module", autouse=True)
def voices(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Put two tiny neural voices where voices are found."""
    place = tmp_path_factory.mktemp("voices")
    tiny_voice.put(place, "tiny")
    tiny_voice.put(place, "wee", tiny_voice.model(period=60))
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("TALK_VOICES", str(place))
        patched.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(
    params=[pytest.param(each, marks=pytest.mark.slow if each in SLOW else ()) for each in SYNTHESIZERS],
    scope="module",
)
def made(request: pytest.FixtureRequest) -> tuple[Synthesizer, str]:
    """Return one for all tests, as a process has one, and its own voice."""
    synthesizer = SYNTHESIZERS[request.param]()
    return synthesizer, synthesizer.voice


@pytest.fixture
def pitched(request: pytest.FixtureRequest) -> bool:
    """Whether it can be higher or lower."""
    return request.node.callspec.params["made"] not in UNPITCHED


@pytest.fixture
def synthesizer(made: tuple[Synthesizer, str]) -> Iterator[Synthesizer]:
    synthesizer, own = made
    yield synthesizer
    synthesizer.load(own)


class Tape:
    """An output that keeps all, checks the order of its calls, and raises an error if it is told to."""

    def __init__(self, *, fails: Exception | None = None, at: str = "", after: int = 0) -> None:
        """`at`: the method that raises, `after` how many calls of it."""
        self.rate = 0
        self.words: list[tuple[int, int, float]] = []
        self.samples = bytearray()
        #: the longest that was written at once, in seconds
        self.most = 0.0
        self.failed_at: float | None = None
        self._fails, self._at, self._left = fails, at, after
        self._thread = threading.get_ident()

    @property
    def seconds(self) -> float:
        return len(self.samples) / SAMPLE_BYTES / self.rate

    @property
    def loudest(self) -> int:
        return max(map(abs, array("h", bytes(self.samples))), default=0)

    def begin(self, rate: int, voice: str, fallback_reason: str | None = None) -> None:
        self._called("begin")
        assert not [*self.words, *self.samples], "the rate comes first"
        assert rate > 0
        assert voice
        assert fallback_reason is None, "the voice that was asked for speaks"
        self.rate = rate

    def word(self, start: int, length: int, position: float) -> None:
        self._called("word")
        assert self.rate, "the rate comes first"
        assert length > 0
        assert position >= 0
        assert round(position * self.rate) >= len(self.samples) // SAMPLE_BYTES, "a word comes before its samples"
        assert not self.words or position >= self.words[-1][2], "positions never decrease"
        self.words.append((start, length, position))

    def write(self, samples: bytes) -> None:
        self._called("write")
        assert self.rate, "the rate comes first"
        assert len(samples) % SAMPLE_BYTES == 0, "samples are whole"
        self.samples += samples
        self.most = max(self.most, len(samples) / SAMPLE_BYTES / self.rate)

    def wait(self, descriptor: int) -> None:
        self._called("wait")
        assert select.select([descriptor], [], [], LATE)[0], "what was waited for doesn't come"

    def _called(self, method: str) -> None:
        assert threading.get_ident() == self._thread, "another thread"
        assert self.failed_at is None, "it has raised"
        if self._fails is not None and method == self._at:
            self._left -= 1
            if self._left < 0:
                self.failed_at = time.monotonic()
                raise self._fails


def _spoken(synthesizer: Synthesizer, text: str = TEXT, sound: SpeechSettings | None = None) -> Tape:
    tape = Tape()
    synthesizer.speak(text, sound or SpeechSettings(voice_only=True), tape)
    return tape


def _assert_alike(first: Tape, second: Tape) -> None:
    """Assert that two are the same sentence, but for noise."""
    assert first.rate == second.rate
    assert first.seconds == pytest.approx(second.seconds, abs=NEAR)
    assert [each[:2] for each in first.words] == [each[:2] for each in second.words]
    assert [each[2] for each in first.words] == pytest.approx([each[2] for each in second.words], abs=NEAR)
    assert first.loudest == pytest.approx(second.loudest, rel=0.2)


# -- voices


def _plain(synthesizer: Synthesizer) -> list[str]:
    """Return the ids of voices but for variants, and for the real voice unless it is in force: its load takes long."""
    found = [each.id for each in synthesizer.voices() if not each.id.startswith("+")]
    return [each for each in found if each != REAL_VOICE or each == synthesizer.voice]


def test_voices_have_unique_ids_and_include_the_current_one(
    made: tuple[Synthesizer, str],
) -> None:
    synthesizer, own = made
    voices = synthesizer.voices()
    ids = {each.id for each in voices}
    assert len(ids) == len(voices)
    assert own in ids
    assert all(each.id and each.name and each.language != "" for each in voices)
    assert synthesizer.voices() == voices


@limits()
def test_a_voice_is_loaded_quickly_with_or_without_a_variant(synthesizer: Synthesizer) -> None:
    """Of the many that libespeak-ng has, some do: `test_voices.py` loads and speaks with all of them."""
    plain = _plain(synthesizer)
    variants = [each.id for each in synthesizer.voices() if each.id.startswith("+")]
    few = len(plain) // 10 + 1
    for voice in [*plain[::few], *(plain[0] + each for each in variants[::20])]:
        began = time.monotonic()
        synthesizer.load(voice)
        assert_within(time.monotonic() - began, LOADED, voice)
        assert synthesizer.voice == voice
        _spoken(synthesizer, "a")


def test_the_voice_that_was_loaded_last_speaks(made: tuple[Synthesizer, str], synthesizer: Synthesizer) -> None:
    before = _spoken(synthesizer)
    other = next(each for each in reversed(_plain(synthesizer)) if each != made[1])
    synthesizer.load(other)
    after = _spoken(synthesizer)
    assert after.samples != before.samples
    synthesizer.load(made[1])
    _assert_alike(_spoken(synthesizer), before)


@pytest.mark.parametrize("voice", ["no such voice", "", "no/such+voice", "\ud800"])
def test_an_unknown_voice_leaves_the_current_one_unchanged(synthesizer: Synthesizer, voice: str) -> None:
    before, spoken = synthesizer.voice, _spoken(synthesizer, sound=SpeechSettings(rate=300))
    with pytest.raises(UnknownVoice) as caught:
        synthesizer.load(voice)
    assert str(caught.value)
    assert synthesizer.voice == before
    _assert_alike(_spoken(synthesizer, sound=SpeechSettings(rate=300)), spoken)


# -- words and samples


@pytest.mark.parametrize("text", [*TEXTS, *SILENT], ids=range(len(TEXTS) + len(SILENT)))
def test_any_text_is_spoken_without_affecting_the_next_one(synthesizer: Synthesizer, pitched: bool, text: str) -> None:
    """The tape holds the order: the rate, then words before their samples, at positions that never decrease."""
    alone = _spoken(synthesizer)
    tape = _spoken(synthesizer, text, SpeechSettings(rate=450, volume=0.1, pitch=99 if pitched else 50))
    assert tape.rate
    assert tape.most < MOST_AT_ONCE, "the first samples are written while the rest is made"
    if text in SILENT:
        assert tape.words == []
        assert tape.loudest == 0
    else:
        assert tape.words
        assert all(0 <= start < len(text) for start, _, _ in tape.words)
        assert tape.words[-1][2] < tape.seconds
        assert tape.loudest > 0
    _assert_alike(_spoken(synthesizer), alone)


def test_words_are_reported_with_their_positions_in_the_text(synthesizer: Synthesizer) -> None:
    tape = _spoken(synthesizer)
    words = [TEXT[start : start + length].strip(",") for start, length, _ in tape.words]
    assert words == TEXT.replace(",", "").split()


def test_rate_volume_and_pitch_are_obeyed_or_refused(synthesizer: Synthesizer, pitched: bool) -> None:
    usual = _spoken(synthesizer)
    assert _spoken(synthesizer, sound=SpeechSettings(rate=400)).seconds < 0.8 * usual.seconds
    assert _spoken(synthesizer, sound=SpeechSettings(rate=100)).seconds > 1.3 * usual.seconds
    assert 0 < _spoken(synthesizer, sound=SpeechSettings(volume=0.5)).loudest < 0.7 * usual.loudest
    assert _spoken(synthesizer, sound=SpeechSettings(volume=0.0)).loudest == 0
    if pitched:
        high, low = (_spoken(synthesizer, sound=SpeechSettings(pitch=each)).samples for each in (90, 10))
        assert high != low
    else:
        tape = Tape()
        with pytest.raises(CannotSpeak) as caught:
            synthesizer.speak(TEXT, SpeechSettings(pitch=90), tape)
        assert caught.value.reason == "bad_option"
        assert not tape.samples
    _assert_alike(_spoken(synthesizer), usual)


def test_phonemes_of_another_language_do_not_change_espeaks_voice() -> None:
    espeak = _espeak()
    own = espeak.voice
    try:
        espeak.load("gmw/de")
        before = _spoken(espeak, "zwanzig Züge", SpeechSettings(rate=300))
        with espeak.phonemizer("en-us") as speller:
            assert speller.word_positions("twenty trains") == [(0, 6), (7, 6)]
        _assert_alike(_spoken(espeak, "zwanzig Züge", SpeechSettings(rate=300)), before)
    finally:
        espeak.load(own)


def test_closing_a_phonemizer_does_not_wait_but_the_next_sentence_does() -> None:
    espeak = _espeak()
    before, tape = _spoken(espeak), Tape()
    asked, go = threading.Event(), threading.Event()
    order: list[str] = []

    def held(*arguments: object) -> object:
        asked.set()
        go.wait(LATE)
        said = library(*arguments)
        order.append("returned")
        return said

    def spell() -> None:
        with pytest.raises(Stopped):
            speller.clauses("hello")
        order.append("stopped")

    with espeak.phonemizer("de") as speller:
        library, speller._to_phonemes = speller._to_phonemes, held
        thread = threading.Thread(target=spell)
        thread.start()
        assert asked.wait(LATE)
    assert not order
    threading.Timer(0.1, go.set).start()
    espeak.speak(TEXT, SpeechSettings(), tape)
    assert order[0] == "returned"
    thread.join(LATE)
    assert order == ["returned", "stopped"]
    _assert_alike(tape, before)


@pytest.mark.parametrize(
    ("language", "text", "ends"),
    [
        ("en-us", "Mr. Smith is at home. The battery is low.", ["at home.", "is low."]),
        ("en-us", "Dr. Who and Mrs. Jones", ["Jones"]),
        ("en-us", "Count to 5. Then go! I see.", ["to 5.", "go!", "see."]),
        ("de", "Das ist Dr. Braun. Er hilft.", ["Dr.", "Braun.", "hilft."]),
    ],
)
def test_a_sentence_ends_where_libespeak_makes_a_pause(language: str, text: str, ends: list[str]) -> None:
    with _espeak().phonemizer(language) as speller:
        found = list(split_text(speller, text))
    starts = [each.words[0][1] for each in found]
    sentences = [text[begin:end].rstrip() for begin, end in zip(starts, [*starts[1:], None], strict=True)]
    assert [each.endswith(end) for each, end in zip(sentences, ends, strict=True)] == [True] * len(ends)


# -- the output


@limits()
@pytest.mark.parametrize(
    ("at", "after", "fails"),
    [
        ("begin", 0, Stopped()),
        ("word", 0, CannotSpeak(Reason.AUDIO_LOST, "unplugged")),
        ("word", 3, Stopped()),
        ("write", 0, CannotSpeak(Reason.AUDIO_LOST, "unplugged")),
        ("write", 5, Stopped()),
    ],
)
def test_an_error_of_the_output_is_raised_at_once_without_further_calls(
    synthesizer: Synthesizer, at: str, after: int, fails: Exception
) -> None:
    alone = _spoken(synthesizer)
    tape = Tape(fails=fails, at=at, after=after)
    with pytest.raises(type(fails)) as caught:
        synthesizer.speak("word " * 1000, SpeechSettings(), tape)
    assert caught.value is fails
    assert tape.failed_at is not None
    assert_within(time.monotonic() - tape.failed_at, AT_ONCE, "the end of a sentence that was stopped")
    _assert_alike(_spoken(synthesizer), alone)


def test_a_synthesizer_waits_for_a_slow_output(synthesizer: Synthesizer) -> None:
    """As long as it has not returned, nothing more comes: that is how a sentence is held."""
    inside = False

    class Slow(Tape):
        def write(self, samples: bytes) -> None:
            nonlocal inside
            assert not inside
            inside = True
            time.sleep(0.001)
            super().write(samples)
            inside = False

    tape = Slow()
    synthesizer.speak(TEXT, SpeechSettings(), tape)
    _assert_alike(tape, _spoken(synthesizer))
