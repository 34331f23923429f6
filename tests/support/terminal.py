"""A program in a terminal whose output is read as text. Use it for plain output and for shells."""

from __future__ import annotations

import re
import time
from typing import TYPE_CHECKING

from tests.support import screen
from tests.support.connection import PATIENCE

if TYPE_CHECKING:
    from types import TracebackType

_COLOUR = re.compile("\x1b\\[[0-9;]*m")


class Terminal(screen.Terminal):
    """A `screen.Terminal` whose output is read as text. Output that can't be drawn is only an error in `finish`."""

    def __enter__(self) -> Terminal:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def text(self) -> str:
        """The output so far, without colours."""
        return _COLOUR.sub("", self.raw.decode(errors="ignore")).replace("\r\n", "\n")

    @property
    def lines(self) -> list[str]:
        """The lines as they were written, without the terminal's wrapping."""
        return self.text.split("\n")[:-1]

    def wait_for(self, pattern: str, timeout: float = PATIENCE) -> re.Match[str]:
        """Wait until the output contains this pattern."""
        end = time.monotonic() + timeout
        with self._changed:
            while True:
                match = re.search(pattern, self.text)
                if match:
                    return match
                remaining = end - time.monotonic()
                assert remaining > 0, f"{pattern!r} was not shown within {timeout} s, but {self.raw!r}"
                self._changed.wait(remaining)
