"""Pauses that end with a connection or after a time. All rules are in `tests/unit/test_scheduler_order.py`."""

from __future__ import annotations

import json
import os
import signal
import statistics
import subprocess
import time
from typing import TYPE_CHECKING

from tests.conformance.rawsocket import Raw
from tests.support.patched_serve import patched_serve
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from pathlib import Path

    from tests.conftest import MakeTalk
    from tests.support.connection import Message
    from tests.support.processes import Talk

NULLS = {"paused": False, "paused_by": None, "paused_at": None, "paused_until": None}


def pause_state(talk: Talk) -> Message:
    server = talk.request("status")["server"]
    return {name: server[name] for name in NULLS}


def start_listener(talk: Talk, **fields: object) -> subprocess.Popen[bytes]:
    """Pause speech over a connection that only the returned process has, so that the pause lasts as long as it."""
    request = {"request": "pause", "while_connected": True, **fields}
    with Raw(talk.socket) as raw:
        raw.send(b'{"request": "hello", "name": "listener"}\n' + json.dumps(request).encode() + b"\n")
        assert raw.receive_lines(3)[2]["paused"] is True
        return subprocess.Popen(["sleep", "60"], pass_fds=[raw.socket.fileno()])


def await_change(talk: Talk, after: int = 0, *, paused: bool = False) -> Message:
    """Wait for an event about a pause with a higher number, and return it."""
    return talk.watcher.wait_until(
        lambda event: event["event"] == "paused" and event["n"] > after and event["paused"] is paused
    )


def test_speech_continues_soon_after_each_of_50_listeners_is_killed(scripted: Talk) -> None:
    goal_id, number, times = scripted.request("say", text="never-ends")["goal"]["id"], 0, []
    with limits():
        for _ in range(50):
            with start_listener(scripted) as listener:
                killed_at = time.monotonic()
                listener.kill()
                event = await_change(scripted, number)
            assert (event["id"], event["by"]["client"]["name"]) == (goal_id, "listener")
            number = event["n"]
            times.append(scripted.watcher.arrived(event) - killed_at)
        assert_within(statistics.median(times), 0.05, "the median time from the end of a listener to speech")
        assert_within(max(times), 0.2, "the longest time from the end of a listener to speech")
    assert scripted.goal(goal_id)["paused"] is False
    scripted.request("cancel")


def test_a_stopped_listener_pauses_speech_no_longer_than_its_limit(scripted: Talk) -> None:
    with start_listener(scripted) as listener:
        state = pause_state(scripted)
        assert (state["paused"], state["paused_by"]["client"]["name"]) == (True, "listener")
        assert state["paused_until"] - state["paused_at"] == 600
        listener.kill()
    resumed = await_change(scripted)
    with start_listener(scripted, seconds=0.3) as listener:
        listener.send_signal(signal.SIGSTOP)
        state = pause_state(scripted)
        assert await_change(scripted, resumed["n"])["at"] >= state["paused_until"]
        assert pause_state(scripted) == NULLS
        listener.kill()


def test_a_pause_ends_with_the_input_of_its_client(scripted: Talk) -> None:
    with scripted.connect() as client:
        client.request("pause", while_connected=True)
        client.half_close()
        await_change(scripted)


def test_the_log_tells_of_a_long_pause_and_of_its_end(make_talk: MakeTalk, tmp_path: Path) -> None:
    talk = make_talk(program=patched_serve(tmp_path, speech__goal_options__LONG_PAUSE_S=0.06))
    talk.request("pause", seconds=0.2)
    await_change(talk)
    lines = [line for line in talk.log.splitlines() if "pause" in line]
    warning = "talk: speech has been paused for 0.001 minutes, last by uid "
    paused, resumed = f"talk: paused by uid {os.getuid()}", "talk: resumed"
    assert [line.partition(",")[0] for line in lines[::2]] == [paused, resumed]
    assert lines[1].startswith(warning), lines
    assert lines[1].endswith("; to continue, run: talk resume")
