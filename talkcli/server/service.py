"""The service: carries out requests, the scheduler's effects and the engine's reports, all in the loop's thread.

What happens is the scheduler's decision, how it is spoken the engine thread's, who hears of it the audience's. It
passes between them and never waits for any of them.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
import traceback
from typing import TYPE_CHECKING

from talkcli import __version__, peers, wire
from talkcli.engine import protocol
from talkcli.engine.thread import EngineDied, Report, ThreadDied
from talkcli.errors import TalkError, UsageError
from talkcli.messages import Sender
from talkcli.scheduler import Changed, Effect, GiveUp, Now, Scheduler, Start
from talkcli.server import log
from talkcli.server.answers import Answers
from talkcli.server.audience import Audience

if TYPE_CHECKING:
    from collections.abc import Callable

    from talkcli.engine.thread import EngineThread
    from talkcli.messages import JsonObject
    from talkcli.record import Record
    from talkcli.requests import Request
    from talkcli.server.connection import Connection
    from talkcli.server.settings import Settings

#: Places at the door of a full server, for clients that want to know its status or to silence it.
DOOR = 16


class Service:
    """One server's state, for as long as it runs. It is the handler of its connections."""

    def __init__(self, boot: str, settings: Settings, path: str, mode: int) -> None:
        self.boot = boot
        self.settings = settings
        self.path = path
        #: whether the socket's mode lets others in than its owner
        self._open_to_others = bool(mode & 0o066)
        self.engine: EngineThread
        self.scheduler = Scheduler(
            boot, preempt=settings.preempt, max_queue=settings.max_queue, max_text=settings.max_text
        )
        self.connections: set[Connection] = set()
        #: set once everything has ended after `shut_down`
        self.finished = asyncio.Event()
        #: set while there is no client
        self.deserted = asyncio.Event()
        self.deserted.set()
        #: why the server must end at once: what it was told to do can't be done
        self.fatal: TalkError | None = None
        self.ready: protocol.Ready | None = None
        self.voices: tuple[protocol.Voice, ...] | None = None
        #: how the engine is, in a few words
        self.engine_words = "starting"
        self.began = self._now()
        self.audience = Audience(asyncio.get_running_loop())
        self._answers = Answers(self)
        self._loop = asyncio.get_running_loop()
        self._closing = False
        self._timer: asyncio.TimerHandle | None = None
        self._started: tuple[str, float] = ("", 0.0)

    # -- the handler of the connections

    def joined(self, connection: Connection, transport: asyncio.Transport) -> None:
        """Admit a client, let it wait at the door of a full server, or turn it away."""
        pid, uid = peers.credentials(transport.get_extra_info("socket"))
        if uid not in {os.getuid(), 0} and not self._open_to_others:
            words = f"this server is uid {os.getuid()}'s; it would have to be started with --socket-mode"
            transport.write(wire.encode({"talk": wire.PROTOCOL, "error": "permission_denied", "message": words}))
            transport.close()
            return
        if len(self.connections) >= self.settings.max_clients + DOOR:
            transport.write(wire.encode(wire.busy_greeting()))
            transport.close()
            return
        connection.sender = Sender(pid or None, uid, peers.command_of(pid), peers.parent_command_of(pid))
        connection.admitted = len(self.connections) < self.settings.max_clients
        self.connections.add(connection)
        self.deserted.clear()

    def greeting(self) -> JsonObject:
        return wire.greeting(__version__, os.getpid(), self.boot)

    def left(self, connection: Connection) -> None:
        """Forget a client; its goals go on."""
        self.connections.discard(connection)
        if not self.connections:
            self.deserted.set()
        self.audience.left(connection)
        self._answers.left(connection)

    def handle(self, connection: Connection, seq: int | None, request: Request) -> None:
        """Carry out a request."""
        self._answers.handle(connection, seq, request)

    def failed(self, what: str, error: Exception) -> None:
        """Log a bug, with the place where it is, on one line."""
        frames = traceback.extract_tb(error.__traceback__)
        place = f" at {os.path.basename(frames[-1].filename)}:{frames[-1].lineno}" if frames else ""
        log.line(f"a bug in {what}{place}: {log.shown(f'{type(error).__name__}: {error}')}")

    # -- the scheduler's effects

    def now(self) -> Now:
        return self._now()

    @staticmethod
    def _now() -> Now:
        return Now(time.monotonic(), time.time())

    def apply(self, effects: list[Effect]) -> None:
        """Carry out what the scheduler decided, in its order."""
        for effect in effects:
            try:
                self._carry_out(effect)
            except Exception as error:  # noqa: BLE001 - the effects after it must not be lost: the engine would wait
                self.failed(type(effect).__name__, error)
        self._set_timer()
        if self._closing and self.scheduler.active is None:
            self.finished.set()

    def _carry_out(self, effect: Effect) -> None:
        if isinstance(effect, Changed):
            self._changed(effect)
        elif isinstance(effect, Start):
            self._start(effect.record)
        elif isinstance(effect, GiveUp):
            self.engine.give_up(effect.record.id)
        else:
            self.engine.stop(effect.record.id)

    def _changed(self, change: Changed) -> None:
        record = change.record
        self.audience.changed(record, change.state, time.time())
        if change.state.terminal:
            goal_id, since = self._started
            log.ended(record, time.monotonic() - since if goal_id == record.id else None)
            self._answers.ended(record)

    def _start(self, record: Record) -> None:
        self._started = (record.id, time.monotonic())
        settings = self.settings
        self.engine.say(
            protocol.Say(
                id=record.id,
                text=record.text or "",
                rate=settings.rate,
                volume=settings.volume,
                voice=settings.voice,
                pitch=settings.pitch,
            )
        )

    def call_later(self, seconds: float, action: Callable[[], None]) -> None:
        """Do something after a while, whatever happens meanwhile."""
        self._loop.call_later(seconds, action)

    def _set_timer(self) -> None:
        if self._timer:
            self._timer.cancel()
        deadline = self.scheduler.deadline()
        self._timer = None if deadline is None else self._loop.call_at(deadline, self._tick)

    def _tick(self) -> None:
        self.apply(self.scheduler.tick(self._now()))

    # -- the engine's reports

    def report(self, report: Report) -> None:
        """Take what the engine thread says; called in any thread."""
        with contextlib.suppress(RuntimeError):  # the loop is closed: nobody is left who would want to know
            self._loop.call_soon_threadsafe(self._note, report)

    def _note(self, report: Report) -> None:
        if isinstance(report, protocol.Ended):
            self._ended(report)
        elif isinstance(report, protocol.Word):
            self._word(report)
        elif isinstance(report, protocol.Ready):
            if self.ready != report:
                version = f", {log.shown(report.version)}" if report.version else ""
                log.line(f"engine ready: driver {report.driver}{version}, player {report.player or 'its own'}")
            self.ready, self.engine_words = report, "ready"
        elif isinstance(report, protocol.Voices):
            self.voices = report.voices
            self._answers.voices_known()
        elif isinstance(report, protocol.StartFailed):
            self._engine_fails(report.message)
            if report.reason == "unknown_voice" and self.ready is None:
                self.fatal = UsageError(report.message)
                self.shut_down()
        elif isinstance(report, EngineDied):
            self._engine_fails(report.words)
        elif isinstance(report, ThreadDied):
            self._thread_died(report.words)

    def _engine_fails(self, words: str) -> None:
        if words != self.engine_words:
            log.line(log.shown(words))
        self.engine_words = words
        self._answers.voices_known()

    def _thread_died(self, words: str) -> None:
        """End: there is nothing left that could speak, and a supervisor will start another server."""
        self._engine_fails(words)
        self.fatal = TalkError(words)
        self.shut_down()
        if self.scheduler.active:
            self.apply(self.scheduler.failed(self.scheduler.active.id, "engine_failed", words, None, self._now()))

    def _ended(self, ended: protocol.Ended) -> None:
        active = self.scheduler.active
        if active is None or active.id != ended.id:
            return  # it was given up before the engine came to its end
        now = self._now()
        if ended.outcome == protocol.COMPLETED:
            effects = self.scheduler.completed(ended.id, ended.duration, now)
        elif ended.outcome == protocol.STOPPED and active.stop_since is not None:
            effects = self.scheduler.stopped(ended.id, now)
        else:
            reason, words = ended.reason or "engine_failed", ended.message or "the engine stopped by itself"
            effects = self.scheduler.failed(ended.id, reason, words, ended.duration, now)
        self.apply(effects)

    def _word(self, word: protocol.Word) -> None:
        active = self.scheduler.active
        if active is None or active.id != word.id:
            return
        record = self.scheduler.heard(word.id, word.end)
        text = (record.text or "")[word.start : word.end]
        event: JsonObject = {
            "word": text,
            "start": word.start,
            "end": word.end,
            "number": word.number,
            "time": word.time,
        }
        self.audience.heard(word.id, event, time.time())

    # -- the end

    def shut_down(self) -> None:
        """End every goal; `finished` is set once it is silent."""
        self._closing = True
        self.apply(self.scheduler.shutdown(self._now()))
