"""A player program at the end of a pipe: the player that is heard.

It is started for one sentence and is gone after it. Nothing in here blocks, except that a killed player is given a
moment to be reaped. Of what it says on standard error the line is kept that names the error.
"""

from __future__ import annotations

import fcntl
import os
import re
import select
import struct
import termios
import time

from talkcli.engine.child.players.base import CannotSpeak, Player
from talkcli.engine.child.players.child import Child
from talkcli.processes import is_held, signal_name
from talkcli.protocol.lines import LineSplitter

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence

    from talkcli.engine.child.players.base import Interest
    from talkcli.engine.players import PlayerCommand

#: Seconds that a player which closed its input is given to end and to say why, before it is killed.
LAST_WORDS = 0.5

#: Seconds to wait on the spot for a killed player; it takes 1 ms. One that hangs in the kernel is left to `gone`.
REAP_WITHIN = 0.02

#: Seconds between two looks at the player where the system has no descriptor for its end (macOS, Linux before 5.3).
LOOK_EVERY = 0.01

#: Bytes of one line of standard error that are kept; error lines are shorter, and a message must stay readable.
LONGEST_LINE = 300

#: What is no error, or none that a user can read: the library's chatter around it, gaps in the sound, and what was
#: meant kindly.
_NOISE = (
    r"ALSA lib |underrun|overrun|Playing |Warning:|please, try |Stream (suspended|successfully|started)|^Got signal"
)
_ERROR = (
    r"error|fail|cannot|can't|could ?n[o']t|unable|no such|not found|not available|refused|denied|invalid|unknown"
    r"|disconnected|busy|broken|terminated|killed|lost"
)
#: `aplay: main:831: text`: function and line mean nothing to a user.
_PLACE = r"^(?P<program>[^\s:]+): \w+:\d+: "

#: Bytes of standard error that are read in one go; a player that floods it must not keep us from the sound.
STDERR_AT_ONCE = 65536


class Complaint:
    """The line of a player's standard error that names the error: bytes come in, one readable line comes out.

    A player can talk for hours (underruns), so only the line that is wanted is kept. It is not the last one, as after
    the error a player may dump its parameters. The patterns are compiled when a player says something, and not at the
    start of each engine process: they take 1 ms.
    """

    def __init__(self) -> None:
        self._lines = LineSplitter(LONGEST_LINE)
        self._named: str | None = None
        self._first: str | None = None

    def feed(self, data: bytes) -> None:
        """Take what the player wrote."""
        for line in self._lines.feed(data):
            self._look(line)

    def line(self) -> str | None:
        """Return the line that names the error, None if nothing was said that could."""
        self._look(self._lines.end())
        return self._named or self._first

    def _look(self, raw: bytes) -> None:
        line = raw.decode("utf-8", "replace").strip()
        if not line or re.search(_NOISE, line, re.IGNORECASE):
            return
        line = re.sub(_PLACE, r"\g<program>: ", line)
        if self._named is None and re.search(_ERROR, line, re.IGNORECASE):
            self._named = line
        self._first = self._first or line


class ProgramPlayer(Player):
    """The running player of one sentence."""

    real_time = True

    def __init__(self, command: PlayerCommand, inherited: Sequence[int] = ()) -> None:
        """Start the player; CannotSpeak (no_player) if that is impossible. It inherits the descriptors given."""
        self.name = command.name
        self.proven = False
        self._command = command
        self._complaint = Complaint()
        try:
            self._child = Child(command.argv, inherited)
        except OSError as error:
            text = error.strerror or str(error)
            raise CannotSpeak("no_player", f"{self.name} cannot be started: {text}") from error
        self._overhead = len(command.preamble)
        self._written = 0
        self._consumed = 0
        self._broken_at: float | None = None
        self._closed = False
        self._write(memoryview(command.preamble))

    def offer(self, data: memoryview) -> int:
        """Write what fits into the pipe."""
        self.ended()  # raises if the player is gone
        # One piece at a time: what waits in the pipe would be heard late by whoever pauses.
        if self._child.stdin is None:
            return 0
        waiting = _unread(self._child.stdin)
        # A write finds out whether it has closed its input, but none is tried where something waits that it left.
        if waiting == 0 or not is_held(self._child.stdin):
            return self._write(data)
        # But a player that has taken nothing yet is to find what it needs to begin.
        room = self._command.at_start - waiting if waiting == self._written else 0
        return self._write(data[:room]) if room > 0 else 0

    def consumed(self) -> int:
        """Return how many bytes of sound the player has taken out of the pipe."""
        if self._child.stdin is not None and self._broken_at is None:
            self._consumed = max(self._consumed, self._written - _unread(self._child.stdin) - self._overhead)
        elif self._closed:
            self._consumed = self._written - self._overhead
        if self._consumed > self._command.read_ahead:
            self.proven = True
        return self._consumed

    def close(self) -> None:
        """Close the player's input: it drains and ends."""
        self._closed = True
        self._child.close_stdin()

    def ended(self) -> bool:
        """Return True when the player ended well after `close`; CannotSpeak if it ended in any other way."""
        self._read_stderr()
        status = self._child.status()
        if status is None:
            if self._broken_at is not None and time.monotonic() - self._broken_at >= LAST_WORDS:
                line = self._complaint.line()
                raise CannotSpeak("audio_lost", line or f"{self.name} closed its input before the sound was over")
            return False
        self._read_stderr()
        if status == 0 and self._closed:
            return True
        raise self._verdict(status)

    def interests(self) -> list[Interest]:
        """Return the pipe, where there is something to write, the player's standard error, and its end."""
        child = self._child
        stdin = child.stdin if self._broken_at is None else None
        wanted = ((stdin, select.POLLOUT), (child.stderr, select.POLLIN), (child.exit, select.POLLIN))
        return [(descriptor, events) for descriptor, events in wanted if descriptor is not None]

    def wake_at(self) -> float | None:
        """Return when to look at the player again."""
        if self._child.exit is None:
            return time.monotonic() + LOOK_EVERY
        return None if self._broken_at is None else self._broken_at + LAST_WORDS

    def kill(self) -> None:
        """Kill the player and what it has started, and reap it if that takes no time."""
        self._child.kill()
        self._child.close_stdin()
        self._child.await_end(REAP_WITHIN)
        self.gone()

    def gone(self) -> bool:
        """Return True once the player is reaped."""
        if self._child.status() is None:
            return False
        self._child.release()
        return True

    def _write(self, data: memoryview) -> int:
        if self._child.stdin is None or self._broken_at is not None:
            return 0
        try:
            written = os.write(self._child.stdin, data)
        except BlockingIOError:
            return 0
        except BrokenPipeError:
            self._broken_at = time.monotonic()
            return 0
        self._written += written
        return written

    def _verdict(self, status: int) -> CannotSpeak:
        self.consumed()
        line = self._complaint.line()
        if status < 0:
            return CannotSpeak("audio_lost", f"{self.name} was killed by {signal_name(-status)}")
        if status == 0:
            return CannotSpeak("audio_lost", line or f"{self.name} ended before the sound did")
        reason = "audio_lost" if self.proven else "audio_device"
        return CannotSpeak(reason, line or f"{self.name} exited with status {status}")

    def _read_stderr(self) -> None:
        if self._child.stderr is None:
            return
        try:
            data = os.read(self._child.stderr, STDERR_AT_ONCE)
        except BlockingIOError:
            return
        if data:
            self._complaint.feed(data)
        else:
            self._child.close_stderr()


def _unread(pipe: int) -> int:
    """Return how many bytes wait in the pipe; 0 where the system does not tell."""
    try:
        return int(struct.unpack("i", fcntl.ioctl(pipe, termios.FIONREAD, b"\0\0\0\0"))[0])
    except OSError:
        return 0
