"""An engine thread for tests, which collects the reports that it posts."""

from __future__ import annotations

import contextlib
import os
import queue
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

import talkcli
from talkcli.engine import protocol
from talkcli.engine.parent.supervisor import Supervisor

if TYPE_CHECKING:
    from pathlib import Path

    from talkcli.engine.parent.supervisor import Report

_R = TypeVar("_R")

#: Seconds after which a report is late even on a busy machine.
PATIENCE = 20.0
CONFIGURE = protocol.Configure(os.getpid(), None, None, None, None)
#: An engine process that is ready at once. `say` is its code for a goal, and `other` its code for any other command.
_PYTHON_ENGINE = """
import os, sys
sys.path.insert(0, {root!r})
from talkcli.engine import protocol
def send(*events):
    os.write(0, b"".join(map(protocol.encode, events)))
for line in os.fdopen(0, "rb"):
    command = protocol.decode(line, protocol.COMMAND_CLASSES)
    if isinstance(command, protocol.Configure):
        send(protocol.Ready("answers", None, None))
    elif isinstance(command, protocol.Speak):
        {say}
    else:
        {other}
"""


def python_engine(folder: Path, say: str, other: str = "pass") -> list[str]:
    """Return the command line of an engine process that runs these lines of Python for each command."""
    program = folder / "engine.py"
    root = os.path.dirname(os.path.dirname(talkcli.__file__))
    program.write_text(_PYTHON_ENGINE.format(root=root, say=say.replace("\n", "\n        "), other=other))
    return [sys.executable, str(program)]


class EngineThread:
    """A running engine thread, with the reports that it has posted."""

    def __init__(self) -> None:
        self.seen: list[Report] = []
        self._posted: queue.Queue[Report] = queue.Queue()
        self.engine = Supervisor(CONFIGURE, self._posted.put)
        self.engine.thread.start()

    def say(self, text: str, goal: str = "g1") -> None:
        self.engine.speak(protocol.Speak(goal, text, 200, 1.0, None, 50))

    def next(self, seconds: float = PATIENCE) -> Report | None:
        """Return the next report, or None if none arrives in time."""
        with contextlib.suppress(queue.Empty):
            self.seen.append(self._posted.get(timeout=seconds))
            return self.seen[-1]
        return None

    def until(self, kind: type[_R]) -> _R:
        while (report := self.next()) is not None:
            if isinstance(report, kind):
                return report
        raise AssertionError(f"no {kind.__name__} in {self.seen}")

    def spoken(self, text: str, goal: str = "g1") -> protocol.Ended:
        """Speak a text, and return the event of its end."""
        self.say(text, goal)
        return self.until(protocol.Ended)

    def close(self) -> None:
        self.engine.close()
        self.engine.thread.join(PATIENCE)


#: Starts an engine thread, which is closed after the test: `start("hang", HANG_LIMIT_S=0.5)`. The first argument is
#: what the process does at its start, and the others are new values for constants of the supervisor.
StartThread = Callable[..., EngineThread]
