"""An engine thread that runs, and what it has posted: what its tests are made of."""

from __future__ import annotations

import contextlib
import os
import queue
import sys
from typing import TYPE_CHECKING, TypeVar

import pytest

from talkcli.engine import protocol
from talkcli.engine.supervisor import Supervisor
from tests.support import scripted_engine

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from talkcli.engine.supervisor import Report

_R = TypeVar("_R")

#: Seconds after which a report is late on the busiest machine.
PATIENCE = 20.0


class Thread:
    """A running engine thread and what it has posted."""

    def __init__(self) -> None:
        self.seen: list[Report] = []
        self._posted: queue.Queue[Report] = queue.Queue()
        self.engine = Supervisor(protocol.Configure(os.getpid(), None, None, None, None), self._posted.put)
        self.engine.thread.start()

    def say(self, text: str, goal: str = "g1") -> None:
        self.engine.say(protocol.Say(goal, text, 200, 1.0, None, 50))

    def next(self, seconds: float = PATIENCE) -> Report | None:
        """Return the next report, None if there is none for so long."""
        with contextlib.suppress(queue.Empty):
            self.seen.append(self._posted.get(timeout=seconds))
            return self.seen[-1]
        return None

    def until(self, kind: type[_R]) -> _R:
        while (report := self.next()) is not None:
            if isinstance(report, kind):
                return report
        raise AssertionError(f"no {kind.__name__} in {self.seen}")

    def close(self) -> None:
        self.engine.close()
        self.engine.thread.join(PATIENCE)


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], Thread]]:
    """Starts an engine thread with the scripted engine as its process."""
    monkeypatch.setattr("talkcli.engine.process.engine_command", lambda: [sys.executable, scripted_engine.__file__])
    with contextlib.ExitStack() as stack:

        def make() -> Thread:
            thread = Thread()
            stack.callback(thread.close)
            return thread

        yield make
