"""Paths: the socket of the user who called sudo, and histories."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from talkcli import paths

if TYPE_CHECKING:
    from pathlib import Path

    import pytest


def test_the_socket_of_the_user_who_called_sudo_is_named_only_if_it_exists(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    uid = os.getuid()
    monkeypatch.setattr(os, "getuid", lambda: 0)
    # A server of this user may be running in a real one of these directories.
    monkeypatch.setattr(paths, "_runtime_directories", lambda user: [f"{tmp_path}/runtime-{user}"])
    monkeypatch.setenv("SUDO_UID", str(uid))
    assert paths.sudo_caller_socket() is None
    socket = tmp_path / f"runtime-{uid}" / "talk" / paths.SOCKET_NAME
    socket.parent.mkdir(parents=True)
    socket.touch()
    assert paths.sudo_caller_socket() == str(socket)
    monkeypatch.setenv("SUDO_UID", str(uid + 1))
    socket.parent.parent.rename(tmp_path / f"runtime-{uid + 1}")
    assert paths.sudo_caller_socket() is None  # somebody else made it
    monkeypatch.delenv("SUDO_UID")
    assert paths.sudo_caller_socket() is None


def test_only_the_system_wide_socket_has_its_history_in_the_systems_directory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", "/state")
    monkeypatch.setattr(paths, "client_sockets", lambda _: ["/run/user/7/talk/talk.sock", paths.SYSTEM_SOCKET])
    user, system = "run-user-7-talk-talk.sock.db", "run-talk-talk.sock.db"
    assert paths.history_files(None) == [f"/state/talk/{user}", f"/state/talk/{system}", f"/var/lib/talk/{system}"]
