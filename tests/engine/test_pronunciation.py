"""Pronunciations with real voices: the words keep their places, and a term sounds like its replacement."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from talkcli.engine import protocol
from talkcli.frozen import replace
from talkcli.install import NEURAL_PACKAGES
from tests.engine.process import FAST, Engine
from tests.support import tiny_voice
from tests.support.real_voice import REAL_VOICE, link_without_noise, real_voice
from tests.support.surroundings import needs_packages

if TYPE_CHECKING:
    from collections.abc import Iterator

#: Terms that are one word, which are said as one or more words.
TERMS = {
    "charger": "[[tS'A@dZ3]]",
    "robot": "row bot",
    "Xylophor": "zai lo four",
    "turbine": "[[n'u:k li@]] thing",
    "ROS 2": "ross two",
    "Stop! Go": "halt",
}
TEXTS = [
    "The charger of the robot is at the door, near the turbine.",
    "Xylophor! Charger? (robot) “turbine”; robot's, robot-arm: the charger's cable.",
    "A [[h@'loU]] charger [1], Mr. Robot takes 1,000 chargers to the U.S.A. robot",
    "Type talk --robot and go-charger, robot_x robot-",
    "charger robot turbine Xylophor\n\n\tcharger, é turbine.",
]


@pytest.fixture(scope="module", params=["espeak", "tiny", pytest.param("joe", marks=pytest.mark.slow)])
def voice(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def engine(voice: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Engine]:
    """Return an engine that writes to a file. Its neural voices render a text the same each time."""
    if voice != "espeak":
        needs_packages(*NEURAL_PACKAGES)
    folder = tmp_path_factory.mktemp("voices")
    if voice == "joe":
        link_without_noise(real_voice(), folder)
    elif voice == "tiny":
        tiny_voice.put(folder, "tiny")
    environment = {"TALK_VOICES": str(folder), "XDG_CACHE_HOME": str(folder)}
    with Engine(f"file:{folder / 'out.wav'}", environment=environment) as engine:
        yield engine


def speak(
    engine: Engine, voice: str, *pieces: str, goal: str, terms: dict[str, str] | None = None, start: int = 0
) -> tuple[list[tuple[int, int]], float]:
    """Speak a text that arrives in pieces. Return the places of its words, and the length of the sound."""
    id_ = {"espeak": None, "tiny": "piper/tiny", "joe": REAL_VOICE}[voice]
    first = protocol.Speak(goal, pieces[0], FAST, 1.0, id_, 50, voice_only=bool(id_), pronunciations=terms, start=start)
    engine.send(replace(first, more=len(pieces) > 1))
    for piece in pieces[1:]:
        engine.send(protocol.Append(goal, piece, end=piece is pieces[-1]))
    ended = engine.until(protocol.Ended)
    assert ended.id == goal
    assert ended.duration is not None, ended
    return [(word.start, word.end) for word in engine.words(goal)], ended.duration


@pytest.mark.parametrize("text", TEXTS)
def test_words_have_the_same_places_with_and_without_replaced_terms(engine: Engine, voice: str, text: str) -> None:
    plain, _ = speak(engine, voice, text, goal=f"plain {text}")
    assert len(plain) > 3
    for goal, pieces in (("whole", [text]), ("grown", [*text, ""])):
        assert speak(engine, voice, *pieces, goal=f"{goal} {text}", terms=TERMS)[0] == plain, goal


#: Texts with terms, and texts that have the same phonemes.
ALIKE = {
    "go to Xylophor Q7 now": ("go to zai lo four queue seven now", {"Xylophor Q7": "zai lo four queue seven"}),
    "Go to (x), now": ("Go to (charger), now", {"x": "[[tS'A@dZ3]]"}),
    "[[h@'loU]] x": ("((h@'loU)) charger", {"x": "[[tS'A@dZ3]]"}),
}


@pytest.mark.parametrize("text", ALIKE)
def test_a_text_sounds_like_its_replacement(engine: Engine, voice: str, text: str) -> None:
    other, terms = ALIKE[text]
    _, length = speak(engine, voice, text, goal=f"replaced {text}", terms=terms)
    _, expected = speak(engine, voice, other, goal=f"expected {text}")
    assert length == pytest.approx(expected, abs=0.03 if voice == "espeak" else 0.001)
    _, before = speak(engine, voice, text, goal=f"before {text}")
    assert abs(before - expected) > 0.05


def test_a_term_is_one_word_even_if_it_contains_the_end_of_a_sentence(engine: Engine) -> None:
    engine.send(protocol.Speak("parts", "Stop! Go now. RO", FAST, 1.0, None, 50, more=True, pronunciations=TERMS))
    engine.until(protocol.Word)  # the first sentence is spoken before the rest arrives
    engine.send(protocol.Append("parts", "S 2.", end=True))
    assert engine.until(protocol.Ended).outcome == protocol.OUTCOME_COMPLETED
    assert [(word.start, word.end) for word in engine.words("parts")] == [(0, 4), (9, 12), (14, 17)]


def test_the_rest_of_an_interrupted_text_has_the_same_words(engine: Engine, voice: str) -> None:
    text = "The charger of (Xylophor) is ROS 2, robot's turbine."
    words, _ = speak(engine, voice, text, goal="uninterrupted", terms=TERMS)
    for number, (start, _) in enumerate(words):
        rest = speak(engine, voice, text, goal=f"rest {number}", terms=TERMS, start=start)[0]
        assert rest == words[number:]
