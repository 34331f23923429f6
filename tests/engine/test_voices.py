"""Voices: what is found is what the library sets, whoever wrote it how; and a goal's voice is that goal's alone."""

from __future__ import annotations

import json
import subprocess
import sys
import wave
from functools import cache
from types import SimpleNamespace
from typing import TYPE_CHECKING

import pytest

from talkcli.engine import protocol
from talkcli.engine.protocol import Voice
from talkcli.engine.synthesizers import espeak
from talkcli.engine.synthesizers.voices import find_voice, languages, list_voices, unknown_voice
from tests.engine.spawned import USUAL, Spawned
from tests.support.reference import Sentence, render

if TYPE_CHECKING:
    from pathlib import Path

#: Sets each voice by its id in the library itself and says which one it has then.
SET_ALL = """
import json, sys
sys.path[:] = json.loads(sys.argv[1])
from talkcli.engine.synthesizers.espeak import load
espeak, *_ = load()
current = []
for each in json.load(sys.stdin):
    status = espeak.SetVoiceByName(each.encode())
    current.append([status, espeak.GetCurrentVoice().contents.identifier.decode()])
json.dump(current, sys.stdout)
"""

TEXT = "the battery is low, please come home"


@cache
def listed() -> tuple[Voice, ...]:
    """Return espeak's voices; what neural ones are installed stands behind them."""
    with Spawned() as engine:
        voices = engine.until(protocol.Voices).voices
    own = tuple(each for each in voices if not each.id.startswith("piper/"))
    assert voices[: len(own)] == own
    return own


def plain() -> list[Voice]:
    return [each for each in listed() if not each.id.startswith("+")]


def variants() -> list[Voice]:
    return [each for each in listed() if each.id.startswith("+")]


def test_the_variants_are_listed_after_the_voices() -> None:
    assert len(plain()) > 100
    assert [*plain(), *variants()] == list(listed())
    assert Voice("+f3", None, "variant female3") in variants()


def test_every_word_of_every_voice_is_found_whatever_its_case() -> None:
    for voice in listed():
        for word in (voice.id, voice.name, voice.id.rpartition("/")[2], voice.language):
            for each in (word, word.upper(), word.lower()) if word else ():
                found = find_voice(each, listed())
                assert found is not None, each
                assert word == voice.language or found.id.endswith(voice.id), (each, found)
                assert word != voice.language or found.language == voice.language, (each, found)


def test_what_is_found_is_what_the_library_sets() -> None:
    wanted = [each.id for each in listed()] + [f"{voice.id}+Andy" for voice in plain()]
    found = [find_voice(each, listed()) for each in wanted]
    ids = [each.id for each in found if each is not None]
    assert len(ids) == len(wanted)
    done = subprocess.run(
        [sys.executable, "-c", SET_ALL, json.dumps(sys.path)],
        input=json.dumps(ids),
        capture_output=True,
        encoding="utf-8",
        timeout=60,
        check=True,
    )
    assert json.loads(done.stdout) == [[0, each] for each in ids]


def test_every_voice_can_be_spoken_with_under_each_of_its_words(tmp_path: Path) -> None:
    with Spawned(f"file:{tmp_path / 'x.wav'}") as engine:
        engine.until(protocol.Ready)
        words = [word for voice in plain() for word in (voice.id, voice.name, voice.language) if word]
        for number, word in enumerate(words):
            ended = engine.spoken("a", f"g{number}", voice=word, rate=450)
            # In the wheel's library one voice has nothing for this text.
            assert ended.outcome == protocol.COMPLETED or ended.reason == "nothing_to_say", (word, ended)


@pytest.mark.parametrize(
    ("wanted", "expected"),
    [
        ("en-gb", "gmw/en"),
        ("EN", "gmw/en"),
        ("en-us", "gmw/en-US"),
        ("gmw/EN-us", "gmw/en-US"),
        ("english (america)", "gmw/en-US"),
        ("fr-fr", "roa/fr"),
        ("fr", "roa/fr"),
        ("pt", "roa/pt"),
        ("yue", "sit/yue"),
        ("en+f3", "gmw/en+f3"),
        ("en-GB+F3", "gmw/en+f3"),
        ("en-us+whisper", "gmw/en-US+whisper"),
        ("English (America)+andy", "gmw/en-US+Andy"),
        ("pt-br+Mr Serious", "roa/pt-BR+Mr serious"),
        ("en+2", "gmw/en+m2"),
        ("de+12", "gmw/de+f2"),
        ("+f3", "gmw/en+f3"),
        ("variant female3", "gmw/en+f3"),
    ],
)
def test_a_voice_is_found_as_users_write_it(wanted: str, expected: str) -> None:
    found = find_voice(wanted, listed())
    assert found is not None
    assert found.id == expected


NEURAL = (
    Voice("piper/de_DE-eva-low", "de-de", "eva, low"),
    Voice("piper/de_DE-eva", "de-de", "eva, medium"),
    Voice("piper/en_US-joe-medium", "en-us", "joe, medium"),
    Voice("piper/xx_XX-only", "xx-xx", "only"),
    Voice("piper/own-voice", None, "own"),
)


@pytest.mark.parametrize(
    ("wanted", "expected"),
    [
        ("piper/en_US-joe-medium", "piper/en_US-joe-medium"),
        ("Piper/EN_us-Joe", "piper/en_US-joe-medium"),
        ("piper/en", "piper/en_US-joe-medium"),
        ("piper/en#3", "piper/en_US-joe-medium#3"),
        ("piper/en#p225", "piper/en_US-joe-medium#p225"),
        ("piper/de_DE-eva", "piper/de_DE-eva"),
        ("piper/de_DE-eva-", "piper/de_DE-eva-low"),
        ("piper/de", None),
        ("piper/", None),
        ("piper/en-US_JOE", "piper/en_US-joe-medium"),
        ("piper/en#", None),
        ("piper/en+f3", None),
        ("en-us", "gmw/en-US"),
        ("de", "gmw/de"),
        ("xx-xx", None),
        ("zh-CN", None),
        ("de-DE", "gmw/de"),
        ("de_AT", "gmw/de"),
        ("en_US", "gmw/en-US"),
        ("EN_us+F3", "gmw/en-US+f3"),
        ("es-MX", "roa/es"),
        ("es_419", "roa/es-419"),
        ("de-DE+f3", "gmw/de+f3"),
        ("de-DE+nosuch", None),
        ("english", "gmw/en"),
        ("English+f3", "gmw/en+f3"),
        ("german", "gmw/de"),
        ("french", "roa/fr"),
        ("norwegian", "gmq/nb"),
        ("mandarin", "sit/cmn"),
        ("brazil", "roa/pt-BR"),
        ("chinese", None),
        ("only", "piper/xx_XX-only"),
        ("joe", "piper/en_US-joe-medium"),
        ("piper/joe", "piper/en_US-joe-medium"),
        ("Joe-Medium#3", "piper/en_US-joe-medium#3"),
        ("joe#", None),
        ("joe+f3", None),
        ("jo", None),
        ("en_US-joe-medium", "piper/en_US-joe-medium"),
        ("EN_us-joe", "piper/en_US-joe-medium"),
        ("en_US-amy-medium", None),
        ("de_DE-eva", "piper/de_DE-eva"),
        ("eva-low", "piper/de_DE-eva-low"),
        ("eva", None),
        ("medium", None),
        ("own", "piper/own-voice"),
        ("voice", None),
    ],
)
def test_a_voice_is_found_by_the_names_that_people_type(wanted: str, expected: str | None) -> None:
    found = find_voice(wanted, (*listed(), *NEURAL))
    assert (found.id if found else None) == expected


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
def test_the_language_of_the_neural_voice_that_a_server_speaks_with_means_that_one(
    wanted: str, preferred: str | None, expected: str | None
) -> None:
    found = find_voice(wanted, (*listed(), *NEURAL), preferred)
    assert (found.id if found else None) == expected


def test_a_voice_without_a_language_is_no_languages() -> None:
    voices = (*listed(), Voice("piper/broken", None, "broken"))
    assert find_voice("", voices, "piper/broken") is None


def test_of_another_driver_and_another_system_no_neural_voice_is_proposed(monkeypatch: pytest.MonkeyPatch) -> None:
    told = unknown_voice("piper/en", (*listed(), *NEURAL), "dummy")
    assert told == '"piper/en" is a neural voice, and the driver "dummy" has none: leave --driver out'
    monkeypatch.setattr(sys, "platform", "darwin")
    told = unknown_voice("piper/en", (), "nsss")
    assert told == '"piper/en" is a neural voice, which only talk on Linux has: choose one that "talk voices" lists'
    assert "unknown voice" in unknown_voice("anna", (), "nsss")


@pytest.mark.parametrize(
    ("wanted", "words"),
    [
        ("piper/de", 'the voice "piper/de" could be piper/de_DE-eva-low or piper/de_DE-eva: name one of them'),
        ("eva#2", 'the voice "eva#2" could be piper/de_DE-eva-low#2 or piper/de_DE-eva#2: name one of them'),
        ("chinese", 'the voice "chinese" could be cmn or yue: name one of them'),
        ("chinese+f3", 'the voice "chinese+f3" could be cmn+f3 or yue+f3: name one of them'),
        (
            "piper/",
            'the voice "piper/" could be piper/de_DE-eva-low or piper/de_DE-eva or piper/en_US-joe-medium or 2 ',
        ),
        ("piper/en_US-jo-medium", "unknown voice \"piper/en_US-jo-medium\": did you mean 'piper/en_US-joe-medium'?"),
        ("en_US-jo-medium", "unknown voice \"en_US-jo-medium\": did you mean 'en_US-joe-medium'?"),
        ("piper/zzzzzzzzzzz", 'unknown voice "piper/zzzzzzzzzzz": put NAME.onnx and NAME.onnx.json into '),
        ("nosuch", 'unknown voice "nosuch": "talk voices" lists them'),
        ("joe+f3", "unknown voice \"joe+f3\": did you mean 'joe'?"),
    ],
)
def test_a_voice_that_is_not_found_says_which_ones_it_could_be(wanted: str, words: str) -> None:
    assert unknown_voice(wanted, (*listed(), *NEURAL)).startswith(words)


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
def test_the_languages_that_a_code_or_an_english_name_means(wanted: str, expected: set[str]) -> None:
    assert languages(wanted, (*listed(), *NEURAL)) == expected


@pytest.mark.parametrize(
    "wanted",
    [
        "",
        "+",
        "en+",
        "en+nosuch",
        "en+f3+f2",
        "en+female3",
        "en+99",
        "+99",
        "f3",
        "../lang/gmw/en",
        "!v/f3",
        "nosuch+f3",
    ],
)
def test_what_the_library_would_refuse_or_pass_over_is_not_found(wanted: str) -> None:
    assert find_voice(wanted, listed()) is None


@pytest.mark.parametrize(
    ("wanted", "near"),
    [
        ("en-uss", ["en-us"]),
        ("germna", ["German"]),
        ("englsh", ["English"]),
        ("rusian", ["Russian"]),
        ("frnch", ["French"]),
        ("mandrin", ["Mandarin"]),
        ("en-us+whispr", ["en-us+whisper"]),
        ("+whispr", ["+whisper"]),
        ("germna+f3", ["German"]),
    ],
)
def test_an_unknown_voice_is_told_what_comes_near(wanted: str, near: list[str]) -> None:
    told = unknown_voice(wanted, listed())
    assert told.startswith(f'unknown voice "{wanted}": did you mean ')
    assert told.endswith('? "talk voices" lists them')
    assert told.count(" or ") < 3
    for each in near:
        assert repr(each) in told


def test_the_voices_of_another_driver_may_be_called_after_persons() -> None:
    voices = (Voice("com.apple.Alex", "en_US", "Alex"), Voice("com.apple.Daniel", "en_GB", "Daniel"))
    assert "did you mean 'Daniel'" in unknown_voice("Danel", voices)
    assert "en_GB" not in unknown_voice("Danel", voices)


def test_a_word_of_any_length_is_answered_shortly() -> None:
    for wanted in ("x" * 60_000, "en-us+" + "y" * 60_000):
        assert find_voice(wanted, listed()) is None
        assert len(unknown_voice(wanted, listed())) < 200


@pytest.mark.parametrize(
    ("languages", "language"), [(["en-US", "en-GB"], "en-US"), ([b"\x05en-us"], "en-us"), ([None], None), ([], None)]
)
def test_a_language_is_listed_however_another_driver_tells_it(languages: list[object], language: str | None) -> None:
    engine = SimpleNamespace(getProperty=lambda _: [SimpleNamespace(id="a", name="Anna", languages=languages)])
    assert list_voices(engine) == (Voice("a", language, "Anna"),)


def test_a_plus_in_the_name_of_another_drivers_voice_is_part_of_it() -> None:
    others = (Voice("voice.1", "en", "Anna+"), Voice("voice.2", None, "Bert"))
    assert find_voice("anna+", others) == others[0]
    assert find_voice("bert+f3", others) is None
    assert "'Bert'" in unknown_voice("Berta", others)


def test_mbrolas_voices_are_there_where_they_are_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    known = [Voice("mb/mb-de4-en", "en", "german-mbrola-4-en"), Voice("mb/mb-us1", "en-us", "us-mbrola-1")]
    monkeypatch.setattr(espeak, "_listed", lambda *_: known)
    monkeypatch.setattr(espeak, "_MBROLA_PLACES", (f"{tmp_path}/{{0}}/{{0}}",))
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    (tmp_path / "us1").mkdir()
    (tmp_path / "us1" / "us1").touch()
    assert espeak._mbrola_voices(None) == []
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "mbrola").touch(0o755)
    assert espeak._mbrola_voices(None) == [Voice("mb/mb-us1", "en-us", "us-mbrola-1")]


@pytest.mark.parametrize("voice", ["zle/be", "piqd", "en+fast", "en-us+whisper"])
def test_after_a_goals_own_voice_the_default_sounds_as_before(tmp_path: Path, voice: str) -> None:
    """As the library's own, which sets everything anew for each sentence; some voices leave their speed behind."""
    target = tmp_path / "x.wav"
    with Spawned(f"file:{target}") as engine:
        engine.until(protocol.Ready)
        durations = [
            engine.spoken(TEXT, "g1", rate=USUAL).duration,
            engine.spoken(TEXT, "g2", rate=USUAL, voice=voice).duration,
            engine.spoken(TEXT, "g3", rate=USUAL).duration,
        ]
    with wave.open(str(target)) as file:
        samples = file.readframes(file.getnframes())
    own = find_voice(voice, listed())
    assert own is not None
    references = render([Sentence(TEXT, voice="gmw/en"), Sentence(TEXT, voice=own.id), Sentence(TEXT, voice="gmw/en")])
    assert samples == b"".join(each.tobytes() for each in references)
    assert durations[2] == pytest.approx(durations[0], abs=0.05)


@pytest.mark.parametrize("unknown", ["en-us+nosuch", "nosuch", "mb-us1"])
def test_an_unknown_voice_between_leaves_the_voice_as_it_was(tmp_path: Path, unknown: str) -> None:
    files = [tmp_path / "with.wav", tmp_path / "without.wav"]
    for target in files:
        with Spawned(f"file:{target}") as engine:
            engine.until(protocol.Ready)
            assert engine.spoken(TEXT, "g1", voice="en-us").outcome == protocol.COMPLETED
            if target == files[0]:
                assert engine.spoken(TEXT, "g2", voice=unknown).reason == "unknown_voice"
            assert engine.spoken(TEXT, "g3", voice="en-us").outcome == protocol.COMPLETED
    assert files[0].read_bytes() == files[1].read_bytes()


def test_a_voice_is_found_by_id_name_or_language() -> None:
    voices = (Voice("gmw/en", "en-gb", "English"), Voice("gmw/en-US", "en-us", "English (America)"))
    assert find_voice("GMW/EN-us", voices) == voices[1]
    assert find_voice("english", voices) == voices[0]
    assert find_voice("en-US", voices) == voices[1]
    assert find_voice("fr", voices) is None
    assert unknown_voice("en-uss", voices).startswith('unknown voice "en-uss": did you mean ')
    assert unknown_voice("qqq", voices) == 'unknown voice "qqq": "talk voices" lists them'
