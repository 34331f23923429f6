"""Neural voices that a server loads or cannot load: goals wait, or espeak speaks; there is never silence."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import time
from typing import TYPE_CHECKING

import pytest

from talkcli.client.client import Client
from talkcli.engine.synthesizers.models import NEEDED
from tests.conformance.bareserve import TALK, environment, run, serving
from tests.support import tiny_voice
from tests.support.processes import children
from tests.support.surroundings import needs_packages, short_directory

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path
    from typing import Any

    from talkcli.client.goal import GoalHandle
    from tests.conformance.bareserve import BareServe

TINY, BROKEN = "piper/tiny", "piper/broken"
#: The voice of libespeak-ng that speaks in the place of these, whose language is en-us.
INSTEAD = "gmw/en-US"
#: Seconds in which anything must have happened.
LIMIT = 20.0
LONG = "this goes on and on " * 30
#: Runs first in each Python process: no model is loaded as long as a file is there, and each may take more memory.
SITE = """
import importlib.abc, importlib.util, os, sys, time
class Held(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name != "talkcli.engine.synthesizers.inference":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(name)
        execute = spec.loader.exec_module
        def executed(module):
            execute(module)
            init = module.Model.__init__
            def held(model, path, *rest):
                while os.path.exists(os.environ["HOLD"]):
                    time.sleep(0.01)
                init(model, path, *rest)
                model.ballast = b"x" * int(os.environ.get("BALLAST_BYTES", 0))
            module.Model.__init__ = held
        spec.loader.exec_module = executed
        return spec
sys.meta_path.insert(0, Held())
"""


@pytest.fixture
def env(tmp_path: Path) -> Iterator[dict[str, str]]:
    """Return the environment of a server with two voices."""
    needs_packages(*NEEDED)
    tiny_voice.put(tmp_path / "voices", "tiny")
    tiny_voice.put(tmp_path / "voices", "broken", b"no model")
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(SITE)
    with short_directory() as home:
        os.mkdir(f"{home}/run", 0o700)
        yield environment(
            home,
            TALK_SOCKET=f"{home}/run/s",
            TALK_VOICES=str(tmp_path / "voices"),
            PYTHONPATH=str(tmp_path / "site"),
            HOLD=str(tmp_path / "hold"),
        )


@pytest.fixture
def hold(tmp_path: Path) -> Path:
    """Let no model be loaded until this file is removed."""
    (tmp_path / "hold").touch()
    return tmp_path / "hold"


class Robot:
    """A server with neural voices, and a client of it."""

    def __init__(self, server: BareServe, env: dict[str, str]) -> None:
        self.server = server
        self.env = env
        self.client = Client(env["TALK_SOCKET"])

    def say(self, text: str = "hello", voice: str | None = TINY, **options: Any) -> GoalHandle:
        return self.client.say(text, voice=voice, **options)

    def heard(self, goal: GoalHandle) -> tuple[str, str | None]:
        """Return how a goal ended, and by which voice it was heard."""
        ended = goal.wait(LIMIT)
        return ended.state.name, ended.voice

    def state(self, goal: GoalHandle) -> str:
        """Return the state of a goal."""
        return self.client.goal(goal.id).state.name

    def neural(self, voice: str = TINY) -> dict[str, Any]:
        """Return how the server describes a neural voice."""
        found = self.client.status().server["neural_voices"]
        assert isinstance(found, dict)
        return dict(found.get(voice, {"state": None}))

    def until(self, what: Callable[[], object]) -> None:
        limit = time.monotonic() + LIMIT
        while not what():
            assert time.monotonic() < limit, f"it never came: {self.server.log}"
            time.sleep(0.02)

    def loads(self, voice: str = TINY) -> None:
        """Wait until a voice is loaded."""
        self.until(lambda: self.neural(voice)["state"] == "loaded")

    def kill_engine(self) -> None:
        for engine in children(self.server.process.pid):
            os.kill(engine, signal.SIGKILL)


@contextlib.contextmanager
def _robot(env: dict[str, str], *options: str) -> Iterator[Robot]:
    with serving(env, "--rate", "450", *options) as server:
        robot = Robot(server, env)
        with robot.client:
            yield robot


# -- a voice that is being loaded


def test_a_goal_waits_for_its_voice_and_so_do_those_behind_it(env: dict[str, str], hold: Path) -> None:
    with _robot(env) as robot:
        first, second = robot.say(), robot.say("behind", None)
        robot.until(lambda: robot.neural() == {"state": "loading", "why": None})
        assert [robot.state(each) for each in (first, second)] == ["PENDING", "PENDING"]
        assert "voice    piper/tiny loading" in run([*TALK, "status"], env).out
        hold.unlink()
        assert robot.heard(first) == ("SUCCEEDED", TINY)
        assert robot.heard(second) == ("SUCCEEDED", "gmw/en")
        assert robot.neural() == {"state": "loaded", "why": None}
    assert "voice piper/tiny loaded in " in robot.server.log


def test_the_server_is_ready_before_its_voice_is_loaded(env: dict[str, str], hold: Path) -> None:
    with _robot(env, "--voice", "piper/ti") as robot:
        assert "loaded" not in robot.server.log
        robot.until(lambda: robot.neural()["state"] == "loading")
        goal = robot.say("hello", None)
        assert robot.state(goal) == "PENDING"
        assert robot.client.status().server["voice"] == TINY
        hold.unlink()
        assert robot.heard(goal) == ("SUCCEEDED", TINY)


def test_espeak_speaks_instead_if_a_goal_cannot_wait(env: dict[str, str], hold: Path) -> None:
    assert hold.exists()
    with _robot(env) as robot:
        for urgent in ({"preempt": True}, {"flush": True}, {"priority": 1}, {"ttl": 0.2}):
            goal = robot.say("hello", **urgent)
            assert robot.heard(goal) == ("SUCCEEDED", INSTEAD)
            assert f"{goal.id} is spoken by {INSTEAD}: piper/tiny is not loaded" in robot.server.log
        assert f"voice    {INSTEAD}" in run([*TALK, "status", goal.id], env).out


def test_a_goal_that_insists_waits_for_the_voice_or_expires(env: dict[str, str], hold: Path) -> None:
    with _robot(env) as robot:
        late, urgent = robot.say(voice_only=True, ttl=0.5), robot.say("x", voice_only=True, priority=1)
        assert late.wait(LIMIT).reason == "expired"
        assert robot.state(urgent) == "PENDING"
        hold.unlink()
        assert robot.heard(urgent) == ("SUCCEEDED", TINY)


def test_a_voice_is_loaded_during_the_speech(env: dict[str, str], hold: Path, tmp_path: Path) -> None:
    tiny_voice.put(tmp_path / "voices", "second")
    hold.unlink()
    with _robot(env, "--voice", "piper/second") as robot:
        robot.loads("piper/second")
        hold.touch()
        active = robot.say(LONG, None, feedback=True)
        robot.until(lambda: robot.state(active) == "ACTIVE")
        goal = robot.say()
        robot.until(lambda: robot.neural()["state"] == "loading")
        words = active.feedback()
        assert [next(words).word for _ in range(5)] == ["this", "goes", "on", "and", "on"]
        hold.unlink()
        robot.loads()
        assert robot.state(active) == "ACTIVE"
        robot.client.cancel([active.id])
        assert robot.heard(goal) == ("SUCCEEDED", TINY)


def test_the_first_voice_is_loaded_while_nothing_is_heard(env: dict[str, str]) -> None:
    """Its libraries stop the whole process for a moment, which would be heard."""
    with _robot(env) as robot:
        active = robot.say(LONG, None)
        robot.until(lambda: robot.state(active) == "ACTIVE")
        goal = robot.say()
        assert robot.neural()["state"] == "waiting"
        robot.client.cancel([active.id])
        assert robot.heard(goal) == ("SUCCEEDED", TINY)
    ended, loaded = (robot.server.log.index(each) for each in (f"{active.id} PREEMPTED", "voice piper/tiny loaded"))
    assert ended < loaded


def test_goals_stop_waiting_when_the_server_s_voice_is_changed(env: dict[str, str], hold: Path) -> None:
    assert hold.exists()
    with _robot(env, "--voice", TINY) as robot:
        goal = robot.say("hello", None, voice_only=True)
        robot.until(lambda: robot.neural()["state"] == "loading")
        robot.client.set(voice="en-us")
        assert robot.heard(goal) == ("SUCCEEDED", INSTEAD)


# -- a voice that can't be loaded


def test_espeak_speaks_instead_of_a_broken_voice_until_it_is_mended(env: dict[str, str], tmp_path: Path) -> None:
    why = f"{tmp_path}/voices/broken.onnx is no ONNX model: get the voice anew, from a source that you trust"
    with _robot(env, "--voice", BROKEN) as robot:
        assert robot.heard(robot.say("hello", None)) == ("SUCCEEDED", INSTEAD)
        assert robot.neural(BROKEN) == {"state": "failed", "why": why}
        assert f"{BROKEN} failed: " in run([*TALK, "status"], env).out
        assert f"voice {BROKEN} cannot be loaded, espeak speaks where it may: {why}" in robot.server.log
        done = run([*TALK, "--json", "say", "--wait", "--voice-only", "hello"], env)
        goal = json.loads(done.out)
        assert (done.code, goal["reason"], goal["message"]) == (4, "voice_failed", f"Talk aborted: {why}")
        assert robot.heard(robot.say()) == ("SUCCEEDED", TINY)
        tiny_voice.put(tmp_path / "voices", "broken")
        assert run([*TALK, "set", "--voice", BROKEN], env).code == 0
        assert robot.heard(robot.say("hello", None)) == ("SUCCEEDED", BROKEN)


def test_two_voices_that_do_not_fit_together_speak_in_turn(env: dict[str, str], tmp_path: Path) -> None:
    tiny_voice.put(tmp_path / "voices", "second")
    with _robot(env, "--voice-memory", "0") as robot:
        names = (TINY, "piper/second", TINY)
        goals = [robot.say(voice=each) for each in names]
        assert [robot.heard(each) for each in goals] == [("SUCCEEDED", each) for each in names]
        assert "voice piper/tiny dropped, to make room" in robot.server.log


def test_a_voice_that_is_dropped_while_it_speaks_is_not_counted_twice(env: dict[str, str], tmp_path: Path) -> None:
    tiny_voice.put(tmp_path / "voices", "second")
    env["BALLAST_BYTES"] = "100000000"
    with _robot(env, "--voice-memory", "180") as robot:
        first = robot.say("this goes on and on " * 3)
        robot.until(lambda: robot.client.goal(first.id).spoken)
        second = robot.say(voice="piper/second")
        assert robot.heard(first) == ("SUCCEEDED", TINY)
        assert robot.heard(second) == ("SUCCEEDED", "piper/second")
        robot.until(lambda: f"voice {TINY} dropped: the voices take more" in robot.server.log)
        assert (robot.neural(TINY)["state"], robot.neural("piper/second")["why"]) == (None, None)
        assert robot.server.log.count("voice piper/second loaded") == 1
        assert "it takes" not in robot.server.log


def test_a_voice_that_alone_takes_too_much_memory_speaks_and_is_told(env: dict[str, str]) -> None:
    env["BALLAST_BYTES"] = "100000000"
    with _robot(env, "--voice-memory", "50") as robot:
        assert robot.heard(robot.say()) == ("SUCCEEDED", TINY)
        assert re.search(rf"voice {TINY}: it takes 1\d\d MB, more than --voice-memory 50\n", robot.server.log)
        assert re.search(rf"{TINY} loaded: it takes 1\d\d MB, more than", run([*TALK, "status"], env).out)


def test_a_pitch_is_refused_with_a_voice_that_has_none(env: dict[str, str]) -> None:
    with _robot(env, "--voice", TINY, "--pitch", "60") as robot:
        refused = robot.say(pitch=70).goal
        assert (refused.reason, refused.state.name) == ("bad_option", "REJECTED")
        assert "has no pitch but its own" in str(refused.message)
        assert robot.heard(robot.say("hello", None)) == ("SUCCEEDED", TINY), "the server's pitch is for other voices"
        assert robot.heard(robot.say("hello", None, pitch=70)) == ("SUCCEEDED", TINY)
        assert robot.heard(robot.say("hello", None, voice_only=True)) == ("SUCCEEDED", TINY)


def test_a_new_voice_is_preferred_to_one_whose_name_begins_with_its_own(env: dict[str, str], tmp_path: Path) -> None:
    tiny_voice.put(tmp_path / "voices", "joe2")
    with _robot(env) as robot:
        assert robot.heard(robot.say(voice="piper/joe", voice_only=True)) == ("SUCCEEDED", "piper/joe2")
        tiny_voice.put(tmp_path / "voices", "joe")
        assert robot.heard(robot.say(voice="piper/joe", voice_only=True)) == ("SUCCEEDED", "piper/joe")


# -- an engine that dies, hangs or cannot start


def test_an_engine_that_dies_costs_one_goal_and_loads_its_voice_again(env: dict[str, str]) -> None:
    with _robot(env, "--voice", TINY) as robot:
        robot.loads()
        goal = robot.say(LONG, None)
        robot.until(lambda: robot.client.goal(goal.id).spoken)
        robot.kill_engine()
        assert goal.wait(LIMIT).reason == "engine_crashed"
        assert robot.heard(robot.say("urgent", None, preempt=True)) == ("SUCCEEDED", INSTEAD)
        assert robot.heard(robot.say("hello", None)) == ("SUCCEEDED", TINY)


def test_a_voice_that_kills_the_engine_twice_is_left_alone_until_it_is_set_again(
    env: dict[str, str], hold: Path
) -> None:
    why = "the engine process ended while it was being loaded"
    with _robot(env, "--voice", TINY) as robot:
        for _ in range(2):
            robot.until(lambda: robot.neural()["state"] == "loading")
            robot.kill_engine()
            robot.until(lambda: robot.neural()["state"] != "loading")
        robot.until(lambda: robot.neural()["state"] == "failed")
        assert robot.neural()["why"] == why
        ended = robot.say("hello", None, voice_only=True).wait(LIMIT)
        assert (ended.reason, ended.message) == ("voice_failed", f"Talk aborted: {why}")
        assert f"voice piper/tiny is left alone: {why}" in robot.server.log
        assert robot.server.log.count("the engine crashed") == 2
        assert robot.heard(robot.say("hello", None)) == ("SUCCEEDED", INSTEAD)
        hold.unlink()
        assert run([*TALK, "set", "--voice", TINY], env).code == 0
        assert robot.heard(robot.say("hello", None)) == ("SUCCEEDED", TINY)


def test_espeak_speaks_if_the_files_of_a_voice_are_gone(env: dict[str, str], tmp_path: Path) -> None:
    with _robot(env, "--voice", TINY) as robot:
        robot.loads()
        (tmp_path / "voices" / "tiny.onnx").unlink()
        robot.kill_engine()
        robot.until(lambda: robot.neural()["state"] == "failed")
        goal = robot.say("hello", None)
        state, voice = robot.heard(goal)
        assert state == "SUCCEEDED"
        assert f'{goal.id} is spoken by {voice}: unknown voice "piper/tiny"' in robot.server.log


def test_goals_end_at_once_if_the_engine_cannot_start(env: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "site" / "pyttsx3.py").write_text("raise ModuleNotFoundError('no pyttsx3 here', name='pyttsx3')")
    with _robot(env, "--voice", TINY) as robot:
        robot.until(lambda: "pyttsx3 is missing" in robot.server.log)
        goals = [robot.say("hello", None), robot.say(voice_only=True), robot.say("behind", "en")]
        assert [each.wait(LIMIT).reason for each in goals] == ["engine_failed"] * 3


def test_an_engine_that_hangs_while_it_loads_is_replaced(env: dict[str, str], hold: Path) -> None:
    with _robot(env) as robot:
        goal = robot.say(voice_only=True)
        robot.until(lambda: robot.neural()["state"] == "loading")
        for engine in children(robot.server.process.pid):
            os.kill(engine, signal.SIGSTOP)
        robot.until(lambda: "no sign of life for 3 s while it loaded piper/tiny" in robot.server.log)
        hold.unlink()
        assert robot.heard(goal) == ("SUCCEEDED", TINY)
