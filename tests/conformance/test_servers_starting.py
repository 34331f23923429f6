"""Only one server serves a socket, and ids don't survive a restart."""

from __future__ import annotations

import os
import signal
from typing import TYPE_CHECKING

from tests.conformance.bareserve import SERVE, TALK, BareServe, environment, run
from tests.support import processes
from tests.support.connection import Wire
from tests.support.surroundings import short_directory

if TYPE_CHECKING:
    from tests.support.processes import Talk


def test_row_45_of_two_servers_started_at_once_exactly_one_serves() -> None:
    scripted = [SERVE[0], processes.SCRIPTED]
    with short_directory() as home:
        env = environment(home, TALK_SOCKET=f"{home}/s")
        for attempt in range(5):
            servers = [BareServe(scripted, env) for _ in range(2)]
            try:
                assert sorted(server.serves() for server in servers) == [False, True], f"attempt {attempt}"
                loser, winner = sorted(servers, key=BareServe.serves)
                assert loser.end() == 11, loser.log
                assert f"(pid {winner.process.pid}) is already running at {home}/s;" in loser.log
                with Wire(f"{home}/s") as wire:
                    assert wire.greeting["pid"] == winner.process.pid
                assert winner.end(signal.SIGTERM) == 0, f"attempt {attempt}: {winner.log}"
                assert not os.path.exists(f"{home}/s")
            finally:
                for server in servers:
                    server.close()


def test_a_second_server_names_the_first_and_leaves_it_running(scripted: Talk) -> None:
    for options in ([], ["--socket", scripted.socket]):
        done = run([*TALK, "serve", *options], scripted.env)
        assert (done.code, done.out) == (11, "")
        assert f"pid {scripted.pid}" in done.err
    assert scripted.run("say", "--wait", "battery low").code == 0


def test_row_48_ids_from_before_a_restart_are_unknown(scripted: Talk) -> None:
    before = [scripted.run("say", "--wait", "length=0").id for _ in range(2)]
    scripted.stop()
    scripted.start_server()
    active, pending = (scripted.run("say", f"never-ends {name}").id for name in ("active", "pending"))
    scripted.watcher.wait_for_word(active)
    assert {goal_id.rpartition("-")[0] for goal_id in before} != {active.rpartition("-")[0]}
    for goal_id in before:
        for args in (["wait", goal_id], ["cancel", goal_id], ["cancel", "--before", goal_id], ["status", goal_id]):
            done = scripted.run(*args)
            assert (done.code, done.out) == (8, ""), done
    assert [scripted.goal(goal_id)["state"] for goal_id in (active, pending)] == ["ACTIVE", "PENDING"]
    assert scripted.run("say", "third").code == 0  # a later goal doesn't get an old id, either
    assert scripted.request("status")["server"]["pending"] == 2
    assert not set(before) & set(scripted.watcher.goals())
    assert len(scripted.run("cancel").out.split()) == 3
