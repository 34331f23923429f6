"""Tests for neural voices in the engine process: speech, stops, pauses, loading, and reported faults.

Tests that don't change the process share one. It writes to a file, which is faster than real time.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import resource
import shutil
import signal
import time
import wave
from array import array
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from talkcli import install
from talkcli.engine import protocol
from talkcli.install import NEURAL_PACKAGES
from tests.engine.process import FAST, SOON, Engine, SharedEngine, before_call
from tests.support import tiny_voice
from tests.support.espeak import RATE
from tests.support.real_voice import REAL_VOICE
from tests.support.surroundings import needs_packages
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from typing import Any

    from tests.support.sink import Sink

TEXT = "battery low, please come home"
VOICE = "piper/tiny"
#: Code for the start of the process that makes loading slow, as on a slow machine.
SLOW_TO_LOAD = before_call("synthesizers.inference:Model._set_halves", "time.sleep(0.4)")
#: Code that makes all samples of a sentence late, except the first piece.
SLOW_TO_SPEAK = before_call("synthesizers.inference:Model.decode", "time.sleep(0.8 if arguments[2] else 0)")
#: Code that hides packages.
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


@pytest.fixture(scope="module")
def voices(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a directory with a tiny voice, which hums and is loaded in some milliseconds."""
    needs_packages(*NEURAL_PACKAGES)
    path = tmp_path_factory.mktemp("neural") / "voices"
    tiny_voice.put(path, "tiny")
    return path


@pytest.fixture
def folder(voices: Path) -> Iterator[Path]:
    """Return the directory of the tiny voice. Voices that the test adds to it are removed after the test."""
    yield voices
    for path in voices.iterdir():
        if not path.name.startswith("tiny."):
            path.unlink()


@pytest.fixture(scope="module")
def shared(voices: Path) -> Iterator[SharedEngine]:
    with contextlib.closing(SharedEngine(lambda: _engine(voices, f"file:{voices.parent / 'out.wav'}"))) as shared:
        yield shared


def _engine(folder: Path, player: str = "null", sink: Mapping[str, str] | None = None, **more: Any) -> Engine:
    folders = {"TALK_VOICES": str(folder), "XDG_CACHE_HOME": str(folder.parent / "cache")}
    return Engine(player, environment={**folders, **(sink or {})}, **more)


def _failure_message(ended: protocol.Ended, reason: str = "voice_failed") -> str:
    assert (ended.outcome, ended.reason) == (protocol.OUTCOME_FAILED, reason), ended
    return ended.message or ""


def _loaded(engine: Engine) -> list[protocol.VoiceLoaded]:
    return [event for event in engine.events if isinstance(event, protocol.VoiceLoaded)]


def _chosen_voices(engine: Engine, goal: str) -> list[tuple[str, str | None]]:
    """Return the voices chosen for a goal, with the reasons for a fallback."""
    return [
        (event.voice, event.fallback_reason)
        for event in engine.events
        if isinstance(event, protocol.VoiceChosen) and event.id == goal
    ]


def _words(engine: Engine, text: str, goal: str = "g1") -> list[str]:
    """Return the reported words of a text."""
    return [text[word.start : word.end] for word in engine.words(goal)]


def test_neural_voices_and_espeak_take_turns_and_report_all_words(engine: Engine) -> None:
    for number, voice in enumerate([None, VOICE, "en-us", VOICE[:8], None]):
        ended = engine.spoken(TEXT, f"g{number}", voice=voice)
        assert ended.outcome == protocol.OUTCOME_COMPLETED, ended
        assert _words(engine, TEXT, f"g{number}") == ["battery", "low", "please", "come", "home"]


@pytest.mark.parametrize("rate", [8000, 48000])
def test_a_file_gets_the_sample_rate_of_the_voice(folder: Path, tmp_path: Path, rate: int) -> None:
    tiny_voice.put(folder, "other", config=tiny_voice.description(rate=rate))
    target = tmp_path / "out.wav"
    with _engine(folder, f"file:{target}") as engine:
        ended = engine.spoken(TEXT, voice="piper/other")
    assert ended.outcome == protocol.OUTCOME_COMPLETED
    with wave.open(str(target)) as file:
        assert file.getframerate() == rate
        assert file.getnframes() / rate == pytest.approx(ended.duration, abs=0.01)


def test_a_speaker_is_given_after_the_name_of_the_voice(folder: Path, engine: Engine) -> None:
    tiny_voice.put(folder, "many", tiny_voice.model(speakers=3), tiny_voice.description(speakers=3))
    for number, voice in enumerate(["piper/many", "piper/many#2", "piper/many#p1"]):
        assert engine.spoken("a", f"g{number}", voice=voice).outcome == protocol.OUTCOME_COMPLETED
    message = _failure_message(engine.spoken("a", "g8", voice="piper/many#3"), "unknown_voice")
    assert 'no speaker "3"; the voice has 3 speakers, 0 to 2' in message
    message = _failure_message(engine.spoken("a", "g9", voice=f"{VOICE}#1"), "unknown_voice")
    assert 'no speaker "1"; the voice has one speaker' in message


def test_a_voice_installed_while_the_engine_runs_is_found(folder: Path, engine: Engine) -> None:
    message = _failure_message(engine.spoken("a", "g1", voice="piper/late"), "unknown_voice")
    assert 'unknown voice "piper/late"' in message
    tiny_voice.put(folder, "late")
    assert engine.spoken("a", "g2", voice="piper/late").outcome == protocol.OUTCOME_COMPLETED


def test_the_name_of_a_voice_cannot_be_a_path(folder: Path, engine: Engine) -> None:
    tiny_voice.put(folder, ".tiny")
    tiny_voice.put(folder, "another")  # so that the empty name is ambiguous
    for name in ("../voices/tiny", "/tiny", ".tiny", "tiny/../tiny", ""):
        _failure_message(engine.spoken("a", name, voice=f"piper/{name}"), "unknown_voice")


def test_the_json_of_a_voice_is_read_whenever_the_voice_is_loaded(folder: Path, engine: Engine) -> None:
    tiny_voice.put(folder, "changes")
    assert engine.spoken("a", "g1", voice="piper/changes").outcome == protocol.OUTCOME_COMPLETED
    (folder / "changes.onnx.json").write_text(json.dumps({"audio": {}}))
    assert engine.spoken("a", "g2", voice="piper/changes").outcome == protocol.OUTCOME_COMPLETED
    engine.send(protocol.DropVoice("piper/changes"))
    assert "does not describe a Piper voice" in _failure_message(engine.spoken("a", "g3", voice="piper/changes"))


def test_unknown_phonemes_are_left_out_and_a_text_without_others_fails(folder: Path, engine: Engine) -> None:
    """Many silent sentences in a row check that the inference thread gets the next piece after each of them."""
    description = tiny_voice.description()
    description["phoneme_id_map"] = {"_": [0], "^": [1], "$": [2], "a": [3], "\u00e6": [4]}
    tiny_voice.put(folder, "few", config=description)
    text = "Cat! " + "See! " * 12 + "Cat!"
    assert engine.spoken(text, "g1", voice="piper/few").outcome == protocol.OUTCOME_COMPLETED
    # The voice lacks the first phoneme of "cat" and all of "see". All words of a partly heard sentence are reported.
    assert _words(engine, text) == ["Cat", "Cat"]
    assert engine.spoken("See a cat see.", "g3", voice="piper/few").outcome == protocol.OUTCOME_COMPLETED
    times = [word.time for word in engine.words("g3")]
    assert len(times) == 4
    assert times == sorted(times)
    message = _failure_message(engine.spoken("See! " * 12, "g2", voice="piper/few"))
    assert "few.onnx.json has no id for a phoneme of the text (" in message
    engine.send(protocol.Speak("g4", text, FAST, 1.0, "piper/few", 50, voice_only=True, more=True))
    engine.until(protocol.TextMissing)
    engine.send(protocol.Append("g4", "", end=True))
    assert engine.until(protocol.Ended).outcome == protocol.OUTCOME_COMPLETED
    assert _words(engine, text, "g4") == ["Cat", "Cat"]


# -- without the extra


@pytest.mark.parametrize("package", NEURAL_PACKAGES)
def test_the_error_without_the_extra_contains_the_install_command(tmp_path: Path, package: str) -> None:
    tiny_voice.put(tmp_path / "voices", "tiny")
    before = WITHOUT.format(names=[package])
    with _engine(tmp_path / "voices", before=before) as engine:
        message = _failure_message(engine.spoken(TEXT, voice=VOICE), "unknown_voice")
        assert f"{VOICE} cannot be loaded" in message
        assert install.neural_command() in message
        assert engine.spoken("yes", "g2").outcome == protocol.OUTCOME_COMPLETED
    with _engine(tmp_path / "voices", before=before, voice=VOICE) as engine:
        failed = engine.until(protocol.StartFailed)
        assert failed.usage_error
        assert install.neural_command() in failed.message


# -- faults


#: Faults in a voice's files: the model, the entries of its JSON, and a part of the error message. `test_inference.py`
#: tests models that can't be loaded.
WRONG: dict[str, tuple[bytes, dict[str, Any], str]] = {
    "no json": (tiny_voice.model(), {}, "wrong.onnx.json does not exist; download it from the source of the model"),
    "truncated": (tiny_voice.model()[:-300], {}, "is truncated, or not an ONNX model; download the voice again"),
    "silent": (tiny_voice.model(amplitude=0.0), {}, "produced only silence; download the voice again"),
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


def _create_wrong_voice(folder: Path, wrong: str) -> str:
    """Create the faulty files, and return a part of the error message."""
    model, entries, message = WRONG[wrong]
    path = tiny_voice.put(folder, "wrong", model, tiny_voice.description(**entries))
    if wrong == "no json":
        (folder / "wrong.onnx.json").unlink()
    elif wrong == "writable":
        path.chmod(0o666)
    return message


@pytest.mark.parametrize("wrong", WRONG)
def test_faulty_voice_files_fail_a_goal_with_a_readable_message(folder: Path, engine: Engine, wrong: str) -> None:
    engine.send(protocol.DropVoice("piper/wrong"))
    expected = _create_wrong_voice(folder, wrong)
    message = _failure_message(engine.spoken(TEXT, "g1", voice="piper/wrong"))
    assert expected in message
    assert str(folder / "wrong.onnx") in message
    assert engine.spoken(TEXT, "g2").outcome == protocol.OUTCOME_COMPLETED
    assert expected in _failure_message(engine.spoken(TEXT, "g3", voice="piper/wrong"))
    tiny_voice.put(folder, "wrong")
    assert engine.spoken(TEXT, "g4", voice="piper/wrong").outcome == protocol.OUTCOME_COMPLETED


@pytest.mark.parametrize(("wrong", "fallback"), [("silent", "gmw/en-US"), ("unknown language", "gmw/en")])
def test_espeak_speaks_if_a_neural_voice_fails_at_once(folder: Path, engine: Engine, wrong: str, fallback: str) -> None:
    engine.send(protocol.DropVoice("piper/wrong"))
    _create_wrong_voice(folder, wrong)
    engine.send(protocol.LoadVoice("piper/wrong"))
    assert engine.until(protocol.VoiceLoaded).error is None
    for goal in ("g1", "g2"):
        assert engine.spoken(TEXT, goal, voice="piper/wrong", voice_only=False).outcome == protocol.OUTCOME_COMPLETED
        (first, no_reason), (second, reason) = _chosen_voices(engine, goal)
        assert (first, no_reason, second) == ("piper/wrong", None, fallback)
        assert reason is not None
        assert str(folder / "wrong.onnx") in reason
        assert _words(engine, TEXT, goal) == TEXT.replace(",", "").split()


def test_a_growing_text_keeps_the_voice_with_which_it_began(folder: Path, engine: Engine) -> None:
    tiny_voice.put(folder, "slow", config=tiny_voice.description(rate=16000))
    engine.send(protocol.Speak("g1", "One. ", FAST, 1.0, "piper/slow", 50, more=True))
    assert [engine.until(protocol.TextMissing).missing for _ in range(2)] == [True, False]
    engine.send(protocol.LoadVoice("piper/slow"))
    assert engine.until(protocol.VoiceLoaded).error is None
    engine.send(protocol.Append("g1", "Two.", end=True))
    assert engine.until(protocol.Ended).outcome == protocol.OUTCOME_COMPLETED
    assert _chosen_voices(engine, "g1") == [("gmw/en-US", "piper/slow is not loaded")]


def test_speech_continues_if_there_is_no_memory_for_a_model(real_voice_env: dict[str, str], tmp_path: Path) -> None:
    """Espeak can speak at once, and the voice as soon as there is memory again. The cached halves are kept."""
    target = f"file:{tmp_path / 'out.wav'}"
    with Engine(target, environment=real_voice_env) as engine:
        assert engine.spoken("a", "g0", voice=REAL_VOICE).outcome == protocol.OUTCOME_COMPLETED
        cached = _cached_halves(real_voice_env)
    with Engine(target, environment=real_voice_env) as engine:
        with _little_memory(engine, 280 << 20):
            message = _failure_message(engine.spoken(TEXT, "g1", voice=REAL_VOICE))
            assert "there is not enough memory; end another program" in message
            assert "en_US-joe-medium.onnx" in message
            assert engine.spoken("yes", "g2").outcome == protocol.OUTCOME_COMPLETED
        assert engine.spoken("a", "g3", voice=REAL_VOICE).outcome == protocol.OUTCOME_COMPLETED
    assert cached == _cached_halves(real_voice_env)


def _cached_halves(real_voice_env: dict[str, str]) -> list[tuple[str, int]]:
    return sorted((path.name, path.stat().st_ino) for path in Path(real_voice_env["XDG_CACHE_HOME"], "talk").iterdir())


@contextlib.contextmanager
def _little_memory(engine: Engine, limit: int) -> Iterator[None]:
    """Limit the address space of the process to this number of bytes."""
    before = resource.prlimit(engine.process.pid, resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))
    try:
        yield
    finally:
        resource.prlimit(engine.process.pid, resource.RLIMIT_AS, before)


# -- stop and pause


@limits()
def test_a_sentence_can_be_paused_and_stopped_while_its_voice_loads(folder: Path) -> None:
    with _engine(folder, before=SLOW_TO_LOAD, alive_every=SOON) as engine:
        engine.say("yes", voice=VOICE)
        engine.until(protocol.Alive)
        assert_within(engine.pause(), protocol.STOP_LIMIT_S, "a pause while the voice is loaded")
        while not isinstance(event := engine.event(), protocol.VoiceLoaded):
            assert isinstance(event, protocol.Alive | protocol.VoiceMemory)
        assert isinstance(engine.event(), protocol.Alive)
        engine.resume()
        assert engine.until(protocol.Ended).outcome == protocol.OUTCOME_COMPLETED
        engine.send(protocol.DropVoice(VOICE))
        engine.say(TEXT, "g2", voice=VOICE)
        engine.until(protocol.Alive)
        assert_within(engine.stop("g2"), protocol.STOP_LIMIT_S, "a stop while the voice is loaded")
        assert engine.spoken("espeak", "g3").outcome == protocol.OUTCOME_COMPLETED
        assert engine.spoken("yes", "g4", voice=VOICE).outcome == protocol.OUTCOME_COMPLETED


@limits()
def test_a_sentence_can_be_paused_and_stopped_during_phonemization(folder: Path) -> None:
    """libespeak-ng needs 0.1 s without interruption for a clause of 800 bytes in a script that the voice can't read."""
    text = "Go. Dr. Who. " + "电池电量低正在返回充电站" * 800
    methods = ("clauses", "word_positions", "ends_with_abbreviation")
    report = "arguments[0] in seen or seen.append(arguments[0]) or print({!r}, len(seen), file=sys.stderr, flush=True)"
    before = (before_call(f"synthesizers.espeak:EspeakPhonemizer.{name}", report.format(name)) for name in methods)
    with _engine(folder, before="\n".join(before)) as engine:
        for method in methods:
            goal = f"g {method}"
            engine.say(text, goal, voice=VOICE)
            while not engine.errors_line().startswith(method):
                pass
            if method == "clauses":
                assert_within(engine.pause(goal), 0.1, "a pause during phonemization")
            assert_within(engine.stop(goal), 0.05, "a stop during phonemization")
            engine.errors_so_far()
        assert engine.spoken("espeak", "g20").outcome == protocol.OUTCOME_COMPLETED


@limits()
def test_a_real_voice_can_be_paused_and_stopped_and_exits_cleanly(real_voice_env: dict[str, str]) -> None:
    """If a thread still ran an inference at the exit, the process would abort, and the log would report a crash."""
    with Engine(environment=real_voice_env) as engine:
        assert engine.spoken("a", "g0", voice=REAL_VOICE).outcome == protocol.OUTCOME_COMPLETED
        engine.say("word " * 500, "g1", voice=REAL_VOICE)
        engine.until(protocol.Word)
        assert_within(engine.pause("g1"), 0.2, "a pause")
        engine.resume("g1")
        engine.until(protocol.Word)
        assert_within(engine.stop("g1"), protocol.STOP_LIMIT_S, "a stop")
        engine.say("word " * 500, "g2", voice=REAL_VOICE)
        engine.until(protocol.Word)  # seconds of samples are still being computed, ahead of the playback
        engine.hang_up()
        assert engine.process.wait(20) == 0, engine.errors()


# -- machines that are too slow


@pytest.mark.parametrize("player", ["pulse", "aplay"])
def test_gaps_are_counted_and_words_are_reported_when_heard(
    folder: Path, sink: Sink, tmp_path: Path, player: str
) -> None:
    """A machine that is too slow leaves nothing out, and reports the words in order, however late.

    A slow start of aplay is no gap.
    """
    text = "one two three"
    slow_aplay = tmp_path / "aplay"
    slow_aplay.write_text(f'#!/bin/sh\nsleep 0.2\nexec {shutil.which("aplay")} "$@"\n')
    slow_aplay.chmod(0o755)
    environment = {**sink.env, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    with limits():
        with sink.record() as recording, _engine(folder, player, environment, before=SLOW_TO_SPEAK) as engine:
            engine.say(text, voice=VOICE)
            reported = []
            while not isinstance(event := engine.event(), protocol.Ended):
                if isinstance(event, protocol.Word):
                    reported.append((time.monotonic(), event.time))
            assert event.outcome == protocol.OUTCOME_COMPLETED
            recording.wait_until_quiet(0.3)
            # The voice hums without a pause, so any silence is a gap.
            loud = [index for index, sample in enumerate(recording.samples) if abs(int(sample)) > 1000]
            assert _words(engine, text) == text.split()
        pairs = itertools.pairwise(loud)
        silent = [(after - before) / RATE for before, after in pairs if after - before > 0.05 * RATE]
        assert silent
        if event.gaps == len(silent):
            assert event.gap_seconds == pytest.approx(sum(silent), abs=0.1 * len(silent))
        else:  # on a busy machine, aplay may begin so late that it has nothing to wait for
            assert_within(abs(event.gap_seconds - sum(silent)), 0, "the difference between counted and heard gaps")
    assert event.gap_seconds > 0.3
    assert event.duration is not None
    assert event.duration - 0.26 == pytest.approx(len(loud) / RATE, abs=0.05), "without the silence at the end"
    for reported_at, position in reported:
        # The monitor drops some samples at a gap, so a word near a gap may be on either side of it.
        near = (int((position + offset) * RATE) for offset in (-0.03, 0, 0.03))
        heard = [recording.time_of(loud[min(len(loud) - 1, max(0, index))]) for index in near]
        assert heard[0] - 0.1 < reported_at < heard[-1] + 0.1


def test_a_process_that_is_stopped_for_a_while_speaks_with_a_gap(folder: Path, sink: Sink) -> None:
    with _engine(folder, "pulse", sink.env) as engine:
        started_at = time.monotonic()
        engine.say(TEXT, voice=VOICE)
        first = engine.until_word()
        engine.process.send_signal(signal.SIGSTOP)
        time.sleep(0.5)  # during this time, the player gets no samples
        engine.process.send_signal(signal.SIGCONT)
        ended = engine.until(protocol.Ended)
        assert (ended.outcome, ended.gaps > 0) == (protocol.OUTCOME_COMPLETED, True)
        assert ended.duration is not None
        assert 0.2 < ended.gap_seconds < time.monotonic() - started_at - ended.duration + first.time
        assert _words(engine, TEXT) == TEXT.replace(",", "").split()


def test_the_word_times_of_a_real_voice_match_its_sound(real_voice_env: dict[str, str], tmp_path: Path) -> None:
    text = "Battery low. Please come home. I am stuck."
    target = tmp_path / "out.wav"
    with Engine(f"file:{target}", environment=real_voice_env) as engine:
        assert engine.spoken(text, rate=200, voice=REAL_VOICE).outcome == protocol.OUTCOME_COMPLETED
        starts = [word.time for word in engine.words() if text[word.start - 2 : word.start] in {"", ". "}]
    with wave.open(str(target)) as file:
        rate, samples = file.getframerate(), array("h", file.readframes(file.getnframes()))
    loud = [at / rate for at in range(0, len(samples) - 200, 200) if max(map(abs, samples[at : at + 200])) > 1000]
    onsets = [loud[0], *(after for before, after in itertools.pairwise(loud) if after - before > 0.25)]
    assert len(onsets) == len(starts) == 3
    assert starts == pytest.approx(onsets, abs=0.12)
    quiet = next(count for count, sample in enumerate(reversed(samples)) if abs(sample) > 330)
    assert quiet / rate == pytest.approx(0.26, abs=0.01), "the silence at the end"


# -- loading during speech


def test_voices_are_loaded_one_at_a_time_during_speech_and_reported_once(folder: Path) -> None:
    path = "synthesizers.inference:Model._set_halves"
    slow = before_call(path, "seen and sys.exit('two at once') or seen.append(1) or time.sleep(0.1) or seen.clear()")
    tiny_voice.put(folder, "second")
    with _engine(folder, before=slow) as engine:
        for voice in ("piper/second", VOICE, "piper/second", "piper/nobody", VOICE):
            engine.send(protocol.LoadVoice(voice))
        assert engine.spoken(TEXT, voice="en", rate=300).outcome == protocol.OUTCOME_COMPLETED
        loaded = [engine.until(protocol.VoiceLoaded) for _ in range(3 - len(_loaded(engine)))]
        assert len(loaded) < 3, "no voice was loaded during the speech"
    assert [(event.voice, event.error) for event in _loaded(engine)] == [
        ("piper/second", None),
        (VOICE, None),
        ("piper/nobody", "piper/nobody: its file no longer exists"),
    ]


def test_espeak_speaks_the_language_of_a_voice_that_is_not_loaded(folder: Path, tmp_path: Path) -> None:
    tiny_voice.put(folder, "deutsch", config=tiny_voice.description(voice="de"))
    tiny_voice.put(folder, "second")
    _create_wrong_voice(folder, "silent")
    with _engine(folder, f"file:{tmp_path / 'out.wav'}") as engine:
        for voice, fallback in [(VOICE, "gmw/en-US"), ("piper/deutsch", "gmw/de"), ("piper/wrong", "gmw/en-US")]:
            assert engine.spoken(TEXT, voice, voice=voice, voice_only=False).outcome == protocol.OUTCOME_COMPLETED
            assert _chosen_voices(engine, voice) == [(fallback, f"{voice} is not loaded")]
            assert len(engine.words(voice)) > 3
        assert _loaded(engine) == [], "a voice was loaded without an order of the server"
        for voice in (VOICE, "piper/second"):
            engine.send(protocol.LoadVoice(voice))
            assert engine.until(protocol.VoiceLoaded).error is None
            goal = f"{voice} loaded"
            assert engine.spoken("a", goal, voice=voice, voice_only=False).outcome == protocol.OUTCOME_COMPLETED
            assert _chosen_voices(engine, goal) == [(voice, None)]
        engine.send(protocol.DropVoice(VOICE))
        for goal, voice, expected in [
            ("dropped", VOICE, ("gmw/en-US", f"{VOICE} is not loaded")),
            ("kept", "piper/second", ("piper/second", None)),
        ]:
            assert engine.spoken("a", goal, voice=voice, voice_only=False).outcome == protocol.OUTCOME_COMPLETED
            assert _chosen_voices(engine, goal) == [expected]


def test_the_memory_of_voices_is_reported_and_freed_when_one_is_dropped(folder: Path) -> None:
    heavy = """
from talkcli.engine.child.synthesizers import inference
init, kept = inference.Model.__init__, []
def heavier(self, *rest):
    init(self, *rest)
    self.ballast = []
    for _ in range(700):
        self.ballast.append(b"x" * 60_000)
        kept.append(bytearray(1000))  # in between, so that the C library doesn't return the memory by itself
inference.Model.__init__ = heavier
"""
    tiny_voice.put(folder, "second")
    with _engine(folder, before=heavy) as engine:
        for voice in (VOICE, "piper/second"):
            engine.send(protocol.LoadVoice(voice))
            assert engine.until(protocol.VoiceMemory).voice == voice
            assert engine.until(protocol.VoiceLoaded).error is None
        assert engine.spoken("yes").outcome == protocol.OUTCOME_COMPLETED  # by then, the loading thread has ended
        engine.send(protocol.DropVoice("piper/second"))
        assert engine.until(protocol.VoiceMemory).voice == ""
        sizes = [event.memory for event in engine.events if isinstance(event, protocol.VoiceMemory)]
    assert sizes[0] > 42e6
    assert sizes[1] - sizes[0] > 40e6
    assert sizes[1] - sizes[2] > 35e6  # the complete pages of each piece


def test_a_load_that_hangs_is_abandoned_and_the_next_voice_is_loaded(folder: Path) -> None:
    hangs = before_call("synthesizers.inference:Model.__init__", '"other" in arguments[1] and threading.Event().wait()')
    hangs = f"from talkcli.engine import protocol\nprotocol.LOAD_LIMIT_S = 0.6\n{hangs}"
    tiny_voice.put(folder, "other")
    with _engine(folder, before=hangs) as engine:
        engine.send(protocol.LoadVoice("piper/other"))
        engine.send(protocol.LoadVoice(VOICE))
        hung, loaded = engine.until(protocol.VoiceLoaded), engine.until(protocol.VoiceLoaded)
        assert hung.error == "piper/other was not loaded within 0.6 s; use a faster disk"
        assert (loaded.voice, loaded.error) == (VOICE, None)
        engine.leave()
        assert engine.process.wait(5) == 0, "the hanging load delayed the exit"
