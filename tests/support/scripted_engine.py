"""An engine process that fails, hangs, crashes or ignores stop if the text of a goal says so (see `script`).

It replaces `talkcli.engine.child.main` and uses the same protocol on file descriptor 0. It imports little, because it
is started hundreds of times in a test run.
"""

from __future__ import annotations

import os
import select
import signal
import sys
import time

from talkcli.engine import protocol
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.reasons import Reason
from tests.support import script

if TYPE_CHECKING:
    from collections.abc import Callable

_FD = 0
_LINGER = "import time; time.sleep({seconds})"


class Goal:
    """The current goal with its script and its planned actions (with monotonic times)."""

    def __init__(self, say: protocol.Speak) -> None:
        self.id = say.id
        self.script = script.Script(say.text)
        self.text, self.more, self.broken = say.text, say.more, say.broken
        #: number of words that are planned or heard, and the seconds that they take
        self.words, self.length = say.heard_words, say.heard
        #: number of words that were heard
        self.heard = say.heard_words
        self.text_missing = self.grown = False
        self.plan: list[tuple[float, Callable[[], None]]] = []
        self.stopped = False
        #: time from which a pause delays the plan
        self.paused_at: float | None = None

    def then(self, due: float, action: Callable[[], None]) -> None:
        """Plan an action. It runs after earlier actions for the same time."""
        self.plan.append((due, action))
        self.plan.sort(key=lambda step: step[0])

    def append(self, added: protocol.Append) -> None:
        self.text += added.text
        self.more, self.broken, self.grown = not added.end, added.broken, True

    def take_words(self) -> list[tuple[int, int]]:
        """Return the spans of words that are not planned yet.

        The last word is left out if it may be incomplete.
        """
        if self.grown:
            self.script, self.grown = script.Script(self.text), False
        spans = [] if "silent-start" in self.script else self.script.spans
        if spans and spans[-1][1] == len(self.text) and (self.more or self.broken):
            spans = spans[:-1]
        new = spans[self.words : int(self.script.number("words", len(spans)))]
        self.words += len(new)
        return new

    def due(self, now: float) -> bool:
        first = self.plan[0][0] if self.plan else float("inf")
        return first <= now and (self.paused_at is None or first < self.paused_at)

    def paused(self, now: float) -> bool:
        return self.paused_at is not None and now >= self.paused_at

    def resume(self, now: float) -> None:
        if self.paused_at is not None and now > self.paused_at:
            self.plan = [(due + now - self.paused_at, action) for due, action in self.plan]
        self.paused_at = None


class Engine:
    """Receives commands and performs planned actions."""

    def __init__(self) -> None:
        self._goal: Goal | None = None
        self._sent_at = time.monotonic()
        self._buffer = b""
        #: number of a pause that isn't confirmed yet
        self._unconfirmed: int | None = None

    def run(self) -> None:
        while True:
            ready, _, _ = select.select([_FD], [], [], self._seconds_to_wait())
            if ready:
                data = os.read(_FD, 65536)
                if not data:
                    return
                *lines, self._buffer = (self._buffer + data).split(b"\n")
                for line in lines:
                    self._receive(protocol.decode(line, protocol.COMMAND_CLASSES))
            self._work()

    def _seconds_to_wait(self) -> float | None:
        if self._goal is None:
            return None
        goal, due = self._goal, self._sent_at + protocol.ALIVE_INTERVAL_S
        if self._unconfirmed and goal.paused_at is not None:
            due = min(due, goal.paused_at)
        if goal.plan and not goal.paused(time.monotonic()):
            due = min(due, goal.plan[0][0])
        return max(0.0, due - time.monotonic())

    def _receive(self, command: protocol.Command) -> None:
        goal = self._goal
        if isinstance(command, protocol.Configure):
            self._start(command.list_voices)
        elif isinstance(command, protocol.Speak):
            self._say(command)
        elif goal is None or not isinstance(
            command, protocol.Append | protocol.Stop | protocol.Interrupt | protocol.Hold | protocol.Continue
        ):
            pass  # only matters with sound
        elif goal.id != command.id or goal.stopped:
            pass
        elif isinstance(command, protocol.Append):
            goal.append(command)
            if goal.text_missing:
                self._continue(goal)
        elif isinstance(command, protocol.Stop):
            self._stop(goal)
        elif isinstance(command, protocol.Interrupt):
            self._interrupt(goal)
        elif isinstance(command, protocol.Hold):
            self._pause(goal, command.number)
        else:
            goal.resume(time.monotonic())
            self._unconfirmed = None

    def _start(self, voices: bool) -> None:
        behaviour, value = script.start()
        if behaviour == "fail":
            self._send(protocol.StartFailed(Reason(value or Reason.ENGINE_FAILED), "scripted start failure"))
            sys.exit(1)
        elif behaviour == "slow":
            time.sleep(float(value or 0.5))
        elif behaviour:
            self._act(behaviour, value or "0")
        self._send(protocol.Ready("scripted", "scripted engine", "none"))
        if voices:
            self._send(protocol.VoiceList((protocol.Voice("en", "en", "scripted"),)))

    def _say(self, say: protocol.Speak) -> None:
        if self._goal:
            sys.exit(f"received {say.id} during {self._goal.id}")
        goal = self._goal = Goal(say)
        words = goal.script
        self._sent_at = time.monotonic()
        if "hang" in (words.act, words.text("on-stop")):
            signal.signal(signal.SIGTERM, signal.SIG_IGN)  # before the server knows that the goal has started
        if "linger" in words:
            _linger(min(script.LONGEST, words.number("linger")))
        if "silent-start" not in words:
            self._send(protocol.Started(goal.id))
        self._report(goal)
        if "muted" in words and say.audible:
            self._send(protocol.Ended(goal.id, protocol.OUTCOME_FAILED, Reason.MUTED, "the output is muted: card"))
            self._goal = None
            return
        self._continue(goal)

    def _continue(self, goal: Goal) -> None:
        """Plan the new words, report that text is missing, or end the goal."""
        now, spans, words = time.monotonic(), goal.take_words(), goal.script
        if goal.text_missing != (missing := goal.more and not spans):
            goal.text_missing = missing
            self._send(protocol.TextMissing(goal.id, missing, len(goal.text)))
        if missing:
            return
        begin, length = goal.length, words.number("length", 0.1)
        if not spans and begin:
            length = 0.0  # everything was heard before
        for index, (start, end) in enumerate(spans):
            at = length * index / len(spans)
            word = protocol.Word(goal.id, start, end, goal.words - len(spans) + index + 1, round(begin + at, 3))
            goal.then(now + at, lambda word=word: self._hear(goal, word))  # type: ignore[misc]
        goal.length = round(begin + length, 6)
        act = words.act
        if act:
            goal.then(now + length * words.number("at", 0.5), lambda: self._act(act))
        elif goal.more:
            goal.then(now + length, lambda: self._continue(goal))
        elif "never-ends" not in words:
            goal.then(now + length, lambda: self._end(protocol.OUTCOME_COMPLETED))

    def _report(self, goal: Goal) -> None:
        """Report the voice and the output if the script contains them."""
        words = goal.script
        if "voice" in words:
            self._send(protocol.VoiceChosen(goal.id, words.text("voice")))
        if "volume" in words or "muted" in words:
            output = {"volume": words.number("volume", 1.0), "muted": "muted" in words}
            self._send(protocol.OutputChanged(goal.id, {"player": "scripted", "device": "card", **output}))

    def _stop(self, goal: Goal) -> None:
        if "ignore-stop" in goal.script:
            return
        goal.stopped, goal.paused_at, self._unconfirmed = True, None, None
        goal.plan.clear()
        act = goal.script.text("on-stop")
        action = (lambda: self._act(act)) if act else (lambda: self._end(protocol.OUTCOME_STOPPED))
        goal.then(time.monotonic() + goal.script.number("slow-stop"), action)

    def _hear(self, goal: Goal, word: protocol.Word) -> None:
        goal.heard = word.number
        self._send(word)

    def _interrupt(self, goal: Goal) -> None:
        """End the goal at once before its next word, if there is one."""
        if goal.heard < len(goal.script.spans):
            rest, _ = goal.script.spans[goal.heard]
            self._goal = self._unconfirmed = None
            self._send(protocol.Ended(goal.id, protocol.OUTCOME_INTERRUPTED, rest=rest))

    def _pause(self, goal: Goal, number: int) -> None:
        if "ignore-pause" in goal.script or goal.paused_at is not None:
            return
        goal.paused_at = time.monotonic() + goal.script.number("slow-pause")
        self._unconfirmed = number
        if "stale-pause" in goal.script and number > 1:
            self._send(protocol.Held(goal.id, number - 1))

    def _work(self) -> None:
        while (goal := self._goal) and goal.due(time.monotonic()):
            goal.plan.pop(0)[1]()
        if goal and self._unconfirmed and goal.paused(time.monotonic()):
            self._send(protocol.Held(goal.id, self._unconfirmed))
            self._unconfirmed = None
        if self._goal and time.monotonic() - self._sent_at >= protocol.ALIVE_INTERVAL_S:
            self._send(protocol.Alive(self._goal.id))

    def _act(self, action: str, value: str = "") -> None:
        if action == "crash":
            import resource

            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            signal.signal(signal.SIGSEGV, signal.SIG_DFL)
            os.kill(os.getpid(), signal.SIGSEGV)
        elif action == "exit":
            os._exit(int(self._goal.script.number("exit") if self._goal else value))
        elif action == "hang":
            _hang()
        elif action in ("fail", "complete"):
            self._end(protocol.OUTCOME_FAILED if action == "fail" else protocol.OUTCOME_COMPLETED)
        else:
            sys.exit(f"unknown behaviour: {action!r}")

    def _end(self, outcome: str) -> None:
        goal, self._goal, self._unconfirmed = self._goal, None, None
        assert goal
        if outcome == protocol.OUTCOME_FAILED:
            reason = Reason(goal.script.text("fail") or Reason.ENGINE_FAILED)
            message = goal.script.text("message").replace("_", " ") or f"scripted {reason}"
            self._send(protocol.Ended(goal.id, outcome, reason, message))
        else:
            length = goal.length if outcome == protocol.OUTCOME_COMPLETED else None
            self._send(protocol.Ended(goal.id, outcome, duration=length))

    def _send(self, event: protocol.Event) -> None:
        line = protocol.encode(event)
        while line:
            line = line[os.write(_FD, line) :]
        self._sent_at = time.monotonic()


def _linger(seconds: float) -> None:
    import subprocess

    fd = os.environ.get("TALK_LIVENESS_FD")
    # The process inherits the blocked signals, so it ignores them from the start.
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
    """Ignore everything until this process is killed or orphaned, or `script.LONGEST` has passed."""
    signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
    parent, end = os.getppid(), time.monotonic() + script.LONGEST
    while os.getppid() == parent and time.monotonic() < end:
        time.sleep(0.1)
    os._exit(1)


def main() -> None:
    try:
        Engine().run()
    except (BrokenPipeError, ConnectionResetError):
        pass
    os._exit(0)
