"""Actions that are left for a thread that waits are done in order, and wake the thread only if they must."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from typing import TYPE_CHECKING

import pytest

from talkcli.engine.inbox import NEVER, Inbox

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

#: Seconds after which the other thread is late on the busiest machine.
PATIENCE = 20.0


class Sleeper:
    """A thread that does nothing but wait for actions; `wakes` counts the bytes that were written to wake it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, doze: float) -> None:
        self.inbox = Inbox(doze)
        self.wakes = 0
        self.asleep = threading.Event()
        self._ending = False
        select, write = self.inbox.selector.select, os.write

        def told(timeout: float | None = None) -> object:
            self.asleep.set()
            return select(timeout)

        def counted(descriptor: int, data: bytes) -> int:
            self.wakes += descriptor == self.inbox._wake
            return write(descriptor, data)

        monkeypatch.setattr(self.inbox.selector, "select", told)
        monkeypatch.setattr("os.write", counted)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        assert self.asleep.wait(PATIENCE)

    def _run(self) -> None:
        while not self._ending:
            self.inbox.wait(NEVER)

    def do(self, action: Callable[[], None]) -> None:
        """Have an action done, and wait for that and for the thread to sleep again."""
        done = threading.Event()

        def act() -> None:
            action()
            self.asleep.clear()
            done.set()

        self.inbox.call(act)
        assert done.wait(PATIENCE)
        assert self.asleep.wait(PATIENCE)

    def close(self) -> None:
        self.inbox.call(lambda: setattr(self, "_ending", True))
        self._thread.join(PATIENCE)
        assert not self._thread.is_alive()
        self.inbox.close()


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[float], Sleeper]]:
    """Starts threads that sleep; each is closed at the end."""
    with contextlib.ExitStack() as stack:
        yield lambda doze: stack.enter_context(contextlib.closing(Sleeper(monkeypatch, doze)))


def test_an_action_does_not_wake_a_thread_that_dozes_and_is_done_in_order(
    start: Callable[[float], Sleeper],
) -> None:
    sleeper, done = start(1000.0), list[str]()
    sleeper.do(lambda: None)
    wakes = sleeper.wakes
    for each in ("first", "second"):
        sleeper.inbox.call(lambda each=each: done.append(each), by=time.monotonic() + 1000)  # type: ignore[misc]
    assert sleeper.wakes == wakes
    sleeper.do(lambda: done.append("third"))
    assert done == ["first", "second", "third"]
    assert sleeper.wakes == wakes + 1


def test_an_action_that_is_due_before_the_thread_would_wake_wakes_it(start: Callable[[float], Sleeper]) -> None:
    sleeper, done = start(0.0), threading.Event()
    sleeper.do(lambda: None)
    wakes = sleeper.wakes
    sleeper.inbox.call(done.set, by=time.monotonic() + 1000)  # it does not doze, so it would sleep for ever
    assert done.wait(PATIENCE)
    assert sleeper.wakes == wakes + 1


def test_a_thread_that_dozes_does_its_actions_before_it_sleeps_on(
    start: Callable[[float], Sleeper],
) -> None:
    sleeper, done = start(0.2), threading.Event()
    sleeper.do(lambda: None)
    wakes = sleeper.wakes
    sleeper.inbox.call(done.set, by=time.monotonic() + 1000)
    assert done.wait(PATIENCE)
    assert sleeper.wakes <= wakes + 1  # one, where this test itself came later than the doze was long


def test_nothing_is_lost_and_nothing_overtakes_while_several_threads_hand_in(start: Callable[[float], Sleeper]) -> None:
    sleeper, done = start(0.001), list[tuple[int, int]]()
    count = 1000

    def hand_in(who: int) -> None:
        for number in range(count):
            by = 0.0 if number % 3 else time.monotonic() + 0.002 * (number % 2)
            sleeper.inbox.call(lambda number=number: done.append((who, number)), by)  # type: ignore[misc]

    threads = [threading.Thread(target=hand_in, args=(who,)) for who in range(3)]
    for each in threads:
        each.start()
    for each in threads:
        each.join(PATIENCE)
    sleeper.do(lambda: None)
    assert [[number for who, number in done if who == each] for each in range(3)] == [list(range(count))] * 3
    assert sleeper.wakes <= 3 * count + 1


def test_nothing_is_done_once_no_more_is_taken() -> None:
    inbox, done = Inbox(0.0), list[str]()
    inbox.close()
    inbox.call(lambda: done.append("late"))
    inbox.run()
    assert done == []


def test_an_inbox_is_not_closed_under_a_thread_that_wakes_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """The descriptor could be another file's by then, and get the byte."""
    inbox, closed, write = Inbox(0.0), threading.Event(), os.write

    def close() -> None:
        inbox.close()
        closed.set()

    def slowly(descriptor: int, data: bytes) -> int:
        threading.Thread(target=close).start()
        assert not closed.wait(0.1)
        return write(descriptor, data)

    monkeypatch.setattr(os, "write", slowly)
    monkeypatch.setattr(inbox, "_sleeps_until", NEVER)
    inbox.call(lambda: None)
    assert closed.wait(PATIENCE)
    inbox.call(lambda: None)  # nothing happens
