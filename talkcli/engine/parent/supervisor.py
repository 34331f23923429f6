"""The engine thread, which gives the engine process one goal at a time.

Another thread submits the goals. Whatever the engine process does, the engine thread posts exactly one `Ended` for each
goal, unless the goal was abandoned. It reports everything through the callback `post` and holds no lock while it waits.
It knows nothing about clients or the queue.
"""

from __future__ import annotations

import contextlib
import select
import socket
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
from talkcli.polling import NEVER, wait_ready

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

#: Delays before the next start. The delay grows with each consecutive process that fails to start or exits too soon.
RESTART_DELAYS_S = (0.0, 0.1, 0.5, 2.0, 10.0)
#: Maximum number of lines from standard error to log per period. This is enough for a traceback. The limit is needed
#: because a third-party driver may write a line for each word.
MAX_STDERR_LINES = 20
STDERR_PERIOD_S = 60.0
#: If a process exits sooner than this without a goal, the next start may be delayed.
MIN_LIFETIME_S = 1.0
#: If no process has been ready for this long, each failed start also fails a goal. Otherwise, goals would wait forever.
ENGINE_WAIT_LIMIT_S = 10.0


@frozen
class EngineDied:
    """A report that the engine process exited, was killed or could not be started."""

    message: str  # for the log


@frozen
class EngineMissing:
    """A report that no engine process could be started for a long time, so the next goal fails."""

    message: str  # for the goal


@frozen
class EngineSaid:
    """A line that the engine process wrote to standard error.

    It may contain parts of a goal's text.
    """

    line: str


@frozen
class ThreadDied:
    """A report that the engine thread has crashed. No more goals can be spoken."""

    message: str


Report = protocol.Event | EngineDied | EngineMissing | EngineSaid | ThreadDied


class ActionQueue:
    """Runs actions from other threads in the engine thread.

    `call` may be used from any thread. Only the engine thread may use the other methods.
    """

    def __init__(self) -> None:
        self._actions: deque[Callable[[], object]] = deque()
        self._receiver, self._sender = socket.socketpair()
        self._receiver.setblocking(False)
        self._sender.setblocking(False)

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when an action is waiting."""
        return self._receiver.fileno()

    def call(self, action: Callable[[], object]) -> None:
        """Queue an action to run in the engine thread. Actions queued after `close` never run."""
        self._actions.append(action)
        with contextlib.suppress(OSError):  # the queue is closed, or its buffer is full
            self._sender.send(b"\0")

    def run(self) -> None:
        """Run the waiting actions."""
        with contextlib.suppress(BlockingIOError):
            self._receiver.recv(65536)
        while self._actions:
            self._actions.popleft()()

    def close(self) -> None:
        """Close the descriptors."""
        self._receiver.close()
        self._sender.close()


class RestartPolicy:
    """Decides when to start the next engine process, and whether goals wait for it.

    Goals wait while the cause may be temporary, such as a lack of memory or descriptors. A permanent cause, such as a
    missing library or an unknown driver, fails each goal at once, until a process becomes ready.

    The class never reads the clock. All times are arguments, in monotonic seconds.
    """

    def __init__(self, now: float) -> None:
        self.next_start_at = 0.0
        #: error message of the last start; None if another start may succeed
        self.permanent_error: str | None = None
        self._failures = 0
        self._missing_since = now

    def process_died(self, now: float, *, age_s: float, had_goal: bool) -> None:
        """Schedule the next start after a ready process has exited.

        The start is delayed only if the process exited too soon.
        """
        self._missing_since = now
        if had_goal or age_s > MIN_LIFETIME_S:
            self._failures = 0
            self.next_start_at = now
        else:
            self._back_off(now)

    def start_failed(self, now: float, started_at: float, permanent_error: str | None) -> bool:
        """Schedule the next start after a failed start. Return whether goals have waited too long.

        After a permanent error, the result is False, because goals no longer wait.

        Args:
            now: the current time.
            started_at: the time at which the failed start began.
            permanent_error: the error message if the cause is permanent, otherwise None.
        """
        self._back_off(now)
        self.permanent_error = permanent_error
        return permanent_error is None and started_at >= self._missing_since + ENGINE_WAIT_LIMIT_S

    def _back_off(self, now: float) -> None:
        """Schedule the next start after a delay that grows with each consecutive failure."""
        self.next_start_at = now + RESTART_DELAYS_S[min(self._failures, len(RESTART_DELAYS_S) - 1)]
        self._failures += 1


@dataclass(slots=True, eq=False)
class SupervisedGoal:
    """The state of a goal from its submission until its `Ended` is posted.

    Times are monotonic.
    """

    command: protocol.GoalCommand
    #: whether the goal was sent to the current process
    sent: bool = False
    #: whether the process has sent `Started`
    started: bool = False
    #: whether the goal was retried because a process crashed before it started the goal
    retried: bool = False
    #: time by which the process must confirm a `Stop`; NEVER if none was sent
    stop_due: float = NEVER
    #: whether the goal must end at the end of a word
    interrupted: bool = False
    #: number of the current pause; None if the goal is not paused
    hold_number: int | None = None
    #: time by which the process must confirm a `Hold`; NEVER if none is waiting for confirmation
    hold_due: float = NEVER
    #: event that will be posted once `lost_process` has exited
    end: protocol.Ended | None = None
    #: the killed process that was speaking the goal
    lost_process: EngineProcess | None = None


class Supervisor:
    """Runs the engine thread, which starts engine processes and sends goals to them."""

    def __init__(self, configure: protocol.Configure, post: Callable[[Report], None]) -> None:
        """Create the thread without starting it.

        Args:
            configure: settings for each engine process.
            post: called in the engine thread with each report, including one `Ended` for each goal.
        """
        # This class doesn't inherit from Thread, because Thread's private names differ between Python versions.

        #: the engine thread, which starts engine processes. The owner starts the thread, and joins it after `close`.
        self.thread = threading.Thread(target=self._run, name="engine", daemon=True)
        self._configure = configure
        self._post = post
        self._actions = ActionQueue()
        #: the process to which each open descriptor belongs
        self._watched: dict[int, EngineProcess] = {}
        self._process: EngineProcess | None = None
        self._started_at = 0.0
        self._restarts = RestartPolicy(time.monotonic())
        self._goal: SupervisedGoal | None = None
        #: ID of the neural voice that the process is loading
        self._loading: str | None = None
        #: time of the last event from the process, or of the last command that the process must answer
        self._last_sign_at = 0.0
        #: killed processes that may still be running, each with the time limit for its exit
        self._dying: dict[EngineProcess, float] = {}
        self._stderr_quota = RateLimit(MAX_STDERR_LINES, STDERR_PERIOD_S)
        self._closing = False

    # -- methods for other threads

    def speak(self, command: protocol.GoalCommand) -> None:
        """Submit a goal to be spoken. The previous goal must have ended or been given up."""
        self._actions.call(lambda: self._begin_goal(command))

    def append(self, goal_id: str, text: str, *, complete: bool, broke_off: bool) -> None:
        """Replace the goal's text with a longer version, and send the new part to the process.

        Args:
            goal_id: the id of the goal.
            text: all of the text so far.
            complete: whether no more text follows.
            broke_off: whether it broke off, so that an incomplete sentence at its end isn't spoken.
        """
        self._actions.call(lambda: self._append_text(goal_id, text, complete=complete, broke_off=broke_off))

    def stop(self, goal_id: str) -> None:
        """Stop the goal. Its `Ended` event is posted once the goal has stopped."""
        self._actions.call(lambda: self._stop_goal(goal_id))

    def interrupt(self, goal_id: str) -> None:
        """End the goal at the end of the current word. Its `Ended` event is posted at that time.

        If no word follows, the goal ends as usual.
        """
        self._actions.call(lambda: self._interrupt_goal(goal_id))

    def pause(self, goal_id: str, number: int) -> None:
        """Pause the goal. Post `Held` with this number once the goal is silent.

        Nothing is posted if the goal is being stopped.
        """
        self._actions.call(lambda: self._pause_or_resume_goal(goal_id, number))

    def resume(self, goal_id: str) -> None:
        """Resume a paused goal."""
        self._actions.call(lambda: self._pause_or_resume_goal(goal_id, None))

    def announce_next(self, goal_id: str, next_waits: bool, next_is_neural: bool) -> None:
        """Tell the process whether another goal is waiting after the current one.

        If so, the process shortens the silence between the two.
        """
        command = protocol.NextGoal(goal_id, next_waits, next_is_neural)
        self._actions.call(lambda: self._send(command))

    def load(self, voice: str) -> None:
        """Tell the engine process to load a neural voice, if the process is ready.

        `VoiceLoaded` is posted when loading has finished or failed.
        """
        self._actions.call(lambda: self._load_voice(voice))

    def drop(self, voice: str) -> None:
        """Tell the engine process to unload a neural voice, if the process is ready."""
        self._actions.call(lambda: self._send(protocol.DropVoice(voice)))

    def give_up(self, goal_id: str) -> None:
        """Abandon a goal that didn't end in time, and replace its process.

        No `Ended` is posted for the goal.
        """
        self._actions.call(lambda: self._give_up_goal(goal_id))

    def close(self) -> None:
        """Tell the engine thread to kill the process and end. Return without waiting."""
        self._closing = True
        self._actions.call(lambda: None)

    # -- the loop

    def _run(self) -> None:
        """Run the engine thread until `close` is called.

        Report bugs, because otherwise goals would wait forever.
        """
        try:
            while not self._closing:
                # Take the time before waiting. If the machine is suspended during the wait, messages that have arrived
                # are then read before any deadline counts as missed.
                now, deadline = time.monotonic(), self._next_deadline()
                self._wait_and_handle(deadline)
                if now >= deadline and not self._closing:
                    self._handle_deadlines(now)
            self._actions.run()  # run actions that were submitted before `close`
        except Exception as error:
            self._closing = True
            self._post(ThreadDied(f"a bug in the engine thread: {type(error).__name__}: {error}"))
            raise
        finally:
            self._shut_down()

    def _wait_and_handle(self, until: float) -> None:
        """Wait for messages and actions, at most until the time `until`, and process them."""
        watched = dict.fromkeys([self._actions.fileno(), *self._watched], select.POLLIN)
        if self._process:
            watched[self._process.socket.fileno()] = self._process.socket_events
        ready = wait_ready(watched, until - time.monotonic())
        self._actions.run()
        for descriptor in ready:
            process = self._watched.get(descriptor)  # None if handling another descriptor has closed this one
            if process:
                self._handle_readable(process, descriptor)

    def _next_deadline(self) -> float:
        """Return the time at which `_handle_deadlines` must be called next."""
        deadlines = [*(deadline for deadline, _ in self._deadlines()), *self._dying.values()]
        return min([*deadlines, NEVER if self._process else self._restarts.next_start_at])

    def _deadlines(self) -> Iterator[tuple[float, str]]:
        """Yield the current deadlines, each with an error message."""
        goal, no_sign = self._goal, f"the engine did not respond for {HANG_LIMIT_S:g} s"
        if self._process and not self._process.ready:
            yield self._started_at + START_LIMIT_S, f"the engine was not ready within {START_LIMIT_S:g} s"
        if goal and goal.sent:
            yield goal.stop_due, f"the engine did not confirm a stop within {STOP_LIMIT_S * 1000:.0f} ms"
            yield self._last_sign_at + HANG_LIMIT_S, no_sign
            yield goal.hold_due, f"the engine did not confirm a pause within {HOLD_LIMIT_S:g} s"
        elif self._loading is not None:
            yield self._last_sign_at + HANG_LIMIT_S, f"{no_sign} while loading {self._loading}"

    def _handle_deadlines(self, now: float) -> None:
        """Kill processes that have missed a deadline, and start a new process if one is due."""
        missed = next((message for deadline, message in self._deadlines() if now >= deadline), None)
        if missed:
            self._kill_process(missed, Reason.ENGINE_HUNG)
        elif self._process is None and now >= self._restarts.next_start_at:
            self._start_process()
        for process in [process for process, deadline in self._dying.items() if now >= deadline]:
            self._dying[process] = NEVER  # don't kill the process again; it is still reaped when it exits
            process.kill()  # the first kill may have left processes alive if no descriptor was free
            if self._goal and self._goal.lost_process is process:
                message = f"the player could not be stopped within {KILL_LIMIT_S:g} s"
                self._fail_goal(self._goal, Reason.NOT_SILENT, message)

    def _handle_readable(self, process: EngineProcess, descriptor: int) -> None:
        """Read from a process's descriptor. If the process has ended, retry or end its goal, and release it."""
        if descriptor == process.liveness:
            if process is self._process:
                self._receive(process)  # read the last messages of the process before handling its death
            if process is self._process:
                self._handle_crash(process)
            self._release_process(process)
        elif descriptor == process.stderr:
            if not process.read_stderr():
                del self._watched[process.stderr]
        elif process is self._process:
            self._receive(process)

    # -- goals

    def _current_goal(self, goal_id: str) -> SupervisedGoal | None:
        """Return the current goal if it has this ID."""
        return self._goal if self._goal and self._goal.command.id == goal_id else None

    def _begin_goal(self, command: protocol.GoalCommand) -> None:
        """Make a goal the current one. Send it to the process, or fail it if no process can start."""
        self._goal = SupervisedGoal(command)
        if self._restarts.permanent_error is not None:
            self._fail_goal(self._goal, Reason.ENGINE_FAILED, self._restarts.permanent_error)
        else:
            self._send_waiting_goal()

    def _send_waiting_goal(self) -> None:
        """Send the waiting goal to the process if both are ready."""
        goal = self._goal
        if goal and not (goal.sent or goal.hold_number or goal.end):
            self._last_sign_at = time.monotonic()
            goal.sent = self._send(goal.command)

    def _load_voice(self, voice: str) -> None:
        """Tell the process to load a voice, and start the time limit for its next message.

        If no process is ready, do nothing, because the server repeats the command to the next one.
        """
        if self._send(protocol.LoadVoice(voice)):
            self._loading, self._last_sign_at = voice, time.monotonic()

    def _send(self, command: protocol.Command) -> bool:
        """Send a command to the process if it is ready. Return whether it is ready."""
        if self._process is None or not self._process.ready:
            return False
        self._process.send(command)
        return True

    def _append_text(self, goal_id: str, text: str, *, complete: bool, broke_off: bool) -> None:
        """Store the goal's longer text, and send the new part to the process.

        Keep the whole text, because the goal may have to be sent again.
        """
        if goal := self._current_goal(goal_id):
            added = text[len(goal.command.text) :]
            goal.command = replace(goal.command, text=text, more=not complete, broken=broke_off)
            if goal.sent:
                self._send(protocol.Append(goal_id, added, complete, broke_off))

    def _pause_or_resume_goal(self, goal_id: str, hold_number: int | None) -> None:
        """Pause the goal, or resume it if `hold_number` is None."""
        goal = self._current_goal(goal_id)
        if goal is None or goal.stop_due != NEVER or goal.end or goal.hold_number == hold_number:
            return
        goal.hold_number = hold_number
        goal.hold_due = time.monotonic() + HOLD_LIMIT_S if goal.sent and hold_number is not None else NEVER
        if goal.sent:
            self._send(protocol.Continue(goal_id) if hold_number is None else protocol.Hold(goal_id, hold_number))
        elif hold_number is not None:
            self._post(protocol.Held(goal_id, hold_number))  # The goal is silent, because no process speaks it.
        else:
            self._send_waiting_goal()

    def _stop_goal(self, goal_id: str) -> None:
        """Stop the goal. If it wasn't sent to the process, end it at once."""
        goal = self._current_goal(goal_id)
        if goal is None or goal.stop_due != NEVER:
            return
        stopped = protocol.Ended(goal_id, protocol.OUTCOME_STOPPED)
        if goal.end:
            goal.end = stopped
        elif not goal.sent:
            self._end_goal(stopped)
        else:
            goal.stop_due = time.monotonic() + STOP_LIMIT_S
            self._send(protocol.Stop(goal_id))

    def _interrupt_goal(self, goal_id: str) -> None:
        """Interrupt the goal. If it wasn't sent to the process, end it at once."""
        goal = self._current_goal(goal_id)
        if goal is None or goal.stop_due != NEVER or goal.end:
            return
        goal.interrupted = True
        if goal.sent:
            self._send(protocol.Interrupt(goal_id))
        else:
            self._end_goal(_interrupted_before_start(goal))

    def _give_up_goal(self, goal_id: str) -> None:
        """Forget the goal without posting its `Ended`, and replace the process that is speaking it."""
        goal = self._current_goal(goal_id)
        if goal:
            self._goal = None
            if goal.sent:
                self._kill_process("the engine could not be silenced", Reason.NOT_SILENT)

    def _fail_goal(self, goal: SupervisedGoal, reason: Reason, message: str) -> None:
        """Forget the current goal, and post an `Ended` event with its failure."""
        self._end_goal(protocol.Ended(goal.command.id, protocol.OUTCOME_FAILED, reason, message))

    def _end_goal(self, ended: protocol.Ended) -> None:
        """Forget the current goal, and post its `Ended` event."""
        self._goal = None
        self._post(ended)

    # -- the process

    def _start_process(self) -> None:
        """Start an engine process. If this fails, schedule another attempt."""
        self._started_at = time.monotonic()
        try:
            process = EngineProcess(self._configure, self._report_stderr)
        except OSError as error:
            message = f"the engine process could not be started: {error.strerror or error}"
            self._post(EngineDied(message))
            self._handle_failed_start(message)
            return
        self._process = process
        self._watched |= dict.fromkeys((process.socket.fileno(), process.liveness, process.stderr), process)

    def _report_stderr(self, line: str) -> None:
        """Post a line of a process's standard error, unless there have been too many lines."""
        omitted = self._stderr_quota.count_event(time.monotonic())
        if omitted:
            self._post(EngineSaid(f"({omitted} lines were omitted)"))
        if omitted is not None:
            self._post(EngineSaid(line))

    def _receive(self, process: EngineProcess) -> None:
        """Handle the messages that have arrived from the process."""
        for event in process.receive():
            if process is not self._process:
                return
            if event is None:
                self._handle_crash(process)
                return
            self._handle_event(process, event)

    def _handle_crash(self, process: EngineProcess) -> None:
        """Retry or end the goal of a crashed process, and post how the process exited."""
        self._kill_process(f"the engine crashed: {process.reap()}", Reason.ENGINE_CRASHED)

    def _handle_event(self, process: EngineProcess, event: protocol.Event) -> None:
        """Handle a goal's event. Post any other event, and send the waiting goal if the process is ready."""
        self._last_sign_at = time.monotonic()
        if isinstance(event, protocol.GoalEvent):
            goal = self._current_goal(event.id)
            if goal:
                process.had_goal = True
                self._handle_goal_event(goal, event)
            return
        if isinstance(event, protocol.Ready):
            self._restarts.permanent_error = None
        elif isinstance(event, protocol.VoiceLoaded) and event.voice == self._loading:
            self._loading = None
        self._post(event)
        if isinstance(event, protocol.StartFailed):
            self._kill_process(event.message, event.reason, event)
        self._send_waiting_goal()

    def _handle_goal_event(self, goal: SupervisedGoal, event: protocol.GoalEvent) -> None:
        """Record that the goal started, fell silent or ended. Post the event if the server needs it."""
        if isinstance(event, protocol.Started):
            goal.started = True
        elif isinstance(event, protocol.Ended):
            self._end_goal(event)
        elif isinstance(event, protocol.Word | protocol.TextMissing | protocol.OutputChanged | protocol.VoiceChosen):
            self._post(event)
        elif isinstance(event, protocol.Held) and event.number == goal.hold_number:
            goal.hold_due = NEVER
            self._post(event)

    def _kill_process(self, message: str, reason: Reason, failure: protocol.StartFailed | None = None) -> None:
        """Kill the process. Retry or end its goal, and schedule the next start.

        Args:
            message: a human-readable description of what happened.
            reason: the reason for which the goal fails.
            failure: the message of the process, if it can't start.
        """
        process, now = self._process, time.monotonic()
        if process is None:
            return
        self._process = self._loading = None
        process.kill()
        del self._watched[process.socket.fileno()]
        self._dying[process] = now + KILL_LIMIT_S
        goal = self._goal if self._goal and self._goal.sent else None
        if goal:
            self._handle_lost_goal(goal, process, message, reason)
        if not (self._closing or failure):
            self._post(EngineDied(message))
        if process.ready:
            had_goal = goal is not None or process.had_goal
            self._restarts.process_died(now, age_s=now - self._started_at, had_goal=had_goal)
        else:
            self._handle_failed_start(message, permanent=failure is not None and failure.permanent)

    def _handle_lost_goal(self, goal: SupervisedGoal, process: EngineProcess, message: str, reason: Reason) -> None:
        """Retry a goal whose process was lost. If it can't be retried, end it after the process exits.

        If the process crashed before it started the goal, nothing was heard, so the goal is sent to the next process.
        Each goal is retried only once.
        """
        if reason == Reason.ENGINE_CRASHED and goal.stop_due == NEVER and not (goal.started or goal.retried):
            goal.retried = True
            if goal.hold_number is not None:
                self._post(protocol.Held(goal.command.id, goal.hold_number))
            if goal.interrupted:
                goal.end, goal.lost_process = _interrupted_before_start(goal), process
        else:
            goal.end = protocol.Ended(goal.command.id, protocol.OUTCOME_FAILED, reason, message)
            if goal.stop_due != NEVER:
                goal.end = protocol.Ended(goal.command.id, protocol.OUTCOME_STOPPED)
            goal.lost_process = process
        goal.sent, goal.stop_due, goal.hold_due = False, NEVER, NEVER

    def _handle_failed_start(self, message: str, *, permanent: bool = False) -> None:
        """Schedule another start of the engine. Fail the waiting goal if it can't wait any longer.

        It can't wait if the error is permanent or the goal has waited too long.
        """
        ends_goal = self._restarts.start_failed(time.monotonic(), self._started_at, message if permanent else None)
        waiting = self._goal if self._goal and not self._goal.end else None
        if waiting and (ends_goal or permanent):
            self._fail_goal(waiting, Reason.ENGINE_FAILED, message)
        elif ends_goal:
            self._post(EngineMissing(message))

    def _release_process(self, process: EngineProcess) -> None:
        """Close the descriptors of an exited process. End the goal that was waiting for the exit, if any."""
        del self._watched[process.liveness]
        if self._watched.pop(process.stderr, None):
            process.read_stderr()
        process.close()
        del self._dying[process]
        goal = self._goal
        if goal and goal.end and goal.lost_process is process:
            self._end_goal(goal.end)

    def _shut_down(self) -> None:
        """Kill the process, wait briefly for it to exit, and close all descriptors."""
        self._kill_process("the server is shutting down", Reason.SHUTDOWN)
        deadline = time.monotonic() + KILL_LIMIT_S / 4
        while self._dying and time.monotonic() < deadline:
            self._wait_and_handle(deadline)
        for process in self._dying:
            process.close()
        self._actions.close()


def _interrupted_before_start(goal: SupervisedGoal) -> protocol.Ended:
    """Return the `Ended` event of a goal that was interrupted before any of it was heard."""
    return protocol.Ended(goal.command.id, protocol.OUTCOME_INTERRUPTED, rest=goal.command.start)
