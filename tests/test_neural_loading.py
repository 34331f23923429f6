"""Neural voices while a server loads them, or can't: goals wait, or espeak speaks; never silence."""

from __future__ import annotations

import contextlib
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
#: What libespeak-ng speaks in the place of these voices, whose language is en-us.
INSTEAD = "gmw/en-US"
#: Seconds in which anything here must have happened.
LIMIT = 20.0
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
    """Return the environment of a server for which two voices are there."""
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
    """Let no model be loaded as long as this file is there."""
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
        """Return the state in which a goal is, by another connection."""
        return self.client.goal(goal.id).state.name

    def neural(self, voice: str = TINY) -> dict[str, Any]:
        """Return what the server says of a neural voice."""
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


def test_a_goal_waits_in_its_place_for_its_voice_and_those_behind_it_do(env: dict[str, str], hold: Path) -> None:
    with _robot(env) as robot:
        first, second = robot.say(), robot.say("behind", None)
        robot.until(lambda: robot.neural() == {"state": "loading", "why": None})
        assert [robot.state(each) for each in (first, second)] == ["PENDING", "PENDING"]
        assert "voice    piper/tiny loading" in run([*TALK, "status"], env).out
        hold.unlink()
        assert robot.heard(first) == ("SUCCEEDED", TINY)
        state, voice = robot.heard(second)
        assert (state, voice) == ("SUCCEEDED", "gmw/en")
        assert robot.neural() == {"state": "loaded", "why": None}
    assert "voice piper/tiny loaded in " in robot.server.log


def test_the_server_s_voice_is_no_part_of_its_start(env: dict[str, str], hold: Path) -> None:
    with _robot(env, "--voice", "piper/ti") as robot:
        assert "loaded" not in robot.server.log, "it is ready before"
        robot.until(lambda: robot.neural()["state"] == "loading")
        goal = robot.say("hello", None)
        assert robot.state(goal) == "PENDING"
        assert robot.client.status().server["voice"] == TINY
        hold.unlink()
        assert robot.heard(goal) == ("SUCCEEDED", TINY)


@pytest.mark.parametrize("urgent", [{"preempt": True}, {"flush": True}, {"priority": 1}, {"ttl": 1.0}, {"ttl": 0.2}])
def test_espeak_speaks_in_its_place_where_it_cannot_wait(
    env: dict[str, str], hold: Path, urgent: dict[str, Any]
) -> None:
    assert hold.exists()
    with _robot(env) as robot:
        goal = robot.say("hello", **urgent)
        assert robot.heard(goal) == ("SUCCEEDED", INSTEAD)
        assert f"{goal.id} is spoken by {INSTEAD}: piper/tiny is not loaded" in robot.server.log
        assert f"voice    {INSTEAD}" in run([*TALK, "status", goal.id], env).out


@pytest.mark.slow
def test_no_goal_waits_longer_than_ten_seconds_for_its_voice(env: dict[str, str], hold: Path) -> None:
    assert hold.exists()
    with _robot(env) as robot:
        began = time.monotonic()
        goals = [robot.say(), robot.say("behind", None), robot.say("at once")]
        assert [robot.heard(each)[1] for each in goals] == [INSTEAD, "gmw/en", INSTEAD]
        assert 10 < time.monotonic() - began < 13


def test_who_insists_waits_for_the_voice_or_expires(env: dict[str, str], hold: Path) -> None:
    with _robot(env) as robot:
        late, urgent = robot.say(voice_only=True, ttl=0.5), robot.say("x", voice_only=True, priority=1)
        assert late.wait(LIMIT).reason == "expired"
        assert robot.state(urgent) == "PENDING"
        hold.unlink()
        assert robot.heard(urgent) == ("SUCCEEDED", TINY)


def test_a_voice_is_loaded_beside_the_speech(env: dict[str, str], hold: Path, tmp_path: Path) -> None:
    tiny_voice.put(tmp_path / "voices", "second")
    hold.unlink()
    with _robot(env, "--voice", "piper/second") as robot:
        robot.loads("piper/second")
        hold.touch()
        active = robot.say("this goes on and on " * 30, None, feedback=True)
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
        active = robot.say("this goes on and on " * 30, None)
        robot.until(lambda: robot.state(active) == "ACTIVE")
        goal = robot.say()
        assert robot.neural()["state"] == "waiting"
        robot.client.cancel([active.id])
        assert robot.heard(goal) == ("SUCCEEDED", TINY)
    ended, loaded = (robot.server.log.index(each) for each in (f"{active.id} PREEMPTED", "voice piper/tiny loaded"))
    assert ended < loaded


# -- a voice that can't be loaded


def test_a_voice_that_cannot_be_loaded_is_espeak_and_says_so(env: dict[str, str], tmp_path: Path) -> None:
    why = f"{tmp_path}/voices/broken.onnx is no ONNX model: get the voice anew, from a source that you trust"
    with _robot(env, "--voice", BROKEN) as robot:
        assert robot.heard(robot.say("hello", None)) == ("SUCCEEDED", INSTEAD)
        assert robot.neural(BROKEN) == {"state": "failed", "why": why}
        assert f"{BROKEN} failed: " in run([*TALK, "status"], env).out
        assert f"voice {BROKEN} cannot be loaded, espeak speaks where it may: {why}" in robot.server.log
        insists = robot.say("hello", None, voice_only=True).wait(LIMIT)
        assert (insists.state.name, insists.reason, insists.message) == (
            "ABORTED",
            "voice_failed",
            f"Talk aborted: {why}",
        )
        assert robot.heard(robot.say()) == ("SUCCEEDED", TINY)


def test_what_is_mended_is_loaded_again(env: dict[str, str], tmp_path: Path) -> None:
    with _robot(env) as robot:
        assert robot.heard(robot.say("hello", BROKEN)) == ("SUCCEEDED", INSTEAD)
        tiny_voice.put(tmp_path / "voices", "broken")
        assert run([*TALK, "set", "--voice", BROKEN], env).code == 0
        assert robot.heard(robot.say("hello", None)) == ("SUCCEEDED", BROKEN)


@pytest.mark.slow
def test_one_that_is_asked_for_again_is_tried_again_after_a_while(env: dict[str, str], tmp_path: Path) -> None:
    with _robot(env) as robot:
        assert robot.heard(robot.say("hello", BROKEN)) == ("SUCCEEDED", INSTEAD)
        tiny_voice.put(tmp_path / "voices", "broken")
        robot.until(lambda: robot.say("hello", BROKEN) and robot.neural(BROKEN)["state"] == "loaded")
        robot.client.cancel()
        assert robot.heard(robot.say("hello", BROKEN)) == ("SUCCEEDED", BROKEN)


def test_two_voices_that_there_is_no_room_for_together_speak_in_turn(env: dict[str, str], tmp_path: Path) -> None:
    tiny_voice.put(tmp_path / "voices", "second")
    with _robot(env, "--voice-memory", "0") as robot:
        goals = [robot.say(voice=each) for each in (TINY, "piper/second") * 3]
        assert [robot.heard(each) for each in goals] == [("SUCCEEDED", TINY), ("SUCCEEDED", "piper/second")] * 3
        assert "voice piper/tiny dropped, to make room" in robot.server.log


def test_what_voices_take_in_memory_counts_and_not_their_files(env: dict[str, str], tmp_path: Path) -> None:
    tiny_voice.put(tmp_path / "voices", "second")
    env["BALLAST_BYTES"] = "100000000"
    with _robot(env, "--voice-memory", "180") as robot:
        assert robot.heard(robot.say()) == ("SUCCEEDED", TINY)
        assert robot.heard(robot.say(voice="piper/second")) == ("SUCCEEDED", "piper/second")
        robot.until(lambda: f"voice {TINY} dropped: the voices take more" in robot.server.log)
        assert (robot.neural(TINY)["state"], robot.neural("piper/second")["why"]) == (None, None)
        assert robot.heard(robot.say()) == ("SUCCEEDED", TINY)


def test_a_voice_that_is_dropped_while_it_speaks_is_not_counted_twice(env: dict[str, str], tmp_path: Path) -> None:
    tiny_voice.put(tmp_path / "voices", "second")
    env["BALLAST_BYTES"] = "100000000"
    with _robot(env, "--voice-memory", "180") as robot:
        first = robot.say("this goes on and on " * 4)
        robot.until(lambda: robot.client.goal(first.id).spoken)
        second = robot.say(voice="piper/second")
        assert robot.heard(first) == ("SUCCEEDED", TINY)
        assert robot.heard(second) == ("SUCCEEDED", "piper/second")
        assert f"voice {TINY} dropped: the voices take more" in robot.server.log
        assert robot.server.log.count("voice piper/second loaded") == 1
        assert "it takes" not in robot.server.log


def test_a_voice_that_takes_more_than_all_may_speaks_and_is_told(env: dict[str, str]) -> None:
    env["BALLAST_BYTES"] = "100000000"
    with _robot(env, "--voice-memory", "50") as robot:
        assert robot.heard(robot.say()) == ("SUCCEEDED", TINY)
        assert re.search(rf"voice {TINY}: it takes 1\d\d MB, more than --voice-memory 50\n", robot.server.log)
        assert re.search(rf"{TINY} loaded: it takes 1\d\d MB, more than", run([*TALK, "status"], env).out)


# -- an engine that dies


def test_an_engine_that_dies_costs_one_goal_and_its_voice_comes_back_by_itself(env: dict[str, str]) -> None:
    with _robot(env, "--voice", TINY) as robot:
        robot.loads()
        goal = robot.say("this goes on and on " * 30, None)
        robot.until(lambda: robot.client.goal(goal.id).spoken)
        robot.kill_engine()
        assert goal.wait(LIMIT).reason == "engine_crashed"
        assert robot.heard(robot.say("urgent", None, preempt=True)) == ("SUCCEEDED", INSTEAD)
        assert robot.heard(robot.say("hello", None)) == ("SUCCEEDED", TINY)


def test_a_voice_that_kills_the_engine_twice_is_left_alone(env: dict[str, str], hold: Path) -> None:
    with _robot(env, "--voice", TINY) as robot:
        for _ in range(2):
            robot.until(lambda: robot.neural()["state"] == "loading")
            robot.kill_engine()
            robot.until(lambda: robot.neural()["state"] != "loading")
        robot.until(lambda: robot.neural()["state"] == "failed")
        assert robot.neural()["why"] == "the engine process ended while it was being loaded"
        assert robot.heard(robot.say("hello", None)) == ("SUCCEEDED", INSTEAD)
        hold.unlink()
        assert run([*TALK, "set", "--voice", TINY], env).code == 0
        assert robot.heard(robot.say("hello", None)) == ("SUCCEEDED", TINY)


def test_a_voice_whose_files_go_away_is_no_reason_for_silence(env: dict[str, str], tmp_path: Path) -> None:
    with _robot(env, "--voice", TINY) as robot:
        robot.loads()
        (tmp_path / "voices" / "tiny.onnx").unlink()
        robot.kill_engine()
        robot.until(lambda: robot.neural()["state"] == "failed")
        goal = robot.say("hello", None)
        state, voice = robot.heard(goal)
        assert state == "SUCCEEDED"
        assert f'{goal.id} is spoken by {voice}: unknown voice "piper/tiny"' in robot.server.log


def test_a_pitch_is_refused_with_a_voice_that_has_none(env: dict[str, str]) -> None:
    with _robot(env, "--voice", TINY, "--pitch", "60") as robot:
        refused = robot.say(pitch=70).goal
        assert (refused.reason, refused.state.name) == ("bad_option", "REJECTED")
        assert "has no pitch but its own" in str(refused.message)
        assert robot.heard(robot.say("hello", None)) == ("SUCCEEDED", TINY), "the server's pitch is for other voices"
        assert robot.heard(robot.say("hello", None, pitch=70)) == ("SUCCEEDED", TINY)
        assert robot.heard(robot.say("hello", None, voice_only=True)) == ("SUCCEEDED", TINY)


# -- and never for ever


def test_goals_end_at_once_where_the_engine_cannot_start(env: dict[str, str], tmp_path: Path) -> None:
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


def test_a_server_s_voice_that_changes_lets_go_who_waited_for_it(env: dict[str, str], hold: Path) -> None:
    assert hold.exists()
    with _robot(env, "--voice", TINY) as robot:
        goal = robot.say("hello", None, voice_only=True)
        robot.until(lambda: robot.neural()["state"] == "loading")
        robot.client.set(voice="en-us")
        assert robot.heard(goal) == ("SUCCEEDED", INSTEAD)


def test_a_voice_that_another_begins_with_is_found_when_it_is_put_there(env: dict[str, str], tmp_path: Path) -> None:
    tiny_voice.put(tmp_path / "voices", "joe2")
    with _robot(env) as robot:
        assert robot.heard(robot.say(voice="piper/joe", voice_only=True)) == ("SUCCEEDED", "piper/joe2")
        tiny_voice.put(tmp_path / "voices", "joe")
        assert robot.heard(robot.say(voice="piper/joe", voice_only=True)) == ("SUCCEEDED", "piper/joe")


def test_a_goal_that_insists_on_a_voice_that_kills_the_engine_ends_for_it(env: dict[str, str], hold: Path) -> None:
    assert hold.exists()
    with _robot(env, "--voice", TINY) as robot:
        for _ in range(2):
            robot.until(lambda: robot.neural()["state"] == "loading")
            robot.kill_engine()
            robot.until(lambda: robot.neural()["state"] != "loading")
        why = "the engine process ended while it was being loaded"
        ended = robot.say("hello", None, voice_only=True).wait(LIMIT)
        assert (ended.reason, ended.message) == ("voice_failed", f"Talk aborted: {why}")
        assert f"voice piper/tiny is left alone: {why}" in robot.server.log
        assert robot.server.log.count("the engine crashed") == 2
