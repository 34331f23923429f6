"""`talk doctor` without a server that it could use: it looks at all the rest, and plays by an engine of its own."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import click
import espeakng_loader
import pytest

import talkcli
from talkcli.doctor import examine, sound
from talkcli.doctor.report import heard
from tests.conformance.bareserve import TALK, environment, serving
from tests.faults.broken import python_path, write
from tests.faults.test_users import NOBODY, as_user, impostor
from tests.support.compare import assert_silent, extent
from tests.support.processes import run_talk, start_talk
from tests.support.surroundings import needs, short_directory

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from tests.support.sink import Sink

pytestmark = pytest.mark.usefixtures("nobody_serves")

#: Seconds in which it ends, whatever it finds.
LIMIT = 60.0
USERS = pytest.mark.skipif(
    os.getuid() != 0 or shutil.which("setpriv") is None, reason="only root can act as other users (and setpriv)"
)


@pytest.fixture
def home() -> Iterator[str]:
    with short_directory() as path:
        os.chmod(path, 0o755)
        os.mkdir(f"{path}/run", 0o700)
        yield path


def quick(home: str, **extra: str) -> dict[str, str]:
    """Return an environment in which the sentence goes to a file, which takes no time, unlike null."""
    return environment(home, TALK_PLAYER=f"file:{home}/said.wav", **extra)


def doctor(
    env: Mapping[str, str], *options: str, command: Sequence[str] = TALK, code: int = 4
) -> dict[str, dict[str, str]]:
    """Run it, assert how it ends, and return its findings by their checks."""
    if command is TALK:
        status, out, err = run_talk(["--json", "doctor", *options], env, LIMIT)
        ended = (status, err)
    else:
        whole = [*command, "--json", "doctor", *options]
        done = subprocess.run(
            whole,
            env=dict(env),
            cwd="/",
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=LIMIT,
            check=False,
        )
        out, ended = done.stdout, (done.returncode, done.stderr)
    assert ended == (code, ""), (ended, out)
    findings = [json.loads(line) for line in out.splitlines()]
    for each in findings:
        assert list(each) == ["check", "state", "message", "next"]
    assert findings[0]["check"] == "python"
    assert findings[-1]["check"] == "sentence"
    return {each["check"]: each for each in findings}


def within(
    env: Mapping[str, str], monkeypatch: pytest.MonkeyPatch, *, silent: bool = False
) -> dict[str, dict[str, str]]:
    """Return what it finds in this process, whose limits a test can set, and assert that nobody would hear it."""
    for name in [each for each in os.environ if each not in env]:
        monkeypatch.delenv(name)
    for name, value in env.items():
        monkeypatch.setenv(name, value)
    found = list(examine.Examination(None, silent=silent).findings())
    assert not heard(found)
    return {each.check: json.loads(json.dumps(each.to_json())) for each in found}


def test_with_sound_and_no_server_its_own_engine_is_heard_and_the_server_is_what_is_missing(
    home: str, sink: Sink
) -> None:
    with sink.record() as recording:
        found = doctor(environment(home, **sink.env, TALK_SOCKET=f"{home}/s"))
        recording.wait_until_quiet(0.2)
    assert extent(recording.samples)
    assert {each["check"] for each in found.values() if each["state"] == "failed"} == {"socket"}
    assert found["socket"]["next"] == "unset TALK_SOCKET, or start a server there: talk serve"
    assert "by an engine of this command's own, pulse" in found["sentence"]["message"]
    assert "server" not in found


def test_silent_makes_no_sound_without_a_server_either(home: str, sink: Sink) -> None:
    with sink.record() as recording:
        found = doctor(environment(home, **sink.env, TALK_SOCKET=f"{home}/s"), "--silent")
        recording.wait_until_quiet(0.2)
    assert_silent(recording)
    assert found["sentence"]["state"] == "ok"


def test_without_any_sound_the_player_s_own_words_are_told(home: str) -> None:
    needs("aplay")
    found = doctor(environment(home, TALK_PLAYER="aplay", ALSA_CONFIG_PATH="/dev/null"))
    assert found["sentence"]["message"].startswith("ABORTED, audio_device: aplay: audio open error")
    assert found["sound server"]["state"] == "warning"
    assert "PULSE_SERVER" in found["sound server"]["message"]


def test_no_player_names_the_package(home: str) -> None:
    found = doctor(environment(home, PATH=f"{home}/run"))
    assert (found["player"]["state"], found["player"]["next"]) == ("failed", "sudo apt-get install -y alsa-utils")
    assert found["sentence"]["message"].startswith("ABORTED, no_player")


def test_no_server_names_each_place_and_how_to_start_one(home: str) -> None:
    found = doctor(environment(home, TALK_PLAYER="null", XDG_RUNTIME_DIR=f"{home}/run"))
    assert f"{home}/run/talk/talk.sock: not there" in found["socket"]["message"]
    assert "/run/talk/talk.sock: not there" in found["socket"]["message"]
    assert found["socket"]["next"] == "talk serve"
    assert f"XDG_RUNTIME_DIR is {home}/run" in found["session"]["message"]


def test_without_a_runtime_directory_it_says_so_and_looks_elsewhere(home: str) -> None:
    found = doctor(quick(home))
    assert "XDG_RUNTIME_DIR" in found["session"]["message"]
    assert f"{home}/runtime-{os.getuid()}/talk/talk.sock: not there" in found["socket"]["message"]


def test_a_runtime_directory_that_is_not_there_is_named(home: str) -> None:
    found = doctor(quick(home, XDG_RUNTIME_DIR=f"{home}/gone"))
    assert found["session"]["state"] == "warning"
    assert f"{home}/gone, which is not there" in found["session"]["message"]


def test_a_stale_socket_is_named_and_no_obstacle(home: str) -> None:
    os.mkdir(f"{home}/run/talk", 0o700)
    path = f"{home}/run/talk/talk.sock"
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(path)
    found = doctor(quick(home, XDG_RUNTIME_DIR=f"{home}/run"))
    assert f"{path}: nobody answers: left over from a server that ended" in found["socket"]["message"]
    assert found["socket"]["next"] == "talk serve (it takes the place of what was left over)"


def test_what_is_no_socket_is_told_from_one_that_was_left(home: str) -> None:
    os.mkdir(f"{home}/run/talk", 0o700)
    Path(f"{home}/file").touch()
    for extra, words, step in (
        (
            {"TALK_SOCKET": f"{home}/run"},
            "run: a directory, and",
            f"name the socket in it: TALK_SOCKET={home}/run/talk.s",
        ),
        ({"TALK_SOCKET": f"{home}/file"}, "file: a file, and no", "unset TALK_SOCKET, or name a socket"),
    ):
        found = doctor(quick(home, **extra))["socket"]
        assert words in found["message"]
        assert found["next"].startswith(step)
    Path(f"{home}/run/talk/talk.sock").touch()
    found = doctor(quick(home, XDG_RUNTIME_DIR=f"{home}/run"))["socket"]
    assert found["next"] == f"remove {home}/run/talk/talk.sock, and: talk serve"


@pytest.mark.parametrize(
    ("greeting", "check", "words", "step"),
    [
        ("220 mail ready", "socket", "is no talk server", "restart the server on"),
        ('{"talk": 2, "version": "9"}', "socket", "upgrade", "install the same talk on both sides"),
        ('{"talk": 1, "error": "permission_denied"}', "socket", "refuses", "--socket-mode 0660"),
        ('{"talk": 1, "version": "0.1", "pid": 1, "boot": "abcd"}', "server", "went away", "start it again"),
    ],
)
def test_what_answers_and_serves_nobody_is_named(home: str, greeting: str, check: str, words: str, step: str) -> None:
    with socket.socket(socket.AF_UNIX) as other:
        other.bind(f"{home}/s")
        other.listen()
        other.settimeout(20)
        process = start_talk(["--json", "doctor", "--silent"], quick(home, TALK_SOCKET=f"{home}/s"))
        client, _ = other.accept()
        client.sendall(f"{greeting}\n".encode())
        client.recv(65536)
        client.close()
        out, _ = process.communicate(timeout=LIMIT)
    assert process.wait() == 4
    found = {each["check"]: each for each in map(json.loads, out.splitlines())}
    assert found[check]["state"] == "failed"
    assert words in found[check]["message"]
    assert step in found[check]["next"]


def test_a_wrong_variable_is_told_from_the_server_that_runs_elsewhere(home: str) -> None:
    env = environment(home, XDG_RUNTIME_DIR=f"{home}/run")
    with serving(env):
        found = doctor({**quick(home), **env, "TALK_SOCKET": f"{home}/wrong"})
    assert f"named by TALK_SOCKET: {home}/wrong: not there" in found["socket"]["message"]
    assert found["socket"]["next"] == f"unset TALK_SOCKET: a server is on {home}/run/talk/talk.sock"


@USERS
def test_a_server_of_another_user_is_named_and_told_nothing(home: str) -> None:
    os.chmod(f"{home}/run", 0o755)
    os.mkdir(f"{home}/run/talk")
    os.chmod(f"{home}/run/talk", 0o777)
    path = f"{home}/run/talk/talk.sock"
    with impostor(path) as heard:
        found = doctor(quick(home, XDG_RUNTIME_DIR=f"{home}/run"))
        assert heard() == b"b''\n", "it hung up without a word"
    assert f"{path}: another user's server (uid {NOBODY})" in found["socket"]["message"]
    assert f"if you trust uid {NOBODY}: talk --socket {path} doctor" in found["socket"]["next"]


@USERS
def test_a_server_that_does_not_let_this_user_in_is_named(home: str) -> None:
    needs("/usr/bin/python3")  # theirs: they may be able to read neither this checkout nor its interpreter
    for package in (talkcli, click):
        folder = os.path.dirname(str(package.__file__))
        shutil.copytree(folder, f"{home}/lib/{package.__name__}", ignore=shutil.ignore_patterns("__pycache__"))
    subprocess.run(["chmod", "-R", "a+rX", f"{home}/lib"], check=True)
    ours = environment(home, TALK_SOCKET=f"{home}/s")
    with serving(ours):
        theirs = {**ours, "PYTHONPATH": f"{home}/lib", "PYTHONDONTWRITEBYTECODE": "1", "TALK_PLAYER": "null"}
        found = doctor(theirs, command=[*as_user(NOBODY), "/usr/bin/python3", "-m", "talkcli"])
    assert f"{home}/s: no permission (uid 0)" in found["socket"]["message"]
    assert "have uid 0 let you in" in found["socket"]["next"]


def test_a_missing_pyttsx3_is_named(home: str, tmp_path: Path) -> None:
    write(tmp_path / "pyttsx3.py", "raise ModuleNotFoundError('No module named pyttsx3', name='pyttsx3')\n")
    found = doctor(environment(home, TALK_SOCKET=f"{home}/s", **python_path(tmp_path)))
    assert (found["pyttsx3"]["state"], found["sentence"]["state"]) == ("failed", "failed")
    assert "pip install pyttsx3" in found["pyttsx3"]["next"]


@pytest.mark.parametrize(
    ("wheel", "words"),
    [
        ("raise ModuleNotFoundError('no wheel', name='espeakng_loader')", "libespeak-ng is missing"),
        (
            "get_library_path = lambda: {real!r} + '/libespeak-ng.so'\nget_data_path = lambda: '/gone'",
            "no espeak-ng data",
        ),
    ],
)
def test_a_missing_libespeak_ng_or_its_data_is_named(home: str, tmp_path: Path, wheel: str, words: str) -> None:
    real = os.path.dirname(espeakng_loader.__file__)
    write(tmp_path / "espeakng_loader.py", wheel.replace("{real!r}", repr(real)) + "\n")
    (tmp_path / "libespeak-ng.so.1").write_bytes(b"no library")
    env = environment(home, TALK_SOCKET=f"{home}/s", LD_LIBRARY_PATH=str(tmp_path), **python_path(tmp_path))
    found = doctor(env)
    assert found["libespeak-ng"]["state"] == "failed"
    assert words in found["libespeak-ng"]["message"]
    assert "apt-get install" in found["libespeak-ng"]["next"]


def test_a_library_that_crashes_is_survived_and_named(home: str, tmp_path: Path) -> None:
    write(tmp_path / "pyttsx3.py", "import os\nos.kill(os.getpid(), 11)\n")
    found = doctor(environment(home, TALK_SOCKET=f"{home}/s", **python_path(tmp_path)))
    assert found["libespeak-ng"]["state"] == "failed"
    assert "SIGSEGV" in found["libespeak-ng"]["message"]


def test_an_unknown_voice_is_named(home: str) -> None:
    found = doctor(environment(home, TALK_SOCKET=f"{home}/s", TALK_PLAYER="null", TALK_VOICE="klingon-7"))
    assert found["voices"]["state"] == "failed"
    assert 'unknown voice "klingon-7"' in found["voices"]["message"]


@pytest.mark.parametrize("limit", [0.3, pytest.param(sound.LIMIT, marks=pytest.mark.slow)])
def test_programs_that_hang_delay_it_and_no_more(home: str, monkeypatch: pytest.MonkeyPatch, limit: float) -> None:
    for name in ("pactl", "aplay", "pw-cli"):
        write(Path(home, "run", name), "#!/bin/sh\nexec sleep 98\n", 0o755)
    env = environment(home, TALK_SOCKET=f"{home}/s")
    env["PATH"] = f"{home}/run:{env['PATH']}"
    began = time.monotonic()
    if limit == sound.LIMIT:
        found = doctor(env)
    else:
        monkeypatch.setattr(sound, "LIMIT", limit)
        monkeypatch.setattr(examine, "LIMIT", 2 * limit)
        found = within(env, monkeypatch)
    assert time.monotonic() - began < LIMIT / 2
    assert f"no answer within {limit:g} s" in found["device"]["message"]
    assert "does not answer" in found["sound server"]["message"]


def test_a_signal_ends_it_and_its_engine(home: str) -> None:
    env = environment(home, TALK_SOCKET=f"{home}/s", TALK_PLAYER="sleep 97")
    with subprocess.Popen([*TALK, "doctor"], env=env, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        for line in process.stdout:
            if "socket" in line.split():
                break
        process.terminate()
        assert process.wait(10) == 128 + 15


def test_the_library_stays_out_of_its_own_process(home: str) -> None:
    code = (
        "import sys\nfrom talkcli.doctor.examine import Examination\n"
        "found = [each.check for each in Examination(None, silent=True).findings()]\n"
        "assert found[-1] == 'sentence'\n"
        "print([each for each in ('pyttsx3', 'espeakng_loader', 'asyncio') if each in sys.modules], end='')\n"
        "print('espeak' in open('/proc/self/maps').read() if sys.platform == 'linux' else False)\n"
    )
    env = quick(home, TALK_SOCKET=f"{home}/s")
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "[]False\n"
