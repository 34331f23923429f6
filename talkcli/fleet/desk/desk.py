"""A desk's way to the broker: one user's connection, made anew wherever it breaks, until the desk goes home.

Who has one waits in `serve`, and is told by that of what has come. Nothing is kept while the broker is away. Nothing
here knows what is asked of whom.
"""

from __future__ import annotations

import os
import random
import select
import socket
import time
from collections import deque
from typing import TYPE_CHECKING, Protocol

from talkcli.errors import AccessDenied, ServerUnavailable, TalkError
from talkcli.fleet import topics
from talkcli.fleet.broker import user
from talkcli.fleet.link import KEEPALIVE, MANY_AT_ONCE, NOT_AUTHORIZED, REFUSED, TICK, Link, Opening
from talkcli.polling import wait_ready

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from talkcli.fleet.broker import Broker
    from talkcli.fleet.message import Message

#: Seconds after which a broker or a robot that went away counts as gone, and what was waited for as lost: bridges are
#: back within 15 s of their broker, and systemd starts one again after two.
ABSENCE_LIMIT = 30.0
#: Seconds for which what the broker keeps is awaited: some send it a moment after the rest.
GRACE = 0.3
#: Seconds between two tries to reach a broker that went away: any time up to the first, doubled up to the second.
_FIRST_PAUSE, _LONGEST_PAUSE = 0.5, 10.0


class Visitor(Protocol):
    """Whoever has a desk, and is told by it, in `Desk.serve`, of what happens."""

    def came_up(self, link: Link) -> None:
        """Subscribe to what is wanted, on a connection that has just been made."""

    def went_down(self, why: str) -> None:
        """Take note that there is no connection any more."""

    def hear(self, message: Message) -> None:
        """Take what has come."""


class Desk:
    """A connection to the broker that comes back. `serve` is called by one thread at a time, the rest by any."""

    #: who is told; to be there before `serve`
    visitor: Visitor

    def __init__(self, broker: Broker) -> None:
        """UsageError where the user's name can't be in a topic. It connects in `serve`."""
        self.broker, self.user = broker, user(broker)
        #: by which the broker and the bridges tell this desk from others of the user's
        self.session = os.urandom(8).hex()
        #: the connection; None while there is none
        self.link: Link | None = None
        #: why the broker was not to be had, the last time; or what it refuses
        self.failure: TalkError | None = None
        #: when what this desk had sent itself came back on this connection, behind all that the broker keeps
        self.marked_at: float | None = None
        self._inbox: deque[Message] = deque()
        self._opening: Opening | None = None
        self._tries = 0
        self._next_try = self._served_at = time.monotonic()
        # Sockets, and no pipe: where nobody has this any more, they are closed.
        self._wake, self._write = socket.socketpair()
        for each in (self._wake, self._write):
            each.setblocking(False)

    @property
    def told(self) -> bool:
        """Whether the broker has had the time to tell all that it keeps."""
        return self.marked_at is not None and time.monotonic() > self.marked_at + GRACE

    def answers(self, robot: str) -> str:
        """Return the topic on which this desk is answered by a robot."""
        return topics.reply(self.user, self.session, robot)

    def serve(self, timeout: float, interrupt: Mapping[int, int] | None = None) -> bool:
        """Wait so many seconds at most until something happens, tell of it, and return whether something was heard;
        Interrupted as of `connect.ready`.
        """
        link = self.link
        now = time.monotonic()
        if link is not None and (link.ended or now - self._served_at > 2 * KEEPALIVE):
            self._lose(link)
            link = None
        due = self._see_to(link, now)
        wake = self._wake.fileno()
        watched = {wake: select.POLLIN}
        descriptor = -1 if link is None else link.fileno()
        if link is not None and descriptor >= 0:  # another thread may have found out that it has ended
            watched[descriptor] = select.POLLIN | (select.POLLOUT if link.wants_write else 0)
        found = wait_ready(watched, min(timeout, due), interrupt)
        if wake in found:
            self._wake.recv(4096)
        self._served_at = time.monotonic()
        if link is not None and descriptor in found:
            link.read()
        heard = bool(self._inbox)
        while self._inbox:
            message = self._inbox.popleft()
            if message.topic == self.answers(topics.MARKER):
                self.marked_at = time.monotonic()
            else:
                self.visitor.hear(message)
        return heard

    def await_kept(
        self, patience: float, enough: Callable[[], bool] = lambda: True, interrupt: Mapping[int, int] | None = None
    ) -> None:
        """Wait until the broker has told what it keeps, and a moment longer where that is not yet `enough`.

        ServerUnavailable where it does not within `patience` seconds, AccessDenied where it doesn't let this user ask;
        Interrupted as of `serve`.
        """
        end = time.monotonic() + patience
        while not (self.told or (self.marked_at is not None and enough())):
            if self.failure is not None:
                raise self.failure
            left = end - time.monotonic()
            if left <= 0:
                raise self.unanswered(patience)
            self.serve(left, interrupt)

    def wake(self) -> None:
        """Have the thread that waits look around, from any thread."""
        try:
            self._write.send(b"\0")
        except OSError:
            pass  # it is awake, or this is closed

    def flush(self, patience: float) -> None:
        """Wait until the broker has taken what was sent, so many seconds at most."""
        end = time.monotonic() + patience
        while self.link is not None and self.link.outstanding and (left := end - time.monotonic()) > 0:
            self.serve(left)

    def close(self) -> None:
        """End it."""
        if self._opening is not None:
            self._opening.give_up()
        if self.link is not None:
            self.link.close()
        self._close_descriptors()

    def drop(self) -> None:
        """Close this process's copies of the descriptors, as a child does: the connection is its parent's."""
        if self.link is not None:
            self.link.drop()
        self._close_descriptors()

    def refused(self, code: int, what: str) -> TalkError:
        """Return the error for a reason of the broker's for which it has taken nothing; `what`: what it was to let."""
        if code == NOT_AUTHORIZED:
            return self.forbidden(what)
        return ServerUnavailable(f"nothing was sent: the broker at {self.broker.url} refuses it, reason 0x{code:02x}")

    def forbidden(self, what: str) -> AccessDenied:
        """Return the error for what the broker's rules don't let this user do."""
        words = f"the broker at {self.broker.url} does not let '{self.user}' {what}"
        return AccessDenied(f"{words}: its ACL needs the lines of an operator, see 'talk bridge --print-acl'")

    def unanswered(self, patience: float) -> TalkError:
        """Return what is wrong where the broker has told nothing in so many seconds."""
        if self.link is None or self.marked_at is not None:
            return ServerUnavailable(f"the broker at {self.broker.url} does not answer within {patience:g} s")
        return self.forbidden(f"read {topics.reply(self.user, '+', '+')}")

    def _see_to(self, link: Link | None, now: float) -> float:
        """Do what is due without anybody's word, and return the seconds until more is."""
        if link is None:
            opening = self._opening
            if opening is None and now >= self._next_try:
                self._opening = Opening(self._new_link(), self.wake)
            elif opening is not None and opening.done:
                self._opened(opening)
                return 0.0
            return TICK if self._opening else max(0.0, self._next_try - now)
        link.tick()
        return TICK if self.marked_at is None or self.told else self.marked_at + GRACE - now

    def _new_link(self) -> Link:
        name = f"talk-desk-{self.user}-{self.session}"
        return Link(self.broker, name, self._inbox.append, at_once=MANY_AT_ONCE)  # a thousand robots may answer at once

    def _opened(self, opening: Opening) -> None:
        """Take over the connection to the broker, or try again after a while."""
        self._opening = None
        if opening.error is not None:
            self._tries += 1
            longest = min(_LONGEST_PAUSE, _FIRST_PAUSE * 2**self._tries)
            self._next_try = time.monotonic() + random.uniform(0, longest)
            self.failure = opening.error
            self.visitor.went_down(str(opening.error))
            return
        link, self._tries, self._served_at = opening.link, 0, time.monotonic()
        self.link = link
        self._inbox.clear()
        link.subscribe(self.answers(topics.MARKER), retained=False)
        self.visitor.came_up(link)
        # It comes back behind all that the broker keeps.
        link.publish(self.answers(topics.MARKER), b"\n", acknowledged=self._marker_taken)

    def _marker_taken(self, code: int) -> None:
        if code >= REFUSED:
            self.failure = self.refused(code, f"write to {topics.reply(self.user, '+', '+')}")

    def _lose(self, link: Link) -> None:
        link.close()
        self.link, self.marked_at = None, None
        self._next_try = time.monotonic() + random.uniform(0, _FIRST_PAUSE)
        self.visitor.went_down(f"the broker at {self.broker.url} went away")

    def _close_descriptors(self) -> None:
        self._wake.close()
        self._write.close()
