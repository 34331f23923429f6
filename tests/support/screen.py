"""A terminal emulator: it runs a program, draws its output, and returns the text on the screen.

It supports wide characters, combining marks, wrapped lines, and the few control sequences that `talk` may use. All
other control sequences are errors.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import struct
import subprocess
import sys
import termios
import threading
import time
import unicodedata
from typing import TYPE_CHECKING

from tests.support.connection import PATIENCE

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

_CONTROL = re.compile(r"\x1b\[(?P<numbers>[0-9;]*)(?P<letter>[A-Za-z])")
_COLOUR = re.compile("\x1b\\[[0-9;]*m")
_IN_A_TERMINAL = (
    "import fcntl, os, sys, termios; os.setsid(); fcntl.ioctl(1, termios.TIOCSCTTY, 0);"
    "os.execvp(sys.argv[1], sys.argv[1:])"
)


class Screen:
    """The cells of a screen: characters with attributes. A wide character is followed by an empty cell."""

    def __init__(self, columns: int) -> None:
        self.columns = columns
        self.rows: list[list[tuple[str, str]]] = [[]]
        #: number of lines that were too long for a row
        self.wraps = 0
        self.column = 0
        self.attributes = ""

    def draw(self, text: str) -> None:
        """Draw a text that may contain complete control sequences."""
        index = 0
        while index < len(text):
            if control := _CONTROL.match(text, index):
                self._control(control["letter"], control["numbers"])
                index = control.end()
            else:
                self._character(text[index])
                index += 1

    @property
    def lines(self) -> list[str]:
        """The rows as text, without trailing blanks."""
        return ["".join(character for character, _ in row).rstrip() for row in self.rows]

    @property
    def last(self) -> str:
        return self.lines[-1]

    def marked(self, attribute: str, row: int = -1) -> str:
        """Return the characters of a row with an attribute ("7": reversed, "2": dim)."""
        return "".join(character for character, attributes in self.rows[row] if attribute in attributes.split(";"))

    def _character(self, character: str) -> None:
        row = self.rows[-1]
        if character == "\r":
            self.column = 0
        elif character == "\n":
            self._next_row()
        elif unicodedata.category(character) in {"Mn", "Me"}:
            index = max((cell for cell in range(min(self.column, len(row))) if row[cell][0]), default=None)
            if index is not None:
                row[index] = (row[index][0] + character, row[index][1])
        else:
            assert character.isprintable(), f"{character!r} reached the terminal"
            width = 2 if unicodedata.east_asian_width(character) in "WF" else 1
            if self.column + width > self.columns:
                self.wraps += 1
                row = self._next_row()
            row.extend([(" ", "")] * (self.column - len(row)))
            row[self.column : self.column + width] = [(character, self.attributes)] + [("", "")] * (width - 1)
            self.column += width

    def _next_row(self) -> list[tuple[str, str]]:
        self.rows.append([])
        self.column = 0
        return self.rows[-1]

    def _control(self, letter: str, numbers: str) -> None:
        if letter == "m":
            self.attributes = "" if numbers in {"", "0"} else numbers
        elif letter == "K" and numbers == "2":
            self.rows[-1] = []
        else:
            raise AssertionError(f"unknown control sequence: ESC[{numbers}{letter}")


class Terminal:
    """A program whose standard input, output and error are a terminal."""

    def __init__(self, command: Sequence[str], env: Mapping[str, str], columns: int = 80) -> None:
        self._changed = threading.Condition()
        self._master, terminal = os.openpty()
        self._resize(columns)
        self.raw = b""
        self.screen = Screen(columns)
        self._failure: Exception | None = None
        self.process = subprocess.Popen(
            [sys.executable, "-S", "-c", _IN_A_TERMINAL, *command],
            env={"TERM": "xterm", **env},
            stdin=terminal,
            stdout=terminal,
            stderr=terminal,
        )
        os.close(terminal)
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    @property
    def text(self) -> str:
        """The output so far, without colours and the terminal's wrapping. It may contain text that can't be drawn."""
        return _COLOUR.sub("", self.raw.decode(errors="ignore")).replace("\r\n", "\n")

    @property
    def lines(self) -> list[str]:
        return self.text.split("\n")[:-1]

    def wait_for(self, pattern: str, timeout: float = PATIENCE) -> re.Match[str]:
        """Wait until the output contains this pattern."""
        self.wait_until(lambda _: re.search(pattern, self.text) is not None, timeout)
        match = re.search(pattern, self.text)
        assert match
        return match

    def wait_until(self, condition: Callable[[Screen], bool], timeout: float = PATIENCE) -> None:
        """Wait until the condition is true for the screen."""
        end = time.monotonic() + timeout
        with self._changed:
            while not condition(self.screen):
                remaining = end - time.monotonic()
                assert remaining > 0, f"the screen: {self.screen.rows}; the output: {self.raw!r}"
                self._changed.wait(remaining)

    def resize(self, columns: int) -> None:
        with self._changed:
            self.screen.columns = columns
        self._resize(columns)

    def type(self, keys: bytes) -> None:
        os.write(self._master, keys)

    def finish(self, timeout: float = 20) -> int:
        """Wait until the program has ended and all its output is drawn. Return the exit code."""
        try:
            code = self.process.wait(timeout)
        finally:
            self.close()
        if self._failure is not None:
            raise self._failure
        return code

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        self._reader.join(PATIENCE)
        with contextlib.suppress(OSError):
            os.close(self._master)

    def _resize(self, columns: int) -> None:
        fcntl.ioctl(self._master, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))

    def _read(self) -> None:
        rest = b""
        with contextlib.suppress(OSError):  # no process has the terminal open any more
            while True:
                data = os.read(self._master, 65536)
                with self._changed:
                    self.raw += data
                    rest = self._draw(rest + data)
                    self._changed.notify_all()

    def _draw(self, data: bytes) -> bytes:
        """Draw complete characters and control sequences, and return the rest."""
        end = len(data)
        escape = data.rfind(b"\x1b")
        if escape >= 0 and not _CONTROL.match(data[escape:].decode(errors="ignore")):
            end = escape
        text = data[:end].decode(errors="ignore")
        try:
            self.screen.draw(text)
        except AssertionError as error:
            self._failure = self._failure or error
        return data[len(text.encode()) :]
