"""The service: carries out requests, the scheduler's effects and the engine's reports, all in the loop's thread.

What happens is the scheduler's decision, how it is spoken the engine thread's, who hears of it the subscribers'. It
passes between them and never waits for any of them. It has the one timer: for the scheduler's `deadline`, at which it
calls `tick`.
"""

from __future__ import annotations

import asyncio
import os
import time
import traceback
from typing import TYPE_CHECKING, Protocol

from talkcli import __version__, peers
from talkcli.engine import protocol
from talkcli.engine.supervisor import EngineDied, EngineMissing, EngineSaid, Report, ThreadDied
from talkcli.engine.synthesizers.voices import find_voice, unknown_voice
from talkcli.errors import TalkError, UsageError
from talkcli.goals.effects import Changed, Effect, GiveUp, Hold, Now, Resume, Start
from talkcli.goals.goal import Sender
from talkcli.goals.options import DEFAULT_VOICE, Cancel, for_engine
from talkcli.goals.scheduler import Scheduler
from talkcli.goals.states import State
from talkcli.protocol import replies
from talkcli.protocol.lines import encode
from talkcli.server import log
from talkcli.server.clock import LOOK_EVERY, elapsed
from talkcli.server.later import Later
from talkcli.server.mailbox import Mailbox
from talkcli.server.stream import Streams
from talkcli.server.subscribers import Subscribers

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any

    from talkcli.engine.supervisor import Supervisor
    from talkcli.goals.goal import JsonObject
    from talkcli.goals.record import Record
    from talkcli.protocol.requests import Request
    from talkcli.server.connection import Connection
    from talkcli.server.settings import Settings
    from talkcli.server.stream import Stream

#: Places at the door of a full server, for clients that want to know its status or to silence it.
DOOR = 16


class Requests(Protocol):
    """Who carries out the requests of a service's clients, and owes them answers."""

    def handle(self, connection: Connection, seq: int | None, request: Request) -> None:
        """Carry out a request."""

    def silent(self, goal_id: str, pause: int) -> None:
        """Take note that the active goal is silent in this pause of it."""

    def ended(self, record: Record) -> None:
        """Take note that a goal has ended."""

    def left(self, connection: Connection) -> None:
        """Owe a connection that is gone nothing more."""


class Service:
    """One server's state, for as long as it runs. It is the handler of its connections."""

    def __init__(self, boot: str, settings: Settings, path: str, mode: int) -> None:
        self.boot = boot
        self.settings = settings
        self.path = path
        #: whether the socket's mode lets others in than its owner
        self._open_to_others = bool(mode & 0o066)
        self.engine: Supervisor
        #: who carries out the clients' requests; set, as the engine is, before the first client is there
        self.requests: Requests
        #: called, in the loop's thread, when `words` may have changed
        self.changed: Callable[[], None] = lambda: None
        self.scheduler = Scheduler(
            boot,
            max_queue=settings.max_queue,
            max_text=settings.max_text,
            settings=settings.goals,
        )
        self.scheduler.engine_lost()  # none is ready yet
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
        #: set once an engine process is ready, or it is known that none will be; and at the server's end
        self.engine_known = asyncio.Event()
        self.began = self._now()
        self._loop = asyncio.get_running_loop()
        self.subscribers = Subscribers(self._loop)
        self.streams = Streams(self._loop)
        self.later = Later(self._loop, self.streams, self.subscribers, self.scheduler.has_room, self.failed)
        #: whether it was told to end, and takes no goal any more
        self.closing = False
        self._timer: asyncio.TimerHandle | None = None
        #: when the goals that were handed to the engine began, until their end is told: one, or for a moment two
        self._started: dict[str, float] = {}
        self._mailbox = Mailbox(self._loop, self._note, self.failed)
        self._takes: dict[type[Report], Callable[[Any], None]] = {
            protocol.Ready: self._ready,
            protocol.StartFailed: self._start_failed,
            protocol.Voices: self._voices_known,
            protocol.Word: self._word,
            protocol.Paused: lambda paused: self.requests.silent(paused.id, paused.number),
            protocol.Ended: self._ended,
            EngineSaid: lambda said: log.line(f"engine: {log.shown(said.words)}"),
            EngineDied: self._died,
            EngineMissing: self._missing,
            ThreadDied: self._thread_died,
        }
        #: whether the engine was told that a goal waits behind the one it has in hand
        self._followed = False

    # -- the handler of the connections

    def joined(self, connection: Connection, stream: Stream) -> None:
        """Admit a client, let it wait at the door of a full server, or turn it away."""
        pid, uid = peers.credentials(stream.socket)
        if uid not in {os.getuid(), 0} and not self._open_to_others:
            words = f"this server is uid {os.getuid()}'s; it would have to be started with --socket-mode"
            stream.write(encode({"talk": replies.PROTOCOL, "error": "permission_denied", "message": words}))
            stream.close()
            return
        if len(self.connections) >= self.settings.max_clients + DOOR:
            stream.write(encode(replies.busy_greeting()))
            stream.close()
            return
        connection.sender = Sender(pid or None, uid, peers.command_of(pid), peers.parent_command_of(pid))
        connection.admitted = len(self.connections) < self.settings.max_clients
        self.connections.add(connection)
        self.deserted.clear()

    def greeting(self) -> JsonObject:
        return replies.greeting(__version__, os.getpid(), self.boot)

    def left(self, connection: Connection) -> None:
        """Forget a client; its goals go on."""
        self.connections.discard(connection)
        if not self.connections:
            self.deserted.set()
        if len(self.connections) >= self.settings.max_clients:  # then somebody may wait at the door for this place
            waiting = [each for each in self.connections if not each.admitted]
            if waiting and len(self.connections) - len(waiting) < self.settings.max_clients:
                waiting[0].admit()
        self.subscribers.left(connection)
        self.later.left(connection)
        self.requests.left(connection)

    def handle(self, connection: Connection, seq: int | None, request: Request) -> None:
        """Carry out a request."""
        self.requests.handle(connection, seq, request)

    def failed(self, what: str, error: Exception) -> None:
        """Log a bug, with the place where it is, on one line."""
        frames = traceback.extract_tb(error.__traceback__)
        place = f" at {os.path.basename(frames[-1].filename)}:{frames[-1].lineno}" if frames else ""
        log.line(f"a bug in {what}{place}: {log.shown(f'{type(error).__name__}: {error}')}")

    def words(self) -> str:
        """Return what the server does and how the engine is, for people; no goal's text: any user may read it."""
        scheduler, ready = self.scheduler, self.ready
        if self.engine_words != "ready":
            doing = f"engine: {self.engine_words}"
        elif scheduler.paused:
            doing = "paused"
        else:
            doing = f"speaking {scheduler.active.id}" if scheduler.active else "idle"
        waiting = f", {scheduler.pending_count} waiting" if scheduler.pending_count else ""
        voice = f"; {ready.version or ready.driver}, {log.sound_of(ready)}" if ready else ""
        return log.shown(doing + waiting + voice)

    # -- the scheduler's effects

    def now(self) -> Now:
        """Return the time, after whatever was due by then is done."""
        now = self._now()
        deadline = self.scheduler.deadline()
        if deadline is not None and deadline <= now.monotonic:
            self.apply(self.scheduler.tick(now))
        return now

    @staticmethod
    def _now() -> Now:
        return Now(elapsed(), time.time())

    def apply(self, effects: list[Effect]) -> None:
        """Carry out what the scheduler decided, in its order, but what is for the engine before what clients are told.

        So it works, or stops, while they are. What it says to that is taken in another turn of the loop: they hear of
        everything in the scheduler's order.
        """
        for effect in sorted(effects, key=_is_told):
            try:
                self._carry_out(effect)
            except Exception as error:  # noqa: BLE001 - the effects after it must not be lost: the engine would wait
                self.failed(type(effect).__name__, error)
        self._tell_followed()
        self._set_timer()
        self.changed()
        self._look_finished()

    def _carry_out(self, effect: Effect) -> None:
        if isinstance(effect, Changed):
            self._changed(effect)
        elif isinstance(effect, Start):
            self._start(effect.record)
        elif isinstance(effect, GiveUp):
            self.engine.give_up(effect.record.id)
        elif isinstance(effect, Hold):
            self.engine.pause(effect.record.id, effect.record.holds)
        elif isinstance(effect, Resume):
            self.engine.resume(effect.record.id)
        else:
            self.engine.stop(effect.record.id)

    def _changed(self, change: Changed) -> None:
        record = change.record
        self.subscribers.changed(record, change.state, time.time())
        if change.state is not State.REJECTED:
            self.later.look()
        if change.state.terminal:
            began = self._started.pop(record.id, None)
            log.ended(record, None if began is None else time.monotonic() - began)
            self.requests.ended(record)

    def _start(self, record: Record) -> None:
        self._started[record.id] = time.monotonic()
        self._followed = self.scheduler.pending_count > 0
        chosen = for_engine(record.say, self.scheduler.settings)
        self.engine.say(protocol.Say(record.id, record.text or "", followed=self._followed, **chosen))

    def _tell_followed(self) -> None:
        """Have the engine know that a goal waits behind the one it speaks: it makes good what the change will take."""
        active, followed = self.scheduler.active, self.scheduler.pending_count > 0
        if active and followed is not self._followed:
            self._followed = followed
            self.engine.follow(active.id, followed)

    def call_later(self, seconds: float, action: Callable[[], None]) -> asyncio.TimerHandle:
        """Do something after a while; what is returned can be cancelled."""
        return self._loop.call_later(seconds, action)

    def voice_fault(self, voice: str | None) -> tuple[str, str] | None:
        """Return reason and words why a voice can't be had; None also where the voices aren't known."""
        if voice is None or voice == DEFAULT_VOICE or not self.voices or find_voice(voice, self.voices):
            return None
        return "unknown_voice", unknown_voice(voice, self.voices)

    def _set_timer(self) -> None:
        if self._timer:
            self._timer.cancel()
        deadline = self.scheduler.deadline()
        self._timer = None
        if deadline is not None:
            rest = max(0.0, deadline - elapsed())
            self._timer = self._loop.call_later(min(rest, LOOK_EVERY), self._tick)

    def _tick(self) -> None:
        self.apply(self.scheduler.tick(self._now()))

    # -- the engine's reports

    def report(self, report: Report) -> None:
        """Take what the engine thread says; called in any thread."""
        self._mailbox.post(report)

    def _note(self, report: Report) -> None:
        take = self._takes.get(type(report))
        if take:  # what else the process says is for the engine thread alone
            take(report)

    def _voices_known(self, voices: protocol.Voices) -> None:
        self.voices = voices.voices
        self.later.voices_known()

    def _died(self, died: EngineDied) -> None:
        self.scheduler.engine_lost()
        self._set_timer()
        self._engine_fails(died.words)

    def _missing(self, missing: EngineMissing) -> None:
        self.apply(self.scheduler.engine_missing(missing.words, self.now()))

    def _ready(self, ready: protocol.Ready) -> None:
        if self.ready != ready:
            log.ready(ready, self.settings.for_player)
        self.ready, self.engine_words = ready, "ready"
        self.engine_known.set()
        self.apply(self.scheduler.engine_ready(self.now()))

    def _start_failed(self, failed: protocol.StartFailed) -> None:
        if failed.usage and self.ready is None:
            self.fatal = UsageError(failed.message)
            self.shut_down()
            return
        self._engine_fails(failed.message)
        if failed.lasting:
            self.engine_known.set()
            # None will come: goals need not wait to be told.
            self.apply(self.scheduler.engine_ready(self.now()))

    def _engine_fails(self, words: str) -> None:
        if words != self.engine_words:
            log.line(log.shown(words))
        self.engine_words = words
        self.later.voices_known()
        self.changed()

    def _thread_died(self, died: ThreadDied) -> None:
        """End: there is nothing left that could speak, and a supervisor will start another server."""
        words = died.words
        self._engine_fails(words)
        self.fatal = TalkError(words)
        self.shut_down()
        if self.scheduler.active:
            self.apply(self.scheduler.failed(self.scheduler.active.id, "engine_failed", words, None, self._now()))

    def _ended(self, ended: protocol.Ended) -> None:
        active = self.scheduler.active
        if active is None or active.id != ended.id:
            return  # it was given up before the engine came to its end
        now = self.now()
        if self.scheduler.active is not active:
            return  # it was due just now
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
        self.subscribers.heard(word.id, event, time.time())

    # -- the end

    def shut_down(self) -> None:
        """End every goal; `finished` is set once it is silent."""
        self.closing = True
        self.engine_known.set()
        self.later.choose(Cancel(), None)
        self.apply(self.scheduler.shutdown(self._now()))
        self.later.voices_known()
        self.later.end(self._look_finished)

    def _look_finished(self) -> None:
        if self.closing and self.scheduler.active is None and not self.later.ends_goals:
            self.finished.set()


def _is_told(effect: Effect) -> bool:
    """Whether an effect is news for clients; the others are for the engine."""
    return isinstance(effect, Changed)
