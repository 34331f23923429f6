"""Neural voices through a server: they are listed, spoken with, and found if they are installed while it runs."""

from __future__ import annotations

import json
import os
import re
import signal
import time
from typing import TYPE_CHECKING

import pytest

from talkcli import install
from talkcli.engine.protocol import Voice
from talkcli.engine.synthesizers.models import NEEDED
from talkcli.engine.synthesizers.voices import find_voice
from tests.conformance.bareserve import LIMIT, SERVE, TALK, environment, run, serving
from tests.engine.test_neural import SLOW_TO_SPEAK, WITHOUT
from tests.support import tiny_voice
from tests.support.processes import children
from tests.support.surroundings import needs, needs_packages, short_directory
from tests.test_completion import offered

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@pytest.fixture
def env(tmp_path: Path) -> Iterator[dict[str, str]]:
    """Return the environment of a server with two voices."""
    needs_packages(*NEEDED)
    tiny_voice.put(tmp_path / "voices", "tiny")
    tiny_voice.put(tmp_path / "voices", "broken", b"no model")
    with short_directory() as home:
        yield environment(home, TALK_SOCKET=f"{home}/s", TALK_VOICES=str(tmp_path / "voices"))


def test_gaps_on_a_slow_machine_are_told(env: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(SLOW_TO_SPEAK)
    with serving({**env, "PYTHONPATH": f"{tmp_path / 'site'}:{env.get('PYTHONPATH', '')}"}):
        done = run([*TALK, "--json", "say", "--wait", "--voice", "piper/tiny", "--voice-only", "one two three"], env)
        assert run([*TALK, "say", "--wait", "hello"], env).code == 0
        espeak = json.loads(run([*TALK, "--json", "log", "-n", "1"], env).out)
    assert (espeak["text"], espeak["message"]) == ("hello", "Talk completed successfully")
    goal = json.loads(done.out)
    assert (goal["state"], goal["voice"]) == ("SUCCEEDED", "piper/tiny")
    assert re.fullmatch(
        r"Talk completed successfully, but with \d gaps? of \d\.\d s in all: this machine is too slow for the voice",
        goal["message"],
    )


def test_a_voice_that_is_installed_later_is_listed_and_spoken_with(env: dict[str, str], tmp_path: Path) -> None:
    with serving(env, "--rate", "450"):
        listed = run([*TALK, "voices"], env).out
        assert "piper/tiny" in listed
        for command, code in ((["say", "--voice", "piper/late", "hello"], 5), (["set", "--voice", "piper/late"], 2)):
            done = run([*TALK, *command], env)
            assert done.code == code
            assert 'unknown voice "piper/late"' in done.err
        tiny_voice.put(tmp_path / "voices", "late")
        assert run([*TALK, "say", "--wait", "--voice-only", "--voice", "Late", "hello"], env).code == 0
        assert run([*TALK, "set", "--voice", "late"], env).code == 0
        assert json.loads(run([*TALK, "--json", "set"], env).out)["voice"] == "piper/late"
        assert run([*TALK, "say", "--wait", "hello"], env).code == 0
        listed = run([*TALK, "voices"], env).out
        assert listed.index("+f3") < listed.index("piper/late")
        (tmp_path / "voices" / "late.onnx").unlink()
        assert "piper/late" not in run([*TALK, "voices"], env).out


def test_a_file_is_rendered_with_a_neural_voice(env: dict[str, str], tmp_path: Path) -> None:
    target = tmp_path / "x.wav"
    assert run([*TALK, "say", "-o", str(target), "--voice", "Tiny", "hello"], env).code == 0
    assert target.stat().st_size > 10_000
    done = run([*TALK, "say", "-o", str(target), "--voice", "piper/broken", "hello"], env)
    assert done.code == 4
    assert "get the voice anew" in done.err


def test_voices_are_listed_with_quality_and_speakers_and_by_language(env: dict[str, str], tmp_path: Path) -> None:
    several = tiny_voice.description(speakers=2, language="de_DE")
    tiny_voice.put(tmp_path / "voices", "two", tiny_voice.model(speakers=2), several)
    with serving(env):
        lines = [each.split(maxsplit=2) for each in run([*TALK, "voices"], env).out.splitlines()]
        assert [each for each in lines if each[0] in {"piper/broken", "piper/tiny", "piper/two"}] == [
            ["piper/broken", "en-us", "tiny, low"],
            ["piper/tiny", "en-us", "tiny, low"],
            ["piper/two", "de-de", "tiny, low, 2 speakers"],
        ]
        found = [json.loads(each) for each in run([*TALK, "--json", "voices"], env).out.splitlines()]
        assert {*map(tuple, found)} == {("id", "language", "name", "quality", "speakers")}
        more = {each["id"]: (each["quality"], each["speakers"]) for each in found}
        assert (more["piper/tiny"], more["piper/two"]) == (("low", None), ("low", ["p0", "p1"]))
        assert more["gmw/en-US"] == (None, None)
        listed = run([*TALK, "voices", "--language", "en"], env).out.split()
        assert listed.index("gmw/en-US") < listed.index("piper/tiny")
        assert "piper/two" not in listed
        # A voice's own name is no language's.
        done = run([*TALK, "voices", "--language", "tiny,"], env)
        assert (done.code, "'de'" in done.err, "'en'" in done.err) == (1, False, False), done


def test_the_text_of_a_voice_s_file_never_reaches_the_terminal_raw(env: dict[str, str], tmp_path: Path) -> None:
    evil = "\x1b]0;owned\x07\n\u202e"
    told = tiny_voice.description(voice=evil, language=evil, speakers=2, dataset=evil * 100, speaker_id_map={evil: 0})
    told["audio"] = {"sample_rate": 22050, "quality": evil}
    tiny_voice.put(tmp_path / "voices", "evil", tiny_voice.model(speakers=2), told)
    tiny_voice.put(tmp_path / "voices", "type", beside=tiny_voice.description(phoneme_type=evil))
    with serving(env) as server:
        shown = [
            run([*TALK, "voices"], env),
            run([*TALK, "voices", "--language", "evil"], env),
            run([*TALK, "say", "--wait", "--voice", "piper/evil", "--voice-only", "hello"], env),
            run([*TALK, "say", "--wait", "--voice", "piper/type", "--voice-only", "hello"], env),
            run([*TALK, "say", "--wait", "--voice", f"piper/{evil}", "hello"], env),
            run([*TALK, "status"], env),
            run([*TALK, "log"], env),
        ]
    assert any("piper/evil" in each.out for each in shown)
    assert [each.code for each in shown[2:5]] == [4, 4, 5]
    for text in (server.log, *(each.out + each.err for each in shown)):
        assert not {"\x1b", "\x07", "\u202e"} & {*text}, text
        assert max(map(len, text.splitlines()), default=0) < 1000


def test_the_voices_that_completion_offers_are_found(env: dict[str, str]) -> None:
    with serving(env):
        told = [json.loads(each) for each in run([*TALK, "--json", "voices"], env).out.splitlines()]
        found = {
            each: [value for value, _ in offered(f"talk say --voice {each}", env)] for each in ("", "pi", "ti", "E")
        }
    voices = tuple(Voice(**each) for each in told)
    for typed, values in found.items():
        for each in values:
            assert find_voice(each, voices) is not None, (typed, each)
    assert {"piper/tiny", "piper/broken", "en-us"} <= {*found[""]}
    assert {"piper/broken", "piper/tiny"} <= {*found["pi"]}
    assert found["ti"] == []


def test_with_another_driver_a_neural_voice_is_refused(env: dict[str, str]) -> None:
    words = '"piper/tiny" is a neural voice, and the driver "dummy" has none: leave --driver out'
    done = run([*TALK, "serve", "--driver", "dummy", "--voice", "piper/tiny"], env)
    assert (done.code, words in done.err) == (2, True), done
    with serving(env, "--driver", "dummy"):
        done = run([*TALK, "say", "--voice", "piper/tiny", "hello"], env)
        assert (done.code, words in done.err) == (5, True), done
        done = run([*TALK, "set", "--voice", "piper/tiny"], env)
        assert (done.code, words in done.err) == (2, True), done


def test_without_the_extra_they_are_listed_and_refused_with_what_to_install(
    env: dict[str, str], tmp_path: Path
) -> None:
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(WITHOUT.format(names=["onnxruntime"]))
    bare = {**env, "PYTHONPATH": f"{tmp_path / 'site'}:{env.get('PYTHONPATH', '')}"}
    words = f"onnxruntime is missing: {install.neural()}"
    done = run([*TALK, "serve", "--player", "null", "--voice", "piper/tiny"], bare)
    assert (done.code, words in done.err) == (2, True), done
    with serving(bare):
        assert "piper/tiny" in run([*TALK, "voices"], env).out
        done = run([*TALK, "--json", "say", "--voice", "piper/tiny", "hello"], env)
        goal = json.loads(done.out)
        assert (done.code, goal["state"], goal["reason"]) == (5, "REJECTED", "unknown_voice")
        assert words in goal["message"]
        done = run([*TALK, "set", "--voice", "piper/tiny"], env)
        assert (done.code, words in done.err) == (2, True), done
        assert run([*TALK, "say", "--wait", "hello"], env).code == 0


def heard(env: dict[str, str], *options: str) -> object:
    """Return the voice by which a sentence was heard."""
    return json.loads(run([*TALK, "--json", "say", "--wait", *options, "hello"], env).out)["voice"]


def test_the_server_s_voice_is_neural_only_if_the_driver_has_no_such_voice(env: dict[str, str], tmp_path: Path) -> None:
    tiny_voice.put(tmp_path / "voices", "en")
    with serving(env, "--rate", "450", "--voice", "en"):
        assert heard(env) == "gmw/en"


def test_the_language_of_the_server_s_neural_voice_means_that_voice(env: dict[str, str]) -> None:
    with serving(env, "--rate", "450", "--voice", "tiny"):
        found = [heard(env, "--voice-only", "--voice", each) for each in ("en-us", "EN", "de", "gmw/en-US")]
        assert found == ["piper/tiny", "piper/tiny", "gmw/de", "gmw/en-US"]
        done = run([*TALK, "say", "--voice", "en-us", "--pitch", "70", "hello"], env)
        assert (done.code, "has no pitch but its own" in done.err) == (5, True), done
        assert run([*TALK, "set", "--voice", "gmw/de"], env).code == 0
        assert heard(env, "--voice-only", "--voice", "en-us") == "gmw/en-US"


def test_an_unknown_voice_or_speaker_is_refused(env: dict[str, str], tmp_path: Path) -> None:
    several = tiny_voice.description(speakers=2)
    tiny_voice.put(tmp_path / "voices", "two", tiny_voice.model(speakers=2), several)
    with serving(env, "--rate", "450"):
        for voice, words in (
            ("piper/tiny#1", 'it has no speaker "1": it has one speaker'),
            ("piper/two#2", 'it has no speaker "2": it has 2 speakers, 0 to 1'),
            ("piper/two#nobody", 'it has no speaker "nobody"'),
        ):
            done = run([*TALK, "say", "--voice", voice, "hello"], env)
            assert (done.code, words in done.err) == (5, True), done
        for voice in ("piper/tiny#0", "piper/two#1", "piper/two#p1"):
            assert heard(env, "--voice-only", "--voice", voice) == voice
    for voice, words in (("piper/tiny#4", "it has one speaker"), ("piper/none", 'unknown voice "piper/none"')):
        done = run([*TALK, "serve", "--player", "null", "--voice", voice], env)
        assert (done.code, words in done.err) == (2, True), done


#: System calls that change a file or use the internet, even if they failed.
_REPORTS = re.compile(
    r"AF_INET|O_WRONLY|O_RDWR|O_CREAT|\b(mkdir|mknod|rename|unlink|link|symlink|chmod|chown|truncate)\w*\("
)


@pytest.mark.parametrize("seconds", [0, pytest.param(30, marks=pytest.mark.slow)])
def test_a_neural_sentence_makes_no_connection_and_writes_no_file(
    env: dict[str, str], tmp_path: Path, seconds: int
) -> None:
    """Even if the user has turned on onnxruntime's telemetry, which asks for its host 9 seconds after the import."""
    needs("strace")
    trace = tmp_path / "trace"
    traced = ["strace", "-f", "-y", "-s", "4096", "-e", "trace=%network,%file", "-o", str(trace), *SERVE]
    env |= {"ORT_DISABLE_TELEMETRY": "0", "PYTHONDONTWRITEBYTECODE": "1"}
    with serving(env, command=traced) as server:
        (talk,) = children(server.process.pid)
        try:
            done = run([*TALK, "say", "--wait", "--voice", "piper/tiny", "--voice-only", "hello"], env)
            assert done.code == 0, done
            time.sleep(seconds)
        finally:
            os.kill(talk, signal.SIGTERM)  # strace itself passes no signal on
            server.process.wait(LIMIT)
    lines = trace.read_text(errors="replace").splitlines()
    assert any("onnxruntime" in each for each in lines)
    home = env["HOME"]
    own = (f'"{home}"', f'"{home}/s', f'"{home}/.cache"', f'"{home}/.cache/talk', '"/dev/null"')
    assert [each for each in lines if _REPORTS.search(each) and not any(place in each for place in own)] == []
