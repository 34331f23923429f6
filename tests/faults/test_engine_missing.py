"""The engine cannot start, as pyttsx3 or libespeak-ng is missing: goals end at once, until it is installed.

A module or a library in the environment of a real server shadows the installed one.
"""

from __future__ import annotations

import itertools
import os
import time
from typing import TYPE_CHECKING

import espeakng_loader
import pytest

from talkcli.engine.supervisor import BACK_OFF
from tests.conformance.hearing import LOW, assert_aborted, send
from tests.faults.broken import assert_answers, heard_again, python_path, told, write
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from pathlib import Path

    from tests.conftest import MakeTalk
    from tests.support.processes import Talk
    from tests.support.sink import Sink

#: Seconds in which a goal is ABORTED that waits for nothing.
AT_ONCE = 0.1
#: Seconds that a start takes on a busy machine, above the wait before it.
START = 1.0

#: A module that cannot be imported; each attempt leaves a line with its time.
MISSING = """
import time
with open({attempts!r}, "a") as file:
    file.write(f"{{time.monotonic()}}\\n")
raise ModuleNotFoundError("No module named " + repr(__name__), name=__name__)
"""
#: The wheel without its data.
EMPTY = """
def get_library_path():
    return {real!r} + "/libespeak-ng.so"
def get_data_path():
    return "{empty}"
"""
WHEEL = os.path.dirname(espeakng_loader.__file__)
#: What else is missing: the module in the place of the wheel, and the words that say what to install.
WITHOUT = {
    "wheel": (MISSING, "libespeak-ng is missing ("),
    "data": (EMPTY, "there is no espeak-ng data: sudo apt-get install -y libespeak-ng1 espeak-ng-data"),
}


@pytest.mark.slow
def test_without_pyttsx3_goals_end_at_once_and_it_is_tried_again_at_longer_and_longer_intervals(
    make_talk: MakeTalk, sink: Sink, tmp_path: Path
) -> None:
    attempts = tmp_path / "attempts"

    with limits():
        attempts.write_text("")
        shadow = write(tmp_path / "pyttsx3.py", MISSING.format(attempts=str(attempts)))
        talk = make_talk(sink=sink, env=python_path(tmp_path))
        _await_attempts(attempts, 2)
        took = _assert_aborted_at_once(talk, "pyttsx3 is missing (")
        times = _await_attempts(attempts, len(BACK_OFF))
        assert_answers(talk)
        shadow.unlink()
        back = time.monotonic()
        _await_ready(talk)
        told("ready again after pyttsx3 is there", time.monotonic() - back)
        heard_again(talk, sink)
        assert talk.log.count("pyttsx3 is missing") == 3, f"once for the engine, once for each goal: {talk.log}"
        talk.stop()
        assert len(_times(attempts)) == len(BACK_OFF), "it was tried more often than it should have been"
        assert_within(took, AT_ONCE, "the end of a goal without an engine")
        for (first, second), wait in zip(itertools.pairwise(times), BACK_OFF, strict=False):
            assert second - first >= wait
            assert_within(second - first, wait + START, f"the start after {wait} s")
        assert_within(time.monotonic() - back, BACK_OFF[-1] + START + 2, "speaking again")


@pytest.mark.parametrize("what", WITHOUT)
def test_without_libespeak_ng_or_its_data_goals_end_at_once_until_it_is_installed(
    make_talk: MakeTalk, sink: Sink, tmp_path: Path, what: str
) -> None:
    wheel, words = WITHOUT[what]
    module = wheel.format(attempts=str(tmp_path / "attempts"), real=WHEEL, empty=tmp_path)
    write(tmp_path / "espeakng_loader.py", module)
    library = tmp_path / "libespeak-ng.so.1"

    with limits():
        library.write_bytes(b"no library")
        talk = make_talk(sink=sink, env={**python_path(tmp_path), "LD_LIBRARY_PATH": str(tmp_path)})
        took = _assert_aborted_at_once(talk, words)
        library.unlink()
        _await_ready(talk)
        heard_again(talk, sink)
        talk.stop()
        assert_within(took, AT_ONCE, "the end of a goal without an engine")


def _assert_aborted_at_once(talk: Talk, words: str) -> float:
    """Assert that goals are ABORTED, and say what to install; return after how many seconds one is."""
    done = talk.run("say", "--wait", "--", LOW)
    assert done.code == 4
    assert words in done.err
    asked = time.monotonic()
    goal_id = send(talk, LOW)
    ended = talk.watcher.arrived(talk.watcher.wait_for(goal_id, "ABORTED"))
    for each in (done.id, goal_id):
        goal = talk.goal(each)
        assert_aborted(goal, "engine_failed", words)
        assert goal["spoken"] == ""
    return ended - asked


def _await_attempts(path: Path, count: int) -> list[float]:
    end = time.monotonic() + sum(BACK_OFF) + 5
    while len(times := _times(path)) < count:
        assert time.monotonic() < end, f"{len(times)} starts"
        time.sleep(0.01)  # another process writes it
    return times


def _times(path: Path) -> list[float]:
    return [float(line) for line in path.read_text().splitlines()]


def _await_ready(talk: Talk) -> None:
    end = time.monotonic() + BACK_OFF[-1] + 5
    while talk.request("status")["server"]["engine"] != "ready":
        assert time.monotonic() < end, talk.log
        time.sleep(0.05)  # it publishes nothing when it is ready
