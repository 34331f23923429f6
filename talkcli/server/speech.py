"""The connection between the scheduler and the engine.

Everything runs in the event loop's thread and never blocks. The scheduler makes the decisions, the engine thread
speaks, and `subscribers` publishes the events. A timer in this module calls the scheduler's `tick` at its `deadline`.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections import defaultdict, deque
from functools import partial
from itertools import chain
from math import inf
from typing import TYPE_CHECKING

from talkcli.daemon import log
from talkcli.engine import protocol
from talkcli.engine.parent.supervisor import EngineDied, EngineMissing, EngineSaid, Report, ThreadDied
from talkcli.engine.players import NO_PLAYER_MESSAGE
from talkcli.engine.pronunciation import Pronunciations
from talkcli.engine.sounds import SoundLibrary
from talkcli.engine.voices import is_own_driver
from talkcli.errors import TalkError, UsageError
from talkcli.frozen import replace
from talkcli.goals import options as goal_options
from talkcli.goals.goal import By, Goal, Output, Sender
from talkcli.goals.options import DEFAULTS, ENGINE_OPTIONS, engine_options, is_neural, require_fields, without_speaker
from talkcli.goals.reasons import Reason
from talkcli.goals.scheduler import Effect, EngineOrder, Interruption, Now, Order, PauseChange, StateChange
from talkcli.goals.states import State
from talkcli.goals.voices import VoiceDropOrder, VoiceLoadOrder, VoiceWarning
from talkcli.server.connection import resume_all
from talkcli.server.stream import ClientStreams
from talkcli.server.subscribers import Notifications, Subscribers
from talkcli.server.voices import VoiceCatalog
from talkcli.terminal.text import printable

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from talkcli.engine.parent.supervisor import Supervisor
    from talkcli.engine.pronunciation import PronunciationFile
    from talkcli.goals.goal import JsonObject
    from talkcli.goals.record import Record
    from talkcli.goals.scheduler import Scheduler
    from talkcli.server.connection import ClientConnection, WaitingList
    from talkcli.server.history import History

#: A clock that keeps running while the machine is suspended. On Linux, the usual monotonic clock stops then.
_CLOCK = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)
#: How often to check whether the deadline has passed. The event loop's own timers stop while the machine is suspended.
CLOCK_CHECK_S = 1.0
#: Status of an engine that is ready to speak.
READY = "ready"
#: Maximum number of the engine's reports to process at once. Publishing this many words to fifty watchers takes 10 to
#: 20 ms on a busy machine.
REPORTS_PER_TURN = 8
#: Maximum length of a program's name or command line in the log.
_MAX_LOGGED_COMMAND_CHARS = 80
_NO_PLAYER_NEEDED = "no player needed"
#: An `append` is answered when at most this many characters of the text are still unheard.
MAX_UNHEARD_CHARS = 10_000

require_fields(protocol.Speak, ENGINE_OPTIONS)


def unheard_chars(record: Record) -> int:
    """Return how many characters of a goal's text have not been heard yet.

    If a goal waits for text, all text that the engine has received doesn't count, such as a block of code.
    """
    return len(record.say.text) - record.passed_chars


def monotonic_now() -> float:
    """Return a monotonic time that doesn't stop while the machine is suspended."""
    return time.clock_gettime(_CLOCK)


class Speech:
    """Manages the goals of a server and the engine that speaks them."""

    def __init__(self, scheduler: Scheduler, player_options: Sequence[str] = ()) -> None:
        """Start without an engine.

        Args:
            scheduler: the server's scheduler.
            player_options: the names of the given player options, for the log.
        """
        self.scheduler = scheduler
        self._player_options = player_options
        #: the supervisor of the engine, set before the first client connects
        self.engine: Supervisor
        #: stores the goals that have ended, or None
        self.history: History | None = None
        #: the file that says how to pronounce terms, or None
        self.pronunciation_file: PronunciationFile | None = None
        #: called when `status_message` may have changed
        self.on_status_change: Callable[[], None] = lambda: None
        #: called when a goal was added to the queue or removed from it
        self.on_queue_change: Callable[[], None] = lambda: None
        #: called with an error when nothing can be spoken any more
        self.on_failure: Callable[[TalkError], None] = lambda _: None
        #: set after a shutdown, when all goals have ended
        self.finished = asyncio.Event()
        #: the latest engine's description of itself, or None before the first engine is ready
        self.ready: protocol.Ready | None = None
        self.voices = VoiceCatalog()
        self.sounds = SoundLibrary(None)
        #: requests that are waiting for the engine's list of voices
        self.waiting_for_voices: WaitingList = {}
        #: goals that are waiting for room in the queue
        self.waiting_for_room: WaitingList = {}
        #: cancelled goals that were waiting and have not been submitted yet
        self.canceled_goals: WaitingList = {}
        #: human-readable status of the engine
        self.engine_status = "starting"
        #: set when an engine is ready or can't be started, and when the server shuts down
        self.engine_known = asyncio.Event()
        self._loop = asyncio.get_running_loop()
        self.subscribers = Subscribers(self._waiting_connections)
        self.streams = ClientStreams()
        self.notifications = Notifications(self.streams)
        self.notifications.on_done = self._finish_if_all_ended
        self._timer: asyncio.TimerHandle | None = None
        #: the timer for a warning about a long pause
        self._pause_timer: asyncio.TimerHandle | None = None
        #: requests that are waiting for a goal to become silent or to end
        self.waiting_for_silence: defaultdict[Record, WaitingList] = defaultdict(dict)
        #: `append` requests that are waiting until more of their goal's text has been heard
        self.waiting_for_hearing: defaultdict[Record, WaitingList] = defaultdict(dict)
        #: the paused goal, if the engine has confirmed that it is silent
        self.silent_goal: Record | None = None
        #: unprocessed reports from the engine thread
        self._reports: deque[Report] = deque()
        #: whether the event loop has been woken to process reports. Waking it for each report would be too slow.
        self._reports_due = False
        #: whether there is a next goal, and whether its voice is neural, as last reported to the engine
        self._announced_next = False, False

    def status_message(self) -> str:
        """Return a short status for `systemctl status`, which every user may read."""
        scheduler, ready = self.scheduler, self.ready
        if self.engine_status != READY:
            doing = f"engine: {self.engine_status}"
        elif scheduler.paused:
            doing = "paused"
        else:
            doing = f"speaking {scheduler.active.id}" if scheduler.active else "idle"
        waiting = f", {len(scheduler.pending)} waiting" if scheduler.pending else ""
        voice = f"; {ready.version or ready.driver}, {_describe_sound(ready)}" if ready else ""
        return log.sanitize(doing + waiting + voice)

    @property
    def awaits_voices(self) -> bool:
        """Whether the engine is still expected to list its voices."""
        return self.voices.listed is None and self.engine_status in {"starting", READY}

    def _waiting_connections(self) -> Iterator[ClientConnection]:
        """Yield the connections that wait for room in the queue or for a text to be heard."""
        for each in chain(self.waiting_for_room, *self.waiting_for_hearing.values()):
            yield each.connection

    def _resume_appends(self, record: Record) -> None:
        """Resume a goal's waiting `append` requests if enough of its text has been heard."""
        waiting = self.waiting_for_hearing.get(record)
        if waiting and unheard_chars(record) <= MAX_UNHEARD_CHARS:
            resume_all(waiting)

    # -- the scheduler's effects

    def advance_time(self) -> Now:
        """Let the scheduler act on all time limits that have been reached. Return the current time."""
        now = Now(monotonic_now(), time.time())
        if self.scheduler.deadline() <= now.monotonic:
            self.apply(self.scheduler.tick(now))
        return now

    def apply(self, effects: list[Effect]) -> None:
        """Carry out the scheduler's effects, starting with orders to the engine."""
        changes, queue_changed, resumed, at = [], False, None, time.time()
        for effect in effects:
            if isinstance(effect, StateChange):
                changes.append(partial(self._publish_change, effect.record, effect.state, at))
                queue_changed = queue_changed or effect.state is not State.REJECTED
                continue
            if isinstance(effect, Interruption):
                changes.append(partial(self.subscribers.interrupted, effect.record.id, effect.interrupted_by, at))
                continue
            if isinstance(effect, PauseChange):
                changes.append(partial(self._publish_pause, effect, at))
                resumed = None if effect.paused else effect.record
                continue
            try:
                self._carry_out(effect)
            except Exception as error:  # noqa: BLE001 - the other effects must not be lost
                log.write_bug(effect.order.value if isinstance(effect, EngineOrder) else type(effect).__name__, error)
        if queue_changed:
            self.on_queue_change()
        self.notifications.add(changes)
        self._announce_next()
        self._set_timer()
        self.on_status_change()
        if resumed:
            self.silent_goal = None
            resume_all(self.waiting_for_silence[resumed])  # requests that wait for silence can now be answered

    def _carry_out(self, effect: EngineOrder | VoiceLoadOrder | VoiceDropOrder | VoiceWarning) -> None:
        """Give the engine an order, or log a warning about a voice."""
        match effect:
            case EngineOrder(record=record, order=order):
                self._give_order(record, order)
            case VoiceLoadOrder(voice=voice, dropped=dropped):
                for each in dropped:
                    log.write(f"unloaded voice {log.sanitize(each)} to make room for {log.sanitize(voice)}")
                    self.engine.drop(each)
                self.engine.load(voice)
            case VoiceDropOrder(voice=voice):
                log.write(f"unloaded voice {log.sanitize(voice)}, because the voices exceed --voice-memory")
                self.engine.drop(voice)
            case VoiceWarning(message=message):
                log.write(log.sanitize(message))

    def _give_order(self, record: Record, order: Order) -> None:
        """Tell the engine to start, change, pause or end a goal, as ordered by the scheduler."""
        match order:
            case Order.START:
                self._start_speaking(record)
            case Order.APPEND:
                self.engine.append(record.id, record.say.text, complete=not record.more, broke_off=record.broken)
            case Order.STOP:
                self.engine.stop(record.id)
            case Order.INTERRUPT:
                self.engine.interrupt(record.id)
            case Order.GIVE_UP:
                self.engine.give_up(record.id)
            case Order.HOLD:
                self.engine.pause(record.id, record.pause_count)
            case Order.RESUME:
                self.engine.resume(record.id)

    def _start_speaking(self, record: Record) -> None:
        """Tell the engine to speak a goal or the rest of it. If the goal's voice is unavailable, fail the goal.

        The rest has the same voice and settings.
        """
        self._announced_next = next_waits, next_is_neural = self._describe_next()
        assert record.settings
        options = engine_options(record.say, record.settings)
        if record.was_heard:
            options |= {"voice": record.voice or options["voice"], "lead_in": None}
        if not is_neural(options["voice"] or ""):
            options["voice_only"] = False
        elif options["voice_only"]:
            if why := self.scheduler.voices.failure(without_speaker(options["voice"])):
                self.report(protocol.Ended(record.id, protocol.OUTCOME_FAILED, Reason.VOICE_FAILED, why))
                return
            options["pitch"] = DEFAULTS.pitch  # neural voices don't support other pitches
        if record.pronunciations is None:
            self.scheduler.pronunciations_chosen(record.id, self._current_pronunciations())
        command = protocol.Speak(
            record.id,
            record.say.text,
            next_waits=next_waits,
            next_is_neural=next_is_neural,
            more=record.more,
            pronunciations=record.pronunciations or None,
            broken=record.broken,
            start=record.rest,
            heard_end=record.begun_end,
            heard_words=record.word_count,
            heard=record.heard,
            **options,
        )
        self.engine.speak(command)

    def _current_pronunciations(self) -> dict[str, str]:
        """Return the current terms and their replacements, which apply to goals that start now."""
        return self.pronunciation_file.refresh().terms if self.pronunciation_file else {}

    def describe_goal(self, record: Record) -> Goal:
        """Return a copy of a goal. Its `said` is the text as it is spoken, or as it would be spoken now."""
        goal, terms = record.snapshot(), record.pronunciations
        if terms is None and goal.state is State.PENDING:
            terms = self._current_pronunciations()
        if terms is None or goal.text is None or record.say.is_sound:
            return goal
        return replace(goal, said=Pronunciations(terms).spoken_form(goal.text, goal.format))

    def _announce_next(self) -> None:
        """Tell the engine whether another goal follows the active one."""
        active, following = self.scheduler.active, self._describe_next()
        if active and following != self._announced_next:
            self._announced_next = following
            self.engine.announce_next(active.id, *following)

    def _describe_next(self) -> tuple[bool, bool]:
        """Return whether there is a next goal, and whether its voice is neural."""
        following = self.scheduler.next_goal()
        return following is not None, following is not None and is_neural(self.scheduler.wanted_voice(following))

    def _publish_change(self, record: Record, state: State, at: float) -> None:
        """Publish a goal's new state. Log and store an ended goal, and resume the requests that wait for it."""
        self.subscribers.state_changed(record, state, at)
        if state.terminal:
            if self.history:
                self.history.add(self.describe_goal(record))
            _log_goal_end(record, monotonic_now() - record.began_at)
            resume_all(self.waiting_for_silence.pop(record, {}))
            resume_all(self.waiting_for_hearing.pop(record, {}))

    def _publish_pause(self, change: PauseChange, at: float) -> None:
        """Publish and log that speech was paused or resumed, and schedule a warning about a long pause."""
        goal_id = change.record.id if change.record else None
        self.subscribers.paused_changed(goal_id, paused=change.paused, by=By(client=change.client), at=at)
        what = "paused" if change.paused else "resumed"
        words = f"{what}, because all pauses have ended; the last one was" if change.all_ended else what
        log.write(f"{words} by {describe_sender(change.client)}")
        if self._pause_timer:
            self._pause_timer.cancel()
        if change.paused:
            self._pause_timer = self._loop.call_later(goal_options.LONG_PAUSE_S, self._warn_of_pause)

    def _warn_of_pause(self) -> None:
        """Log a warning if speech is still paused."""
        self.advance_time()
        if pause := self.scheduler.last_pause:
            minutes, by = goal_options.LONG_PAUSE_S / 60, describe_sender(pause.client)
            log.write(f"speech has been paused for {minutes:g} minutes, last by {by}; to continue, run: talk resume")

    def describe_pause(self) -> JsonObject:
        """Return the fields of a reply that say whether speech is paused, and by whom.

        They describe the pause that ends last.
        """
        last = self.scheduler.last_pause
        by = By(client=last.client).to_json() if last else None
        found: JsonObject = {"paused": self.scheduler.paused, "paused_by": by}
        return {**found, "paused_at": last and last.at, "paused_until": last and last.until}

    def _set_timer(self) -> None:
        """Set the timer for the scheduler's next time limit."""
        if self._timer:
            self._timer.cancel()
        deadline = self.scheduler.deadline()
        self._timer = None
        if deadline < inf:
            self._timer = self._loop.call_later(min(deadline - monotonic_now(), CLOCK_CHECK_S), self._tick)

    def _tick(self) -> None:
        """Let the scheduler act on time limits that have been reached, and set the timer for the next one."""
        self.advance_time()
        self._set_timer()

    # -- reports from the engine

    def report(self, report: Report) -> None:
        """Queue a report from the engine thread. This method is thread-safe.

        Only a few reports are processed in one iteration of the event loop, so that a sentence of many words doesn't
        delay other clients.
        """
        self._reports.append(report)
        if not self._reports_due:
            self._reports_due = True
            with contextlib.suppress(RuntimeError):  # raised if the event loop is closed
                self._loop.call_soon_threadsafe(self._process_reports)

    def _process_reports(self) -> None:
        """Process a limited number of queued reports, and schedule another call for the rest."""
        # Reset this first, so that a report that arrives during the loop below wakes the event loop again.
        self._reports_due = False
        for _ in range(REPORTS_PER_TURN):
            if not self._reports:
                return
            report = self._reports.popleft()
            try:
                self._process_report(report)
            except Exception as error:  # noqa: BLE001 - the other reports must not be lost
                log.write_bug("a report from the engine", error)
        self._reports_due = True
        self._loop.call_soon(self._process_reports)

    def _process_report(self, report: Report) -> None:
        """Pass a report to the method for its kind. Ignore reports about goals that are no longer active."""
        now, active = self.advance_time(), self.scheduler.active
        if isinstance(report, protocol.GoalEvent):
            if active and active.id == report.id:  # reports about a goal that is no longer active are ignored
                self._process_goal_event(report, active, now)
        elif isinstance(report, protocol.VoiceEvent):
            self._process_voice_event(report, now)
        else:
            self._process_engine_event(report, now)

    def _process_goal_event(self, event: protocol.GoalEvent, active: Record, now: Now) -> None:
        """Update the active goal from a report of the engine, and notify the goal's clients."""
        scheduler = self.scheduler
        match event:
            case protocol.TextMissing():
                if active.waits is not event.missing:
                    publish = partial(self.subscribers.text_missing, event.id, time.time(), waits=event.missing)
                    self.notifications.add([publish])
                scheduler.text_missing(event.id, event.length, now, missing=event.missing)
                self._resume_appends(active)
                self._set_timer()
            case protocol.Word():
                scheduler.word_heard(event.id, event.start, event.end, event.time)
                self._resume_appends(active)
                text = active.say.text[event.start : event.end]
                self.notifications.add([partial(self.subscribers.word_heard, event, text, time.time())])
            case protocol.Ended():
                self._end_active_goal(event, active, now)
            case protocol.OutputChanged():
                scheduler.output_changed(event.id, Output.from_json(event.output))
            case protocol.VoiceChosen():
                if event.fallback_reason:
                    log.write(
                        log.sanitize(
                            f"{event.id} is spoken with the voice {event.voice} instead: {event.fallback_reason}"
                        )
                    )
                self.apply(scheduler.voice_chosen(event.id, event.voice, now))
            case protocol.Held():
                if active.paused and active.pause_count == event.number:
                    self.silent_goal = active
                    resume_all(self.waiting_for_silence[active])

    def _process_voice_event(self, event: protocol.VoiceEvent, now: Now) -> None:
        """Store the engine's list of voices, or tell the scheduler that a voice was loaded or unloaded."""
        scheduler = self.scheduler
        match event:
            case protocol.VoiceList():
                self.voices.listed = event.voices
                resume_all(self.waiting_for_voices)
            case protocol.VoiceLoaded():
                _log_voice_load(event)
                imported = event.seconds > 0
                self.apply(scheduler.voice_load_ended(event.voice, event.error, now, imported_libraries=imported))
            case protocol.VoiceMemory():
                self.apply(scheduler.voices_measured(event.voice, event.memory, now))
            case protocol.VoiceUnloaded():
                self.apply(scheduler.voice_unloaded(event.voice, now))

    def _process_engine_event(self, event: Report, now: Now) -> None:
        """Record that the engine is ready or has failed, or log a line of its standard error."""
        match event:
            case protocol.Ready():
                self._handle_ready(event, now)
            case protocol.StartFailed():
                self._handle_failed_start(event, now)
            case EngineSaid():
                log.write(f"engine: {log.sanitize(event.line)}")
            case EngineDied():
                self.apply(self.scheduler.engine_lost(now))
                self._record_engine_failure(event.message)
            case EngineMissing():
                self.apply(self.scheduler.fail_next(event.message, now))
            case ThreadDied():
                # Nothing can be spoken any more, so shut down. A service manager may restart the server.
                self._record_engine_failure(event.message)
                self.on_failure(TalkError(event.message))
                if active := self.scheduler.active:
                    self.apply(self.scheduler.failed(active.id, Reason.ENGINE_FAILED, event.message, None, now))

    def _end_active_goal(self, ended: protocol.Ended, active: Record, now: Now) -> None:
        """End or interrupt the active goal after the engine has reported its end."""
        scheduler = self.scheduler
        if self.ready and ended.player:  # `status` shows the player that was used
            self.ready = replace(self.ready, player=ended.player)
        if ended.heard is not None:
            scheduler.audio_heard(ended.id, ended.heard)
        if ended.outcome == protocol.OUTCOME_COMPLETED:
            effects = scheduler.completed(ended.id, ended.duration, now, ended.gaps, ended.gap_seconds)
        elif ended.outcome == protocol.OUTCOME_INTERRUPTED:
            if active.waits:
                publish = partial(self.subscribers.text_missing, active.id, time.time(), waits=False)
                self.notifications.add([publish])
            rest = ended.rest or 0
            effects = scheduler.interrupted_at(ended.id, rest, now, ended.gaps, ended.gap_seconds)
            resume_all(self.waiting_for_silence[active])
        elif ended.outcome == protocol.OUTCOME_STOPPED and active.stop_requested_at is not None:
            effects = scheduler.stopped(ended.id, now)
        else:
            reason, words = ended.reason or Reason.ENGINE_FAILED, ended.message or "the engine stopped unexpectedly"
            effects = scheduler.failed(ended.id, reason, words, ended.duration, now)
        self.apply(effects)

    def _handle_ready(self, ready: protocol.Ready, now: Now) -> None:
        """Record that an engine is ready, and start the next goal. The first engine sets the voice."""
        if self.ready is None and ready.voice is not None:
            self.apply(self.scheduler.change_settings({"voice": ready.voice}, now))
        if self.ready is None or self.ready != replace(ready, player=self.ready.player):
            _log_engine(ready, self._player_options)
        self.ready, self.engine_status, self.voices.driver = ready, READY, ready.driver
        self.engine_known.set()
        self.apply(self.scheduler.engine_ready(now))

    def _handle_failed_start(self, failed: protocol.StartFailed, now: Now) -> None:
        """Record that the engine could not be started, and shut down if its options are wrong."""
        if failed.usage_error and self.ready is None:
            self.on_failure(UsageError(failed.message))
            return
        self._record_engine_failure(failed.message)
        if failed.permanent:
            self.engine_known.set()
            self.apply(self.scheduler.engine_unavailable(now))

    def _record_engine_failure(self, message: str) -> None:
        """Record and log why there is no engine. Requests that wait for its voices continue."""
        if message != self.engine_status:
            log.write(log.sanitize(message))
        self.engine_status = message
        resume_all(self.waiting_for_voices)
        self.on_status_change()

    # -- shutdown

    def shut_down(self) -> None:
        """End all goals and reject new ones."""
        self.engine_known.set()
        self.apply(self.scheduler.shutdown(self.advance_time()))

    def _finish_if_all_ended(self) -> None:
        """Set `finished` once all goals have ended during a shutdown."""
        if self.scheduler.closing and not (self.scheduler.active or self.canceled_goals):
            self.finished.set()


# -- the log


def _log_goal_end(record: Record, seconds: float) -> None:
    """Log how a goal ended, and how many seconds it was active."""
    took = "" if record.started_at is None else f" after {seconds:.1f} s"
    how = f"{record.id} {record.state.name}{took}"
    if record.state is not State.SUCCEEDED:
        by = record.by or By()
        ended_by = by.goal or (by.client and describe_sender(by.client))
        cause = f" by {ended_by}" if ended_by else ""
        how += f" ({record.reason}{cause})"
    detail = f"; {log.sanitize(record.message)}" if record.state is State.ABORTED and record.message else ""
    sound = "sound " * record.say.is_sound
    log.write(f'{how}: {sound}"{log.sanitize(record.say.text)}" from {describe_sender(record.sender)}{detail}')


def _log_engine(engine: protocol.Ready, player_options: Sequence[str]) -> None:
    """Log that the engine is ready, with its driver and audio output.

    Args:
        engine: the engine's description of itself.
        player_options: the names of the player options that were given.
    """
    version = f", {log.sanitize(engine.version)}" if engine.version else ""
    sound = _describe_sound(engine)
    words = f"engine ready: driver {engine.driver}{version}, {sound}"
    if player_options and sound == _NO_PLAYER_NEEDED:
        words += f"; {' and '.join(player_options)} {'has' if len(player_options) == 1 else 'have'} no effect"
    log.write(words)


def _log_voice_load(voice: protocol.VoiceLoaded) -> None:
    """Log that a neural voice was loaded, or that loading it failed."""
    how = f"loaded in {voice.seconds:.1f} s"
    if voice.error is not None:
        how = f"can't be loaded, so espeak is used instead (except with --voice-only): {log.sanitize(voice.error)}"
    log.write(f"voice {log.sanitize(voice.voice)} {how}")


def _describe_sound(engine: protocol.Ready) -> str:
    """Return a short description of the engine's audio output."""
    if engine.player:
        return f"player {engine.player}"
    return NO_PLAYER_MESSAGE if is_own_driver(engine.driver) else _NO_PLAYER_NEEDED


def describe_sender(sender: Sender) -> str:
    """Return a short description of the program that sent a request."""
    parts = (
        None if sender.uid is None else f"uid {sender.uid}",
        None if sender.pid is None else f"pid {sender.pid}",
        sender.command and printable(sender.command, _MAX_LOGGED_COMMAND_CHARS),
        sender.parent and f"started by {printable(sender.parent, _MAX_LOGGED_COMMAND_CHARS)}",
        sender.name and f'named "{printable(sender.name)}"',
    )
    return ", ".join(filter(None, parts)) or "an unknown client"
