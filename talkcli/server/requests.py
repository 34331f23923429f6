"""The handler of clients' requests, which has one coroutine for each kind of request.

A coroutine may wait for the list of voices, for room in the queue, or for silence. Meanwhile, the client's connection
stays open. If the client disconnects, its requests are dropped.
"""

from __future__ import annotations

import asyncio
import sys
import time
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING

from talkcli.daemon import log
from talkcli.errors import Busy, RequestRefused, UnknownGoal
from talkcli.frozen import fields, replace
from talkcli.goals import options
from talkcli.goals.goal import By, JsonObject
from talkcli.goals.options import MAX_LOG_GOALS, Append, Cancel, Log, Pause, Say, Set
from talkcli.goals.reasons import Reason, Refusal
from talkcli.goals.states import State
from talkcli.history.rows import given_filters, matches, row_chars, row_to_json
from talkcli.protocol.events import Result
from talkcli.protocol.lines import encode
from talkcli.protocol.requests import Request, Resume, Sounds, Status, Voices, Wait, Watch
from talkcli.server.connection import PendingRequest, resume_all
from talkcli.server.speech import MAX_UNHEARD_CHARS, describe_sender, unheard_chars

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from typing import Any

    from talkcli.goals.record import Record
    from talkcli.history.rows import Row
    from talkcli.server.connection import ClientConnection, Steps
    from talkcli.server.speech import Speech

#: Number of ended goals in a reply to `status`.
RECENT_GOALS = 10
#: How long a request waits for the list of voices. Clients give up after five seconds.
VOICES_LIMIT_S = 4.0
#: How long a `pause` request waits for silence before it fails.
PAUSE_ANSWER_S = 2.0
#: Maximum number of waiting requests per client, as promised in the protocol's document. At the limit, the server still
#: reads from the client, because a cancel may follow.
MAX_CLIENT_REQUESTS = 1_000
#: Maximum memory for all waiting requests, equal to the limit for unread output.
MAX_KEPT_REQUEST_BYTES = 64 * 1024 * 1024
#: Memory counted for each waiting request in addition to its values. This is ten times the actual size, so that no more
#: than 8,000 requests wait and all of them can be cancelled within 2 s.
REQUEST_BYTES = 8 * 1024


class Requests:
    """Carries out the requests of all clients, and replies to them."""

    def __init__(self, speech: Speech, describe: Callable[[], JsonObject]) -> None:
        """Create the handler.

        Args:
            speech: the goals and the engine.
            describe: function that returns the description of the server for `status`.
        """
        self._speech = speech
        self._scheduler = speech.scheduler
        self._describe = describe
        #: memory counted for all waiting requests
        self._waiting_bytes = 0
        self._room_check: asyncio.Handle | None = None
        #: the connections that may add text to goals
        self._producers: dict[Record, ClientConnection] = {}
        speech.on_queue_change = self._schedule_room_check

    def handle(self, connection: ClientConnection, seq: int | None, request: Request) -> None:
        """Start to carry out a client's request, which may be answered later."""
        pending = PendingRequest(connection, seq, request)
        connection.unanswered[pending] = None
        pending.start(self._carry_out(pending))

    def is_waiting(self, connection: ClientConnection) -> bool:
        """Return whether a client is still waiting for a reply or an event."""
        return bool(connection.unanswered) or self._speech.subscribers.is_subscribed(connection)

    def left(self, connection: ClientConnection) -> None:
        """Drop a disconnected client's requests and subscriptions, and treat its input as ended."""
        for each in list(connection.unanswered):
            each.drop()
        self._speech.subscribers.left(connection)
        self.input_ended(connection)

    def input_ended(self, connection: ClientConnection) -> None:
        """End a client's pause, and all its incomplete texts that no other connection may continue.

        This method is called at the end of the client's input.
        """
        for record in [record for record, producer in self._producers.items() if producer is connection]:
            del self._producers[record]
            self._speech.apply(self._scheduler.producer_left(record, self._speech.advance_time()))
        if effects := self._scheduler.end_pause(connection, self._speech.advance_time()):
            self._speech.apply(effects)

    def shut_down(self) -> None:
        """End all goals, including those that are not in the queue yet, and reject new ones."""
        notifications = self._mark_canceled(self._select_waiting(Cancel()), None)
        self._speech.shut_down()
        resume_all(self._speech.waiting_for_voices)
        self._speech.notifications.add(notifications)

    async def _carry_out(self, pending: PendingRequest) -> None:
        """Carry out a request. If necessary, wait for the list of voices first. Reply with any error."""
        request = pending.request
        try:
            if isinstance(request, Cancel | Pause):
                self._stop_awaiting_voices(pending.connection)  # carry out earlier requests first, without a delay
            elif self._must_await_voices(pending):
                if self._reserve_memory(pending):
                    await pending.wait(self._speech.waiting_for_voices, VOICES_LIMIT_S)
                elif not isinstance(request, Say):
                    self._stop_awaiting_voices(pending.connection)
            steps: Callable[[PendingRequest, Any], Steps] = getattr(self, f"_{request.kind}")
            await steps(pending, request)
        except RequestRefused as error:
            pending.refuse(error.code, str(error))
        except Exception as error:  # noqa: BLE001 - other clients must not be affected
            log.write_bug(request.kind, error)
            pending.refuse("internal_error", f"{request.kind} failed because of a bug in talk; see the server's log")
        finally:
            self._waiting_bytes -= pending.kept_bytes
            del pending.connection.unanswered[pending]

    # -- requests that wait

    def _awaiting_voices(self, connection: ClientConnection) -> list[PendingRequest]:
        """Return a connection's requests that are waiting for the list of voices."""
        return [each for each in connection.unanswered if each.waiting_list is self._speech.waiting_for_voices]

    def _must_await_voices(self, pending: PendingRequest) -> bool:
        """Return whether a request must wait for the list of voices."""
        request = pending.request
        if self._speech.waiting_for_voices and (isinstance(request, Say) or self._awaiting_voices(pending.connection)):
            return True
        names_voice = isinstance(request, Say | Set) and request.voice is not None
        return self._speech.awaits_voices and (names_voice or isinstance(request, Voices))

    def _stop_awaiting_voices(self, connection: ClientConnection) -> None:
        """Continue a connection's requests that wait for the list of voices, without waiting any longer."""
        for each in self._awaiting_voices(connection):
            each.resume()

    def _reserve_memory(self, pending: PendingRequest) -> bool:
        """Reserve memory for a waiting request. If too many wait, store a refusal and return False.

        In this case, the request is carried out without waiting, and the refusal rejects its goal.
        """
        if pending.kept_bytes:
            return True  # the request has waited before
        size = REQUEST_BYTES + sum(map(_memory_of, fields(pending.request).values()))
        if len(pending.connection.unanswered) > MAX_CLIENT_REQUESTS:  # the count includes this request
            words = f"too many requests are waiting ({MAX_CLIENT_REQUESTS:,} of this connection)"
        elif self._waiting_bytes + size > MAX_KEPT_REQUEST_BYTES:
            words = f"too many requests are waiting ({MAX_KEPT_REQUEST_BYTES >> 20} MiB)"
        else:
            pending.kept_bytes = size
            self._waiting_bytes += size
            return True
        pending.refusal = Reason.QUEUE_FULL, words
        return False

    def _schedule_room_check(self) -> None:
        """If goals wait for room in the queue, schedule a call that submits the goals that fit."""
        if self._speech.waiting_for_room and self._room_check is None:
            # Check in the next iteration of the event loop, because the caller may not have finished its changes.
            self._room_check = asyncio.get_running_loop().call_soon(self._submit_waiting_goals)

    def _submit_waiting_goals(self) -> None:
        """Resume the waiting `say` requests whose goals now fit into the queue."""
        self._room_check = None
        without_room: set[object] = set()
        for each in list(self._speech.waiting_for_room):
            say = each.request
            assert isinstance(say, Say)
            # If there is no room for a goal without an id, there is also none for other goals with the same values.
            kind = (say.priority, say.key, say.flush, say.preempt) if say.id is None else None
            if kind in without_room:
                continue
            if not self._scheduler.has_room(say):
                if kind:
                    without_room.add(kind)
            elif not each.connection.detect_hang_up():
                # If the goal enters the queue, another check follows, because it may make room for an earlier goal.
                each.resume()

    def _select_waiting(self, selection: Cancel) -> list[PendingRequest]:
        """Return the waiting `say` requests that a `cancel` selects."""
        waiting = (*self._speech.canceled_goals, *self._speech.waiting_for_room, *self._speech.waiting_for_voices)
        goals = [(each, each.request) for each in waiting if isinstance(each.request, Say)]
        selected = (goals[index][0] for index in selection.select_waiting([say for _, say in goals]))
        # Waiting goals of a disconnected client are dropped instead of cancelled.
        return [each for each in selected if not each.connection.detect_hang_up()]

    def _mark_canceled(self, requests: list[PendingRequest], by: By | None) -> list[Callable[[], None]]:
        """Mark waiting `say` requests as cancelled. Return the functions that end their goals.

        The functions submit the goals to the scheduler, which recalls them.
        """
        new = [each for each in requests if each.waiting_list is not self._speech.canceled_goals]
        for each in new:
            each.canceled_by = by
            each.move_to(self._speech.canceled_goals)
        return [each.resume for each in new]

    async def _await_room(self, pending: PendingRequest, say: Say) -> float:
        """Wait until the queue has room, or the goal expires or is cancelled. Return the seconds waited."""
        ttl = (self._scheduler.settings.ttl if say.ttl is None else say.ttl) or None
        began = self._speech.advance_time().monotonic
        self._speech.subscribers.schedule_keep_alive()
        in_time = await pending.wait(self._speech.waiting_for_room, ttl)
        waited = self._speech.advance_time().monotonic - began
        return waited if in_time or ttl is None else max(waited, ttl)

    # -- coroutines, named after the requests that they handle

    async def _say(self, pending: PendingRequest, say: Say) -> None:
        """Submit a goal, and reply. A `patient` goal first waits for room in the queue.

        The reply shows the goal as it was accepted.
        """
        speech, scheduler, connection = self._speech, self._scheduler, pending.connection
        if say.dry_run:
            say, refusal = self._check_goal(pending, say)
            record = scheduler.try_out(say, connection.client, speech.advance_time(), refusal)
            pending.answer(goal=speech.describe_goal(record).to_json())
            return
        waited = 0.0
        if pending.canceled_by is None:
            now = speech.advance_time()
            if self._room_check:  # goals that are already waiting come first
                self._room_check.cancel()
                self._submit_waiting_goals()
            _, refusal = self._check_goal(pending, say)
            if say.patient and scheduler.only_lacks_room(say, now, refusal) and self._reserve_memory(pending):
                waited = await self._await_room(pending, say)
        now = speech.advance_time()
        say, refusal = self._check_goal(pending, say)
        record, effects = scheduler.submit(say, connection.client, now, refusal, pending.canceled_by, waited)
        extra = speech.describe_pause() if scheduler.paused else {}
        attached = not effects  # the goal was sent before
        if attached:
            state = record.state
            extra["attached"] = True
        else:
            # The reply shows the goal as it was accepted. If the goal has already started, an event reports it.
            state = record.state if record.state is State.REJECTED else State.PENDING
            if pending.canceled_by and record.by is pending.canceled_by:
                pending.canceled_goal = record
        goal = record.snapshot(state).to_json()
        ended = attached and state.terminal
        if say.more and record.more and (effects or self._lacks_producer(record)):
            self._producers = {each: producer for each, producer in self._producers.items() if each.more}
            self._producers[record] = connection
        if (say.wait or say.feedback) and not ended:
            speech.subscribers.subscribe_to_goal(record.id, connection, feedback=say.feedback)
        pending.answer(goal=goal, **extra)
        if ended and (say.wait or say.feedback):
            connection.publish(encode({"event": "result", "goal": goal}))
        speech.apply(effects)

    async def _append(self, pending: PendingRequest, request: Append) -> None:
        """Add text to a goal. Delay the reply while too much of the text has not been heard."""
        speech, now = self._speech, self._speech.advance_time()
        record = self._require_goal(request.id)
        length = len(record.say.text)
        try:
            self._require_producer(record, pending.connection)
            effects = self._scheduler.append(record, request, now)
        except RequestRefused as error:
            pending.refuse(error.code, str(error), state=record.state.name)
            return
        if added := record.say.text[length:]:
            speech.notifications.add([partial(speech.subscribers.text_added, record.id, length, added, time.time())])
        speech.apply(effects)
        while unheard_chars(record) > MAX_UNHEARD_CHARS and not record.state.terminal:
            if not self._reserve_memory(pending):
                break  # too many requests are waiting
            speech.subscribers.schedule_keep_alive()
            await pending.wait(speech.waiting_for_hearing[record])
        pending.answer(length=len(record.say.text), state=record.state.name)

    def _require_producer(self, record: Record, connection: ClientConnection) -> None:
        """Let only this connection add text to a goal. Raise RequestRefused if another one already does.

        A new connection may continue a text if the old one is gone and the sender chose the goal's id.
        """
        if not record.more or self._producers.get(record) is connection:
            return
        if record.say.id is None or not self._lacks_producer(record):
            raise RequestRefused(f"another connection is already sending the text of goal {record.id}", "not_sender")
        self._producers[record] = connection

    def _lacks_producer(self, record: Record) -> bool:
        """Return whether the connection that added text to a goal is gone."""
        producer = self._producers.get(record)
        return producer is None or producer.detect_hang_up()

    def _check_goal(self, pending: PendingRequest, say: Say) -> tuple[Say, Refusal | None]:
        """Look up a goal's voice. Return the goal with the voice's id, and any reason to reject the goal.

        Refusals that need a clock, files or other I/O belong here. The scheduler decides about all others.
        """
        voice, refusal = self._speech.voices.look_up(say.voice, self._scheduler.settings.voice)
        say = replace(say, voice=voice)
        if say.pitch not in {None, options.DEFAULTS.pitch} and options.is_neural(voice or ""):
            words = f"the voice {voice} has a fixed pitch; leave out the pitch, or use an espeak voice"
            refusal = refusal or (Reason.BAD_OPTION, words)
        if say.is_sound:
            refusal = self._speech.sounds.refusal(say.text)
        return say, pending.refusal or refusal

    async def _wait(self, pending: PendingRequest, request: Wait) -> None:
        """Reply with the goals, and send the result of each goal once it has ended."""
        await self._speech.notifications.wait_done(pending)  # send earlier events of a goal before its result
        if request.ids is None:
            records = self._scheduler.unfinished()
        else:
            records = [self._require_goal(each) for each in dict.fromkeys(request.ids)]
        for record in records:
            if not record.state.terminal:
                self._speech.subscribers.subscribe_to_goal(record.id, pending.connection, feedback=request.feedback)
        # The list shows the goals as they are now, and events report later changes. Only goals that have begun may look
        # different later, so snapshots of these goals are made now. The other snapshots are made when they are sent.
        begun = {each: each.snapshot() for each in self._scheduler.begun()}
        states = [(record, record.state) for record in records]
        goals = (begun.get(record) or record.snapshot(state) for record, state in states)
        results = (Result(record.snapshot()).to_json() for record, state in states if state.terminal)
        pending.answer(({"goal": each.to_json()} for each in goals), results, count=len(records))

    async def _cancel(self, pending: PendingRequest, selection: Cancel) -> None:
        """Cancel goals, and reply when all of them have ended."""
        speech, client = self._speech, pending.connection.client
        now = speech.advance_time()
        waiting = self._select_waiting(selection)
        notifications = self._mark_canceled(waiting, By(client=client))
        ids = {each.request.id for each in waiting if isinstance(each.request, Say)}
        result = self._scheduler.cancel(selection, client, now, ids)
        speech.apply(result.effects)  # carry out the effects first, because thousands of notifications may follow
        speech.notifications.add(notifications)
        if result.stopping:
            while not result.stopping.state.terminal:
                await pending.wait(speech.waiting_for_silence[result.stopping])
        else:
            await speech.notifications.wait_done(pending)
        ended = result.ended_at_once + [each.canceled_goal for each in waiting if each.canceled_goal]
        if result.stopping and result.stopping.state is not State.SUCCEEDED:
            ended.append(result.stopping)
        goals = chain(_goal_items("canceled", ended), _goal_items("ended", result.ended))
        if result.unknown:
            pending.refuse(UnknownGoal.code, _unknown_message(*result.unknown), goals)
        else:
            pending.answer(goals, count=len(ended))

    async def _pause(self, pending: PendingRequest, request: Pause) -> None:
        """Pause speech, and reply when the active goal is silent.

        Raises RequestRefused if that takes too long, or if a field has an invalid value.
        """
        speech, scheduler, connection = self._speech, self._scheduler, pending.connection
        if words := options.bad_option(request):
            raise RequestRefused(words, Reason.BAD_OPTION)
        seconds = request.seconds or (options.PAUSE_S if request.while_connected else None)
        owner = connection if request.while_connected else None
        speech.apply(scheduler.pause(connection.client, speech.advance_time(), seconds, owner))
        active = scheduler.active
        if active and active is not speech.silent_goal:
            in_time = await pending.wait(speech.waiting_for_silence[active], PAUSE_ANSWER_S)
            if not in_time:
                words = f"speech is paused, but {active.id} was not confirmed to be silent within {PAUSE_ANSWER_S:g} s"
                raise RequestRefused(words, Reason.NOT_SILENT)
        self._answer_pause(pending, active)

    async def _resume(self, pending: PendingRequest, _: Resume) -> None:
        """Resume speech, and reply with the resumed goal, if any."""
        now, active = self._speech.advance_time(), self._scheduler.active
        if active and active.state is not State.ACTIVE:
            active = None  # a goal that is being stopped can't be resumed
        self._speech.apply(self._scheduler.resume(pending.connection.client, now))
        self._answer_pause(pending, active)

    def _answer_pause(self, pending: PendingRequest, goal: Record | None) -> None:
        """Reply to a `pause` or `resume` request.

        The reply contains the goal unless it has ended.
        """
        shown = None if goal is None or goal.state.terminal else goal.snapshot().to_json()
        pending.answer(goal=shown, **self._speech.describe_pause())

    async def _status(self, pending: PendingRequest, request: Status) -> None:
        """Reply with one goal, or with the state of the server and its goals."""
        if request.id is None:
            self._answer_overview(pending)
        else:
            history, known = self._speech.history, self._scheduler.find(request.id)
            rows = await history.search(pending, {"id": request.id}, 1) if history and not known else []
            record = None if rows else self._require_goal(request.id)
            pending.answer(goal=self._speech.describe_goal(record).to_json() if record else row_to_json(rows[0]))

    async def _watch(self, pending: PendingRequest, _: Watch) -> None:
        """Reply with the state of the server, and subscribe the client to all events."""
        await self._speech.notifications.wait_done(pending)  # send earlier events before the overview
        self._answer_overview(pending)
        self._speech.subscribers.watch(pending.connection)

    def _answer_overview(self, pending: PendingRequest) -> None:
        """Reply with the state of the server, and its active, pending and recent goals."""
        recent = self._scheduler.recent.latest(RECENT_GOALS, include_rejected=False)
        active = self._scheduler.active
        now = active.snapshot().to_json() if active else None
        goals = chain(
            _goal_items("interrupted", self._scheduler.interrupted[::-1]),
            _goal_items("pending", list(self._scheduler.pending)),
            _goal_items("recent", recent),
        )
        pending.answer(goals, server=self._describe(), active=now)

    async def _voices(self, pending: PendingRequest, _: Voices) -> None:
        """Reply with the engine's voices, including new files of neural voices."""
        self._speech.voices.find_new_files()
        voices = self._speech.voices.listed
        if voices is None:
            words = f"the engine hasn't listed its voices yet ({self._speech.engine_status})"
            if self._scheduler.active:
                words += "; try again after the first sentence"
            raise RequestRefused(words, Reason.ENGINE_FAILED)
        pending.answer(({"voice": fields(each)} for each in voices), count=len(voices))

    async def _sounds(self, pending: PendingRequest, _: Sounds) -> None:
        """Reply with the names of all sounds."""
        names = self._speech.sounds.names()
        pending.answer(({"sound": {"name": each}} for each in names), count=len(names))

    async def _log(self, pending: PendingRequest, request: Log) -> None:
        """Reply with the most recently ended goals that pass the filters."""
        history, filters = self._speech.history, given_filters(request)
        if request.history and history and (history.with_text or request.grep is None):
            if not self._reserve_memory(pending):
                raise RequestRefused("too many requests are waiting", Busy.code)
            rows = await history.search(pending, filters, request.count)
            size = sum(map(row_chars, rows))
            pending.connection.stream.adjust_held_bytes(size)
            pending.answer(self._history_items(pending, rows, size), count=len(rows))
            return
        # Only the goals in memory have texts that the history doesn't store.
        records = self._scheduler.recent.latest(MAX_LOG_GOALS if filters else request.count, include_rejected=True)
        records = [each for each in records if matches(filters, _filter_values(each))][-request.count :]
        pending.answer(_goal_items("goal", records), count=len(records))

    def _history_items(self, pending: PendingRequest, rows: list[Row], held_bytes: int) -> Iterator[JsonObject]:
        """Yield an object for each row of the history. Then stop counting `held_bytes` as held output.

        Goals that are still in memory have their texts.
        """
        for row in rows:
            goal = row_to_json(row)
            record = self._scheduler.find(str(goal["id"]))
            is_same = record is not None and record.ended_at == goal["ended_at"]
            yield {"goal": record.snapshot().to_json() if record and is_same else goal}
        pending.connection.stream.adjust_held_bytes(-held_bytes)

    async def _set(self, pending: PendingRequest, request: Set) -> None:
        """Check and change the server's settings, and reply with all settings."""
        speech, scheduler = self._speech, self._scheduler
        if words := options.bad_option(request):
            raise RequestRefused(words, Reason.BAD_OPTION)
        voice, refusal = speech.voices.look_up(request.voice)
        if refusal:
            raise RequestRefused(refusal[1], refusal[0])
        given = fields(replace(request, voice=voice))
        changes = {name: value for name, value in given.items() if value is not None}
        effects = scheduler.change_settings(changes, speech.advance_time())
        self._schedule_room_check()  # a waiting goal may now be able to preempt others
        speech.apply(effects)
        if changes:
            values = ", ".join(f"{name} {options.format_number(value)}" for name, value in changes.items())
            log.write(f"settings changed to {log.sanitize(values)} by {describe_sender(pending.connection.client)}")
        pending.answer(settings=options.shown_settings(scheduler.settings))

    def _require_goal(self, goal_id: str) -> Record:
        """Return the goal with this id, or raise UnknownGoal."""
        record = self._scheduler.find(goal_id)
        if record is None:
            raise UnknownGoal(_unknown_message(goal_id))
        return record


def _unknown_message(*ids: str) -> str:
    """Return the error message for goal ids that the server doesn't know."""
    return f"unknown goal{'s' * (len(ids) > 1)} {', '.join(map(repr, ids))}; list the goals with: talk status"


def _goal_items(name: str, records: Iterable[Record]) -> Iterator[JsonObject]:
    """Yield an object for each goal, with the goal in the field `name`.

    The goal is copied when the object is sent.
    """
    return ({name: each.snapshot().to_json()} for each in records)


def _filter_values(record: Record) -> JsonObject:
    """Return the values of a goal in memory that `log` can filter by."""
    say, state = record.say, record.state.name
    values: JsonObject = {"state": state, "name": record.sender.name, "key": say.key, "text": say.text}
    return {**values, "ended_at": record.ended_at or 0.0}


def _memory_of(value: object) -> int:
    """Estimate how many bytes of memory a value uses."""
    inside = value.values() if isinstance(value, dict) else value if isinstance(value, (list, tuple)) else ()
    return sys.getsizeof(value) + sum(map(_memory_of, inside))
