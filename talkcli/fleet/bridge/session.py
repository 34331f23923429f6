"""One asker's connection to the robot's server: what it asks goes in, and the server's lines come back, in their order.

It is a line pump: of what passes it looks at what is a goal, and at what answers what. Whether something may be asked
is decided before, in `policy`; goals that are too many wait here, or are turned away.
"""

from __future__ import annotations

import asyncio
import random
from collections import deque
from typing import TYPE_CHECKING, Protocol

from talkcli.daemon import log
from talkcli.errors import BadRequest, Busy, TalkError
from talkcli.fleet.bridge.local import dial
from talkcli.fleet.bridge.policy import SHARE, not_taken, sender, unworded
from talkcli.goals.goal import By, Sender
from talkcli.goals.options import Cancel, Say, Set
from talkcli.goals.states import State
from talkcli.protocol.events import failure
from talkcli.protocol.lines import MAX_LINE, decode, encode
from talkcli.protocol.requests import Hello, Pause, Resume, Status, Wait, Watch

if TYPE_CHECKING:
    from collections.abc import Iterable

    from talkcli.fleet.bridge.local import Local
    from talkcli.fleet.bridge.policy import Ask, Ids, Share
    from talkcli.goals.goal import Goal, JsonObject

#: Requests of one asker that may wait: for the connection, for room, for their answers. And bytes of those of all; what
#: ends them, or tells of them, may be as many beyond.
MAX_WAITING, MAX_HELD = 64, 4 * 1024 * 1024
#: Seconds without a line of its own after which an asker is taken to be gone, whatever it waits for: MQTT doesn't tell.
#: One that lives says hello every 30 s, and two of those may be lost.
IDLE = 90.0
#: Seconds in which the server must have taken what an asker wants who has said goodbye.
_TAKEN = 5.0
#: What is carried out, whoever hears of it.
_LASTING = (Say, Cancel, Set, Pause, Resume)
#: Characters of a robot's name in the ids that it gives: with what follows, an id has 64 at most.
_OF_NAME = 48
#: What lines begin with that may be lost on their way.
_LIGHT = (b'{"event": "word"', b'{"event": "alive"')
#: What an asker is told last, where the server has ended the connection.
_GONE = "the robot's talk server ended the connection"


class House(Protocol):
    """What the sessions of a robot share."""

    #: the robot's name, and the place of its server's socket
    name: str
    socket: str | None
    ids: Ids
    share: Share
    #: how many may try at once to get a connection to the server
    dialing: asyncio.Semaphore
    #: set while the broker takes what there is
    flowing: asyncio.Event
    #: goals that wait until fewer are pending, in their order
    waiting: list[tuple[Ask, Session]]

    def publish(self, topic: str, payload: bytes, qos: int, correlation: bytes | None) -> None:
        """Publish lines to an asker."""

    def room(self) -> int:
        """Return how many bytes the broker takes in one payload."""

    def boottime(self) -> float:
        """Return seconds by a clock that goes on while the robot is suspended."""

    def now(self) -> float:
        """Return seconds since 1970 UTC."""

    def held(self) -> int:
        """Return how many bytes the requests have that wait for anything."""

    def take_back(self, selection: Cancel, by: By) -> list[Goal]:
        """End the goals that wait and are selected."""

    def look(self) -> None:
        """Let go, soon, what waits and may go now."""

    def left(self, session: Session) -> None:
        """Forget a session that has ended."""


class _Open:
    """A request that the server has, and has not answered."""

    def __init__(self, ask: Ask, goal_id: str | None = None, *, fresh: bool = False) -> None:
        self.ask = ask
        #: of a goal: the id that it was sent with, and whether it was never sent before
        self.goal_id, self.fresh = goal_id, fresh
        #: of a cancel: what it ended that never came to the server
        self.taken: list[Goal] = []


class Session:
    """One asker. All calls are made in the event loop's thread."""

    def __init__(self, house: House, user: str, topic: str | None) -> None:
        """`topic`: where the answers go; None for nowhere."""
        self.user, self.topic = user, topic
        #: when its asker was last heard, by the loop's clock
        self.used = 0.0
        self._house = house
        self._loop = asyncio.get_running_loop()
        self._name = sender(user)
        self._local: Local | None = None
        #: what waits for the connection
        self._queue: deque[Ask] = deque()
        self._open: dict[int, _Open] = {}
        self._numbers = 0
        #: the goals whose results are still to come; whether everything is
        self._awaited: set[str] = set()
        self._watches = False
        self._task: asyncio.Task[None] | None = None
        #: ends it, where its asker has said goodbye
        self._leaving: asyncio.TimerHandle | None = None

    # -- what it is asked

    @property
    def idle(self) -> bool:
        """Whether nothing is owed to its asker."""
        return not (self._queue or self._open or self._awaited or self._watches or self._mine())

    @property
    def held(self) -> int:
        """How many bytes its requests have that wait for the connection or their answers."""
        return sum(each.size for each in self._queue) + sum(each.ask.size for each in self._open.values())

    def ask(self, ask: Ask) -> None:
        """Carry out a request, after those that came before it."""
        self.used = self._loop.time()
        if self._leaving:  # and has thought better of it
            self._leaving.cancel()
            self._leaving, self.topic = None, ask.topic
        urgent = isinstance(ask.request, Cancel | Status)
        if len(self._open) + len(self._queue) + len(self._mine()) >= MAX_WAITING:
            self._refuse(ask, Busy.code, f"{MAX_WAITING} requests of yours are waiting already")
        elif self._house.held() + ask.size > (2 * MAX_HELD if urgent else MAX_HELD):
            self._refuse(ask, Busy.code, f"{MAX_HELD >> 20} MiB of requests are waiting already")
        elif self._local:
            self._take(ask)
        else:
            self._queue.append(ask)
            if self._task is None:
                self._task = asyncio.create_task(self._run(urgent))

    def leave(self) -> None:
        """Tell the asker nothing more, and end as soon as the server has taken what was asked; goals that wait for room
        are taken back.
        """
        self.topic = None
        self._house.waiting = [each for each in self._house.waiting if each[1] is not self]
        self._queue = deque(each for each in self._queue if _lasts(each))
        self._leaving = self._leaving or self._loop.call_later(_TAKEN, self.hang_up)
        self._leave()

    def hang_up(self, why: str | None = None) -> None:
        """Take back what can be taken back, and tell the asker nothing more; but `why`, if something is owed to it."""
        if why and not self.idle:
            self._tell_end(why)
        self.topic = None
        if self._leaving:
            self._leaving.cancel()
        if self._task:
            self._task.cancel()
        self._end()

    def alive(self) -> None:
        """Tell the asker that the robot lives, where a goal waits here: the server knows nothing of it."""
        if self._mine():
            self._tell([(_LIGHT[1] + b"}\n", None)])

    def let_go(self, ask: Ask) -> None:
        """Send a goal that has waited here."""
        self._say(ask, forced=True)

    def end_waiting(self, ask: Ask, by: By | None) -> Goal:
        """Tell that a goal that has waited here was cancelled."""
        return self._turn_away(ask, State.RECALLED, "canceled", "canceled before it was spoken", by)

    def _mine(self) -> list[Ask]:
        return [each for each, session in self._house.waiting if session is self]

    def _leave(self) -> None:
        """End, if it is to end and nothing is left to be taken."""
        if self._leaving and not self._queue and not any(_lasts(each.ask) for each in self._open.values()):
            self.hang_up()

    def _take(self, ask: Ask) -> None:
        request = ask.request
        if isinstance(request, Say):
            self._say(ask)
        elif isinstance(request, Cancel):
            self._cancel(ask, request)
        elif isinstance(request, Hello):
            self._name = sender(self.user, request.name)
            self._send(_Open(ask), {**ask.message, "name": self._name})
        else:
            self._watches = self._watches or isinstance(request, Watch)
            self._send(_Open(ask), ask.message)

    def _say(self, ask: Ask, *, forced: bool = False) -> None:
        house, say, local = self._house, ask.request, self._local
        assert isinstance(say, Say)
        assert local
        goal_id = say.id or self._new_id()
        boot, counts = house.ids.boot_of(goal_id), house.share.counts(say)
        if boot not in (None, local.boot):
            words = f"{goal_id} was sent to a server that has ended since: it may have been spoken"
            self._refuse(ask, "lost", words)
        elif forced or (house.share.has_room(say) and not (counts and house.waiting)):
            if self._send(_Open(ask, goal_id, fresh=boot is None), ask.line(house.boottime(), goal_id)):
                house.ids.note(goal_id, local.boot, in_share=counts)
                if counts:
                    house.share.sent(goal_id, say.key)
        elif say.patient:
            house.waiting.append((ask, self))
        else:
            words = f"{SHARE} goals from afar are waiting already"
            self._turn_away(ask, State.REJECTED, "queue_full", words, None)

    def _cancel(self, ask: Ask, selection: Cancel) -> None:
        """Cancel what waits here, and then at the server, which must not be asked for what it has never heard of."""
        opened = _Open(ask)
        opened.taken = self._house.take_back(selection, By(client=Sender(name=self._name)))
        message = dict(ask.message)
        taken = {each.id for each in opened.taken}
        if selection.ids is not None:
            message["ids"] = [each for each in selection.ids if each not in taken]
        if selection.before in taken:
            del message["before"]
            message.setdefault("ids", [])
        self._send(opened, message)

    def _send(self, opened: _Open, message: JsonObject) -> bool:
        """Ask the server, and return whether that was possible."""
        assert self._local
        self._numbers += 1
        line = encode({"seq": self._numbers, **message})
        if len(line) > MAX_LINE:
            self._refuse(opened.ask, "line_too_long", f"a request has at most {MAX_LINE} bytes")
            return False
        self._open[self._numbers] = opened
        self._local.write(line)
        return True

    def _new_id(self) -> str:
        """Return an id that no server and no other robot gives: each `say` has one, so that it can be counted."""
        return f"{self._house.name[:_OF_NAME]}-x{random.getrandbits(48):012x}"

    # -- what it is told

    async def _run(self, urgent: bool) -> None:
        try:
            await self._serve(urgent)
        except Exception as error:  # noqa: BLE001 - one asker's must not take the robot from the others
            log.bug("a session", error)
        self._end()

    async def _serve(self, urgent: bool) -> None:
        house = self._house
        try:
            self._local = await dial(house.socket, self._name, urgent=urgent, slots=house.dialing)
        except TalkError as error:
            code = Busy.code if isinstance(error, Busy) else "no_server"
            while self._queue:
                self._refuse(self._queue.popleft(), code, " ".join(str(error).split()))
            return
        while self._queue:
            self._take(self._queue.popleft())
        self._leave()
        while lines := await self._local.read():
            self._hear(lines)
            self._leave()
            await house.flowing.wait()
        for each in self._mine():
            self._refuse(each, "no_server", _GONE)
        self._tell_end(_GONE)

    def _hear(self, lines: Iterable[bytes]) -> None:
        told: list[tuple[bytes, bytes | None]] = []
        for line in lines:
            if line.startswith(_LIGHT):
                told.append((line + b"\n", None))
                continue
            try:
                message = decode(line)
            except BadRequest as error:
                log.seldom("server", f"what the server says is no line: {error}")
                continue
            if "seq" in message:
                told += self._answer(message)
            elif "event" in message:
                if message["event"] == "result" and isinstance(goal := message.get("goal"), dict):
                    self._awaited.discard(str(goal.get("id")))
                told.append((line + b"\n", None))
        self._tell(told)

    def _answer(self, message: JsonObject) -> list[tuple[bytes, bytes | None]]:
        """Return a line that answers a request, and what goes before it, as the asker is told it."""
        number = message.pop("seq")
        opened = self._open.get(number) if isinstance(number, int) else None
        if opened is None:
            return []
        ask = opened.ask
        found: list[JsonObject] = []
        goal = message.get("goal")
        if isinstance(goal, dict):
            self._note_goal(opened, goal)
        if "ok" in message:
            assert isinstance(number, int)
            del self._open[number]
            self._settle(opened, message)
            found = [{"canceled": each.to_json()} for each in opened.taken]
            count = message.get("count")
            if found and isinstance(count, int):
                message["count"] = count + len(found)
        numbered = (each if ask.seq is None else {"seq": ask.seq, **each} for each in (*found, message))
        return [(encode(each), ask.correlation) for each in numbered]

    def _note_goal(self, opened: _Open, goal: JsonObject) -> None:
        """Note a goal of which the asker will be told more."""
        request, state = opened.ask.request, State.__members__.get(str(goal.get("state")))
        waits = isinstance(request, Wait) or (isinstance(request, Say) and (request.wait or request.feedback))
        if waits and state is not None and not state.terminal:
            self._awaited.add(str(goal.get("id")))

    def _settle(self, opened: _Open, reply: JsonObject) -> None:
        """Count a goal that the server has answered for."""
        if opened.goal_id is None:
            return
        goal = reply.get("goal")
        state = goal.get("state") if isinstance(goal, dict) else None
        self._house.share.answered(opened.goal_id, pending=state == State.PENDING.name)
        if opened.fresh and state in (None, State.REJECTED.name):
            self._house.ids.forget(opened.goal_id)
        self._house.look()

    def _refuse(self, ask: Ask, code: str, words: str) -> None:
        self._tell([(encode(failure(ask.seq, code, words)), ask.correlation)])

    def _turn_away(self, ask: Ask, state: State, reason: str, words: str, by: By | None) -> Goal:
        say, now = ask.request, self._house.now()
        assert isinstance(say, Say)
        own = say.id if state is State.RECALLED else None  # a goal that was never queued has no id of its sender's
        goal, lines = not_taken(ask, own or self._new_id(), state, reason, words, now, by)
        answer, *events = (encode(each) for each in lines)
        self._tell([(answer, ask.correlation), *((each, None) for each in events)])
        return goal

    def _tell_end(self, why: str) -> None:
        self._tell([(encode({"event": "gone", "message": why}), None)])

    def _tell(self, lines: list[tuple[bytes, bytes | None]]) -> None:
        """Publish lines, as many in one payload as fit: those that answer the same request, or none."""
        if self.topic is None:
            return
        piece, belongs, light, room = b"", None, True, self._house.room()
        for whole, correlation in lines:
            line = whole if len(whole) <= room else self._shortened(whole, room)
            if piece and (correlation != belongs or len(piece) + len(line) > room):
                self._publish(piece, belongs, light=light)
                piece, light = b"", True
            piece, belongs, light = piece + line, correlation, light and line.startswith(_LIGHT)
        if piece:
            self._publish(piece, belongs, light=light)

    def _shortened(self, line: bytes, room: int) -> bytes:
        """Return a line that the broker takes in place of one that is too long for it."""
        message = decode(line)
        shorter = encode(unworded(message))
        if len(shorter) <= room:
            return shorter
        words = f"this has {len(line):,} bytes, and the broker takes {room:,}"
        if "ok" in message:
            seq = message.get("seq")
            return encode(failure(seq if isinstance(seq, int) else None, "too_long", words))
        log.seldom("long", f"a line for {self._name} is dropped: {words}")
        return b""

    def _publish(self, piece: bytes, correlation: bytes | None, *, light: bool) -> None:
        assert self.topic
        self._house.publish(self.topic, piece, 0 if light else 1, correlation)

    def _end(self) -> None:
        """Forget what is not answered: whoever asked has been told, or is gone."""
        house = self._house
        house.waiting = [each for each in house.waiting if each[1] is not self]
        for opened in self._open.values():
            if opened.goal_id is not None:
                house.share.answered(opened.goal_id, pending=False)
        self._open.clear()
        if self._local:
            self._local.close()
        house.left(self)
        house.look()


def _lasts(ask: Ask) -> bool:
    """Whether something is carried out that its asker hears nothing of; a goal that waits for room is taken back."""
    request = ask.request
    return isinstance(request, _LASTING) and not (isinstance(request, Say) and request.patient)
