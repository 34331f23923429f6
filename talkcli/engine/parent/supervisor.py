"""The engine thread: owns the engine process, sees to it that it has one goal at a time, and is its watchdog.

Who has a goal hands it in, in another thread, which sends it to the process by itself. Whatever the process does, a
goal that was handed in ends with exactly one `Ended`, unless it was given up. The thread holds no lock while it
waits, and everything it learns goes out through `post`. It knows no client and no queue.
"""

from __future__ import annotations

import selectors
import threading
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from talkcli.daemon.quota import Quota
from talkcli.engine import protocol
from talkcli.engine.parent.inbox import NEVER, Inbox
from talkcli.engine.parent.process import EngineProcess
from talkcli.engine.protocol import HANG_AFTER, PAUSE_LIMIT, SILENCE_LIMIT, START_LIMIT, STOP_LIMIT
from talkcli.frozen import frozen, replace

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

#: Seconds before the next start, by the number of processes in a row that died before they were of use.
BACK_OFF = (0.0, 0.1, 0.5, 2.0, 10.0)
#: Lines of the process's standard error that are passed on in a while, and the seconds of that: a whole traceback, and
#: no flood, as a driver of somebody else's may write a line for each word, for months.
LINES, WHILE = 20, 60.0
#: A ready process that dies sooner than this, and has had no goal, was of no use.
SHORT_LIFE = 1.0
#: Seconds without a ready process after which each start that fails costs a goal: nobody waits for ever.
PATIENCE = 10.0


@frozen
class EngineDied:
    """The engine process ended, or had to be ended; for the log."""

    words: str


@frozen
class EngineMissing:
    """There has been no ready engine process for long, and one more start failed: the next goal ends for it."""

    words: str


@frozen
class EngineSaid:
    """A line that the engine process wrote to standard error; for the log. It may hold what a goal's text says."""

    words: str


@frozen
class ThreadDied:
    """A bug ended the engine thread: nothing will be spoken any more."""

    words: str


Report = protocol.Event | EngineDied | EngineMissing | EngineSaid | ThreadDied


class Restarts:
    """When the next engine process may be started, and whether goals wait for it.

    What may pass is waited out: no memory, no descriptors, a process that was killed in its start. What is known to
    stay (no library, no such driver) ends each goal at once, until a process gets ready all the same. The time comes in
    as an argument (monotonic seconds).
    """

    def __init__(self, now: float) -> None:
        #: when the next process may be started
        self.due_at = 0.0
        #: why the last start failed, where that is known to stay: no goal waits for another one then
        self.error: str | None = None
        self._failures = 0
        #: since when there has been no ready process
        self._missing_since = now

    def died(self, now: float, *, age: float, had_goal: bool) -> None:
        """Plan the start after a process that had been ready; one that has had a goal costs no wait."""
        self._missing_since = now
        if had_goal or age > SHORT_LIFE:
            self._failures = 0
            self.due_at = now
        else:
            self._wait_longer(now)

    def failed(self, now: float, began: float, lasting: str | None) -> bool:
        """Plan the start after one that failed, begun at that time, and return whether it costs a goal.

        `lasting`: the cause in words, where it is known to stay.
        """
        self._wait_longer(now)
        self.error = lasting
        return lasting is None and began >= self._missing_since + PATIENCE

    def _wait_longer(self, now: float) -> None:
        self.due_at = now + BACK_OFF[min(self._failures, len(BACK_OFF) - 1)]
        self._failures += 1


@dataclass(slots=True, eq=False)
class Handed:
    """A goal from the moment it is handed in until its `Ended` is posted."""

    say: protocol.Say
    #: when the process last gave a sign of life for it; None while it waits for a process
    heard_at: float | None = None
    #: whether the process said that it has begun with it
    started: bool = False
    #: whether a process that had it died before it began with it
    again: bool = False
    #: when the process was told to stop it
    stop_at: float | None = None
    #: the number of the pause that it is to be held for, by the process that speaks it, else by the thread
    pause: int | None = None
    #: when a process was told of it, until it is confirmed
    pause_at: float | None = None
    #: how it ended, once the process that spoke it is known to be gone
    verdict: protocol.Ended | None = None
    #: … and that process
    verdict_on: EngineProcess | None = None

    @property
    def spoken(self) -> bool:
        """Whether a process has it."""
        return self.heard_at is not None


class Supervisor:
    """Owns the engine process. `post` is called in its thread: with what the process says, an `Ended` for each goal."""

    def __init__(self, configure: protocol.Configure, post: Callable[[Report], None]) -> None:
        # Held, not inherited from: a Thread has private names of its own, and others in each version of Python.
        #: to be started, and with it the first engine process; joined after `close`
        self.thread = threading.Thread(target=self._run, name="engine", daemon=True)
        self._configure = configure
        self._post = post
        self._inbox = Inbox(doze=HANG_AFTER)
        self._selector = self._inbox.selector
        self._process: EngineProcess | None = None
        #: the process that takes the next goal, from whichever thread; None where only this thread may decide
        self._open: EngineProcess | None = None
        self._started_at = 0.0
        self._restarts = Restarts(time.monotonic())
        self._goal: Handed | None = None
        #: the neural voice that the process loads, and when it last gave a sign of life
        self._loading: str | None = None
        self._load_heard_at = 0.0
        #: the killed ones that are not known to be gone
        self._dying: list[EngineProcess] = []
        self._complaints = Quota(LINES, WHILE)
        self._closing = False

    # -- called from other threads

    def say(self, goal: protocol.Say) -> None:
        """Hand in a goal; the one before must have ended or been given up. Only one thread may call this.

        The caller itself sends it where it can: to wake this thread took a tenth to a fifth of what a goal costs.
        """
        process, now = self._open, time.monotonic()
        if process is None:
            self._inbox.call(lambda: self._take(goal))
            return
        self._inbox.call(lambda: self._take(goal, process, now), by=now + HANG_AFTER)
        if not process.send(goal):
            self._inbox.call(lambda: self._not_taken(goal.id, process))

    def stop(self, goal_id: str) -> None:
        """Make the goal end, silent."""
        self._inbox.call(lambda: self._begin_stop(goal_id))

    def pause(self, goal_id: str, number: int) -> None:
        """Hold the goal where it is; `Paused` is posted when it is silent, and nothing once it is being stopped."""
        self._inbox.call(lambda: self._hold(goal_id, number))

    def resume(self, goal_id: str) -> None:
        """Let the goal go on."""
        self._inbox.call(lambda: self._hold(goal_id, None))

    def follow(self, goal_id: str, followed: bool, by_neural: bool) -> None:
        """Tell whether another goal waits, `by_neural` by a neural voice: the silence before it may be made shorter."""
        process = self._open
        if process:
            # An engine that has no room for it at this moment is not hung for that, and little is lost.
            process.send(protocol.Followed(goal_id, followed, by_neural))

    def load(self, voice: str, drop: tuple[str, ...] = ()) -> None:
        """Have the process drop neural voices and load one; `Loaded` is posted if it lives so long."""
        for each in drop:
            self.drop(each)
        self._inbox.call(lambda: self._load(protocol.Load(voice)))

    def drop(self, voice: str) -> None:
        """Have the process keep a neural voice no longer."""
        self._inbox.call(lambda: self._order(protocol.Drop(voice)))

    def give_up(self, goal_id: str) -> None:
        """Let go of a goal that didn't end in time: its process is left behind, there will be no `Ended`."""
        self._open = None
        self._inbox.call(lambda: self._abandon(goal_id))

    def close(self) -> None:
        """End the process and this thread."""
        self._closing = True
        self._inbox.call(lambda: None)

    # -- the loop

    def _run(self) -> None:
        """Serve until `close`; a bug is reported, so that no goal waits for an engine that is not there."""
        try:
            while not self._closing:
                # Before it takes what has come: whoever stood still, machine or process, has heard nothing meanwhile.
                now = time.monotonic()
                for key in self._inbox.wait(self._next_deadline()):
                    self._handle(key)
                if not self._closing:
                    self._keep_limits(now)
            self._inbox.run()  # what came before `close`, which takes no turn
        except Exception as error:
            self._closing = True
            self._post(ThreadDied(f"a bug in the engine thread: {type(error).__name__}: {error}"))
            raise
        finally:
            self._shut_down()

    def _next_deadline(self) -> float:
        due = [limit for limit, _ in self._limits()] + [each.gone_by for each in self._dying]
        return min([*due, NEVER] if self._process else [*due, self._restarts.due_at])

    def _limits(self) -> Iterator[tuple[float, str]]:
        """Return until when the process may take for what is waited for, and what is said of one that takes longer."""
        goal = self._goal
        if self._process and not self._process.ready:
            yield self._started_at + START_LIMIT, f"the engine was not ready after {START_LIMIT:g} s"
        if goal and goal.stop_at is not None:
            yield goal.stop_at + STOP_LIMIT, f"the engine did not confirm a stop within {STOP_LIMIT * 1000:.0f} ms"
        if goal and goal.heard_at is not None:
            yield goal.heard_at + HANG_AFTER, f"the engine gave no sign of life for {HANG_AFTER:g} s"
        if self._loading is not None:
            words = f"the engine gave no sign of life for {HANG_AFTER:g} s while it loaded {self._loading}"
            yield self._load_heard_at + HANG_AFTER, words
        if goal and goal.pause_at is not None:
            yield goal.pause_at + PAUSE_LIMIT, f"the engine did not confirm a pause within {PAUSE_LIMIT:g} s"

    def _keep_limits(self, now: float) -> None:
        late = next((words for limit, words in self._limits() if now >= limit), None)
        if late:
            self._lose_process(late, "engine_hung")
        elif self._process is None and now >= self._restarts.due_at:
            self._start()
        for process in self._dying:
            if now < process.gone_by:
                continue
            process.gone_by = NEVER  # overdue once; it is kept, to be reaped when it goes
            process.kill()  # what could not be found before, for want of a descriptor, may be found now
            if self._goal and self._goal.verdict_on is process:
                words = f"the player could not be ended within {SILENCE_LIMIT:g} s"
                self._finish(protocol.Ended(self._goal.say.id, protocol.FAILED, "not_silent", words))

    def _handle(self, key: selectors.SelectorKey) -> None:
        if key.fd not in self._selector.get_map():
            return  # closed by what was handled before it
        process: EngineProcess = key.data
        if key.fd == process.liveness:
            if process is self._process:
                self._hear(process)  # its last messages, before its end is acted upon
            if process is self._process:
                self._crashed(process)
            if process.silent():
                self._bury(process)
        elif key.fd == process.stderr:
            if not process.read_stderr():
                self._selector.unregister(process.stderr)
        elif process is self._process:
            self._hear(process)

    # -- goals

    def _in_hand(self, goal_id: str) -> Handed | None:
        """Return the goal if it has not ended meanwhile."""
        return self._goal if self._goal and self._goal.say.id == goal_id else None

    def _take(self, say: protocol.Say, sent: EngineProcess | None = None, at: float = 0.0) -> None:
        """Take a goal in hand, one that was sent to a process already, or is to be: where that one is lost since."""
        self._goal = Handed(say)
        if sent is not None and sent is self._process:
            self._goal.heard_at = at
        elif self._restarts.error is not None:
            self._finish(protocol.Ended(say.id, protocol.FAILED, "engine_failed", self._restarts.error))
        else:
            self._hand_over()

    def _not_taken(self, goal_id: str, process: EngineProcess) -> None:
        """Let a goal wait for the next process: this one doesn't have it."""
        if process is self._process:
            goal = self._in_hand(goal_id)
            if goal:
                goal.heard_at = None
            self._refused(process)

    def _load(self, load: protocol.Load) -> None:
        if self._process and self._process.ready:  # else another will be, of which it is wanted anew
            self._loading, self._load_heard_at = load.voice, time.monotonic()
            self._order(load)

    def _order(self, order: protocol.Load | protocol.Drop) -> None:
        if self._process and self._process.ready and not self._process.send(order):
            self._refused(self._process)

    def _refused(self, process: EngineProcess) -> None:
        self._hear(process)  # where it is dead, it is known how it died
        if process is self._process:
            self._lose_process("the engine takes no commands", "engine_hung")

    def _hand_over(self) -> None:
        goal, process = self._goal, self._process
        waits = goal and not (goal.spoken or goal.pause or goal.verdict)
        if goal and waits and process and process.ready:
            goal.heard_at = time.monotonic()
            if not process.send(goal.say):
                self._not_taken(goal.say.id, process)

    def _hold(self, goal_id: str, pause: int | None) -> None:
        goal = self._in_hand(goal_id)
        if goal is None or goal.stop_at is not None or goal.verdict or goal.pause is pause is None:
            return  # it ended, or is about to, while this was on its way
        goal.pause = pause
        goal.pause_at = time.monotonic() if goal.spoken and pause is not None else None
        if goal.spoken:
            command = protocol.Resume(goal_id) if pause is None else protocol.Pause(goal_id, pause)
            if self._process and not self._process.send(command):
                self._refused(self._process)
        elif pause is not None:
            self._post(protocol.Paused(goal_id, pause))  # it waits for a process, and now for `resume` as well
        else:
            self._hand_over()

    def _begin_stop(self, goal_id: str) -> None:
        goal = self._in_hand(goal_id)
        if goal is None or goal.stop_at is not None:
            return  # it ended while the stop was on its way
        if goal.verdict:
            goal.verdict = protocol.Ended(goal_id, protocol.STOPPED)
        elif not goal.spoken:
            self._finish(protocol.Ended(goal_id, protocol.STOPPED))
        elif self._process:
            goal.stop_at = time.monotonic()
            self._process.send(protocol.Stop(goal_id))

    def _abandon(self, goal_id: str) -> None:
        goal = self._in_hand(goal_id)
        if goal:
            self._goal = None
            if goal.spoken:
                self._lose_process("the engine could not be silenced", "not_silent")
        self._open = self._process if self._process and self._process.ready else None

    def _finish(self, ended: protocol.Ended) -> None:
        self._goal = None
        self._post(ended)

    # -- the process

    def _start(self) -> None:
        self._started_at = time.monotonic()
        try:
            process = EngineProcess(self._configure, self._complain)
        except OSError as error:
            words = f"the engine process cannot be started: {error.strerror or error}"
            self._post(EngineDied(words))
            self._start_failed(words)
            return
        self._process = process
        for fd in (process.socket.fileno(), process.liveness, process.stderr):
            self._selector.register(fd, selectors.EVENT_READ, process)

    def _hear(self, process: EngineProcess) -> None:
        for event in process.receive():
            self._inbox.run()  # what it answers to was left there before it was sent
            if process is not self._process:
                return
            if event is None:
                self._crashed(process)
                return
            self._note(process, event)

    def _crashed(self, process: EngineProcess) -> None:
        self._open = None
        self._lose_process(f"the engine crashed: {process.last_words()}", "engine_crashed")

    def _complain(self, words: str) -> None:
        left_out = self._complaints.take(time.monotonic())
        if left_out:
            self._post(EngineSaid(f"({left_out} lines were left out)"))
        if left_out is not None:
            self._post(EngineSaid(words))

    def _note(self, process: EngineProcess, event: protocol.Event) -> None:
        self._load_heard_at = time.monotonic()
        if isinstance(event, protocol.OF_A_GOAL):
            if self._goal and self._goal.spoken and event.id == self._goal.say.id:  # else it has ended already
                process.used = True
                self._note_of(self._goal, event)
            return
        if isinstance(event, protocol.Ready):
            process.ready = True
            self._restarts.error = None
            self._open = process
        elif isinstance(event, protocol.StartFailed):
            process.failed = event
        elif isinstance(event, protocol.Loaded) and event.voice == self._loading:
            self._loading = None
        elif isinstance(event, protocol.Voices):
            self._configure = replace(self._configure, list_voices=False)  # the next process need not
        self._post(event)
        self._hand_over()

    def _note_of(self, goal: Handed, event: protocol.Event) -> None:
        goal.heard_at = time.monotonic()
        if isinstance(event, protocol.Started):
            goal.started = True
        elif isinstance(event, protocol.Ended):
            self._finish(event)
        elif isinstance(event, protocol.Word | protocol.Output | protocol.Speaks):
            self._post(event)
        elif isinstance(event, protocol.Paused) and event.number == goal.pause:
            goal.pause_at = None
            self._post(event)

    def _lose_process(self, words: str, reason: str) -> None:
        """Kill the process, end its goal once it is silent, and plan the next start."""
        process, now = self._process, time.monotonic()
        if process is None:
            return
        self._process = self._open = self._loading = None
        process.kill()
        self._selector.unregister(process.socket.fileno())
        process.gone_by = now + SILENCE_LIMIT
        self._dying.append(process)
        goal = self._goal if self._goal and self._goal.spoken else None
        if goal:
            self._take_back(goal, process, words, reason)
        if not (self._closing or process.failed):
            self._post(EngineDied(words))
        if process.ready:
            self._restarts.died(now, age=now - self._started_at, had_goal=goal is not None or process.used)
        elif process.failed:
            self._start_failed(process.failed.message, lasting=process.failed.lasting)
        else:
            self._start_failed(words)

    def _take_back(self, goal: Handed, process: EngineProcess, words: str, reason: str) -> None:
        """Decide what becomes of a goal whose process is lost.

        One that died before it began with the goal, so that nothing of it was heard, leaves it to the next; not twice.
        """
        if reason == "engine_crashed" and goal.stop_at is None and not (goal.started or goal.again):
            goal.again = True
            if goal.pause is not None:
                self._post(protocol.Paused(goal.say.id, goal.pause))
        else:
            failed = protocol.Ended(goal.say.id, protocol.FAILED, reason, words)
            goal.verdict = failed if goal.stop_at is None else protocol.Ended(goal.say.id, protocol.STOPPED)
            goal.verdict_on = process
        goal.heard_at = goal.stop_at = goal.pause_at = None

    def _start_failed(self, words: str, *, lasting: bool = False) -> None:
        """Plan another start; where the one in hand need not wait for it, it ends."""
        costs_a_goal = self._restarts.failed(time.monotonic(), self._started_at, words if lasting else None)
        waits = self._goal if self._goal and not self._goal.verdict else None
        if waits and (costs_a_goal or self._restarts.error is not None):
            why = self._restarts.error or words
            self._finish(protocol.Ended(waits.say.id, protocol.FAILED, "engine_failed", why))
        elif costs_a_goal:
            self._post(EngineMissing(words))

    def _bury(self, process: EngineProcess) -> None:
        """Process and player are gone: what was being spoken is silent."""
        self._selector.unregister(process.liveness)
        if process.stderr in self._selector.get_map():
            process.read_stderr()
            self._selector.unregister(process.stderr)
        process.close()
        self._dying.remove(process)
        goal = self._goal
        if goal and goal.verdict and goal.verdict_on is process:
            self._finish(goal.verdict)

    # -- the end

    def _shut_down(self) -> None:
        """Leave no process behind; one that cannot be ended within the limit is left to the system."""
        self._lose_process("the server ends", "shutdown")
        limit = time.monotonic() + SILENCE_LIMIT / 4
        while self._dying and time.monotonic() < limit:
            for key in self._inbox.wait(limit):
                self._handle(key)
        for process in self._dying:
            process.close()
        self._inbox.close()
