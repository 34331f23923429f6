"""The engine thread, which owns the engine process, hands it one goal at a time, and enforces its time limits.

Another thread hands goals in, and sends them directly to the process if it can. Whatever the process does, each goal
ends with exactly one `Ended`, unless it was given up. The thread reports everything through `post` and holds no lock
while it waits. It knows neither clients nor the queue.
"""

from __future__ import annotations

import os
import selectors
import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

from talkcli.daemon.log import RateLimit
from talkcli.engine import protocol
from talkcli.engine.parent.process import EngineProcess
from talkcli.engine.protocol import HANG_LIMIT_S, HOLD_LIMIT_S, KILL_LIMIT_S, START_LIMIT_S, STOP_LIMIT_S
from talkcli.frozen import frozen, replace
from talkcli.goals.reasons import Reason

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

#: Delay before the next start, by the number of processes in a row that didn't start or ended too soon.
RESTART_DELAYS_S = (0.0, 0.1, 0.5, 2.0, 10.0)
#: Lines of standard error passed on per period: enough for a traceback. A foreign driver may write one for each word.
MAX_STDERR_LINES = 20
STDERR_PERIOD_S = 60.0
#: A process that was ready for less than this, and had no goal, ended too soon.
MIN_LIFETIME_S = 1.0
#: Time without a ready process after which each failed start ends a goal, so that no goal waits for ever.
ENGINE_WAIT_LIMIT_S = 10.0
NEVER = float("inf")


@frozen
class EngineDied:
    """The engine process ended or was killed. For the log."""

    message: str


@frozen
class EngineMissing:
    """Another start failed after a long time without a ready process. The next goal ends for this reason."""

    message: str


@frozen
class EngineSaid:
    """A line that the engine process wrote to standard error, for the log. It may contain parts of a goal's text."""

    line: str


@frozen
class ThreadDied:
    """A bug ended the engine thread. Nothing will be spoken any more."""

    message: str


Report = protocol.Event | EngineDied | EngineMissing | EngineSaid | ThreadDied


class ActionQueue:
    """Actions that other threads hand to a thread waiting for descriptors.

    `call` may be used from any thread. The other methods belong to the thread that waits.
    """

    def __init__(self, nap_s: float) -> None:
        """Create the queue.

        Args:
            nap_s: after any work, the waiting thread wakes up once by itself within this time. Actions that can wait
                as long don't have to wake it.
        """
        self.selector = selectors.DefaultSelector()
        self._actions: deque[Callable[[], None]] = deque()
        self._closed = False
        #: held by `call`, so that the wake-up descriptor isn't closed and reused in the meantime
        self._calling = threading.Lock()
        #: whether a wake-up is on its way, which serves all actions until it arrives
        self._woken = False
        #: monotonic time until which the thread sleeps if nothing wakes it; 0 while it is awake
        self._sleeps_until = 0.0
        self._nap_s = nap_s
        self._nap_ends_at = 0.0
        self._reader, self._writer = os.pipe()
        os.set_blocking(self._reader, False)
        os.set_blocking(self._writer, False)
        self.selector.register(self._reader, selectors.EVENT_READ)

    def call(self, action: Callable[[], None], by: float = 0.0) -> None:
        """Have the waiting thread run an action. After `close`, do nothing.

        Args:
            action: the action.
            by: monotonic time until which the action can wait for the thread to wake up by itself. Waking it, and
                handing over the interpreter, costs about 50 µs, as much as a hundred lines of Python.
        """
        with self._calling:
            if self._closed:
                return
            self._actions.append(action)
            # The order matters, and `wait` does the opposite: either this sees the thread asleep, or `wait` sees the
            # action.
            if self._sleeps_until > by and not self._woken:
                self._woken = True
                os.write(self._writer, b"\0")

    def wait(self, until: float) -> list[selectors.SelectorKey]:
        """Wait for a registered descriptor, an action or a monotonic time.

        Run the actions, and return the keys of the ready descriptors.
        """
        now = time.monotonic()
        if now < self._nap_ends_at < until:
            until = self._nap_ends_at
        self._sleeps_until = until
        timeout = 0.0 if self._actions else max(0.0, until - now)
        ready = [key for key, _ in self.selector.select(None if timeout == NEVER else timeout)]
        self._sleeps_until = 0.0
        if ready:
            self._nap_ends_at = time.monotonic() + self._nap_s
        if any(key.fd == self._reader for key in ready):
            os.read(self._reader, 4096)
            self._woken = False  # before running the actions, so that a later `call` wakes the thread again
        self.run()
        return [key for key in ready if key.fd != self._reader]

    def run(self) -> None:
        """Run the waiting actions."""
        while self._actions:
            self._actions.popleft()()

    def close(self) -> None:
        """Accept no more actions and close the queue's own descriptors."""
        with self._calling:
            self._closed = True
        self.selector.close()
        os.close(self._reader)
        os.close(self._writer)


class RestartPolicy:
    """The rule for when to start the next engine process, and whether goals wait for it.

    Temporary causes are waited out: no memory, no descriptors, a process killed while it started. A permanent cause,
    such as a missing library or an unknown driver, ends each goal at once until a process becomes ready after all.

    Pure: the time is an argument, in monotonic seconds.
    """

    def __init__(self, now: float) -> None:
        self.next_start_at = 0.0
        #: why the last start failed, if the cause is permanent
        self.permanent_error: str | None = None
        self._failures = 0
        self._missing_since = now

    def process_died(self, now: float, *, age_s: float, had_goal: bool) -> None:
        """Plan the next start after a process that was ready. There is no delay unless it ended too soon."""
        self._missing_since = now
        if had_goal or age_s > MIN_LIFETIME_S:
            self._failures = 0
            self.next_start_at = now
        else:
            self._back_off(now)

    def start_failed(self, now: float, started_at: float, permanent_error: str | None) -> bool:
        """Plan the next start after a failed one, and return whether the failure ends a goal.

        Args:
            now: the present time.
            started_at: time of the failed start.
            permanent_error: message about the cause if it is permanent, else None.
        """
        self._back_off(now)
        self.permanent_error = permanent_error
        return permanent_error is None and started_at >= self._missing_since + ENGINE_WAIT_LIMIT_S

    def _back_off(self, now: float) -> None:
        self.next_start_at = now + RESTART_DELAYS_S[min(self._failures, len(RESTART_DELAYS_S) - 1)]
        self._failures += 1


@dataclass(slots=True, eq=False)
class SupervisedGoal:
    """A goal from the time it is handed in until its `Ended` is posted."""

    command: protocol.GoalCommand
    #: time of the last sign of life for this goal; None while it waits for a process
    last_sign_at: float | None = None
    #: whether the process has reported that it has begun
    started: bool = False
    #: whether the goal was already taken back from a process that died before it began
    retried: bool = False
    #: when the process was told to stop
    stop_sent_at: float | None = None
    #: number of the hold in force; None if the goal is not to be held
    hold_number: int | None = None
    #: when the process was told to hold, until it confirms
    hold_sent_at: float | None = None
    #: how the goal ended, to be posted once `lost_process` is gone
    end: protocol.Ended | None = None
    #: the killed process that spoke the goal
    lost_process: EngineProcess | None = None

    @property
    def sent(self) -> bool:
        """Whether a process has the goal."""
        return self.last_sign_at is not None


class Supervisor:
    """The owner of the engine process and its thread."""

    def __init__(self, configure: protocol.Configure, post: Callable[[Report], None]) -> None:
        """Prepare the thread.

        Args:
            configure: settings of each engine process.
            post: called in the engine thread with what the process reports, including one `Ended` for each goal.
        """
        # An attribute, not a base class, because Thread has private names that differ between versions of Python.
        #: to be started by the owner, which also starts the first engine process, and joined after `close`
        self.thread = threading.Thread(target=self._run, name="engine", daemon=True)
        self._configure = configure
        self._post = post
        self._actions = ActionQueue(nap_s=HANG_LIMIT_S)
        self._selector = self._actions.selector
        self._process: EngineProcess | None = None
        #: the process to which `speak` sends goals directly; None if only the engine thread may decide
        self._direct_process: EngineProcess | None = None
        self._started_at = 0.0
        self._restarts = RestartPolicy(time.monotonic())
        self._goal: SupervisedGoal | None = None
        #: the neural voice that the process is loading, and the last sign of life
        self._loading: str | None = None
        self._last_sign_at = 0.0
        #: killed processes that may still be there
        self._dying: list[EngineProcess] = []
        self._stderr_quota = RateLimit(MAX_STDERR_LINES, STDERR_PERIOD_S)
        self._closing = False

    # -- methods for other threads

    def speak(self, command: protocol.GoalCommand) -> None:
        """Hand in a goal. The previous goal must have ended or been given up. Always call this from the same thread.

        The caller's thread sends it to the process if possible, because waking the engine thread would take a tenth to
        a fifth of the time that a goal costs.
        """
        process, now = self._direct_process, time.monotonic()
        if process is None:
            self._actions.call(lambda: self._take_goal(command))
            return
        self._actions.call(lambda: self._take_goal(command, process, now), by=now + HANG_LIMIT_S)
        if not process.send(command):
            self._actions.call(lambda: self._goal_not_sent(command.id, process))

    def stop(self, goal_id: str) -> None:
        """Stop the goal."""
        self._actions.call(lambda: self._stop_goal(goal_id))

    def pause(self, goal_id: str, number: int) -> None:
        """Hold the goal. `Held` is posted once it is silent, unless it is being stopped."""
        self._actions.call(lambda: self._hold_goal(goal_id, number))

    def resume(self, goal_id: str) -> None:
        """Let the goal go on."""
        self._actions.call(lambda: self._hold_goal(goal_id, None))

    def announce_next(self, goal_id: str, next_waits: bool, next_is_neural: bool) -> None:
        """Tell the process whether another goal waits behind this one, so that it can shorten the silence at its end.

        The message is dropped if the process can't take it, which costs little.
        """
        process = self._direct_process
        if process:
            process.send(protocol.NextGoal(goal_id, next_waits, next_is_neural))

    def load(self, voice: str) -> None:
        """Have the process load a neural voice. `VoiceLoaded` is posted when that is done."""
        self._actions.call(lambda: self._send_voice_command(protocol.LoadVoice(voice)))

    def drop(self, voice: str) -> None:
        """Have the process remove a neural voice from memory."""
        self._actions.call(lambda: self._send_voice_command(protocol.DropVoice(voice)))

    def give_up(self, goal_id: str) -> None:
        """Forget a goal that didn't end in time, and replace its process. No `Ended` is posted for it."""
        self._direct_process = None
        self._actions.call(lambda: self._give_up_goal(goal_id))

    def close(self) -> None:
        """End the process and the thread."""
        self._closing = True
        self._actions.call(lambda: None)

    # -- the loop

    def _run(self) -> None:
        """Run until `close`. Report a bug, so that no goal waits for an engine that doesn't exist."""
        try:
            while not self._closing:
                # Taken before reading. If the machine or the process stood still, the messages are read before their
                # absence counts.
                now = time.monotonic()
                for key in self._actions.wait(self._next_deadline()):
                    self._handle_ready(key)
                if not self._closing:
                    self._check_deadlines(now)
            self._actions.run()  # actions that came before `close`
        except Exception as error:
            self._closing = True
            self._post(ThreadDied(f"a bug in the engine thread: {type(error).__name__}: {error}"))
            raise
        finally:
            self._shut_down()

    def _next_deadline(self) -> float:
        deadlines = [deadline for deadline, _ in self._deadlines()] + [each.gone_by for each in self._dying]
        return min([*deadlines, NEVER if self._process else self._restarts.next_start_at])

    def _deadlines(self) -> Iterator[tuple[float, str]]:
        """Yield each deadline of the process, with the message for missing it."""
        goal, no_sign = self._goal, f"the engine gave no sign of life for {HANG_LIMIT_S:g} s"
        if self._process and not self._process.ready:
            yield self._started_at + START_LIMIT_S, f"the engine was not ready after {START_LIMIT_S:g} s"
        if goal and goal.stop_sent_at is not None:
            limit_ms = STOP_LIMIT_S * 1000
            yield goal.stop_sent_at + STOP_LIMIT_S, f"the engine did not confirm a stop within {limit_ms:.0f} ms"
        if goal and goal.last_sign_at is not None:
            yield goal.last_sign_at + HANG_LIMIT_S, no_sign
        if self._loading is not None:
            yield self._last_sign_at + HANG_LIMIT_S, f"{no_sign} while it loaded {self._loading}"
        if goal and goal.hold_sent_at is not None:
            yield goal.hold_sent_at + HOLD_LIMIT_S, f"the engine did not confirm a pause within {HOLD_LIMIT_S:g} s"

    def _check_deadlines(self, now: float) -> None:
        missed = next((message for deadline, message in self._deadlines() if now >= deadline), None)
        if missed:
            self._lose_process(missed, Reason.ENGINE_HUNG)
        elif self._process is None and now >= self._restarts.next_start_at:
            self._start_process()
        for process in self._dying:
            if now < process.gone_by:
                continue
            process.gone_by = NEVER  # checked once; it is reaped whenever it goes
            process.kill()  # finds processes that the first kill may have missed for lack of a descriptor
            if self._goal and self._goal.lost_process is process:
                message = f"the player could not be ended within {KILL_LIMIT_S:g} s"
                self._fail_goal(self._goal, Reason.NOT_SILENT, message)

    def _handle_ready(self, key: selectors.SelectorKey) -> None:
        if key.fd not in self._selector.get_map():
            return  # closed while an earlier key was handled
        process: EngineProcess = key.data
        if key.fd == process.liveness:
            if process is self._process:
                self._receive(process)  # its last messages, before its death is handled
            if process is self._process:
                self._handle_crash(process)
            if process.is_gone():
                self._release_process(process)
        elif key.fd == process.stderr:
            if not process.read_stderr():
                self._selector.unregister(process.stderr)
        elif process is self._process:
            self._receive(process)

    # -- goals

    def _current(self, goal_id: str) -> SupervisedGoal | None:
        """Return the goal with this id; None if it has ended."""
        return self._goal if self._goal and self._goal.command.id == goal_id else None

    def _take_goal(self, command: protocol.GoalCommand, sent_to: EngineProcess | None = None, at: float = 0.0) -> None:
        """Take charge of a goal. Send it to the process unless that was already done."""
        self._goal = SupervisedGoal(command)
        if sent_to is not None and sent_to is self._process:
            self._goal.last_sign_at = at
        elif self._restarts.permanent_error is not None:
            self._fail_goal(self._goal, Reason.ENGINE_FAILED, self._restarts.permanent_error)
        else:
            self._send_goal()

    def _send_goal(self) -> None:
        """Send the goal to the process if both are ready for it."""
        goal, process = self._goal, self._process
        waits = goal and not (goal.sent or goal.hold_number or goal.end)
        if goal and waits and process and process.ready:
            goal.last_sign_at = time.monotonic()
            if not process.send(goal.command):
                self._goal_not_sent(goal.command.id, process)

    def _goal_not_sent(self, goal_id: str, process: EngineProcess) -> None:
        """Keep a goal for the next process, because this one didn't take it."""
        if process is self._process:
            goal = self._current(goal_id)
            if goal:
                goal.last_sign_at = None
            self._handle_refusal(process)

    def _send_voice_command(self, command: protocol.LoadVoice | protocol.DropVoice) -> None:
        """Send a command about a voice, if a process is ready. The server asks each new process for voices anyway."""
        process = self._process
        if process and process.ready:
            if isinstance(command, protocol.LoadVoice):
                self._loading, self._last_sign_at = command.voice, time.monotonic()
            if not process.send(command):
                self._handle_refusal(process)

    def _handle_refusal(self, process: EngineProcess) -> None:
        """Replace a process that takes no commands."""
        self._receive(process)  # notices how it died if it is dead
        if process is self._process:
            self._lose_process("the engine takes no commands", Reason.ENGINE_HUNG)

    def _hold_goal(self, goal_id: str, number: int | None) -> None:
        """Hold the goal, or let it go on if `number` is None."""
        goal = self._current(goal_id)
        if goal is None or goal.stop_sent_at is not None or goal.end or goal.hold_number is number is None:
            return
        goal.hold_number = number
        goal.hold_sent_at = time.monotonic() if goal.sent and number is not None else None
        if goal.sent:
            command = protocol.Continue(goal_id) if number is None else protocol.Hold(goal_id, number)
            if self._process and not self._process.send(command):
                self._handle_refusal(self._process)
        elif number is not None:
            self._post(protocol.Held(goal_id, number))  # no process has it, so it is silent
        else:
            self._send_goal()

    def _stop_goal(self, goal_id: str) -> None:
        goal = self._current(goal_id)
        if goal is None or goal.stop_sent_at is not None:
            return
        stopped = protocol.Ended(goal_id, protocol.OUTCOME_STOPPED)
        if goal.end:
            goal.end = stopped
        elif not goal.sent:
            self._end_goal(stopped)
        elif self._process:
            goal.stop_sent_at = time.monotonic()
            self._process.send(protocol.Stop(goal_id))

    def _give_up_goal(self, goal_id: str) -> None:
        goal = self._current(goal_id)
        if goal:
            self._goal = None
            if goal.sent:
                self._lose_process("the engine could not be silenced", Reason.NOT_SILENT)
        self._direct_process = self._process if self._process and self._process.ready else None

    def _fail_goal(self, goal: SupervisedGoal, reason: Reason, message: str) -> None:
        self._end_goal(protocol.Ended(goal.command.id, protocol.OUTCOME_FAILED, reason, message))

    def _end_goal(self, ended: protocol.Ended) -> None:
        self._goal = None
        self._post(ended)

    # -- the process

    def _start_process(self) -> None:
        self._started_at = time.monotonic()
        try:
            process = EngineProcess(self._configure, self._report_stderr)
        except OSError as error:
            message = f"the engine process cannot be started: {error.strerror or error}"
            self._post(EngineDied(message))
            self._plan_after_failed_start(message)
            return
        self._process = process
        for fd in (process.socket.fileno(), process.liveness, process.stderr):
            self._selector.register(fd, selectors.EVENT_READ, process)

    def _report_stderr(self, line: str) -> None:
        omitted = self._stderr_quota.allow(time.monotonic())
        if omitted:
            self._post(EngineSaid(f"({omitted} lines were left out)"))
        if omitted is not None:
            self._post(EngineSaid(line))

    def _receive(self, process: EngineProcess) -> None:
        """Handle the messages of the process that have arrived."""
        for event in process.receive():
            self._actions.run()  # the command that this answers may still be waiting to be noted
            if process is not self._process:
                return
            if event is None:
                self._handle_crash(process)
                return
            self._handle_event(process, event)

    def _handle_crash(self, process: EngineProcess) -> None:
        self._direct_process = None
        self._lose_process(f"the engine crashed: {process.describe_exit()}", Reason.ENGINE_CRASHED)

    def _handle_event(self, process: EngineProcess, event: protocol.Event) -> None:
        self._last_sign_at = time.monotonic()
        if isinstance(event, protocol.GoalEvent):
            if self._goal and self._goal.sent and event.id == self._goal.command.id:  # else it has ended already
                process.had_goal = True
                self._handle_goal_event(self._goal, event)
            return
        if isinstance(event, protocol.Ready):
            process.ready = True
            self._restarts.permanent_error = None
            self._direct_process = process
        elif isinstance(event, protocol.StartFailed):
            process.start_failure = event
        elif isinstance(event, protocol.VoiceLoaded) and event.voice == self._loading:
            self._loading = None
        elif isinstance(event, protocol.VoiceList):
            self._configure = replace(self._configure, list_voices=False)  # the next process doesn't have to send it
        self._post(event)
        self._send_goal()

    def _handle_goal_event(self, goal: SupervisedGoal, event: protocol.GoalEvent) -> None:
        goal.last_sign_at = self._last_sign_at
        if isinstance(event, protocol.Started):
            goal.started = True
        elif isinstance(event, protocol.Ended):
            self._end_goal(event)
        elif isinstance(event, protocol.Word | protocol.OutputChanged | protocol.VoiceChosen):
            self._post(event)
        elif isinstance(event, protocol.Held) and event.number == goal.hold_number:
            goal.hold_sent_at = None
            self._post(event)

    def _lose_process(self, message: str, reason: Reason) -> None:
        """Kill the process, let its goal end once it is silent, and plan the next start.

        Args:
            message: what happened, for people.
            reason: the reason for the goal to end.
        """
        process, now = self._process, time.monotonic()
        if process is None:
            return
        self._process = self._direct_process = self._loading = None
        process.kill()
        self._selector.unregister(process.socket.fileno())
        process.gone_by = now + KILL_LIMIT_S
        self._dying.append(process)
        goal = self._goal if self._goal and self._goal.sent else None
        if goal:
            self._handle_lost_goal(goal, process, message, reason)
        if not (self._closing or process.start_failure):
            self._post(EngineDied(message))
        if process.ready:
            had_goal = goal is not None or process.had_goal
            self._restarts.process_died(now, age_s=now - self._started_at, had_goal=had_goal)
        elif process.start_failure:
            self._plan_after_failed_start(process.start_failure.message, permanent=process.start_failure.permanent)
        else:
            self._plan_after_failed_start(message)

    def _handle_lost_goal(self, goal: SupervisedGoal, process: EngineProcess, message: str, reason: Reason) -> None:
        """Decide what happens to a goal whose process was lost.

        If the process crashed before it began with the goal, nothing was heard, and the next process gets the goal.
        This happens only once per goal.
        """
        if reason == Reason.ENGINE_CRASHED and goal.stop_sent_at is None and not (goal.started or goal.retried):
            goal.retried = True
            if goal.hold_number is not None:
                self._post(protocol.Held(goal.command.id, goal.hold_number))
        else:
            goal.end = protocol.Ended(goal.command.id, protocol.OUTCOME_FAILED, reason, message)
            if goal.stop_sent_at is not None:
                goal.end = protocol.Ended(goal.command.id, protocol.OUTCOME_STOPPED)
            goal.lost_process = process
        goal.last_sign_at = goal.stop_sent_at = goal.hold_sent_at = None

    def _plan_after_failed_start(self, message: str, *, permanent: bool = False) -> None:
        """Plan another start, and end the waiting goal if it shouldn't wait for that."""
        ends_goal = self._restarts.start_failed(time.monotonic(), self._started_at, message if permanent else None)
        waiting = self._goal if self._goal and not self._goal.end else None
        if waiting and (ends_goal or permanent):
            self._fail_goal(waiting, Reason.ENGINE_FAILED, message)
        elif ends_goal:
            self._post(EngineMissing(message))

    def _release_process(self, process: EngineProcess) -> None:
        """Close the descriptors of a process that is gone with its player, and end its goal, which is silent now."""
        self._selector.unregister(process.liveness)
        if process.stderr in self._selector.get_map():
            process.read_stderr()
            self._selector.unregister(process.stderr)
        process.close()
        self._dying.remove(process)
        goal = self._goal
        if goal and goal.end and goal.lost_process is process:
            self._end_goal(goal.end)

    def _shut_down(self) -> None:
        """End the process. If it can't be ended within the limit, leave it to the system."""
        self._lose_process("the server ends", Reason.SHUTDOWN)
        deadline = time.monotonic() + KILL_LIMIT_S / 4
        while self._dying and time.monotonic() < deadline:
            for key in self._actions.wait(deadline):
                self._handle_ready(key)
        for process in self._dying:
            process.close()
        self._actions.close()
