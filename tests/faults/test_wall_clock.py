"""The wall clock of the server jumps by an hour, there and back: no timer, `--ttl` or `--throttle` moves.

The server runs with a `time.time` that adds the number in a file; all its other clocks are the machine's.
"""

from __future__ import annotations

import os
import time
from typing import TYPE_CHECKING

import pytest

from tests.faults.broken import python_path, write

if TYPE_CHECKING:
    from pathlib import Path

    from tests.conftest import MakeTalk

HOUR = 3600
#: Seconds by which a timer may be late on a busy machine.
LATE = 1.0
#: Python runs this at its start.
SITE_CUSTOMIZE = """
import time
_real = time.time
def _jumped():
    with open({offset!r}) as file:
        return _real() + float(file.read())
time.time = _jumped
"""


@pytest.mark.parametrize("seconds", [HOUR, -HOUR])
def test_no_timer_and_no_throttle_moves_when_the_wall_clock_jumps(
    make_talk: MakeTalk, tmp_path: Path, seconds: int
) -> None:
    offset = write(tmp_path / "offset", "0")
    write(tmp_path / "sitecustomize.py", SITE_CUSTOMIZE.format(offset=str(offset)))
    talk = make_talk(scripted=True, env=python_path(tmp_path))
    assert talk.run("say", "--wait", "length=0.05 battery low").code == 0
    said = time.monotonic()
    active = talk.run("say", "never-ends").id
    talk.watcher.wait_for_word(active)
    began = time.monotonic()
    with talk.connect() as wire:
        short = wire.request("say", text="one", ttl=1)["goal"]["id"]
        long = wire.request("say", text="two", ttl=20)["goal"]["id"]
    os.replace(write(tmp_path / "new", str(seconds)), offset)
    jumped = talk.request("say", text="")["goal"]
    assert abs(jumped["queued_at"] - time.time() - seconds) < 60, "it did not jump, so nothing is tested"
    refused = talk.request("say", text="length=0.05 battery low", throttle=60)["goal"]
    assert (refused["state"], refused["reason"]) == ("REJECTED", "throttled")
    assert talk.watcher.wait_for_terminal(short, 10) == "RECALLED"
    assert 1 - 0.05 <= time.monotonic() - began <= 1 + LATE
    assert talk.goal(long)["state"] == "PENDING"
    assert talk.request("status")["server"]["uptime"] < 60
    throttle = time.monotonic() - said - 0.1
    assert talk.request("say", text="length=0.05 battery low", throttle=throttle)["goal"]["state"] == "PENDING"
    os.replace(write(tmp_path / "new", "0"), offset)
    assert talk.run("cancel").code == 0
    talk.stop()
