"""A coroutine a request: carries it out, and answers it now or as soon as what it asks for is so.

Each is driven on the spot, and waits by `call.wait`; what it waits for is brought about by what is spoken
(`speech.py`), or here: room in the queue, and a cancel that ends goals which wait themselves. While a request waits it
keeps its connection open, and it is forgotten with it.
"""

from __future__ import annotations

import asyncio
import sys
from itertools import chain
from typing import TYPE_CHECKING

from talkcli.daemon import log
from talkcli.engine.voices import is_neural
from talkcli.errors import RequestRefused, UnknownGoal
from talkcli.frozen import fields, replace
from talkcli.goals.goal import By
from talkcli.goals.option import figure
from talkcli.goals.options import INITIAL, Cancel, Say, Set, as_shown, bad_option, given
from talkcli.goals.reasons import Reason
from talkcli.goals.states import State
from talkcli.protocol.events import Result
from talkcli.protocol.lines import encode
from talkcli.protocol.requests import Log, Pause, Request, Resume, Status, Voices, Wait, Watch
from talkcli.server.call import Call, go_on
from talkcli.server.log import who

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterable, Iterator
    from typing import Any

    from talkcli.goals.goal import JsonObject
    from talkcli.goals.reasons import Refusal
    from talkcli.goals.record import Record
    from talkcli.server.call import Place
    from talkcli.server.connection import Connection
    from talkcli.server.speech import Speech

#: Ended goals that `status` lists.
RECENT = 10
#: Seconds for which the voices are awaited; a client gives up after five.
VOICES_LIMIT = 4.0
#: Seconds after which a pause is answered though nobody knows that it is silent.
PAUSE_LIMIT = 2.0
#: Requests that wait for one client; the wire names it. Each is kept with its text, and a client is read from all the
#: while, because a cancel may come behind them.
MAX_WAITING = 1_000
#: Bytes of all the requests that wait, as of the output that waits.
ALL_WAITING = 64 * 1024 * 1024
#: Bytes that each is counted with besides what it carries. It takes a tenth of that; but so no more than 8,000 wait,
#: and a cancel of so many is answered within 2 s, too.
EACH = 8 * 1024


class Requests:
    """Carries out the requests of a server's clients."""

    def __init__(self, speech: Speech, describe: Callable[[], JsonObject]) -> None:
        """`describe` returns what `status` says of the server itself."""
        self._speech = speech
        self._scheduler = speech.scheduler
        self._describe = describe
        #: goals that were cancelled while they waited, and are to be told so
        self._canceled: Place = {}
        #: those that are not answered yet, by connection, in their order
        self._calls: dict[Connection, Place] = {}
        #: bytes of all that are kept while they wait
        self._size = 0
        self._turn: asyncio.Handle | None = None
        speech.queue_changed = self._look
        self._by_kind: dict[type[Request], Callable[[Call, Any], Coroutine[Place, bool | None, None]]] = {
            Say: self._say,
            Wait: self._wait,
            Cancel: self._cancel,
            Status: self._status,
            Voices: self._voices,
            Watch: self._watch,
            Log: self._log,
            Set: self._set,
            Pause: self._pause,
            Resume: self._resume,
        }

    def handle(self, connection: Connection, seq: int | None, request: Request) -> None:
        """Carry out a request, and answer it now or later."""
        call = Call(connection, seq, request)
        self._calls.setdefault(connection, {})[call] = None
        call.begin(self._carry_out(call))

    def owes(self, connection: Connection) -> bool:
        """Whether a client waits: for an answer, or for what it is to be told."""
        return connection in self._calls or self._speech.subscribers.has(connection)

    def left(self, connection: Connection) -> None:
        """Forget the requests of a client that is gone, and what it was to be told."""
        for each in self._waiting(connection):
            each.drop()
        self._speech.subscribers.left(connection)

    def shut_down(self) -> None:
        """End all goals, those that wait, too."""
        ends = self._end_waiting(self._select(Cancel()), None)
        self._speech.shut_down()
        go_on(self._speech.for_voices)
        self._speech.news.tell([*ends, self._speech.look_finished])

    async def _carry_out(self, call: Call) -> None:
        request = call.request
        try:
            if isinstance(request, Cancel | Pause):
                self._hurry(call.connection)  # silence waits for nothing; what was asked for before comes before it
            elif self._must_wait(call):
                if self._keep(call):
                    await call.wait(self._speech.for_voices, VOICES_LIMIT)
                elif not isinstance(request, Say):
                    self._hurry(call.connection)
            await self._by_kind[type(request)](call, request)
        except RequestRefused as error:
            call.refuse(error.code, str(error))
        except Exception as error:  # noqa: BLE001 - one client's request must not take the voice from the others
            log.write_bug(request.kind, error)
            call.refuse("internal_error", f"{request.kind} failed: a bug of talk's, see its log")
        finally:
            self._size -= call.size
            mine = self._calls[call.connection]
            del mine[call]
            if not mine:
                del self._calls[call.connection]

    # -- who waits

    def _waiting(self, connection: Connection) -> list[Call]:
        """Return the requests of this connection that are not answered yet, in their order."""
        return list(self._calls.get(connection, ()))

    def _must_wait(self, call: Call) -> bool:
        """Whether it can't be carried out yet: the voices are needed, or what came before it needs them."""
        request, waiting = call.request, self._speech.for_voices
        if waiting and (isinstance(request, Say) or self._held(call.connection)):
            return True
        if not self._speech.awaits_voices:
            return False
        if isinstance(request, Set):
            return request.voice is not None and not bad_option(request)
        return isinstance(request, Voices) or (isinstance(request, Say) and request.voice is not None)

    def _held(self, connection: Connection) -> list[Call]:
        """Return the requests of this connection that wait for the voices: what comes after them must not overtake."""
        return [each for each in self._waiting(connection) if each.place is self._speech.for_voices]

    def _keep(self, call: Call) -> bool:
        """Count a request that is to wait; where it can't, return False, and it has a fault."""
        if call.size:
            return True  # it has waited for something else already
        size = EACH + sum(map(_bytes_of, fields(call.request).values()))
        if len(self._waiting(call.connection)) > MAX_WAITING:  # it is one of them
            call.fault = Reason.QUEUE_FULL, f"{MAX_WAITING:,} requests of this connection are waiting already"
        elif self._size + size > ALL_WAITING:
            call.fault = Reason.QUEUE_FULL, f"{ALL_WAITING >> 20} MiB of requests are waiting already"
        else:
            call.size = size
            self._size += size
        return call.fault is None

    def _hurry(self, connection: Connection) -> None:
        """Have go on what of this connection waits for the voices; the others' know nothing of what hurries."""
        for each in self._held(connection):
            each.resume()

    def _look(self) -> None:
        """Let go, soon, what may go now that a goal has come to the queue, or left it."""
        if self._speech.for_room and self._turn is None:
            # Soon, not at once: whoever changed something may be in the middle of other changes.
            self._turn = asyncio.get_running_loop().call_soon(self._let_go)

    def _let_go(self) -> None:
        self._turn = None
        full: set[object] = set()
        went = False
        for each in list(self._speech.for_room):
            say = each.request
            assert isinstance(say, Say)
            # All that room depends on, but for an id: where a thousand lack it, one is asked for.
            kind = (say.priority, say.key, say.flush, say.preempt) if say.id is None else None
            if kind in full:
                continue
            if not self._scheduler.has_room(say):
                if kind:
                    full.add(kind)
            elif not each.connection.has_hung_up():
                each.resume()
                went = True
        if went:
            self._look()  # they may have made room for others, those before them first

    def _select(self, selection: Cancel) -> list[Call]:
        """Return the selected goals of those that wait."""
        waiting = (*self._canceled, *self._speech.for_room, *self._speech.for_voices)
        goals = [(each, each.request) for each in waiting if isinstance(each.request, Say)]
        selected = selection.of_waiting([say for _, say in goals])
        # Who has hung up has taken its request back, and is about to be forgotten.
        return [goals[place][0] for place in selected if not goals[place][0].connection.has_hung_up()]

    def _end_waiting(self, calls: list[Call], by: By | None) -> list[Callable[[], None]]:
        """Have these goals wait for nothing more; return what submits them as cancelled, to be told in its turn."""
        new = [each for each in calls if each.place is not self._canceled]
        for each in new:
            each.by = by
            each.move(self._canceled)
        return [each.resume for each in new]

    async def _await_room(self, call: Call, say: Say) -> float:
        """Wait until there is room or the goal's ttl is over, and return the seconds that count towards its ttl."""
        ttl = (self._scheduler.settings.ttl if say.ttl is None else say.ttl) or None
        began = self._speech.now().monotonic
        self._speech.subscribers.keep_alive()
        in_time = await call.wait(self._speech.for_room, ttl)
        waited = self._speech.now().monotonic - began
        return waited if in_time or ttl is None else max(waited, ttl)

    # -- one method a request

    async def _say(self, call: Call, say: Say) -> None:
        connection, sender = call.connection, call.connection.sender
        waited = 0.0
        if call.by is None:
            now = self._speech.now()
            if self._turn:  # a goal that comes now must not take the room of one that waits
                self._turn.cancel()
                self._let_go()
            fault = call.fault or self._speech.voices.fault(say.voice, self._scheduler.settings.voice)
            if say.patient and self._scheduler.lacks_room(say, now, fault) and self._keep(call):
                waited = await self._await_room(call, say)
        voices, usual = self._speech.voices, self._scheduler.settings.voice
        now, fault = self._speech.now(), call.fault or voices.fault(say.voice, usual)
        if not fault:
            say = replace(say, voice=voices.meant(say.voice, usual))
            fault = _unpitched(say)
        if not fault:
            self._speech.want(say.voice or usual)
        submitted = self._scheduler.submit(say, sender, now, fault, call.by, waited)
        record = submitted.record
        extra: JsonObject = {"paused": True} if self._scheduler.paused else {}
        if submitted.attached:
            state = record.state
            extra["attached"] = True
        else:
            # As it was accepted: it may have started in the same step, but that is told by its events.
            state = record.state if record.state is State.REJECTED else State.PENDING
            if call.by and record.by is call.by:
                call.ended = record
        goal = record.snapshot(state).to_json()
        ended = submitted.attached and state.terminal
        if (say.wait or say.feedback) and not ended:
            self._speech.subscribers.await_result(record.id, connection, feedback=say.feedback)
        call.answer(goal=goal, **extra)
        if ended and (say.wait or say.feedback):
            connection.publish(encode({"event": "result", "goal": goal}))
        self._speech.apply(submitted.effects)

    async def _wait(self, call: Call, request: Wait) -> None:
        await self._speech.news.until_told(call)  # the result of a goal that has ended is the last of it
        if request.ids is None:
            records = self._scheduler.unfinished()
        else:
            records = [self._find(each) for each in dict.fromkeys(request.ids)]
        for record in records:
            if not record.state.terminal:
                self._speech.subscribers.await_result(record.id, call.connection, feedback=request.feedback)
        # As they are now: what becomes of them meanwhile is told by the events that come after the list. Of a thousand
        # that have ended, each is looked at when its turn comes to be sent.
        active = self._scheduler.active
        spoken = active.snapshot() if active else None
        told = [(record, record.state) for record in records]
        goals = (spoken if spoken and record is active else record.snapshot(state) for record, state in told)
        # Subscribers are told of the others.
        results = (Result(record.snapshot()).to_json() for record, state in told if state.terminal)
        call.answer(({"goal": each.to_json()} for each in goals), results, count=len(records))

    async def _cancel(self, call: Call, selection: Cancel) -> None:
        speech, by = self._speech, By(client=call.connection.sender)
        now = speech.now()
        waiting = self._select(selection)
        ends = self._end_waiting(waiting, by)
        ids = {each.request.id for each in waiting if isinstance(each.request, Say)}
        done = self._scheduler.cancel(selection, call.connection.sender, now, ids)
        speech.apply(done.effects)  # the engine is told before thousands of clients may be
        speech.news.tell(ends)
        if done.stopping:  # its end will be told after all that
            while not done.stopping.state.terminal:
                await call.wait(speech.for_silence(done.stopping))
        else:
            await speech.news.until_told(call)
        ended = done.recalled + [each.ended for each in waiting if each.ended]
        if done.stopping and done.stopping.state is not State.SUCCEEDED:
            ended.append(done.stopping)
        goals = chain(_listed("canceled", ended), _listed("ended", done.ended))
        if done.unknown:
            call.refuse(UnknownGoal.code, _unknown(*done.unknown), goals)
        else:
            call.answer(goals, count=len(ended))

    async def _pause(self, call: Call, _: Pause) -> None:
        speech = self._speech
        speech.pause(By(client=call.connection.sender))
        active = self._scheduler.active
        if active and active is not speech.silent and not await call.wait(speech.for_silence(active), PAUSE_LIMIT):
            words = f"speech is paused, but {active.id} was not known to be silent within {PAUSE_LIMIT:g} s"
            raise RequestRefused(words, Reason.NOT_SILENT)
        self._report_pause(call, active)

    async def _resume(self, call: Call, _: Resume) -> None:
        self._report_pause(call, self._speech.resume(By(client=call.connection.sender)))

    def _report_pause(self, call: Call, goal: Record | None) -> None:
        told = None if goal is None or goal.state.terminal else goal.snapshot().to_json()
        call.answer(paused=self._scheduler.paused, goal=told)

    async def _status(self, call: Call, request: Status) -> None:
        if request.id is None:
            self._send_overview(call)
        else:
            call.answer(goal=self._find(request.id).snapshot().to_json())

    async def _watch(self, call: Call, _: Watch) -> None:
        await self._speech.news.until_told(call)  # what comes after the overview has happened after it
        self._send_overview(call)
        self._speech.subscribers.watch(call.connection)

    def _send_overview(self, call: Call) -> None:
        pending = list(self._scheduler.pending())
        recent = list(self._scheduler.history.latest(RECENT))
        active = self._scheduler.active
        now = active.snapshot().to_json() if active else None
        goals = chain(_listed("pending", pending), _listed("recent", reversed(recent)))
        call.answer(goals, server=self._describe(), active=now)

    async def _voices(self, call: Call, _: Voices) -> None:
        self._speech.voices.look_for_files()
        voices = self._speech.voices.listed
        if voices is None:
            words = f"the engine can't list its voices now: it is {self._speech.engine_words}"
            if self._scheduler.active:
                words += ", and busy with its first sentence: ask again after that"
            raise RequestRefused(words, Reason.ENGINE_FAILED)
        call.answer(({"voice": fields(each)} for each in voices), count=len(voices))

    async def _log(self, call: Call, request: Log) -> None:
        records = list(self._scheduler.history.log(request.count))
        call.answer(_listed("goal", reversed(records)), count=len(records))

    async def _set(self, call: Call, request: Set) -> None:
        words = bad_option(request)
        if words:
            raise RequestRefused(words, Reason.BAD_OPTION)
        voices = self._speech.voices
        fault = voices.fault(request.voice)
        if fault:
            code, words = fault
            raise RequestRefused(words, code)
        changed = given(replace(request, voice=voices.meant(request.voice)))
        self._scheduler.settings = replace(self._scheduler.settings, **changed)
        self._look()  # what preempts may have room
        self._speech.want(changed.get("voice"), anew=True)
        self._speech.apply(self._scheduler.tick(self._speech.now()))  # who waited for a voice may wait no more
        if changed:
            values = ", ".join(f"{name} {figure(value)}" for name, value in changed.items())
            log.write(f"set to {log.sanitize(values)} by {who(call.connection.sender)}")
        call.answer(settings=as_shown(self._scheduler.settings))

    def _find(self, goal_id: str) -> Record:
        record = self._scheduler.find(goal_id)
        if record is None:
            raise UnknownGoal(_unknown(goal_id))
        return record


def _unknown(*ids: str) -> str:
    return f"no goal {', '.join(map(repr, ids))} is known: see `talk status`"


def _unpitched(say: Say) -> Refusal | None:
    """Return reason and words why a goal can't be had that wants a pitch of a voice that has none but its own."""
    if say.pitch in {None, INITIAL.pitch} or not is_neural(say.voice or ""):
        return None
    words = f"the voice {say.voice} has no pitch but its own: leave the pitch out, or take one of espeak's"
    return Reason.BAD_OPTION, words


def _listed(name: str, records: Iterable[Record]) -> Iterator[JsonObject]:
    """Return the lines of a list of goals; each is looked at when its turn comes to be sent."""
    return ({name: each.snapshot().to_json()} for each in records)


def _bytes_of(value: object) -> int:
    """Return the bytes that a value from a request takes in memory: small lists take many times their JSON."""
    inside = value.values() if isinstance(value, dict) else value if isinstance(value, (list, tuple)) else ()
    return sys.getsizeof(value) + sum(map(_bytes_of, inside))
