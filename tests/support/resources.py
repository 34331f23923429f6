"""The base of the programs and connections that tests use."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from contextlib import ExitStack

    from typing_extensions import Self


class Resource:
    """Something that runs until `close()` or the end of a `with` block.

    The constructor sets `_stack`, which ends everything. Resource write their log into their private directory.
    """

    directory: str
    _stack: ExitStack

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def close(self) -> None:
        """End everything. Closing twice is allowed."""
        self._stack.close()

    @property
    def log(self) -> str:
        with open(f"{self.directory}/log", encoding="utf-8", errors="replace") as file:
            return file.read()
