"""An engine process that can't be started for a while is waited for: its death costs one goal, and none behind it."""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import time
from typing import TYPE_CHECKING

import pytest

from tests.conformance.hearing import LONG, begin, engine_process, send
from tests.faults.broken import python_path, write
from tests.support import census

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from tests.conftest import MakeTalk
    from tests.support.connection import Wire
    from tests.support.processes import Talk

#: Goals that wait behind the one that loses its engine.
WAITING = 20
#: Descriptors that a server has, and no engine can be started with.
TOO_FEW = 12
#: Shortens the waits of a server whose engine can't start: no second, but tenths.
HASTY = """
from talkcli.engine import restarts
restarts.BACK_OFF, restarts.PATIENCE = (0.0, 0.05, 0.1), {patience}
"""


@contextlib.contextmanager
def too_few_descriptors(talk: Talk) -> Iterator[None]:
    allowed = resource.prlimit(talk.pid, resource.RLIMIT_NOFILE)
    resource.prlimit(talk.pid, resource.RLIMIT_NOFILE, (TOO_FEW, allowed[1]))
    yield
    resource.prlimit(talk.pid, resource.RLIMIT_NOFILE, allowed)


def _ends(talk: Talk, goals: list[str]) -> list[tuple[str, str | None]]:
    for each in goals:
        talk.watcher.wait_for_terminal(each)
    return [(goal["state"], goal["reason"]) for goal in map(talk.goal, goals)]


def _await_engine(wire: Wire, words: str) -> None:
    end = time.monotonic() + 10
    while (told := wire.request("status")["server"]["engine"]) != words:
        assert time.monotonic() < end, told
        time.sleep(0.005)  # how the engine is, is published to nobody


def test_a_moment_without_descriptors_costs_the_goal_whose_engine_was_killed_and_no_other(make_talk: MakeTalk) -> None:
    talk = make_talk("--player", "null")
    assert talk.run("voices").code == 0
    first = begin(talk, LONG, number=1)
    goals = [send(talk, "yes", rate=450, volume=0) for _ in range(3)]
    brief = send(talk, "too late", ttl=0.3)
    with talk.connect() as wire:  # connected before: a new client would need a descriptor
        with too_few_descriptors(talk):
            os.kill(engine_process(talk), signal.SIGKILL)
            assert talk.watcher.wait_for_terminal(first) == "ABORTED"
            _await_engine(wire, "the engine process cannot be started: Too many open files")
            assert talk.watcher.wait_for_terminal(brief) == "RECALLED"  # a goal that waits for an engine has its time
            assert [wire.request("status", id=each)["goal"]["state"] for each in goals] == ["PENDING"] * len(goals)
        assert _ends(talk, goals) == [("SUCCEEDED", None)] * len(goals)
    assert (talk.goal(first)["reason"], talk.goal(brief)["reason"]) == ("engine_crashed", "expired")
    assert talk.log.count("cannot be started") == 1, talk.log


def test_a_kill_in_a_goal_and_two_in_the_starts_behind_it_cost_one_goal(scripted: Talk) -> None:
    talk = scripted
    first = begin(talk, "never-ends", number=1)
    goals = [send(talk, "length=0.01") for _ in range(WAITING)]
    talk.script_start("hang")  # so that each start can be met in its middle
    (engine,) = census.descendants(talk.pid)
    for _ in range(3):
        os.kill(engine, signal.SIGKILL)
        known = engine
        while not (found := set(census.descendants(talk.pid)) - {known}):
            time.sleep(0.002)  # a process that is started is no event
        (engine,) = found
    talk.script_start("")
    os.kill(engine, signal.SIGKILL)
    assert _ends(talk, [first]) == [("ABORTED", "engine_crashed")]
    assert _ends(talk, goals) == [("SUCCEEDED", None)] * WAITING


def test_an_engine_that_was_killed_while_idle_costs_no_goal_that_comes_at_once(make_talk: MakeTalk) -> None:
    talk = make_talk("--player", "null")
    assert talk.run("voices").code == 0
    for _ in range(10):
        os.kill(engine_process(talk), signal.SIGKILL)
        goal = send(talk, "yes", rate=450)
        assert _ends(talk, [goal]) == [("SUCCEEDED", None)], talk.goal(goal)


def test_an_engine_that_does_not_come_for_long_costs_a_goal_each_time_it_is_tried(
    make_talk: MakeTalk, tmp_path: Path
) -> None:
    write(tmp_path / "sitecustomize.py", HASTY.format(patience=0.5))
    talk = make_talk(scripted=True, env=python_path(tmp_path))
    assert talk.run("voices").code == 0
    talk.script_start("crash")
    began = time.monotonic()
    (engine,) = census.descendants(talk.pid)
    os.kill(engine, signal.SIGKILL)
    goals = [send(talk, "length=0.5") for _ in range(4)]
    assert _ends(talk, goals[:2]) == [("ABORTED", "engine_failed")] * 2
    assert time.monotonic() - began >= 0.4, "it is waited for first"
    times = [talk.goal(each)["ended_at"] for each in goals[:2]]
    assert times[1] - times[0] >= 0.09, "one goal for one start"
    assert "the engine crashed: it was killed by SIGSEGV" in talk.goal(goals[0])["message"]
    talk.script_start("")
    assert _ends(talk, goals)[-1] == ("SUCCEEDED", None)


@pytest.mark.parametrize("option", [("--driver", "parrot"), ("--driver", "nsss"), ("--voice", "parrot")], ids=" ".join)
def test_a_driver_or_a_voice_that_there_is_not_ends_the_server_before_it_is_ready(
    make_talk: MakeTalk, option: tuple[str, str]
) -> None:
    talk = make_talk("--player", "null")
    place = f"{talk.directory}/other"
    done = talk.run("serve", "--player", "null", "--socket", place, *option)
    assert done.code == 2
    (words,) = done.err.splitlines()
    assert words.startswith("talk: "), words
    assert f'"{option[1]}"' in words or f"'{option[1]}'" in words, words
    assert not os.path.exists(place)
