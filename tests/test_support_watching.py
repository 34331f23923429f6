"""Raw connection, watcher, search for leftovers, shown without a server of talk's."""

from __future__ import annotations

import contextlib
import glob
import json
import os
import socket
import subprocess
import sys
import threading
import uuid
from typing import TYPE_CHECKING

import pytest

from talkcli import paths
from tests.support.connection import Message, Wire
from tests.support.surroundings import (
    MARK,
    assert_none_left,
    clean_environment,
    dying_with_parent,
    marked,
    needs,
    needs_no_server,
    short_directory,
)
from tests.support.watcher import Watcher

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

GREETING: Message = {"talk": 1, "version": "0", "pid": 1, "boot": "test", "features": []}


class Server:
    """Greets one client, and says after each line of the client's what it was given to say."""

    def __init__(self, path: str, *answers: list[Message]) -> None:
        self.path = path
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(path)
        self._listener.listen()
        self._answers = answers
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        peer, _ = self._listener.accept()
        with peer, peer.makefile("rb") as lines:
            self._say(peer, [GREETING])
            for answer in self._answers:
                if not lines.readline():
                    return
                self._say(peer, answer)

    @staticmethod
    def _say(peer: socket.socket, messages: list[Message]) -> None:
        peer.sendall(b"".join(json.dumps(each).encode() + b"\n" for each in messages))

    def close(self) -> None:
        self._thread.join()
        self._listener.close()


@pytest.fixture
def serve() -> Iterator[Callable[..., Server]]:
    with contextlib.ExitStack() as stack:
        directory = stack.enter_context(short_directory())

        def make(*answers: list[Message]) -> Server:
            server = Server(f"{directory}/s", *answers)
            stack.callback(server.close)
            return server

        yield make


def event(goal_id: str, state: str, number: int) -> Message:
    return {"event": "state", "id": goal_id, "state": state, "n": number, "at": 0.0}


def watched(serve: Callable[..., Server], *states: tuple[str, str]) -> Watcher:
    """Return a watcher that has seen these states, and whose server has gone."""
    events: list[Message] = [event(goal_id, state, number) for number, (goal_id, state) in enumerate(states)]
    watcher = Watcher(serve([{"seq": 1, "ok": True}, *events]).path)
    watcher.wait_for_end()
    watcher.close()
    return watcher


def test_connection_tells_reply_items_and_events_apart(serve: Callable[..., Server]) -> None:
    reply = {"seq": 1, "ok": True}
    before = [event("a", "ACTIVE", 1), {"seq": 1, "pending": {"id": "b"}}]
    with Wire(serve([*before, reply, event("a", "SUCCEEDED", 2)]).path) as wire:
        assert wire.greeting == GREETING
        assert wire.request("status") == reply
        assert wire.items == before[1:]
        assert wire.receive_event("state", state="SUCCEEDED")["n"] == 2
        with pytest.raises(EOFError):
            wire.receive()


def test_connection_does_not_wait_for_ever(serve: Callable[..., Server]) -> None:
    server = serve([])
    with Wire(server.path) as wire:
        with pytest.raises(TimeoutError):
            wire.receive(0.05)
        assert not wire.closed_by_server(0.05)
        wire.send_raw(b"anything\n")
        assert wire.closed_by_server()


def test_watcher_sees_states_in_order(serve: Callable[..., Server]) -> None:
    watcher = watched(serve, ("a", "PENDING"), ("b", "PENDING"), ("a", "ACTIVE"), ("a", "SUCCEEDED"), ("b", "RECALLED"))
    assert watcher.states("a") == ["PENDING", "ACTIVE", "SUCCEEDED"]
    assert watcher.terminal_counts() == {"a": 1, "b": 1}
    assert watcher.wait_for(None, "PENDING")["id"] == "a"
    assert watcher.wait_for("b", "RECALLED")["n"] == 4
    assert watcher.wait_for_terminal("a") == "SUCCEEDED"
    assert watcher.arrived(watcher.events("a")[0]) <= watcher.arrived(watcher.events("b")[-1])
    with pytest.raises(AssertionError, match="connection ended"):
        watcher.wait_for("a", "ABORTED")
    watcher.check()


def test_watcher_waits_only_so_long(serve: Callable[..., Server]) -> None:
    watcher = Watcher(serve([{"seq": 1, "ok": True}], []).path)
    try:
        with pytest.raises(AssertionError, match="not within"):
            watcher.wait_for("a", "ACTIVE", 0.05)
    finally:
        watcher.close()


@pytest.mark.parametrize(
    ("states", "fault"),
    [
        ([("a", "ACTIVE")], "no terminal state"),
        ([("a", "ACTIVE"), ("a", "SUCCEEDED"), ("a", "SUCCEEDED")], "more than one terminal state"),
        ([("a", "ACTIVE"), ("a", "SUCCEEDED"), ("b", "RECALLED"), ("a", "ACTIVE")], "after the terminal state"),
    ],
)
def test_watcher_notices_a_broken_promise(
    serve: Callable[..., Server], states: list[tuple[str, str]], fault: str
) -> None:
    watcher = watched(serve, *states)
    with pytest.raises(AssertionError, match=fault):
        watcher.check()


def test_watcher_notices_numbers_that_do_not_grow(serve: Callable[..., Server]) -> None:
    watcher = Watcher(serve([{"seq": 1, "ok": True}, event("a", "ACTIVE", 2), event("a", "ABORTED", 2)]).path)
    watcher.wait_for_end()
    watcher.close()
    with pytest.raises(AssertionError, match="numbers"):
        watcher.check()


def test_a_goal_may_be_declared_unfinished_but_never_end_twice(serve: Callable[..., Server]) -> None:
    watcher = watched(serve, ("a", "ACTIVE"))
    watcher.check({"a"})
    watcher.check(unfinished=True)
    with pytest.raises(AssertionError):
        watcher.check({"b"})


def test_rejected_goals_use_no_id_up(serve: Callable[..., Server]) -> None:
    watched(serve, ("a", "REJECTED"), ("a", "PENDING"), ("a", "REJECTED"), ("a", "RECALLED"), ("a", "REJECTED")).check()


def test_what_is_left_running_is_found_and_killed() -> None:
    mark = uuid.uuid4().hex
    assert_none_left(mark, 0)
    script = "import subprocess, sys; subprocess.Popen([sys.executable, '-S', '-c', 'import time; time.sleep(60)'])"
    with short_directory() as home:
        subprocess.run([sys.executable, "-c", script], env=clean_environment(home, {MARK: mark}), check=True)
        (left,) = marked(mark)
        with pytest.raises(AssertionError, match=f"{left}: .*time.sleep"):
            assert_none_left(mark, 0.1)
        assert_none_left(mark, 2)


def test_a_process_dies_with_its_parent() -> None:
    mark = uuid.uuid4().hex
    sleeper = dying_with_parent([sys.executable, "-S", "-c", "print(flush=True); import time; time.sleep(60)"])
    script = f"import subprocess; subprocess.Popen({sleeper!r}, stdout=subprocess.PIPE).stdout.readline()"
    with short_directory() as home:
        subprocess.run([sys.executable, "-c", script], env=clean_environment(home, {MARK: mark}), check=True)
    assert_none_left(mark, 2)


def test_a_missing_program_skips_but_fails_in_ci(monkeypatch: pytest.MonkeyPatch) -> None:
    needs("sh")
    monkeypatch.delenv("CI", raising=False)
    with pytest.raises(pytest.skip.Exception, match="no-such-program"):
        needs("sh", "no-such-program")
    monkeypatch.setenv("CI", "true")
    with pytest.raises(pytest.fail.Exception, match="no-such-program"):
        needs("no-such-program")


def test_a_server_where_clients_look_skips_but_fails_in_ci(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CI", raising=False)
    monkeypatch.setattr(glob, "glob", lambda _: [])
    with short_directory() as home, socket.socket(socket.AF_UNIX) as server:
        path = f"{home}/s"
        monkeypatch.setattr(paths, "client_sockets", lambda _: [f"{home}/there is none", path])
        needs_no_server()
        server.bind(path)
        with pytest.raises(pytest.skip.Exception, match=f"{path}: nobody answers: left over"):
            needs_no_server()
        server.listen(0)
        with pytest.raises(pytest.skip.Exception, match=f"{path}: there is one"):
            needs_no_server()
        with pytest.raises(pytest.skip.Exception, match=f"{path}: Resource temporarily unavailable"):
            needs_no_server()  # it hangs, and has no room for another
        monkeypatch.setenv("CI", "true")
        with pytest.raises(pytest.fail.Exception, match=path):
            needs_no_server()


def test_directories_are_short_private_and_removed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", "/" + "x" * 60)
    with short_directory() as path:
        assert len(path) < 40
        assert os.stat(path).st_mode & 0o777 == 0o700
    assert not os.path.exists(path)


def test_nothing_of_the_users_leaks_into_a_child(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("XDG_RUNTIME_DIR", "TALK_SOCKET", "TALK_RATE", "PULSE_SERVER", "NO_COLOR"):
        monkeypatch.setenv(name, "theirs")
    environment = clean_environment("/home", {"EXTRA": "1"})
    assert "theirs" not in environment.values()
    assert environment["EXTRA"] == "1"
