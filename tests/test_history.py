"""`talk serve --history`: goals from before a restart, faults of the file, and what is stored."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import random
import sqlite3
import subprocess
import sys
import threading
import time
from typing import TYPE_CHECKING, Any

import pytest

from talkcli import paths
from talkcli.cli.log import HISTORY_FAILED, log
from talkcli.cli.show import CommonOptions
from talkcli.errors import RequestRefused, ServerUnavailable
from talkcli.goals.goal import Goal
from talkcli.goals.options import Log
from talkcli.goals.states import State
from talkcli.history import file
from talkcli.history.file import HistoryError, HistoryWriter
from talkcli.history.rows import to_row
from talkcli.server import history
from talkcli.server.connection import PendingRequest
from tests.faults.test_surroundings import fill, mounted
from tests.support.surroundings import clean_environment

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tests.conftest import MakeTalk
    from tests.support.processes import Talk


def state(talk: Talk) -> dict[str, object]:
    """Return the state of a server's history."""
    found: dict[str, object] = talk.request("status")["server"]["history"]
    return found


def await_state(talk: Talk, meets: Callable[[dict[str, object]], object]) -> None:
    """Wait until the state of a server's history meets a condition. No event reports this."""
    end = time.monotonic() + 15
    while not meets(state(talk)):
        assert time.monotonic() < end, state(talk)
        time.sleep(0.02)


def await_written(talk: Talk) -> None:
    await_state(talk, lambda found: found["unwritten"] == 0 and found["error"] is None)


def stored_files(directory: str) -> bytes:
    """Return the content of all files in a directory and its subdirectories."""
    paths = [os.path.join(folder, name) for folder, _, names in os.walk(directory) for name in names]
    content = b""
    for path in paths:
        with open(path, "rb") as file:
            content += file.read()
    return content


@pytest.fixture
def kept(make_talk: MakeTalk, tmp_path: Path) -> Talk:
    """A server with a history in the state directory."""
    return make_talk("--history", scripted=True, env={"XDG_STATE_HOME": str(tmp_path)})


def test_goals_from_before_a_restart_are_shown_with_and_without_a_server(kept: Talk, tmp_path: Path) -> None:
    first = kept.run("say", "--wait", "--as", "patrol", "--key", "door", "length=0 door open").id
    failed = kept.run("say", "--wait", "fail=audio_lost").id
    shown = {goal_id: kept.goal(goal_id) for goal_id in (first, failed)}
    await_written(kept)
    kept.kill()
    without = kept.run("--json", "log")
    assert [json.loads(line) for line in without.out.splitlines()] == [*shown.values()]
    (path,) = [str(each) for each in (tmp_path / "talk").glob("*.db")]
    assert (without.code, without.err) == (
        0,
        f"talk: no server is running, so these goals come from the history {path}\n",
    )
    kept.start_server()
    last = kept.run("say", "--wait", "length=0").id  # not written yet
    assert [line.split()[2] for line in kept.run("log").out.splitlines()] == [first, failed, last.partition("-")[2]]
    assert [goal["id"] for goal in kept_goals(kept, history=False)] == [last]
    for filters, ids in (
        (["--as", "patrol"], [first]),
        (["--key", "door"], [first]),
        (["--state", "aborted"], [failed]),
        (["--grep", "door op"], [first]),
        (["--grep", "Door"], []),
        (["--since", "2h", "-n", "2"], [failed, last]),
        (["--until", "yesterday"], []),
    ):
        found = kept.run("--json", "log", *filters)
        assert (found.code, [json.loads(line)["id"] for line in found.out.splitlines()]) == (0, ids), filters
    for goal_id in (first, failed):
        assert kept.goal(goal_id) == shown[goal_id]
        assert f"id       {goal_id}" in kept.run("status", goal_id).out
        assert [kept.run(command, goal_id).code for command in ("wait", "cancel")] == [8, 8]  # row 48
    assert kept.run("status", "none").code == 8


def kept_goals(talk: Talk, **fields: object) -> list[dict[str, object]]:
    """Return the goals in the reply to `log`."""
    with talk.connect() as wire:
        reply = wire.request("log", **fields)  # type: ignore[arg-type]
        assert reply["ok"], reply
        return [item["goal"] for item in wire.items]


def test_without_texts_only_the_memory_knows_them(make_talk: MakeTalk, tmp_path: Path) -> None:
    env = {"XDG_STATE_HOME": str(tmp_path)}
    talk = make_talk("--history", "no-text", scripted=True, env=env)
    spoken = talk.run("say", "--wait", "--key", "k", "length=0 secret").id
    failed = talk.run("say", "--wait", "fail=audio_lost message=secret secret").id
    await_written(talk)
    assert b"secret" not in stored_files(str(tmp_path))
    assert kept_goals(talk, history=True)[0]["text"] == "length=0 secret"
    assert [goal["id"] for goal in kept_goals(talk, history=True, grep="secret")] == [spoken, failed]
    talk.stop()
    talk.start_server()
    assert [(goal["id"], goal["text"]) for goal in kept_goals(talk, history=True)] == [(spoken, None), (failed, None)]
    assert kept_goals(talk, history=True, grep="secret") == []
    talk.stop()
    assert b"secret" not in stored_files(str(tmp_path))


def test_a_silent_player_stores_goals_only_in_a_named_file(make_talk: MakeTalk, tmp_path: Path) -> None:
    env = {"XDG_STATE_HOME": str(tmp_path)}
    unnamed = make_talk("--player", "null", "--history", env=env, watched=False)
    assert unnamed.request("status")["server"]["history"] is None
    assert os.listdir(tmp_path) == []
    assert "no history is kept, because the player null is silent" in unnamed.log
    named = make_talk("--player", "null", "--history", f"{tmp_path}/h.db", env=env, watched=False)
    named.request("say", text="")  # Before the first goal has ended, there may be no file.
    await_written(named)
    assert os.path.exists(tmp_path / "h.db")


def test_a_history_needs_sqlite(tmp_path: Path) -> None:
    code = "import sys; sys.modules['_sqlite3'] = None; from talkcli.cli import main; main()"
    env = clean_environment(str(tmp_path), {"TALK_SOCKET": f"{tmp_path}/s"})
    command = [sys.executable, "-c", code, "serve", "--player", "null", "--history", f"{tmp_path}/h.db"]
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=20, check=False)
    assert done.returncode == 2
    assert "talk: --history needs the module sqlite3, which this Python lacks" in done.stderr


def make_read_only(directory: str) -> None:
    subprocess.run(["mount", "-o", "remount,ro", directory], check=True)


@pytest.mark.parametrize(("spoil", "restarts"), [(fill, False), (make_read_only, True)])
def test_a_full_or_read_only_disk_is_reported_once_and_speech_goes_on(
    make_talk: MakeTalk, tmp_path: Path, spoil: Callable[[str], None], *, restarts: bool
) -> None:
    disk = f"{tmp_path}/disk"
    with mounted(disk, "size=300k"):
        talk = make_talk("--history", f"{disk}/h.db", scripted=True)
        ids = [talk.run("say", "--wait", "length=0").id]
        await_written(talk)
        if restarts:
            talk.stop()
            spoil(disk)
            talk.start_server()
        else:
            spoil(disk)
        ids.append(talk.run("say", "--wait", "length=0").id)
        await_state(talk, lambda found: found["error"])
        ids.append(talk.run("say", "--wait", "length=0").id)
        assert [goal["id"] for goal in kept_goals(talk, history=True)] == ids
        assert talk.log.count("can't write to") == 1
        assert talk.run("doctor", "--silent").out.count("can't write to") == 1
        talk.stop()


def test_a_removed_or_damaged_file_is_replaced_and_reported_once(make_talk: MakeTalk, tmp_path: Path) -> None:
    path = f"{tmp_path}/h.db"
    talk = make_talk("--history", path, scripted=True)
    talk.run("say", "--wait", "length=0")
    await_written(talk)
    os.unlink(path)
    second = talk.run("say", "--wait", "length=0").id
    await_state(talk, lambda found: found["replaced"])
    await_written(talk)
    assert [goal["id"] for goal in kept_goals(talk, history=True)] == [second]
    os.truncate(f"{path}-wal", 0)
    with open(path, "r+b") as damaged:
        damaged.write(b"garbage " * (os.stat(path).st_size // 8))
    assert talk.request("log", history=True)["error"]["code"] == HISTORY_FAILED
    shown = talk.run("log")  # while the file is damaged, or just after it was replaced
    assert (shown.code, "only goals since the server's start" in shown.err) == (0, "\n" in shown.err)
    await_state(talk, lambda found: "was damaged" in str(found["replaced"]))
    assert kept_goals(talk, history=True) == []
    assert os.path.exists(f"{path}.damaged")
    for words in ("was removed", "was damaged"):
        assert talk.log.count(words) == 1
    assert talk.run("doctor", "--silent").out.count("was damaged") == 1


@pytest.mark.parametrize("times", [1, pytest.param(10, marks=pytest.mark.slow)])
def test_a_killed_server_loses_at_most_two_seconds_of_its_history(
    make_talk: MakeTalk, tmp_path: Path, times: int
) -> None:
    path = f"{tmp_path}/h.db"
    talk = make_talk("--history", path, scripted=True, watched=False)
    for number in range(times):
        killed_at = time.monotonic() + random.uniform(1.1, 2.5)
        with talk.connect() as wire:
            while time.monotonic() < killed_at:
                last = wire.request("say", text="")["goal"]  # it is REJECTED, and so it has ended
        talk.kill()
        with contextlib.closing(sqlite3.connect(path)) as database:
            assert database.execute("PRAGMA integrity_check").fetchall() == [("ok",)], number
            newest = database.execute("SELECT ended_at FROM goals ORDER BY number DESC LIMIT 1").fetchone()[0]
        assert last["ended_at"] - newest < 2, number
        talk.start_server()


def test_replies_that_were_read_do_not_count_as_unread(make_talk: MakeTalk, tmp_path: Path) -> None:
    """Otherwise, the server would disconnect clients after 64 MiB."""
    talk = make_talk("--history", f"{tmp_path}/h.db", scripted=True, watched=False)
    with talk.connect() as wire:
        for _ in range(30):
            wire.request("say", text="\0" + "x" * 60_000)
        for _ in range(40):
            reply = wire.request("log", count=30, history=True)
            assert reply.get("count") == 30, reply


def test_the_newest_goals_are_kept_while_they_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(history, "MAX_UNWRITTEN_GOALS", 3)
    monkeypatch.setattr(history, "RETRY_AFTER_S", 0.01)
    directory, failures = tmp_path / "state", threading.Semaphore(0)
    write = HistoryWriter.write

    def count_failures(*arguments: Any) -> str | None:
        try:
            return write(*arguments)
        except HistoryError:
            failures.release()
            raise

    async def run() -> None:
        directory.touch()  # a file is in the way
        store = history.History(f"{directory}/h.db", with_text=True)
        for number in range(5):
            store.add(Goal(f"4k7f-{number}", State.SUCCEEDED, ended_at=time.time()))
        for _ in range(3):
            assert await asyncio.to_thread(failures.acquire, timeout=10)
        assert (store.describe()["unwritten"], store.describe()["dropped"]) == (3, 2)
        os.unlink(directory)
        store.close()

    monkeypatch.setattr(HistoryWriter, "write", count_failures)
    asyncio.run(run())
    assert capfd.readouterr().err.count("can't write to the history") == 1
    rows = file.search(f"{directory}/h.db", "1", [], 9, time.monotonic() + 9)
    assert [row[0] for row in rows] == ["4k7f-2", "4k7f-3", "4k7f-4"]


def test_a_search_fails_if_the_disk_does_not_respond_and_finds_unwritten_goals_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second search reads the file just after the goal was written."""
    goal = Goal("4k7f-1", State.SUCCEEDED, "door open", ended_at=time.time())
    responds = threading.Event()
    monkeypatch.setattr(history, "search", lambda *_: responds.wait(20) and [to_row(goal)])
    monkeypatch.setattr(history, "SEARCH_LIMIT_S", 0.1)

    async def search(store: history.History) -> object:
        answer = asyncio.get_running_loop().create_future()

        async def steps() -> None:
            try:
                answer.set_result(await store.search(pending, {}, 5))
            except RequestRefused as error:
                answer.set_result(error.code)

        pending = PendingRequest(None, 1, Log())  # type: ignore[arg-type]
        pending.start(steps())
        return await asyncio.wait_for(answer, 10)

    async def run() -> None:
        store = history.History(f"{tmp_path}/h.db", with_text=True)
        store.add(goal)
        assert await search(store) == HISTORY_FAILED
        responds.set()
        monkeypatch.setattr(history, "SEARCH_LIMIT_S", 10.0)
        assert await search(store) == [to_row(goal)]
        store.close()

    asyncio.run(run())
    assert b"door open" in stored_files(str(tmp_path))


@pytest.mark.parametrize("hidden", [False, True])
def test_a_history_of_another_user_is_named_with_its_owner(
    home: str, monkeypatch: pytest.MonkeyPatch, *, hidden: bool
) -> None:
    """The patches stand for another user's file, and for one in a directory that the user can't enter."""
    monkeypatch.setenv("XDG_STATE_HOME", home)
    path = paths.history_files(f"{home}/s")[0]
    HistoryWriter(path).write([])
    stat = os.stat

    def refuse(name: str, **options: Any) -> os.stat_result:
        if hidden and name == path:
            raise PermissionError
        return stat(name, **options)

    monkeypatch.setattr(os, "stat", refuse)
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(ServerUnavailable) as failed:
        log(CommonOptions(socket=f"{home}/s"), None, long=False)
    first, *_, last = str(failed.value).splitlines()
    assert first == "no server found; tried:"
    owner = stat("/").st_uid if hidden else os.getuid()
    assert last == f"the history {path} can't be read: the file belongs to uid {owner}"
