"""The socket's path, which client and server must agree on in any environment, and the start of a server."""

from __future__ import annotations

import os
import tempfile
from typing import TYPE_CHECKING

import platformdirs
import pytest

from talkcli import paths
from tests.conformance.bareserve import TALK, environment, run, serving

if TYPE_CHECKING:
    from tests.conftest import MakeTalk


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
