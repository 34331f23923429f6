"""Pause and resume: what they do, and who is answered when what is held is silent."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from talkcli.goals.goal import By
from talkcli.goals.states import State
from talkcli.protocol import replies
from talkcli.server import log

if TYPE_CHECKING:
    from talkcli.goals.record import Record
    from talkcli.protocol.requests import Pause, Resume
    from talkcli.server.connection import Connection
    from talkcli.server.service import Service

#: Seconds after which a pause is answered though nobody knows that it is silent.
PAUSE_LIMIT = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class _Awaited:
    """A pause that is answered when the goal that it holds is silent, or in doubt after a while."""

    connection: Connection
    seq: int | None
    record: Record


class Pauses:
    """Answers the pauses and resumes of a service's clients."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._scheduler = service.scheduler
        self._awaited: list[_Awaited] = []
        #: the goal that is known to be held and silent
        self._silent: str | None = None

    def left(self, connection: Connection) -> None:
        """Owe a connection that is gone nothing more."""
        self._awaited = [each for each in self._awaited if each.connection is not connection]

    def ended(self, record: Record) -> None:
        """Answer those who wait for this goal to be silent: it has ended."""
        if record.id == self._silent:
            self._silent = None
        self._answer(record)

    def silent(self, goal_id: str, pause: int) -> None:
        """Answer those who wait for the active goal to be silent in this pause of it."""
        active = self._scheduler.active
        if active is not None and active.id == goal_id and active.paused and active.holds == pause:
            self._silent = goal_id
            self._answer(active)

    def pause(self, connection: Connection, seq: int | None, _: Pause) -> None:
        """Hold what is being spoken, and start nothing; answered when it is silent."""
        self._service.now()
        newly = not self._scheduler.paused
        effects = self._scheduler.pause()
        active = self._scheduler.active
        if newly:
            self._tell(connection, active if active and active.paused else None)
        self._service.apply(effects)
        if active is None or active.id == self._silent:
            self._report(connection, seq, active)
            return
        connection.owed += 1
        awaited = _Awaited(connection, seq, active)
        self._awaited.append(awaited)
        self._service.call_later(PAUSE_LIMIT, lambda: self._doubt(awaited))

    def resume(self, connection: Connection, seq: int | None, _: Resume) -> None:
        """Go on with what is held, or start what waits."""
        now = self._service.now()
        newly, active = self._scheduler.paused, self._scheduler.active
        if active and active.state is not State.ACTIVE:
            active = None  # it is being stopped
        self._silent = None
        effects = self._scheduler.resume(now)
        if newly:
            self._tell(connection, active)
        self._service.apply(effects)
        if active:
            self._answer(active)  # they will not see it silent any more
        self._report(connection, seq, active)

    def _tell(self, connection: Connection, held: Record | None) -> None:
        """Publish and log that speech is paused, or not any more."""
        paused, by = self._scheduler.paused, By(client=connection.sender)
        self._service.subscribers.paused(held.id if held else None, paused=paused, by=by, at=time.time())
        log.line(f"{'paused' if paused else 'resumed'} by {log.who(connection.sender)}")

    def _answer(self, record: Record) -> None:
        due = [each for each in self._awaited if each.record is record]
        self._awaited = [each for each in self._awaited if each.record is not record]
        for each in due:
            self._report(each.connection, each.seq, record)
            each.connection.settle()

    def _doubt(self, awaited: _Awaited) -> None:
        """Answer a pause whose goal was not known to be silent in time."""
        if awaited not in self._awaited:
            return
        self._awaited.remove(awaited)
        words = f"speech is paused, but {awaited.record.id} was not known to be silent within {PAUSE_LIMIT:g} s"
        awaited.connection.reply(replies.failure(awaited.seq, "not_silent", words))
        awaited.connection.settle()

    def _report(self, connection: Connection, seq: int | None, goal: Record | None) -> None:
        told = None if goal is None or goal.state.terminal else goal.snapshot().to_json()
        connection.reply(replies.ok(seq, paused=self._scheduler.paused, goal=told))
