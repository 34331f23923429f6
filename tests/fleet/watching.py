"""A `talk fleet watch` at a desk, as tests have it."""

from __future__ import annotations

import signal
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tests.support.bridge import Desk
    from tests.support.processes import Finished, Process


class Watching:
    """A `talk fleet watch` that has begun, and what it has written so far."""

    def __init__(self, somebody: Desk, *words: str) -> None:
        self._desk = somebody
        self.process: Process = somebody.start(*words, "fleet", "watch")
        self.lines: list[str] = []
        self.until("")

    def until(self, words: str) -> str:
        """Read lines until one has these words, and return it."""
        assert self.process.stdout
        for line in self.process.stdout:
            self.lines.append(line.rstrip("\n"))
            if words in line:
                return self.lines[-1]
        raise AssertionError(f"it ended without '{words}': {self.lines}")

    def end(self) -> Finished:
        """Press Ctrl-C, and return how it ended."""
        self.process.send_signal(signal.SIGINT)
        return self._desk.finish(self.process)
