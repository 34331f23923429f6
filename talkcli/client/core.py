"""The client's side of the protocol, without I/O: requests become bytes, received bytes become replies and events.

A transport is a shell around `ClientCore`. It connects, owns the lock or the event loop, and has these duties:

- Send the bytes that `outgoing()` returns, and report with `mark_sent()` how many were accepted.
- Pass received bytes to `receive()`.
- Call `expire()` at the time that `next_expiry()` returns, or earlier.
- Call `end()` when the connection has ended for good, or `disconnected()` if the shell is going to connect again.

Rules for this file: no socket, thread, lock, asyncio or clock. Times are seconds of a monotonic clock, and are passed
as arguments. Only one thread at a time may call a method.
"""

from __future__ import annotations

import itertools
from _weakrefset import WeakSet  # as `threading` imports it: the rest of `weakref` takes longer
from collections import deque
from collections.abc import Callable

from talkcli.errors import AccessDenied, BadRequest, Lost, ServerUnavailable, TalkError, Unreadable, refusal
from talkcli.frozen import TYPE_CHECKING, frozen, replace
from talkcli.goals.goal import Goal
from talkcli.goals.options import Say
from talkcli.goals.states import State
from talkcli.protocol import events
from talkcli.protocol.events import PausedChanged, Result, ServerStatus, Snapshot, StateChanged, WordHeard, goals
from talkcli.protocol.lines import FIRST_NUMBER, LineSplitter, decode, request_line, write_request
from talkcli.protocol.requests import Wait, Watch

if TYPE_CHECKING:
    from collections.abc import Iterator

    from talkcli.goals.goal import JsonObject
    from talkcli.protocol.events import Event
    from talkcli.protocol.requests import Request

#: Called with the reply to a request and the lines of its list.
OnReply = Callable[["JsonObject", "list[JsonObject]"], None]
#: Called with the reason why a request was refused, was not sent, or will not be answered.
OnFailure = Callable[["TalkError"], None]

#: The longest silence of a server that owes the client anything. A server sends a sign of life every 5 s.
SILENCE_LIMIT_S = 15.0
#: The most bytes that may wait to be sent when a request is sent without waiting.
MAX_UNSENT_BYTES = 256 * 1024
#: The least ttl that is sent: 0 would mean no limit.
_LEAST_TTL_S = 0.01
#: Words and pauses kept for a slow reader, the newest ones. The longest text, 10,000 characters, has no more words, so
#: a goal's words are complete even if they are read after its end.
MAX_FEEDBACK_EVENTS = 5_000
#: State changes kept for a slow reader of all goals: those of about 3,000 goals. With more, the reader's stream ends.
MAX_STATE_EVENTS = 10_000


@frozen
class GoalLost:
    """The end of a goal for its listeners, because the server sends no more events for it."""

    #: the reason, for people
    why: str


class EventBuffer:
    """A bounded queue of events for one reader."""

    __slots__ = ("__weakref__", "_count", "_feedback", "_last_number", "_states", "closed", "reconnects")

    def __init__(self, *, reconnects: bool = False) -> None:
        # Two queues of numbered events, so that dropping the oldest feedback takes constant time.
        self._states: deque[tuple[int, Event]] = deque()
        self._feedback: deque[tuple[int, Event]] = deque(maxlen=MAX_FEEDBACK_EVENTS)
        self._count = 0
        self._last_number: int | None = None
        #: why no more events are added; None while the buffer is open
        self.closed: str | None = None
        #: whether the buffer stays in use after the connection has broken
        self.reconnects = reconnects

    def add(self, event: Event) -> None:
        """Add an event, unless it is the same as the last one.

        A connection that waits for a goal and also watches all goals receives each state twice.
        """
        number = getattr(event, "n", None)
        if number is not None and number == self._last_number:
            return
        self._last_number = number
        if self.closed is not None:
            return
        self._count += 1
        if isinstance(event, WordHeard | PausedChanged):
            self._feedback.append((self._count, event))
        elif len(self._states) < MAX_STATE_EVENTS:
            self._states.append((self._count, event))
        else:
            self.closed = (
                f"more than {MAX_STATE_EVENTS} events waited and none was taken: watch again, and take them faster"
            )

    def __len__(self) -> int:
        return len(self._states) + len(self._feedback)

    def take(self) -> Event | None:
        """Remove the oldest event and return it; None if the buffer is empty."""
        queues = [each for each in (self._states, self._feedback) if each]
        return min(queues, key=lambda each: each[0][0]).popleft()[1] if queues else None


class EventListeners:
    """The listeners for single goals, and the buffers of readers that watch all goals."""

    def __init__(self) -> None:
        self._goals: dict[str, list[Callable[[Event | Goal | GoalLost], None]]] = {}
        #: the goals whose listeners also want each word
        self._with_feedback: set[str] = set()
        #: weak references, because watching ends when the reader drops its iterator
        self._watches: WeakSet[EventBuffer] = WeakSet()

    def add(self, goal_id: str, listener: Callable[[Event | Goal | GoalLost], None], *, feedback: bool = False) -> None:
        """Pass the events of a goal, and all pauses, to a listener, until its Result or GoalLost."""
        self._goals.setdefault(goal_id, []).append(listener)
        self.want_feedback(goal_id, feedback=feedback)

    def want_feedback(self, goal_id: str, *, feedback: bool) -> None:
        """Record that a listener wants each word of a goal, if `feedback` is set."""
        if feedback:
            self._with_feedback.add(goal_id)

    def watch(self, buffer: EventBuffer) -> None:
        """Add all events to this buffer, for as long as its reader keeps a reference to it."""
        self._watches.add(buffer)

    @property
    def watched(self) -> bool:
        """Whether there is a reader that watches all goals."""
        return bool(self._watches)

    @property
    def goals(self) -> dict[str, bool]:
        """The ids of the goals with listeners, and whether one of these wants each word."""
        return {each: each in self._with_feedback for each in self._goals}

    def lose(self, goal_id: str, why: str) -> None:
        """Tell a goal's listeners that it is lost, and remove them."""
        for listener in self._remove(goal_id):
            listener(GoalLost(why))

    def update(self, goal: Goal) -> None:
        """Pass the current state of a goal to its listeners."""
        for listener in self._goals.get(goal.id, []):
            listener(goal)

    def end_watches(self, why: str, *, all_of_them: bool) -> None:
        """Close the buffers of the readers that watch all goals.

        Args:
            why: the reason, for people.
            all_of_them: also close the buffers that stay in use after a break.
        """
        for buffer in list(self._watches):
            if all_of_them or not buffer.reconnects:
                buffer.closed = buffer.closed or why
                self._watches.discard(buffer)

    def hear(self, message: JsonObject) -> None:
        """Pass an event in the server's JSON form to its listeners; ValueError if it is malformed."""
        event = events.from_json(message)
        if isinstance(event, Result):
            for listener in self._remove(event.goal.id):
                listener(event)
        elif isinstance(event, Snapshot):
            for buffer in self._watches:
                buffer.add(event)
        elif isinstance(event, StateChanged | WordHeard | PausedChanged):
            if isinstance(event, PausedChanged):
                listeners = [listener for each in self._goals.values() for listener in each]
            else:
                listeners = self._goals.get(event.id, [])
            for listener in listeners:
                listener(event)
            state = event.state if isinstance(event, StateChanged) and not event.goal else None
            if state is State.PENDING or (state and state.terminal):
                return  # for watching clients, the server sends this event again with the whole goal
            for buffer in self._watches:
                buffer.add(event)

    def _remove(self, goal_id: str) -> list[Callable[[Event | Goal | GoalLost], None]]:
        self._with_feedback.discard(goal_id)
        return self._goals.pop(goal_id, [])


class TrackedGoal:
    """A client's knowledge of one goal, with a buffer of its events."""

    def __init__(self, goal: Goal) -> None:
        #: the goal as the server last described it
        self.goal = goal
        #: whether an earlier `say` with the same id sent this goal, so that the text is not spoken again
        self.attached = False
        #: whether the server has paused all speech, as far as is known
        self.speech_paused = False
        #: when the server began to send the goal's events to this connection (monotonic); None if it doesn't
        self._followed_at: float | None = None
        #: whether each word is kept, too
        self._with_feedback = False
        #: whether this object is among the goal's listeners
        self._listening = False
        self._buffer = EventBuffer()
        #: whether the Result has been taken
        self._result_taken = False

    def _expect(self, request: Say, now: float) -> None:
        """Take the goal's id from a `say` that has not been answered yet."""
        self.goal = replace(self.goal, id=request.id or "", text=request.text)
        if request.wait:
            self._followed_at = now

    def _accept(self, reply: JsonObject) -> None:
        """Update the goal from the reply to its `say`."""
        self.goal = Goal.from_json(reply.get("goal"))
        self.attached = reply.get("attached") is True
        self.speech_paused = reply.get("paused") is True

    def _listen_to(self, listeners: EventListeners, *, feedback: bool, now: float) -> None:
        """Become a listener for the goal's events, which the server sends from `now` on."""
        self._with_feedback = self._with_feedback or feedback
        if self._followed_at is None:
            self._followed_at = now
        if self._listening:
            listeners.want_feedback(self.goal.id, feedback=feedback)
        elif not self.goal.state.terminal:
            self._listening = True
            listeners.add(self.goal.id, self._hear, feedback=feedback)

    def _fail(self, error: TalkError) -> None:
        """End the goal because its `say` failed: as LOST if it may be spoken, otherwise as REJECTED."""
        from talkcli.goals.reasons import Reason  # rarely needed, and slow to import

        if self.goal.state.terminal:
            return
        if isinstance(error, Lost):
            self.goal = lost(self.goal, error.message)
        else:
            reason = Reason.NOT_SENT.value if isinstance(error, ServerUnavailable) else error.code
            message = f"Talk rejected: {error.message}"
            self.goal = replace(self.goal, state=State.REJECTED, reason=reason, message=message)

    def _settle(self, goal: Goal) -> None:
        """Replace the goal with the server's current description, unless it has already ended."""
        if not self.goal.state.terminal:
            self.goal = goal

    def _hear(self, event: Event | Goal | GoalLost) -> None:
        """Update the goal from an event of its own, or from a pause of all speech."""
        if self.goal.state.terminal:
            return
        if isinstance(event, Goal):
            if event.state is not self.goal.state:
                self._buffer.add(StateChanged(event.id, event.state))
            self.goal = event
        elif isinstance(event, GoalLost):
            self.goal = lost(self.goal, event.why)
        elif isinstance(event, Result):
            self.goal = event.goal
        elif isinstance(event, StateChanged):
            # A terminal state is followed by the result, which has the details.
            if not event.state.terminal:
                self.goal = replace(self.goal, state=event.state)
            self._buffer.add(event)
        else:
            if isinstance(event, PausedChanged):
                self.speech_paused = event.paused
                paused = event.paused and event.id == self.goal.id and self.goal.state is State.ACTIVE
                self.goal = replace(self.goal, paused=paused)
            if self._with_feedback:
                self._buffer.add(event)

    def _has_event(self) -> bool:
        """Return whether there is an event to take."""
        return self.goal.state.terminal or bool(self._buffer)

    def _take(self) -> Event | None:
        """Remove and return the oldest event. An ended goal without events returns its Result, every time."""
        return self._buffer.take() or (Result(self.goal) if self.goal.state.terminal else None)


def lost(goal: Goal, why: str) -> Goal:
    """Return a goal as LOST."""
    from talkcli.goals.reasons import Reason  # rarely needed, and slow to import

    return replace(goal, state=State.LOST, reason=Reason.LOST.value, message=f"Talk lost: {why}")


def read_greeting(line: bytes, path: str, version: str) -> JsonObject:
    """Return the greeting of a server.

    Args:
        line: the server's first line, without its newline.
        path: where the server is, for people.
        version: this client's, for people.

    Raises:
        ServerUnavailable: this is no greeting.
        ProtocolMismatch, Busy, AccessDenied: the server can't be used.
    """
    try:
        greeting = decode(line)
    except BadRequest:
        greeting = {}
    if "talk" not in greeting:
        raise ServerUnavailable(f"what answers at {path} is no talk server")
    events.check_greeting(greeting, version)
    if "error" in greeting:
        from talkcli.terminal.text import printable  # rarely needed, and slow to import

        raise AccessDenied(f"the server refuses: {printable(str(greeting.get('message') or greeting['error']))}")
    return greeting


def identity(server: JsonObject) -> tuple[str, int | None]:
    """Return the boot id and the process in a greeting, or in another description of a server."""
    boot, pid = server.get("boot"), server.get("pid")
    return boot if isinstance(boot, str) else "", pid if isinstance(pid, int) else None


class Exchange:
    """A request and its answer: the lines of a list, then the reply."""

    __slots__ = ("error", "heard_at", "items", "number", "on_failure", "on_reply", "reply", "request", "sent", "slow")

    def __init__(
        self,
        request: Request,
        on_reply: OnReply | None = None,
        on_failure: OnFailure | None = None,
        *,
        slow: bool = False,
    ) -> None:
        """Describe an exchange that is still to be registered.

        Args:
            request: the request.
            on_reply: called with the reply and the lines of the list, if the request was accepted.
            on_failure: called if there is no such reply. Nobody waits for an exchange with this function.
            slow: the answer may take any time.
        """
        self.request = request
        self.on_reply, self.on_failure = on_reply, on_failure
        self.slow = slow
        #: the `seq` of its lines
        self.number = 0
        #: whether the whole line was sent, so that the server may carry out the request
        self.sent = False
        self.items: list[JsonObject] = []
        self.reply: JsonObject | None = None
        #: why there is no reply
        self.error: TalkError | None = None
        #: when the exchange began, or when its last line was received (monotonic)
        self.heard_at = 0.0

    @property
    def over(self) -> bool:
        """Whether the exchange has ended, with a reply or an error."""
        return self.reply is not None or self.error is not None


class ClientCore:
    """The protocol state of one client's connection to a server."""

    #: requests that may take effect although the client gets no answer
    lasting: tuple[type[Request], ...] = (Say,)

    def __init__(self, patience: float, now: float) -> None:
        """`patience` is the time in seconds in which the server must answer."""
        #: where the server is, for people
        self.path = ""
        #: the server's boot id, the first half of the ids that it gives
        self.boot = ""
        #: the process id that the server reports
        self.pid: int | None = None
        self.listeners = EventListeners()
        #: why the connection has ended for good; None until then
        self.ended: str | None = None
        #: the open exchanges by their numbers
        self.exchanges: dict[int, Exchange] = {}
        #: bytes of requests that are waiting to be sent
        self.unsent_bytes = 0
        #: whether the server has greeted, so that requests may be sent
        self.greeted = True
        #: since when there has been no connection (monotonic); None while there is one
        self.absent_since: float | None = None
        #: why the connection broke the last time
        self.absence = ""
        #: why the last attempt to reconnect failed; empty after a success
        self._attempt_failure = ""
        self._patience = patience
        self._numbers: Iterator[int] = itertools.count(FIRST_NUMBER)
        self._splitter = LineSplitter()
        #: when the last bytes were received (monotonic)
        self._heard = now
        #: lines that are waiting to be sent, each with its exchange
        self._unsent: deque[tuple[bytes, Exchange | None]] = deque()
        #: bytes of the first of these lines that have been sent
        self._first_sent_bytes = 0
        #: the unsent part of the hello line, which is sent before the server greets
        self._hello = b""
        #: this client's version, for people
        self._version = ""
        #: the part of the first request that was sent before this object was created
        self._sent_early = b""
        #: why nothing more can be sent, although answers may still be received; None while sending is possible
        self._sending_ended: str | None = None
        #: the server's last error that was no answer to a request, which tells why it closes the connection
        self._last_words: str | None = None

    # -- requests

    def register(self, exchange: Exchange, now: float) -> None:
        """Expect the answer to a request. The exchange gets a number, unless it has one."""
        exchange.number = exchange.number or next(self._numbers)
        exchange.heard_at = now
        self.exchanges[exchange.number] = exchange

    def line(self, exchange: Exchange) -> bytes:
        """Return the request of a registered exchange as a line."""
        return request_line({"seq": exchange.number, **write_request(exchange.request)})

    def queue(self, line: bytes, exchange: Exchange | None = None) -> None:
        """Append a line to the outgoing bytes; ServerUnavailable if nothing more can be sent."""
        why = self.ended or self._sending_ended
        if why:
            raise ServerUnavailable(f"nothing was sent to the server at {self.path}: {why}")
        self._unsent.append((line, exchange))
        self.unsent_bytes += len(line)
        early, self._sent_early = self._sent_early, b""
        if not line.startswith(early):
            raise AssertionError(f"{early!r} was sent early instead of {line!r}")
        if early:
            self.mark_sent(len(early))

    def outgoing(self) -> bytes:
        """Return the bytes to be sent now. Requests wait until the server has greeted."""
        if self._hello or not self.greeted:
            return self._hello
        if not self._unsent:
            return b""
        if len(self._unsent) == 1:
            return self._unsent[0][0][self._first_sent_bytes :]
        return b"".join(line for line, _ in self._unsent)[self._first_sent_bytes :]

    def mark_sent(self, count: int) -> None:
        """Record that the transport has accepted this number of outgoing bytes."""
        if self._hello:
            self._hello = self._hello[count:]
            return
        self.unsent_bytes -= count
        count += self._first_sent_bytes
        while self._unsent and count >= len(self._unsent[0][0]):
            line, exchange = self._unsent.popleft()
            count -= len(line)
            if exchange:
                exchange.sent = True
        self._first_sent_bytes = count

    def forget(self, exchange: Exchange) -> bool:
        """Stop expecting an answer. If the request has not been sent, don't send it.

        Returns:
            False if only a part of the line has been sent. The connection must be closed then. The server never carries
            out a request without its newline.
        """
        self.exchanges.pop(exchange.number, None)
        for place, (line, owner) in enumerate(self._unsent):
            if owner is exchange:
                if place == 0 and self._first_sent_bytes:
                    return False
                del self._unsent[place]
                self.unsent_bytes -= len(line)
                break
        return True

    def stop_sending(self, why: str, message: str) -> None:
        """Fail the requests that have not been sent, and all later ones. Answers can still be received.

        Args:
            why: the reason, for the errors of later requests.
            message: the error message of the requests that were waiting to be sent.
        """
        self._sending_ended = self._sending_ended or why
        unsent = [exchange for _, exchange in self._unsent if exchange]
        self._drop_lines()
        for exchange in unsent:
            self.fail(exchange, ServerUnavailable(message))

    def answer(self, exchange: Exchange) -> tuple[JsonObject, list[JsonObject]]:
        """Return the reply to a request, and the lines of its list.

        Raises:
            RequestRefused: the server refused the request.
            ServerUnavailable: the request was not sent, or a request without lasting effect was not answered.
            Lost: the request was sent and not answered, so it may have taken effect.
        """
        if exchange.error is not None:
            raise exchange.error
        if exchange.reply is None:
            raise self.unanswered(exchange)
        if exchange.reply.get("ok") is not True:
            raise self.refusal(exchange.reply, exchange.items)
        return exchange.reply, exchange.items

    def unanswered(self, exchange: Exchange) -> TalkError:
        """Return the error for a request without an answer."""
        request = exchange.request
        why = self.ended or (self.absence if self.absent_since is not None else "")
        if not exchange.sent:
            why = self.ended or self._attempt_failure or why
            if not why:
                return ServerUnavailable(f"the server at {self.path} does not answer")
            return ServerUnavailable(f"nothing was sent to the server at {self.path}: {why}")
        words = f"{request.kind} was sent to the server at {self.path}, but {why or self.no_reply}"
        if isinstance(request, Say):
            return Lost(f"{words}; it may still be spoken")
        return Lost(words) if isinstance(request, self.lasting) else ServerUnavailable(words)

    @property
    def no_reply(self) -> str:
        """Why the wait for an answer has ended, for people."""
        return f"it did not reply within {self._patience:g} s"

    def refusal(self, reply: JsonObject, items: list[JsonObject]) -> TalkError:
        """Return the error for a reply that is not ok. It gets the lines of the list as its `items`."""
        from talkcli.terminal.text import printable  # rarely needed, and slow to import

        error = reply.get("error")
        code, message = (error.get("code"), error.get("message")) if isinstance(error, dict) else (None, None)
        return refusal(str(code), printable(str(message or "refused: the server gives no reason")), items)

    # -- limits

    def answer_by(self, exchange: Exchange) -> float:
        """Return the time limit for sending the request, or for the next line of the answer once it was sent."""
        if exchange.sent:
            return float("inf") if exchange.slow else exchange.heard_at + self._patience
        ttl = exchange.request.ttl if isinstance(exchange.request, Say) else None
        return exchange.heard_at + min(self._patience, ttl or self._patience)

    def silent_by(self, began: float) -> tuple[float, str]:
        """Return when a silent server counts as gone for a caller that has waited since `began`, and the reason."""
        if self.absent_since is not None:
            return float("inf"), ""
        return max(began, self._heard) + SILENCE_LIMIT_S, f"it has said nothing for {SILENCE_LIMIT_S:g} s"

    def goals_lost_at(self) -> float:
        """Return when the followed goals are lost if there is no new connection."""
        return float("inf") if self.absent_since is None else self.absent_since + self._patience

    def next_expiry(self) -> float:
        """Return the time at which `expire` must be called."""
        times = [self.answer_by(each) for each in self.exchanges.values() if each.on_failure]
        if self.listeners.goals:
            times.append(self.goals_lost_at())
        return min(times, default=float("inf"))

    def expire(self, now: float) -> bool:
        """Fail what is over its time limit: exchanges with an `on_failure`, and followed goals without a connection.

        Returns:
            False if the connection must be closed, see `forget`.
        """
        intact = True
        for exchange in [each for each in self.exchanges.values() if each.on_failure and self.answer_by(each) <= now]:
            intact = self.forget(exchange) and intact
            self.fail(exchange, self.unanswered(exchange))
        if now >= self.goals_lost_at():
            self._lose_goals(f"{self.absence}; it may still be spoken")
        return intact

    # -- receiving

    def split(self, data: bytes, now: float) -> list[bytes]:
        """Return the lines that received bytes complete. For shells that pass lines on undecoded."""
        self._heard = now
        return self._splitter.feed(data)

    def begin_stream(self) -> None:
        """Discard an incomplete line, because the next bytes are the beginning of another stream."""
        self._splitter = LineSplitter()

    def receive(self, data: bytes, now: float) -> None:
        """Process received bytes. A malformed line breaks the connection.

        Raises:
            ServerUnavailable, AccessDenied, Busy, ProtocolMismatch: according to the greeting on a new connection, the
                server can't be used.
        """
        splitter = self._splitter
        for line in self.split(data, now):
            if self.ended is not None or self._splitter is not splitter:
                return  # the previous line has broken the connection
            if self.greeted:
                self.take_line(line, now)
            else:
                self.connected(*identity(read_greeting(line, self.path, self._version)), now)

    def take_line(self, line: bytes, now: float) -> None:
        """Process a received line."""
        try:
            self.dispatch(decode(line), now)
        except (BadRequest, ValueError) as error:  # ValueError: a malformed goal or event
            self.break_off(f"it sent what is no message: {error}", now)

    def match(self, message: JsonObject) -> Exchange | None:
        """Return the open exchange that a message belongs to; None if there is none."""
        number = message.get("seq")
        return self.exchanges.get(number) if isinstance(number, int) else None

    def dispatch(self, message: JsonObject, now: float) -> Exchange | None:
        """Process a received message.

        Returns:
            The exchange that has ended with this message, or None.

        Raises:
            ValueError: the event, or a goal in the reply, is malformed.
        """
        if "event" in message:
            self.listeners.hear(message)
            return None
        if message.get("seq") is None and message.get("ok") is False:
            self._last_words = f"the server closed it: {self.refusal(message, [])}"
        exchange = self.match(message)
        if exchange is None or exchange.over:
            return None
        exchange.heard_at = now
        if "ok" not in message:
            exchange.items.append(message)
            return None
        self._finish(exchange, message)
        return exchange

    def _finish(self, exchange: Exchange, reply: JsonObject) -> None:
        """End an exchange with its reply; Unreadable if a goal in the reply is malformed."""
        if exchange.on_failure:
            del self.exchanges[exchange.number]
        if reply.get("ok") is not True and exchange.on_failure:
            exchange.on_failure(self.refusal(reply, exchange.items))
        elif reply.get("ok") is True and exchange.on_reply:
            try:
                exchange.on_reply(reply, exchange.items)
            except Unreadable as error:
                if not isinstance(exchange.request, self.lasting):  # otherwise the request may have taken effect
                    exchange.error = error
                if exchange.on_failure:
                    exchange.on_failure(exchange.error or self.unanswered(exchange))
                raise
        exchange.reply = reply  # a malformed reply doesn't count

    # -- disconnecting and reconnecting

    def break_off(self, why: str, now: float) -> None:  # noqa: ARG002 - for subclasses that reconnect
        """Give up the connection. Here, that is its end; a subclass may reconnect instead."""
        self.end(why)

    def end(self, why: str) -> None:
        """End the connection for good. Events that were received before can still be read."""
        if self.ended is not None:
            return
        self.ended = self._last_words or why
        self._drop_lines()
        for exchange in [each for each in self.exchanges.values() if each.on_failure]:
            self.fail(exchange, self.unanswered(exchange))

    def disconnected(self, why: str, now: float) -> None:
        """Record that the connection has broken and is going to be made again. All open exchanges fail."""
        self.absence = self._last_words or why
        self.absent_since, self._last_words, self._sending_ended = now, None, None
        self.greeted, self._hello, self._splitter = False, b"", LineSplitter()
        self._drop_lines()
        for exchange in list(self.exchanges.values()):
            self.fail(exchange, self.unanswered(exchange))
        self.listeners.end_watches(self._nothing_heard(), all_of_them=False)

    def connecting(self, hello: bytes, version: str) -> None:
        """Begin a new connection, on which requests wait for the server's greeting.

        Args:
            hello: the line to be sent first.
            version: this client's version, for people.
        """
        self.greeted, self._hello, self._version, self._splitter = False, hello, version, LineSplitter()
        self._sending_ended = None

    def not_connected(self, error: TalkError, why: str) -> None:
        """Record that an attempt to reconnect has failed. Exchanges that somebody waits for fail, too."""
        self._attempt_failure = why
        self.greeted, self._hello = False, b""
        for exchange in [each for each in self.exchanges.values() if not each.on_failure]:
            self.forget(exchange)
            self.fail(exchange, error)

    def connected(self, boot: str, pid: int | None, now: float) -> None:
        """Record that the server has greeted on a new connection.

        Goals are followed again if the server is still the one of the last connection. Otherwise they are lost.
        """
        restarted = boot != self.boot
        self.boot, self.pid, self.greeted, self._attempt_failure = boot, pid, True, ""
        self._heard, self.absent_since = now, None
        if restarted:
            self._lose_goals(f"{self.absence}; it may still be spoken")
        waiting, self._unsent, self.unsent_bytes = self._unsent, deque(), 0
        for goal_id, feedback in self.listeners.goals.items():
            self._follow_again(goal_id, feedback=feedback, now=now)
        if self.listeners.watched:
            self._watch_again(now)
        for line, exchange in waiting:
            self.queue(line if exchange is None else self._line_now(exchange, now), exchange)

    def _line_now(self, exchange: Exchange, now: float) -> bytes:
        """Return the line of a request that has waited for the connection, with the rest of its ttl."""
        request = exchange.request
        if isinstance(request, Say) and request.ttl:
            exchange.request = replace(request, ttl=max(_LEAST_TTL_S, request.ttl - (now - exchange.heard_at)))
        exchange.heard_at = now
        return self.line(exchange)

    def _follow_again(self, goal_id: str, *, feedback: bool, now: float) -> None:
        def on_reply(_: JsonObject, items: list[JsonObject]) -> None:
            for goal in goals(items, "goal"):
                if not goal.state.terminal:  # an ended goal's result follows
                    self.listeners.update(goal)

        def on_failure(error: TalkError) -> None:
            if self.absent_since is None:  # otherwise the next connection follows it again
                self.listeners.lose(goal_id, f"{error.message}; it may have been spoken")

        self._begin(Exchange(Wait((goal_id,), feedback), on_reply, on_failure), now)

    def _watch_again(self, now: float) -> None:
        def on_reply(reply: JsonObject, items: list[JsonObject]) -> None:
            self.listeners.hear(Snapshot(ServerStatus.from_reply(reply, items)).to_json())

        def on_failure(error: TalkError) -> None:
            if self.absent_since is None:
                self.listeners.end_watches(error.message, all_of_them=True)

        self._begin(Exchange(Watch(), on_reply, on_failure), now)

    def _begin(self, exchange: Exchange, now: float) -> None:
        self.register(exchange, now)
        self.queue(self.line(exchange), exchange)

    def fail(self, exchange: Exchange, error: TalkError) -> None:
        """End an exchange with an error, unless it has already ended."""
        if exchange.over:
            return
        exchange.error = error
        if exchange.on_failure:
            self.exchanges.pop(exchange.number, None)
            exchange.on_failure(error)

    def _lose_goals(self, why: str) -> None:
        for goal_id in self.listeners.goals:
            self.listeners.lose(goal_id, why)

    def _drop_lines(self) -> None:
        self._unsent.clear()
        self._first_sent_bytes = self.unsent_bytes = 0

    def _nothing_heard(self) -> str:
        return f"nothing more is heard of the server at {self.path}: {self.absence}"
