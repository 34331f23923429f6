"""`talk fleet watch` as a process."""

from __future__ import annotations

import signal
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tests.support.bridge import Desk
    from tests.support.processes import Finished, Process


class WatchProcess:
    """A running `talk fleet watch` that has printed its first line."""

    def __init__(self, desk: Desk, *arguments: str) -> None:
        self._desk = desk
        self.process: Process = desk.start(*arguments, "fleet", "watch")
        self.lines: list[str] = []
        self.until("")

    def until(self, text: str) -> str:
        """Return the next line that contains this text."""
        assert self.process.stdout
        for line in self.process.stdout:
            self.lines.append(line.rstrip("\n"))
            if text in line:
                return self.lines[-1]
        raise AssertionError(f"it ended without '{text}': {self.lines}")

    def end(self) -> Finished:
        self.process.send_signal(signal.SIGINT)
        return self._desk.finish(self.process)
