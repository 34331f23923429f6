"""The start of a server, and the path of its socket, on which client and server must agree in any environment."""

from __future__ import annotations

import os
import signal
import tempfile
from typing import TYPE_CHECKING

import platformdirs
import pytest

from talkcli import paths
from tests.conformance.bareserve import SERVE, TALK, BareServe, environment, run, serving
from tests.support import processes
from tests.support.connection import Wire
from tests.support.surroundings import short_directory

if TYPE_CHECKING:
    from tests.conftest import MakeTalk
    from tests.support.processes import Talk


@pytest.mark.parametrize("times", [3, pytest.param(20, marks=pytest.mark.slow)])
def test_row_45_of_two_servers_started_at_once_exactly_one_serves(times: int) -> None:
    scripted = [SERVE[0], processes.SCRIPTED]
    with short_directory() as home:
        env = environment(home, TALK_SOCKET=f"{home}/s")
        for attempt in range(times):
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


@pytest.fixture
def home(home: str) -> str:
    os.mkdir(f"{home}/run", 0o700)
    return home


@pytest.mark.filterwarnings("ignore::platformdirs.RuntimeDirWarning")
@pytest.mark.parametrize(
    "variables",
    [*({"XDG_RUNTIME_DIR": name} for name in ("run", "gone", "")), {"TMPDIR": "run"}, {"TMP": "run"}, {"TMPDIR": ""}],
    ids=str,
)
def test_a_client_looks_where_platformdirs_puts_the_socket(
    home: str, monkeypatch: pytest.MonkeyPatch, variables: dict[str, str]
) -> None:
    for name in ("XDG_RUNTIME_DIR", "TMPDIR", "TEMP", "TMP"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value and f"{home}/{value}")
    monkeypatch.setattr(tempfile, "tempdir", None)  # so that it is determined again
    looked = paths.client_sockets(None)
    assert f"{platformdirs.PlatformDirs('talk', appauthor=False).user_runtime_dir}/talk.sock" in looked
    assert looked[-1] == "/run/talk/talk.sock"
    if variables.get("XDG_RUNTIME_DIR"):
        assert looked[0].startswith(home)


@pytest.mark.usefixtures("nobody_serves")
@pytest.mark.parametrize("runtime", ["run", "", None])
def test_a_client_finds_the_server_without_naming_a_socket(home: str, runtime: str | None) -> None:
    env = environment(home) if runtime is None else environment(home, XDG_RUNTIME_DIR=runtime and f"{home}/{runtime}")
    if not runtime and os.path.isdir(f"/run/user/{os.getuid()}"):
        pytest.skip("this user has a runtime directory, which would be used")
    with serving(env, "--rate", "450") as server:
        assert f"ready on {home}/" in server.log
        assert run([*TALK, "say", "--wait", "hi"], env).code == 0
        second = run([*TALK, "serve", "--player", "null"], env)
        assert second.code == 11
        assert f"pid {server.process.pid}" in second.err
        if runtime:
            # Without that variable, as under cron or ssh, the client doesn't find the server.
            assert run([*TALK, "status"], environment(home)).code == 3
    assert run([*TALK, "status"], env).code == 3


@pytest.mark.usefixtures("nobody_serves")
def test_the_error_lists_every_path_in_search_order(home: str) -> None:
    os.makedirs(f"{home}/run/talk", 0o700)
    done = run([*TALK, "status"], environment(home, XDG_RUNTIME_DIR=f"{home}/run"))
    places = [line.strip().partition(": ")[0] for line in done.err.splitlines() if line.startswith("  ")]
    uid = os.getuid()
    assert places[:2] == [f"{home}/run/talk/talk.sock", f"/run/user/{uid}/talk/talk.sock"]
    assert places[-1] == "/run/talk/talk.sock"
    assert f"{home}/runtime-{uid}/talk/talk.sock" in places
    assert done.code == 3


@pytest.mark.usefixtures("nobody_serves")
def test_the_system_service_serves_in_its_runtime_directory(home: str) -> None:
    with serving(environment(home, RUNTIME_DIRECTORY=f"{home}/run")) as server:
        assert f"ready on {home}/run/talk.sock" in server.log


def test_the_greeting_is_spoken_at_the_start(make_talk: MakeTalk) -> None:
    talk = make_talk("--greeting", "length=0 at your service", scripted=True, watched=False)
    with talk.connect() as wire:
        goal_id = f"{wire.greeting['boot']}-1"
        assert wire.request("wait", ids=[goal_id])["ok"]
        goal = wire.receive_event("result")["goal"]
    assert (goal["state"], goal["text"]) == ("SUCCEEDED", "length=0 at your service")
    assert goal["client"]["pid"] == talk.pid
