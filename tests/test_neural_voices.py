"""Neural voices with a server. If a neural voice can't be used, espeak speaks instead."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import time
from typing import TYPE_CHECKING

import pytest

from talkcli import install
from talkcli.client.client import Client
from talkcli.install import NEURAL_PACKAGES
from tests.conformance.bareserve import LIMIT, SERVE, TALK, Ended, environment, serving
from tests.conformance.bareserve import run as run_program
from tests.engine.test_neural import WITHOUT
from tests.support import tiny_voice
from tests.support.processes import children
from tests.support.surroundings import needs, needs_packages

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path
    from typing import Any

    from talkcli.client.goal import GoalHandle
    from tests.conformance.bareserve import BareServe

TINY, BROKEN = "piper/tiny", "piper/broken"
#: The espeak voice that replaces these voices, whose language is en-us.
INSTEAD = "gmw/en-US"
#: Runs first in each Python process: models load only after the file HOLD is removed, and may take more memory. The
#: server may wait less for its engine.
SITE = """
import importlib.abc, importlib.util, os, sys, time
class Delay(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name != "talkcli.engine.child.synthesizers.inference":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(name)
        execute = spec.loader.exec_module
        def executed(module):
            execute(module)
            init = module.Model.__init__
            def delayed(model, path, *rest):
                while os.path.exists(os.environ["HOLD"]):
                    time.sleep(0.01)
                init(model, path, *rest)
                model.ballast = b"x" * int(os.environ.get("BALLAST_BYTES", 0))
            module.Model.__init__ = delayed
        spec.loader.exec_module = executed
        return spec
sys.meta_path.insert(0, Delay())
if "HANG_LIMIT_S" in os.environ:
    from talkcli.engine import protocol
    protocol.HANG_LIMIT_S = float(os.environ["HANG_LIMIT_S"])
"""


@pytest.fixture
def env(home: str, tmp_path: Path) -> dict[str, str]:
    """Return the environment of a server with a working and a broken voice."""
    needs_packages(*NEURAL_PACKAGES)
    tiny_voice.put(tmp_path / "voices", "tiny")
    tiny_voice.put(tmp_path / "voices", "broken", b"no model")
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(SITE)
    return environment(
        home,
        TALK_SOCKET=f"{home}/s",
        TALK_VOICES=str(tmp_path / "voices"),
        PYTHONPATH=str(tmp_path / "site"),
        HOLD=str(tmp_path / "hold"),
    )


@pytest.fixture
def hold(tmp_path: Path) -> Path:
    """Create the file that delays the loading of models until it is removed."""
    (tmp_path / "hold").touch()
    return tmp_path / "hold"


def run(command: Sequence[str], env: dict[str, str]) -> Ended:
    """Run a server or a client. A client doesn't need the code in `SITE`, so it can be forked."""
    return run_program(
        command, {name: value for name, value in env.items() if name != "PYTHONPATH" or "serve" in command}
    )


def _to_file(env: dict[str, str]) -> tuple[str, ...]:
    """Return options for a server that speaks to a file, which is faster than real time."""
    return ("--rate", "450", "--player", f"file:{env['HOME']}/said.wav")


class Robot:
    """A server with neural voices, and its client."""

    def __init__(self, server: BareServe, env: dict[str, str]) -> None:
        self.server = server
        self.env = env
        self.client = Client(env["TALK_SOCKET"])

    def say(self, text: str = "a", voice: str | None = TINY, **options: Any) -> GoalHandle:
        return self.client.say(text, voice=voice, **options)

    def heard(self, goal: GoalHandle) -> tuple[str, str | None]:
        """Return the final state of a goal, and the voice that spoke it."""
        ended = goal.wait(LIMIT)
        return ended.state.name, ended.voice

    def state(self, goal: GoalHandle) -> str:
        return self.client.goal(goal.id).state.name

    def neural(self, voice: str = TINY) -> dict[str, Any]:
        """Return the server's description of a neural voice."""
        voices = self.client.status().server["neural_voices"]
        assert isinstance(voices, dict)
        return dict(voices.get(voice, {"state": None}))

    def until(self, condition: Callable[[], object]) -> None:
        limit = time.monotonic() + LIMIT
        while not condition():
            assert time.monotonic() < limit, f"the condition never became true: {self.server.log}"
            time.sleep(0.02)

    def signal_engine(self, number: signal.Signals) -> None:
        for engine in children(self.server.process.pid):
            os.kill(engine, number)


@contextlib.contextmanager
def _robot(env: dict[str, str], *options: str) -> Iterator[Robot]:
    with serving(env, *_to_file(env), *options) as server:
        robot = Robot(server, env)
        with robot.client:
            yield robot


# -- voices that are being loaded


def test_a_goal_and_those_behind_it_wait_for_its_voice(env: dict[str, str], hold: Path) -> None:
    with _robot(env) as robot:
        first, second = robot.say(), robot.say("behind", None)
        robot.until(lambda: robot.neural() == {"state": "loading", "why": None})
        assert [robot.state(goal) for goal in (first, second)] == ["PENDING", "PENDING"]
        assert "voice    piper/tiny loading" in run([*TALK, "status"], env).out
        hold.unlink()
        assert robot.heard(first) == ("SUCCEEDED", TINY)
        assert robot.heard(second) == ("SUCCEEDED", "gmw/en")
        assert robot.neural() == {"state": "loaded", "why": None}
    assert "voice piper/tiny loaded in " in robot.server.log


# -- voices that can't be loaded


def test_espeak_replaces_a_broken_voice_until_it_is_repaired(env: dict[str, str], tmp_path: Path) -> None:
    why = f"{tmp_path}/voices/broken.onnx is not an ONNX model; download the voice again, from a source that you trust"
    with _robot(env, "--voice", BROKEN) as robot:
        assert robot.heard(robot.say("a", None)) == ("SUCCEEDED", INSTEAD)
        assert robot.neural(BROKEN) == {"state": "failed", "why": why}
        assert f"{BROKEN} failed: " in run([*TALK, "status"], env).out
        assert (
            f"voice {BROKEN} can't be loaded, so espeak is used instead (except with --voice-only): {why}"
            in robot.server.log
        )
        done = run([*TALK, "--json", "say", "--wait", "--voice-only", "a"], env)
        goal = json.loads(done.out)
        assert (done.code, goal["reason"], goal["message"]) == (4, "voice_failed", f"speech failed: {why}")
        assert robot.heard(robot.say()) == ("SUCCEEDED", TINY)
        tiny_voice.put(tmp_path / "voices", "broken")
        assert run([*TALK, "set", "--voice", BROKEN], env).code == 0
        assert robot.heard(robot.say("a", None)) == ("SUCCEEDED", BROKEN)


def test_two_voices_that_exceed_the_memory_limit_speak_in_turn(env: dict[str, str], tmp_path: Path) -> None:
    tiny_voice.put(tmp_path / "voices", "second")
    with _robot(env, "--voice-memory", "0") as robot:
        names = (TINY, "piper/second", TINY)
        goals = [robot.say(voice=name) for name in names]
        assert [robot.heard(goal) for goal in goals] == [("SUCCEEDED", name) for name in names]
        assert "unloaded voice piper/tiny to make room" in robot.server.log


def test_a_voice_larger_than_the_memory_limit_speaks_and_is_reported(env: dict[str, str]) -> None:
    env["BALLAST_BYTES"] = "100000000"
    with _robot(env, "--voice-memory", "50") as robot:
        assert robot.heard(robot.say()) == ("SUCCEEDED", TINY)
        assert re.search(rf"voice {TINY}: it uses 1\d\d MB, more than --voice-memory 50 allows\n", robot.server.log)
        assert re.search(rf"{TINY} loaded: it uses 1\d\d MB, more than", run([*TALK, "status"], env).out)


def test_a_pitch_is_refused_with_a_voice_of_fixed_pitch(env: dict[str, str]) -> None:
    with _robot(env, "--voice", TINY, "--pitch", "60") as robot:
        refused = robot.say(pitch=70).goal
        assert (refused.reason, refused.state.name) == ("bad_option", "REJECTED")
        assert "has a fixed pitch" in str(refused.message)
        for options in ({}, {"pitch": 70}, {"voice_only": True}):  # the server's pitch only affects other voices
            assert robot.heard(robot.say("a", None, **options)) == ("SUCCEEDED", TINY)


# -- engines that crash, hang or can't start


def test_a_voice_that_crashes_the_engine_twice_is_not_used(env: dict[str, str], hold: Path) -> None:
    why = "the engine process died while loading the voice"
    with _robot(env, "--voice", TINY) as robot:
        for crashes in (1, 2):
            robot.until(lambda: robot.neural()["state"] == "loading")
            robot.signal_engine(signal.SIGKILL)
            robot.until(lambda: robot.server.log.count("the engine crashed") == crashes)  # noqa: B023
        robot.until(lambda: robot.neural()["state"] == "failed")
        assert robot.neural()["why"] == why
        ended = robot.say("a", None, voice_only=True).wait(LIMIT)
        assert (ended.reason, ended.message) == ("voice_failed", f"speech failed: {why}")
        assert f"voice piper/tiny is not used: {why}" in robot.server.log
        assert robot.server.log.count("the engine crashed") == 2
        assert robot.heard(robot.say("a", None)) == ("SUCCEEDED", INSTEAD)
        hold.unlink()
        assert run([*TALK, "set", "--voice", TINY], env).code == 0
        assert robot.heard(robot.say("a", None)) == ("SUCCEEDED", TINY)


def test_espeak_speaks_if_the_files_of_a_voice_are_missing(env: dict[str, str], tmp_path: Path) -> None:
    with _robot(env, "--voice", TINY) as robot:
        robot.until(lambda: robot.neural()["state"] == "loaded")
        (tmp_path / "voices" / "tiny.onnx").unlink()
        robot.signal_engine(signal.SIGKILL)
        robot.until(lambda: robot.neural()["state"] == "failed")
        goal = robot.say("a", None)
        state, voice = robot.heard(goal)
        assert state == "SUCCEEDED"
        assert f'{goal.id} is spoken with the voice {voice} instead: unknown voice "piper/tiny"' in robot.server.log


def test_an_engine_that_hangs_while_loading_is_replaced(env: dict[str, str], hold: Path) -> None:
    env["HANG_LIMIT_S"] = "0.5"
    with _robot(env) as robot:
        goal = robot.say(voice_only=True)
        robot.until(lambda: robot.neural()["state"] == "loading")
        robot.signal_engine(signal.SIGSTOP)
        robot.until(lambda: "did not respond for 0.5 s while loading piper/tiny" in robot.server.log)
        hold.unlink()
        assert robot.heard(goal) == ("SUCCEEDED", TINY)


# -- lists, files, refused voices


def test_a_voice_installed_later_can_be_listed_and_used(env: dict[str, str], tmp_path: Path) -> None:
    with serving(env, *_to_file(env)):
        listed = run([*TALK, "voices"], env).out
        assert "piper/tiny" in listed
        for command, code in ((["say", "--voice", "piper/late", "a"], 5), (["set", "--voice", "piper/late"], 2)):
            done = run([*TALK, *command], env)
            assert done.code == code
            assert 'unknown voice "piper/late"' in done.err
        tiny_voice.put(tmp_path / "voices", "late")
        assert run([*TALK, "say", "--wait", "--voice-only", "--voice", "Late", "a"], env).code == 0
        assert run([*TALK, "set", "--voice", "late"], env).code == 0
        assert json.loads(run([*TALK, "--json", "set"], env).out)["voice"] == "piper/late"
        assert run([*TALK, "say", "--wait", "a"], env).code == 0
        listed = run([*TALK, "voices"], env).out
        assert listed.index("+f3") < listed.index("piper/late")
        (tmp_path / "voices" / "late.onnx").unlink()
        assert "piper/late" not in run([*TALK, "voices"], env).out


def test_a_file_is_rendered_with_a_neural_voice(env: dict[str, str], tmp_path: Path) -> None:
    target = tmp_path / "x.wav"
    assert run([*TALK, "say", "-o", str(target), "--voice", "Tiny", "a"], env).code == 0
    assert target.stat().st_size > 10_000
    done = run([*TALK, "say", "-o", str(target), "--voice", "piper/broken", "a"], env)
    assert done.code == 4
    assert "download the voice again" in done.err


def test_voices_are_listed_with_quality_and_speakers(env: dict[str, str], tmp_path: Path) -> None:
    several = tiny_voice.description(speakers=2, language="de_DE")
    tiny_voice.put(tmp_path / "voices", "two", tiny_voice.model(speakers=2), several)
    with serving(env):
        lines = [line.split(maxsplit=2) for line in run([*TALK, "voices"], env).out.splitlines()]
        assert [line for line in lines if line[0] in {"piper/broken", "piper/tiny", "piper/two"}] == [
            ["piper/broken", "en-us", "tiny, low"],
            ["piper/tiny", "en-us", "tiny, low"],
            ["piper/two", "de-de", "tiny, low, 2 speakers"],
        ]
        voices = [json.loads(line) for line in run([*TALK, "--json", "voices"], env).out.splitlines()]
        assert {*map(tuple, voices)} == {("id", "language", "name", "quality", "speakers")}
        more = {voice["id"]: (voice["quality"], voice["speakers"]) for voice in voices}
        assert (more["piper/tiny"], more["piper/two"]) == (("low", None), ("low", ["p0", "p1"]))
        assert more["gmw/en-US"] == (None, None)
        listed = run([*TALK, "voices", "--language", "en"], env).out.split()
        assert listed.index("gmw/en-US") < listed.index("piper/tiny")
        assert "piper/two" not in listed
        # The name of a voice doesn't count as a language.
        done = run([*TALK, "voices", "--language", "tiny,"], env)
        assert (done.code, "'de'" in done.err, "'en'" in done.err) == (1, False, False), done


def test_text_from_a_voices_files_is_always_escaped(env: dict[str, str], tmp_path: Path) -> None:
    evil = "\x1b]0;owned\x07\n\u202e"
    config = tiny_voice.description(voice=evil, language=evil, speakers=2, dataset=evil * 100, speaker_id_map={evil: 0})
    config["audio"] = {"sample_rate": 22050, "quality": evil}
    tiny_voice.put(tmp_path / "voices", "evil", tiny_voice.model(speakers=2), config)
    tiny_voice.put(tmp_path / "voices", "type", config=tiny_voice.description(phoneme_type=evil))
    with serving(env) as server:
        shown = [
            run([*TALK, "voices"], env),
            run([*TALK, "voices", "--language", "evil"], env),
            run([*TALK, "say", "--wait", "--voice", "piper/evil", "--voice-only", "a"], env),
            run([*TALK, "say", "--wait", "--voice", "piper/type", "--voice-only", "a"], env),
            run([*TALK, "say", "--wait", "--voice", f"piper/{evil}", "a"], env),
            run([*TALK, "status"], env),
            run([*TALK, "log"], env),
        ]
    assert any("piper/evil" in done.out for done in shown)
    assert [done.code for done in shown[2:5]] == [4, 4, 5]
    for text in (server.log, *(done.out + done.err for done in shown)):
        assert not {"\x1b", "\x07", "\u202e"} & {*text}, text
        assert max(map(len, text.splitlines()), default=0) < 1000


def test_a_neural_voice_is_refused_with_another_driver(env: dict[str, str]) -> None:
    message = '"piper/tiny" is a neural voice, which the driver "dummy" does not support; leave out --driver'
    done = run([*TALK, "serve", "--driver", "dummy", "--voice", "piper/tiny"], env)
    assert (done.code, message in done.err) == (2, True), done
    with serving(env, "--driver", "dummy"):
        done = run([*TALK, "say", "--voice", "piper/tiny", "a"], env)
        assert (done.code, message in done.err) == (5, True), done
        done = run([*TALK, "set", "--voice", "piper/tiny"], env)
        assert (done.code, message in done.err) == (2, True), done


def test_without_the_extra_neural_voices_are_listed_but_refused(env: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "site" / "sitecustomize.py").write_text(WITHOUT.format(names=["onnxruntime"]))
    bare = {**env, "PYTHONPATH": str(tmp_path / "site")}
    message = f"onnxruntime is missing; install it with: {install.neural_command()}"
    done = run([*TALK, "serve", "--player", "null", "--voice", "piper/tiny"], bare)
    assert (done.code, message in done.err) == (2, True), done
    with serving(bare):
        assert "piper/tiny" in run([*TALK, "voices"], env).out
        done = run([*TALK, "--json", "say", "--voice", "piper/tiny", "a"], env)
        goal = json.loads(done.out)
        assert (done.code, goal["state"], goal["reason"]) == (5, "REJECTED", "unknown_voice")
        assert message in goal["message"]
        done = run([*TALK, "set", "--voice", "piper/tiny"], env)
        assert (done.code, message in done.err) == (2, True), done
        assert run([*TALK, "say", "--wait", "a"], env).code == 0


def test_a_drivers_voice_precedes_a_neural_voice_of_the_same_name(env: dict[str, str], tmp_path: Path) -> None:
    tiny_voice.put(tmp_path / "voices", "en")
    with _robot(env, "--voice", "en") as robot:
        assert robot.heard(robot.say("a", None)) == ("SUCCEEDED", "gmw/en")
        robot.client.set(voice="tiny")
        goals = [robot.say(voice=voice, voice_only=True) for voice in ("en-us", "EN", "gmw/en-US")]
        used = [robot.heard(goal)[1] for goal in goals]
        assert used == [TINY, TINY, "gmw/en-US"], "the language of a neural voice selects that voice"


#: System calls that change a file or use the internet, successful or not.
_SIDE_EFFECTS = re.compile(
    r"AF_INET|O_WRONLY|O_RDWR|O_CREAT|\b(mkdir|mknod|rename|unlink|link|symlink|chmod|chown|truncate)\w*\("
)


@pytest.mark.parametrize("seconds", [0, pytest.param(10, marks=pytest.mark.slow)])
def test_a_neural_voice_contacts_no_host_and_changes_no_file(env: dict[str, str], tmp_path: Path, seconds: int) -> None:
    """Even if the user enables onnxruntime's telemetry, which looks up its host 9 seconds after the import."""
    needs("strace")
    trace = tmp_path / "trace"
    traced = ["strace", "-f", "-y", "-s", "4096", "-e", "trace=%network,%file", "-o", str(trace), *SERVE]
    env |= {"ORT_DISABLE_TELEMETRY": "0", "PYTHONDONTWRITEBYTECODE": "1"}
    with serving(env, command=traced) as server:
        (talk,) = children(server.process.pid)
        try:
            done = run([*TALK, "say", "--wait", "--voice", "piper/tiny", "--voice-only", "a"], env)
            assert done.code == 0, done
            time.sleep(seconds)
        finally:
            os.kill(talk, signal.SIGTERM)  # strace doesn't forward signals
            server.process.wait(LIMIT)
    lines = trace.read_text(errors="replace").splitlines()
    assert any("onnxruntime" in line for line in lines)
    home = env["HOME"]
    own = (f'"{home}"', f'"{home}/s', f'"{home}/.cache"', f'"{home}/.cache/talk', '"/dev/null"')
    assert [line for line in lines if _SIDE_EFFECTS.search(line) and not any(place in line for place in own)] == []
