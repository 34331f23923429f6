"""An engine process that does what the text of a goal tells it to: it fails, hangs, crashes, ignores stop, on request.

It stands in for `talkcli.engine.main` where the real one can't be made to misbehave, and speaks the same protocol on
file descriptor 0. What it can be told is in `script`. Of talk it knows `talkcli.engine.protocol` alone.

One loop: it waits for a command or for the next thing that the goal in hand has planned, whichever comes first.
"""

from __future__ import annotations

import contextlib
import os
import resource
import select
import signal
import subprocess
import sys
import time
from typing import TYPE_CHECKING

sys.path.insert(1, os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__)))))

from talkcli.engine import protocol
from tests.support import script

if TYPE_CHECKING:
    from collections.abc import Callable

_FD = 0
_LINGER = "import time; time.sleep({seconds})"


class Goal:
    """The goal in hand: what it was told, and what it will do when."""

    def __init__(self, say: protocol.Say) -> None:
        self.id = say.id
        self.script = script.parse(say.text)
        self.plan: list[tuple[float, Callable[[], None]]] = []
        self.stopped = False
        #: when it is silent because it was told to pause, or has been since; the plan stands still then
        self.silent_at: float | None = None

    def then(self, due: float, action: Callable[[], None]) -> None:
        """Plan an action for a monotonic time, after those that are planned for the same one."""
        self.plan.append((due, action))
        self.plan.sort(key=lambda each: each[0])

    def held(self, now: float) -> bool:
        """Whether it is silent because of a pause."""
        return self.silent_at is not None and now >= self.silent_at

    def resume(self, now: float) -> None:
        """Go on with the plan where it stood still."""
        if self.silent_at is not None and now > self.silent_at:
            self.plan = [(due + now - self.silent_at, action) for due, action in self.plan]
        self.silent_at = None


class Engine:
    """Reads commands, and does what they say."""

    def __init__(self) -> None:
        self._goal: Goal | None = None
        self._last = time.monotonic()
        self._buffer = b""
        #: the number of the pause that is still to be answered
        self._untold: int | None = None

    def run(self) -> None:
        """Serve until the other side closes."""
        while True:
            ready, _, _ = select.select([_FD], [], [], self._patience())
            if ready and not self._read():
                return
            self._work()

    def _patience(self) -> float | None:
        if self._goal is None:
            return None
        goal, due = self._goal, self._last + protocol.ALIVE_EVERY
        if self._untold and goal.silent_at is not None:
            due = min(due, goal.silent_at)
        if goal.plan and not goal.held(time.monotonic()):
            due = min(due, goal.plan[0][0])
        return max(0.0, due - time.monotonic())

    def _read(self) -> bool:
        data = os.read(_FD, 65536)
        if not data:
            return False
        *lines, self._buffer = (self._buffer + data).split(b"\n")
        for line in lines:
            self._take(protocol.decode(line, protocol.COMMANDS))
        return True

    def _take(self, command: protocol.Command) -> None:
        if isinstance(command, protocol.Configure):
            self._start(command.list_voices)
        elif isinstance(command, protocol.Say):
            self._say(command)
        elif isinstance(command, protocol.Stop):
            self._stop(command)
        elif isinstance(command, protocol.Pause):
            self._pause(command)
        elif isinstance(command, protocol.Resume):
            self._resume(command)
        # What else there is tells that another goal follows: it makes no sound that it could shorten.

    def _start(self, voices: bool) -> None:
        what, value = script.start()
        if what == "fail":
            self._send(protocol.StartFailed(value or "engine_failed", "scripted start failure"))
            sys.exit(1)
        elif what == "slow":
            time.sleep(float(value or 0.5))
        elif what:
            self._act(what, int(value or 0))
        self._send(protocol.Ready("scripted", "scripted engine", "none"))
        if voices:
            self._send(protocol.Voices((protocol.Voice("en", "en", "scripted"),)))

    def _tell(self, goal: Goal) -> None:
        """Tell by which voice it speaks, and where that goes."""
        asked = goal.script
        if asked.voice is not None:
            self._send(protocol.Speaks(goal.id, asked.voice))
        if asked.volume is not None:
            output = {"player": "scripted", "device": "card", "volume": asked.volume, "muted": asked.muted}
            self._send(protocol.Output(goal.id, output))

    def _say(self, say: protocol.Say) -> None:
        if self._goal:
            sys.exit(f"told to say {say.id} while {self._goal.id} is in hand")
        goal = self._goal = Goal(say)
        asked = goal.script
        began = self._last = time.monotonic()
        if "hang" in (asked.act, asked.on_stop):
            signal.signal(signal.SIGTERM, signal.SIG_IGN)  # before anybody can know that the goal has started
        if asked.linger:
            self._linger(asked.linger)
        if asked.started:
            self._send(protocol.Started(goal.id))
        self._tell(goal)
        if asked.muted and say.audible:
            self._send(protocol.Ended(goal.id, protocol.FAILED, "muted", "the output is muted: card"))
            self._goal = None
            return
        for number, (start, end) in enumerate(asked.words):
            at = asked.length * number / len(asked.words)
            word = protocol.Word(goal.id, start, end, number + 1, round(at, 3))
            goal.then(began + at, lambda word=word: self._send(word))  # type: ignore[misc]
        if asked.act:
            goal.then(began + asked.length * asked.at, lambda: self._act(str(asked.act), asked.code))
        elif not asked.never_ends:
            goal.then(began + asked.length, lambda: self._end(protocol.COMPLETED))

    def _stop(self, stop: protocol.Stop) -> None:
        goal = self._goal
        if goal is None or goal.id != stop.id or goal.script.ignore_stop or goal.stopped:
            return
        goal.stopped, goal.silent_at, self._untold = True, None, None
        goal.plan.clear()
        act = goal.script.on_stop
        action = (lambda: self._act(act, goal.script.code)) if act else (lambda: self._end(protocol.STOPPED))
        goal.then(time.monotonic() + goal.script.slow_stop, action)

    def _pause(self, pause: protocol.Pause) -> None:
        goal = self._goal
        if (
            goal is None
            or goal.id != pause.id
            or goal.script.ignore_pause
            or goal.stopped
            or goal.silent_at is not None
        ):
            return
        goal.silent_at = time.monotonic() + goal.script.slow_pause
        self._untold = pause.number
        if goal.script.stale_pause and pause.number > 1:
            self._send(protocol.Paused(goal.id, pause.number - 1))

    def _resume(self, resume: protocol.Resume) -> None:
        if self._goal and self._goal.id == resume.id:
            self._goal.resume(time.monotonic())
            self._untold = None

    def _work(self) -> None:
        while (goal := self._goal) and goal.plan and goal.plan[0][0] <= time.monotonic():
            if goal.silent_at is not None and goal.plan[0][0] >= goal.silent_at:
                break
            _, action = goal.plan.pop(0)
            action()
        if goal and self._untold and goal.held(time.monotonic()):
            self._send(protocol.Paused(goal.id, self._untold))
            self._untold = None
        if self._goal and time.monotonic() - self._last >= protocol.ALIVE_EVERY:
            self._send(protocol.Alive(self._goal.id))

    def _act(self, what: str, code: int) -> None:
        if what == "crash":
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            signal.signal(signal.SIGSEGV, signal.SIG_DFL)
            os.kill(os.getpid(), signal.SIGSEGV)
        elif what == "exit":
            os._exit(code)
        elif what == "hang":
            _hang()
        elif what == "fail":
            self._end(protocol.FAILED)
        elif what == "complete":
            self._end(protocol.COMPLETED)
        else:
            sys.exit(f"the script asks for {what!r}, which is not in its grammar")

    def _end(self, outcome: str) -> None:
        goal, self._goal, self._untold = self._goal, None, None
        assert goal
        failed = outcome == protocol.FAILED
        self._send(
            protocol.Ended(
                goal.id,
                outcome,
                goal.script.reason if failed else None,
                goal.script.said if failed else None,
                goal.script.length if outcome == protocol.COMPLETED else None,
            )
        )

    def _send(self, event: protocol.Event) -> None:
        line = protocol.encode(event)
        while line:
            line = line[os.write(_FD, line) :]
        self._last = time.monotonic()

    def _linger(self, seconds: float) -> None:
        fd = os.environ.get("TALK_LIVENESS_FD")
        # Blocked signals are inherited: it ignores them from its first moment.
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
        subprocess.Popen(
            [sys.executable, "-S", "-c", _LINGER.format(seconds=seconds)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            pass_fds=[int(fd)] if fd else [],
            start_new_session=True,
        )
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


def _hang() -> None:
    """Ignore everything until killed, orphaned or `script.LONGEST` seconds old, so that nothing is left for ever."""
    signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
    parent, end = os.getppid(), time.monotonic() + script.LONGEST
    while os.getppid() == parent and time.monotonic() < end:
        time.sleep(0.1)
    os._exit(1)


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError, ConnectionResetError):
        Engine().run()
