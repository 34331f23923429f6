"""Tests for rendering: a file gets exactly espeak-ng's samples or isn't created, and nothing is left behind."""

from __future__ import annotations

import os
import random
import resource
import select
import signal
import socket
import stat
import struct
import subprocess
import sys
import tempfile
import threading
import time
import uuid
import wave
from subprocess import Popen
from typing import IO, TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from talkcli.doctor import sentence, voice
from talkcli.doctor.sentence import SentenceResult
from talkcli.doctor.voice import EngineOptions, EngineReport
from talkcli.engine import protocol
from talkcli.engine.parent import process
from talkcli.engine.parent.process import EngineFailed, PrivateEngine, engine_command
from talkcli.engine.parent.render import CannotWrite, RenderFailed, render, split_into_pieces
from talkcli.errors import TalkError, UsageError
from talkcli.goals.states import State
from talkcli.polling import Interrupted
from tests.support.reference import RATE, Sentence
from tests.support.reference import render as reference
from tests.support.surroundings import MARK, assert_none_left, needs

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

TEXT = "battery low, please recharge"
#: A text that takes some seconds to render.
LONG_TEXT = "one two three. " * 666
BEFORE = b"what was there before"


def samples(path: Path) -> bytes:
    with wave.open(str(path)) as file:
        assert (file.getframerate(), file.getnchannels(), file.getsampwidth()) == (RATE, 1, 2)
        data: bytes = file.readframes(file.getnframes())
        return data


@pytest.fixture(autouse=True)
def _no_leaks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Assert after each test that no engine process, hidden file or empty file is left."""
    mark = uuid.uuid4().hex
    monkeypatch.setenv(MARK, mark)
    yield
    monkeypatch.delenv(MARK)
    assert_none_left(mark, 2)
    assert not [name for name in os.listdir(tmp_path) if name.startswith(".")]
    assert not (tmp_path / "x.wav").exists() or (tmp_path / "x.wav").stat().st_size


def render_error(text: str, path: Path | str, **settings: object) -> TalkError:
    with pytest.raises(TalkError) as caught:
        render(text, str(path), **settings)  # type: ignore[arg-type]
    return caught.value


def test_the_file_has_exactly_espeak_ngs_samples(tmp_path: Path) -> None:
    path, expected_path = tmp_path / "x.wav", tmp_path / "expected.wav"
    seconds = render(TEXT, str(path))
    assert seconds == pytest.approx(len(samples(path)) / 2 / RATE, abs=1e-5)
    needs("espeak-ng")
    subprocess.run(["espeak-ng", "-s", "200", "-w", str(expected_path), TEXT], check=True)
    assert path.read_bytes() == expected_path.read_bytes()
    render(TEXT, str(path), rate=120, volume=0.5, voice="en-GB+F3", pitch=80)
    (expected,) = reference([Sentence(TEXT, 120, 0.5, "gmw/en+f3", 80)])
    assert samples(path) == expected.tobytes()
    assert sorted(os.listdir(tmp_path)) == ["expected.wav", "x.wav"]


def test_a_text_longer_than_a_goal_is_rendered_in_pieces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "x.wav"
    monkeypatch.setattr("talkcli.engine.parent.render.MAX_PIECE_CHARS", 500)
    sentences = [f"This is number {number}, and so on." for number in range(20)]
    text = f"{' '.join(sentences)}\n\n{'... ' * 200}"  # a silent piece is not an error
    first, second, *rest = split_into_pieces(text)
    assert first + second + "".join(rest) == text
    assert first.endswith("so on. ")
    seconds = render(text, str(path), rate=450)
    spoken = reference([Sentence(first, 450), Sentence(second, 450)])
    assert samples(path) == b"".join(piece.tobytes() for piece in spoken)
    assert seconds == pytest.approx(len(samples(path)) / RATE / 2, abs=1e-3)
    monkeypatch.setattr("talkcli.engine.parent.render.MAX_PIECE_CHARS", 10_000)
    assert seconds == pytest.approx(render(first + second, str(path), rate=450), abs=0.02)


@given(
    st.lists(st.sampled_from([". ", "\n\n", "word", " ", "日本。", "x" * 5_000, "“Mr. X.”  "]), max_size=40).map(
        "".join
    )
)
def test_pieces_add_up_to_the_text_and_none_is_too_long(text: str) -> None:
    pieces = list(split_into_pieces(text))
    assert "".join(pieces) == text
    assert max(map(len, pieces)) <= 10_000


def test_a_replaced_file_gets_its_permissions_from_the_umask(tmp_path: Path) -> None:
    path = tmp_path / "x.wav"
    path.write_bytes(BEFORE)
    before = os.umask(0o027)
    try:
        render("yes", str(path))
    finally:
        os.umask(before)
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    assert samples(path)


def test_relative_paths_and_unusual_file_names_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names = ["a b'\"\n😀.wav", "n" * 255, os.fsdecode(b"\xff.wav"), "-x", "file:x"]
    for name in names:
        render("a", name)
        assert samples(tmp_path / name)
    assert sorted(os.listdir(tmp_path)) == sorted(names)


def test_the_target_of_a_link_is_replaced_and_the_link_is_kept(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    for name in ("old.wav", "new.wav"):
        (tmp_path / name).symlink_to(tmp_path / "there" / name)
    (tmp_path / "there" / "old.wav").write_bytes(BEFORE)
    for name in ("old.wav", "new.wav"):
        render("a", str(tmp_path / name))
        assert (tmp_path / name).is_symlink()
        assert samples(tmp_path / "there" / name)
    assert sorted(os.listdir(tmp_path / "there")) == ["new.wav", "old.wav"]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("", "'' is not a file name"),
        ("{0}/", "is not a file name"),
        ("{0}/a\0b", "is not a file name"),
        ("{0}", "{0} is a directory; name a file in it"),
        ("{0}/missing/x.wav", "{0}/missing/x.wav cannot be written: the directory {0}/missing does not exist"),
        ("{0}/file/x.wav", "{0}/file/x.wav cannot be written: Not a directory"),
        ("{0}/socket", "{0}/socket is not a file that can be replaced"),
        ("{0}/loop", "{0}/loop cannot be written: Too many levels of symbolic links"),
        ("{0}/" + "n" * 256, "cannot be written: File name too long"),
    ],
)
def test_an_unwritable_path_is_an_error_before_an_engine_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, message: str
) -> None:
    monkeypatch.setattr(process, "EngineProcess", None)  # starting a process would raise TypeError
    (tmp_path / "file").touch()
    with socket.socket(socket.AF_UNIX) as listening, monkeypatch.context() as patch:
        patch.chdir(tmp_path)
        listening.bind("socket")
    (tmp_path / "loop").symlink_to("loop")
    error = render_error("yes", name.format(tmp_path))
    assert isinstance(error, CannotWrite)
    assert message.format(tmp_path) in str(error)
    assert (error.code, error.exit_code) == ("cannot_write", 1)


#: A program that renders its first argument to the path in its second.
RENDERS = """
import sys
sys.path[:] = {path!r}
from talkcli.engine.parent.render import render
print("started", file=sys.stderr, flush=True)
render(sys.argv[1], sys.argv[2])
"""


def start_rendering(
    path: str, stdout: IO[bytes] | int, text: str = "yes", env: dict[str, str] | None = None
) -> Popen[bytes]:
    command = [sys.executable, "-c", RENDERS.format(path=sys.path), text, path]
    return Popen(command, stdout=stdout, stderr=subprocess.PIPE, env={**os.environ, **(env or {})})


def stream_samples(data: bytes) -> bytes:
    """Return the samples of a WAV stream, whose header has no valid lengths."""
    assert (data[:8], data[8:16]) == (b"RIFF\xff\xff\xff\xff", b"WAVEfmt ")
    assert struct.unpack("<HHIIHH", data[20:36]) == (1, 1, RATE, 2 * RATE, 2, 16)
    assert data[36:44] == b"data\xff\xff\xff\xff"
    return data[44:]


@pytest.mark.parametrize("path", ["-", "/dev/stdout", "/dev/fd/1"])
def test_standard_output_gets_the_sound_as_a_stream(tmp_path: Path, path: str) -> None:
    (expected,) = reference(["yes"])
    if path == "-":
        with start_rendering(path, subprocess.PIPE) as process:
            out, err = process.communicate(timeout=60)
        assert (process.returncode, stream_samples(out), err) == (0, expected.tobytes(), b"started\n")
    with (tmp_path / "out").open("wb") as file:
        file.write(b"before")
        file.flush()
        with start_rendering(path, file) as process:
            assert process.communicate(timeout=60)[1] == b"started\n"
        os.lseek(file.fileno(), 0, os.SEEK_END)
        file.write(b"after")
    data = (tmp_path / "out").read_bytes()
    assert (data[:6], stream_samples(data[6:-5]), data[-5:]) == (b"before", expected.tobytes(), b"after")


def run_in_engines(monkeypatch: pytest.MonkeyPatch, before: str) -> None:
    """Make each engine process run this code first."""
    interpreter, option, code = engine_command()
    path, rest = code.split("; from ", 1)
    command = [interpreter, option, f"{path}\n{before}\nfrom {rest}"]
    monkeypatch.setattr("talkcli.engine.parent.process.engine_command", lambda: command)


def test_a_slow_reader_of_a_pipe_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The sound doesn't fit into the pipe, and the reader pauses for longer than a player may stall."""
    limits = "from talkcli.engine.child import playback; playback.FIRST_SOUND_LIMIT_S = playback.STALL_LIMIT_S = 0.1"
    run_in_engines(monkeypatch, limits)
    text = TEXT * 4
    (expected,) = reference([text])
    assert len(expected) * 2 > 3 * 65536
    os.mkfifo(tmp_path / "pipe")
    durations: list[float] = []
    thread = threading.Thread(target=lambda: durations.append(render(text, str(tmp_path / "pipe"))))
    thread.start()
    with (tmp_path / "pipe").open("rb") as pipe:
        head = pipe.read(44)
        time.sleep(0.4)
        assert stream_samples(head + pipe.read()) == expected.tobytes()
    thread.join(10)
    assert durations == [pytest.approx(len(expected) / RATE, abs=1e-5)]


@pytest.fixture
def interrupt() -> Iterator[dict[int, int]]:
    """Return descriptors that interrupt a wait at once."""
    reader, writer = os.pipe()
    os.write(writer, b"x")
    yield {reader: select.POLLIN}
    os.close(reader)
    os.close(writer)


def test_a_timeout_or_an_interrupt_ends_the_wait_for_a_pipes_reader(tmp_path: Path, interrupt: dict[int, int]) -> None:
    path = tmp_path / "pipe"
    os.mkfifo(path)
    with pytest.raises(TimeoutError, match="no program opened"):
        render("yes", str(path), timeout=0.1)
    with pytest.raises(Interrupted):
        render("yes", str(path), interrupt=interrupt)


def test_an_error_is_raised_if_the_reader_goes_away(tmp_path: Path) -> None:
    path = tmp_path / "pipe"
    os.mkfifo(path)
    failures: list[TalkError] = []
    thread = threading.Thread(target=lambda: failures.append(render_error(LONG_TEXT, path)))
    thread.start()
    with path.open("rb") as pipe:
        pipe.read(44)
    thread.join(10)
    assert [(str(error), error.exit_code) for error in failures] == [(f"{path} cannot be written: Broken pipe", 1)]
    with start_rendering("-", subprocess.PIPE) as process:
        assert process.stdout
        process.stdout.close()
        assert process.stderr
        assert b"BrokenPipeError: " in process.stderr.read().splitlines()[-1]


def test_a_device_can_be_written_but_not_a_terminal() -> None:
    assert render("yes", "/dev/null") > 0.3
    full = render_error("yes", "/dev/full")
    assert (str(full), full.exit_code) == ("/dev/full cannot be written: No space left on device", 1)
    controller, terminal = os.openpty()
    for name in ("-", os.ttyname(terminal)):
        with start_rendering(name, terminal) as process:
            _, err = process.communicate(timeout=60)
        assert b"UsageError: " in err
        assert b"is a terminal" in err
    os.set_blocking(controller, False)
    with pytest.raises(BlockingIOError):
        os.read(controller, 1)
    os.close(controller)
    os.close(terminal)


def test_a_file_that_is_also_standard_output_is_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "out"
    with path.open("wb") as out, start_rendering(str(path), out) as process:
        _, err = process.communicate(timeout=60)
    assert process.returncode == 1
    assert f"{path} is not a file that can be replaced" in err.decode()
    assert path.read_bytes() == b""


#: Code that changes the user from root, who can write everywhere, to nobody.
AS_NOBODY = """
import os
import unicodedata  # needed later, when the user nobody can't read an interpreter in root's home
if os.geteuid() == 0:
    os.setgroups([])
    os.setgid(65534)
    os.setuid(65534)
"""


@pytest.mark.parametrize("protected", ["directory", "file"])
def test_a_protected_path_is_an_error_and_keeps_its_file(monkeypatch: pytest.MonkeyPatch, protected: str) -> None:
    with tempfile.TemporaryDirectory() as directory:  # the user nobody can't enter pytest's directory
        path = os.path.join(directory, "x.wav")
        with open(path, "wb") as file:
            file.write(BEFORE)
        os.chmod(path, 0o444 if protected == "file" else 0o666)
        os.chmod(directory, 0o777 if protected == "file" else 0o555)
        monkeypatch.setitem(globals(), "RENDERS", RENDERS.replace("print(", f"{AS_NOBODY}print("))
        with start_rendering(path, subprocess.PIPE) as process:
            _, err = process.communicate(timeout=60)
        os.chmod(directory, 0o755)
        assert f"CannotWrite: {path} cannot be written: " in err.decode()
        assert os.listdir(directory) == ["x.wav"]
        with open(path, "rb") as file:
            assert file.read() == BEFORE


def test_a_failed_write_is_an_error_and_keeps_the_old_file(tmp_path: Path) -> None:
    """A limit on the file size makes a write fail halfway, as on a full disk."""
    path = tmp_path / "x.wav"
    path.write_bytes(BEFORE)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (65536, before[1]))
    try:
        error = render_error(TEXT * 3, path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert isinstance(error, CannotWrite)
    assert (str(error), error.exit_code) == (f"{path} cannot be written: File too large", 1)
    assert path.read_bytes() == BEFORE
    assert os.listdir(tmp_path) == ["x.wav"]


@pytest.mark.parametrize(
    ("text", "settings", "code", "exit_code", "message"),
    [
        ("", {}, "invalid_text", 5, "the text is empty"),
        ("a\0b", {}, "invalid_text", 5, "NUL"),
        ("yes", {"voice": "en-uss"}, "unknown_voice", 5, "did you mean 'en-us'"),
        ("yes", {"voice": "en+nosuch"}, "unknown_voice", 5, 'unknown voice "en+nosuch"'),
        ("yes", {"driver": "parrot"}, "engine_failed", 4, 'unknown driver "parrot"'),
        ("...", {}, "nothing_to_say", 4, "nothing in the text can be spoken"),
    ],
)
def test_a_text_that_fails_keeps_the_old_file(
    tmp_path: Path, text: str, settings: dict[str, str], code: str, exit_code: int, message: str
) -> None:
    path = tmp_path / "x.wav"
    path.write_bytes(BEFORE)
    error = render_error(text, path, **settings)
    assert isinstance(error, RenderFailed)
    assert (error.code, error.exit_code) == (code, exit_code)
    assert message in str(error)
    assert path.read_bytes() == BEFORE


def test_a_driver_that_plays_by_itself_is_refused(tmp_path: Path) -> None:
    error = render_error("yes", tmp_path / "x.wav", driver="dummy")
    assert isinstance(error, UsageError)
    assert str(error).startswith('the driver "dummy" cannot write files')


def test_a_timeout_or_an_interrupt_ends_the_rendering_at_once(tmp_path: Path, interrupt: dict[int, int]) -> None:
    path = tmp_path / "x.wav"
    path.write_bytes(BEFORE)
    started_at = time.monotonic()
    with pytest.raises(TimeoutError, match="the text was not rendered in time"):
        render(LONG_TEXT, str(path), timeout=0.3)
    assert time.monotonic() - started_at < 2
    with pytest.raises(Interrupted):
        render(LONG_TEXT, str(path), interrupt=interrupt)
    assert path.read_bytes() == BEFORE


@pytest.mark.parametrize(
    ("before", "reason", "message"),
    [
        ("import time; time.sleep(60)", "engine_failed", "the engine was not ready within 0.3 s"),
        ("raise RuntimeError('no tongue')", "engine_crashed", "RuntimeError: no tongue"),
        (
            "import os; from talkcli.engine.child import runner; runner.GoalRunner._speak = lambda *_: os.abort()",
            "engine_crashed",
            'the engine crashed while it spoke with the voice "en-us": it was killed by SIGABRT',
        ),
        (
            "import time; from talkcli.engine.child import runner; runner.GoalRunner._speak = lambda *_: time.sleep(9)",
            "engine_hung",
            'the engine did not respond for 0.3 s while it spoke with the voice "en-us"',
        ),
    ],
)
def test_an_engine_that_fails_or_hangs_is_reported_and_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, before: str, reason: str, message: str
) -> None:
    run_in_engines(monkeypatch, before)
    monkeypatch.setattr(process, "START_LIMIT_S", 0.3 if reason == "engine_failed" else 10)
    monkeypatch.setattr(process, "HANG_LIMIT_S", 0.3)
    error = render_error("yes", tmp_path / "x.wav", voice="en-us")
    assert error.code == reason
    assert message in str(error)


def test_an_interpreter_that_cannot_be_started_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("talkcli.engine.parent.process.engine_command", lambda: ["/nonesuch"])
    error = render_error("yes", tmp_path / "x.wav")
    assert (error.code, "/nonesuch" in str(error)) == ("engine_failed", True)


@pytest.mark.parametrize("sent", [signal.SIGKILL, signal.SIGINT])
def test_a_kill_at_any_moment_leaves_no_partial_file(tmp_path: Path, sent: signal.Signals) -> None:
    text = "one two three four five. " * 20
    (expected,) = reference([text])
    path = tmp_path / "x.wav"
    started_at = time.monotonic()
    render(text, str(path))
    duration = time.monotonic() - started_at
    moments = random.Random(sent)
    outcomes = set()
    for _ in range(4):
        path.write_bytes(BEFORE)
        mark = uuid.uuid4().hex
        with start_rendering(str(path), subprocess.DEVNULL, text, {MARK: mark}) as program:
            assert program.stderr is not None
            program.stderr.readline()
            time.sleep(moments.uniform(0, duration))  # until a random moment
            program.send_signal(sent)
        assert_none_left(mark, 2)
        hidden = [name for name in os.listdir(tmp_path) if name != "x.wav"]
        if sent == signal.SIGKILL:
            assert len(hidden) <= 1
            for name in hidden:
                assert name.startswith(".talk-")
                os.unlink(tmp_path / name)
        else:
            assert hidden == []
        done = path.read_bytes() != BEFORE
        outcomes.add(done)
        if done:
            assert samples(path) == expected.tobytes()
    assert False in outcomes


# -- a private engine process


CONFIGURE = protocol.Configure(os.getpid(), None, None, None, None, list_voices=False)
SAY = protocol.Speak("1", "length=0", 200, 1.0, None, 50)


@pytest.mark.usefixtures("scripted_process")
def test_waiting_for_a_dead_process_raises_an_error_with_the_cause() -> None:
    with PrivateEngine(CONFIGURE) as engine:
        events = engine.events
        assert isinstance(next(events), protocol.Ready)
        os.kill(engine._process.pid, 9)
        os.waitid(os.P_PID, engine._process.pid, os.WEXITED | os.WNOWAIT)
        engine.speak(SAY)
        with pytest.raises(EngineFailed, match=r"^it was killed by SIGKILL$") as failed:
            engine.wait_for(protocol.Ended)
        assert failed.value.reason == "engine_crashed"


@pytest.mark.usefixtures("scripted_process")
def test_a_stream_of_events_does_not_extend_the_deadline() -> None:
    with PrivateEngine(CONFIGURE, deadline=time.monotonic() + 0.7) as engine:
        events: list[protocol.Event] = []
        assert isinstance(next(engine.events), protocol.Ready)
        engine.speak(protocol.Speak("1", "never-ends", 200, 1.0, None, 50))
        with pytest.raises(TimeoutError):
            events.extend(engine.events)
        assert any(isinstance(event, protocol.Word) for event in events)


# -- errors in `talk doctor`


@pytest.mark.usefixtures("scripted_process")
def test_doctor_reports_hangs_crashes_and_long_sentences(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    died = SentenceResult(State.ABORTED, "engine_crashed", "it was killed by SIGSEGV")
    assert sentence.speak_by_engine("silent-start crash", EngineOptions(), 1.0, 20.0) == died
    late = SentenceResult(State.ABORTED, "engine_hung", "the sentence did not end within 0.5 s")
    assert sentence.speak_by_engine("never-ends", EngineOptions(), 1.0, 0.5) == late
    monkeypatch.setattr(process, "HANG_LIMIT_S", 0.4)
    hung = SentenceResult(State.ABORTED, "engine_hung", "the engine process did not respond for 0.4 s")
    assert sentence.speak_by_engine("hang", EngineOptions(), 1.0, 20.0) == hung
    script = tmp_path / "start"
    script.write_text("hang")
    monkeypatch.setenv("SCRIPTED_START_FILE", str(script))
    monkeypatch.setattr(process, "START_LIMIT_S", 0.3)
    message = "the engine process did not respond for 0.3 s"
    assert voice.probe_engine(EngineOptions()) == EngineReport(reason="engine_hung", message=message)
