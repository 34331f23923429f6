"""The scripted engine, over a socket pair as the engine thread has one: each word of its grammar does what it says."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import subprocess
import sys
import time
import uuid
from typing import TYPE_CHECKING

import pytest

from talkcli.engine import protocol
from tests.support.surroundings import MARK, assert_none_left, clean_environment, marked

if TYPE_CHECKING:
    import pathlib
    from collections.abc import Callable, Iterator

#: What relies on the scripted engine fails with it.
pytestmark = pytest.mark.slow

PROGRAM = os.path.join(os.path.dirname(os.path.abspath(__file__)), "support", "scripted_engine.py")


class Engine:
    """A scripted engine process, and the server's end of its socket pair."""

    def __init__(self, home: str, **env: str) -> None:
        self.mark = uuid.uuid4().hex
        self.socket, theirs = socket.socketpair()
        self.liveness, inherited = os.pipe()
        self._buffer = b""
        env = {MARK: self.mark, "TALK_LIVENESS_FD": str(inherited), **env}
        with theirs:
            self.process = subprocess.Popen(
                [sys.executable, PROGRAM],
                stdin=theirs.fileno(),
                env=clean_environment(home, env),
                pass_fds=[inherited],
                start_new_session=True,
            )
        os.close(inherited)
        self.send(protocol.Configure(os.getpid(), None, None, None, None))

    def send(self, command: protocol.Command) -> None:
        self.socket.sendall(protocol.encode(command))

    def say(self, text: str, goal_id: str = "a") -> None:
        self.send(protocol.Say(goal_id, text, 200, 1.0, None, 50))

    def stop(self, goal_id: str = "a") -> None:
        self.send(protocol.Stop(goal_id))

    def receive(self, timeout: float = 5) -> protocol.Event | None:
        """Return the next event, None where the process has closed its end."""
        self.socket.settimeout(timeout)
        while b"\n" not in self._buffer:
            try:
                data = self.socket.recv(65536)
            except ConnectionResetError:
                return None
            if not data:
                return None
            self._buffer += data
        line, _, self._buffer = self._buffer.partition(b"\n")
        return protocol.decode(line, protocol.EVENTS)

    def until_end(self) -> tuple[list[protocol.Event], protocol.Ended | None]:
        """Return the events before the goal's end, and that: None where the process ended instead."""
        events: list[protocol.Event] = []
        while (event := self.receive()) is not None:
            if isinstance(event, protocol.Ended):
                return events, event
            events.append(event)
        return events, None

    def ready(self) -> Engine:
        assert isinstance(self.receive(), protocol.Ready)
        assert isinstance(self.receive(), protocol.Voices)
        return self

    def gone(self, timeout: float) -> bool:
        """Return whether all that holds the liveness pipe is gone in time."""
        readable, _, _ = select.select([self.liveness], [], [], timeout)
        return bool(readable) and os.read(self.liveness, 1) == b""

    def close(self) -> None:
        self.socket.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(1)
        self.process.kill()
        self.process.wait()
        os.close(self.liveness)
        for pid in marked(self.mark):
            os.kill(pid, signal.SIGKILL)
        assert_none_left(self.mark, 1)


@pytest.fixture
def start(tmp_path: pathlib.Path) -> Iterator[Callable[..., Engine]]:
    with contextlib.ExitStack() as stack:

        def make(**env: str) -> Engine:
            engine = Engine(str(tmp_path), **env)
            stack.callback(engine.close)
            return engine

        yield make


@pytest.fixture
def engine(start: Callable[..., Engine]) -> Engine:
    return start().ready()


def test_plain_text_is_spoken_with_all_its_words(engine: Engine) -> None:
    for goal_id in ("a", "b"):
        engine.say("the battery is low", goal_id)
        events, end = engine.until_end()
        assert isinstance(events[0], protocol.Started)
        words = [each for each in events if isinstance(each, protocol.Word)]
        assert [(each.start, each.end, each.number) for each in words] == [
            (0, 3, 1),
            (4, 11, 2),
            (12, 14, 3),
            (15, 18, 4),
        ]
        assert end == protocol.Ended(goal_id, protocol.COMPLETED, None, None, 0.1)


def test_words_without_their_values_are_ordinary(engine: Engine) -> None:
    engine.say("the length of words, at a fail message")
    events, end = engine.until_end()
    assert len([each for each in events if isinstance(each, protocol.Word)]) == 8
    assert end == protocol.Ended("a", protocol.COMPLETED, None, None, 0.1)


def test_length_and_words_are_obeyed(engine: Engine) -> None:
    began = time.monotonic()
    engine.say("length=0.4 words=2 one two")
    events, end = engine.until_end()
    assert end is not None
    assert 0.4 <= time.monotonic() - began < 1
    assert [each.time for each in events if isinstance(each, protocol.Word)] == [0.0, 0.2]


def test_failure_comes_in_the_middle_with_its_reason(engine: Engine) -> None:
    engine.say("length=0.2 fail=audio_lost message=the_cable_is_out")
    events, end = engine.until_end()
    assert len([each for each in events if isinstance(each, protocol.Word)]) == 2
    assert end == protocol.Ended("a", protocol.FAILED, "audio_lost", "the cable is out", None)
    engine.say("next", "b")
    assert engine.until_end()[1] == protocol.Ended("b", protocol.COMPLETED, None, None, 0.1)


@pytest.mark.parametrize(("text", "code"), [("crash", -signal.SIGSEGV), ("exit", 0), ("exit=7", 7)])
def test_it_ends_without_a_result(engine: Engine, text: str, code: int) -> None:
    engine.say(f"{text} and more")
    events, end = engine.until_end()
    assert end is None
    assert events
    assert engine.process.wait(5) == code


def test_a_hang_ignores_everything(engine: Engine) -> None:
    engine.say("hang at=0")
    assert isinstance(engine.receive(), protocol.Started)
    engine.stop()
    engine.socket.shutdown(socket.SHUT_WR)
    engine.process.terminate()
    with contextlib.suppress(TimeoutError):
        while True:
            assert not isinstance(engine.receive(protocol.ALIVE_EVERY * 1.5), protocol.Alive | protocol.Ended | None)
    assert engine.process.poll() is None
    engine.process.kill()
    assert engine.gone(2)


def test_what_never_ends_is_alive_until_it_is_stopped(engine: Engine) -> None:
    engine.say("never-ends")
    while not isinstance(engine.receive(), protocol.Alive):
        pass
    engine.stop("other")
    engine.stop()
    assert engine.until_end()[1] == protocol.Ended("a", protocol.STOPPED)


def test_ignored_stop_changes_nothing(engine: Engine) -> None:
    engine.say("ignore-stop length=0.2")
    engine.stop()
    end = engine.until_end()[1]
    assert end
    assert end.outcome == protocol.COMPLETED


def test_ignored_stop_and_no_end_stays_alive(engine: Engine) -> None:
    engine.say("ignore-stop never-ends")
    engine.stop()
    events = [engine.receive() for _ in range(4)]
    assert [type(each) for each in events[-2:]] == [protocol.Word, protocol.Alive]
    engine.socket.close()
    assert engine.gone(2)


def test_slow_stop_takes_its_time(engine: Engine) -> None:
    engine.say("slow-stop=0.3 length=10")
    assert isinstance(engine.receive(), protocol.Started)
    began = time.monotonic()
    engine.stop()
    assert engine.until_end()[1] == protocol.Ended("a", protocol.STOPPED)
    assert 0.3 <= time.monotonic() - began < 1


@pytest.mark.parametrize(
    ("what", "outcome"),
    [("complete", protocol.COMPLETED), ("fail", protocol.FAILED), ("crash", None), ("exit", None)],
)
def test_on_stop_does_what_it_says(engine: Engine, what: str, outcome: str | None) -> None:
    engine.say(f"length=10 on-stop={what}")
    assert isinstance(engine.receive(), protocol.Started)
    engine.stop()
    end = engine.until_end()[1]
    assert (end.outcome if end else None) == outcome


def test_silent_start_says_nothing_before_the_end(engine: Engine) -> None:
    engine.say("silent-start some words")
    assert engine.until_end()[0] == []


def test_end_of_input_ends_it(engine: Engine) -> None:
    engine.say("length=10")
    engine.socket.close()
    assert engine.process.wait(5) == 0
    assert engine.gone(1)


def test_what_lingers_outlives_a_kill_and_then_ends(engine: Engine) -> None:
    engine.say("linger=0.6 length=10")
    assert isinstance(engine.receive(), protocol.Started)
    os.killpg(engine.process.pid, signal.SIGKILL)
    engine.process.wait()
    for pid in marked(engine.mark):
        os.kill(pid, signal.SIGTERM)
    assert not engine.gone(0.3)
    assert engine.gone(3)


@pytest.mark.parametrize("reason", ["engine_failed", "unknown_voice"])
def test_a_start_fails(start: Callable[..., Engine], reason: str) -> None:
    engine = start(SCRIPTED_START=f"fail={reason}")
    event = engine.receive()
    assert isinstance(event, protocol.StartFailed)
    assert event.reason == reason
    assert engine.process.wait(5) == 1


def test_a_start_crashes_or_exits(start: Callable[..., Engine]) -> None:
    for asked, code in [("crash", -signal.SIGSEGV), ("exit=3", 3)]:
        engine = start(SCRIPTED_START=asked)
        assert engine.receive() is None
        assert engine.process.wait(5) == code


def test_a_start_is_slow(start: Callable[..., Engine]) -> None:
    began = time.monotonic()
    start(SCRIPTED_START="slow=0.4").ready()
    assert time.monotonic() - began > 0.4


def test_a_start_hangs(start: Callable[..., Engine]) -> None:
    engine = start(SCRIPTED_START="hang")
    with pytest.raises(TimeoutError):
        engine.receive(0.5)
    engine.process.kill()


def test_each_start_reads_the_file_anew(start: Callable[..., Engine], tmp_path: pathlib.Path) -> None:
    file = tmp_path / "start"
    file.write_text("fail\n")
    assert isinstance(start(SCRIPTED_START_FILE=str(file)).receive(), protocol.StartFailed)
    file.write_text("")
    start(SCRIPTED_START_FILE=str(file)).ready()
    file.unlink()
    start(SCRIPTED_START_FILE=str(file)).ready()
