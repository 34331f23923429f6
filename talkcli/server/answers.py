"""The answer to each request, now or as soon as what it asks for is so."""

from __future__ import annotations

import os
import time
from typing import TYPE_CHECKING

from talkcli import __version__, wire
from talkcli.errors import UnknownGoal
from talkcli.requests import Cancel, Request, Say, Status, Voices, Wait, Watch
from talkcli.states import State

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from talkcli.messages import JsonObject
    from talkcli.record import Record
    from talkcli.scheduler import Cancelled
    from talkcli.server.connection import Connection
    from talkcli.server.service import Service

#: Ended goals that `status` lists.
RECENT = 10
#: Seconds in which a request for the voices is answered; a client gives up after five.
VOICES_LIMIT = 4.0


class Answers:
    """Answers the requests of a service's clients."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._scheduler = service.scheduler
        #: cancels that are answered when the goal they stopped is silent
        self._cancels: list[tuple[Connection, int | None, Cancelled]] = []
        self._voices_asked: list[tuple[Connection, int | None]] = []
        self._by_kind: dict[type[Request], Callable[..., None]] = {
            Say: self._say,
            Wait: self._wait,
            Cancel: self._cancel,
            Status: self._status,
            Voices: self._voices,
            Watch: self._watch,
        }

    def handle(self, connection: Connection, seq: int | None, request: Request) -> None:
        """Carry out a request, and answer it now or later."""
        try:
            self._by_kind[type(request)](connection, seq, request)
        except UnknownGoal as error:
            connection.reply(wire.failure(seq, error.code, str(error)))

    def left(self, connection: Connection) -> None:
        """Owe a connection that is gone nothing more."""
        self._cancels = [each for each in self._cancels if each[0] is not connection]
        self._voices_asked = [each for each in self._voices_asked if each[0] is not connection]

    def ended(self, record: Record) -> None:
        """Answer those who wait for this goal to be silent."""
        due = [each for each in self._cancels if each[2].stopping is record]
        if due:
            self._cancels = [each for each in self._cancels if each[2].stopping is not record]
        for connection, seq, done in due:
            self._report_cancel(connection, seq, done)
            connection.settle()

    def voices_known(self) -> None:
        """Answer those who asked for the voices, also where there are none yet and it would take too long."""
        asked, self._voices_asked = self._voices_asked, []
        for connection, seq in asked:
            self._send_voices(connection, seq)
            connection.settle()

    # -- one method a request

    def _say(self, connection: Connection, seq: int | None, request: Say) -> None:
        record, effects = self._scheduler.submit(request, connection.sender, self._service.now())
        if request.wait:
            self._service.audience.await_result(record.id, connection)
        # As it was accepted: it may have started in the same step, but that is told by its events.
        accepted = record.state if record.state is State.REJECTED else State.PENDING
        connection.reply(wire.ok(seq, goal=record.snapshot(accepted).to_json()))
        self._service.apply(effects)

    def _wait(self, connection: Connection, seq: int | None, request: Wait) -> None:
        if request.ids is None:
            records = self._scheduler.unfinished()
        else:
            records = [self._find(each) for each in dict.fromkeys(request.ids)]
        for record in records:
            if not record.state.terminal:
                self._service.audience.await_result(record.id, connection)
        goals = [record.snapshot().to_json() for record in records]
        connection.stream((wire.item(seq, goal=each) for each in goals), wire.ok(seq, count=len(goals)))
        for record, goal in zip(records, goals, strict=True):
            if record.state.terminal:
                connection.publish({"event": "result", "goal": goal})

    def _cancel(self, connection: Connection, seq: int | None, request: Cancel) -> None:
        done = self._scheduler.cancel(request, connection.sender, self._service.now())
        self._service.apply(done.effects)
        if done.stopping is None or done.stopping.state.terminal:
            self._report_cancel(connection, seq, done)
        else:
            connection.owed += 1
            self._cancels.append((connection, seq, done))

    def _status(self, connection: Connection, seq: int | None, request: Status) -> None:
        if request.id is None:
            self._send_overview(connection, seq)
        else:
            connection.reply(wire.ok(seq, goal=self._find(request.id).snapshot().to_json()))

    def _watch(self, connection: Connection, seq: int | None, _: Watch) -> None:
        self._send_overview(connection, seq)
        self._service.audience.watch(connection)

    def _voices(self, connection: Connection, seq: int | None, _: Voices) -> None:
        if self._service.voices is None and self._service.engine_words in {"starting", "ready"}:
            connection.owed += 1
            self._voices_asked.append((connection, seq))
            self._service.call_later(VOICES_LIMIT, self.voices_known)
        else:
            self._send_voices(connection, seq)

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
                yield wire.item(seq, pending=record.snapshot().to_json())
            for record in reversed(recent):
                yield wire.item(seq, recent=record.snapshot().to_json())

        active = self._scheduler.active
        now = active.snapshot().to_json() if active else None
        connection.stream(items(), wire.ok(seq, server=self._describe(), active=now))

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
            "rate": settings.rate,
            "volume": settings.volume,
            "voice": settings.voice,
            "pitch": settings.pitch,
            "preempt": self._scheduler.preempt,
            "paused": False,
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
            connection.reply(wire.failure(seq, "engine_failed", words))
            return
        items = (wire.item(seq, voice={"id": each.id, "language": each.language, "name": each.name}) for each in voices)
        connection.stream(items, wire.ok(seq, count=len(voices)))

    def _report_cancel(self, connection: Connection, seq: int | None, done: Cancelled) -> None:
        ended = list(done.recalled)
        if done.stopping and done.stopping.state is not State.SUCCEEDED:
            ended.append(done.stopping)
        items = [wire.item(seq, canceled=each.snapshot().to_json()) for each in ended]
        items += [wire.item(seq, ended=each.snapshot().to_json()) for each in done.ended]
        if done.unknown:
            words = ", ".join(repr(each) for each in done.unknown)
            reply = wire.failure(seq, UnknownGoal.code, f"no goal {words} is known: see `talk status`")
        else:
            reply = wire.ok(seq, count=len(ended))
        connection.stream(items, reply)
