"""A connection to one robot's server, through the broker and the robot's bridge.

The robot keeps speaking while its bridge or the broker is away, and the connection survives such an absence. When the
robot is back, open requests are sent again, except those that could take effect twice. For each goal, the robot is
first asked whether it knows the id. The goal is sent again only if it doesn't. The goal's listeners receive its current
state.
"""

from __future__ import annotations

import math
import os
import time
from collections import deque
from typing import TYPE_CHECKING, Any

from talkcli.client.connect import ANSWER_LIMIT_S
from talkcli.client.connection import Connection, checked_sender_name
from talkcli.client.core import Exchange, ServerInfo
from talkcli.errors import (
    AccessDenied,
    BadRequest,
    Lost,
    ProtocolMismatch,
    ServerUnavailable,
    TalkError,
    UnknownGoal,
    UsageError,
)
from talkcli.fleet import topics
from talkcli.fleet.desk.link import ABSENCE_LIMIT_S, DeskLink
from talkcli.fleet.desk.request import NoServer, RobotOffline
from talkcli.fleet.link import Link, boottime
from talkcli.frozen import replace
from talkcli.goals.options import Append, Cancel, Pause, Say, Set
from talkcli.protocol.events import check_greeting
from talkcli.protocol.lines import decode
from talkcli.protocol.requests import Hello, Request, Resume, Wait
from talkcli.terminal.text import printable

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping

    from typing_extensions import Self

    from talkcli.fleet.broker import Broker
    from talkcli.fleet.payloads import Message
    from talkcli.goals.goal import JsonObject

#: How often to send a message that keeps the bridge's session alive. The bridge ends a session after 90 s of silence.
_KEEP_ALIVE_INTERVAL_S = 30.0
#: If the last token is older than this, the desk requests a new one before it sends a `say`. The robot accepts a token
#: for 6 s, so the message has at least 3 s left to arrive.
_FRESH_TOKEN_S = 3.0
#: How many times a request may be sent again. The limit matters if the request itself breaks the connection.
_MAX_RESENDS = 5
#: The pause between two attempts to connect, if `keep_trying_s` is set.
_CONNECT_PAUSE_S = 0.25
#: A new goal id begins with this many characters of the user name. An id has at most 64 characters.
_ID_USER_CHARS = 48
#: How many goals to look up at the same time after an absence. A bridge accepts 64 open requests from each client.
_MAX_OPEN_LOOKUPS = 32


class RobotExchange(Exchange):
    """A request to a robot, and the robot's answer.

    The request stays open while the robot is absent.
    """

    #: how many times the request has been sent again
    resends = 0
    #: when the sentence expires (by the `boottime` clock), or None if it never does
    expires_at: float | None = None


class RobotConnection(Connection):
    """A connection to a robot's server through the broker.

    A thread is used only while connecting to the broker.
    """

    lasting = (Say, Cancel, Set, Pause, Resume)
    exchange_type = RobotExchange

    def __init__(
        self,
        robot: str,
        desk: DeskLink,
        *,
        name: str | None = None,
        interrupt: Mapping[int, int] | None = None,
        patience_s: float = ANSWER_LIMIT_S,
        end: float | None = None,
        numbers: Iterator[int] | None = None,
    ) -> None:
        """Prepare a connection. Requests are queued until the robot is online.

        Args:
            robot: the name of the robot.
            desk: the connection to the broker. Its handler must pass the robot's messages to `on_message`.
            name: the name of the sender. The default is TALK_NAME.
            interrupt: file descriptors that interrupt any wait, as in `wait_ready`.
            patience_s: the time in seconds within which the server must answer.
            end: the time limit for all answers (monotonic time), even if the robot is absent, or None for no limit.
            numbers: an iterator of request numbers, if several connections share one.

        Raises:
            UsageError: The name of the robot or the sender is not allowed.
        """
        super().__init__(patience_s)
        if fault := topics.name_fault(robot):
            raise UsageError(f"invalid robot name '{printable(robot)}': it {fault}")
        self._sender = checked_sender_name(name)
        self.robot, self._desk = robot, desk
        self._numbers = numbers or self._numbers
        self.path = f"{robot} ({desk.broker.url})"
        self._interrupt, self._end = interrupt, end
        self._published_at = time.monotonic()
        #: the robot's presence; empty until it arrives on the current connection to the broker
        self._presence: JsonObject = {}
        #: the session id of the bridge that received the open requests, or None if there is no such bridge
        self._bridge_session: object = None
        #: when the robot became absent (monotonic time), or None if requests can be sent
        self.absent_since = self._published_at
        #: the class of the error to raise while the robot is absent
        self._absence_error: type[ServerUnavailable] = ServerUnavailable
        #: the ids of cancelled goals, which are cancelled again after each absence
        self._canceled: set[str] = set()
        #: queued lookups of goals, which are sent when earlier ones have been answered
        self._lookups: deque[Exchange] = deque()
        #: the robot's latest token, and when it was requested (by the `boottime` clock); None if there is none
        self._token: tuple[str, float] | None = None
        #: the token in the message that is being processed
        self._received_token: str | None = None
        #: requests to send, in this order, once the robot has sent a token
        self._awaiting_token: deque[Exchange] = deque()
        #: the request for a token that hasn't been answered yet
        self._token_request: Exchange | None = None

    @classmethod
    async def open(cls, robot: str, broker: Broker, *, keep_trying_s: float = 0.0, **options: Any) -> Self:
        """Connect to a robot's server through the broker. Return the connection.

        Args:
            robot: the name of the robot.
            broker: the broker that the robot's bridge uses.
            keep_trying_s: how long to keep trying in seconds if the broker can't be reached or the robot is offline.
            options: other arguments of `RobotConnection`.

        Raises:
            ServerUnavailable: The broker can't be reached, or the robot is unknown, offline or without a server.
            AccessDenied: The broker rejected the login, or its certificate is not trusted.
            UsageError: The name of the robot or the sender is not allowed.
        """
        give_up_at = time.monotonic() + keep_trying_s
        while True:
            desk = DeskLink(broker, cls.wait)
            try:
                desk.handler = connection = cls(robot, desk, **options)
                await connection.wait_online(give_up_at)
                return connection
            except BaseException as error:
                desk.close()
                left = give_up_at - time.monotonic()
                if not isinstance(error, ServerUnavailable) or left <= 0:
                    raise
            await cls.wait({}, min(_CONNECT_PAUSE_S, left), options.get("interrupt"))

    # -- requests

    def _send(self, exchange: Exchange) -> None:
        """Send a request now, or once the robot is back. A goal is given an id and an expiry time."""
        request = exchange.request
        if isinstance(request, Say) and isinstance(exchange, RobotExchange):
            exchange.request = replace(request, id=request.id or self.new_goal_id())
            exchange.expires_at = boottime() + request.ttl if request.ttl else None
        if not self._publish(exchange):
            self._desk.wake()  # The request will be sent when the robot is back.

    def new_goal_id(self) -> str:
        """Return a new random id for a goal that this client sends."""
        return new_goal_id(self._desk)

    def expect_reply(self, exchange: RobotExchange) -> None:
        """Expect the robot's answer to a request that was sent to its group."""
        exchange.sent = True
        self._published_at = time.monotonic()
        self.register(exchange, self._published_at)

    def cancel_after_absence(self, goal_id: str, *, also_now: bool) -> None:
        """Cancel a goal whenever the robot comes back, and also now if `also_now` is true."""
        with self.changed:
            self._canceled.add(goal_id)
            if also_now:
                self._send_without_answer(Cancel((goal_id,)))

    def _send_without_answer(self, request: Request) -> bool:
        """Send a request, and ignore its answer. Return whether it could be sent."""
        exchange = RobotExchange(request)
        exchange.number = next(self._numbers)
        return self._publish(exchange)

    def _publish(self, exchange: Exchange) -> bool:
        """Send a request now, or queue it until a new token arrives. Return whether it was sent.

        If the robot is absent, do nothing. If a `say` needs a new token, the requests after it wait, too, so that they
        arrive in order.
        """
        if self.ended is not None or self.absent_since is not None:
            return False
        if not (self._awaiting_token or self._needs_token(exchange.request)):
            return self._send_now(exchange)
        self._awaiting_token.append(exchange)
        if self._token_request is None:
            self._request_token()
        return False

    def _send_now(self, exchange: Exchange) -> bool:
        """Send a request with the robot's latest token, if any. Return whether it was sent."""

        def on_refused(error: TalkError) -> None:
            with self.changed:
                self.fail(exchange, error)

        token = self._token[0] if self._token and isinstance(exchange.request, Say) else None
        if not self._desk.send(exchange.request, exchange.number, self.robot, on_refused, token=token):
            return False
        self._published_at = time.monotonic()
        exchange.sent = True
        return True

    # -- tokens

    @property
    def awaits_token(self) -> bool:
        """Whether requests are waiting for a token from the robot."""
        return self._token_request is not None

    def _needs_token(self, request: Request) -> bool:
        """Return whether a new token must be requested before a request can be sent."""
        if not isinstance(request, Say) or self._presence.get("tokens") is not True:
            return False
        return self._token is None or boottime() - self._token[1] > _FRESH_TOKEN_S

    def _request_token(self) -> None:
        """Request a token from the robot. When it arrives, send the requests that wait for it."""
        requested_at = boottime()

        def on_reply(_reply: JsonObject, _items: list[JsonObject]) -> None:
            self._token = (self._received_token, requested_at) if self._received_token else None
            self._send_waiting(None)

        self._token_request = Exchange(Hello(self._sender), on_reply, self._send_waiting)
        self.register(self._token_request, time.monotonic())
        self._send_now(self._token_request)

    def _send_waiting(self, error: TalkError | None) -> None:
        """Send all requests that waited for a token. After an error, fail the `say` requests instead.

        `error` says why no token has arrived. It is None if one has.
        """
        while self._awaiting_token:
            exchange = self._awaiting_token.popleft()
            request = exchange.request
            exchange.heard_at = time.monotonic()
            if error and isinstance(request, Say):
                self.fail(exchange, error)
            elif isinstance(exchange, RobotExchange) and isinstance(request, Say) and request.ttl:
                left = (exchange.expires_at or 0.0) - boottime()
                # Round up, so that a typical ttl stays the same unless the token was late.
                exchange.request = replace(request, ttl=min(request.ttl, math.ceil(left * 10) / 10))
                if left > 0:
                    self._send_now(exchange)
                else:
                    self.fail(exchange, self.unanswered(exchange))
            else:
                self._send_now(exchange)
        self._token_request = None

    def forget(self, exchange: Exchange) -> bool:
        """Drop an exchange, even if it is still waiting for a token.

        The result is that of `ClientCore.forget`.
        """
        if exchange in self._awaiting_token:
            self._awaiting_token.remove(exchange)
        return super().forget(exchange)

    # -- time limits

    def answer_deadline(self, exchange: Exchange) -> float:
        """Return the time at which an exchange fails if its robot stays silent or absent."""
        if not isinstance(exchange, RobotExchange):
            return float("inf")  # A lookup needs no time limit, because a new one is sent after each absence.
        if self.absent_since is None:
            by = super().answer_deadline(exchange)
        else:
            by = self.absent_since + (ABSENCE_LIMIT_S if self._patience >= ANSWER_LIMIT_S else self._patience)
        return by if self._end is None else min(by, max(self._end, exchange.heard_at))

    def goals_lost_at(self) -> float:
        """Return infinity, because followed goals are only lost when the whole connection ends."""
        return float("inf")

    def silence_deadline(self, waiting_since: float) -> tuple[float, str]:
        """Return the time at which a silent or absent robot counts as lost, and the error message."""
        if self.absent_since is None:
            return super().silence_deadline(waiting_since)
        return self.absent_since + ABSENCE_LIMIT_S, f"{self.absence} (for {ABSENCE_LIMIT_S:g} s)"

    def unsupported(self, request: Request) -> TalkError | None:
        """Return an error if the robot's server lacks a feature that a request needs.

        Return None if the server's features are unknown.
        """
        error = super().unsupported(request)
        return ProtocolMismatch(f"{self.robot}: {error.message}") if error else None

    def refusal(self, reply: JsonObject, items: list[JsonObject]) -> TalkError:
        """Return the error for a refused request. The bridge's own errors have more specific classes."""
        error = super().refusal(reply, items)
        kinds = {"not_allowed": AccessDenied, "no_server": NoServer, "stale": ServerUnavailable, "lost": Lost}
        kind = kinds.get(error.code)
        return kind(f"{self.robot}: {error.message}") if kind else error

    # -- messages from the robot

    def prepare(self, now: float) -> tuple[dict[int, int], float]:
        """Keep the bridge's session alive. Return the descriptors to wait for, and when to call `process`."""
        self.keep_alive()
        return self._desk.prepare(now)

    def process(self, ready: Collection[int]) -> None:
        """Receive messages from the broker, and pass them to `on_message`."""
        self._desk.process(ready)

    def keep_alive(self) -> None:
        """Send a message to keep the bridge's session alive, unless another was sent recently."""
        if time.monotonic() - self._published_at > _KEEP_ALIVE_INTERVAL_S:
            self._send_without_answer(Hello(self._sender))

    def on_connected(self, link: Link) -> None:
        """Subscribe to the robot's replies and its presence."""
        link.subscribe(self._desk.reply_topic(self.robot), retained=False)
        link.subscribe(topics.robot(self.robot, topics.PRESENCE), retained=True)

    def on_disconnected(self, why: str) -> None:
        """Treat the robot as absent until its presence arrives again."""
        with self.changed:
            self.begin_stream()
            self._presence, self._bridge_session = {}, None
            self._mark_absent(why)

    def on_message(self, message: Message) -> None:
        """Update the robot's presence from a message, or pass on lines from its server."""
        with self.changed:
            if message.topic == topics.robot(self.robot, topics.PRESENCE):
                self._update_presence(message.payload)
            else:
                self._received_token = message.token
                self.receive(message.payload, time.monotonic())

    def _mark_absent(self, why: str, error: type[ServerUnavailable] = ServerUnavailable) -> None:
        """Mark the robot as absent. Store the reason and the class of the error to raise."""
        self.absence, self._absence_error = why, error
        if self.absent_since is None:
            self.absent_since = time.monotonic()

    def _update_presence(self, payload: bytes) -> None:
        """Store a robot's presence, and send open requests again if the robot is back.

        The message comes from the robot's bridge, or from the broker if the bridge has lost its connection.
        """
        try:
            presence = decode(payload.strip())
        except BadRequest:
            return  # The retained message has been deleted.
        self._presence = presence
        server = presence.get("server")
        if presence.get("online") is not True:
            self._mark_absent(f"{self.robot} is offline", RobotOffline)
        elif not isinstance(server, dict):
            self._mark_absent(f"{self.robot} has no running talk server", NoServer)
        elif self._bridge_session != presence.get("session") or self.absent_since is not None:
            self.server = ServerInfo.read(server)
            self._bridge_session = presence.get("session")
            self.absent_since, self._heard = None, time.monotonic()
            self._resume_requests()

    # -- connecting

    async def wait_online(self, give_up_at: float) -> None:
        """Wait until the robot can receive requests. Raise an error if it can't by `give_up_at`.

        `give_up_at` is a monotonic time. The errors are the same as those of `open`.
        """
        left = self._patience if self._end is None else max(0.0, self._end - time.monotonic())
        await self._desk.wait_for_retained(min(self._patience, left), lambda: bool(self._presence), self._interrupt)
        while self.absent_since is not None and self._desk.link and (left := give_up_at - time.monotonic()) > 0:
            await self._desk.poll(left, self._interrupt)
        self._patience = max(self._patience, round(give_up_at - time.monotonic(), 1))
        if not self._presence:
            words = f"no robot '{self.robot}' is known at {self._desk.broker.url}, so nothing was sent"
            raise ServerUnavailable(f"{words}; on the robot, run: talk bridge --name {self.robot}")
        self.check_online()

    def check_online(self) -> None:
        """Raise ServerUnavailable or ProtocolMismatch if the robot can't receive requests now."""
        check_greeting(self._presence)
        if self.absent_since is not None:
            raise self._absence_error(f"{self.absence}, so nothing was sent")

    # -- after an absence

    def _resume_requests(self) -> None:
        """Resume open requests after an absence. Resend them, look up their goals, or report failure."""
        now = time.monotonic()
        self._token = self._token_request = None
        self._awaiting_token.clear()
        if self._sender:
            self._send_without_answer(Hello(self._sender))
        if self._canceled:
            self._send_without_answer(Cancel(tuple(self._canceled)))
        begun = [each.request for each in self.exchanges.values() if each.sent]
        begun_ids = [str(each.id) for each in begun if isinstance(each, Say) and each.more]
        for goal_id in self.listeners.growing + begun_ids:
            self._send_without_answer(Append(goal_id))  # Without this request, the text would break off.
        self._lookups.clear()
        interrupted = [each for each in self.exchanges.values() if isinstance(each, RobotExchange)]
        self.exchanges = {each.number: each for each in interrupted}
        for goal_id, feedback in self.listeners.goals.items():
            self._follow_again(goal_id, feedback=feedback, now=now)
        for exchange in interrupted:
            if exchange.sent and isinstance(exchange.request, Say):
                self._look_up_goal(exchange, exchange.request, now)
            elif exchange.sent and isinstance(exchange.request, self.lasting):
                # The robot may already have carried out this request. A repeated request could affect newer goals.
                self.fail(exchange, self._lost_error(exchange, self.absence))
            else:
                self._resend(exchange)
        if self.listeners.watches:
            self._watch_again(now)

    def _resend(self, exchange: RobotExchange) -> None:
        """Send a request again. Report failure if it has expired or was sent too often."""
        if exchange.number not in self.exchanges:
            return  # The caller has stopped waiting for the answer.
        request = exchange.request
        if error := self.unsupported(request):
            self.fail(exchange, error)
            return
        left = 0.0 if exchange.expires_at is None else exchange.expires_at - boottime()
        exchange.resends += 1
        why = "its ttl was over before an answer came" if left < 0 else f"{self.absence} ({_MAX_RESENDS} times)"
        if isinstance(request, Say) and request.id in self._canceled:
            left, why = -1.0, "it was cancelled before the robot received it"
        if left < 0 or exchange.resends > _MAX_RESENDS:
            self.fail(exchange, self._lost_error(exchange, why))
            return
        if isinstance(request, Say) and left:
            exchange.request = replace(request, ttl=left)
        exchange.items.clear()
        exchange.heard_at = time.monotonic()
        self._publish(exchange)

    def _lost_error(self, exchange: Exchange, why: str) -> Lost:
        """Return the error for a request that was sent but not answered.

        `why` says why the answer is missing.
        """
        words = f"the {exchange.request.kind} request was sent to {self.path}, but {why}"
        return Lost(f"{words}; it may have been carried out")

    def _look_up_goal(self, exchange: RobotExchange, request: Say, now: float) -> None:
        """Ask the robot whether it has accepted a goal, and send the goal again if it hasn't."""

        def on_reply(_: JsonObject, items: list[JsonObject]) -> None:
            for each in items:
                if not exchange.over:
                    self._finish(exchange, {"ok": True, "goal": each.get("goal")})

        def on_failure(error: TalkError) -> None:
            if isinstance(error, UnknownGoal):
                self._resend(exchange)
            elif self.absent_since is None:
                words = f"the result of {request.id} is unknown, and it may still be spoken: {error.message}"
                self.fail(exchange, Lost(words))

        exchange.heard_at = now
        self._queue_exchange(Exchange(Wait((str(request.id),), request.feedback), on_reply, on_failure), now)

    def _queue_exchange(self, exchange: Exchange, now: float) -> None:
        """Queue a lookup of goals, and send it now unless too many lookups are unanswered."""
        self._lookups.append(exchange)
        self._send_lookups(now)

    def _send_lookups(self, now: float) -> None:
        """Send queued lookups until the maximum number of lookups is open."""
        open_count = sum(not isinstance(each, RobotExchange) for each in self.exchanges.values())
        for _ in range(min(len(self._lookups), _MAX_OPEN_LOOKUPS - open_count)):
            exchange = self._lookups.popleft()
            self.register(exchange, now)
            self._publish(exchange)

    def dispatch(self, message: JsonObject, now: float) -> Exchange | None:
        """Pass a message to its exchange or to the listeners. Return the exchange that it ends, if any.

        The message `gone` of the bridge ends the connection.
        """
        if message.get("event") == "gone":
            self.end(printable(str(message.get("message") or "the connection to the server was lost")))
            return None
        exchange = super().dispatch(message, now)
        if exchange is not None and not isinstance(exchange, RobotExchange):
            self._send_lookups(now)
        return exchange

    # -- closing

    def end_session(self) -> None:
        """Tell the robot's bridge that no more requests will follow."""
        if self._bridge_session is not None:
            self._desk.end_session(self.robot)

    def _hang_up(self) -> None:
        """End the bridge's session, and wake the thread that is waiting in `poll`."""
        self.end_session()
        self._desk.wake()

    def _drop(self) -> None:
        """Close the connection to the broker. In a forked child, only close the child's descriptors."""
        self._desk.close(forked=os.getpid() != self._process)


def new_goal_id(desk: DeskLink) -> str:
    """Return a new random goal id, which begins with the user's name.

    The colon sets it apart from servers' ids.
    """
    return f"{desk.user[:_ID_USER_CHARS]}:{os.urandom(5).hex()}"
