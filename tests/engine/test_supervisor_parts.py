"""The parts of the engine thread, by times given: when it tries again, what it passes on, whom it waits for."""

from __future__ import annotations

import os
import select
import selectors
import socket
import sys
import time
from typing import TYPE_CHECKING, cast

import pytest

from talkcli.client.connect import ready
from talkcli.engine import protocol
from talkcli.engine.process import LONGEST, EngineProcess
from talkcli.engine.protocol import SILENCE_LIMIT
from talkcli.engine.supervisor import (
    BACK_OFF,
    LINES,
    PATIENCE,
    SHORT_LIFE,
    WHILE,
    EngineSaid,
    Handed,
    Restarts,
    Supervisor,
)
from tests.engine.threads import CONFIGURE

if TYPE_CHECKING:
    from talkcli.engine.supervisor import Report

LACKING = "no library"
YES = protocol.Say("g1", "yes", 200, 1.0, None, 50)


def test_the_wait_grows_with_each_process_that_never_got_ready() -> None:
    restarts, now = Restarts(100.0), 100.0
    for wait in (*BACK_OFF, BACK_OFF[-1], BACK_OFF[-1]):
        restarts.failed(now, now, LACKING)
        assert restarts.due_at == now + wait
        now = restarts.due_at


@pytest.mark.parametrize(("age", "had_goal"), [(SHORT_LIFE / 2, True), (SHORT_LIFE * 2, False)])
def test_a_process_that_was_of_use_costs_no_wait_and_resets_it(age: float, had_goal: bool) -> None:
    restarts = Restarts(100.0)
    for _ in range(4):
        restarts.failed(100.0, 100.0, None)
    restarts.died(200.0, age=age, had_goal=had_goal)
    assert restarts.due_at == 200.0
    restarts.failed(200.0, 200.0, None)
    assert restarts.due_at == 200.0 + BACK_OFF[0]


def test_a_process_that_dies_as_soon_as_it_is_ready_is_waited_for_longer_and_longer() -> None:
    restarts = Restarts(100.0)
    for wait in BACK_OFF:
        restarts.died(100.0, age=SHORT_LIFE / 2, had_goal=False)
        assert restarts.due_at == 100.0 + wait


def test_what_is_known_to_stay_is_an_error_until_the_next_start_says_otherwise() -> None:
    restarts = Restarts(100.0)
    assert not restarts.failed(100.0, 100.0, LACKING)
    assert restarts.error == LACKING
    restarts.error = None
    assert restarts.error is None
    restarts.died(200.0, age=SHORT_LIFE * 2, had_goal=False)
    restarts.failed(200.0, 200.0, LACKING)
    assert restarts.failed(200.0 + PATIENCE, 200.0 + PATIENCE, None), "goals wait again, and not for ever"
    assert restarts.error is None


def test_a_start_costs_a_goal_only_where_it_began_long_after_there_was_a_process() -> None:
    restarts = Restarts(100.0)
    assert not restarts.failed(100.0 + PATIENCE + 5, 100.0 + PATIENCE - 0.1, None)
    assert restarts.failed(100.0 + PATIENCE, 100.0 + PATIENCE, None)
    assert restarts.failed(100.0 + PATIENCE + 10, 100.0 + PATIENCE + 10, None)
    restarts.error = None
    restarts.died(300.0, age=SHORT_LIFE * 2, had_goal=False)
    assert not restarts.failed(300.0, 300.0, None)
    assert restarts.failed(300.0 + PATIENCE, 300.0 + PATIENCE, None)
    assert restarts.error is None


def _complaining(script: str) -> tuple[list[str], str]:
    """Return the lines that a process passes on which writes to standard error, and its last words."""
    lines: list[str] = []
    process = EngineProcess(CONFIGURE, lines.append, command=[sys.executable, "-c", f"import os\n{script}"])
    while process.stderr in ready({process.stderr: select.POLLIN}, 20.0) and process.read_stderr():
        pass
    words = process.last_words()
    process.close()
    return lines, words


def test_lines_are_passed_on_when_they_are_whole_and_the_last_is_a_crashs_own() -> None:
    lines, words = _complaining("for each in (b'one\\ntw', b'o\\n\\n  \\n thr\\xffee'): os.write(2, each)")
    assert lines == ["one", "two", " thr\ufffdee"]
    assert words == "it exited with status 0 (thr\ufffdee)"


def test_a_line_that_never_ends_is_not_kept() -> None:
    assert _complaining("for _ in range(100): os.write(2, b'x' * 65536)")[0] == ["x" * LONGEST]


def test_what_is_too_much_is_counted_and_told_with_the_next_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    passed: list[Report] = []
    engine, now = Supervisor(CONFIGURE, passed.append), 1000.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    for number in range(100):
        now = 1000.0 + number / 10
        engine._complain("x")
    assert passed == [EngineSaid("x")] * LINES
    for later in (WHILE - 0.1, WHILE, 2 * WHILE):
        now = 1000.0 + later
        engine._complain(f"{later}")
    told = [f"({100 + 1 - LINES} lines were left out)", f"{WHILE}", f"{2 * WHILE}"]
    assert passed[LINES:] == [EngineSaid(each) for each in told]
    engine._inbox.close()


class Undying:
    """Stands for a process that is ready, and that no kill ends for long."""

    def __init__(self) -> None:
        self.ready, self.used, self.failed, self.gone_by = True, False, None, 0.0
        self.socket, self._other = socket.socketpair()
        self.stderr = self._other.fileno()
        self.liveness = os.dup(self.stderr)
        self.kills = 0

    def kill(self) -> None:
        self.kills += 1

    def close(self) -> None:
        self.socket.close()
        self._other.close()
        os.close(self.liveness)


def _watching(process: EngineProcess, posted: list[Report]) -> Supervisor:
    """Return an engine thread that doesn't run, with this process."""
    engine = Supervisor(CONFIGURE, posted.append)
    for descriptor in (process.socket.fileno(), process.liveness):
        engine._selector.register(descriptor, selectors.EVENT_READ, process)
    engine._process = process
    engine._started_at = time.monotonic()
    return engine


@pytest.mark.parametrize("spoken", [True, False])
def test_a_process_that_dies_while_idle_was_of_use_if_it_has_spoken(spoken: bool) -> None:
    process = cast("EngineProcess", Undying())
    engine = _watching(process, [])
    engine._restarts.failed(0.0, 0.0, None)
    if spoken:
        engine._goal = Handed(YES, heard_at=0.0)
        engine._note(process, protocol.Ended(YES.id, protocol.COMPLETED, duration=0.1))
    engine._note(process, protocol.Alive(""))  # as one does that loads a voice
    before = time.monotonic()
    engine._lose_process("it is killed", "engine_crashed")
    assert (engine._restarts.due_at - before < BACK_OFF[1]) == spoken
    engine._bury(process)
    engine._inbox.close()


@pytest.mark.parametrize("in_time", [True, False])
def test_a_goal_ends_once_when_its_process_is_gone_or_should_be(monkeypatch: pytest.MonkeyPatch, in_time: bool) -> None:
    posted: list[Report] = []
    undying = Undying()
    process = cast("EngineProcess", undying)
    engine = _watching(process, posted)
    monkeypatch.setattr(engine, "_start", lambda: None)
    engine._goal = Handed(YES, heard_at=0.0, started=True)
    engine._lose_process("it hangs", "engine_hung")
    due = process.gone_by
    engine._keep_limits(due - SILENCE_LIMIT / 2)
    assert [type(each).__name__ for each in posted] == ["EngineDied"]
    assert undying.kills == 1
    if not in_time:
        engine._keep_limits(due)
        assert undying.kills == 2
        engine._keep_limits(due + 1)
        assert undying.kills == 2, "it was overdue once"
    engine._bury(process)
    assert [each.reason for each in posted[1:] if isinstance(each, protocol.Ended)] == [
        "engine_hung" if in_time else "not_silent"
    ]
    assert len(posted) == 2
    assert not engine._dying
    engine._inbox.close()
