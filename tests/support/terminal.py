"""A program in a terminal, read as lines, for output from top to bottom and for shells, which draw."""

from __future__ import annotations

import re
import time
from typing import TYPE_CHECKING

from tests.support import screen
from tests.support.connection import PATIENCE

if TYPE_CHECKING:
    from types import TracebackType

_COLOURING = re.compile("\x1b\\[[0-9;]*m")


class Terminal(screen.Terminal):
    """A `screen.Terminal` whose output is read as text; output that can't be drawn is no error before `finish`."""

    def __enter__(self) -> Terminal:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def text(self) -> str:
        """The output so far, without colours."""
        return _COLOURING.sub("", self.raw.decode(errors="ignore")).replace("\r\n", "\n")

    @property
    def lines(self) -> list[str]:
        """The lines that were written, however the terminal has wrapped them."""
        return self.text.split("\n")[:-1]

    def wait_for(self, pattern: str, timeout: float = PATIENCE) -> re.Match[str]:
        """Wait until the output has this pattern."""
        end = time.monotonic() + timeout
        with self._changed:
            while True:
                found = re.search(pattern, self.text)
                if found:
                    return found
                left = end - time.monotonic()
                assert left > 0, f"{pattern!r} was not shown within {timeout} s, but {self.raw!r}"
                self._changed.wait(left)
