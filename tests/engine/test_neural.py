"""A neural voice in the engine process: it speaks, is stopped and held at any time, and tells its faults.

Tests that leave the process as it is share one, which writes to a file and so takes no time.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import resource
import signal
import threading
import time
import wave
from array import array
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from talkcli import install
from talkcli.engine import protocol
from talkcli.install import NEURAL_PACKAGES
from tests.engine.programs import Player, without_silence
from tests.engine.spawned import SOON, Shared, Spawned, first
from tests.support import tiny_voice
from tests.support.espeak import RATE
from tests.support.processes import children
from tests.support.real_voice import REAL_VOICE, real_voice
from tests.support.surroundings import needs_packages
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from typing import Any

    from tests.support.sink import Sink

TEXT = "battery low, please come home"
VOICE = "piper/tiny"
#: Code that runs in the process first and makes loading slow, as on a slow machine.
SLOW_TO_LOAD = first("synthesizers.inference:Model._set_halves", "time.sleep(0.8)")
#: … that makes all but the first sound of a sentence too late.
SLOW_TO_SPEAK = first("synthesizers.inference:Model.decode", "time.sleep(0.8 if arguments[2] else 0)")
#: … that hides packages.
WITHOUT = """
import sys, importlib.abc
class Without(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {names}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
import importlib.util
find_spec = importlib.util.find_spec
importlib.util.find_spec = lambda name, *rest: None if name in {names} else find_spec(name, *rest)
sys.meta_path.insert(0, Without())
"""
#: Modules that an engine process without a neural voice has no use for.
NEURAL_MODULES = [
    *NEURAL_PACKAGES,
    *("difflib", "hashlib", "queue"),
    *(f"talkcli.engine.child.synthesizers.{each}" for each in ("inference", "loader", "phonemes", "piper", "vits")),
]


@pytest.fixture(scope="module")
def voices(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a directory with a voice that hums, in some milliseconds."""
    needs_packages(*NEURAL_PACKAGES)
    path = tmp_path_factory.mktemp("neural") / "voices"
    tiny_voice.put(path, "tiny")
    return path


@pytest.fixture
def place(voices: Path) -> Iterator[Path]:
    """That directory. The voices that a test puts there are removed after it."""
    yield voices
    for each in voices.iterdir():
        if not each.name.startswith("tiny."):
            each.unlink()


@pytest.fixture(scope="module")
def shared(voices: Path) -> Iterator[Shared]:
    with contextlib.closing(Shared(lambda: _engine(voices, f"file:{voices.parent / 'out.wav'}"))) as shared:
        yield shared


def _engine(place: Path, player: str = "null", sink: Mapping[str, str] | None = None, **more: Any) -> Spawned:
    places = {"TALK_VOICES": str(place), "XDG_CACHE_HOME": str(place.parent / "cache")}
    return Spawned(player, environment={**places, **(sink or {})}, **more)


def _failed(ended: protocol.Ended, reason: str = "voice_failed") -> str:
    assert (ended.outcome, ended.reason) == (protocol.OUTCOME_FAILED, reason), ended
    return ended.message or ""


def _loaded(engine: Spawned) -> list[protocol.VoiceLoaded]:
    return [each for each in engine.events if isinstance(each, protocol.VoiceLoaded)]


def _speaks(engine: Spawned, goal: str) -> list[tuple[str, str | None]]:
    return [
        (each.voice, each.fallback_reason)
        for each in engine.events
        if isinstance(each, protocol.VoiceChosen) and each.id == goal
    ]


def test_a_neural_voice_speaks_with_its_words_and_espeak_before_and_after(engine: Spawned) -> None:
    for number, voice in enumerate([None, VOICE, "en-us", VOICE[:8], None]):
        ended = engine.spoken(TEXT, f"g{number}", voice=voice)
        assert ended.outcome == protocol.OUTCOME_COMPLETED, ended
        words = [TEXT[each.start : each.end] for each in engine.words(f"g{number}")]
        assert words == ["battery", "low", "please", "come", "home"]


@pytest.mark.parametrize("rate", [8000, 48000])
def test_any_rate_of_samples_goes_into_a_file(place: Path, tmp_path: Path, rate: int) -> None:
    tiny_voice.put(place, "other", config=tiny_voice.description(rate=rate))
    target = tmp_path / "out.wav"
    with _engine(place, f"file:{target}") as engine:
        ended = engine.spoken(TEXT, voice="piper/other")
    assert ended.outcome == protocol.OUTCOME_COMPLETED
    with wave.open(str(target)) as file:
        assert file.getframerate() == rate
        assert file.getnframes() / rate == pytest.approx(ended.duration, abs=0.01)


def test_a_speaker_is_named_behind_the_voice(place: Path, engine: Spawned) -> None:
    tiny_voice.put(place, "many", tiny_voice.model(speakers=3), tiny_voice.description(speakers=3))
    for number, voice in enumerate(["piper/many", "piper/many#2", "piper/many#p1"]):
        assert engine.spoken("a", f"g{number}", voice=voice).outcome == protocol.OUTCOME_COMPLETED
    message = _failed(engine.spoken("a", "g8", voice="piper/many#3"), "unknown_voice")
    assert 'no speaker "3"; the voice has 3 speakers, 0 to 2' in message
    message = _failed(engine.spoken("a", "g9", voice=f"{VOICE}#1"), "unknown_voice")
    assert 'no speaker "1"; the voice has one speaker' in message


def test_a_voice_that_is_put_there_while_it_runs_is_found(place: Path, engine: Spawned) -> None:
    message = _failed(engine.spoken("a", "g1", voice="piper/late"), "unknown_voice")
    assert 'unknown voice "piper/late"' in message
    tiny_voice.put(place, "late")
    assert engine.spoken("a", "g2", voice="piper/late").outcome == protocol.OUTCOME_COMPLETED


def test_a_name_is_no_path(place: Path, engine: Spawned) -> None:
    tiny_voice.put(place, ".tiny")
    tiny_voice.put(place, "another")  # so that no voice is the only one whose name begins with nothing
    for name in ("../voices/tiny", "/tiny", ".tiny", "tiny/../tiny", ""):
        _failed(engine.spoken("a", name, voice=f"piper/{name}"), "unknown_voice")


def test_the_json_of_a_voice_is_read_again_with_each_load(place: Path, engine: Spawned) -> None:
    """It is no secret kept by the process: a voice that is dropped is another when it is loaded again."""
    tiny_voice.put(place, "changes")
    assert engine.spoken("a", "g1", voice="piper/changes").outcome == protocol.OUTCOME_COMPLETED
    (place / "changes.onnx.json").write_text(json.dumps({"audio": {}}))
    assert engine.spoken("a", "g2", voice="piper/changes").outcome == protocol.OUTCOME_COMPLETED
    engine.send(protocol.DropVoice("piper/changes"))
    assert "does not describe a Piper voice" in _failed(engine.spoken("a", "g3", voice="piper/changes"))


def test_unknown_sounds_are_left_out_and_a_text_of_nothing_else_fails(place: Path, engine: Spawned) -> None:
    """Several in a row: the thread that makes sound is handed the next piece for each of them."""
    about = tiny_voice.description()
    about["phoneme_id_map"] = {"_": [0], "^": [1], "$": [2], "a": [3], "\u00e6": [4]}
    tiny_voice.put(place, "few", config=about)
    text = "Cat! " + "See! " * 12 + "Cat!"
    assert engine.spoken(text, "g1", voice="piper/few").outcome == protocol.OUTCOME_COMPLETED
    # It lacks the first sound of "cat", and all of "see". A sentence of which a part is heard tells all of its words.
    assert [text[each.start : each.end] for each in engine.words("g1")] == ["Cat", "Cat"]
    assert engine.spoken("See a cat see.", "g3", voice="piper/few").outcome == protocol.OUTCOME_COMPLETED
    told = [each.time for each in engine.words("g3")]
    assert len(told) == 4
    assert told == sorted(told)
    message = _failed(engine.spoken("See! " * 12, "g2", voice="piper/few"))
    assert "few.onnx.json has no id for a phoneme of the text (" in message


# -- without the extra


def test_an_engine_process_that_speaks_as_ever_loads_nothing_of_it(place: Path) -> None:
    report = f"""
import atexit, sys
atexit.register(lambda: sys.stderr.write(repr([each for each in {NEURAL_MODULES!r} if each in sys.modules])))
"""
    with _engine(place, before=report) as engine:
        assert VOICE in {each.id for each in engine.until(protocol.VoiceList).voices}
        assert engine.spoken("yes").outcome == protocol.OUTCOME_COMPLETED
        engine.leave()
        assert engine.errors() == "[]"


@pytest.mark.parametrize("package", NEURAL_PACKAGES)
def test_without_the_extra_a_voice_says_what_to_install(tmp_path: Path, package: str) -> None:
    tiny_voice.put(tmp_path / "voices", "tiny")
    before = WITHOUT.format(names=[package])
    with _engine(tmp_path / "voices", before=before) as engine:
        message = _failed(engine.spoken(TEXT, voice=VOICE), "unknown_voice")
        assert f"{VOICE} cannot be loaded" in message
        assert install.neural() in message
        assert engine.spoken("yes", "g2").outcome == protocol.OUTCOME_COMPLETED
    with _engine(tmp_path / "voices", before=before, voice=VOICE) as engine:
        failed = engine.until(protocol.StartFailed)
        assert failed.usage_error
        assert install.neural() in failed.message


# -- faults


#: Faults of a voice's files: the model, the entries of its JSON, and the words of the error. Models that are refused
#: when they are loaded are in `test_inference.py`.
WRONG: dict[str, tuple[bytes, dict[str, Any], str]] = {
    "no json": (tiny_voice.model(), {}, "wrong.onnx.json does not exist; download it from the source of the model"),
    "truncated": (tiny_voice.model()[:-300], {}, "is truncated, or not an ONNX model; download the voice again"),
    "silent": (tiny_voice.model(amplitude=0.0), {}, "made no sound from a text; download the voice again"),
    "unknown language": (
        tiny_voice.model(),
        {"voice": "tlh"},
        'no voice "tlh", which this voice needs for its phonemes; download the voice',
    ),
    "writable": (
        tiny_voice.model(),
        {},
        "wrong.onnx can be changed by other users, which is unsafe; fix it with: chmod go-w",
    ),
}


def _put_wrong(place: Path, wrong: str) -> str:
    """Put the files there and return the words of the error."""
    model, beside, words = WRONG[wrong]
    path = tiny_voice.put(place, "wrong", model, tiny_voice.description(**beside))
    if wrong == "no json":
        (place / "wrong.onnx.json").unlink()
    elif wrong == "writable":
        path.chmod(0o666)
    return words


@pytest.mark.parametrize("wrong", WRONG)
def test_a_fault_of_a_voices_files_ends_one_goal_in_words(place: Path, engine: Spawned, wrong: str) -> None:
    """And it is no reason to be silent for ever: the process lives, and a file that is mended is taken at once."""
    engine.send(protocol.DropVoice("piper/wrong"))
    words = _put_wrong(place, wrong)
    message = _failed(engine.spoken(TEXT, "g1", voice="piper/wrong"))
    assert words in message
    assert str(place / "wrong.onnx") in message
    assert engine.spoken(TEXT, "g2").outcome == protocol.OUTCOME_COMPLETED
    assert words in _failed(engine.spoken(TEXT, "g3", voice="piper/wrong"))
    tiny_voice.put(place, "wrong")
    assert engine.spoken(TEXT, "g4", voice="piper/wrong").outcome == protocol.OUTCOME_COMPLETED


@pytest.mark.parametrize(("wrong", "instead"), [("silent", "gmw/en-US"), ("unknown language", "gmw/en")])
def test_a_voice_that_fails_at_once_is_no_reason_for_silence(
    place: Path, engine: Spawned, wrong: str, instead: str
) -> None:
    """Nor is it given up for that: the next text may be another."""
    engine.send(protocol.DropVoice("piper/wrong"))
    _put_wrong(place, wrong)
    engine.send(protocol.LoadVoice("piper/wrong"))
    assert engine.until(protocol.VoiceLoaded).error is None
    for goal in ("g1", "g2"):
        assert engine.spoken(TEXT, goal, voice="piper/wrong", voice_only=False).outcome == protocol.OUTCOME_COMPLETED
        (first, why), (second, words) = _speaks(engine, goal)
        assert (first, why, second) == ("piper/wrong", None, instead)
        assert words is not None
        assert str(place / "wrong.onnx") in words
        assert [TEXT[each.start : each.end] for each in engine.words(goal)] == TEXT.replace(",", "").split()


def test_a_machine_without_memory_for_a_model_says_so_and_speaks_on(real: dict[str, str], tmp_path: Path) -> None:
    """With espeak at once, and with the voice when there is memory again. The cached halves stay."""
    target = f"file:{tmp_path / 'out.wav'}"
    with Spawned(target, environment=real) as engine:
        assert engine.spoken("a", "g0", voice=REAL_VOICE).outcome == protocol.OUTCOME_COMPLETED
        kept = _kept(real)
    with Spawned(target, environment=real) as engine:
        with _little_memory(engine, 280 << 20):
            message = _failed(engine.spoken(TEXT, "g1", voice=REAL_VOICE))
            assert "there is not enough memory; end another program" in message
            assert "en_US-joe-medium.onnx" in message
            assert engine.spoken("yes", "g2").outcome == protocol.OUTCOME_COMPLETED
        assert engine.spoken("a", "g3", voice=REAL_VOICE).outcome == protocol.OUTCOME_COMPLETED
    assert kept == _kept(real)


def _kept(real: dict[str, str]) -> list[tuple[str, int]]:
    return sorted((each.name, each.stat().st_ino) for each in Path(real["XDG_CACHE_HOME"], "talk").iterdir())


@contextlib.contextmanager
def _little_memory(engine: Spawned, most: int) -> Iterator[None]:
    """Let the process have no more than so many bytes of address space."""
    before = resource.prlimit(engine.process.pid, resource.RLIMIT_AS, (most, resource.RLIM_INFINITY))
    try:
        yield
    finally:
        resource.prlimit(engine.process.pid, resource.RLIMIT_AS, before)


@pytest.mark.slow
@pytest.mark.parametrize("megabytes", range(80, 480, 40))
def test_little_memory_ends_a_sentence_once_and_the_next_is_espeaks(tmp_path: Path, megabytes: int) -> None:
    """The process may die of it, in numpy's own libraries: they end it if they get none as they are loaded.

    Or an import fails in its midst, and says whatever is missing then.
    """
    real_voice()
    limit = f"import resource\nresource.setrlimit(resource.RLIMIT_AS, ({megabytes} << 20, -1))"
    with _engine(tmp_path / "voices", f"file:{tmp_path / 'out.wav'}", before=limit) as engine:
        engine.say("word " * 100, "g1", voice=REAL_VOICE)
        try:
            ended = engine.until(protocol.Ended)
        except AssertionError:
            engine.process.wait(20)
            return
        if ended.outcome == protocol.OUTCOME_COMPLETED:
            assert megabytes > 300, "so much it takes"
        else:
            message = _failed(ended)
            assert "there is not enough memory; end another program" in message or install.neural() in message
        assert engine.spoken(TEXT, "g2").outcome == protocol.OUTCOME_COMPLETED


# -- stop and pause


@limits()
def test_a_voice_is_held_and_stopped_while_it_is_loaded_and_then_speaks(place: Path) -> None:
    with _engine(place, before=SLOW_TO_LOAD, alive_every=SOON) as engine:
        engine.say(TEXT, voice=VOICE)
        engine.until(protocol.Alive)
        assert_within(engine.pause(), protocol.STOP_LIMIT_S, "a pause while the voice is loaded")
        held_until = time.monotonic() + 1.2  # past the loading
        while time.monotonic() < held_until:
            assert isinstance(engine.event(), protocol.Alive | protocol.VoiceMemory | protocol.VoiceLoaded)
        engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.OUTCOME_COMPLETED
        engine.send(protocol.DropVoice(VOICE))
        engine.say(TEXT, "g2", voice=VOICE)
        for _ in range(3):
            engine.until(protocol.Alive)
        assert_within(engine.stop("g2"), protocol.STOP_LIMIT_S, "a stop while the voice is loaded")
        assert engine.spoken("espeak", "g3").outcome == protocol.OUTCOME_COMPLETED
        assert engine.spoken(TEXT, "g4", voice=VOICE).outcome == protocol.OUTCOME_COMPLETED


@limits()
@pytest.mark.parametrize("asked", ["clauses", "word_positions", "ends_with_abbreviation"])
def test_a_voice_is_stopped_and_held_while_the_sounds_of_a_text_are_looked_up(place: Path, asked: str) -> None:
    """Libespeak-ng needs a tenth of a second at once for a clause of 800 bytes of a script that isn't the voice's."""
    text = "Go. Dr. Who. " + "电池电量低正在返回充电站" * 800
    tells = f"arguments[0] in seen or seen.append(arguments[0]) or print({asked!r}, file=sys.stderr, flush=True)"
    with _engine(place, before=first(f"synthesizers.espeak:EspeakPhonemizer.{asked}", tells)) as engine:
        assert engine.spoken("Go. Go", "g0", voice=VOICE).outcome == protocol.OUTCOME_COMPLETED
        assert engine.errors_line() == asked
        for number in range(1, 5):
            goal = f"g{number}"
            engine.say(text, goal, voice=VOICE)
            assert engine.errors_line() == asked
            if number % 2:
                assert_within(engine.pause(goal), 0.1, "a pause while sounds are looked up")
            assert_within(engine.stop(goal), 0.05, "a stop while sounds are looked up")
        assert engine.spoken("espeak", "g20").outcome == protocol.OUTCOME_COMPLETED


@limits()
def test_a_real_voice_is_held_and_stopped_in_mid_sentence_and_ends_well(
    real: dict[str, str],
) -> None:
    """A thread that is left in an inference would have the process abort, and the log tell of a crash."""
    with Spawned(environment=real) as engine:
        assert engine.spoken("a", "g0", voice=REAL_VOICE).outcome == protocol.OUTCOME_COMPLETED
        engine.say("word " * 500, "g1", voice=REAL_VOICE)
        engine.until(protocol.Word)
        assert_within(engine.pause("g1"), 0.2, "a pause")
        engine.resume("g1")
        engine.until(protocol.Word)
        assert_within(engine.stop("g1"), protocol.STOP_LIMIT_S, "a stop")
        engine.say("word " * 500, "g2", voice=REAL_VOICE)
        engine.until(protocol.Word)  # seconds of it are still to be made, ahead of what is heard
        engine.hang_up()
        assert engine.process.wait(20) == 0, engine.errors()


def test_a_program_that_plays_gets_each_sample_once_whether_it_is_held_or_not(place: Path, player: Player) -> None:
    """And silence while it is held."""
    text = "one two three four five six"
    with _engine(place, player.plays()) as engine:
        ended = engine.spoken(text, "g0", voice=VOICE)
        sentence = player.heard.read_bytes()
        assert ended.duration is not None
        assert len(sentence) == round(ended.duration * 22050) * 2
        player.heard.unlink()
        engine.say(text, "g1", voice=VOICE)
        engine.until_word(3)
        assert engine.pause() < 0.2
        assert children(engine.process.pid), "it plays silence"
        for _ in range(2):
            engine.until(protocol.Alive)
        engine.resume()
        ended = engine.until(protocol.Ended)
        assert ended.outcome == protocol.OUTCOME_COMPLETED
        assert ended.gap_seconds < protocol.ALIVE_INTERVAL_S, "it was held, and that is no gap"
        assert [each.number for each in engine.words()] == [*range(1, 7)]
        heard = player.heard.read_bytes()
        assert len(heard) > len(sentence)
        assert without_silence(heard, sentence) == sentence


# -- machines that are too slow


@pytest.mark.parametrize("player", ["pulse", "aplay"])
def test_the_gaps_that_are_heard_are_told_and_words_when_they_are_heard(place: Path, sink: Sink, player: str) -> None:
    """A machine that is too slow leaves nothing out, and tells words in the order of the text, however late."""
    text = "one two three four five six seven"
    with sink.record() as recording, _engine(place, player, sink.env, before=SLOW_TO_SPEAK) as engine:
        engine.say(text, voice=VOICE)
        told = []
        while not isinstance(event := engine.event(), protocol.Ended):
            if isinstance(event, protocol.Word):
                told.append((time.monotonic(), event.time))
        assert event.outcome == protocol.OUTCOME_COMPLETED
        recording.wait_until_quiet(0.3)
        # It hums all the time, so any silence is a gap.
        loud = [at for at, each in enumerate(recording.samples) if abs(int(each)) > 1000]
        assert [text[each.start : each.end] for each in engine.words()] == text.split()
    silent = [(here - before) / RATE for before, here in itertools.pairwise(loud) if here - before > 0.05 * RATE]
    assert event.gaps == len(silent) >= 1
    assert event.gap_seconds == pytest.approx(sum(silent), abs=0.1 * len(silent))
    assert event.gap_seconds > 0.5
    assert event.duration is not None
    assert event.duration - 0.26 == pytest.approx(len(loud) / RATE, abs=0.05), "less the pause at its end"
    for at, position in told:
        # A monitor drops some samples when a player runs dry: a word near a gap may be on either side of it.
        near = (int((position + each) * RATE) for each in (-0.03, 0, 0.03))
        heard = [recording.time_of(loud[min(len(loud) - 1, max(0, each))]) for each in near]
        assert heard[0] - 0.1 < at < heard[-1] + 0.1


@pytest.mark.parametrize("player", [pytest.param("null", marks=pytest.mark.slow), "pulse"])
def test_a_processor_at_a_fifth_of_its_time_speaks_on_with_gaps(real: dict[str, str], sink: Sink, player: str) -> None:
    """It stands still for a sixth of a second again and again, as under a limit of the kernel's, and its player too."""
    text = "Please step aside, the robot turns."
    with Spawned(player, environment={**real, **sink.env}) as engine:
        assert engine.spoken("a", "g0", voice=REAL_VOICE).gaps == 0
        with _slowed(engine, running=0.04, standing=0.16):
            began = time.monotonic()
            ended = engine.spoken(text, voice=REAL_VOICE, rate=200)
            took = time.monotonic() - began
        assert ended.outcome == protocol.OUTCOME_COMPLETED
        assert ended.duration is not None
        words = [text[each.start : each.end] for each in engine.words()]
        assert words == text.replace(",", "").rstrip(".").split()
        assert ended.gaps > 2
        first = next(each for each in engine.words()).time
        assert 0.5 < ended.gap_seconds < took - ended.duration + first
        assert engine.spoken("espeak", "g2").outcome == protocol.OUTCOME_COMPLETED


@contextlib.contextmanager
def _slowed(engine: Spawned, running: float, standing: float) -> Iterator[None]:
    """Have the process stand still and go on in turn, for so many seconds each."""
    over = threading.Event()

    def limit() -> None:
        while not over.wait(running):
            engine.process.send_signal(signal.SIGSTOP)
            over.wait(standing)
            engine.process.send_signal(signal.SIGCONT)

    limiting = threading.Thread(target=limit)
    limiting.start()
    try:
        yield
    finally:
        over.set()
        limiting.join()


def test_a_real_voice_says_a_sentence_with_its_words_in_time(real: dict[str, str], tmp_path: Path) -> None:
    """Each word begins where the sound comes up behind a pause of the sentence: at its stops."""
    text = "Battery low. Please come home. I am stuck."
    target = tmp_path / "out.wav"
    with Spawned(f"file:{target}", environment=real) as engine:
        assert engine.spoken(text, rate=200, voice=REAL_VOICE).outcome == protocol.OUTCOME_COMPLETED
        starts = [each.time for each in engine.words() if text[each.start - 2 : each.start] in {"", ". "}]
    with wave.open(str(target)) as file:
        rate, samples = file.getframerate(), array("h", file.readframes(file.getnframes()))
    loud = [at / rate for at in range(0, len(samples) - 200, 200) if max(map(abs, samples[at : at + 200])) > 1000]
    onsets = [loud[0], *(here for before, here in itertools.pairwise(loud) if here - before > 0.25)]
    assert len(onsets) == len(starts) == 3
    assert starts == pytest.approx(onsets, abs=0.12)
    quiet = next(number for number, each in enumerate(reversed(samples)) if abs(each) > 330)
    assert quiet / rate == pytest.approx(0.26, abs=0.01), "the pause at its end"


# -- loading beside the speech


def test_voices_are_loaded_one_at_a_time_beside_the_speech_and_told_once_each(place: Path) -> None:
    path = "synthesizers.inference:Model._set_halves"
    slow = first(path, "seen and sys.exit('two at once') or seen.append(1) or time.sleep(0.3) or seen.clear()")
    tiny_voice.put(place, "second")
    with _engine(place, before=slow) as engine:
        for voice in ("piper/second", VOICE, "piper/second", "piper/nobody", VOICE):
            engine.send(protocol.LoadVoice(voice))
        assert engine.spoken(TEXT, voice="en", rate=150).outcome == protocol.OUTCOME_COMPLETED
        loaded = [engine.until(protocol.VoiceLoaded) for _ in range(3 - len(_loaded(engine)))]
        assert len(loaded) < 3, "some came while it spoke"
    assert [each.voice for each in _loaded(engine)] == ["piper/second", VOICE, "piper/nobody"]
    assert [each.error for each in _loaded(engine)] == [None, None, "piper/nobody: its file no longer exists"]


def test_a_voice_that_is_not_loaded_or_was_dropped_is_spoken_by_espeak_in_its_language(place: Path) -> None:
    about = tiny_voice.description(voice="de")
    tiny_voice.put(place, "deutsch", config=about)
    tiny_voice.put(place, "second")
    _put_wrong(place, "silent")
    with _engine(place) as engine:
        for voice, speaker in [(VOICE, "gmw/en-US"), ("piper/deutsch", "gmw/de"), ("piper/wrong", "gmw/en-US")]:
            assert engine.spoken(TEXT, voice, voice=voice, voice_only=False).outcome == protocol.OUTCOME_COMPLETED
            assert _speaks(engine, voice) == [(speaker, f"{voice} is not loaded")]
            assert len(engine.words(voice)) > 3
        assert _loaded(engine) == [], "espeak in its place loads nothing: that is the server's to decide"
        for voice in (VOICE, "piper/second"):
            engine.send(protocol.LoadVoice(voice))
            assert engine.until(protocol.VoiceLoaded).error is None
            assert (
                engine.spoken("a", f"{voice} loaded", voice=voice, voice_only=False).outcome
                == protocol.OUTCOME_COMPLETED
            )
            assert _speaks(engine, f"{voice} loaded") == [(voice, None)]
        engine.send(protocol.DropVoice(VOICE))
        for goal, voice, told in [
            ("dropped", VOICE, ("gmw/en-US", f"{VOICE} is not loaded")),
            ("kept", "piper/second", ("piper/second", None)),
        ]:
            assert engine.spoken("a", goal, voice=voice, voice_only=False).outcome == protocol.OUTCOME_COMPLETED
            assert _speaks(engine, goal) == [told]


def test_growth_by_each_voice_is_told_and_memory_of_dropped_ones_is_given_back(place: Path) -> None:
    heavy = """
from talkcli.engine.child.synthesizers import inference
init, kept = inference.Model.__init__, []
def heavier(self, *rest):
    init(self, *rest)
    self.ballast = []
    for _ in range(700):
        self.ballast.append(b"x" * 60_000)
        kept.append(bytearray(1000))  # between them, so that the C library keeps what is free
inference.Model.__init__ = heavier
"""
    tiny_voice.put(place, "second")
    with _engine(place, before=heavy) as engine:
        for voice in (VOICE, "piper/second"):
            engine.send(protocol.LoadVoice(voice))
            assert engine.until(protocol.VoiceMemory).voice == voice
            assert engine.until(protocol.VoiceLoaded).error is None
        assert engine.spoken("yes").outcome == protocol.OUTCOME_COMPLETED  # the thread that loaded it has ended by then
        engine.send(protocol.DropVoice("piper/second"))
        assert engine.until(protocol.VoiceMemory).voice == ""
        sizes = [each.memory for each in engine.events if isinstance(each, protocol.VoiceMemory)]
    assert sizes[0] > 42e6
    assert sizes[1] - sizes[0] > 40e6
    assert sizes[1] - sizes[2] > 35e6, "of each piece its whole pages"


def test_a_load_that_hangs_is_given_up_and_the_next_voice_is_loaded(place: Path) -> None:
    hangs = first("synthesizers.inference:Model.__init__", '"other" in arguments[1] and threading.Event().wait()')
    hangs = f"from talkcli.engine import protocol\nprotocol.LOAD_LIMIT_S = 0.6\n{hangs}"
    tiny_voice.put(place, "other")
    with _engine(place, before=hangs) as engine:
        engine.send(protocol.LoadVoice("piper/other"))
        engine.send(protocol.LoadVoice(VOICE))
        hung, loaded = engine.until(protocol.VoiceLoaded), engine.until(protocol.VoiceLoaded)
        assert hung.error == "piper/other was not loaded within 0.6 s; use a faster disk"
        assert (loaded.voice, loaded.error) == (VOICE, None)
        engine.leave()
        assert engine.process.wait(5) == 0, "a load that hangs keeps no process"
