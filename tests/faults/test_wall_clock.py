"""The wall clock of the server jumps by an hour, there and back: no timer, `--ttl`, `--throttle` or timeout moves.

To set the machine's own clock is nobody's business here. So the server, a process of its own, runs with a `time.time`
that adds what a file says; all its other clocks are the machine's.
"""

from __future__ import annotations

import os
import time
from typing import TYPE_CHECKING

import pytest

from tests.support.surroundings import clean_environment, short_directory

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from tests.conftest import MakeTalk
    from tests.support.processes import Talk

    Clock = tuple[dict[str, str], Callable[[int], None]]

HOUR = 3600
#: Seconds by which a timer may be late on a busy machine.
LATE = 1.0

#: Python runs this at its start.
_SITE_CUSTOMIZE = """
import os, time

_real = time.time

def _jumped():
    with open(os.environ["TALK_TEST_CLOCK"]) as file:
        return _real() + float(file.read())

time.time = _jumped
"""


@pytest.fixture
def jump() -> Iterator[Clock]:
    """Give the environment of a server with a wall clock of its own, and what sets that clock by so many seconds."""
    with short_directory() as directory:
        offset = f"{directory}/offset"

        def set_to(seconds: int) -> None:
            with open(f"{offset}.new", "w", encoding="utf-8") as file:
                file.write(str(seconds))
            os.replace(f"{offset}.new", offset)

        set_to(0)
        with open(f"{directory}/sitecustomize.py", "w", encoding="utf-8") as file:
            file.write(_SITE_CUSTOMIZE)
        root = clean_environment(directory).get("PYTHONPATH")
        path = os.pathsep.join(each for each in (directory, root) if each)
        yield {"PYTHONPATH": path, "TALK_TEST_CLOCK": offset}, set_to


@pytest.mark.parametrize("hours", [1, -1])
def test_no_timer_moves_when_the_wall_clock_jumps(make_talk: MakeTalk, jump: Clock, hours: int) -> None:
    environment, set_to = jump
    talk = make_talk(scripted=True, env=environment)
    active = talk.run("say", "never-ends").id
    talk.watcher.wait_for_word(active)
    began = time.monotonic()
    with talk.connect() as wire:
        short = wire.request("say", text="one", ttl=1)["goal"]["id"]
        long = wire.request("say", text="two", ttl=20)["goal"]["id"]
    set_to(hours * HOUR)
    assert_jumped(talk, hours * HOUR)
    assert talk.watcher.wait_for_terminal(short, 10) == "RECALLED"
    assert 1 - 0.05 <= time.monotonic() - began <= 1 + LATE
    assert talk.goal(long)["state"] == "PENDING"
    assert talk.request("status")["server"]["uptime"] < 60
    set_to(0)
    assert talk.run("cancel").code == 0
    talk.stop()


@pytest.mark.parametrize("hours", [1, -1])
def test_throttle_counts_no_jump(make_talk: MakeTalk, jump: Clock, hours: int) -> None:
    environment, set_to = jump
    talk = make_talk(scripted=True, env=environment)
    assert talk.run("say", "--wait", "length=0.05 battery low").code == 0
    said = time.monotonic()
    set_to(hours * HOUR)
    assert_jumped(talk, hours * HOUR)
    refused = talk.request("say", text="length=0.05 battery low", throttle=60)["goal"]
    assert (refused["state"], refused["reason"]) == ("REJECTED", "throttled")
    time.sleep(max(0.0, said + 0.5 - time.monotonic()))  # that this much time passes is what is tested
    assert talk.request("say", text="length=0.05 battery low", throttle=0.4)["goal"]["state"] == "PENDING"
    set_to(0)
    talk.stop()


def assert_jumped(talk: Talk, seconds: int) -> None:
    """Assert that the server's wall clock has jumped: else nothing was tested."""
    goal = talk.request("say", text="")["goal"]
    assert abs(goal["queued_at"] - time.time() - seconds) < 60, goal
