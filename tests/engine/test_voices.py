"""Tests for voices: finding them by name, suggesting similar names, and setting the voice of one goal."""

from __future__ import annotations

import sys
import wave
from functools import cache
from types import SimpleNamespace
from typing import TYPE_CHECKING

import pytest

from talkcli.engine import protocol
from talkcli.engine.child.synthesizers import espeak
from talkcli.engine.protocol import Voice
from talkcli.engine.voices import find_voice, list_voices, matching_languages, unknown_voice_message
from tests.engine.process import USUAL, Engine
from tests.support.reference import Sentence, render

if TYPE_CHECKING:
    from pathlib import Path
TEXT = "the battery is low"
NEURAL = (
    Voice("piper/de_DE-eva-low", "de-de", "eva, low"),
    Voice("piper/de_DE-eva", "de-de", "eva, medium"),
    Voice("piper/en_US-joe-medium", "en-us", "joe, medium"),
    Voice("piper/xx_XX-only", "xx-xx", "only"),
    Voice("piper/own-voice", None, "own"),
)


@cache
def listed() -> tuple[Voice, ...]:
    """Return espeak's voices. They must be listed before the installed neural voices."""
    with Engine() as engine:
        voices = engine.until(protocol.VoiceList).voices
    espeak_voices = tuple(voice for voice in voices if not voice.id.startswith("piper/"))
    assert voices[: len(espeak_voices)] == espeak_voices
    return espeak_voices


def plain() -> list[Voice]:
    """Return espeak's voices without the variants."""
    return [voice for voice in listed() if not voice.id.startswith("+")]


def find_id(wanted: str, preferred: str | None = None) -> str | None:
    """Return the id of the voice that is found among espeak's and the neural voices."""
    voice = find_voice(wanted, (*listed(), *NEURAL), preferred)
    return voice.id if voice else None


# -- espeak's voices


def test_the_variants_are_listed_after_the_voices() -> None:
    assert len(plain()) > 100
    variants = [voice for voice in listed() if voice.id.startswith("+")]
    assert [*plain(), *variants] == list(listed())
    assert Voice("+f3", None, "variant female3") in variants


def test_every_voice_is_found_by_each_of_its_names_in_any_case() -> None:
    for voice in listed():
        for name in (voice.id, voice.name, voice.id.rpartition("/")[2], voice.language):
            for spelling in (name, name.upper(), name.lower()) if name else ():
                match = find_voice(spelling, listed())
                assert match is not None, spelling
                assert name == voice.language or match.id.endswith(voice.id), (spelling, match)
                assert name != voice.language or match.language == voice.language, (spelling, match)


def test_every_voice_can_speak_under_each_of_its_names(tmp_path: Path) -> None:
    with Engine(f"file:{tmp_path / 'x.wav'}") as engine:
        names = [name for voice in plain() for name in (voice.id, voice.name, voice.language) if name]
        for number, name in enumerate(names):
            ended = engine.spoken("a", f"g{number}", voice=name, rate=450)
            # In the wheel's library, one voice makes no sound from this text.
            assert ended.outcome == protocol.OUTCOME_COMPLETED or ended.reason == "nothing_to_say", (name, ended)


# -- by the names that people type

#: Ids of espeak's voices, and names that mean them.
ESPEAK_NAMES = {
    "gmw/en": ["en-gb", "EN", "english"],
    "gmw/en+f3": ["en+f3", "en-GB+F3", "+f3", "variant female3", "English+f3"],
    "gmw/en+m2": ["en+2"],
    "gmw/en-US": ["en-us", "gmw/EN-us", "english (america)", "en_US"],
    "gmw/en-US+whisper": ["en-us+whisper"],
    "gmw/en-US+Andy": ["English (America)+andy"],
    "gmw/en-US+f3": ["EN_us+F3"],
    "gmw/de": ["de", "de-DE", "de_AT", "german"],
    "gmw/de+f2": ["de+12"],
    "gmw/de+f3": ["de-DE+f3"],
    "roa/fr": ["fr-fr", "fr", "french"],
    "roa/pt": ["pt"],
    "roa/pt-BR": ["brazil"],
    "roa/pt-BR+Mr serious": ["pt-br+Mr Serious"],
    "roa/es": ["es-MX"],
    "roa/es-419": ["es_419"],
    "sit/yue": ["yue"],
    "sit/cmn": ["mandarin"],
    "gmq/nb": ["norwegian"],
}
#: Ids of neural voices, and names that mean them.
NEURAL_NAMES = {
    "piper/en_US-joe-medium": [
        *("piper/en_US-joe-medium", "Piper/EN_us-Joe", "piper/en", "piper/en-US_JOE", "joe", "piper/joe"),
        *("en_US-joe-medium", "EN_us-joe"),
    ],
    "piper/en_US-joe-medium#3": ["piper/en#3", "Joe-Medium#3"],
    "piper/en_US-joe-medium#p225": ["piper/en#p225"],
    "piper/de_DE-eva": ["piper/de_DE-eva", "de_DE-eva"],
    "piper/de_DE-eva-low": ["piper/de_DE-eva-", "eva-low"],
    "piper/xx_XX-only": ["only"],
    "piper/own-voice": ["own"],
}
#: Names that mean no voice, or several.
UNCLEAR_NAMES = [
    *("piper/de", "piper/", "piper/en#", "piper/en+f3", "xx-xx", "zh-CN", "de-DE+nosuch", "chinese", "joe#", "joe+f3"),
    *("jo", "en_US-amy-medium", "eva", "medium", "voice"),
    # The library would refuse these, or ignore a part of them.
    *("", "+", "en+", "en+nosuch", "en+f3+f2", "en+female3", "en+99", "+99", "f3", "../lang/gmw/en", "!v/f3"),
    "nosuch+f3",
]


@pytest.mark.parametrize(
    ("wanted", "expected"),
    [
        *((name, voice) for voice, names in {**ESPEAK_NAMES, **NEURAL_NAMES}.items() for name in names),
        *((name, None) for name in UNCLEAR_NAMES),
    ],
)
def test_a_voice_is_found_by_the_names_that_people_type(wanted: str, expected: str | None) -> None:
    assert find_id(wanted) == expected
    if expected is None or not expected.startswith("piper/"):
        voice = find_voice(wanted, listed())
        assert (voice.id if voice else None) == expected, "without neural voices, another voice is found"


@pytest.mark.parametrize(
    ("wanted", "preferred", "expected"),
    [
        ("en-us", "piper/en", "piper/en_US-joe-medium"),
        ("EN-us", "Piper/EN_us-joe#2", "piper/en_US-joe-medium#2"),
        ("en", "piper/en", "piper/en_US-joe-medium"),
        ("de", "piper/de_DE-eva", "piper/de_DE-eva"),
        ("de-de", "piper/de_DE-eva", "piper/de_DE-eva"),
        ("de_DE", "piper/de_DE-eva", "piper/de_DE-eva"),
        ("english", "piper/en", "piper/en_US-joe-medium"),
        ("en-gb", "piper/en", "gmw/en"),
        ("en-us+f3", "piper/en", "gmw/en-US+f3"),
        ("English (America)", "piper/en", "gmw/en-US"),
        ("gmw/en-US", "piper/en", "gmw/en-US"),
        ("gmw/en", "piper/en", "gmw/en"),
        ("fr", "piper/en", "roa/fr"),
        ("e", "piper/en", None),
        ("en-us", "piper/none", "gmw/en-US"),
        ("en-us", "piper/de", "gmw/en-US"),
        ("en-us", "de", "gmw/en-US"),
        ("piper/de_DE-eva-low", "piper/en", "piper/de_DE-eva-low"),
    ],
)
def test_a_language_means_the_servers_neural_voice(wanted: str, preferred: str, expected: str | None) -> None:
    assert find_id(wanted, preferred) == expected


def test_a_voice_without_a_language_matches_no_language() -> None:
    voices = (*listed(), Voice("piper/broken", None, "broken"))
    assert find_voice("", voices, "piper/broken") is None


@pytest.mark.parametrize(
    ("wanted", "expected"),
    [
        ("EN_us", {"en-us", "en-us-nyc"}),
        ("de-DE", {"de-de"}),
        ("de-AT", {"de", "de-de"}),
        ("german", {"de", "de-de"}),
        ("french", {"fr-fr", "fr-be", "fr-ch"}),
        ("brazil", {"pt-br"}),
        ("chinese", {"cmn", "cmn-latn-pinyin", "yue"}),
        ("e", set()),
        ("joe", set()),
        ("", set()),
    ],
)
def test_a_code_or_an_english_name_matches_its_languages(wanted: str, expected: set[str]) -> None:
    assert matching_languages(wanted, (*listed(), *NEURAL)) == expected


# -- errors for other names


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        ("piper/de", 'the voice "piper/de" could be piper/de_DE-eva-low or piper/de_DE-eva; write the whole name'),
        ("eva#2", 'the voice "eva#2" could be piper/de_DE-eva-low#2 or piper/de_DE-eva#2; write the whole name'),
        ("chinese", 'the voice "chinese" could be cmn or yue; write the whole name'),
        ("chinese+f3", 'the voice "chinese+f3" could be cmn+f3 or yue+f3; write the whole name'),
        (
            "piper/",
            'the voice "piper/" could be piper/de_DE-eva-low or piper/de_DE-eva or piper/en_US-joe-medium, or 2 ',
        ),
        ("piper/en_US-jo-medium", "unknown voice \"piper/en_US-jo-medium\"; did you mean 'piper/en_US-joe-medium'?"),
        ("en_US-jo-medium", "unknown voice \"en_US-jo-medium\"; did you mean 'en_US-joe-medium'?"),
        ("piper/zzzzzzzzzzz", 'unknown voice "piper/zzzzzzzzzzz"; put NAME.onnx and NAME.onnx.json into '),
        ("nosuch", 'unknown voice "nosuch"; list all voices with: talk voices'),
        ("joe+f3", "unknown voice \"joe+f3\"; did you mean 'joe'?"),
    ],
)
def test_the_error_for_an_unclear_voice_lists_the_possible_ones(wanted: str, message: str) -> None:
    assert unknown_voice_message(wanted, (*listed(), *NEURAL)).startswith(message)


@pytest.mark.parametrize(
    ("wanted", "suggestion"),
    [
        ("en-uss", "en-us"),
        ("germna", "German"),
        ("englsh", "English"),
        ("rusian", "Russian"),
        ("frnch", "French"),
        ("mandrin", "Mandarin"),
        ("en-us+whispr", "en-us+whisper"),
        ("+whispr", "+whisper"),
        ("germna+f3", "German"),
    ],
)
def test_similar_names_are_suggested_for_an_unknown_voice(wanted: str, suggestion: str) -> None:
    message = unknown_voice_message(wanted, listed())
    assert message.startswith(f'unknown voice "{wanted}"; did you mean ')
    assert message.endswith("? list all voices with: talk voices")
    assert message.count(" or ") < 3
    assert repr(suggestion) in message


def test_a_very_long_name_gets_a_short_error() -> None:
    for wanted in ("x" * 60_000, "en-us+" + "y" * 60_000):
        assert find_voice(wanted, listed()) is None
        assert len(unknown_voice_message(wanted, listed())) < 200


# -- voices of other drivers


def test_neural_voices_are_not_suggested_for_other_drivers_or_systems(monkeypatch: pytest.MonkeyPatch) -> None:
    message = unknown_voice_message("piper/en", (*listed(), *NEURAL), "dummy")
    assert message == '"piper/en" is a neural voice, which the driver "dummy" does not support; leave out --driver'
    monkeypatch.setattr(sys, "platform", "darwin")
    expected = '"piper/en" is a neural voice, which talk only supports on Linux; list other voices with: talk voices'
    assert unknown_voice_message("piper/en", (), "nsss") == expected
    assert "unknown voice" in unknown_voice_message("anna", (), "nsss")


def test_voices_of_other_drivers_may_have_a_plus_in_their_names() -> None:
    voices = (Voice("com.apple.Alex", "en_US", "Alex"), Voice("com.apple.Daniel", "en_GB", "Daniel+"))
    assert "did you mean 'Daniel+'" in unknown_voice_message("Danel", voices)
    assert "en_GB" not in unknown_voice_message("Danel", voices)
    assert find_voice("daniel+", voices) == voices[1]
    assert find_voice("alex+f3", voices) is None


@pytest.mark.parametrize(
    ("languages", "language"), [(["en-US", "en-GB"], "en-US"), ([b"\x05en-us"], "en-us"), ([None], None), ([], None)]
)
def test_a_language_is_listed_in_any_form_that_drivers_use(languages: list[object], language: str | None) -> None:
    engine = SimpleNamespace(getProperty=lambda _: [SimpleNamespace(id="a", name="Anna", languages=languages)])
    assert list_voices(engine) == (Voice("a", language, "Anna"),)


def test_mbrola_voices_are_listed_if_they_are_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    known = [Voice("mb/mb-de4-en", "en", "german-mbrola-4-en"), Voice("mb/mb-us1", "en-us", "us-mbrola-1")]
    monkeypatch.setattr(espeak, "_list_voices", lambda *_: known)
    monkeypatch.setattr(espeak, "_MBROLA_PATHS", (f"{tmp_path}/{{0}}/{{0}}",))
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    (tmp_path / "us1").mkdir()
    (tmp_path / "us1" / "us1").touch()
    assert espeak._list_mbrola_voices(None) == []
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "mbrola").touch(0o755)
    assert espeak._list_mbrola_voices(None) == [Voice("mb/mb-us1", "en-us", "us-mbrola-1")]


# -- the voice of a goal


def test_a_goals_voice_does_not_change_how_the_default_sounds(tmp_path: Path) -> None:
    """Some voices change the library's speed, so the reference sets all parameters again for each sentence."""
    target = tmp_path / "x.wav"
    unknown = ["nosuch", "nosuch", "en-us+nosuch", "mb-us1"]
    order = [None, *unknown, None, "zle/be", None, "piqd", None, "en+fast", *unknown, None, "en-us+whisper", None]
    durations, sentences = [], []
    with Engine(f"file:{target}") as engine:
        for number, voice in enumerate(order):
            ended = engine.spoken(TEXT, f"g{number}", rate=USUAL, voice=voice)
            if voice in unknown:
                assert ended.reason == "unknown_voice"
                continue
            match = find_voice(voice or "gmw/en", listed())
            assert match is not None
            sentences.append(Sentence(TEXT, voice=match.id))
            if voice is None:
                durations.append(ended.duration)
    with wave.open(str(target)) as file:
        samples = file.readframes(file.getnframes())
    assert samples == b"".join(sentence.tobytes() for sentence in render(sentences))
    assert durations == [pytest.approx(durations[0], abs=0.05)] * 6
