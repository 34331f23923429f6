"""The client's side of the wire, without I/O: requests become bytes, received bytes become replies and events.

A transport is a shell around `ClientCore`. The shell connects, owns the lock or the event loop, and does this:

- send the bytes of `outgoing()`, and report with `mark_sent()` how many were taken;
- pass received bytes to `receive()`;
- call `expire()` at the time that `next_expiry()` returns, if not earlier;
- call `end()` when nothing more can come, or `disconnected()` if it will connect again.

Rules for this file: no socket, thread, lock, asyncio or clock. Times are seconds of a monotonic clock and come in as
arguments. The methods must be called by one thread at a time.
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
    """Nothing more will be heard of a goal."""

    #: for people
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
        #: why no more events are added; None while they are
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
    """The listeners to single goals, and the buffers of those who watch all goals."""

    def __init__(self) -> None:
        self._goals: dict[str, list[Callable[[Event | Goal | GoalLost], None]]] = {}
        #: the goals whose words are wanted, too
        self._with_feedback: set[str] = set()
        #: weak: watching ends when the reader drops its iterator
        self._watches: WeakSet[EventBuffer] = WeakSet()

    def add(self, goal_id: str, listener: Callable[[Event | Goal | GoalLost], None], *, feedback: bool = False) -> None:
        """Pass the events of a goal, and all pauses, to a listener. The last one is a Result or GoalLost."""
        self._goals.setdefault(goal_id, []).append(listener)
        self.want_feedback(goal_id, feedback=feedback)

    def want_feedback(self, goal_id: str, *, feedback: bool) -> None:
        """Note that the words of a goal are wanted, too."""
        if feedback:
            self._with_feedback.add(goal_id)

    def watch(self, buffer: EventBuffer) -> None:
        """Add all events to this buffer, for as long as somebody else refers to it."""
        self._watches.add(buffer)

    @property
    def watched(self) -> bool:
        """Whether anybody watches all goals."""
        return bool(self._watches)

    @property
    def goals(self) -> dict[str, bool]:
        """The ids of the goals with listeners, and whether their words are wanted."""
        return {each: each in self._with_feedback for each in self._goals}

    def lose(self, goal_id: str, why: str) -> None:
        """Tell the listeners that nothing more will be heard of a goal."""
        for listener in self._remove(goal_id):
            listener(GoalLost(why))

    def update(self, goal: Goal) -> None:
        """Tell the listeners how a goal stands now."""
        for listener in self._goals.get(goal.id, []):
            listener(goal)

    def end_watches(self, why: str, *, all_of_them: bool) -> None:
        """Close the buffers of those who watch all goals.

        Args:
            why: the reason, for people.
            all_of_them: close those buffers, too, that stay in use after a break.
        """
        for buffer in list(self._watches):
            if all_of_them or not buffer.reconnects:
                buffer.closed = buffer.closed or why
                self._watches.discard(buffer)

    def hear(self, message: JsonObject) -> None:
        """Pass on an event as the server sent it; ValueError if it is malformed."""
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
                return  # the server sends it once more, with the whole goal, to those who watch
            for buffer in self._watches:
                buffer.add(event)

    def _remove(self, goal_id: str) -> list[Callable[[Event | Goal | GoalLost], None]]:
        self._with_feedback.discard(goal_id)
        return self._goals.pop(goal_id, [])


class TrackedGoal:
    """A goal as far as its client knows it, and its events that nobody has taken yet."""

    def __init__(self, goal: Goal) -> None:
        #: the goal as it was last heard of
        self.goal = goal
        #: whether an earlier `say` with the same id had sent this goal; the text isn't spoken a second time
        self.attached = False
        #: whether the server has paused all speech, as far as is known
        self.speech_paused = False
        #: since when the server sends the goal's events to this connection (monotonic); None if it doesn't
        self._followed_at: float | None = None
        #: whether the words are among them
        self._with_feedback = False
        #: whether the events come here
        self._listening = False
        self._buffer = EventBuffer()
        #: whether the Result has been taken
        self._result_taken = False

    def _expect(self, request: Say, now: float) -> None:
        """Stand for a goal whose `say` has not been answered yet, with the id that its sender has chosen."""
        self.goal = replace(self.goal, id=request.id or "", text=request.text)
        if request.wait:
            self._followed_at = now

    def _accept(self, reply: JsonObject) -> None:
        """Take in the reply to the goal's `say`."""
        self.goal = Goal.from_json(reply.get("goal"))
        self.attached = reply.get("attached") is True
        self.speech_paused = reply.get("paused") is True

    def _listen_to(self, listeners: EventListeners, *, feedback: bool, now: float) -> None:
        """Take in the goal's events, which the server sends to this connection from `now` on."""
        self._with_feedback = self._with_feedback or feedback
        if self._followed_at is None:
            self._followed_at = now
        if self._listening:
            listeners.want_feedback(self.goal.id, feedback=feedback)
        elif not self.goal.state.terminal:
            self._listening = True
            listeners.add(self.goal.id, self._hear, feedback=feedback)

    def _fail(self, error: TalkError) -> None:
        """Conclude from an error that the goal was never queued, or that it is lost."""
        from talkcli.goals.reasons import Reason  # no start pays for it

        if self.goal.state.terminal:
            return
        if isinstance(error, Lost):
            self.goal = lost(self.goal, error.message)
        else:
            reason = Reason.NOT_SENT.value if isinstance(error, ServerUnavailable) else error.code
            message = f"Talk rejected: {error.message}"
            self.goal = replace(self.goal, state=State.REJECTED, reason=reason, message=message)

    def _settle(self, goal: Goal) -> None:
        """Take over what the server says of the goal now, unless the goal is known to have ended."""
        if not self.goal.state.terminal:
            self.goal = goal

    def _hear(self, event: Event | Goal | GoalLost) -> None:
        """Take in an event of this goal, or a pause of all speech."""
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
            # The result, which follows a terminal state, says how and why the goal ended.
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
        """Return whether `_take` would return an event."""
        return self.goal.state.terminal or bool(self._buffer)

    def _take(self) -> Event | None:
        """Remove the oldest event and return it. After the last one return the Result, every time."""
        return self._buffer.take() or (Result(self.goal) if self.goal.state.terminal else None)


def lost(goal: Goal, why: str) -> Goal:
    """Return a goal as LOST."""
    from talkcli.goals.reasons import Reason  # no start pays for it

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
        from talkcli.terminal.text import printable  # no start pays for it

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
        """`on_failure` makes it an exchange that nobody waits for. `slow`: the answer may take any time."""
        self.request = request
        self.on_reply, self.on_failure = on_reply, on_failure
        self.slow = slow
        #: the `seq` of its lines
        self.number = 0
        #: whether the whole line may have reached the server
        self.sent = False
        self.items: list[JsonObject] = []
        self.reply: JsonObject | None = None
        #: why there will be no reply
        self.error: TalkError | None = None
        #: when it began, or the last line of its answer came (monotonic)
        self.heard_at = 0.0

    @property
    def over(self) -> bool:
        """Whether nothing more will come."""
        return self.reply is not None or self.error is not None


class ClientCore:
    """One client's connection to a server, without the connection itself."""

    #: requests that may have an effect even if the client never learns of it
    lasting: tuple[type[Request], ...] = (Say,)

    def __init__(self, patience: float, now: float) -> None:
        """`patience`: seconds in which the server must answer; `now`: the monotonic time."""
        #: where the server is, for people
        self.path = ""
        #: the server's boot id, the first half of the ids that it gives
        self.boot = ""
        #: the server's process, as the server says
        self.pid: int | None = None
        self.listeners = EventListeners()
        #: why nothing more will come, ever; None while something may
        self.ended: str | None = None
        #: the requests that have not been answered, by number
        self.exchanges: dict[int, Exchange] = {}
        #: bytes that wait to be sent, without the first line of a connection
        self.unsent_bytes = 0
        #: whether requests may be sent: the server has greeted
        self.greeted = True
        #: since when there has been no connection (monotonic); None while there is one
        self.absent_since: float | None = None
        #: why there is none, or was none the last time
        self.absence = ""
        #: why the last attempt to connect again has failed; empty after a success
        self._attempt_failure = ""
        self._patience = patience
        self._numbers: Iterator[int] = itertools.count(FIRST_NUMBER)
        self._splitter = LineSplitter()
        #: when the server was last heard
        self._heard = now
        #: lines to be sent, each with its exchange; and how many bytes of the first one were sent
        self._unsent: deque[tuple[bytes, Exchange | None]] = deque()
        self._first_sent_bytes = 0
        #: what is left of the first line of a connection, which goes out before the greeting
        self._hello = b""
        self._version = ""
        #: the beginning of the first request, if that was sent before this object was made
        self._sent_early = b""
        #: why nothing more can be sent; answers may still come
        self._sending_ended: str | None = None
        #: the server's last error that answered no request: why it closes the connection
        self._last_words: str | None = None

    # -- requests

    def register(self, exchange: Exchange, now: float) -> None:
        """Give an exchange a number, unless it has one, and expect its answer from now on."""
        exchange.number = exchange.number or next(self._numbers)
        exchange.heard_at = now
        self.exchanges[exchange.number] = exchange

    def line(self, exchange: Exchange) -> bytes:
        """Return the line of a registered exchange's request."""
        return request_line({"seq": exchange.number, **write_request(exchange.request)})

    def queue(self, line: bytes, exchange: Exchange | None = None) -> None:
        """Append a line to the bytes to be sent; ServerUnavailable if nothing more can be sent."""
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
        """Return bytes to be sent now, none if there are none. Requests wait for the server's greeting."""
        if self._hello or not self.greeted:
            return self._hello
        if not self._unsent:
            return b""
        if len(self._unsent) == 1:
            return self._unsent[0][0][self._first_sent_bytes :]
        return b"".join(line for line, _ in self._unsent)[self._first_sent_bytes :]

    def mark_sent(self, count: int) -> None:
        """Note that this many bytes of `outgoing` were taken by the transport."""
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
        """Expect no answer any more, and don't send the request if it can still be held back.

        Return False if a part of the line was sent already: the connection is useless then, and the server must see it
        end. A request without its newline is never carried out.
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
        """Give up all lines that are not sent; what was sent may still be answered.

        Args:
            why: the reason, for requests to come.
            message: the error of those requests that were waiting to be sent.
        """
        self._sending_ended = self._sending_ended or why
        unsent = [exchange for _, exchange in self._unsent if exchange]
        self._drop_lines()
        for exchange in unsent:
            self.fail(exchange, ServerUnavailable(message))

    def answer(self, exchange: Exchange) -> tuple[JsonObject, list[JsonObject]]:
        """Return the reply to a request, and the lines of its list.

        Raises:
            RequestRefused: the server refuses the request.
            ServerUnavailable: the request was not sent, or it was not answered and has no effect that lasts.
            Lost: the request was sent and not answered. It may have an effect.
        """
        if exchange.error is not None:
            raise exchange.error
        if exchange.reply is None:
            raise self.unanswered(exchange)
        if exchange.reply.get("ok") is not True:
            raise self.refusal(exchange.reply, exchange.items)
        return exchange.reply, exchange.items

    def unanswered(self, exchange: Exchange) -> TalkError:
        """Return the error of a request to which no answer will come."""
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
        """Why no answer is waited for any longer."""
        return f"it did not reply within {self._patience:g} s"

    def refusal(self, reply: JsonObject, items: list[JsonObject]) -> TalkError:
        """Return the error for a reply that is not ok; `items`: the lines of its list."""
        from talkcli.terminal.text import printable  # no start pays for it

        error = reply.get("error")
        code, message = (error.get("code"), error.get("message")) if isinstance(error, dict) else (None, None)
        return refusal(str(code), printable(str(message or "refused: the server gives no reason")), items)

    # -- limits

    def answer_by(self, exchange: Exchange) -> float:
        """Return by when (monotonic) the request must be sent; once it was, by when more of its answer must come."""
        if exchange.sent:
            return float("inf") if exchange.slow else exchange.heard_at + self._patience
        ttl = exchange.request.ttl if isinstance(exchange.request, Say) else None
        return exchange.heard_at + min(self._patience, ttl or self._patience)

    def silent_by(self, began: float) -> tuple[float, str]:
        """Return when a silent server counts as gone for a client that waits since `began`, and why it does."""
        if self.absent_since is not None:
            return float("inf"), ""
        return max(began, self._heard) + SILENCE_LIMIT_S, f"it has said nothing for {SILENCE_LIMIT_S:g} s"

    def goals_lost_at(self) -> float:
        """Return when the goals that are followed are lost, because no connection was made again."""
        return float("inf") if self.absent_since is None else self.absent_since + self._patience

    def next_expiry(self) -> float:
        """Return when `expire` has something to do at the latest."""
        times = [self.answer_by(each) for each in self.exchanges.values() if each.on_failure]
        if self.listeners.goals:
            times.append(self.goals_lost_at())
        return min(times, default=float("inf"))

    def expire(self, now: float) -> bool:
        """Fail what has waited too long: requests that nobody waits for, and goals without a connection.

        Return False if a request's line was sent in part, as `forget` does.
        """
        intact = True
        for exchange in [each for each in self.exchanges.values() if each.on_failure and self.answer_by(each) <= now]:
            intact = self.forget(exchange) and intact
            self.fail(exchange, self.unanswered(exchange))
        if now >= self.goals_lost_at():
            self._lose_goals(f"{self.absence}; it may still be spoken")
        return intact

    # -- what comes

    def split(self, data: bytes, now: float) -> list[bytes]:
        """Return the lines that are complete with these bytes, for a shell that passes them on."""
        self._heard = now
        return self._splitter.feed(data)

    def begin_stream(self) -> None:
        """Forget the beginning of a line: what comes next begins another stream."""
        self._splitter = LineSplitter()

    def receive(self, data: bytes, now: float) -> None:
        """Take in received bytes. A malformed line breaks the connection.

        Raises:
            ServerUnavailable, AccessDenied, Busy, ProtocolMismatch: the greeting of a new connection, after
                `connecting`, is that of a server that can't be used.
        """
        splitter = self._splitter
        for line in self.split(data, now):
            if self.ended is not None or self._splitter is not splitter:
                return  # the line before has broken the connection
            if self.greeted:
                self.take_line(line, now)
            else:
                self.connected(*identity(read_greeting(line, self.path, self._version)), now)

    def take_line(self, line: bytes, now: float) -> None:
        """Take in one line of the server's."""
        try:
            self.dispatch(decode(line), now)
        except (BadRequest, ValueError) as error:  # ValueError: a malformed goal or event
            self.break_off(f"it sent what is no message: {error}", now)

    def match(self, message: JsonObject) -> Exchange | None:
        """Return the exchange that a line belongs to, None for an event or an answer that nobody expects."""
        number = message.get("seq")
        return self.exchanges.get(number) if isinstance(number, int) else None

    def dispatch(self, message: JsonObject, now: float) -> Exchange | None:
        """Pass on an event or a line of an answer; return the exchange that ended with it.

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
                if not isinstance(exchange.request, self.lasting):  # else the request may have had its effect
                    exchange.error = error
                if exchange.on_failure:
                    exchange.on_failure(exchange.error or self.unanswered(exchange))
                raise
        exchange.reply = reply  # only now: a reply that can't be read is none

    # -- the end, and another beginning

    def break_off(self, why: str, now: float) -> None:  # noqa: ARG002 - for those that connect again
        """Give up this connection: end, unless a subclass connects again."""
        self.end(why)

    def end(self, why: str) -> None:
        """Note that nothing more will come. What has come before can still be read."""
        if self.ended is not None:
            return
        self.ended = self._last_words or why
        self._drop_lines()
        for exchange in [each for each in self.exchanges.values() if each.on_failure]:
            self.fail(exchange, self.unanswered(exchange))

    def disconnected(self, why: str, now: float) -> None:
        """Note that the connection broke, and will be made again: nothing that waits for an answer gets one."""
        self.absence = self._last_words or why
        self.absent_since, self._last_words, self._sending_ended = now, None, None
        self.greeted, self._hello, self._splitter = False, b"", LineSplitter()
        self._drop_lines()
        for exchange in list(self.exchanges.values()):
            self.fail(exchange, self.unanswered(exchange))
        self.listeners.end_watches(self._nothing_heard(), all_of_them=False)

    def connecting(self, hello: bytes, version: str) -> None:
        """Begin a new connection: requests wait for the server's greeting.

        Args:
            hello: the first line.
            version: this client's, for people.
        """
        self.greeted, self._hello, self._version, self._splitter = False, hello, version, LineSplitter()
        self._sending_ended = None

    def not_connected(self, error: TalkError, why: str) -> None:
        """Note that no new connection was made: requests that somebody waits for fail, others wait for the next one."""
        self._attempt_failure = why
        self.greeted, self._hello = False, b""
        for exchange in [each for each in self.exchanges.values() if not each.on_failure]:
            self.forget(exchange)
            self.fail(exchange, error)

    def connected(self, boot: str, pid: int | None, now: float) -> None:
        """Note that the server has greeted on a new connection.

        If it is the server of the last connection, its goals are followed again; else they are lost.
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
        """Return the line of a request that has waited for the connection; its limits count from now on."""
        request = exchange.request
        if isinstance(request, Say) and request.ttl:
            exchange.request = replace(request, ttl=max(_LEAST_TTL_S, request.ttl - (now - exchange.heard_at)))
        exchange.heard_at = now
        return self.line(exchange)

    def _follow_again(self, goal_id: str, *, feedback: bool, now: float) -> None:
        def on_reply(_: JsonObject, items: list[JsonObject]) -> None:
            for goal in goals(items, "goal"):
                if not goal.state.terminal:  # else its result follows
                    self.listeners.update(goal)

        def on_failure(error: TalkError) -> None:
            if self.absent_since is None:  # else it is followed again after the next connection
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
        """End an exchange with an error."""
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
