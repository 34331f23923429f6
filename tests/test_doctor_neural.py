"""`talk doctor` where there are neural voices: what they take, their files, and the one that is spoken with, tried."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from talkcli import Client, install
from talkcli.client.connect import Interrupted
from talkcli.doctor import neural, voice
from talkcli.doctor.neural import Neural, Tried
from talkcli.doctor.report import FAILED, OK, WARNING
from talkcli.doctor.voice import Engine
from talkcli.engine.synthesizers.models import NEEDED
from tests.conformance.bareserve import environment, serving
from tests.engine.test_neural import WITHOUT
from tests.support import tiny_voice
from tests.support.real_voice import REAL_PACKAGE, REAL_VOICE, real_voice
from tests.support.surroundings import needs_packages
from tests.test_doctor_alone import doctor, home

if TYPE_CHECKING:
    from talkcli.doctor.report import Finding

__all__ = ["home"]

#: So that voices of packages are not found: what is looked at is what a test has put there.
ALONE = """
import importlib, sys
from talkcli.engine.synthesizers import models
models._PACKAGE = "no such package"
"""
TRIED = r"is in use: loaded in \d+\.\d s, makes a sentence \d+\.\d times as fast as it is heard, takes \d+ MB"


@pytest.fixture
def alone(home: str, tmp_path: Path) -> dict[str, str]:
    """Return an environment with the voice that hums, and no other."""
    tiny_voice.put(Path(home) / "v", "tiny")
    return _environment(home, tmp_path, ALONE)


def _environment(home: str, tmp_path: Path, code: str, **more: str) -> dict[str, str]:
    """Return an environment without a server, where each Python runs this code first."""
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(code)
    env = environment(home, TALK_SOCKET=f"{home}/s", TALK_VOICES=f"{home}/v", TALK_PLAYER="file:" + f"{home}/said.wav")
    return {**env, "PYTHONPATH": f"{tmp_path / 'site'}:{env.get('PYTHONPATH', '')}", **more}


def test_the_voice_in_use_is_loaded_and_timed(alone: dict[str, str]) -> None:
    needs_packages(*NEEDED)
    found = doctor({**alone, "TALK_VOICE": "piper/ti"})
    assert found["neural"]["state"] == "ok"
    assert re.search(r"onnxruntime \d+\.\d+.*, numpy \d+\.\d+", found["neural"]["message"])
    assert found["voice files"] == {
        "check": "voice files", "state": "ok", "message": "as they should be: piper/tiny", "next": None
    }  # fmt: skip
    assert found["neural voice"]["state"] == "ok"
    assert re.match(f"piper/ti {TRIED}", found["neural voice"]["message"]), found
    assert list(found)[3:8] == ["voices", "neural", "voice files", "neural voice", "session"]


def test_a_real_one_is_loaded_and_timed(home: str, tmp_path: Path) -> None:
    needs_packages(*NEEDED, REAL_PACKAGE)
    real_voice()
    found = doctor(_environment(home, tmp_path, "", TALK_VOICE=REAL_VOICE))
    assert re.match(f"{REAL_VOICE} {TRIED}", found["neural voice"]["message"]), found
    assert REAL_VOICE in found["voice files"]["message"]


def test_a_voice_that_nobody_uses_is_looked_at_and_not_loaded(alone: dict[str, str], home: str) -> None:
    tiny_voice.put(Path(home) / ".local/share/talk/voices", "garbage", b"no model")
    del alone["TALK_VOICES"]
    found = doctor(alone)
    assert "neural voice" not in found
    assert found["voice files"]["message"] == "as they should be: piper/garbage"


def test_of_files_that_are_not_as_they_should_be_the_first_is_named_with_what_to_do(
    alone: dict[str, str], home: str
) -> None:
    place = Path(home) / "v"
    for name in ("a", "b", "c"):
        tiny_voice.put(place, name)
    (place / "a.onnx").chmod(0o666)
    (place / "a.onnx.json").chmod(0o666)
    (place / "b.onnx.json").unlink()
    (place / "c.onnx").unlink()
    (place / "c.onnx").symlink_to("nowhere")
    files = doctor(alone)["voice files"]
    assert files["state"] == "warning"
    json, model = f"{place}/a.onnx.json", f"{place}/a.onnx"
    words = f"piper/a: {json} and {model} can be written by others, who could change the voice"
    assert files["message"] == f"{words}; and something is wrong with piper/b, piper/c"
    subprocess.run(["/bin/sh", "-c", files["next"]], check=True)
    files = doctor(alone)["voice files"]
    assert files["message"].startswith(f"piper/b: {place}/b.onnx.json is not there")
    assert files["next"] == "get it from where that came from"


@pytest.mark.parametrize(
    ("model", "beside", "words", "step"),
    [
        (b"no model", None, "is no ONNX model", "get the voice anew, from a source that you trust"),
        (
            tiny_voice.model(cut="other"),
            None,
            "it has no dec.conv_pre",
            "get the voice anew, from a source that you trust",
        ),
        (None, tiny_voice.description(voice="xx"), 'has no voice "xx"', "get the voice anew"),
        (tiny_voice.model(speakers=2), None, "one has several speakers", "get both from the same place"),
    ],
    ids=["garbage", "not to be cut", "unknown sounds", "another's json"],
)
def test_one_that_cannot_be_spoken_with_says_why_and_what_to_do(
    alone: dict[str, str], home: str, model: bytes | None, beside: dict[str, object] | None, words: str, step: str
) -> None:
    needs_packages(*NEEDED)
    tiny_voice.put(Path(home) / "v", "bad", model, beside)
    found = doctor({**alone, "TALK_VOICE": "piper/bad"})["neural voice"]
    assert found["state"] == "failed"
    assert found["message"].startswith(f"piper/bad is in use: {home}/v/bad.onnx")
    assert words in found["message"]
    assert found["next"] == step


@pytest.mark.parametrize("used", [True, False])
def test_without_the_extra_it_says_what_to_install(home: str, tmp_path: Path, used: bool) -> None:
    tiny_voice.put(Path(home) / "v", "tiny")
    env = _environment(home, tmp_path, WITHOUT.format(names=["onnxruntime"]))
    found = doctor({**env, **({"TALK_VOICE": "tiny"} if used else {})})
    step = install.neural()
    assert found["neural"] == {
        "check": "neural",
        "state": "failed" if used else "warning",
        "message": "onnxruntime is missing",
        "next": step,
    }
    assert "neural voice" not in found
    assert used is (found["voices"]["next"] == step)


@pytest.mark.parametrize(
    ("code", "words", "step", "used"),
    [
        ("os.kill(os.getpid(), 4)", "it was killed by SIGILL", "this processor is too old", True),
        ("raise ImportError('no libgomp.so.1')", "ImportError: no libgomp.so.1", "install it again", False),
    ],
)
def test_a_package_that_cannot_be_imported_is_a_finding(
    home: str, tmp_path: Path, code: str, words: str, step: str, used: bool
) -> None:
    needs_packages(*NEEDED)
    tiny_voice.put(Path(home) / "v", "tiny")
    env = _environment(home, tmp_path, "")
    (tmp_path / "site" / "onnxruntime.py").write_text(
        f"import os\nassert os.environ['ORT_DISABLE_TELEMETRY'] == '1'\n{code}\n"
    )
    found = doctor({**env, **({"TALK_VOICE": "piper/tiny"} if used else {})})
    assert found["neural"]["state"] == ("failed" if used else "warning")
    assert re.match(f"onnxruntime .* cannot be imported: {re.escape(words)}$", found["neural"]["message"])
    assert found["neural"]["next"].startswith(step)
    assert "neural voice" not in found


def test_packages_that_are_imported_too_slowly_are_not_installed_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    needs_packages(*NEEDED)
    monkeypatch.setattr(neural, "_IMPORT_LIMIT_S", 0.2)
    (tmp_path / "onnxruntime.py").write_text("import time\ntime.sleep(60)\n")
    found = neural.judge(neural.look(None, {**os.environ, "PYTHONPATH": str(tmp_path)}, 5.0), server=False)[0]
    assert (found.state, found.next) == (WARNING, "run talk doctor again when this machine is less busy")


def test_where_nothing_neural_is_there_nothing_is_done() -> None:
    code = """
import sys
from talkcli.doctor import examine, machine, voice
session = machine.Session(0, "root")
engine = voice.Engine("espeak", "x", 9)
found = list(examine.Examination(None, silent=True)._neural("de", engine, session, {}, running=False))
assert found == [], found
assert not {"talkcli.doctor.neural", "onnxruntime", "numpy"} & {*sys.modules}, sys.modules.keys()
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


# -- beside a server


def _beside(env: dict[str, str], *options: str) -> dict[str, dict[str, str]]:
    """Return what it finds beside a server of these options, whose voice is loaded, or has failed to be."""
    silent = {name: value for name, value in env.items() if name != "TALK_PLAYER"}
    with serving(silent, *options), Client(env["TALK_SOCKET"]) as client:
        limit = time.monotonic() + 20
        while not re.search("loaded|failed", str(client.status().server["neural_voices"])):
            assert time.monotonic() < limit
            time.sleep(0.02)
        # Where its voices are, the server alone was told.
        return doctor({name: value for name, value in silent.items() if name != "TALK_VOICES"}, "--silent", code=4)


def test_the_server_s_voice_is_tried_in_its_surroundings(alone: dict[str, str]) -> None:
    needs_packages(*NEEDED)
    found = _beside(alone, "--voice", "piper/ti")
    assert re.match(f"piper/tiny {TRIED}", found["neural voice"]["message"]), found


def test_a_voice_that_the_server_has_given_up_is_a_warning(alone: dict[str, str], home: str) -> None:
    needs_packages(*NEEDED)
    tiny_voice.put(Path(home) / "v", "bad", b"no model")
    found = _beside(alone, "--voice", "piper/bad")["neural voice"]
    assert found["state"] == "warning"
    assert found["message"].startswith("piper/bad is in use: ")


FAILED_THEN = {"piper/a": {"state": "loaded", "why": None}, "piper/b": {"state": "failed", "why": "x is no model"}}


def test_what_the_server_says_of_its_voices_is_told_where_they_cannot_be_looked_at() -> None:
    (found,) = neural.judge_told(FAILED_THEN)
    assert (found.state, found.message) == (WARNING, "the server cannot speak by piper/b: x is no model")
    assert found.next == "see whether it still is so: talk set --voice piper/b"
    (found,) = neural.judge_told({"piper/a": FAILED_THEN["piper/a"]})
    assert (found.state, found.message) == (OK, "of the server: piper/a")
    assert neural.judge_told({}) == neural.judge_told(None) == []


def test_a_voice_that_speaks_here_and_that_the_server_has_given_up_is_told_so() -> None:
    facts = Neural(None, used="piper/b", tried=Tried(loaded=0.5, speed=9.0))
    assert neural.judge(facts, server=True, told=FAILED_THEN)[-1].state == WARNING
    assert neural.judge(facts, server=True, told={})[-1].state == OK


# -- the one that is tried, and what is made of it


def _look(env: dict[str, str] | None, limit: float = 20.0) -> Tried:
    needs_packages(*NEEDED)
    found = neural.look("piper/tiny", env, limit).tried
    assert found is not None
    return found


def test_one_that_takes_too_long_is_given_up(alone: dict[str, str]) -> None:
    assert _look(alone, 0.01).words == "it was not loaded, and had not spoken, after 0.01 s"


def test_one_that_kills_the_engine_process_is_a_fact(home: str, tmp_path: Path) -> None:
    needs_packages(*NEEDED)
    tiny_voice.put(Path(home) / "v", "tiny")
    dies = "from talkcli.engine.synthesizers import inference\nimport os\ninference.halves = lambda _: os.abort()\n"
    tried = _look(_environment(home, tmp_path, dies))
    assert "SIGABRT" in (tried.words or "")


def test_a_signal_ends_it(alone: dict[str, str]) -> None:
    needs_packages(*NEEDED)
    readable, writable = os.pipe()
    os.write(writable, b"x")
    try:
        with pytest.raises(Interrupted):
            neural.look("piper/tiny", alone, 20.0, {readable: 1})
    finally:
        os.close(readable)
        os.close(writable)


def _judged(**tried: object) -> Finding:
    found = neural.judge(Neural(None, used="piper/a", tried=Tried(**tried)), server=False)  # type: ignore[arg-type]
    return found[-1]


def test_a_machine_that_is_too_slow_is_told_what_to_choose() -> None:
    slow = _judged(loaded=3.04, speed=1.29, memory=250_400_000)
    assert slow.state == WARNING
    assert slow.message.startswith(
        "piper/a is in use: loaded in 3.0 s, makes a sentence 1.3 times as fast as it is heard, takes 250 MB"
    )
    assert "quality is low" in (slow.next or "")
    assert _judged(loaded=3.04, speed=1.31).state == OK
    assert "MB" not in _judged(speed=2.0).message


def test_a_voice_that_fails_is_a_warning_where_espeak_speaks_in_its_place() -> None:
    facts = Neural(None, used="piper/a", tried=Tried(words="x is no model", step="get it anew"))
    assert [neural.judge(facts, server=each)[-1].state for each in (False, True)] == [FAILED, WARNING]
    without = Neural("onnxruntime is missing: install it", used="piper/a")
    assert [neural.judge(without, server=each)[0].state for each in (False, True)] == [FAILED, WARNING]


def test_a_voice_that_takes_what_is_not_installed_is_cured_by_that() -> None:
    words = f"the voice piper/a is listed, but it cannot be loaded: numpy is missing: {install.neural()}"
    found = voice.judge("2.99", Engine(reason="unknown_voice", words=words), server=None)[-1]
    assert (found.check, found.next) == ("voices", install.neural())
