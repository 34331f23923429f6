"""Tests that every synthesizer behaves as `synthesizers.base.Synthesizer` describes.

To test a new synthesizer, add it to `SYNTHESIZERS`.
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
from talkcli.engine.voices import UnknownVoice
from talkcli.goals.reasons import Reason
from talkcli.install import NEURAL_PACKAGES
from tests.support import tiny_voice
from tests.support.real_voice import REAL_VOICE, link_without_noise, real_voice
from tests.support.surroundings import needs_packages
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from talkcli.engine.child.synthesizers.base import Synthesizer

TEXT = "battery low, please come home"
#: Various texts.
TEXTS = [
    TEXT,
    "a",
    "I go. This one, on the 1,000th day, is well-known: it's «hello», U.S.A.!",
    "日本語 のテキスト, привет мир 😀 n\u0303 e\u0301",
    "one\x01two\x00three\ttab\nline\r\n\x7f \ud800 \ufffd \u200d",
    "word " * 200,
]
#: Texts without any words.
SILENT = ["", " ", "\n\t ", "...", "\x00"]
#: Seconds by which two renderings of a text may differ. libespeak-ng's noise moves the next sounds by some samples, and
#: after a text in another script, the pause at the first comma is 44 ms longer.
NEAR = 0.05
#: Seconds within which `speak` returns after its output has raised an error.
AT_ONCE = 0.05
#: Seconds within which a voice is loaded.
LOADED = 0.5
#: Seconds after which a wait fails.
LATE = 20.0
#: The most seconds of sound in one call of `write`, so that speech starts while the rest is still being made.
MAX_WRITE_S = 0.2


@cache
def _espeak() -> Espeak:
    """Return the only instance in this process. Its library can be loaded only once, and can't be unloaded."""
    return Espeak()


def _piper(voice: str = "piper/tiny") -> Synthesizer:
    """Return a synthesizer with this neural voice. "tiny" hums, and takes only some milliseconds."""
    needs_packages(*NEURAL_PACKAGES)
    synthesizer = Piper(_espeak())
    synthesizer.choose_voice(voice)
    return synthesizer


def _joe() -> Synthesizer:
    """Return a synthesizer with a real neural voice, without noise."""
    link_without_noise(real_voice(), Path(os.environ["TALK_VOICES"]))
    return _piper(f"piper/{real_voice().stem}")


def _combined() -> Synthesizer:
    needs_packages(*NEURAL_PACKAGES)
    return CombinedSynthesizer(_espeak())


SYNTHESIZERS: dict[str, Callable[[], Synthesizer]] = {
    "espeak": _espeak,
    "piper": _piper,
    "joe": _joe,
    "combined": _combined,
}
#: Synthesizers whose tests take half a minute.
SLOW = {"joe"}
#: Synthesizers whose pitch can't be changed.
UNPITCHED = {"piper", "joe"}


@pytest.fixture(scope="module", autouse=True)
def voices(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Install two tiny neural voices."""
    folder = tmp_path_factory.mktemp("voices")
    tiny_voice.put(folder, "tiny")
    tiny_voice.put(folder, "wee", tiny_voice.model(period=60))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TALK_VOICES", str(folder))
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(
    params=[pytest.param(name, marks=pytest.mark.slow if name in SLOW else ()) for name in SYNTHESIZERS],
    scope="module",
)
def shared_synthesizer(request: pytest.FixtureRequest) -> tuple[Synthesizer, str]:
    """Return a synthesizer and its default voice. All tests share it, because a process has only one."""
    synthesizer = SYNTHESIZERS[request.param]()
    return synthesizer, synthesizer.voice


@pytest.fixture
def pitched(request: pytest.FixtureRequest) -> bool:
    """Return whether the synthesizer can change its pitch."""
    return request.node.callspec.params["shared_synthesizer"] not in UNPITCHED


@pytest.fixture
def synthesizer(shared_synthesizer: tuple[Synthesizer, str]) -> Iterator[Synthesizer]:
    synthesizer, default_voice = shared_synthesizer
    yield synthesizer
    synthesizer.choose_voice(default_voice)


class Tape:
    """A sink that records everything, and checks the order of the calls. It can raise an error."""

    def __init__(self, *, error: Exception | None = None, at: str = "", after: int = 0) -> None:
        """Set the error that the method named `at` raises after the given number of calls."""
        self.rate = 0
        self.words: list[tuple[int, int, float]] = []
        self.samples = bytearray()
        self.longest_write_s = 0.0
        self.failed_at: float | None = None
        self._error, self._at, self._calls_left = error, at, after
        self._thread = threading.get_ident()

    @property
    def seconds(self) -> float:
        return len(self.samples) / SAMPLE_BYTES / self.rate

    @property
    def loudest(self) -> int:
        return max(map(abs, array("h", bytes(self.samples))), default=0)

    def begin(self, rate: int, voice: str, fallback_reason: str | None = None) -> None:
        self._called("begin")
        assert not [*self.words, *self.samples], "begin was called after word or write"
        assert rate > 0
        assert voice
        assert fallback_reason is None, "another voice speaks"
        self.rate = rate

    def word(self, start: int, length: int, audio_start: float) -> None:
        self._called("word")
        assert self.rate, "word was called before begin"
        assert length > 0
        assert audio_start >= 0
        assert round(audio_start * self.rate) >= len(self.samples) // SAMPLE_BYTES, "a word came after its samples"
        assert not self.words or audio_start >= self.words[-1][2], "the position decreased"
        self.words.append((start, length, audio_start))

    def write(self, samples: bytes) -> None:
        self._called("write")
        assert self.rate, "write was called before begin"
        assert len(samples) % SAMPLE_BYTES == 0, "a sample is incomplete"
        self.samples += samples
        self.longest_write_s = max(self.longest_write_s, len(samples) / SAMPLE_BYTES / self.rate)

    def wait(self, descriptor: int) -> None:
        self._called("wait")
        assert select.select([descriptor], [], [], LATE)[0], "the descriptor never became readable"

    def _called(self, method: str) -> None:
        assert threading.get_ident() == self._thread, "the call came from another thread"
        assert self.failed_at is None, "the call came after an error"
        if self._error is not None and method == self._at:
            self._calls_left -= 1
            if self._calls_left < 0:
                self.failed_at = time.monotonic()
                raise self._error


def _spoken(synthesizer: Synthesizer, text: str = TEXT, sound: SpeechSettings | None = None) -> Tape:
    tape = Tape()
    synthesizer.speak(text, sound or SpeechSettings(voice_only=True), tape)
    return tape


def _assert_alike(first: Tape, second: Tape) -> None:
    """Assert that two tapes have the same sentence, except for noise."""
    assert first.rate == second.rate
    assert first.seconds == pytest.approx(second.seconds, abs=NEAR)
    assert [word[:2] for word in first.words] == [word[:2] for word in second.words]
    assert [word[2] for word in first.words] == pytest.approx([word[2] for word in second.words], abs=NEAR)
    assert first.loudest == pytest.approx(second.loudest, rel=0.2)


# -- voices


def _plain_ids(synthesizer: Synthesizer) -> list[str]:
    """Return the ids of all voices except variants. The slow real voice is only included if it is the current one."""
    ids = [voice.id for voice in synthesizer.voices() if not voice.id.startswith("+")]
    return [voice for voice in ids if voice != REAL_VOICE or voice == synthesizer.voice]


def test_voices_have_unique_ids_and_include_the_current_one(shared_synthesizer: tuple[Synthesizer, str]) -> None:
    synthesizer, default_voice = shared_synthesizer
    voices = synthesizer.voices()
    ids = {voice.id for voice in voices}
    assert len(ids) == len(voices)
    assert default_voice in ids
    assert all(voice.id and voice.name and voice.language != "" for voice in voices)
    assert synthesizer.voices() == voices


@limits()
def test_a_voice_is_loaded_quickly_with_or_without_a_variant(synthesizer: Synthesizer) -> None:
    """libespeak-ng has many voices, so this test loads only some. `test_voices.py` speaks with all of them."""
    plain = _plain_ids(synthesizer)
    variants = [voice.id for voice in synthesizer.voices() if voice.id.startswith("+")]
    step = len(plain) // 10 + 1
    for voice in [*plain[::step], *(plain[0] + variant for variant in variants[::20])]:
        started_at = time.monotonic()
        synthesizer.choose_voice(voice)
        assert_within(time.monotonic() - started_at, LOADED, voice)
        assert synthesizer.voice == voice
        _spoken(synthesizer, "a")


def test_the_last_chosen_voice_speaks(shared_synthesizer: tuple[Synthesizer, str], synthesizer: Synthesizer) -> None:
    before = _spoken(synthesizer)
    other = next(voice for voice in reversed(_plain_ids(synthesizer)) if voice != shared_synthesizer[1])
    synthesizer.choose_voice(other)
    after = _spoken(synthesizer)
    assert after.samples != before.samples
    synthesizer.choose_voice(shared_synthesizer[1])
    _assert_alike(_spoken(synthesizer), before)


@pytest.mark.parametrize("voice", ["no such voice", "", "no/such+voice", "\ud800"])
def test_an_unknown_voice_leaves_the_current_one_unchanged(synthesizer: Synthesizer, voice: str) -> None:
    before, spoken = synthesizer.voice, _spoken(synthesizer, sound=SpeechSettings(rate=300))
    with pytest.raises(UnknownVoice) as caught:
        synthesizer.choose_voice(voice)
    assert str(caught.value)
    assert synthesizer.voice == before
    _assert_alike(_spoken(synthesizer, sound=SpeechSettings(rate=300)), spoken)


# -- words and samples


@pytest.mark.parametrize("text", [*TEXTS, *SILENT], ids=range(len(TEXTS) + len(SILENT)))
def test_any_text_is_spoken_without_affecting_the_next_one(synthesizer: Synthesizer, pitched: bool, text: str) -> None:
    """`Tape` checks the order of the calls."""
    before = _spoken(synthesizer)
    tape = _spoken(synthesizer, text, SpeechSettings(rate=450, volume=0.1, pitch=99 if pitched else 50))
    assert tape.rate
    assert tape.longest_write_s < MAX_WRITE_S
    if text in SILENT:
        assert tape.words == []
        assert tape.loudest == 0
    else:
        assert tape.words
        assert all(0 <= start < len(text) for start, _, _ in tape.words)
        assert tape.words[-1][2] < tape.seconds
        assert tape.loudest > 0
    _assert_alike(_spoken(synthesizer), before)


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
        high, low = (_spoken(synthesizer, sound=SpeechSettings(pitch=pitch)).samples for pitch in (90, 10))
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
    default_voice = espeak.voice
    try:
        espeak.choose_voice("gmw/de")
        before = _spoken(espeak, "zwanzig Züge", SpeechSettings(rate=300))
        with espeak.phonemizer("en-us") as phonemizer:
            assert phonemizer.word_positions("twenty trains") == [(0, 6), (7, 6)]
        _assert_alike(_spoken(espeak, "zwanzig Züge", SpeechSettings(rate=300)), before)
    finally:
        espeak.choose_voice(default_voice)


def test_closing_a_phonemizer_does_not_wait_but_the_next_sentence_does() -> None:
    espeak = _espeak()
    before, tape = _spoken(espeak), Tape()
    called, may_return = threading.Event(), threading.Event()
    order: list[str] = []

    def slow(*arguments: object) -> object:
        called.set()
        may_return.wait(LATE)
        phonemes = to_phonemes(*arguments)
        order.append("returned")
        return phonemes

    def phonemize() -> None:
        with pytest.raises(Stopped):
            phonemizer.clauses("hello")
        order.append("stopped")

    with espeak.phonemizer("de") as phonemizer:
        to_phonemes, phonemizer._to_phonemes = phonemizer._to_phonemes, slow
        thread = threading.Thread(target=phonemize)
        thread.start()
        assert called.wait(LATE)
    assert not order
    threading.Timer(0.1, may_return.set).start()
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
    with _espeak().phonemizer(language) as phonemizer:
        starts = [sentence.words[0][1] for sentence in split_text(phonemizer, text)]
    sentences = [text[start:end].rstrip() for start, end in zip(starts, [*starts[1:], None], strict=True)]
    assert all(sentence.endswith(end) for sentence, end in zip(sentences, ends, strict=True)), sentences


# -- the output


@limits()
@pytest.mark.parametrize(
    ("at", "after", "error"),
    [
        ("begin", 0, Stopped()),
        ("word", 0, CannotSpeak(Reason.AUDIO_LOST, "unplugged")),
        ("word", 3, Stopped()),
        ("write", 0, CannotSpeak(Reason.AUDIO_LOST, "unplugged")),
        ("write", 5, Stopped()),
    ],
)
def test_an_error_of_the_output_is_raised_at_once_without_further_calls(
    synthesizer: Synthesizer, at: str, after: int, error: Exception
) -> None:
    before = _spoken(synthesizer)
    tape = Tape(error=error, at=at, after=after)
    with pytest.raises(type(error)) as caught:
        synthesizer.speak("word " * 1000, SpeechSettings(), tape)
    assert caught.value is error
    assert tape.failed_at is not None
    assert_within(time.monotonic() - tape.failed_at, AT_ONCE, "the end of a sentence that was stopped")
    _assert_alike(_spoken(synthesizer), before)


def test_a_synthesizer_waits_for_a_slow_output(synthesizer: Synthesizer) -> None:
    """A sink pauses the sentence by not returning from a call."""
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
