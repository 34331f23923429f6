"""Creates the README's animated picture by recording a terminal session.

    python .github/picture/picture.py [FILE]      the default is talk.svg beside this script

The script runs a shell in a pseudo-terminal, types commands, and records each change of the screen with its time. The
picture replays these changes. If the viewer has switched off animations, it shows the final screen. The script has no
other requirements than `talk`.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import os
import pty
import re
import select
import signal
import struct
import subprocess
import sys
import tempfile
import termios
import time
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable

# ruff: noqa: INP001

HERE = Path(__file__).resolve().parent
COMMANDS = (
    'talk say -wf -- "I am on my way to the charger"',
    'talk say "the battery is at twenty percent, so I am going to charge before the next round"',
    'talk say --priority 5 --ttl 20 "please let me pass"',
    "talk status",
    "talk cancel",
    'talk say --wait -- "back in the dock" && echo "it was heard to its end"',
)
COLUMNS, ROWS = 96, 20
#: Pauses between two keys, after a command, and before the picture starts again.
KEY_S, READ_S, REST_S = 0.025, 1.1, 5.0
#: Time limit for one command.
COMMAND_LIMIT_S = 30.0
PROMPT = "$ "
#: Width of a character, height of a row, and width of the margin, in pixels.
WIDTH, HEIGHT, EDGE = 8.4, 19, 14
STYLE = """
text { font: 14px ui-monospace, "DejaVu Sans Mono", Menlo, Consolas, monospace; fill: #d8dee9; white-space: pre }
.c1 { font-weight: bold } .c2 { fill: #7b869c } .c7 { fill: #1f2430 }
.c31 { fill: #f28b82 } .c32 { fill: #98c379 } .c33 { fill: #e5c07b } .c36 { fill: #7fd0d8 }
.past { visibility: hidden }
"""

Cell = tuple[str, str]
Row = tuple[Cell, ...]


class Frame(NamedTuple):
    """The content of the screen, and the time in seconds at which it appeared."""

    at: float
    rows: tuple[Row, ...]


class Screen:
    """A terminal that supports the control sequences of `talk` and of a shell."""

    def __init__(self) -> None:
        self.rows: list[list[Cell]] = [[]]
        self._column = 0
        self._attributes = ""

    def draw(self, text: str) -> None:
        """Update the screen with output of the shell."""
        for part in re.finditer(r"\x1b\[\??([0-9;]*)([A-Za-z])|(.)", text, re.DOTALL):
            if part[3] is None:
                self._control(part[1], part[2])
            elif part[3] == "\r":
                self._column = 0
            elif part[3] == "\n":
                self.rows.append([])
                self._column = 0
            else:
                row = self.rows[-1]
                row[self._column : self._column + 1] = [(part[3], self._attributes)]
                self._column += 1
                if self._column > COLUMNS:
                    raise SystemExit(f"a line is too long for the picture: {row}")

    def last(self) -> str:
        """Return the text of the last row."""
        return "".join(character for character, _ in self.rows[-1])

    def frame(self, at: float) -> Frame:
        """Return the current screen as a frame."""
        return Frame(at, tuple(map(tuple, self.rows)))

    def _control(self, numbers: str, letter: str) -> None:
        """Carry out a control sequence. Exit with an error if it isn't supported."""
        if letter == "m":
            self._attributes = "" if numbers in {"", "0"} else numbers
        elif letter == "K":
            del self.rows[-1][0 if numbers == "2" else self._column :]
        elif letter != "h" and letter != "l":
            raise SystemExit(f"the control sequence ESC[{numbers}{letter} is not supported")


def record(pause_factor: float) -> list[Frame]:
    """Run the commands in a terminal. Return the recorded screens.

    If the factor is 0, there are no pauses.
    """
    with contextlib.ExitStack() as stack:
        place = stack.enter_context(tempfile.TemporaryDirectory(prefix="robot-"))
        env = _environment(place)
        _serve(stack, env)
        shell, terminal = pty.fork()
        if shell == 0:
            os.execve("/bin/sh", ["sh", "-i"], env)
        stack.callback(_end, shell, terminal)
        fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, COLUMNS, 0, 0))
        return _type(terminal, pause_factor)


def _environment(place: str) -> dict[str, str]:
    """Create a `talk` command in `place`, and return an environment for it."""
    talk = Path(place, "talk")
    talk.write_text(f'#!/bin/sh\nexec {sys.executable} -m talkcli "$@"\n', encoding="utf-8")
    talk.chmod(0o755)
    return {
        "HOME": place,
        "LANG": "C.UTF-8",
        "PATH": f"{place}:{os.environ['PATH']}",
        "PS1": PROMPT,
        "PYTHONPATH": str(HERE.parents[1]),
        "TALK_SOCKET": f"{place}/talk.sock",
        "TERM": "xterm",
    }


def _serve(stack: contextlib.ExitStack, env: dict[str, str]) -> None:
    """Start a server that `stack` stops at the end, and wait until its engine is ready."""
    server = subprocess.Popen(
        [sys.executable, "-m", "talkcli", "serve", "--player", "null", "--rate", "120"],
        env=env,
        stderr=subprocess.PIPE,
        text=True,
    )
    stack.enter_context(server)
    stack.callback(server.terminate)
    assert server.stderr
    log = ""
    for line in server.stderr:
        log += line
        if "engine ready" in line:
            return
    raise SystemExit(f"the server did not start: {log}")


def _end(shell: int, terminal: int) -> None:
    """Kill the shell, and close its terminal."""
    os.close(terminal)
    os.kill(shell, signal.SIGKILL)
    os.waitpid(shell, 0)


class _Typist:
    """Types in a terminal, and records what the terminal shows."""

    def __init__(self, terminal: int) -> None:
        self.frames = [Frame(0.0, ((),))]
        self._terminal = terminal
        self._screen = Screen()
        self._began = time.monotonic()

    def press(self, keys: str) -> None:
        """Type the given keys."""
        os.write(self._terminal, keys.encode())

    def watch(self, seconds: float) -> None:
        """Record the screen for some seconds."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self._draw(left)

    def watch_until(self, condition: Callable[[str], bool]) -> None:
        """Record the screen until `condition` is true for the last row."""
        end = time.monotonic() + COMMAND_LIMIT_S
        while not condition(self._screen.last()):
            self._draw(end - time.monotonic())
            if time.monotonic() > end:
                raise SystemExit(f"the terminal still shows {self._screen.last()!r}")

    def _draw(self, seconds: float) -> None:
        """Wait up to `seconds` for output. If there is any, record the new screen."""
        if select.select([self._terminal], [], [], max(seconds, 0))[0]:
            self._screen.draw(os.read(self._terminal, 65536).decode())
            self.frames.append(self._screen.frame(time.monotonic() - self._began))


def _type(terminal: int, pause_factor: float) -> list[Frame]:
    """Type all commands one after another. Return the recorded screens."""
    typist = _Typist(terminal)
    for command in COMMANDS:
        typist.watch_until(PROMPT.__eq__)
        typist.watch(READ_S * pause_factor)
        for key in command:
            typist.press(key)
            typist.watch(KEY_S * pause_factor)
        typed = f"{PROMPT}{command}"
        typist.watch_until(typed.__eq__)
        typist.press("\n")
        typist.watch_until(typed.__ne__)
    typist.watch_until(PROMPT.__eq__)
    return typist.frames


def plain(frame: Frame) -> list[str]:
    """Return the rows of a screen as text."""
    return ["".join(character for character, _ in row).rstrip() for row in frame.rows]


def picture(frames: list[Frame]) -> str:
    """Return the picture as SVG."""
    whole = frames[-1].at + REST_S
    count = max(len(each.rows) for each in frames)
    width, height = round(COLUMNS * WIDTH) + 2 * EDGE, count * HEIGHT + 2 * EDGE
    rules, rows = [], []
    for number in range(count):
        for index, (row, start, end) in enumerate(_row_contents(frames, number, whole)):
            name = f"r{number}-{index}"
            past = end < whole
            shown = [(0.0, "hidden"), (start, "visible"), *([(end, "hidden")] if past else [])]
            steps = "".join(f"{100 * at / whole:.2f}%{{visibility:{how}}}" for at, how in shown)
            rules.append(f"@keyframes {name}{{{steps}}}#{name}{{animation:{name} {whole:.1f}s step-end infinite}}")
            kind = ' class="past"' if past else ""
            rows.append(f'<g id="{name}"{kind}>{_row_svg(row, EDGE + number * HEIGHT)}</g>')
    words = escape("\n".join(plain(frames[-1])))
    moving = "@media (prefers-reduced-motion: no-preference) {\n" + "\n".join(rules) + "\n}\n"
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}">\n'
        f"<title>talk in a terminal</title>\n<desc>{words}</desc>\n<style>{STYLE}{moving}</style>\n"
        f'<rect width="{width}" height="{height}" rx="8" fill="#1f2430"/>\n' + "\n".join(rows) + "\n</svg>\n"
    )


def _row_contents(frames: list[Frame], number: int, whole: float) -> list[tuple[Row, float, float]]:
    """Return the successive contents of a row, with the times at which each appears and disappears.

    The last content disappears at `whole`, which is the length of the recording. Omit empty contents.
    """
    contents: list[tuple[Row, float, float]] = []
    before: Row = ()
    since = 0.0
    for at, rows in [*frames, Frame(whole, ())]:
        row = rows[number] if number < len(rows) else ()
        if row != before:
            if before and at > since:
                contents.append((before, since, at))
            before, since = row, at
    return contents


def _row_svg(row: Row, top: float) -> str:
    """Return the SVG of a row whose upper edge is at `top`.

    Each run of equal attributes has its own position, whatever the width of the font.
    """
    parts, column = [], 0
    while column < len(row):
        attributes = row[column][1]
        end = next((each for each in range(column, len(row)) if row[each][1] != attributes), len(row))
        text = "".join(each for each, _ in row[column:end])
        left, length = EDGE + column * WIDTH, len(text) * WIDTH
        codes = attributes.split(";") if attributes else []
        if "7" in codes:
            parts.append(f'<rect x="{left:g}" y="{top:g}" width="{length:g}" height="{HEIGHT}" fill="#e5c07b"/>')
        if text.strip():
            kind = f' class="{" ".join(f"c{each}" for each in codes)}"' if codes else ""
            place = f'x="{left:g}" y="{top + 14:g}" textLength="{length:g}" xml:space="preserve"'
            parts.append(f"<text {place}{kind}>{escape(text, quote=False)}</text>")
        column = end
    return "".join(parts)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", nargs="?", type=Path, default=HERE / "talk.svg")
    parser.add_argument("--fast", action="store_true", help="type without pauses (the test uses this option)")
    given = parser.parse_args()
    given.file.write_text(picture(record(0.0 if given.fast else 1.0)), encoding="utf-8")
