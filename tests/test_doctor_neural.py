"""How `talk doctor` checks neural voices: their packages, their files, and the voice in use."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, cast

import pytest

from talkcli import Client, install
from talkcli.doctor import examine, voice
from talkcli.doctor.report import FAILURE, OK, WARNING
from talkcli.doctor.sound import UserSession
from talkcli.doctor.voice import EngineOptions, EngineReport, VoiceTrial
from talkcli.engine.protocol import Ready
from talkcli.install import NEURAL_PACKAGES
from talkcli.polling import Interrupted
from tests.conformance.bareserve import environment, serving
from tests.support import tiny_voice
from tests.support.surroundings import needs_packages
from tests.test_doctor import doctor, home

if TYPE_CHECKING:
    from talkcli.doctor.report import Finding

__all__ = ["home"]

#: Hides the voices of packages, so that only the test's voices are found.
WITHOUT_PACKAGES = """
import importlib, sys
from talkcli.engine import models
models._PACKAGE_SUFFIX = "no such package"
"""
TRIED = r"is in use: loaded in \d+\.\d s, speaks \d+\.\d times as fast as real time, uses \d+ MB"
LIMIT_S = 20.0


@pytest.fixture
def alone(home: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """Return an environment whose only neural voice is the tiny test voice."""
    needs_packages(*NEURAL_PACKAGES)
    monkeypatch.setattr("talkcli.engine.models._PACKAGE_SUFFIX", "no such package")
    tiny_voice.put(Path(home) / "v", "tiny")
    return _environment(home, tmp_path, WITHOUT_PACKAGES)


def _environment(home: str, tmp_path: Path, code: str) -> dict[str, str]:
    """Return an environment without a server, in which each Python process runs this code first."""
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(code)
    env = environment(home, TALK_SOCKET=f"{home}/s", TALK_VOICES=f"{home}/v", TALK_PLAYER=f"file:{home}/said.wav")
    return {**env, "PYTHONPATH": f"{tmp_path / 'site'}:{env.get('PYTHONPATH', '')}"}


def _found(used: str | None, env: dict[str, str], limit: float = LIMIT_S) -> dict[str, Finding]:
    """Return the findings about the voices in this environment, by name of the check."""
    findings = voice.check_neural(used, EngineOptions(env=env), limit, None)
    return {finding.check: finding for finding in findings}


def test_the_voice_in_use_is_loaded_and_timed(alone: dict[str, str]) -> None:
    checks = doctor({**alone, "TALK_VOICE": "piper/ti"})
    assert checks["neural"]["state"] == "ok"
    assert re.search(r"onnxruntime \d+\.\d+.*, numpy \d+\.\d+", checks["neural"]["message"])
    assert checks["voice files"]["state"] == "ok"
    assert checks["voice files"]["message"] == "the files of piper/tiny are complete and safe"
    assert checks["neural voice"]["state"] == "ok"
    assert re.match(f"piper/ti {TRIED}", checks["neural voice"]["message"]), checks
    assert list(checks)[3:8] == ["voices", "neural", "voice files", "neural voice", "session"]


def test_faulty_files_are_reported_one_by_one_with_the_next_step(alone: dict[str, str], home: str) -> None:
    place = Path(home) / "v"
    for name in ("a", "b", "c"):
        tiny_voice.put(place, name)
    (place / "a.onnx").chmod(0o666)
    (place / "a.onnx.json").chmod(0o666)
    (place / "b.onnx.json").unlink()
    (place / "c.onnx").unlink()
    (place / "c.onnx").symlink_to("nowhere")
    files = _found(None, alone)["voice files"]
    assert files.state == WARNING
    json, model = f"{place}/a.onnx.json", f"{place}/a.onnx"
    message = f"piper/a: {json} and {model} can be changed by other users, which is unsafe"
    assert files.message == f"{message}; also faulty: piper/b, piper/c"
    subprocess.run(["/bin/sh", "-c", str(files.next)], check=True)
    findings = _found(None, alone)
    assert findings["voice files"].message.startswith(f"piper/b: {place}/b.onnx.json does not exist")
    assert findings["voice files"].next == "download it from the source of the model"
    assert "neural voice" not in findings, "no voice is in use"


def test_the_fault_of_a_voice_that_cannot_speak_is_reported(alone: dict[str, str], home: str) -> None:
    tiny_voice.put(Path(home) / "v", "bad", b"no model")
    finding = _found("piper/bad", alone)["neural voice"]
    assert finding.state == FAILURE
    assert finding.message == f"piper/bad is in use: {home}/v/bad.onnx is not an ONNX model"
    assert finding.next == "download the voice again, from a source that you trust"


@pytest.mark.parametrize(
    ("code", "message", "step", "used"),
    [
        ("os.kill(os.getpid(), 4)", "it was killed by SIGILL", "this processor is too old", "piper/tiny"),
        ("raise ImportError('no libgomp.so.1')", "ImportError: no libgomp.so.1", "install it again", None),
    ],
)
def test_a_broken_package_is_reported(tmp_path: Path, code: str, message: str, step: str, used: str | None) -> None:
    needs_packages(*NEURAL_PACKAGES)
    package = f"import os\nassert os.environ['ORT_DISABLE_TELEMETRY'] == '1'\n{code}\n"
    (tmp_path / "onnxruntime.py").write_text(package)
    findings = _found(used, {**os.environ, "PYTHONPATH": str(tmp_path)})
    assert findings["neural"].state == (FAILURE if used else WARNING)
    assert re.match(f"onnxruntime .* cannot be imported: {re.escape(message)}$", findings["neural"].message)
    assert str(findings["neural"].next).startswith(step)
    assert "neural voice" not in findings


def test_a_slow_import_is_not_reported_as_a_broken_package(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    needs_packages(*NEURAL_PACKAGES)
    monkeypatch.setattr(voice, "_IMPORT_LIMIT_S", 0.2)
    (tmp_path / "onnxruntime.py").write_text("import time\ntime.sleep(60)\n")
    finding = _found(None, {**os.environ, "PYTHONPATH": str(tmp_path)}, 5.0)["neural"]
    assert (finding.state, finding.next) == (WARNING, "run talk doctor again when this machine is less busy")


def test_the_servers_voice_is_tried_in_the_servers_environment(alone: dict[str, str]) -> None:
    silent = {name: value for name, value in alone.items() if name != "TALK_PLAYER"}
    with serving(silent, "--voice", "piper/ti"), Client(alone["TALK_SOCKET"]) as client:
        limit = time.monotonic() + LIMIT_S
        while not re.search("loaded", str(client.status().server["neural_voices"])):
            assert time.monotonic() < limit
            time.sleep(0.02)
        # Only the server's environment names the directory of the voices.
        findings = doctor({name: value for name, value in silent.items() if name != "TALK_VOICES"}, "--silent")
    assert re.match(f"piper/tiny {TRIED}", findings["neural voice"]["message"]), findings


# Which voice is tried


HERE, SERVED = UserSession(0, "root"), UserSession(0, "root", server_pid=7)
UNKNOWN = EngineReport(reason="unknown_voice", message="x")


def started(voice: str | None = None, *voices: str, driver: str = "espeak") -> EngineReport:
    """Return the report of an engine. `voice` is the neural voice in its settings, and `voices` are all its voices."""
    return EngineReport(Ready(driver, None, None, voice), voices)


ESPEAK = started()


def test_only_the_voice_in_use_is_tried(home: str, monkeypatch: pytest.MonkeyPatch) -> None:
    tiny_voice.put(Path(home) / "v", "tiny")
    tried_voices: list[str | None] = []

    def check_neural(used: str | None, *_: object) -> list[Finding]:
        tried_voices.append(used)
        return []

    monkeypatch.setattr(voice, "check_neural", check_neural)

    def tried(used: str | None, engine: EngineReport, user: UserSession = HERE, **server: object) -> list[str | None]:
        env = {"TALK_VOICES": f"{home}/v"} if server.pop("installed", False) else {}
        examination = examine.LocalExamination(None, silent=True)
        if server:
            examination._client, examination._server = cast("Client", object()), {"voice": used, **server}
        else:
            monkeypatch.setenv("TALK_VOICE", used or "")
        examination._engine, examination._session, examination._env = engine, user, env
        tried_voices.clear()
        findings = list(examination._check_neural())
        assert not findings or findings[0].message == "the server's neural voices: piper/a"
        return [*tried_voices]

    assert tried(None, ESPEAK) == tried("de", ESPEAK) == []
    assert tried("piper/ti", started(driver="dummy"), driver="dummy") == []
    assert tried(None, started(None, "en", "piper/tiny")) == tried(None, ESPEAK, installed=True) == [None]
    assert tried("piper/ti", ESPEAK) == ["piper/ti"]
    assert tried("ti", started("piper/tiny")) == ["piper/tiny"]
    assert tried("tiny", UNKNOWN, installed=True) == ["tiny"]
    assert tried("none", UNKNOWN, installed=True) == [None]
    voices = {"piper/a": {"state": "loaded"}}
    assert tried(None, ESPEAK, neural_voices=voices) == [], "the server's files can't be examined"
    assert tried(None, ESPEAK, SERVED, neural_voices=voices) == [None]


def test_without_neural_voices_their_packages_are_not_imported() -> None:
    code = """
import sys
from talkcli.doctor import examine
examination = examine.LocalExamination(None, silent=True)
examination._env = {}
assert [*examination._check_neural()] == []
assert not {"onnxruntime", "numpy"} & {*sys.modules}, sys.modules.keys()
"""
    env = {**os.environ, "TALK_VOICE": "de"}
    subprocess.run([sys.executable, "-c", code], env=env, check=True, timeout=60)


# The trial of a voice


def test_the_trial_of_a_slow_voice_is_aborted(alone: dict[str, str]) -> None:
    finding = _found("piper/tiny", alone, 0.01)["neural voice"]
    assert finding.message == "piper/tiny is in use: loading and speaking took more than 0.01 s"


def test_a_voice_that_crashes_the_engine_process_is_reported(home: str, tmp_path: Path) -> None:
    needs_packages(*NEURAL_PACKAGES)
    tiny_voice.put(Path(home) / "v", "tiny")
    dies = (
        "from talkcli.engine.child.synthesizers import inference\nimport os\n"
        "inference.split_model = lambda _: os.abort()\n"
    )
    assert "SIGABRT" in _found("piper/tiny", _environment(home, tmp_path, dies))["neural voice"].message


def test_a_signal_ends_the_trial(alone: dict[str, str]) -> None:
    readable, writable = os.pipe()
    os.write(writable, b"x")
    options = EngineOptions(env=alone, interrupt={readable: 1})
    try:
        with pytest.raises(Interrupted):
            list(voice.check_neural("piper/tiny", options, LIMIT_S, None))
    finally:
        os.close(readable)
        os.close(writable)


# Findings


SERVER_VOICES = {"piper/a": {"state": "loaded", "why": None}, "piper/b": {"state": "failed", "why": "x is no model"}}


def test_the_servers_status_is_reported_if_voices_cannot_be_examined() -> None:
    (finding,) = voice.judge_server_voices(SERVER_VOICES)
    assert finding.state == WARNING
    assert finding.message == "the server cannot speak with the voice piper/b: x is no model"
    assert finding.next == "try to load the voice again: talk set --voice piper/b"
    (finding,) = voice.judge_server_voices({"piper/a": SERVER_VOICES["piper/a"]})
    assert (finding.state, finding.message) == (OK, "the server's neural voices: piper/a")
    assert voice.judge_server_voices({}) == []


def test_a_voice_that_fails_only_on_the_server_is_a_warning() -> None:
    trial = VoiceTrial(load_s=0.5, speed=9.0)
    assert voice.judge_trial("piper/b", trial, SERVER_VOICES).state == WARNING
    assert voice.judge_trial("piper/b", trial, {}).state == OK


def _judged(**tried: object) -> Finding:
    trial = VoiceTrial(**tried)  # type: ignore[arg-type]
    return voice.judge_trial("piper/a", trial, None)


def test_on_a_slow_machine_a_faster_voice_is_suggested() -> None:
    slow = _judged(load_s=3.04, speed=1.29, memory_bytes=250_400_000)
    assert slow.state == WARNING
    assert slow.message.startswith(
        "piper/a is in use: loaded in 3.0 s, speaks 1.3 times as fast as real time, uses 250 MB"
    )
    assert "the quality low" in (slow.next or "")
    assert _judged(load_s=3.04, speed=1.31).state == OK
    assert "MB" not in _judged(speed=2.0).message


def test_a_failed_voice_is_a_warning_if_the_server_falls_back_to_espeak(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(voice, "_find_package_fault", lambda _: ("onnxruntime is missing", "install it"))
    trial = VoiceTrial(fault=("x is no model", "download it again"))

    def packages(used: str | None, server_voices: dict[str, object] | None) -> str:
        return next(voice.check_neural(used, EngineOptions(env={}), LIMIT_S, server_voices)).state

    for server_voices, state in ((None, FAILURE), ({}, WARNING)):
        assert voice.judge_trial("piper/a", trial, server_voices).state == state
        assert packages("piper/a", server_voices) == state
    assert packages(None, None) == WARNING


def test_a_missing_package_is_reported_with_its_install_command() -> None:
    message = f"the voice piper/a cannot be loaded: numpy is missing; install it with: {install.neural_command()}"
    finding = voice.judge_engine("2.99", EngineReport(reason="unknown_voice", message=message), server_engine=None)[-1]
    assert (finding.check, finding.next) == ("voices", install.neural_command())
