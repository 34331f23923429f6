"""The engine cannot start. Goals are aborted at once if the cause is permanent, and wait if it is temporary.

A module in the environment of a real server shadows the installed one.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import resource
import signal
import time
from typing import TYPE_CHECKING

import pytest

from tests.conformance.bareserve import SERVE, environment, run
from tests.conformance.hearing import LONG, LOW, assert_aborted, engine_process, send, start_goal
from tests.faults.broken import assert_answers, assert_heard_again, python_path, write
from tests.support import usage
from tests.support.connection import PATIENCE
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from tests.conftest import MakeTalk
    from tests.support.connection import Wire
    from tests.support.processes import Talk
    from tests.support.sink import Sink

#: Limit in seconds for a goal that is ABORTED without waiting.
AT_ONCE = 0.1
#: Limit in seconds from an engine's end to the next goal's first word.
SPEAKING = 0.5

#: The documented delays in seconds between failing starts of the engine.
WAITS = (0.0, 0.1, 0.5, 2.0, 10.0)
#: A module that cannot be imported, and logs the time of each attempt.
ABSENT = """
import time
with open({attempts!r}, "a") as file:
    file.write(str(time.monotonic()) + "\\n")
raise ModuleNotFoundError("No module named " + repr(__name__), name=__name__)
"""


def test_goals_are_aborted_at_once_while_a_dependency_is_missing(
    make_talk: MakeTalk, sink: Sink, tmp_path: Path
) -> None:
    """`tests/engine/test_drivers.py` tests the error of each dependency."""
    error = "pyttsx3 is missing ("
    attempts = write(tmp_path / "attempts", "")
    with limits():
        shadow = write(tmp_path / "pyttsx3.py", ABSENT.format(attempts=str(attempts)))
        talk = make_talk(sink=sink, env=python_path(tmp_path))
        took = _assert_aborted_at_once(talk, error)
        assert talk.log.count(error) == 3, f"not once for the engine and once per goal: {talk.log}"
        assert_answers(talk)
        times = _await_attempts(attempts, 3)
        shadow.unlink()
        with talk.connect() as wire:
            _await_engine(wire, "ready")
            times.append(time.monotonic())
        assert_heard_again(talk, sink)
        talk.stop()
        for (former, following), wait in zip(itertools.pairwise(times), WAITS, strict=False):
            assert following - former >= wait
        assert_within(took, AT_ONCE, "the end of a goal without an engine")


def _await_attempts(path: Path, count: int) -> list[float]:
    """Return the times of the first `count` attempts to start the engine."""
    end = time.monotonic() + PATIENCE
    while len(times := path.read_text(encoding="utf-8").splitlines()) < count:
        assert time.monotonic() < end, times
        time.sleep(0.01)  # the attempts of another process send no event
    return [float(line) for line in times]


def _assert_aborted_at_once(talk: Talk, error: str) -> float:
    """Assert that goals are ABORTED with this error, and return the seconds until one is."""
    done = talk.run("say", "--wait", "--", LOW)
    assert done.code == 4
    assert error in done.err
    sent_at = time.monotonic()
    goal_id = send(talk, LOW)
    ended = talk.watcher.arrived(talk.watcher.wait_for(goal_id, "ABORTED"))
    for ended_id in (done.id, goal_id):
        goal = talk.goal(ended_id)
        assert_aborted(goal, "engine_failed", error)
        assert goal["spoken"] == ""
    return ended - sent_at


#: Number of goals that wait behind the one that loses its engine.
WAITING = 20
#: A limit of descriptors that is too low to start an engine.
TOO_FEW = 12


@contextlib.contextmanager
def too_few_descriptors(talk: Talk) -> Iterator[None]:
    allowed = resource.prlimit(talk.pid, resource.RLIMIT_NOFILE)
    resource.prlimit(talk.pid, resource.RLIMIT_NOFILE, (TOO_FEW, allowed[1]))
    yield
    resource.prlimit(talk.pid, resource.RLIMIT_NOFILE, allowed)


def _replaced(talk: Talk, engine: int, number: signal.Signals = signal.SIGKILL) -> int:
    """Kill the engine process, wait for the next one, and return its id."""
    os.kill(engine, number)
    end = time.monotonic() + PATIENCE
    while not (replacement := set(usage.descendants(talk.pid)) - {engine}):
        assert time.monotonic() < end, talk.log
        time.sleep(0.002)  # the start of a process sends no event
    return replacement.pop()


def _ends(talk: Talk, goals: list[str]) -> list[tuple[str, str | None]]:
    for goal_id in goals:
        talk.watcher.wait_for_terminal(goal_id)
    return [(goal["state"], goal["reason"]) for goal in map(talk.goal, goals)]


def _await_engine(wire: Wire, expected: str) -> None:
    end = time.monotonic() + 10
    while (state := wire.request("status")["server"]["engine"]) != expected:
        assert time.monotonic() < end, state
        time.sleep(0.005)  # no event reports the state of the engine


def test_a_brief_lack_of_descriptors_aborts_only_the_current_goal(make_talk: MakeTalk) -> None:
    talk = make_talk("--player", "null")
    assert talk.run("voices").code == 0
    first = start_goal(talk, LONG, number=1)
    goals = [send(talk, "yes", rate=450, volume=0) for _ in range(3)]
    brief = send(talk, "too late", ttl=0.3)
    with talk.connect() as wire:  # connected in advance, because a new client needs a descriptor
        with too_few_descriptors(talk):
            os.kill(engine_process(talk), signal.SIGKILL)
            assert talk.watcher.wait_for_terminal(first) == "ABORTED"
            _await_engine(wire, "the engine process could not be started: Too many open files")
            assert talk.watcher.wait_for_terminal(brief) == "RECALLED"  # its time to live expires as usual
            assert [wire.request("status", id=goal)["goal"]["state"] for goal in goals] == ["PENDING"] * len(goals)
        assert _ends(talk, goals) == [("SUCCEEDED", None)] * len(goals)
    assert (talk.goal(first)["reason"], talk.goal(brief)["reason"]) == ("engine_crashed", "expired")
    assert talk.log.count("could not be started") == 1, talk.log


def test_an_engine_killed_again_during_its_restarts_costs_one_goal(scripted: Talk) -> None:
    talk = scripted
    with limits():
        first = start_goal(talk, "never-ends", number=1)
        goals = [send(talk, "length=0.01") for _ in range(WAITING)]
        talk.script_start("hang")  # so that the engine can be killed during each start
        (engine,) = usage.descendants(talk.pid)
        engine = _replaced(talk, engine)
        engine = _replaced(talk, engine, signal.SIGSEGV)
        talk.script_start("")
        killed = time.monotonic()
        os.kill(engine, signal.SIGKILL)
        speaking = talk.watcher.arrived(talk.watcher.wait_for_word(goals[0])) - killed
        assert _ends(talk, [first]) == [("ABORTED", "engine_crashed")]
        assert _ends(talk, goals) == [("SUCCEEDED", None)] * WAITING
        assert_within(speaking, SPEAKING, "the next goal after an engine was killed during its start")


@pytest.mark.parametrize("driver", ["parrot", "nsss"])
def test_an_unknown_driver_stops_the_server_at_start(tmp_path: Path, driver: str) -> None:
    path = str(tmp_path / "s")
    done = run([*SERVE, "--socket", path, "--driver", driver], environment(str(tmp_path)))
    assert done.code == 2
    (error,) = done.err.splitlines()
    assert error.startswith("talk: "), error
    assert f'"{driver}"' in error, error
    assert not os.path.exists(path)


def test_a_server_waiting_for_its_engine_can_be_stopped(make_talk: MakeTalk) -> None:
    talk = make_talk("--voice", "en", scripted=True, env={"SCRIPTED_START": "hang"})
    with limits():
        started_at = time.monotonic()
        talk.stop()
        assert_within(time.monotonic() - started_at, 1, "the end of a server whose engine hangs while it starts")
    assert "ready on" not in talk.log
