"""The scheduler decides which goal is spoken next, how goals end, and which voices are loaded.

The scheduler is pure: its methods receive a request, a report from the engine or the time, and return effects. A method
either does everything or raises an error and changes nothing. The caller must carry out the orders for the engine in
the order in which they were returned, and publish the state changes in their order. Only this package changes the
scheduler and its records.

At most one goal is spoken or stopped at any time. The next goal starts only after that goal has ended or was
interrupted, and only with an engine and while speech is not paused. Interrupted goals stay ACTIVE, and continue later.
Every goal ends exactly once.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from math import inf
from typing import TYPE_CHECKING

from talkcli.errors import RequestRefused
from talkcli.frozen import frozen, replace
from talkcli.goals import options
from talkcli.goals.goal import By, Output, Sender
from talkcli.goals.memory import EarlyCancels, RecentGoals, SpeechTimes
from talkcli.goals.queue import Queue
from talkcli.goals.reasons import Reason, Refusal
from talkcli.goals.record import Record
from talkcli.goals.states import IllegalTransition, State
from talkcli.goals.voices import VoiceDropOrder, VoiceLoadOrder, VoiceScheduler, VoiceWarning

if TYPE_CHECKING:
    from collections.abc import Collection

    from talkcli.goals.options import Append, Cancel, Say, Set

_BROKEN_OFF = "the text broke off before its end"
#: Descriptions of the reasons for stopping a goal, except for interrupting goals and an expired ttl.
_STOP_CAUSES = {Reason.CANCELED: "the goal was cancelled", Reason.SHUTDOWN: "the server was stopped"}
#: Time limit for the engine to become silent after a stop. Every cancel must be answered within 2 s.
CONFIRM_SILENCE_S = 1.9
#: Maximum number of interrupted goals. Listeners couldn't follow more of them.
MAX_INTERRUPTED = 8


@frozen
class Now:
    """The current time in seconds, on the monotonic clock and on the wall clock.

    The monotonic clock must keep running while the machine is suspended, so that goals can expire during that time.
    """

    monotonic: float
    #: seconds since 1970 UTC, used only for display
    wall: float


@frozen
class StateChange:
    """An effect that tells clients about a goal's new state."""

    record: Record
    state: State


@frozen
class Interruption:
    """An effect that tells clients about the interruption of a goal by another one.

    When the goal continues, a StateChange to ACTIVE follows.
    """

    record: Record
    interrupted_by: str


@frozen
class PauseChange:
    """An effect that tells clients about the start or the end of a pause."""

    paused: bool
    #: the goal that is being spoken, or None
    record: Record | None
    #: the client that paused or resumed speech, or whose pause has ended
    client: Sender
    #: whether speech is resumed because all pauses have ended
    all_ended: bool = False


@frozen
class SpeechPause:
    """A pause of all speech that a client began."""

    client: Sender
    #: the beginning and the end, in seconds since 1970 UTC. The end is None if only `resume` ends the pause.
    at: float
    until: float | None
    #: monotonic time when the pause ends, or inf
    ends_at: float


class Order(Enum):
    """A kind of order to the engine, such as starting or stopping a goal.

    The value is the order's name in the log.
    """

    START = "Start"
    #: become silent, then report that the goal has ended
    STOP = "Stop"
    #: become silent at the end of a word, then report where the text continues
    INTERRUPT = "Interrupt"
    #: speak the text that was added, and stop waiting for more if the text has ended or broken off
    APPEND = "Append"
    #: replace the engine process, because it did not become silent in time
    GIVE_UP = "GiveUp"
    #: pause the speech until RESUME
    HOLD = "Hold"
    RESUME = "Resume"


@frozen
class EngineOrder:
    """An effect that gives the engine an order."""

    record: Record
    order: Order


Effect = StateChange | Interruption | PauseChange | EngineOrder | VoiceLoadOrder | VoiceDropOrder | VoiceWarning


@dataclass(slots=True)
class Cancellation:
    """The result of a cancel request: the goals found, the unknown ids, and the effects to carry out."""

    #: pending and interrupted goals that the request has ended at once
    ended_at_once: list[Record] = field(default_factory=list)
    #: the active goal, if it is being stopped
    stopping: Record | None = None
    #: requested goals that had already ended
    ended: list[Record] = field(default_factory=list)
    #: requested ids that don't belong to any goal
    unknown: list[str] = field(default_factory=list)
    effects: list[Effect] = field(default_factory=list)


class Scheduler:
    """Decides which goal of a server is spoken next, and how each goal ends."""

    def __init__(
        self,
        boot: str,
        *,
        max_queue: int,
        max_text: int = options.MAX_TEXT_CHARS,
        settings: Set = options.DEFAULTS,
        voices: VoiceScheduler | None = None,
        can_interrupt: bool = True,
    ) -> None:
        """Create a scheduler with no goals and no engine.

        Args:
            boot: the first four characters of all goal ids made by this server.
            max_queue: the maximum number of pending goals.
            max_text: the maximum number of characters in a text.
            settings: the values for options that a goal omits. Every setting must have a value.
            voices: the scheduler of neural voices, or None to create one.
            can_interrupt: whether interjections interrupt goals. Otherwise, they only go first.
        """
        self.boot = boot
        self.settings = settings
        self.max_queue = max_queue
        self.max_text = max_text
        self.pending = Queue()
        self.recent = RecentGoals()
        self.voices = voices or VoiceScheduler()
        self._can_interrupt = can_interrupt
        #: the goal that is being spoken or stopped, or None
        self.active: Record | None = None
        #: the goals that were interrupted and will continue; the last one continues first
        self.interrupted: list[Record] = []
        #: id of the interjection that interrupts the active goal at the end of a word, or None
        self._interrupter: str | None = None
        #: whether speech is paused
        self.paused = False
        #: the pauses that end with their connections, by connection. The longest of all other pauses has the key None.
        self._pauses: dict[object, SpeechPause] = {}
        #: whether goals can start. This is also true if no engine can be started, so that goals fail at once.
        self.has_engine = False
        #: goals with incomplete texts whose senders have left, and the time at which each one ends if nobody continues
        #: it
        self._orphans: dict[Record, float] = {}
        #: whether `shutdown` was called, so that new goals are rejected
        self.closing = False
        #: whether an engine process is running that can load voices
        self._loads_voices = False
        self._by_id: dict[str, Record] = {}
        self._speech_times = SpeechTimes()
        self._early_cancels = EarlyCancels()
        self._count = 0

    # -- goals

    def unfinished(self) -> list[Record]:
        """Return all unfinished goals in speaking order: the active goal, the interrupted and the pending ones."""
        return [*self.begun()[::-1], *self.pending]

    def begun(self) -> list[Record]:
        """Return the interrupted goals and the active one, if any."""
        return [*self.interrupted, *([self.active] if self.active else [])]

    def next_goal(self) -> Record | None:
        """Return the goal to speak after the active one, or None if no goal is waiting.

        Interrupted goals continue before other goals start, but after interjections, unless those have a lower
        priority.
        """
        if not self.interrupted:
            return self.pending.first()
        last = self.interrupted[-1]
        return self._find_interjection(last.say.priority) or last

    def find(self, goal_id: str) -> Record | None:
        """Return the goal with this id, or None if it is unknown.

        Goals that ended long ago are forgotten.
        """
        return self._by_id.get(goal_id) or self.recent.find(goal_id)

    def has_room(self, say: Say) -> bool:
        """Return whether the queue has room for a goal, or can make room.

        A known id needs no room.
        """
        attaches = say.id is not None and self.find(say.id) is not None
        return attaches or self._find_room(say) is not None

    def only_lacks_room(self, say: Say, now: Now, server_refusal: Refusal | None = None) -> bool:
        """Return whether a goal would be rejected only because the queue is full.

        `server_refusal` is the server's own reason to reject the goal, as in `submit`.
        """
        canceled = self._early_cancels.find(say.id, now.monotonic)
        return not (canceled or self.has_room(say)) and self._find_refusal(say, server_refusal, None) is None

    def wanted_voice(self, record: Record) -> str:
        """Return the voice that a goal asks for, or the server's default voice.

        A goal that has begun keeps its voice. An empty string stands for the driver's default voice. A sound needs no
        voice.
        """
        settings = record.settings or self.settings
        return "" if record.say.is_sound else record.voice or record.say.voice or settings.voice or ""

    # -- requests from clients

    def submit(
        self,
        say: Say,
        sender: Sender,
        now: Now,
        server_refusal: Refusal | None = None,
        canceled_by: By | None = None,
        waited_s: float = 0.0,
    ) -> tuple[Record, list[Effect]]:
        """Add a goal to the queue, or reject it. Return its record and the effects.

        A rejected goal doesn't affect other goals.

        Args:
            say: the goal.
            sender: the program that sent the goal.
            now: the current time.
            server_refusal: the server's own reason to reject the goal, or None.
            canceled_by: the client that cancelled the goal while it waited for room. The goal is accepted and recalled.
            waited_s: how long the goal waited for room, which counts towards its time to live.

        Returns:
            The record of the goal, and the effects. If an earlier goal has the same id and text, its record is returned
            without effects.
        """
        first = self.find(say.id) if say.id is not None and options.is_clients_id(say.id) else None
        if first is not None and first.was_sent_as(say):
            if say.more:
                self._orphans.pop(first, None)
            return first, []
        self._count += 1
        ttl = (self.settings.ttl if say.ttl is None else say.ttl) or None
        expires_at = inf if ttl is None else now.monotonic + ttl - waited_s
        number, asked = self._count, say if ttl == say.ttl else replace(say, ttl=ttl)
        record = Record(f"{self.boot}-{number}", number, asked, sender, now.wall, self._may_preempt(say), expires_at)
        record.first_chars = len(say.text)
        by = canceled_by or self._early_cancels.find(say.id, now.monotonic)
        refused = self._find_refusal(say, server_refusal, first)
        refused = refused or (None if canceled_by else self._find_repeat(say, record, now))
        expired = expires_at <= now.monotonic
        recalled = self._find_room(say)
        if recalled is None and not (by or refused or expired):
            refused = Reason.QUEUE_FULL, f"the queue is full ({len(self.pending)} goals); wait, or cancel some of them"
        if refused:
            record.reject(refused, now.wall)
            self.recent.add(record)
            return record, [StateChange(record, State.REJECTED)]
        record.id, record.more = say.id or record.id, say.more
        self._by_id[record.id] = record
        effects: list[Effect] = [StateChange(record, State.PENDING)]
        if by:
            words = f"the goal was cancelled before it {'started' if canceled_by else 'arrived'}"
            return record, effects + self._end_unqueued(record, Reason.CANCELED, words, by, now)
        if expired:
            words = _expiry_message(record)
            return record, effects + self._end_unqueued(record, Reason.EXPIRED, words, None, now)
        effects += self._enqueue(record, recalled or [], now)
        self._request_voice(self.wanted_voice(record), now)
        effects += self._start_next(now) + self._interrupt_active()
        return record, effects + self._order_next_voice(now)

    def try_out(self, say: Say, sender: Sender, now: Now, server_refusal: Refusal | None) -> Record:
        """Check a goal without queueing it. Return its record, which has no id and is PENDING or REJECTED.

        The arguments are those of `submit`.
        """
        record, first = Record("", 0, say, sender, now.wall), self.find(say.id or "")
        if refused := self._find_refusal(say, server_refusal, None if first and first.was_sent_as(say) else first):
            record.reject(refused, now.wall)
        return record

    def cancel(
        self, selection: Cancel, sender: Sender | None, now: Now, waiting_ids: Collection[str | None] = ()
    ) -> Cancellation:
        """Cancel goals, including unknown ones that arrive soon. Return the affected goals and the effects.

        Pending and interrupted goals end at once. The active goal ends when the engine is silent. Unknown
        ids are remembered, and a goal with such an id is cancelled if it arrives soon.

        Args:
            selection: the goals to cancel.
            sender: the client that cancels the goals.
            now: the current time.
            waiting_ids: ids of selected goals that still wait for room in the queue.
        """
        result = Cancellation()
        by = By(client=sender)
        chosen = self._select(selection, result, waiting_ids)
        for goal_id in filter(options.is_clients_id, result.unknown):
            self._early_cancels.add(goal_id, by, now.monotonic)
        for record in chosen:
            if record.state is State.PENDING:
                result.effects += self._recall(
                    record, Reason.CANCELED, "the goal was cancelled before it started", by, now
                )
                result.ended_at_once.append(record)
                continue
            if record is self.active:
                result.stopping = record
            else:
                result.ended_at_once.append(record)
            result.effects += self._stop(record, Reason.CANCELED, by, now)
        result.effects += self._order_next_voice(now)
        return result

    def append(self, record: Record, addition: Append, now: Now) -> list[Effect]:
        """Add text to a goal, mark its text as complete, or end the goal if its sender gave up.

        Return the effects. An addition that was sent before changes nothing.

        Args:
            record: the goal.
            addition: the text to add, whether it is the last one, and whether the sender gave up.
            now: the current time.

        Raises:
            RequestRefused: the goal or its text has ended, or the addition doesn't fit. Its code is `goal_ended`,
                `text_ended`, `text_missing`, `text_conflict`, `text_too_long` or `invalid_text`.
        """
        text = record.say.text
        at = len(text) if addition.at is None else addition.at
        known = text[at : at + len(addition.text)]
        added = addition.text[len(known) :]
        if record.state not in {State.PENDING, State.ACTIVE}:
            raise RequestRefused(f"goal {record.id} has ended ({record.state})", "goal_ended")
        if record.broken:
            raise RequestRefused(f"goal {record.id} takes no more text: {_BROKEN_OFF}", "goal_ended")
        if at > len(text):
            words = f"the text of goal {record.id} has {len(text):,} characters, so nothing can be added at {at:,}"
            raise RequestRefused(words, "text_missing")
        if not addition.text.startswith(known):
            raise RequestRefused(f"goal {record.id} already has a different text at position {at:,}", "text_conflict")
        if not record.more:
            if added:
                raise RequestRefused(f"the text of goal {record.id} is already complete", "text_ended")
            return []
        if refused := options.bad_characters(added, self.max_text * options.GROWTH_FACTOR, len(text)):
            raise RequestRefused(refused[1], refused[0])
        record.say = replace(record.say, text=text + added)
        if addition.broken:
            return self.break_off(record, now, at_once=True)
        self._orphans.pop(record, None)
        record.more = not addition.end
        self._reset_stall_limit(record, now)
        return [EngineOrder(record, Order.APPEND)] if record is self.active and (added or addition.end) else []

    def producer_left(self, record: Record, now: Now) -> list[Effect]:
        """End an incomplete goal after its client has left, unless another client may continue it. Return the effects.

        Another connection can continue the text only if the sender chose the goal's id.
        """
        if not record.more or record.say.id is None:
            return self.break_off(record, now)
        self._orphans.setdefault(record, now.monotonic + record.say.stall)
        return []

    def break_off(self, record: Record, now: Now, *, at_once: bool = False) -> list[Effect]:
        """End an incomplete goal, at once or after speaking the text so far. Return the effects.

        A goal that hasn't started always ends at once.
        """
        self._orphans.pop(record, None)
        if not (record.more and record.state in {State.PENDING, State.ACTIVE}):
            return []
        if record.state is State.PENDING:
            return self._recall(record, Reason.BROKEN_OFF, _BROKEN_OFF, None, now) + self._order_next_voice(now)
        record.more, record.broken = False, True
        self._reset_stall_limit(record, now)
        if at_once:
            return self._stop(record, Reason.BROKEN_OFF, None, now)
        return [EngineOrder(record, Order.APPEND)] if record is self.active else []

    def change_settings(self, changes: dict[str, object], now: Now) -> list[Effect]:
        """Change the settings for goals that have not started. Return the effects.

        A new voice that failed to load earlier is loaded again.
        """
        self.settings = replace(self.settings, **changes)
        voice = changes.get("voice")
        if isinstance(voice, str):
            self.voices.forget_failure(options.without_speaker(voice))
            self._request_voice(voice, now)
        return self.tick(now)  # the next goal may no longer have to wait for its voice

    def pause(self, client: Sender, now: Now, seconds: float | None = None, connection: object = None) -> list[Effect]:
        """Pause the active goal, and start no other goal until all pauses have ended. Return the effects.

        If the goal is about to be interrupted, it becomes silent at the end of its word.

        Args:
            client: the client that pauses speech.
            now: the current time.
            seconds: after this time, the pause ends. If it is None, only `resume` or the connection ends the pause.
            connection: if it is given, the pause ends when `end_pause` is called with it. The pause replaces an earlier
                one with the same connection.
        """
        until, ends_at = (None, inf) if seconds is None else (now.wall + seconds, now.monotonic + seconds)
        earlier = self._pauses.get(connection)
        if earlier is None or connection is not None or earlier.ends_at < ends_at:
            self._pauses[connection] = SpeechPause(client, now.wall, until, ends_at)
        if self.paused:
            return []
        self.paused = True
        if self.active is None or self.active.state is not State.ACTIVE or self._interrupter is not None:
            return [PauseChange(True, None, client)]
        self.active.paused = True
        self.active.pause_count += 1
        return [PauseChange(True, self.active, client), EngineOrder(self.active, Order.HOLD)]

    def resume(self, client: Sender, now: Now, *, all_ended: bool = False) -> list[Effect]:
        """End all pauses, and resume the paused goal or start the next one. Return the effects.

        Args:
            client: the client that resumes speech, or whose pause has ended.
            now: the current time.
            all_ended: whether speech is resumed because all pauses have ended.
        """
        if not self.paused:
            return []
        self.paused = False
        self._pauses.clear()
        if not (self.active and self.active.paused):
            return [PauseChange(False, None, client, all_ended), *self._start_next(now)]
        self.active.paused = False
        self._reset_stall_limit(self.active, now)
        effects: list[Effect] = [PauseChange(False, self.active, client, all_ended)]
        return [*effects, EngineOrder(self.active, Order.RESUME), *self._interrupt_active()]

    def end_pause(self, connection: object, now: Now) -> list[Effect]:
        """End the pause that belongs to a connection, if there is one. Return the effects."""
        ended = self._pauses.pop(connection, None)
        return self._resume_if_all_ended(ended.client, now) if ended else []

    @property
    def last_pause(self) -> SpeechPause | None:
        """The pause that ends last, or None if speech is not paused."""
        return max(self._pauses.values(), key=lambda each: each.ends_at, default=None)

    def _resume_if_all_ended(self, client: Sender, now: Now) -> list[Effect]:
        """Resume speech if all pauses have ended. Return the effects.

        `client` is the client of the pause that ended last.
        """
        last = self.last_pause
        return [] if last and last.ends_at > now.monotonic else self.resume(client, now, all_ended=True)

    def shutdown(self, now: Now) -> list[Effect]:
        """End all pending and interrupted goals, stop the active one, and reject new ones. Return the effects."""
        self.closing = True
        effects: list[Effect] = []
        for record in list(self.pending):
            effects += self._recall(record, Reason.SHUTDOWN, "the server was stopped", None, now)
        for record in self.begun():
            effects += self._stop(record, Reason.SHUTDOWN, None, now)
        return effects

    # -- reports from the engine

    def engine_lost(self, now: Now) -> list[Effect]:
        """Record that the engine process has exited. Return warnings about voices, if any.

        No goal starts until a new engine is ready.
        """
        self.has_engine = self._loads_voices = False
        return [*self.voices.engine_lost(now.monotonic)]

    def engine_ready(self, now: Now) -> list[Effect]:
        """Record that an engine is ready, and start the next goal. Return the effects.

        The effects also load the voices that goals need.
        """
        self.has_engine = self._loads_voices = True
        for voice in (*self._needed_voices(), self.settings.voice or ""):
            self._request_voice(voice, now)
        return self._start_next(now) + self._order_next_voice(now)

    def engine_unavailable(self, now: Now) -> list[Effect]:
        """Record that no engine can be started, and let goals fail from now on. Return the effects.

        The next goal starts and fails at once.
        """
        self.has_engine, self._loads_voices = True, False
        return self._start_next(now)

    def fail_next(self, message: str, now: Now) -> list[Effect]:
        """End the next goal as ABORTED, unless an engine is available. Return the effects.

        Called after a long wait for an engine.
        """
        if self.has_engine:
            return []
        record, effects = self._activate_next(now)
        return effects + self.failed(record.id, Reason.ENGINE_FAILED, message, None, now) if record else effects

    def word_heard(self, goal_id: str, start: int, end: int, seconds: float) -> None:
        """Record the start of a word of the active goal, and the word's position in the audio.

        All words before it were heard to their end.

        Raises IllegalTransition if the active goal has another id.

        Args:
            goal_id: the id of the goal.
            start: the offset in the text at which the word starts.
            end: the offset in the text at which the word ends.
            seconds: the position of the word in the audio.
        """
        record = self._require_active(goal_id)
        if start >= record.begun_end:
            # The text between two reported words may contain a word that was spoken together with the first one.
            between = record.say.text[record.begun_end : start]
            opening = [] if between[-1:].isspace() else between.split()[-1:]  # such as a quotation mark
            record.spoken_end = record.begun_end + len(between.removesuffix("".join(opening)).rstrip())
        record.begun_end = max(record.begun_end, end)
        record.word_count += 1
        record.passed_chars = max(record.passed_chars, end)
        self.audio_heard(goal_id, seconds)

    def audio_heard(self, goal_id: str, seconds: float) -> None:
        """Record how many seconds of the active goal's audio have been heard so far."""
        record = self._require_active(goal_id)
        record.heard = max(record.heard, seconds)

    def text_missing(self, goal_id: str, received_chars: int, now: Now, *, missing: bool) -> None:
        """Record whether the active goal is silent while it waits for text.

        `received_chars` is the number of characters that the engine has received.
        """
        record = self._require_active(goal_id)
        record.waits = missing
        if missing:
            record.spoken_end, record.passed_chars = record.begun_end, received_chars
        self._reset_stall_limit(record, now)

    def voice_chosen(self, goal_id: str, voice: str, now: Now) -> list[Effect]:
        """Record which voice speaks the active goal. Return the order to load the next voice, if any."""
        self._require_active(goal_id).voice = voice
        return self._order_next_voice(now)

    def pronunciations_chosen(self, goal_id: str, pronunciations: dict[str, str]) -> None:
        """Record how terms in the active goal's text are replaced."""
        self._require_active(goal_id).pronunciations = pronunciations

    def output_changed(self, goal_id: str, output: Output | None) -> None:
        """Record the audio output of the active goal.

        `output` is None if it is unknown. A goal that was ever muted counts as muted.
        """
        record = self._require_active(goal_id)
        if record.output and record.output.muted:
            output = replace(output or record.output, muted=True)
        record.output = output

    def interrupted_at(self, goal_id: str, rest: int, now: Now, gaps: int = 0, gap_seconds: float = 0) -> list[Effect]:
        """Record where the active goal was interrupted, and start the next goal. Return the effects.

        Args:
            goal_id: the id of the goal.
            rest: the offset in the text at which the goal will continue.
            now: the current time.
            gaps: how often the audio was interrupted because the synthesis was too slow.
            gap_seconds: the total length of these gaps.
        """
        record = self._require_active(goal_id)
        if record.state is State.PREEMPTING:
            return self.stopped(goal_id, now)
        record.rest, record.paused, record.waits, record.stalls_at = rest, True, False, inf
        record.gaps, record.gap_seconds = record.gaps + gaps, record.gap_seconds + gap_seconds
        self.interrupted.append(record)
        interrupter, self._interrupter, self.active = self._interrupter, None, None
        return _set_interrupter(record, interrupter) + self._start_next(now)

    def completed(
        self, goal_id: str, duration: float | None, now: Now, gaps: int = 0, gap_seconds: float = 0
    ) -> list[Effect]:
        """End the active goal as SUCCEEDED, or as ABORTED if its text is incomplete. Return the effects.

        Its audio was played to the end.

        Args:
            goal_id: the id of the goal.
            duration: the length of the audio in seconds, or None if unknown.
            now: the current time.
            gaps: how often the audio was interrupted because the synthesis was too slow.
            gap_seconds: the total length of the interruptions.
        """
        record = self._require_active(goal_id)
        record.duration = duration
        gaps, gap_seconds = record.gaps + gaps, record.gap_seconds + gap_seconds
        if record.broken:
            record.spoken_end = record.begun_end
            return self._end(record, State.ABORTED, Reason.BROKEN_OFF, f"speech failed: {_BROKEN_OFF}", None, now)
        record.spoken_end = record.begun_end = len(record.say.text)
        words = "Talk completed successfully"
        if record.output and record.output.muted:
            words += f", but the output was muted: {record.output.device}"
        if gaps:
            many = f"{gaps} gap{'s' if gaps > 1 else ''} ({gap_seconds:.1f} s in total)"
            words += f", but with {many}: this machine is too slow for the voice"
        # The reason for a stop doesn't apply if the goal was played to the end anyway.
        return self._end(record, State.SUCCEEDED, None, words, None, now)

    def failed(self, goal_id: str, reason: Reason, message: str, duration: float | None, now: Now) -> list[Effect]:
        """End the active goal as ABORTED, or as PREEMPTED if it was being stopped. Return the effects.

        A failure silences a goal that is being stopped. With the reason `not_silent`, the goal is always ABORTED. If
        all of a text was heard before an interruption, the goal succeeds.
        """
        record = self._require_active(goal_id)
        record.duration = duration
        if record.state is State.PREEMPTING and reason is not Reason.NOT_SILENT:
            return self.stopped(goal_id, now)
        if record.broken and reason is Reason.NOTHING_TO_SAY:  # no sentence was complete
            return self.completed(goal_id, duration, now)
        if record.rest and reason is Reason.NOTHING_TO_SAY:  # all of the text was heard before the interruption
            return self.completed(goal_id, record.heard, now)
        return self._end(record, State.ABORTED, reason, f"speech failed: {message}", record.by, now)

    def stopped(self, goal_id: str, now: Now) -> list[Effect]:
        """End the stopped goal as PREEMPTED, or as ABORTED if its text was incomplete. Return the effects.

        The engine has confirmed that the goal is silent.
        """
        return self._end_stopped(self._require_active(goal_id), now)

    def _end_stopped(self, record: Record, now: Now) -> list[Effect]:
        """End a goal that was stopped and is silent. Return the effects."""
        if record.reason in {Reason.BROKEN_OFF, Reason.TEXT_STALLED}:
            stalled = f"no more text arrived for {options.format_number(record.say.stall)} s"
            words = f"speech failed: {stalled if record.reason is Reason.TEXT_STALLED else _BROKEN_OFF}"
            return self._end(record, State.ABORTED, record.reason, words, None, now)
        goal = record.by and record.by.goal
        why = _STOP_CAUSES.get(record.reason or Reason.EXPIRED) or _expiry_message(record)
        why = f"interrupted by goal {goal}" if goal else why
        return self._end(record, State.PREEMPTED, record.reason, f"Talk preempted: {why}", record.by, now)

    def voice_load_ended(self, voice: str, error: str | None, now: Now, *, imported_libraries: bool) -> list[Effect]:
        """Record that a voice was loaded or failed to load. Return the effects.

        The effects start the next goal if it waited for the voice.

        Args:
            voice: the id of the voice.
            error: the human-readable error, or None if the voice was loaded.
            now: the current time.
            imported_libraries: whether the engine process has imported the libraries for neural voices.
        """
        self.voices.has_libraries = self.voices.has_libraries or imported_libraries
        self.voices.load_ended(voice, error, now.monotonic)
        return self._order_voice_drops() + self.tick(now)

    def voices_measured(self, voice: str, total_bytes: int, now: Now) -> list[Effect]:
        """Record how much memory all neural voices use. Return orders to drop or load voices.

        Args:
            voice: the voice that was just loaded or has just spoken, or "" if a voice was dropped.
            total_bytes: the memory of all voices together.
            now: the current time.
        """
        self.voices.measured(voice, total_bytes)
        return self._order_voice_drops() + self._order_next_voice(now)

    def voice_unloaded(self, voice: str, now: Now) -> list[Effect]:
        """Record that the engine dropped a voice on its own. Return the order to load the next voice, if any."""
        self.voices.unloaded(voice, self._needed_voices())
        return self._order_next_voice(now)

    # -- time limits

    def deadline(self) -> float:
        """Return the monotonic time at which to call `tick` next.

        Return inf if there is no time limit.
        """
        pause_end = self.last_pause.ends_at if self.last_pause else inf
        deadlines = (self._active_deadline(), self.pending.next_expiry(), self._next_attempt_time(), pause_end)
        return min(*deadlines, *self._orphans.values())

    def tick(self, now: Now) -> list[Effect]:
        """End goals that are out of time, and start the next goal if possible. Return the effects.

        Speech is resumed if all pauses have ended. Expired goals are recalled. If the active goal was stopped and did
        not become silent in time, it is aborted. The next goal starts if it no longer has to wait for its voice.
        """
        effects = self._resume_if_all_ended(self.last_pause.client, now) if self.last_pause else []
        record = self.active
        if record is not None and now.monotonic >= self._active_deadline():
            if record.stop_requested_at is None:
                stalled = now.monotonic >= record.stalls_at
                effects += self._stop(record, Reason.TEXT_STALLED if stalled else Reason.EXPIRED, None, now)
            else:
                words = (
                    f"speech failed: the goal was stopped, but silence was not confirmed within {CONFIRM_SILENCE_S:g} s"
                )
                effects.append(EngineOrder(record, Order.GIVE_UP))
                effects += self._end(record, State.ABORTED, Reason.NOT_SILENT, words, record.by, now)
        for each in [each for each, ends_at in self._orphans.items() if now.monotonic >= ends_at]:
            effects += self.break_off(each, now)
        effects += self._expire(now) + self._start_next(now) + self._interrupt_active()
        return effects + self._order_next_voice(now)

    # -- selecting and accepting goals

    def _select(self, selection: Cancel, result: Cancellation, waiting_ids: Collection[str | None]) -> list[Record]:
        """Return the unfinished goals to cancel. Add ended goals and unknown ids to `result`."""
        chosen = self.unfinished() if selection.selects_all else []
        for goal_id in dict.fromkeys(selection.ids or ()):
            record = self.find(goal_id)
            if record and record.state.terminal:
                result.ended.append(record)
            elif record:
                chosen.append(record)
            elif goal_id not in waiting_ids:
                result.unknown.append(goal_id)
        if self.active and selection.current:
            chosen.append(self.active)
        chosen += [each for each in self.begun() if each.say.key == selection.key is not None]
        if pending := self.pending.with_key(selection.key):
            chosen.append(pending)
        if selection.before is not None:
            last = self.find(selection.before)
            if last or selection.before in waiting_ids:
                chosen += [each for each in self.unfinished() if last is None or each.number <= last.number]
            else:
                result.unknown.append(selection.before)
        unique = {each.number: each for each in chosen}.values()
        # Cancel the active goal last. Otherwise, another selected goal could start before it is cancelled.
        return sorted(unique, key=lambda each: (each is self.active, each.number))

    def _find_refusal(self, say: Say, server_refusal: Refusal | None, conflicting: Record | None) -> Refusal | None:
        """Return the reason to reject a goal, if there is one. A full queue is not considered.

        Args:
            say: the goal.
            server_refusal: the server's own reason to reject the goal, or None.
            conflicting: an earlier goal with the same id and another text, or None.
        """
        if self.closing:
            return Reason.SHUTDOWN, "the server is stopping"
        if words := options.bad_option(say):
            return Reason.BAD_OPTION, words
        if conflicting is not None:
            return Reason.ID_CONFLICT, f"the id {say.id} was already used for another text"
        limit = self.max_text * options.GROWTH_FACTOR if say.more else self.max_text
        return options.bad_text(say.text, limit) or server_refusal

    def _find_repeat(self, say: Say, record: Record, now: Now) -> Refusal | None:
        """Return a refusal if a goal repeats another too soon. Store the other goal's id in `record.by`."""
        if say.throttle is None:
            return None
        waiting = self.pending.with_content(say.content) if say.key is None else None
        begun = (
            each
            for each in self.begun()
            if (each.say.content == say.content if say.key is None else each.say.key == say.key)
        )
        if spoken := next(begun, None):
            first, words = spoken.id, "is being spoken"
        elif waiting:
            first, words = waiting.id, "is already waiting"
        else:
            last = self._speech_times.last_goal_id(now.monotonic - say.throttle, say.key, say.content)
            if last is None:
                return None
            first, words = last, f"was spoken less than {options.format_number(say.throttle)} s ago"
        record.by = By(goal=first)
        what = f"the same {'sound' if say.is_sound else 'text'}" if say.key is None else "a goal with this key"
        return Reason.THROTTLED, f"{what} {words}"

    def _may_preempt(self, say: Say) -> bool:
        """Return whether a new goal may end other goals.

        The goal's options take precedence over the server's setting.
        """
        preempt = self.settings.preempt and not say.interject if say.preempt is None else say.preempt
        return say.flush or bool(preempt)

    def _find_room(self, say: Say) -> list[tuple[Record, Reason]] | None:
        """Return the goals that a new goal would replace, preempt or displace, or None if there is no room.

        Each comes with the reason for its removal.
        """
        replaced = self.pending.with_key(say.key)
        preempted: list[Record] = []
        if self._may_preempt(say):
            preempted = self.pending.goals_up_to(say.priority, only_preempting=not say.flush)
        recalled = [(replaced, Reason.REPLACED)] if replaced else []
        recalled += [(each, Reason.PREEMPTED) for each in preempted if each is not replaced]
        # The queue never exceeds its limit, so removing one goal is enough.
        if recalled or len(self.pending) < self.max_queue:
            return recalled
        last = self.pending.displaceable_goal()
        # A goal sent with `preempt` may also displace a goal of its own priority.
        limit = say.priority if say.preempt else say.priority - 1
        return [(last, Reason.DISPLACED)] if last and last.say.priority <= limit else None

    def _enqueue(self, record: Record, to_recall: list[tuple[Record, Reason]], now: Now) -> list[Effect]:
        """Add a goal to the queue, recall the given goals, and stop started goals that the new goal preempts.

        Return the effects.
        """
        by = By(goal=record.id)
        effects: list[Effect] = []
        replaced = None
        for each, reason in to_recall:
            same_kind = (each.say.priority, each.say.interject) == (record.say.priority, record.say.interject)
            if reason is Reason.REPLACED and same_kind and not record.preempt:
                replaced = each
            effects += self._recall(each, reason, f"it was {reason} by goal {record.id}", by, now)
        for each in self.begun() if record.preempt else ():
            if each.say.priority <= record.say.priority:
                effects += self._stop(each, Reason.PREEMPTED, by, now)
        self.pending.add(record, replaced)
        return effects

    # -- voices

    def _request_voice(self, voice: str, now: Now) -> None:
        """Plan to load a voice if it is neural and an engine process is running."""
        if self._loads_voices and options.is_neural(model := options.without_speaker(voice)):
            self.voices.request(model, now.monotonic)

    def _needed_voices(self) -> list[str]:
        """Return the neural voices that unfinished goals need, in speaking order.

        If the active goal already has a voice, it needs no other, because the engine keeps that voice until the goal
        ends.
        """
        needing = (each for each in self.unfinished() if each is not self.active or each.voice is None)
        voices = (options.without_speaker(self.wanted_voice(each)) for each in needing)
        return list(filter(options.is_neural, dict.fromkeys(voices)))

    def _order_next_voice(self, now: Now) -> list[Effect]:
        """Mark the next voice as loading. Return a list with the order to load it, if any.

        The first voice is not loaded while a goal is active. Loading it imports libraries, which blocks the engine
        process for a tenth of a second.
        """
        if not (self._loads_voices and self.voices.can_load) or self.closing:
            return []
        if self.active and not self.voices.has_libraries:
            return []
        order = self.voices.load_next(
            self._needed_voices(), options.without_speaker(self.settings.voice), now.monotonic
        )
        return [order] if order else []

    def _order_voice_drops(self) -> list[Effect]:
        """Drop voices if they use too much memory. Return the orders and warnings."""
        needed = self._needed_voices()
        speaking = options.without_speaker(self.active.voice) if self.active else ""
        if options.is_neural(speaking) and not self.voices.is_loaded(speaking):
            return []  # the speaking voice was already dropped, but its memory is only freed at the end of the goal
        return [*self.voices.drop_excess(next(iter(needed), speaking), needed)]

    # -- starting and ending goals

    def _expire(self, now: Now) -> list[Effect]:
        """Recall all pending goals that have expired. Return the effects."""
        effects: list[Effect] = []
        for record in self.pending.expired(now.monotonic):
            effects += self._recall(record, Reason.EXPIRED, _expiry_message(record), None, now)
        return effects

    def _active_deadline(self) -> float:
        """Return the monotonic time of the active goal's next time limit.

        If the goal is being stopped, it must be silent by then. Otherwise, it expires then, but only if the engine was
        lost before anything was heard, because the goal must start again.
        """
        goal = self.active
        if goal is None:
            return inf
        if goal.stop_requested_at is not None:
            return goal.stop_requested_at + CONFIRM_SILENCE_S
        if goal.stalls_at < inf and not self.paused:
            return goal.stalls_at
        return inf if self.has_engine or goal.was_heard else goal.expires_at

    def _next_attempt_time(self) -> float:
        """Return the monotonic time of the next attempt to start a goal."""
        record = None if self.active or self.paused or not self.has_engine else self.next_goal()
        if record is None:
            return inf
        return 0.0 if record.next_since == inf else self._patience_end(record)

    def _patience_end(self, record: Record) -> float:
        """Return the monotonic time until which a goal waits for its voice, or 0 if it doesn't wait."""
        waits = self._loads_voices and not record.say.is_sound
        return self.voices.patience_end(record, self.wanted_voice(record)) if waits else 0.0

    def _find_interjection(self, priority: int) -> Record | None:
        """Return the first interjection of at least this priority that needn't wait for its voice, if any."""
        for each in self.pending.interjections():
            if each.say.priority < priority:
                break
            if self._patience_end(each) < inf:
                return each
        return None

    def _interrupt_active(self) -> list[Effect]:
        """Interrupt the active goal if an interjection is waiting. Return the order for the engine, if any.

        Another interjection is only interrupted by one with a higher priority. A goal that preempts is not interrupted
        by an older interjection, because it goes before that in the queue, too.
        """
        active = self.active
        if active is None or active.state is not State.ACTIVE or self.paused or self._interrupter is not None:
            return []
        if not self._can_interrupt or len(self.interrupted) >= MAX_INTERRUPTED:
            return []
        interjection = self._find_interjection(active.say.priority + active.say.interject)
        if interjection is None or (active.preempt and interjection.number < active.number):
            return []
        self._interrupter = interjection.id
        return [EngineOrder(active, Order.INTERRUPT)]

    def _start_next(self, now: Now) -> list[Effect]:
        """Start the next goal if possible. Return the effects.

        They include the order to speak the goal.
        """
        if not self.has_engine:
            return []
        record, effects = self._activate_next(now)
        return [*effects, EngineOrder(record, Order.START)] if record else effects

    def _activate_next(self, now: Now) -> tuple[Record | None, list[Effect]]:
        """Make the next goal ACTIVE, or continue the last interrupted one, if possible.

        Return this goal, if any, and the effects.

        Return None instead of a goal if no goal can start. The effects don't contain the order to speak the goal.
        """
        if self.active or self.paused:
            return None, []
        effects = self._expire(now)
        record = self.next_goal()
        if record is None:
            return None, effects
        record.next_since = min(record.next_since, now.monotonic)
        if self._patience_end(record) > now.monotonic:
            return None, effects
        self.active, last = record, self.interrupted[-1] if self.interrupted else None
        if record is last:
            self.interrupted.pop()
            record.paused, record.interrupted_by = False, None
            return record, [*effects, StateChange(record, State.ACTIVE)]
        if last:
            effects += _set_interrupter(last, record.id)
        record.change_state(State.ACTIVE)
        self.pending.remove(record)
        record.started_at, record.began_at, record.settings = now.wall, now.monotonic, self.settings
        return record, [*effects, StateChange(record, State.ACTIVE)]

    def _recall(self, record: Record, reason: Reason, details: str, by: By | None, now: Now) -> list[Effect]:
        """Remove a goal from the queue, and end it as RECALLED. Return the effects."""
        self.pending.remove(record)
        return self._end_unqueued(record, reason, details, by, now)

    def _end_unqueued(self, record: Record, reason: Reason, details: str, by: By | None, now: Now) -> list[Effect]:
        """End a pending goal outside the queue as RECALLED. Return the effects."""
        record.change_state(State.RECALLING)
        return self._end(record, State.RECALLED, reason, f"not spoken: {details}", by, now)

    def _stop(self, record: Record, reason: Reason, by: By | None, now: Now) -> list[Effect]:
        """Mark the active goal as being stopped, or end an interrupted goal at once. Return the effects.

        Return no effects if it is already being stopped.
        """
        if record.state is State.PREEMPTING:
            return []  # keep the reason for the first stop
        record.change_state(State.PREEMPTING)
        record.reason, record.by, record.paused = reason, by, False
        effects: list[Effect] = [StateChange(record, State.PREEMPTING)]
        if record is not self.active:
            place = self.interrupted.index(record)
            if place > 0:
                effects += _set_interrupter(self.interrupted[place - 1], record.interrupted_by)
            del self.interrupted[place]
            return effects + self._end_stopped(record, now)
        record.stop_requested_at = now.monotonic
        return [*effects, EngineOrder(record, Order.STOP)]

    def _reset_stall_limit(self, record: Record, now: Now) -> None:
        """Restart the time limit for more text if a goal waits for text. Otherwise, remove the limit."""
        record.stalls_at = now.monotonic + record.say.stall if record.waits and record.more else inf

    def _require_active(self, goal_id: str) -> Record:
        """Return the active goal. Raise IllegalTransition if its id isn't `goal_id`."""
        if self.active is None or self.active.id != goal_id:
            raise IllegalTransition(f"goal {goal_id} is not being spoken")
        return self.active

    def _end(
        self, record: Record, state: State, reason: Reason | None, message: str, by: By | None, now: Now
    ) -> list[Effect]:
        """End a goal, and store it as recent. If it was active, start the next goal. Return the effects."""
        record.change_state(state)
        record.reason, record.message, record.by = reason, message, by
        record.ended_at, record.paused, record.more, record.waits = now.wall, False, False, False
        record.interrupted_by = None
        self._orphans.pop(record, None)
        if record.was_heard and state is not State.ABORTED:
            self._speech_times.add(record)
        self._by_id.pop(record.id)
        self.recent.add(record)
        if record is not self.active:
            return [StateChange(record, state)]
        self.active = self._interrupter = None
        return [StateChange(record, state), *self._start_next(now), *self._order_next_voice(now)]


def _expiry_message(record: Record) -> str:
    """Return the message for a goal whose time to live is over."""
    return f"its ttl of {options.format_number(record.say.ttl)} s was over"


def _set_interrupter(record: Record, goal_id: str | None) -> list[Effect]:
    """Store which goal interrupts another one. Return the effects."""
    if goal_id is None or record.interrupted_by == goal_id:
        return []
    record.interrupted_by = goal_id
    return [Interruption(record, goal_id)]
