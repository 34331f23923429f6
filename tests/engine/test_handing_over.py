"""A goal goes to the engine process without a detour, and whatever happens to the process it is spoken, or ends."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from typing import TYPE_CHECKING, cast

import pytest

from talkcli.engine import protocol, supervisor
from talkcli.engine.supervisor import EngineDied, Supervisor
from tests.engine.threads import CONFIGURE, PATIENCE, Thread, answering

if TYPE_CHECKING:
    import selectors
    from collections.abc import Callable
    from pathlib import Path

    from talkcli.engine.process import EngineProcess
    from talkcli.engine.supervisor import Report


@pytest.mark.parametrize("followed", [True, False])
def test_the_process_is_told_whether_a_goal_follows(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, followed: bool
) -> None:
    told = 'protocol.Ended(command.id, protocol.COMPLETED, f"{command.followed} {command.by_neural}")'
    program = answering(tmp_path, "tell(protocol.Started(command.id))", f"tell({told})")
    monkeypatch.setattr("talkcli.engine.process.engine_command", lambda: program)
    with contextlib.closing(Thread()) as thread:
        thread.engine.follow("g1", followed, by_neural=True)  # there is none yet that could be told
        thread.until(protocol.Ready)
        thread.say("battery low")
        thread.engine.follow("g1", followed, by_neural=True)
        assert thread.until(protocol.Ended) == protocol.Ended("g1", protocol.COMPLETED, f"{followed} True")


def test_a_goal_behind_another_wakes_the_thread_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """By its answer, which comes in one piece: it was begun and played."""
    program = answering(tmp_path, "tell(protocol.Started(command.id), protocol.Ended(command.id, protocol.COMPLETED))")
    monkeypatch.setattr("talkcli.engine.process.engine_command", lambda: program)
    monkeypatch.setattr(supervisor, "HANG_AFTER", 600.0)  # so that no goal is slow enough on any machine
    with contextlib.closing(Thread()) as thread:
        thread.until(protocol.Ready)
        thread.spoken("the first may find it asleep for longer", "g0")
        woken: list[list[int]] = []
        select = thread.engine._selector.select

        def counted(timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
            found = select(timeout)
            woken.append([key.fd for key, _ in found])
            return found

        monkeypatch.setattr(thread.engine._selector, "select", counted)
        for number in range(1, 51):
            assert thread.spoken("yes", f"g{number}") == protocol.Ended(f"g{number}", protocol.COMPLETED)
        # By what the process said, and by nothing else; its answer to the first may have come to a `select` before.
        process = thread.engine._process
        assert process is not None
        assert {each for fds in woken for each in fds} == {process.socket.fileno()}
        # A thread that was not asleep yet looks once more; where it is, that is one for a goal.
        assert sum(bool(fds) for fds in woken) <= 50


def test_a_process_that_hangs_is_noticed_although_nobody_woke_the_thread(
    start: Callable[[], Thread], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervisor, "HANG_AFTER", 0.5)
    thread = start()
    assert thread.spoken("length=0").outcome == protocol.COMPLETED
    # handed over while the thread dozes
    assert thread.spoken("length=0.05 hang", "g2").reason == "engine_hung"
    assert thread.spoken("yes", "g3").outcome == protocol.COMPLETED
    assert thread.next(0.7) is None  # it does not doze any more
    assert thread.spoken("length=0.05 hang", "g4").reason == "engine_hung"


class Swift:
    """Stands for a process that has answered before anybody looked."""

    def __init__(self) -> None:
        self._said: list[str] = []

    def send(self, command: protocol.Command) -> bool:
        if isinstance(command, protocol.Say):
            self._said.append(command.id)
        return True

    def receive(self) -> list[protocol.Event]:
        return [protocol.Ended(each, protocol.COMPLETED) for each in self._said]


def test_the_answer_to_a_goal_is_understood_although_the_goal_has_not_been_noted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    posted: list[Report] = []
    engine, process = Supervisor(CONFIGURE, posted.append), Swift()
    for name in ("_process", "_open"):
        monkeypatch.setattr(engine, name, process)
    engine.say(protocol.Say("g1", "yes", 200, 1.0, None, 50))
    engine._hear(cast("EngineProcess", process))
    assert posted == [protocol.Ended("g1", protocol.COMPLETED)]
    engine._inbox.close()


class Lost:
    """Stands for a process that is lost while a goal is being sent to it."""

    def __init__(self, *, takes: bool) -> None:
        self._takes = takes

    def send(self, _: protocol.Command) -> bool:
        return self._takes


@pytest.mark.parametrize("takes", [True, False], ids=["taken by the system", "refused"])
def test_a_goal_that_was_sent_to_a_process_that_is_lost_is_spoken_by_the_next(
    start: Callable[[], Thread], monkeypatch: pytest.MonkeyPatch, takes: bool
) -> None:
    monkeypatch.setattr(supervisor, "HANG_AFTER", 1.0)  # so long a thread may doze that nothing wakes
    thread = start()
    thread.until(protocol.Ready)
    monkeypatch.setattr(thread.engine, "_open", Lost(takes=takes))
    assert thread.spoken("yes") == protocol.Ended("g1", protocol.COMPLETED, duration=0.1)
    assert not any(isinstance(each, EngineDied) for each in thread.seen)


def test_a_process_that_takes_no_goal_is_ended_and_the_goal_is_the_next_ones(
    start: Callable[[], Thread], monkeypatch: pytest.MonkeyPatch
) -> None:
    thread = start()
    thread.until(protocol.Ready)
    process = thread.engine._process
    assert process is not None
    monkeypatch.setattr(process, "send", lambda _: False)
    thread.say("yes")
    assert thread.until(EngineDied).words == "the engine takes no commands"
    assert thread.until(protocol.Ended) == protocol.Ended("g1", protocol.COMPLETED, duration=0.1)


def test_a_goal_that_is_sent_to_a_process_in_its_death_is_spoken_by_the_next(start: Callable[[], Thread]) -> None:
    thread = start()
    thread.until(protocol.Ready)
    for number in range(10):
        process = thread.engine._process
        assert process is not None
        os.kill(process.pid, signal.SIGKILL)
        ended = thread.spoken("length=0.01", f"g{number}")
        assert ended == protocol.Ended(f"g{number}", protocol.COMPLETED, duration=0.01)


def test_a_goal_for_which_two_processes_die_before_they_begin_with_it_ends(start: Callable[[], Thread]) -> None:
    thread = start()
    ended = thread.spoken("silent-start length=0 crash")
    assert (ended.outcome, ended.reason) == (protocol.FAILED, "engine_crashed")
    assert sum(isinstance(each, EngineDied) for each in thread.seen) == 2
    assert thread.spoken("yes", "g2").outcome == protocol.COMPLETED


def test_a_process_that_was_given_up_gets_no_other_goal(start: Callable[[], Thread]) -> None:
    thread = start()
    thread.say("never-ends ignore-stop")
    thread.until(protocol.Word)
    lost = thread.engine._process
    thread.engine.give_up("g1")
    assert thread.spoken("yes", "g2") == protocol.Ended("g2", protocol.COMPLETED, duration=0.1)
    assert thread.engine._process is not lost


def test_a_goal_that_ended_before_it_was_given_up_costs_no_process(start: Callable[[], Thread]) -> None:
    thread = start()
    thread.spoken("length=0")
    process = thread.engine._process
    thread.engine.give_up("g1")
    for number in (2, 3):
        assert thread.spoken("yes", f"g{number}").id == f"g{number}"
    assert thread.engine._process is process
    assert thread.engine._open is process


def test_a_closed_process_takes_no_command(start: Callable[[], Thread]) -> None:
    thread = start()
    thread.until(protocol.Ready)
    process = thread.engine._process
    thread.close()
    assert process is not None
    assert not process.send(protocol.Stop("g1"))


def test_a_goal_that_is_handed_in_just_before_the_end_has_its_end(
    start: Callable[[], Thread], monkeypatch: pytest.MonkeyPatch
) -> None:
    thread, held = start(), threading.Event()
    post = thread.engine._post

    def slow(report: Report) -> None:
        post(report)
        if isinstance(report, protocol.Ended) and report.id == "g0":
            held.wait(PATIENCE)  # both come while it is at work, and finds next that it is to end

    monkeypatch.setattr(thread.engine, "_post", slow)
    assert thread.spoken("length=0", "g0").id == "g0"
    thread.say("never-ends")
    thread.engine.close()
    held.set()
    ended = thread.until(protocol.Ended)
    assert (ended.id, ended.reason) == ("g1", "shutdown")
