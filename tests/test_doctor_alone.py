"""`talk doctor` without a server: it checks all the rest, and plays the sentence by its own engine process."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import click
import pytest

import talkcli
from talkcli.doctor import examine, sound
from talkcli.doctor.report import heard
from tests.conformance.bareserve import TALK, environment, serving
from tests.conformance.rawsocket import FakeServer
from tests.faults.broken import python_path, write
from tests.faults.test_users import NOBODY, as_user
from tests.support.compare import extent
from tests.support.processes import run_talk
from tests.support.surroundings import needs, short_directory

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from tests.support.sink import Sink

pytestmark = pytest.mark.usefixtures("nobody_serves")

#: Seconds in which the doctor ends, whatever it finds.
LIMIT = 60.0


@pytest.fixture
def home() -> Iterator[str]:
    with short_directory() as path:
        os.chmod(path, 0o755)
        os.mkdir(f"{path}/run", 0o700)
        yield path


def quick(home: str) -> dict[str, str]:
    """Return an environment without a server, in which the sentence goes to a file, which takes no time."""
    return environment(home, TALK_PLAYER=f"file:{home}/said.wav", TALK_SOCKET=f"{home}/s")


def doctor(env: Mapping[str, str], *options: str, command: Sequence[str] = ()) -> dict[str, dict[str, str]]:
    """Run the doctor, by another command if one is named, to its failure; return its findings by their checks."""
    words = ["--json", "doctor", *options]
    if command:
        done = subprocess.run(
            [*command, *words], env=dict(env), cwd="/", capture_output=True, text=True, timeout=LIMIT, check=False
        )
        code, out, err = done.returncode, done.stdout, done.stderr
    else:
        code, out, err = run_talk(words, env, LIMIT)
    assert (code, err) == (4, ""), out
    findings = [json.loads(line) for line in out.splitlines()]
    assert [findings[each]["check"] for each in (0, -1)] == ["python", "sentence"]
    return {each["check"]: each for each in findings}


def test_its_own_engine_is_heard_and_the_server_is_what_is_missing(home: str, sink: Sink) -> None:
    with sink.record() as recording:
        found = doctor(environment(home, **sink.env, TALK_SOCKET=f"{home}/s"))
        recording.wait_until_quiet(0.2)
    assert extent(recording.samples)
    assert {each["check"] for each in found.values() if each["state"] == "failed"} == {"socket"}
    assert found["socket"]["next"] == "unset TALK_SOCKET, or start a server there: talk serve"
    assert "by an engine of this command's own, pulse" in found["sentence"]["message"]
    assert "server" not in found


def test_without_any_sound_the_player_s_own_words_are_told(home: str) -> None:
    needs("aplay")
    found = doctor(environment(home, TALK_PLAYER="aplay", ALSA_CONFIG_PATH="/dev/null"))
    assert found["sentence"]["message"].startswith("ABORTED, audio_device: aplay: audio open error")
    assert found["sound server"]["state"] == "warning"
    assert "PULSE_SERVER" in found["sound server"]["message"]


def test_without_a_library_the_sentence_fails_as_the_engine_does(home: str, tmp_path: Path) -> None:
    write(tmp_path / "pyttsx3.py", "raise ModuleNotFoundError('No module named pyttsx3', name='pyttsx3')\n")
    found = doctor({**quick(home), **python_path(tmp_path)})
    assert (found["pyttsx3"]["state"], found["sentence"]["state"]) == ("failed", "failed")
    assert "pip install pyttsx3" in found["pyttsx3"]["next"]


def test_a_server_that_goes_away_is_named(home: str) -> None:
    greeting = b'{"talk": 1, "version": "0.1", "pid": 1, "boot": "abcd"}\n'
    with FakeServer(f"{home}/s", [greeting], closes=True):
        found = doctor(quick(home), "--silent")["server"]
    assert found["state"] == "failed"
    assert "went away" in found["message"]
    assert "start it again" in found["next"]


@pytest.mark.skipif(
    os.getuid() != 0 or shutil.which("setpriv") is None, reason="only root can act as other users (and setpriv)"
)
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


def test_programs_that_hang_delay_it_and_no_more(home: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("pactl", "aplay", "pw-cli"):
        write(Path(home, "run", name), "#!/bin/sh\nexec sleep 98\n", 0o755)
    env = environment(home, TALK_SOCKET=f"{home}/s")
    env["PATH"] = f"{home}/run:{env['PATH']}"
    monkeypatch.setattr(sound, "LIMIT", 0.3)
    monkeypatch.setattr(examine, "LIMIT", 0.6)
    for name in [each for each in os.environ if each not in env]:
        monkeypatch.delenv(name)
    for name, value in env.items():
        monkeypatch.setenv(name, value)
    began = time.monotonic()
    findings = list(examine.Examination(None, silent=False).findings())
    assert time.monotonic() - began < LIMIT / 2
    assert not heard(findings)
    found = {each.check: each.message for each in findings}
    assert "no answer within 0.3 s" in found["device"]
    assert "does not answer" in found["sound server"]


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
    done = subprocess.run(
        [sys.executable, "-c", code], env=quick(home), capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout == "[]False\n"
