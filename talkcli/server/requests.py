"""The answer to each request, now or as soon as what it asks for is so."""

from __future__ import annotations

import os
import time
from itertools import chain
from typing import TYPE_CHECKING

from talkcli import __version__
from talkcli.errors import UnknownGoal
from talkcli.frozen import replace
from talkcli.goals.goal import By
from talkcli.goals.options import Cancel, Say, Set, as_shown, bad_option, given
from talkcli.goals.states import State
from talkcli.protocol import replies
from talkcli.protocol.lines import encode
from talkcli.protocol.requests import Log, Pause, Request, Resume, Status, Voices, Wait, Watch
from talkcli.server import log
from talkcli.server.pauses import Pauses

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from talkcli.goals.effects import Cancelled, Submitted
    from talkcli.goals.goal import JsonObject, Sender
    from talkcli.goals.record import Record
    from talkcli.server.connection import Connection
    from talkcli.server.service import Service

#: Ended goals that `status` lists.
RECENT = 10


class Answers:
    """Answers the requests of a service's clients."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._scheduler = service.scheduler
        #: cancels that are answered when the goal they stopped is silent
        self._cancels: list[tuple[Connection, int | None, Cancelled]] = []
        self._pauses = Pauses(service)
        self._by_kind: dict[type[Request], Callable[..., None]] = {
            Say: self._say,
            Wait: self._wait,
            Cancel: self._cancel,
            Status: self._status,
            Voices: self._voices,
            Watch: self._watch,
            Log: self._log,
            Set: self._set,
            Pause: self._pauses.pause,
            Resume: self._pauses.resume,
        }

    def handle(self, connection: Connection, seq: int | None, request: Request) -> None:
        """Carry out a request, and answer it now or later."""
        later = self._service.later
        if isinstance(request, Cancel | Pause):
            later.hurry(connection)  # silence waits for nothing; what was asked for before it comes before it
        elif later.holds(connection) or self._awaits_voices(request):
            fault = later.too_many(connection, request)
            if fault is None:
                later.until_voices(connection, request, lambda by: self._go(connection, seq, request, by))
                return
            if isinstance(request, Say):
                self._submit(connection, seq, request, connection.sender, fault)
                return
            later.hurry(connection)
        self._carry_out(connection, seq, request)

    def silent(self, goal_id: str, pause: int) -> None:
        """Answer those who wait for the active goal to be silent in this pause of it."""
        self._pauses.silent(goal_id, pause)

    def left(self, connection: Connection) -> None:
        """Owe a connection that is gone nothing more."""
        self._cancels = [each for each in self._cancels if each[0] is not connection]
        self._pauses.left(connection)

    def ended(self, record: Record) -> None:
        """Answer those who wait for this goal to be silent."""
        due = [each for each in self._cancels if each[2].stopping is record]
        if due:
            self._cancels = [each for each in self._cancels if each[2].stopping is not record]
        for connection, seq, done in due:
            self._report_cancel(connection, seq, done)
            connection.settle()
        self._pauses.ended(record)

    # -- one method a request

    def _go(self, connection: Connection, seq: int | None, request: Request, by: By | None) -> Submitted | None:
        """Carry out a request that has waited for the voices; with `by`, it is a goal that was cancelled meanwhile."""
        if by and isinstance(request, Say):
            return self._submit(connection, seq, request, connection.sender, canceled=by)
        self._carry_out(connection, seq, request)
        return None

    def _carry_out(self, connection: Connection, seq: int | None, request: Request) -> None:
        try:
            self._by_kind[type(request)](connection, seq, request)
        except UnknownGoal as error:
            connection.reply(replies.failure(seq, error.code, str(error)))

    def _awaits_voices(self, request: Request) -> bool:
        """Whether it can't be carried out yet: the voices are needed, or a goal that came before it needs them."""
        if isinstance(request, Voices):
            return self._voices_awaited()
        if isinstance(request, Set):
            return request.voice is not None and self._voices_awaited() and not bad_option(request)
        if isinstance(request, Say):
            return self._service.later.awaits_voices or (request.voice is not None and self._voices_awaited())
        return False

    def _say(self, connection: Connection, seq: int | None, request: Say) -> None:
        later, sender = self._service.later, connection.sender
        now = self._service.now()
        later.look_now()
        fault = self._service.voice_fault(request.voice)
        if request.patient and self._scheduler.lacks_room(request, now, fault):
            fault = later.too_many(connection, request)
            if fault is None:
                later.until_room(
                    connection, request, lambda by: self._submit(connection, seq, request, sender, canceled=by)
                )
                return
        self._submit(connection, seq, request, sender, fault)

    def _submit(
        self,
        connection: Connection,
        seq: int | None,
        request: Say,
        sender: Sender,
        fault: tuple[str, str] | None = None,
        canceled: By | None = None,
    ) -> Submitted:
        now = self._service.now()
        fault = fault or self._service.voice_fault(request.voice)
        submitted = self._scheduler.submit(request, sender, now, fault, canceled)
        record = submitted.record
        extra: JsonObject = {"paused": True} if self._scheduler.paused else {}
        if submitted.attached:
            state = record.state
            extra["attached"] = True
        else:
            # As it was accepted: it may have started in the same step, but that is told by its events.
            state = record.state if record.state is State.REJECTED else State.PENDING
        goal = record.snapshot(state).to_json()
        ended = submitted.attached and state.terminal
        if (request.wait or request.feedback) and not ended:
            self._service.subscribers.await_result(record.id, connection, feedback=request.feedback)
        connection.reply(replies.ok(seq, goal=goal, **extra))
        if ended and (request.wait or request.feedback):
            connection.publish(encode({"event": "result", "goal": goal}))
        self._service.apply(submitted.effects)
        return submitted

    def _wait(self, connection: Connection, seq: int | None, request: Wait) -> None:
        if request.ids is None:
            records = self._scheduler.unfinished()
        else:
            records = [self._find(each) for each in dict.fromkeys(request.ids)]
        for record in records:
            if not record.state.terminal:
                self._service.subscribers.await_result(record.id, connection, feedback=request.feedback)
        # As they are now: what becomes of them meanwhile is told by the events that come after the list. Of a thousand
        # that have ended, each is looked at when its turn comes to be sent.
        active = self._scheduler.active
        spoken = active.snapshot() if active else None
        states = [record.state for record in records]

        def goals() -> Iterator[JsonObject]:
            for record, state in zip(records, states, strict=True):
                goal = spoken if spoken and record is active else record.snapshot(state)
                yield replies.item(seq, goal=goal.to_json())

        def results() -> Iterator[JsonObject]:
            for record, state in zip(records, states, strict=True):
                if state.terminal:  # the subscribers are told of the others
                    yield {"event": "result", "goal": record.snapshot().to_json()}

        connection.stream(goals(), replies.ok(seq, count=len(records)), results())

    def _cancel(self, connection: Connection, seq: int | None, request: Cancel) -> None:
        later, now = self._service.later, self._service.now()
        waiting = later.choose(request, By(client=connection.sender))
        ids = {each.request.id for each in waiting if isinstance(each.request, Say)}
        # The engine is told before thousands of clients may be.
        done = self._scheduler.cancel(request, connection.sender, now, ids)
        self._service.apply(done.effects)
        connection.owed += 1

        def answer() -> None:
            done.recalled += [each.ended for each in waiting if each.ended]
            if done.stopping is None or done.stopping.state.terminal:
                self._report_cancel(connection, seq, done)
                connection.settle()
            else:
                self._cancels.append((connection, seq, done))

        later.end(answer)

    def _status(self, connection: Connection, seq: int | None, request: Status) -> None:
        if request.id is None:
            self._send_overview(connection, seq)
        else:
            connection.reply(replies.ok(seq, goal=self._find(request.id).snapshot().to_json()))

    def _watch(self, connection: Connection, seq: int | None, _: Watch) -> None:
        self._send_overview(connection, seq)
        self._service.subscribers.watch(connection)

    def _voices(self, connection: Connection, seq: int | None, _: Voices) -> None:
        self._send_voices(connection, seq)

    def _voices_awaited(self) -> bool:
        return self._service.voices is None and self._service.engine_words in {"starting", "ready"}

    def _log(self, connection: Connection, seq: int | None, request: Log) -> None:
        records = list(self._scheduler.history.log(request.count))
        items = (replies.item(seq, goal=each.snapshot().to_json()) for each in reversed(records))
        connection.stream(items, replies.ok(seq, count=len(records)))

    def _set(self, connection: Connection, seq: int | None, request: Set) -> None:
        words = bad_option(request)
        if words:
            connection.reply(replies.failure(seq, "bad_option", words))
        else:
            self._change_settings(connection, seq, request)

    def _change_settings(self, connection: Connection, seq: int | None, request: Set) -> None:
        service, scheduler = self._service, self._scheduler
        fault = service.voice_fault(request.voice)
        if fault:
            connection.reply(replies.failure(seq, *fault))
            return
        changed = given(request)
        scheduler.settings = replace(scheduler.settings, **changed)
        service.later.look()  # what preempts may have room
        if changed:
            values = ", ".join(f"{name} {value}" for name, value in changed.items())
            log.line(f"set to {log.shown(values)} by {log.who(connection.sender)}")
        connection.reply(replies.ok(seq, settings=as_shown(scheduler.settings)))

    def _find(self, goal_id: str) -> Record:
        record = self._scheduler.find(goal_id)
        if record is None:
            raise UnknownGoal(f"no goal {goal_id!r} is known: see `talk status`")
        return record

    # -- what is sent

    def _send_overview(self, connection: Connection, seq: int | None) -> None:
        pending = list(self._scheduler.pending())
        recent = list(self._scheduler.history.latest(RECENT))

        def items() -> Iterator[JsonObject]:
            for record in pending:
                yield replies.item(seq, pending=record.snapshot().to_json())
            for record in reversed(recent):
                yield replies.item(seq, recent=record.snapshot().to_json())

        active = self._scheduler.active
        now = active.snapshot().to_json() if active else None
        connection.stream(items(), replies.ok(seq, server=self._describe(), active=now))

    def _describe(self) -> JsonObject:
        service, settings = self._service, self._service.settings
        ready = service.ready
        return {
            "pid": os.getpid(),
            "version": __version__,
            "boot": service.boot,
            "socket": service.path,
            "started_at": service.began.wall,
            "uptime": time.monotonic() - service.began.monotonic,
            "engine": service.engine_words,
            "driver": ready.driver if ready else settings.driver,
            "synthesizer": ready.version if ready else None,
            "player": ready.player if ready else settings.player,
            "device": settings.device,
            "lead_in": settings.lead_in,
            **as_shown(self._scheduler.settings),
            "paused": self._scheduler.paused,
            "pending": self._scheduler.pending_count,
            "max_queue": settings.max_queue,
            "clients": len(service.connections),
            "max_clients": settings.max_clients,
        }

    def _send_voices(self, connection: Connection, seq: int | None) -> None:
        voices = self._service.voices
        if voices is None:
            words = f"the engine can't list its voices now: it is {self._service.engine_words}"
            if self._scheduler.active:
                words += ", and busy with its first sentence: ask again after that"
            connection.reply(replies.failure(seq, "engine_failed", words))
            return
        items = (
            replies.item(seq, voice={"id": each.id, "language": each.language, "name": each.name}) for each in voices
        )
        connection.stream(items, replies.ok(seq, count=len(voices)))

    def _report_cancel(self, connection: Connection, seq: int | None, done: Cancelled) -> None:
        ended = list(done.recalled)
        if done.stopping and done.stopping.state is not State.SUCCEEDED:
            ended.append(done.stopping)
        canceled = (replies.item(seq, canceled=each.snapshot().to_json()) for each in ended)
        before = (replies.item(seq, ended=each.snapshot().to_json()) for each in done.ended)
        if done.unknown:
            words = ", ".join(repr(each) for each in done.unknown)
            reply = replies.failure(seq, UnknownGoal.code, f"no goal {words} is known: see `talk status`")
        else:
            reply = replies.ok(seq, count=len(ended))
        connection.stream(chain(canceled, before), reply)
