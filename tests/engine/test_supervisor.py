"""Tests for the engine thread, with the scripted engine as its process.

Whatever happens to the process, every goal ends.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import sys
import threading
import time
from typing import TYPE_CHECKING, Any, cast

import pytest

from talkcli.engine import protocol
from talkcli.engine.parent import supervisor
from talkcli.engine.parent.process import MAX_STDERR_LINE_BYTES, EngineProcess
from talkcli.engine.parent.supervisor import ENGINE_WAIT_LIMIT_S as WAITED
from talkcli.engine.parent.supervisor import (
    MAX_STDERR_LINES,
    MIN_LIFETIME_S,
    RESTART_DELAYS_S,
    STDERR_PERIOD_S,
    ActionQueue,
    EngineDied,
    EngineMissing,
    EngineSaid,
    RestartPolicy,
    SupervisedGoal,
    Supervisor,
)
from talkcli.engine.protocol import KILL_LIMIT_S, OUTCOME_COMPLETED, OUTCOME_FAILED, OUTCOME_STOPPED
from talkcli.goals.reasons import Reason
from talkcli.polling import wait_ready
from tests.engine.threads import CONFIGURE, PATIENCE, EngineThread, python_engine

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from talkcli.engine.parent.supervisor import Report
    from tests.engine.threads import StartThread

YES = protocol.Speak("g1", "yes", 200, 1.0, None, 50)
#: The expected end of `YES`.
SPOKEN = protocol.Ended("g1", OUTCOME_COMPLETED, duration=0.1)


def _pauses(thread: EngineThread) -> int:
    """Return the number of confirmed pauses."""
    return sum(isinstance(report, protocol.Held) for report in thread.seen)


def _pause(thread: EngineThread, text: str) -> None:
    """Start a goal, and request a pause during its first word."""
    thread.say(text)
    thread.until(protocol.Word)
    thread.engine.pause("g1", 1)


def _process(thread: EngineThread) -> EngineProcess:
    thread.until(protocol.Ready)
    assert thread.engine._process is not None
    return thread.engine._process


# -- pauses


def test_a_pause_may_exceed_all_limits_and_resumes_in_place(start: StartThread) -> None:
    thread = start(HANG_LIMIT_S=0.7, HOLD_LIMIT_S=0.7)
    started_at = time.monotonic()
    _pause(thread, "length=0.4 slow-pause=0.1 two three four")
    assert thread.until(protocol.Held).id == "g1"
    assert thread.next(1.0) is None
    thread.engine.resume("g1")
    assert thread.until(protocol.Ended).outcome == OUTCOME_COMPLETED
    assert time.monotonic() - started_at >= 0.4 + 1.0
    assert [report.number for report in thread.seen if isinstance(report, protocol.Word)] == [1, 2, 3, 4, 5]


def test_a_resumed_goal_need_not_confirm_its_pause(start: StartThread) -> None:
    thread = start(HOLD_LIMIT_S=0.2)
    _pause(thread, "length=0.5 ignore-pause")
    thread.engine.resume("g1")
    assert thread.until(protocol.Ended).outcome == OUTCOME_COMPLETED
    assert not _pauses(thread)


def test_an_unconfirmed_pause_kills_the_process(start: StartThread) -> None:
    thread = start(HOLD_LIMIT_S=0.3)
    started_at = time.monotonic()
    _pause(thread, "never-ends ignore-pause")
    ended = thread.until(protocol.Ended)
    assert time.monotonic() - started_at >= 0.3
    assert (ended.reason, ended.message) == ("engine_hung", "the engine did not confirm a pause within 0.3 s")
    assert thread.spoken("yes", "g2").outcome == OUTCOME_COMPLETED


def test_a_pause_is_reported_at_silence_but_not_after_a_resume(start: StartThread) -> None:
    thread = start()
    started_at = time.monotonic()
    _pause(thread, "length=0.7 slow-pause=0.3")
    thread.until(protocol.Held)
    assert time.monotonic() - started_at >= 0.3
    thread.engine.resume("g1")
    thread.engine.pause("g1", 2)
    thread.engine.resume("g1")
    thread.until(protocol.Ended)
    assert _pauses(thread) == 1


def test_a_late_confirmation_does_not_count_for_a_new_pause(start: StartThread) -> None:
    thread = start()
    _pause(thread, "length=0.6 stale-pause slow-pause=0.2")
    thread.engine.resume("g1")
    thread.engine.pause("g1", 2)
    assert thread.until(protocol.Held) == protocol.Held("g1", 2)
    thread.engine.resume("g1")
    thread.until(protocol.Ended)
    assert _pauses(thread) == 1


def test_a_goal_waiting_for_a_process_is_paused_by_the_thread(start: StartThread) -> None:
    thread = start("slow=0.3")
    thread.say("two words")
    thread.engine.pause("g1", 1)
    assert thread.next() == protocol.Held("g1", 1)
    thread.until(protocol.VoiceList)
    assert thread.next(0.2) is None
    thread.engine.resume("g1")
    assert isinstance(thread.next(), protocol.Word)
    assert thread.until(protocol.Ended).outcome == OUTCOME_COMPLETED


def test_a_goal_paused_by_the_thread_is_stopped_at_once(start: StartThread) -> None:
    thread = start("slow=0.3")
    thread.say("two words")
    thread.engine.pause("g1", 1)
    thread.engine.stop("g1")
    assert [thread.next(), thread.next()] == [protocol.Held("g1", 1), protocol.Ended("g1", OUTCOME_STOPPED)]
    assert thread.spoken("the next is not paused", "g2") == protocol.Ended("g2", OUTCOME_COMPLETED, duration=0.1)


@pytest.mark.parametrize("on_stop", ["", "on-stop=crash"])
def test_a_paused_goal_can_be_stopped(start: StartThread, on_stop: str) -> None:
    thread = start()
    _pause(thread, f"never-ends {on_stop}")
    thread.until(protocol.Held)
    thread.engine.stop("g1")
    thread.engine.pause("g1", 1)
    assert thread.until(protocol.Ended).outcome == OUTCOME_STOPPED
    assert _pauses(thread) == 1


def test_a_crash_before_the_pause_is_confirmed_ends_the_goal(start: StartThread) -> None:
    thread = start()
    _pause(thread, "length=0.2 at=0.9 crash slow-pause=5")
    ended = thread.until(protocol.Ended)
    assert (ended.outcome, ended.reason) == (OUTCOME_FAILED, "engine_crashed")
    thread.engine.resume("g1")
    assert thread.spoken("yes", "g2").outcome == OUTCOME_COMPLETED


def test_a_pause_or_resume_of_another_goal_changes_nothing(start: StartThread) -> None:
    thread = start()
    thread.engine.pause("g1", 1)
    thread.say("length=0.2")
    thread.engine.pause("g0", 1)
    thread.engine.resume("g1")
    assert thread.until(protocol.Ended).outcome == OUTCOME_COMPLETED
    assert not _pauses(thread)


# -- sending a goal to the process


@pytest.fixture
def start_python(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Callable[..., EngineThread]]:
    """Return a function that starts an engine thread with a `python_engine` as its process."""
    with contextlib.ExitStack() as stack:

        def make(*lines: str) -> EngineThread:
            monkeypatch.setattr("talkcli.engine.parent.process.engine_command", lambda: python_engine(tmp_path, *lines))
            return stack.enter_context(contextlib.closing(EngineThread()))

        yield make


@pytest.mark.parametrize("waits", [True, False])
def test_the_process_learns_whether_another_goal_waits(start_python: Callable[..., EngineThread], waits: bool) -> None:
    reply = (
        'protocol.Ended(command.id, protocol.OUTCOME_COMPLETED, None, f"{command.next_waits} {command.next_is_neural}")'
    )
    thread = start_python("send(protocol.Started(command.id))", f"send({reply})")
    thread.engine.announce_next("g1", waits, next_is_neural=True)  # no process is ready yet
    thread.until(protocol.Ready)
    thread.say("battery low")
    thread.engine.announce_next("g1", waits, next_is_neural=True)
    assert thread.until(protocol.Ended) == protocol.Ended("g1", OUTCOME_COMPLETED, None, f"{waits} True")


def test_a_process_that_reads_late_gets_all_of_a_growing_text(start_python: Callable[..., EngineThread]) -> None:
    other = 'seen = globals().setdefault("seen", []); seen.append(getattr(command, "text", ""))'
    reply = 'protocol.Ended(command.id, protocol.OUTCOME_COMPLETED, None, str(len("".join(seen))))'
    other = f'{other}; getattr(command, "end", False) and send({reply})'
    thread = start_python("send(protocol.Started(command.id))", other)
    process, sent = _process(thread), threading.Event()
    thread.engine.speak(protocol.Speak("g1", "a", 200, 1.0, None, 50, more=True))
    os.kill(process.pid, signal.SIGSTOP)
    for length in range(2, 5_001):
        thread.engine.announce_next("g1", length % 2 == 0, next_is_neural=False)
        thread.engine.append("g1", "a" * length, complete=length == 5_000, broke_off=False)
    thread.engine._actions.call(sent.set)
    assert sent.wait(PATIENCE)
    os.kill(process.pid, signal.SIGCONT)
    assert thread.until(protocol.Ended).message == "4999"


def test_a_goal_sent_to_a_dying_process_is_spoken_by_the_next(start: StartThread) -> None:
    thread = start()
    thread.until(protocol.Ready)
    for number in range(5):
        process = thread.engine._process
        assert process is not None
        os.kill(process.pid, signal.SIGKILL)
        ended = thread.spoken("length=0.01", f"g{number}")
        assert ended == protocol.Ended(f"g{number}", OUTCOME_COMPLETED, duration=0.01)


def test_a_goal_fails_if_two_processes_die_before_starting_it(start: StartThread) -> None:
    thread = start()
    ended = thread.spoken("silent-start length=0 crash")
    assert (ended.outcome, ended.reason) == (OUTCOME_FAILED, "engine_crashed")
    assert sum(isinstance(report, EngineDied) for report in thread.seen) == 2
    assert thread.spoken("yes", "g2").outcome == OUTCOME_COMPLETED


def _interrupted(rest: int) -> protocol.Ended:
    return protocol.Ended("g1", protocol.OUTCOME_INTERRUPTED, rest=rest)


def test_an_interrupted_goal_ends_once_and_can_be_continued(start: StartThread) -> None:
    thread = start()
    thread.say("never-ends length=9 two")
    thread.until(protocol.Word)
    thread.engine.interrupt("g2")  # another goal
    thread.engine.interrupt("g1")
    thread.engine.stop("g1")
    assert thread.until(protocol.Ended) == _interrupted(rest=11)
    assert thread.spoken("yes", "g1") == SPOKEN


def test_a_goal_that_no_process_has_started_is_interrupted_before_its_first_word(start: StartThread) -> None:
    thread = start("slow=0.3")
    thread.say("yes")
    thread.engine.interrupt("g1")
    assert thread.until(protocol.Ended) == _interrupted(rest=0)
    thread.until(protocol.Ready)
    _signal(thread, signal.SIGSTOP)
    thread.say("yes")
    thread.engine.interrupt("g1")
    _signal(thread, signal.SIGKILL)
    assert thread.until(protocol.Ended) == _interrupted(rest=0)
    assert thread.spoken("yes", "g1") == SPOKEN


def test_an_interrupted_goal_that_has_started_fails_with_its_process(start: StartThread) -> None:
    thread = start()
    thread.say("never-ends")  # without another word, the process continues it
    thread.until(protocol.Word)
    thread.engine.interrupt("g1")
    _signal(thread, signal.SIGKILL)
    assert thread.until(protocol.Ended).reason == "engine_crashed"


def _signal(thread: EngineThread, number: int) -> None:
    process = thread.engine._process
    assert process is not None
    os.kill(process.pid, number)


def test_an_abandoned_process_gets_no_other_goal(start: StartThread) -> None:
    thread = start()
    thread.say("never-ends ignore-stop")
    thread.until(protocol.Word)
    abandoned = thread.engine._process
    thread.engine.give_up("g1")
    assert thread.spoken("yes", "g2") == protocol.Ended("g2", OUTCOME_COMPLETED, duration=0.1)
    assert thread.engine._process is not abandoned


def test_abandoning_a_goal_that_has_ended_keeps_the_process(start: StartThread) -> None:
    thread = start()
    thread.spoken("length=0")
    process = thread.engine._process
    thread.engine.give_up("g1")
    for number in (2, 3):
        assert thread.spoken("yes", f"g{number}").id == f"g{number}"
    assert thread.engine._process is process


def test_a_goal_submitted_just_before_the_shutdown_ends(start: StartThread, monkeypatch: pytest.MonkeyPatch) -> None:
    thread, submitted = start(), threading.Event()
    post = thread.engine._post

    def slow(report: Report) -> None:
        post(report)
        if isinstance(report, protocol.Ended) and report.id == "g0":
            submitted.wait(PATIENCE)  # the goal and `close` arrive while the thread is busy

    monkeypatch.setattr(thread.engine, "_post", slow)
    assert thread.spoken("length=0", "g0").id == "g0"
    thread.say("never-ends")
    thread.engine.close()
    submitted.set()
    ended = thread.until(protocol.Ended)
    assert (ended.id, ended.reason) == ("g1", "shutdown")


# -- the process


def test_after_a_suspend_messages_come_before_time_limits(start: StartThread, monkeypatch: pytest.MonkeyPatch) -> None:
    suspensions = [0.6]

    class Clock:
        def __getattr__(self, name: str) -> Any:
            return getattr(time, name)

        def monotonic(self) -> float:
            if words and suspensions and sys._getframe(1).f_code.co_name == "_run":  # between two turns of the loop
                time.sleep(suspensions.pop())
            return time.monotonic()

    words: list[protocol.Word] = []
    thread = start(HANG_LIMIT_S=0.5)
    monkeypatch.setattr(supervisor, "time", Clock())
    thread.say("length=0.9 b c d e f g h i j k")
    words.append(thread.until(protocol.Word))
    assert thread.until(protocol.Ended).outcome == OUTCOME_COMPLETED
    assert not suspensions


def test_a_hanging_start_is_retried_and_later_fails_one_goal_each_time(
    start: StartThread, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    script = tmp_path / "start"
    script.write_text("hang")
    monkeypatch.setenv("SCRIPTED_START_FILE", str(script))
    thread = start(START_LIMIT_S=0.2, ENGINE_WAIT_LIMIT_S=0.35, RESTART_DELAYS_S=(0.0,))
    started_at = time.monotonic()
    message = "the engine was not ready within 0.2 s"
    assert thread.spoken("battery low") == protocol.Ended("g1", OUTCOME_FAILED, Reason.ENGINE_FAILED, message)
    assert time.monotonic() - started_at >= 2 * 0.2, "the goal failed before ENGINE_WAIT_LIMIT_S"
    assert thread.until(EngineMissing) == EngineMissing(message)  # the thread has no goal that it could fail
    thread.say("coming home", "g2")
    script.write_text("")
    monkeypatch.setattr(supervisor, "START_LIMIT_S", 10.0)
    assert thread.until(protocol.Ended).outcome == OUTCOME_COMPLETED


class UndyingProcess:
    """A stand-in for a ready process that survives being killed."""

    def __init__(self) -> None:
        self.ready, self.had_goal = True, False
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


def _make_supervisor(process: EngineProcess, posted: list[Report]) -> Supervisor:
    """Return a supervisor with this process, without running its thread."""
    engine = Supervisor(CONFIGURE, posted.append)
    for descriptor in (process.socket.fileno(), process.liveness):
        engine._watched[descriptor] = process
    engine._process = process
    engine._started_at = time.monotonic()
    return engine


@pytest.mark.parametrize("spoken", [True, False])
def test_a_process_that_dies_idle_is_replaced_sooner_if_it_has_spoken(spoken: bool) -> None:
    process = cast("EngineProcess", UndyingProcess())
    engine = _make_supervisor(process, [])
    engine._restarts.start_failed(0.0, 0.0, None)
    if spoken:
        engine._goal = SupervisedGoal(YES, sent=True)
        engine._handle_event(process, SPOKEN)
    engine._handle_event(process, protocol.Alive(""))  # as if the process were loading a voice
    before = time.monotonic()
    engine._kill_process("it is killed", Reason.ENGINE_CRASHED)
    assert (engine._restarts.next_start_at - before < RESTART_DELAYS_S[1]) == spoken
    engine._release_process(process)
    engine._actions.close()


@pytest.mark.parametrize("in_time", [True, False])
def test_a_goal_ends_once_when_its_process_is_gone_or_overdue(monkeypatch: pytest.MonkeyPatch, in_time: bool) -> None:
    posted: list[Report] = []
    undying = UndyingProcess()
    process = cast("EngineProcess", undying)
    engine = _make_supervisor(process, posted)
    starts: list[float] = []
    monkeypatch.setattr(engine, "_start_process", lambda: starts.append(time.monotonic()))
    engine._goal = SupervisedGoal(YES, sent=True, started=True)
    engine._kill_process("it hangs", Reason.ENGINE_HUNG)
    due = engine._dying[process]
    engine._handle_deadlines(due - KILL_LIMIT_S / 2)
    assert [type(report).__name__ for report in posted] == ["EngineDied"]
    assert (undying.kills, len(starts)) == (1, 1), "the next process waited for the dying one"
    if not in_time:
        engine._handle_deadlines(due)
        assert undying.kills == 2
        engine._handle_deadlines(due + 1)
        assert undying.kills == 2, "the overdue process was killed again"
    engine._release_process(process)
    reason = "engine_hung" if in_time else "not_silent"
    assert [report.reason for report in posted[1:] if isinstance(report, protocol.Ended)] == [reason]
    assert len(posted) == 2
    assert not engine._dying
    engine._actions.close()


# -- restarts

NO_LIBRARY = "no library"


def test_the_restart_delay_grows_with_each_failed_start_or_early_death() -> None:
    failing, dying, now = RestartPolicy(100.0), RestartPolicy(100.0), 100.0
    for delay in (*RESTART_DELAYS_S, RESTART_DELAYS_S[-1], RESTART_DELAYS_S[-1]):
        failing.start_failed(now, now, NO_LIBRARY)
        dying.process_died(now, age_s=MIN_LIFETIME_S / 2, had_goal=False)
        assert failing.next_start_at == dying.next_start_at == now + delay
        now = failing.next_start_at


@pytest.mark.parametrize(("age", "had_goal"), [(MIN_LIFETIME_S / 2, True), (MIN_LIFETIME_S * 2, False)])
def test_the_death_of_a_useful_process_resets_the_delay(age: float, had_goal: bool) -> None:
    restarts = RestartPolicy(100.0)
    for _ in range(4):
        restarts.start_failed(100.0, 100.0, None)
    restarts.process_died(200.0, age_s=age, had_goal=had_goal)
    assert restarts.next_start_at == 200.0
    restarts.start_failed(200.0, 200.0, None)
    assert restarts.next_start_at == 200.0 + RESTART_DELAYS_S[0]


def test_a_permanent_error_lasts_until_a_start_fails_without_one() -> None:
    restarts = RestartPolicy(100.0)
    assert not restarts.start_failed(100.0, 100.0, NO_LIBRARY)
    assert restarts.permanent_error == NO_LIBRARY
    restarts.permanent_error = None
    restarts.process_died(200.0, age_s=MIN_LIFETIME_S * 2, had_goal=False)
    restarts.start_failed(200.0, 200.0, NO_LIBRARY)
    assert restarts.start_failed(200.0 + WAITED, 200.0 + WAITED, None)  # goals wait again, but not forever
    assert restarts.permanent_error is None


def test_a_failed_start_fails_a_goal_only_long_after_the_last_process() -> None:
    restarts = RestartPolicy(100.0)
    assert not restarts.start_failed(100.0 + WAITED + 5, 100.0 + WAITED - 0.1, None)
    assert restarts.start_failed(100.0 + WAITED, 100.0 + WAITED, None)
    assert restarts.start_failed(100.0 + WAITED + 10, 100.0 + WAITED + 10, None)
    restarts.process_died(300.0, age_s=MIN_LIFETIME_S * 2, had_goal=False)
    assert not restarts.start_failed(300.0, 300.0, None)
    assert restarts.start_failed(300.0 + WAITED, 300.0 + WAITED, None)


# -- standard error of the process


def _run_process(script: str) -> tuple[list[str], str]:
    """Run a script as the engine process, and return its lines of standard error and a description of its exit."""
    lines: list[str] = []
    command = [sys.executable, "-c", f"import os\n{script}"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("talkcli.engine.parent.process.engine_command", lambda: command)
        process = EngineProcess(CONFIGURE, lines.append)
    while process.stderr in wait_ready({process.stderr: select.POLLIN}, 20.0) and process.read_stderr():
        pass
    exit_message = process.reap()
    process.close()
    return lines, exit_message


def test_complete_lines_are_reported_and_the_last_one_explains_the_exit() -> None:
    lines, exit_message = _run_process("for data in (b'one\\ntw', b'o\\n\\n  \\n thr\\xffee'): os.write(2, data)")
    assert lines == ["one", "two", " thr\ufffdee"]
    assert exit_message == "it exited with status 0 (thr\ufffdee)"
    endless_line = "for _ in range(100): os.write(2, b'x' * 65536)"
    assert _run_process(endless_line)[0] == ["x" * MAX_STDERR_LINE_BYTES]


def test_omitted_lines_are_counted_and_reported_with_the_next_line(monkeypatch: pytest.MonkeyPatch) -> None:
    posted: list[Report] = []
    engine, now = Supervisor(CONFIGURE, posted.append), 1000.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    for number in range(100):
        now = 1000.0 + number / 10
        engine._report_stderr("x")
    assert posted == [EngineSaid("x")] * MAX_STDERR_LINES
    for seconds in (STDERR_PERIOD_S - 0.1, STDERR_PERIOD_S, 2 * STDERR_PERIOD_S):
        now = 1000.0 + seconds
        engine._report_stderr(f"{seconds}")
    omitted = f"({100 + 1 - MAX_STDERR_LINES} lines were omitted)"
    expected = [omitted, f"{STDERR_PERIOD_S}", f"{2 * STDERR_PERIOD_S}"]
    assert posted[MAX_STDERR_LINES:] == [EngineSaid(line) for line in expected]
    engine._actions.close()


def test_standard_error_is_reported_with_the_traceback_of_a_crash(start_python: Callable[..., EngineThread]) -> None:
    complains = """
for word in command.text.split():
    if word == "raise":
        raise ValueError("no tongue")
    sys.stderr.write(word + "\\n")
sys.stderr.flush()
send(protocol.Ended(command.id, protocol.OUTCOME_COMPLETED))
"""
    thread = start_python(complains)
    thread.say("one two")
    while sum(isinstance(report, EngineSaid) for report in thread.seen) < 2:
        assert thread.next() is not None
    thread.say("raise", "g2")
    died = thread.until(EngineDied)
    assert died.message == "the engine crashed: it exited with status 1 (ValueError: no tongue)"
    lines = [report.line for report in thread.seen if isinstance(report, EngineSaid)]
    assert lines[:3] == ["one", "two", "Traceback (most recent call last):"]
    assert lines[-1] == "ValueError: no tongue"


# -- the queue of actions


def test_any_number_of_actions_of_several_threads_is_neither_lost_nor_reordered() -> None:
    queue, done = ActionQueue(), list[tuple[int, int]]()
    count = 30_000  # more than the pipe that wakes the thread can hold

    def submit(sender: int) -> None:
        for number in range(count):
            queue.call(lambda number=number: done.append((sender, number)))  # type: ignore[misc]

    threads = [threading.Thread(target=submit, args=(sender,)) for sender in range(3)]
    for thread in threads:
        thread.start()
    while len(done) < 3 * count:
        assert wait_ready({queue.fileno(): select.POLLIN}, PATIENCE)
        queue.run()
    for thread in threads:
        thread.join(PATIENCE)
    for sender in range(3):
        assert [number for source, number in done if source == sender] == [*range(count)]
    queue.close()
    queue.call(done.clear)  # a later action is ignored
    assert done
