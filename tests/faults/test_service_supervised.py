"""A supervisor is told READY, STATUS, WATCHDOG from the event loop alone, and STOPPING."""

from __future__ import annotations

import os
import signal
import sys
import time
import uuid
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from talkcli.daemon.systemd import RETRY_AFTER, STATUS_AFTER
from tests.conformance.bareserve import SERVE, BareServe, environment, serving
from tests.faults.broken import write
from tests.faults.supervisor import Supervisor
from tests.support import processes
from tests.support.connection import Wire
from tests.support.surroundings import short_directory
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from tests.conftest import MakeTalk

SCRIPTED = [SERVE[0], processes.SCRIPTED]


def supervised(home: str, supervisor: Supervisor, **extra: str) -> dict[str, str]:
    return environment(home, TALK_SOCKET=f"{home}/s", NOTIFY_SOCKET=supervisor.address, **extra)


def test_supervisor_is_told_of_begin_doings_and_end(home: str) -> None:
    with Supervisor(f"{home}/n") as supervisor, serving(supervised(home, supervisor), command=SCRIPTED) as server:
        ready = supervisor.wait_for("READY", "1")
        with Wire(f"{home}/s") as wire:  # it was told no earlier than clients are served
            assert wire.greeting["pid"] == server.process.pid
            supervisor.wait_for("STATUS", "idle; ", since=ready)
            goal = wire.request("say", text="never-ends a secret")["goal"]
            wire.request("say", text="another")
            supervisor.wait_for("STATUS", f"speaking {goal['id']}, 1 waiting")
            wire.request("pause")
            supervisor.wait_for("STATUS", "paused, 1 waiting")
            wire.request("resume")
            wire.request("cancel")
            supervisor.wait_for("STATUS", "idle; ", since=supervisor.told[-1][2])
        assert server.end(signal.SIGTERM) == 0
        supervisor.wait_for("STOPPING", "1")
        supervisor.drain()
    told = [name for name, _, _ in supervisor.told]
    assert (told.count("READY"), told.count("STOPPING"), told.count("WATCHDOG")) == (1, 1, 0)
    assert "secret" not in str(supervisor.told)  # anybody may read a unit's status


def test_status_says_why_the_engine_cannot_start(home: str) -> None:
    write(Path(home, "start"), "fail=engine_failed")
    with Supervisor(f"{home}/n") as supervisor:
        env = supervised(home, supervisor, SCRIPTED_START_FILE=f"{home}/start")
        with serving(env, command=SCRIPTED):
            supervisor.wait_for("READY")  # it serves, and says what is wrong, instead of being started in a loop
            supervisor.wait_for("STATUS", "engine: ")
            os.unlink(f"{home}/start")
            supervisor.wait_for("STATUS", "idle; ")


def test_watchdog_is_fed_by_the_event_loop_and_not_by_the_loudspeaker(home: str) -> None:
    limit = 0.6
    with Supervisor(f"{home}/n") as supervisor:
        env = supervised(home, supervisor, WATCHDOG_USEC=str(int(limit * 1e6)))
        with serving(env, command=SCRIPTED) as server, Wire(f"{home}/s") as wire:
            first = supervisor.wait_for("WATCHDOG")
            second = supervisor.wait_for("WATCHDOG", since=first)
            assert limit / 3 - 0.05 <= second - first <= limit
            wire.request("say", text="hang")  # another watchdog looks after an engine that hangs
            began = time.monotonic()
            while (last := supervisor.wait_for("WATCHDOG", since=second)) < began + limit * 2:
                assert last - second <= limit
                second = last
            os.kill(server.process.pid, signal.SIGSTOP)
            try:
                time.sleep(0.01)
                supervisor.drain()
                assert not supervisor.hear(limit)  # an event loop that stands still feeds nothing
            finally:
                os.kill(server.process.pid, signal.SIGCONT)
            supervisor.wait_for("WATCHDOG", since=time.monotonic())


@pytest.mark.parametrize("extra", [{"WATCHDOG_USEC": "0"}, {"WATCHDOG_USEC": "200000", "WATCHDOG_PID": "1"}])
def test_watchdog_of_nobody_or_of_another_process_is_not_fed(home: str, extra: dict[str, str]) -> None:
    with Supervisor(f"{home}/n") as supervisor:
        with serving(supervised(home, supervisor, **extra), command=SCRIPTED) as server:
            supervisor.wait_for("STATUS", "idle; ")
            assert not supervisor.hear(0.3)
            assert server.end(signal.SIGTERM) == 0
        supervisor.drain()
    assert {name for name, _, _ in supervisor.told} == {"READY", "STATUS", "STOPPING"}


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux has abstract sockets")
def test_watchdog_that_watches_this_process_is_fed_at_an_abstract_address(home: str) -> None:
    with Supervisor(f"@talk-{uuid.uuid4().hex}") as supervisor:
        # The shell's process is the server's, as systemd's child is.
        command = ["sh", "-c", 'WATCHDOG_PID=$$ exec "$@"', "sh", *SCRIPTED]
        with serving(supervised(home, supervisor, WATCHDOG_USEC="500000"), command=command):
            supervisor.wait_for("WATCHDOG", since=supervisor.wait_for("WATCHDOG"))


@pytest.mark.parametrize("address", ["", "relative", "/nowhere/at/all"])
def test_supervisor_that_is_not_there_is_no_obstacle(home: str, address: str) -> None:
    env = environment(home, TALK_SOCKET=f"{home}/s", NOTIFY_SOCKET=address, WATCHDOG_USEC="100000")
    with serving(env, command=SCRIPTED) as server, Wire(f"{home}/s") as wire:
        wire.request("say", text="length=0", wait=True)
        assert wire.receive_event("result")["goal"]["state"] == "SUCCEEDED"
        if address.startswith("/"):
            time.sleep(RETRY_AFTER + 0.1)  # many signs of life, and another attempt
    assert server.log.count("NOTIFY_SOCKET") == (1 if address.startswith("/") else 0)


@limits()
def test_supervisor_that_reads_late_is_told_all_the_same_without_a_wait(home: str) -> None:
    with Supervisor(f"{home}/n") as supervisor:
        env = supervised(home, supervisor, WATCHDOG_USEC="100000")
        with serving(env, command=SCRIPTED) as server, Wire(f"{home}/s") as wire:
            supervisor.wait_for("STATUS", "idle; ")
            supervisor.fill()
            goal = wire.request("say", text="never-ends")["goal"]
            time.sleep(STATUS_AFTER + 0.2)  # its signs of life, and the news, find no room
            began = time.monotonic()
            wire.request("status")
            assert_within(time.monotonic() - began, 0.5, "`status`")
            supervisor.wait_for("STATUS", f"speaking {goal['id']}")
            supervisor.wait_for("WATCHDOG", since=time.monotonic())
            supervisor.fill()
            assert server.end(signal.SIGTERM) == 0


def test_engine_and_player_know_nothing_of_the_supervisor(make_talk: MakeTalk) -> None:
    with short_directory() as directory, Supervisor(f"{directory}/n") as supervisor:
        told = {"NOTIFY_SOCKET": supervisor.address, "WATCHDOG_USEC": "9000000", "LISTEN_FDNAMES": "talk"}
        seen = Path(directory, "environment")
        player = write(Path(directory, "player"), f"#!/bin/sh\nenv > {seen}\ncat >&2\n", 0o700)
        talk = make_talk("--player", str(player), env=told)
        talk.run("say", "--wait", "hello")
        inherited = {line.partition("=")[0] for line in seen.read_text().splitlines()}
        assert "PATH" in inherited
        assert not [each for each in inherited if each.startswith(("NOTIFY_", "WATCHDOG_", "LISTEN_"))]


def test_server_that_cannot_start_never_says_that_it_is_ready(home: str) -> None:
    with Supervisor(f"{home}/n") as supervisor, serving(environment(home, TALK_SOCKET=f"{home}/s"), command=SCRIPTED):
        second = BareServe(SCRIPTED, supervised(home, supervisor))
        try:
            assert not second.serves()
            assert second.end() == 11
        finally:
            second.close()
        assert not supervisor.hear(0.1)


@pytest.mark.slow
def test_idle_server_under_a_supervisor_wakes_less_than_once_a_second(home: str) -> None:
    with Supervisor(f"{home}/n") as supervisor:
        env = supervised(home, supervisor, WATCHDOG_USEC="30000000")
        with serving(env, command=SCRIPTED) as server:
            supervisor.wait_for("STATUS", "idle; ")
            before = switches(server.process.pid)
            time.sleep(4)
            assert switches(server.process.pid) - before < 4


def switches(pid: int) -> int:
    """Return how often the threads of a process were switched to and from."""
    total = 0
    for task in os.listdir(f"/proc/{pid}/task"):
        with open(f"/proc/{pid}/task/{task}/status", encoding="utf-8") as file:
            total += sum(int(line.split()[1]) for line in file if "ctxt_switches" in line)
    return total
