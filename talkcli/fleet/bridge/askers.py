"""All who ask a robot by the broker: their sessions, and what they share: places in the queue, ids, room in the line.

It decides who is let in and who has to go; what is asked and answered is a session's.
"""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

from talkcli.errors import Busy
from talkcli.fleet.bridge.policy import AFAR, Ids, Share
from talkcli.fleet.bridge.session import IDLE, Session
from talkcli.fleet.link import boottime
from talkcli.goals.options import Cancel, Say
from talkcli.goals.states import State
from talkcli.protocol.events import failure
from talkcli.protocol.lines import encode
from talkcli.protocol.requests import Status

if TYPE_CHECKING:
    from collections.abc import Callable

    from talkcli.fleet.bridge.policy import Ask
    from talkcli.goals.goal import By, Goal, JsonObject
    from talkcli.protocol.events import StateChanged

    #: Publishes lines: topic, payload, QoS, correlation.
    Publish = Callable[[str, bytes, int, bytes | None], None]

#: Askers at once; each has a connection to the server, which takes 256 unless it was told otherwise.
MAX_SESSIONS = 32


class Askers:
    """The sessions of a robot's askers."""

    def __init__(
        self, name: str, socket: str | None, publish: Publish, room: Callable[[], int], changed: Callable[[], None]
    ) -> None:
        """`changed` is called where another number of goals is pending."""
        self.name, self.socket = name, socket
        self.publish, self.room = publish, room
        self.boottime, self.now = boottime, time.time
        self.ids, self.share = Ids(), Share()
        self.dialing = asyncio.Semaphore(MAX_SESSIONS)
        self.flowing = asyncio.Event()
        self.flowing.set()
        self.waiting: list[tuple[Ask, Session]] = []
        self._changed = changed
        self._loop = asyncio.get_running_loop()
        self._sessions: dict[tuple[str, str | None], Session] = {}
        self._turn: asyncio.Handle | None = None
        #: who cancelled the goals from here that left the queue last
        self._canceled_by: By | None = None

    # -- from the broker

    def ask(self, ask: Ask) -> None:
        """Carry out a request, in the session that it belongs to."""
        session = self._sessions.get((ask.user, ask.topic)) or self._begin(ask)
        if session:
            session.ask(ask)
        else:
            words = f"{self.name} has as many askers as it takes: {MAX_SESSIONS}"
            self.answer(ask.topic, failure(ask.seq, Busy.code, words), ask.correlation)

    def answer(self, topic: str | None, message: JsonObject, correlation: bytes | None) -> None:
        """Tell an asker something that is no session's, if there is one to be told."""
        if topic is not None:
            self.publish(topic, encode(message), 1, correlation)

    def hang_up(self, user: str, topic: str) -> None:
        """End the session of an asker who says goodbye, once the server has taken what it asked."""
        session = self._sessions.get((user, topic))
        if session:
            session.leave()

    def hang_up_all(self) -> None:
        """End all sessions: nobody can be told anything more."""
        for each in list(self._sessions.values()):
            each.hang_up()
        self.flowing.set()

    def beat(self) -> None:
        """See to the sessions, every few seconds: who is gone, and who has to be told that the robot lives."""
        now = self._loop.time()
        for each in list(self._sessions.values()):
            if now - each.used > IDLE:
                each.hang_up(f"you have said nothing for {IDLE:g} s: whoever waits says hello every 30 s")
            else:
                each.alive()

    def _begin(self, ask: Ask) -> Session | None:
        """Return a new session; None where there is no room, and nobody who makes some.

        To have the robot be silent there is always room, and to find out why it is not.
        """
        if len(self._sessions) >= MAX_SESSIONS:
            sessions = list(self._sessions.values())
            urgent = isinstance(ask.request, Cancel | Status)
            place = [each for each in sessions if each.idle] or (sessions if urgent else [])
            if not place:
                return None
            min(place, key=_used).hang_up("the place was needed for another's cancel or status")
        session = self._sessions[ask.user, ask.topic] = Session(self, ask.user, ask.topic)
        return session

    # -- from the sessions

    def left(self, session: Session) -> None:
        """Forget a session that has ended."""
        self._sessions = {place: each for place, each in self._sessions.items() if each is not session}

    def held(self) -> int:
        """Return how many bytes the requests have that wait for anything."""
        return sum(each.held for each in self._sessions.values()) + sum(ask.size for ask, _ in self.waiting)

    def take_back(self, selection: Cancel, by: By | None) -> list[Goal]:
        """End the goals that wait here and are selected, and return them."""
        says = [ask.request for ask, _ in self.waiting if isinstance(ask.request, Say)]
        chosen = [self.waiting[each] for each in selection.of_waiting(says)]
        self.waiting = [each for each in self.waiting if not any(each is other for other in chosen)]
        return [session.end_waiting(ask, by) for ask, session in chosen]

    def look(self) -> None:
        """Let go, soon, what waits and may go now: all that has come together is heard before."""
        self._changed()
        if self.waiting and self._turn is None:
            self._turn = self._loop.call_soon(self._let_go)

    def _let_go(self) -> None:
        self._turn = None
        canceled_by, self._canceled_by = self._canceled_by, None
        if canceled_by and not self.share.pending:
            # All that were pending from here were cancelled at once: so are those that wait for their places.
            self.take_back(Cancel(), canceled_by)
        while self.waiting:
            ask, session = self.waiting[0]
            if not (isinstance(ask.request, Say) and self.share.has_room(ask.request)):
                break
            del self.waiting[0]
            session.let_go(ask)

    # -- from the watch

    def watched(self, event: StateChanged, boot: str) -> None:
        """Count a goal that is pending now, or no more; `boot`: the server's."""
        goal = event.goal
        if event.state is not State.PENDING:
            counted = self.share.left(event.id)
            if counted and self.waiting and goal and event.state is State.RECALLED and goal.reason == "canceled":
                self._canceled_by = goal.by
        elif self.ids.in_share(event.id, boot):
            self.share.came(event.id, goal.key if goal else None)
        self.look()

    def known(self, goal: Goal, boot: str) -> None:
        """Note a goal that the server knows, if it came by the broker: an earlier bridge may have sent it.

        It counts in the share, even if it preempts: a goal doesn't tell.
        """
        ours = goal.client and (goal.client.name or "").startswith(AFAR)
        if ours and self.ids.boot_of(goal.id) != boot:
            self.ids.note(goal.id, boot)

    def server_came(self, pending: list[Goal], boot: str) -> None:
        """Count what is pending at the server as it begins to be watched."""
        self.share.begin((each.id, each.key) for each in pending if self.ids.in_share(each.id, boot))
        self.look()

    def server_went(self) -> None:
        """Count nothing: the server is gone."""
        self.share.clear()
        self.look()


def _used(session: Session) -> float:
    return session.used
