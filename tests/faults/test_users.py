"""Several users on one machine: which users are admitted, and what they can do."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import stat
import subprocess
import sys
from typing import TYPE_CHECKING, Any

import click
import pytest

import talkcli
from tests.conformance.bareserve import TALK, environment, run, serving
from tests.faults.test_service_units import SCRIPTED
from tests.support.connection import Wire
from tests.support.surroundings import needs

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

NOBODY = 65534
#: The group of the server and of some strangers.
GROUP = 4242
#: A client for users who may not be able to read this checkout or its interpreter. It sends lines and prints replies.
STRANGER = r"""
import socket, sys
s = socket.socket(socket.AF_UNIX)
s.settimeout(5)
try:
    s.connect(sys.argv[1])
except OSError as error:
    sys.exit(type(error).__name__)
try:
    for line in sys.argv[2:]:
        s.sendall(line.encode() + b"\n")
    s.shutdown(socket.SHUT_WR)
except OSError:
    pass  # already closed, with the reason
try:
    while data := s.recv(65536):
        sys.stdout.buffer.write(data)
except ConnectionResetError:
    pass  # closed without reading the request
"""
#: A server of another user, with the greeting of a talk server.
IMPOSTOR = r"""
import os, socket, sys
s = socket.socket(socket.AF_UNIX)
s.bind(sys.argv[1])
os.chmod(sys.argv[1], 0o666)
s.listen()
print(flush=True)
while True:
    client, _ = s.accept()
    try:
        client.sendall(b'{"talk": 1, "version": "0", "pid": 1, "boot": "evil", "features": []}\n')
        print(client.recv(65536), flush=True)
    except (BrokenPipeError, ConnectionResetError):
        print(b"", flush=True)
    client.close()
"""
PYTHON = "/usr/bin/python3" if os.path.exists("/usr/bin/python3") else sys.executable

pytestmark = [
    pytest.mark.skipif(
        os.getuid() != 0 or shutil.which("setpriv") is None, reason="only root can act as other users (and setpriv)"
    ),
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs users, groups and sockets of Linux"),
]


def as_user(uid: int, *groups: int) -> list[str]:
    member = [f"--groups={','.join(map(str, groups))}"] if groups else ["--clear-groups"]
    return ["setpriv", f"--reuid={uid}", f"--regid={uid}", *member]


def stranger(path: str, *requests: dict[str, object], groups: Sequence[int] = ()) -> subprocess.CompletedProcess[str]:
    command = [*as_user(NOBODY, *groups), PYTHON, "-c", STRANGER, path, *map(json.dumps, requests)]
    return subprocess.run(command, cwd="/", capture_output=True, text=True, timeout=20, check=False)


@contextlib.contextmanager
def impostor(path: str) -> Iterator[Callable[[], bytes]]:
    """Run another user's server; yield a function that waits for a client and returns its first bytes."""
    command = [*as_user(NOBODY), PYTHON, "-u", "-c", IMPOSTOR, path]
    with subprocess.Popen(command, cwd="/", stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout
            assert process.stdout.readline()
            yield process.stdout.readline
        finally:
            process.kill()


def copy_package(home: str) -> dict[str, str]:
    """Copy talk for users who may not be able to read this checkout, and return the environment for the copy."""
    needs("/usr/bin/python3")
    for package in (talkcli, click):
        folder = os.path.dirname(str(package.__file__))
        shutil.copytree(folder, f"{home}/lib/{package.__name__}", ignore=shutil.ignore_patterns("__pycache__"))
    subprocess.run(["chmod", "-R", "a+rX", f"{home}/lib"], check=True)
    return environment(home, PYTHONPATH=f"{home}/lib", PYTHONDONTWRITEBYTECODE="1")


def replies(done: subprocess.CompletedProcess[str]) -> list[dict[str, Any]]:
    assert not done.stderr, done
    return [json.loads(line) for line in done.stdout.splitlines()]


def group_server() -> list[str]:
    return ["setpriv", f"--regid={GROUP}", "--clear-groups", *SCRIPTED, "--socket-mode", "0660"]


def test_the_socket_mode_admits_only_members_of_the_group(home: str) -> None:
    """A member may cancel everyone's goals, and the log names the user."""
    path = f"{home}/s"
    with serving(environment(home, TALK_SOCKET=path), command=group_server()) as server, Wire(path) as wire:
        status = os.stat(path)
        assert (status.st_uid, status.st_gid, stat.S_IMODE(status.st_mode)) == (0, GROUP, 0o660)
        assert stranger(path).stderr.strip() == "PermissionError"
        assert stranger(path, groups=[4343]).stderr.strip() == "PermissionError"
        say = {"seq": 1, "request": "say", "text": "length=0", "wait": True}
        answers = replies(stranger(path, say, groups=[GROUP]))
        assert answers[-1]["goal"]["state"] == "SUCCEEDED"
        assert answers[-1]["goal"]["client"]["uid"] == NOBODY
        goal = wire.request("say", text="never-ends", wait=True)["goal"]
        wire.receive_event("state", state="ACTIVE")
        pending = wire.request("say", text="waits")["goal"]
        answers = replies(stranger(path, {"seq": 1, "request": "cancel"}, groups=[GROUP]))
        canceled = {answer["canceled"]["id"] for answer in answers if "canceled" in answer}
        assert canceled == {goal["id"], pending["id"]}
        ended = wire.receive_event("result")["goal"]
        assert (ended["state"], ended["by"]["client"]["uid"]) == ("PREEMPTED", NOBODY)
        others: list[dict[str, object]] = [{"request": "pause"}, {"request": "resume"}, {"request": "set", "rate": 150}]
        answers = replies(stranger(path, *({"seq": 1, **other} for other in others), groups=[GROUP]))
        assert [answer["ok"] for answer in answers if "ok" in answer] == [True] * 3
        assert server.end(signal.SIGTERM) == 0
    line = next(line for line in server.log.splitlines() if f"{goal['id']} PREEMPTED" in line)
    assert f"(canceled by uid {NOBODY}, pid " in line


def test_another_user_is_refused_even_if_the_socket_file_is_writable(home: str) -> None:
    path = f"{home}/s"
    with serving(environment(home, TALK_SOCKET=path), command=SCRIPTED) as server, Wire(path) as wire:
        os.chmod(path, 0o666)  # the server has no --socket-mode that admits others
        (reply,) = replies(stranger(path, {"request": "say", "text": "somebody else"}))
        assert reply["error"] == "permission_denied"
        assert "--socket-mode" in reply["message"]
        wire.request("status")
        assert wire.items == []
    assert "somebody else" not in server.log


@pytest.mark.usefixtures("nobody_serves")
def test_a_client_trusts_another_users_server_only_if_it_was_named(home: str) -> None:
    os.makedirs(f"{home}/run/talk")
    os.chmod(f"{home}/run/talk", 0o777)
    path = f"{home}/run/talk/talk.sock"
    with impostor(path) as heard:
        env = environment(home, XDG_RUNTIME_DIR=f"{home}/run")
        done = run([*TALK, "say", "a secret"], env)
        assert done.code == 10, done
        assert f"belongs to uid {NOBODY}" in done.err
        assert heard() == b"b''\n"  # it closed the connection without sending anything
        run([*TALK, "--socket", path, "status"], env)
        assert b'"hello"' in heard()  # the user named it, and thus trusts it


@pytest.mark.usefixtures("nobody_serves")
def test_a_server_at_run_talk_is_trusted_whoever_runs_it(home: str) -> None:
    """The system service runs as neither root nor the client's user."""
    script = f"""
        set -e
        mount -t tmpfs tmpfs /run
        mkdir /run/talk; chown {NOBODY} /run/talk
        {" ".join(as_user(NOBODY))} {PYTHON} -u -c "$1" /run/talk/talk.sock > {home}/heard &
        while ! [ -s {home}/heard ]; do sleep 0.01; done
        shift
        "$@" || true
        kill $!
    """
    needs("unshare", "mount")
    command = ["unshare", "--mount", "sh", "-c", script, "sh", IMPOSTOR, *TALK, "status"]
    with open(f"{home}/heard", "w", encoding="utf-8"):
        os.chown(f"{home}/heard", NOBODY, NOBODY)
    done = run(command, environment(home))
    if "unshare" in done.err or "mount" in done.err:
        pytest.skip(f"root is not allowed to mount here: {done.err}")
    with open(f"{home}/heard", encoding="utf-8") as file:
        assert '"hello"' in file.read(), done


def test_a_users_server_admits_root_and_refuses_other_users(home: str) -> None:
    env = copy_package(home)
    os.mkdir(f"{home}/other")
    os.chown(f"{home}/other", 4141, 4141)
    path = f"{home}/other/s"
    command = [*as_user(4141), "/usr/bin/python3", "-m", "talkcli", "serve", "--player", "null"]
    with serving({**env, "TALK_SOCKET": path}, command=command):
        assert run([*TALK, "--socket", path, "status"], environment(home)).code == 0
        os.chmod(path, 0o666)
        (reply,) = replies(stranger(path, {"request": "status"}))
        assert reply["error"] == "permission_denied"
        assert "uid 4141; ask its owner to run" in reply["message"]
