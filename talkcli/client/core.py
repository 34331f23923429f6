"""The client's side of the protocol, without I/O.

`ClientCore` turns requests into bytes, and received bytes into replies and events. A transport is a shell around it,
which connects, and has the lock or the event loop. The duties of a transport are:

- Send the bytes that `outgoing()` returns, and report with `mark_sent()` how many were accepted.
- Pass received bytes to `receive()`.
- Call `expire()` at the time that `next_expiry()` returns, or earlier.
- Call `end()` when the connection has ended for good, or `disconnected()` if it is going to reconnect.

Rules for this file: no socket, thread, lock, asyncio or clock. Times are seconds of a monotonic clock, and are passed
as arguments. The caller must make sure that only one thread at a time calls a method.
"""

from __future__ import annotations

import itertools
from _weakrefset import WeakSet  # importing `weakref` would take longer
from collections import deque
from collections.abc import Callable

from talkcli.errors import (
    AccessDenied,
    BadRequest,
    Lost,
    ProtocolMismatch,
    ServerUnavailable,
    TalkError,
    Unreadable,
    refusal,
)
from talkcli.frozen import TYPE_CHECKING, frozen, replace
from talkcli.goals.goal import Goal, read_fields
from talkcli.goals.options import Append, Pause, Say
from talkcli.goals.states import State
from talkcli.protocol import events
from talkcli.protocol.events import PausedChanged, Result, ServerStatus, Snapshot, StateChanged, WordHeard, goals
from talkcli.protocol.features import FEATURES, missing_features
from talkcli.protocol.lines import FIRST_SEQ, LineSplitter, decode, request_line, request_to_json
from talkcli.protocol.requests import Wait, Watch

if TYPE_CHECKING:
    from collections.abc import Iterator

    from talkcli.goals.goal import JsonObject
    from talkcli.protocol.events import Event
    from talkcli.protocol.requests import Request

#: A callback that receives the reply to a request, and the list items before the reply.
OnReply = Callable[["JsonObject", "list[JsonObject]"], None]
#: A callback that receives the error if a request was refused, not sent, or not answered.
OnFailure = Callable[["TalkError"], None]

#: How long the server may be silent before the connection is treated as broken. A working server sends waiting clients
#: a message at least every 5 s.
SILENCE_LIMIT_S = 15.0
#: Maximum size of the requests that are waiting to be sent.
MAX_UNSENT_BYTES = 256 * 1024
#: The minimum TTL in a request, because 0 would mean no limit.
MIN_TTL_S = 0.01
#: Maximum number of buffered words, pauses and additions to texts. If there are more, the oldest are dropped. This is
#: enough for 10,000 characters, which have at most 5,000 words.
MAX_FEEDBACK_EVENTS = 5_000
#: Maximum number of buffered state changes, which is enough for about 3,000 goals. If there are more, the reader's
#: stream ends.
MAX_STATE_EVENTS = 10_000


class EventBuffer:
    """A bounded queue of events for one reader."""

    def __init__(self, *, reconnects: bool = False) -> None:
        # Two queues of numbered events make it fast to drop the oldest feedback.
        self._states: deque[tuple[int, Event]] = deque()
        self._feedback: deque[tuple[int, Event]] = deque(maxlen=MAX_FEEDBACK_EVENTS)
        self._count = 0
        self._last_number: int | None = None
        #: why the buffer was closed, or None while it is open
        self.closed: str | None = None
        #: whether to keep the buffer after reconnecting
        self.reconnects = reconnects

    def add(self, event: Event) -> None:
        """Add a new event, or close the buffer if too many state changes are unread.

        Duplicates are ignored, and a closed buffer ignores all events. A connection that waits for a goal and also
        watches all goals receives each state twice.
        """
        number = getattr(event, "n", None)
        if number is not None and number == self._last_number:
            return
        self._last_number = number
        if self.closed is not None:
            return
        self._count += 1
        if isinstance(event, WordHeard | events.TextAdded | events.TextMissing | PausedChanged):
            self._feedback.append((self._count, event))
        elif len(self._states) < MAX_STATE_EVENTS:
            self._states.append((self._count, event))
        else:
            self.closed = f"events were read too slowly (more than {MAX_STATE_EVENTS:,} were waiting); watch again"

    def __len__(self) -> int:
        return len(self._states) + len(self._feedback)

    def take(self) -> Event | None:
        """Remove and return the oldest event. Return None if the buffer is empty."""
        queues = [each for each in (self._states, self._feedback) if each]
        return min(queues, key=lambda each: each[0][0]).popleft()[1] if queues else None


class EventListeners:
    """The receivers of a connection's events."""

    def __init__(self) -> None:
        #: the followed goals, by id. A goal can be followed several times.
        self._goals: dict[str, set[TrackedGoal]] = {}
        #: the buffers of the readers that watch all goals. A reader stops watching by dropping its buffer.
        self.watches: WeakSet[EventBuffer] = WeakSet()

    def add(self, tracked_goal: TrackedGoal) -> None:
        """Start passing a goal's events, and all pause events, to `tracked_goal`.

        This ends when the goal has ended or is lost.
        """
        self._goals.setdefault(tracked_goal.goal.id, set()).add(tracked_goal)

    @property
    def goals(self) -> dict[str, bool]:
        """The ids of the followed goals, with True for goals whose words are needed."""
        return {goal_id: any(each._with_feedback for each in some) for goal_id, some in self._goals.items()}

    @property
    def growing(self) -> list[str]:
        """The ids of the followed goals to which this client adds text."""
        return [goal_id for goal_id, some in self._goals.items() if any(each._adds_text for each in some)]

    def lose(self, goal_id: str, why: str) -> None:
        """End a followed goal as LOST, and stop following it.

        `why` is a human-readable reason.
        """
        for tracked in self._goals.pop(goal_id, set()):
            tracked._mark_lost(why)

    def update(self, goal: Goal) -> None:
        """Pass a goal's current state to all objects that follow the goal."""
        for tracked in self._goals.get(goal.id, set()):
            tracked._hear(goal)

    def end_watches(self, why: str, *, include_reconnecting: bool) -> None:
        """Close the buffers of the readers that watch all goals.

        Args:
            why: a human-readable reason.
            include_reconnecting: whether to also close buffers that are still used after reconnecting.
        """
        for buffer in list(self.watches):
            if include_reconnecting or not buffer.reconnects:
                buffer.closed = buffer.closed or why
                self.watches.discard(buffer)

    def publish(self, event: Event | None) -> None:
        """Pass an event to its receivers. After a Result, stop following its goal.

        Events of an unknown kind are None, and are ignored.
        """
        if isinstance(event, Result):
            for tracked in self._goals.pop(event.goal.id, set()):
                tracked._update(event.goal)
            return
        if isinstance(event, StateChanged | WordHeard | events.TextMissing | events.GoalInterrupted | PausedChanged):
            for goal_id in self._goals if isinstance(event, PausedChanged) else [event.id]:
                for tracked in self._goals.get(goal_id, set()):
                    tracked._hear(event)
            state = event.state if isinstance(event, StateChanged) and not event.goal else None
            if state is State.PENDING or (state and state.terminal):
                return  # clients that watch all goals receive this event again, with the whole goal
        elif event is None:
            return
        for buffer in self.watches:
            buffer.add(event)


class TrackedGoal:
    """A client's record of a goal, with a buffer for the goal's events."""

    def __init__(self, goal: Goal) -> None:
        #: the goal's last known state
        self.goal = goal
        #: whether a goal with this id had already been sent. In this case, the text isn't spoken again.
        self.attached = False
        #: whether all speech is paused, as far as the client knows
        self.speech_paused = False
        #: the fields of the server's reply that describe the pause, if speech was paused
        self.pause: JsonObject = {}
        #: whether this client still adds text to the goal
        self._adds_text = False
        #: monotonic time at which the server began to send the goal's events, or None
        self._followed_at: float | None = None
        #: whether to buffer words and pauses, too
        self._with_feedback = False
        self._buffer = EventBuffer()

    def _set_request(self, request: Say, sent_at: float) -> None:
        """Set the goal's id and text from a `say` request, before the server answers."""
        self.goal = replace(self.goal, id=request.id or "", text=request.text)
        if request.wait:
            self._followed_at = sent_at

    def _accept(self, reply: JsonObject) -> None:
        """Update the goal from the server's reply to `say`."""
        self.goal = Goal.from_json(reply.get("goal"))
        self.attached = reply.get("attached") is True
        self.speech_paused = reply.get("paused") is True
        self.pause = {name: value for name, value in reply.items() if name.startswith("paused")}
        self._adds_text = self.goal.more

    def _listen_to(self, listeners: EventListeners, *, feedback: bool, followed_at: float) -> None:
        """Register with `listeners` to receive the goal's events, unless the goal has ended."""
        self._with_feedback = self._with_feedback or feedback
        if self._followed_at is None:
            self._followed_at = followed_at
        if not self.goal.state.terminal:
            listeners.add(self)

    def _grow(self, addition: Append) -> None:
        """Record text that the server has added to the goal, unless the goal has ended.

        After reconnecting, the goal may already have this text. The Result has the whole text.
        """
        self._adds_text = not addition.end
        text = (self.goal.text or "")[: addition.at] + addition.text
        self._update(replace(self.goal, text=text, more=self._adds_text))

    def _fail(self, error: TalkError) -> None:
        """End the goal as LOST or REJECTED after a failed `say` request."""
        from talkcli.goals.reasons import Reason  # this import is slow and rarely needed

        if isinstance(error, Lost):
            self._mark_lost(error.message)
        else:
            reason = Reason.NOT_SENT.value if isinstance(error, ServerUnavailable) else error.code
            message = f"not spoken: {error.message}"
            self._update(replace(self.goal, state=State.REJECTED, reason=reason, message=message))

    def _mark_lost(self, why: str) -> None:
        """End the goal as LOST, unless it has already ended."""
        from talkcli.goals.reasons import Reason  # this import is slow and rarely needed

        self._update(replace(self.goal, state=State.LOST, reason=Reason.LOST.value, message=f"result unknown: {why}"))

    def _update(self, goal: Goal) -> None:
        """Update the goal, unless it has already ended."""
        if not self.goal.state.terminal:
            self.goal = goal

    def _hear(
        self, event: StateChanged | WordHeard | events.TextMissing | events.GoalInterrupted | PausedChanged | Goal
    ) -> None:
        """Update the goal from an event, and buffer the event. Do nothing if the goal has ended."""
        if self.goal.state.terminal:
            return
        if isinstance(event, Goal):
            if event.state is not self.goal.state:
                self._buffer.add(StateChanged(event.id, event.state))
            self.goal = event
        elif isinstance(event, StateChanged):
            # A terminal state is followed by the Result, which has more details. Any other change of state ends an
            # interruption.
            if not event.state.terminal:
                paused = self.goal.paused and self.goal.interrupted_by is None
                self.goal = replace(self.goal, state=event.state, paused=paused, interrupted_by=None)
            self._buffer.add(event)
        elif isinstance(event, events.GoalInterrupted):
            self.goal = replace(self.goal, paused=True, interrupted_by=event.by.goal)
            self._buffer.add(event)
        else:
            if isinstance(event, PausedChanged):
                self.speech_paused = event.paused
                paused = event.paused and event.id == self.goal.id and self.goal.state is State.ACTIVE
                self.goal = replace(self.goal, paused=paused or self.goal.interrupted_by is not None)
            elif isinstance(event, events.TextMissing):
                self.goal = replace(self.goal, waits=event.waits)
            if self._with_feedback:
                self._buffer.add(event)

    def _has_event(self) -> bool:
        """Return whether there is an event to take."""
        return self.goal.state.terminal or bool(self._buffer)

    def _take(self) -> Event | None:
        """Remove and return the next event, if any. The last event is the Result."""
        return self._buffer.take() or (Result(self.goal) if self.goal.state.terminal else None)


@frozen
class ServerInfo:
    """A server's description of itself, such as its version and features.

    It is sent in the server's greeting, and published by the server's robot.
    """

    boot: str = ""
    pid: int | None = None
    version: str = "unknown"
    #: the names of the server's features; None if unknown
    features: tuple[str, ...] | None = None

    @classmethod
    def read(cls, server: JsonObject) -> ServerInfo:
        """Read a server's description from a JSON object. Ignore invalid fields."""
        return cls(**read_fields(cls, server))


def read_greeting(line: bytes, path: str) -> ServerInfo:
    """Return the server's description from its greeting. Raise an error if the server can't be used.

    Raises:
        ServerUnavailable: the line is not a greeting.
        ProtocolMismatch, Busy, AccessDenied: the server can't be used.
    """
    try:
        greeting = decode(line)
    except BadRequest:
        greeting = {}
    if "talk" not in greeting:
        raise ServerUnavailable(f"the program listening at {path} is not a talk server")
    events.check_greeting(greeting)
    if "error" in greeting:
        from talkcli.terminal.text import printable  # this import is slow and rarely needed

        reason = printable(str(greeting.get("message") or greeting["error"]))
        raise AccessDenied(f"the server refused the connection: {reason}")
    return ServerInfo.read(greeting)


class Exchange:
    """A client's request and the server's answer to it."""

    def __init__(self, request: Request, on_reply: OnReply | None = None, on_failure: OnFailure | None = None) -> None:
        """Create an exchange. Register it before sending its request.

        Args:
            request: the request.
            on_reply: called if the server accepts the request.
            on_failure: called if the server refuses the request or doesn't answer. Without this function, the caller
                must wait for the answer. Such a request fails at once if the client can't reconnect.
        """
        self.request = request
        self.on_reply, self.on_failure = on_reply, on_failure
        #: the `seq` of the request and its answer, or 0 before registration
        self.number = 0
        #: whether the whole request was sent. If so, the server may carry it out.
        self.sent = False
        #: the list items that have been received
        self.items: list[JsonObject] = []
        self.reply: JsonObject | None = None
        #: the error, if the request failed
        self.error: TalkError | None = None
        #: monotonic time at which the exchange last made progress
        self.heard_at = 0.0

    @property
    def unlimited(self) -> bool:
        """Whether the client waits for the answer without a time limit."""
        request = self.request
        if isinstance(request, Append):
            return not request.broken
        return isinstance(request, Pause) or (isinstance(request, Say) and request.patient)

    @property
    def over(self) -> bool:
        """Whether the exchange has ended, with a reply or an error."""
        return self.reply is not None or self.error is not None


class ClientCore:
    """The protocol state of a client's connection to a server."""

    #: the kinds of requests that may have an effect even if no answer is received
    lasting: tuple[type[Request], ...] = (Say,)

    def __init__(self, patience_s: float, now: float) -> None:
        """Initialize the state for a connection that is already open.

        Args:
            patience_s: seconds in which the server must answer.
            now: the monotonic time.
        """
        #: the server's socket or address, for error messages
        self.path = ""
        self.server = ServerInfo()
        self.listeners = EventListeners()
        #: why the connection has ended for good, or None if it hasn't
        self.ended: str | None = None
        #: the unanswered exchanges, by the `seq` of their requests
        self.exchanges: dict[int, Exchange] = {}
        #: whether the server's greeting has arrived. Requests may be sent only after that.
        self.greeted = True
        #: monotonic time at which the connection broke, or None while there is a connection
        self.absent_since: float | None = None
        #: why the connection last broke
        self.absence = ""
        #: the error of the last attempt to reconnect, or None if it succeeded
        self.connect_error: TalkError | None = None
        self._patience = patience_s
        self._numbers: Iterator[int] = itertools.count(FIRST_SEQ)
        self._splitter = LineSplitter()
        #: monotonic time at which bytes were last received
        self._heard = now
        #: unsent lines, each with its exchange
        self._unsent: deque[tuple[bytes, Exchange]] = deque()
        #: how many bytes of the first line in `_unsent` have already been sent
        self._first_sent_bytes = 0
        #: the unsent part of the hello line, which is sent before the server's greeting arrives
        self._hello = b""
        #: the bytes of the first request that were sent before this object was created
        self._sent_early = b""
        #: why requests can no longer be sent, or None. Answers may still be received.
        self._sending_ended: str | None = None
        #: the last error message that did not belong to a request. It explains why the server closes the connection.
        self._last_error: str | None = None

    @property
    def boot(self) -> str:
        """The server's boot id, which is the first part of its goal ids."""
        return self.server.boot

    # -- requests

    def register(self, exchange: Exchange, now: float) -> None:
        """Number an exchange, and add it to the unanswered exchanges."""
        exchange.number = exchange.number or next(self._numbers)
        exchange.heard_at = now
        self.exchanges[exchange.number] = exchange

    def line(self, exchange: Exchange) -> bytes:
        """Return the line that contains the request of a registered exchange."""
        return request_line({"seq": exchange.number, **request_to_json(exchange.request)})

    def queue(self, line: bytes, exchange: Exchange) -> None:
        """Queue the line of an exchange's request for sending.

        Raises:
            ServerUnavailable: nothing more can be sent.
        """
        if self.ended is not None or self._sending_ended is not None:
            raise self.unanswered(exchange)
        self._unsent.append((line, exchange))
        early, self._sent_early = self._sent_early, b""
        if not line.startswith(early):
            raise AssertionError(f"the request that was sent early, {early!r}, differs from {line!r}")
        if early:
            self.mark_sent(len(early))

    @property
    def unsent_bytes(self) -> int:
        """The size of the requests that are waiting to be sent."""
        return sum(len(line) for line, _ in self._unsent) - self._first_sent_bytes

    def outgoing(self) -> bytes:
        """Return the bytes that can be sent now.

        Requests wait for the server's greeting.
        """
        if self._hello or not self.greeted:
            return self._hello
        return b"".join(line for line, _ in self._unsent)[self._first_sent_bytes :]

    def mark_sent(self, count: int) -> None:
        """Record that the transport has sent this number of bytes."""
        if self._hello:
            self._hello = self._hello[count:]
            return
        count += self._first_sent_bytes
        while self._unsent and count >= len(self._unsent[0][0]):
            line, exchange = self._unsent.popleft()
            count -= len(line)
            exchange.sent = True
        self._first_sent_bytes = count

    def forget(self, exchange: Exchange) -> bool:
        """Drop an exchange and its unsent request. Return False if part of the request was sent.

        Returns:
            False if a part of the line has been sent. The connection must then be closed before the newline is sent,
            because the server never carries out a request without its newline.
        """
        self.exchanges.pop(exchange.number, None)
        for place, (_, owner) in enumerate(self._unsent):
            if owner is exchange:
                if place == 0 and self._first_sent_bytes:
                    return False
                del self._unsent[place]
                break
        return True

    def stop_sending(self, why: str) -> None:
        """Fail all unsent requests, and all later ones.

        Answers to earlier requests can still be received.
        """
        self._sending_ended = self._sending_ended or why
        unsent = [exchange for _, exchange in self._unsent]
        self._drop_unsent_lines()
        for exchange in unsent:
            self.fail(exchange, self.unanswered(exchange))

    def answer(self, exchange: Exchange) -> tuple[JsonObject, list[JsonObject]]:
        """Return the reply to a request with its list items. Raise the error of a failed request.

        Raises:
            RequestRefused: the server refused the request.
            ServerUnavailable: the request was not sent, or the server didn't answer a request without lasting effect.
            Lost: the request was sent, but not answered. It may have taken effect.
        """
        if exchange.reply is None:
            raise exchange.error or self.unanswered(exchange)
        return exchange.reply, exchange.items

    def unanswered(self, exchange: Exchange) -> TalkError:
        """Return the error for an unanswered request."""
        request = exchange.request
        why = self.ended or (self.absence if self.absent_since is not None else "")
        if not exchange.sent:
            if self.connect_error and not self.ended:
                why = " ".join(self.connect_error.message.split())
            why = why or self._sending_ended or "the server doesn't respond"
            return ServerUnavailable(f"nothing was sent to the server at {self.path}: {why}")
        why = why or f"it did not reply within {self._patience:g} s"
        words = f"the {request.kind} request was sent to the server at {self.path}, but {why}"
        if isinstance(request, Say):
            return Lost(f"{words}; the sentence may still be spoken")
        return Lost(words) if isinstance(request, self.lasting) else ServerUnavailable(words)

    def unsupported(self, request: Request) -> TalkError | None:
        """Return an error if the server lacks a feature that a request needs.

        Return None if the server's features are unknown.
        """
        features = self.server.features
        missing = missing_features(request_to_json(request), features) if features is not None else []
        if not missing:
            return None
        from talkcli.terminal.text import printable  # this import is slow and rarely needed

        version, name = printable(self.server.version), FEATURES[missing[0]][0]
        return ProtocolMismatch(f"the server (version {version}) does not support {name}; restart it")

    def refusal(self, reply: JsonObject, items: list[JsonObject]) -> TalkError:
        """Return the error for a reply that refuses a request.

        `items` are the list items before the reply.
        """
        from talkcli.terminal.text import printable  # this import is slow and rarely needed

        error = reply.get("error")
        code, message = (error.get("code"), error.get("message")) if isinstance(error, dict) else (None, None)
        return refusal(str(code), printable(str(message or "the server refused the request without a reason")), items)

    # -- time limits

    def answer_deadline(self, exchange: Exchange) -> float:
        """Return the time at which an exchange fails if nothing happens.

        The request must be sent, or the next line of its answer must arrive, by this time.
        """
        if exchange.sent:
            return float("inf") if exchange.unlimited else exchange.heard_at + self._patience
        ttl = exchange.request.ttl if isinstance(exchange.request, Say) else None
        return exchange.heard_at + min(self._patience, ttl or self._patience)

    def silence_deadline(self, waiting_since: float) -> tuple[float, str]:
        """Return the time at which a silent server counts as lost, and an error message.

        Args:
            waiting_since: when the caller started to wait (monotonic). Earlier silence doesn't count.
        """
        if self.absent_since is not None:
            return float("inf"), ""
        return max(waiting_since, self._heard) + SILENCE_LIMIT_S, f"the server sent nothing for {SILENCE_LIMIT_S:g} s"

    def goals_lost_at(self) -> float:
        """Return the time at which followed goals become LOST.

        While connected, return inf.
        """
        return float("inf") if self.absent_since is None else self.absent_since + self._patience

    def next_expiry(self) -> float:
        """Return the time by which `expire` must be called.

        Return inf if there is no time limit.
        """
        times = [self.answer_deadline(each) for each in self.exchanges.values()]
        if self.listeners.goals:
            times.append(self.goals_lost_at())
        return min(times, default=float("inf"))

    def expire(self, now: float) -> bool:
        """Fail late requests, and end lost goals as LOST. Return False if the connection must be closed.

        Followed goals are LOST if the client was disconnected for too long.

        Returns:
            False if the connection must be closed, because a part of a line has been sent (see `forget`).
        """
        intact = True
        for exchange in [each for each in self.exchanges.values() if self.answer_deadline(each) <= now]:
            intact = self.forget(exchange) and intact
            self.fail(exchange, self.unanswered(exchange))
        if now >= self.goals_lost_at():
            self._lose_goals()
        return intact

    # -- receiving

    def split(self, data: bytes, now: float) -> list[bytes]:
        """Add received bytes. Return the lines that are now complete.

        Transports that pass lines on without decoding them use this method instead of `receive`.
        """
        self._heard = now
        return self._splitter.feed(data)

    def begin_stream(self) -> None:
        """Prepare for a new stream of bytes. Discard the incomplete line of the previous stream."""
        self._splitter = LineSplitter()

    def receive(self, data: bytes, now: float) -> None:
        """Process received bytes. A malformed line breaks the connection.

        Raises:
            ServerUnavailable, AccessDenied, Busy, ProtocolMismatch: the greeting shows that the server can't be used.
        """
        splitter = self._splitter
        for line in self.split(data, now):
            if self.ended is not None or self._splitter is not splitter:
                return  # processing the previous line has ended the connection
            if not self.greeted:
                self.connected(read_greeting(line, self.path), now)
                continue
            try:
                self.dispatch(decode(line), now)
            except (BadRequest, ValueError) as error:  # a ValueError reports a malformed goal or event
                self.break_off(f"the server sent a malformed message: {error}", now)

    def match(self, message: JsonObject) -> Exchange | None:
        """Return the exchange that a message belongs to, if any."""
        number = message.get("seq")
        return self.exchanges.get(number) if isinstance(number, int) else None

    def dispatch(self, message: JsonObject, now: float) -> Exchange | None:
        """Process a received message. Return the exchange that it ends, if any.

        The message is an event, a list item or a reply.

        Raises:
            ValueError: the event, or a goal in the reply, is malformed.
        """
        if "event" in message:
            self.listeners.publish(events.from_json(message))
            return None
        if message.get("seq") is None and message.get("ok") is False:
            self._last_error = f"the server closed the connection: {self.refusal(message, [])}"
        exchange = self.match(message)
        if exchange is None:
            return None
        exchange.heard_at = now
        if "ok" not in message:
            exchange.items.append(message)
            return None
        self._finish(exchange, message)
        return exchange

    def _finish(self, exchange: Exchange, reply: JsonObject) -> None:
        """End an exchange with the server's reply, and call its `on_reply` or `on_failure`.

        Raises:
            Unreadable: a goal in the reply is malformed.
        """
        if reply.get("ok") is not True:
            self.fail(exchange, self.refusal(reply, exchange.items))
            return
        try:
            if exchange.on_reply:
                exchange.on_reply(reply, exchange.items)
        except Unreadable as error:
            # A request that may have taken effect fails later, when this error breaks the connection.
            if not isinstance(exchange.request, self.lasting):
                self.fail(exchange, error)
            raise
        exchange.reply = reply
        self.exchanges.pop(exchange.number, None)

    # -- disconnecting and reconnecting

    def break_off(self, why: str, now: float) -> None:  # noqa: ARG002 - for subclasses that reconnect
        """Record that a faulty connection has ended for good. Subclasses may reconnect instead."""
        self.end(why)

    def end(self, why: str) -> None:
        """Record that the connection has ended for good, and fail all unanswered requests.

        Received events can still be read.
        """
        if self.ended is not None:
            return
        self.ended = self._last_error or why
        self._fail_all()

    def disconnected(self, why: str, now: float) -> None:
        """Record a broken connection. Fail unanswered requests, and end watches that don't reconnect."""
        self.absence = self._last_error or why
        self.absent_since, self._last_error, self._sending_ended = now, None, None
        self.greeted = False
        self.begin_stream()
        self._fail_all()
        why = f"no more events from the server at {self.path}: {self.absence}"
        self.listeners.end_watches(why, include_reconnecting=False)

    def connecting(self, hello: bytes) -> None:
        """Prepare for a new connection, and queue the bytes of its `hello` message.

        Requests wait for the server's greeting.
        """
        self.greeted, self._hello = False, hello
        self.begin_stream()

    def not_connected(self, error: TalkError) -> None:
        """Record a failed attempt to reconnect. Fail the requests that callers are waiting for.

        These are the exchanges without an `on_failure`.
        """
        self.connect_error = error
        for exchange in [each for each in self.exchanges.values() if not each.on_failure]:
            self.forget(exchange)
            self.fail(exchange, error)

    def connected(self, server: ServerInfo, now: float) -> None:
        """After reconnecting, follow the goals again, or end them as LOST. Queue the waiting requests.

        The goals are LOST if the server was restarted in the meantime. Otherwise, they are followed again, and their
        texts continue over this connection. Watches and waiting requests are sent again.

        Args:
            server: the server's greeting. Each start of the server has another boot id.
            now: the monotonic time.
        """
        restarted = server.boot != self.boot
        self.server, self.greeted, self.connect_error = server, True, None
        self._heard, self.absent_since = now, None
        if restarted:
            self._lose_goals()
        waiting, self._unsent = self._unsent, deque()
        for goal_id in self.listeners.growing:
            self._queue_exchange(Exchange(Append(goal_id)), now)  # otherwise, the text would break off
        for goal_id, feedback in self.listeners.goals.items():
            self._follow_again(goal_id, feedback=feedback, now=now)
        if self.listeners.watches:
            self._watch_again(now)
        for _, exchange in waiting:
            if error := self.unsupported(exchange.request):
                self.fail(exchange, error)
            else:
                self.queue(self._renew_line(exchange, now), exchange)

    def _renew_line(self, exchange: Exchange, now: float) -> bytes:
        """Reduce the TTL of a waiting request by its waiting time. Return the request as a line."""
        request = exchange.request
        if isinstance(request, Say) and request.ttl:
            exchange.request = replace(request, ttl=max(MIN_TTL_S, request.ttl - (now - exchange.heard_at)))
        exchange.heard_at = now
        return self.line(exchange)

    def _follow_again(self, goal_id: str, *, feedback: bool, now: float) -> None:
        """Queue a request to follow a goal again after reconnecting."""

        def on_reply(_: JsonObject, items: list[JsonObject]) -> None:
            for goal in goals(items, "goal"):
                if not goal.state.terminal:  # an ended goal's Result is sent next
                    self.listeners.update(goal)

        def on_failure(error: TalkError) -> None:
            if self.absent_since is None:  # after another break, the next connection will follow the goal
                self.listeners.lose(goal_id, f"{error.message}; the sentence may have been spoken")

        self._queue_exchange(Exchange(Wait((goal_id,), feedback), on_reply, on_failure), now)

    def _watch_again(self, now: float) -> None:
        """Queue a request to watch all goals again after reconnecting."""

        def on_reply(reply: JsonObject, items: list[JsonObject]) -> None:
            self.listeners.publish(Snapshot(ServerStatus.from_reply(reply, items)))

        def on_failure(error: TalkError) -> None:
            if self.absent_since is None:
                self.listeners.end_watches(error.message, include_reconnecting=True)

        self._queue_exchange(Exchange(Watch(), on_reply, on_failure), now)

    def _queue_exchange(self, exchange: Exchange, now: float) -> None:
        """Register an exchange, and queue its request to be sent."""
        self.register(exchange, now)
        self.queue(self.line(exchange), exchange)

    def fail(self, exchange: Exchange, error: TalkError) -> None:
        """End an exchange with an error, and call its `on_failure`, unless it has already ended."""
        if exchange.over:
            return
        exchange.error = error
        self.exchanges.pop(exchange.number, None)
        if exchange.on_failure:
            exchange.on_failure(error)

    def _fail_all(self) -> None:
        """Fail all unanswered requests, and discard their unsent bytes."""
        self._drop_unsent_lines()
        for exchange in list(self.exchanges.values()):
            self.fail(exchange, self.unanswered(exchange))

    def _lose_goals(self) -> None:
        """End all followed goals as LOST."""
        for goal_id in self.listeners.goals:
            self.listeners.lose(goal_id, f"{self.absence}; the sentence may still be spoken")

    def _drop_unsent_lines(self) -> None:
        """Remove all unsent lines, without failing their exchanges."""
        self._unsent.clear()
        self._first_sent_bytes = 0
