"""Sessions of remote clients.

Each session is one client's connection to the robot's server.

A session sends its client's requests to the server and publishes the server's lines in their order. `policy` has
already accepted the requests. If too many goals are pending, a patient goal waits here for room, and other goals are
rejected.
"""

from __future__ import annotations

import asyncio
import random
import time
from collections import Counter, deque
from typing import TYPE_CHECKING

from talkcli.client.core import Exchange
from talkcli.daemon import log
from talkcli.errors import BadRequest, Busy, TalkError
from talkcli.fleet.bridge import policy
from talkcli.fleet.bridge.local import LocalConnection
from talkcli.fleet.link import boottime
from talkcli.fleet.payloads import Message
from talkcli.frozen import frozen, replace
from talkcli.goals.goal import By, Goal, Sender
from talkcli.goals.options import SHOWN_OPTIONS, Append, Cancel, Log, Pause, Say, Set
from talkcli.goals.states import State
from talkcli.protocol.events import Result, StateChanged, failure, item, ok
from talkcli.protocol.lines import MAX_LINE_BYTES, decode, encode
from talkcli.protocol.requests import Hello, Resume, Status, Wait, Watch

if TYPE_CHECKING:
    from collections.abc import Callable

    from talkcli.fleet.bridge.policy import RemoteRequest
    from talkcli.goals.goal import JsonObject
    from talkcli.protocol.requests import Request

#: Maximum number of sessions. Each has a connection to the server, which accepts 256 connections by default.
MAX_SESSIONS = 32
#: If another user needs a session, a user with more sessions than this may lose the oldest one.
MAX_USER_SESSIONS = 8
#: Maximum number of unanswered requests per client.
MAX_WAITING_REQUESTS = 64
#: Maximum total size of all clients' unanswered requests. For `cancel` and `status`, the limit is twice as high.
MAX_WAITING_BYTES = 4 * 1024 * 1024
#: A client's session ends if the client sends nothing for this long, because MQTT doesn't report when a client leaves.
#: Waiting clients send `hello` every 30 s, so that two of these messages may get lost.
CLIENT_SILENCE_LIMIT_S = 90.0
#: A generated goal id begins with the robot's name, which is cut to this length. An id has at most 64 characters.
_MAX_ID_PREFIX_CHARS = 48
#: Message to a client after the server has closed the client's connection.
_SERVER_GONE = "the robot's talk server closed the connection"
_ALIVE = b'{"event": "alive"}\n'
#: Lines that start with one of these prefixes are published with QoS 0, because losing them does no harm.
_UNRELIABLE = (b'{"event": "word"', b'{"event": "alive"')


class RemoteSessions:
    """Manages the sessions of all remote clients, and the limits that they share."""

    def __init__(
        self,
        name: str,
        socket: str | None,
        publish: Callable[[Message, int], None],
        max_payload: Callable[[], int],
        on_change: Callable[[], None],
        new_token: Callable[[], str],
        on_end: Callable[[Goal], None],
        *,
        with_text: bool = True,
    ) -> None:
        """Create an empty collection of sessions.

        Args:
            name: the robot's name.
            socket: path of the server's socket, or None for the default locations.
            publish: publishes lines for a client, with a QoS of 0 or 1.
            max_payload: returns the size of the largest payload that the broker accepts, in bytes.
            on_change: called when the number of pending goals may have changed.
            new_token: returns a new token, which shows a client's requests to be recent.
            on_end: called after a goal has ended without being sent to the server.
            with_text: whether the status, the events and the answers to `watch`, to `log` and to a `status` with an id
                contain the texts of goals.
        """
        self.name, self.socket, self.with_text = name, socket, with_text
        self.publish, self.max_payload, self.new_token, self.on_end = publish, max_payload, new_token, on_end
        self.ids = policy.SentIds()
        self.goals = policy.RemoteGoals(self.ids)
        #: limits the number of connections that are waiting for the server's greeting
        self.dialing = asyncio.Semaphore(MAX_SESSIONS)
        #: cleared while the broker is slow, so that sessions stop reading from the server
        self.may_read = asyncio.Event()
        self.may_read.set()
        #: goals that are waiting for room in the server's queue, oldest first
        self.waiting: list[tuple[RemoteRequest, Say, RemoteSession]] = []
        self._on_change = on_change
        self._loop = asyncio.get_running_loop()
        self._sessions: dict[tuple[str, str | None], RemoteSession] = {}
        self._release_handle: asyncio.Handle | None = None
        #: the client that cancelled pending goals after the last run of `_send_or_cancel_waiting`, or None
        self._canceled_by: By | None = None

    # -- from the broker

    def submit(self, request: RemoteRequest) -> None:
        """Pass a request to its client's session, or to a new one. Refuse it if there are too many."""
        key = request.user, request.reply_topic
        session = self._sessions.get(key) or RemoteSession(self, *key)
        if key in self._sessions or self._make_room(request.user, urgent=isinstance(request.request, Cancel | Status)):
            self._sessions[key] = session
            session.submit(request)
        else:
            session.refuse(request, Busy.code, f"{self.name} already has {MAX_SESSIONS} remote clients")

    def handle_goodbye(self, user: str, reply_topic: str) -> None:
        """After a client's goodbye, end its session as soon as requests with a lasting effect are answered."""
        if session := self._sessions.get((user, reply_topic)):
            session.handle_goodbye()

    def end_all(self) -> None:
        """End all sessions without informing their clients."""
        for session in list(self._sessions.values()):
            session.end()
        self.may_read.set()

    def tick(self) -> None:
        """End the sessions of silent clients. Tell other clients if their goals are still waiting.

        Call this every few seconds.
        """
        now = self._loop.time()
        for session in list(self._sessions.values()):
            if now - session.used_at > CLIENT_SILENCE_LIMIT_S:
                limit = f"{CLIENT_SILENCE_LIMIT_S:g} s"
                session.end(f"this client sent nothing for {limit}; a waiting client must send hello every 30 s")
            else:
                session.send_alive()

    def _make_room(self, user: str, *, urgent: bool) -> bool:
        """End a session if there are too many. Return whether there is room for a user's new session.

        Preferably, an idle session is ended. Otherwise, a user with few sessions takes the place of a user with many.
        For an `urgent` request, any session may be ended. A user with many sessions only gets places of users with at
        least as many.
        """
        if len(self._sessions) < MAX_SESSIONS:
            return True
        counts = Counter(each.user for each in self._sessions.values())
        sessions = list(self._sessions.values())
        if counts[user] >= MAX_USER_SESSIONS:
            sessions = [each for each in sessions if counts[each.user] >= counts[user]]
            crowded = []
        else:
            crowded = [each for each in sessions if counts[each.user] > MAX_USER_SESSIONS]
        candidates = [each for each in sessions if each.idle] or crowded or (sessions if urgent else [])
        if candidates:
            oldest = min(candidates, key=lambda each: each.used_at)
            oldest.end("the session was closed to make room for another client")
        return bool(candidates)

    # -- from the sessions

    def forget(self, session: RemoteSession) -> None:
        """Remove a session that has ended."""
        self._sessions = {key: each for key, each in self._sessions.items() if each is not session}

    def count_unanswered_bytes(self, user: str | None = None) -> int:
        """Return the total size of the unanswered requests of a user, or of all users."""
        sessions = [each for each in self._sessions.values() if user in (None, each.user)]
        return sum(each.size_bytes for session in sessions for each in session.unanswered)

    def has_waiting(self, user: str) -> bool:
        """Return whether any of a user's goals are waiting for room."""
        return any(session.user == user for _, _, session in self.waiting)

    def cancel_waiting(self, cancel: Cancel, canceled_by: By | None) -> list[Goal]:
        """Cancel the goals that wait in the bridge and match a `cancel` request. Return these goals."""
        selected = [self.waiting[each] for each in cancel.select_waiting([say for _, say, _ in self.waiting])]
        self.waiting = [each for each in self.waiting if not any(each is other for other in selected)]
        ending = State.RECALLED, "canceled", "not spoken: the goal was cancelled before it started", canceled_by
        return [session.end_goal(request, say, *ending) for request, say, session in selected]

    def handle_pending_change(self) -> None:
        """Call `on_change`, and schedule `_send_or_cancel_waiting` if any goal waits in the bridge.

        Call this whenever the number of pending goals may have changed. Events that were received together are all
        processed before goals are released.
        """
        self._on_change()
        if self.waiting and self._release_handle is None:
            self._release_handle = self._loop.call_soon(self._send_or_cancel_waiting)

    def _send_or_cancel_waiting(self) -> None:
        """Send waiting goals while there is room, or cancel them if all pending goals were cancelled.

        The goals of each user are sent in their order.
        """
        self._release_handle = None
        canceled_by, self._canceled_by = self._canceled_by, None
        if canceled_by and not self.goals.pending_count:
            # A client has cancelled every pending goal, so cancel the waiting goals, too.
            self.cancel_waiting(Cancel(), canceled_by)
        waiting, self.waiting = self.waiting, []
        for each in waiting:
            request, say, session = each
            if self.has_waiting(session.user) or not self.goals.has_room(say, session.user):
                self.waiting.append(each)
            else:
                session.send_say(request, say, ignore_limit=True)

    # -- from the publisher

    def handle_goal_change(self, event: StateChanged, boot: str) -> None:
        """Record whether a remote goal is now pending, and schedule `_send_or_cancel_waiting`."""
        goal = event.goal
        if event.state is not State.PENDING:
            counted = self.goals.remove(event.id)
            if counted and self.waiting and goal and event.state is State.RECALLED and goal.reason == "canceled":
                self._canceled_by = goal.by
        elif self.ids.is_counted(event.id, boot):
            self.goals.record_pending(event.id, goal.key if goal else None)
        self.handle_pending_change()

    def remember(self, goal: Goal, boot: str) -> None:
        """Remember the id of a goal if a remote client sent it.

        Ignore other goals. An earlier bridge process may have sent the goal. It counts towards the limit even if it was
        sent with `preempt`, because the server doesn't report that.
        """
        if (user := policy.remote_user(goal)) and self.ids.boot_of(goal.id) != boot:
            self.ids.add(goal.id, boot, user)

    def reset_pending(self, pending: tuple[Goal, ...], boot: str) -> None:
        """Replace the recorded pending goals, and schedule `_send_or_cancel_waiting`."""
        self.goals.replace_pending((each.id, each.key) for each in pending if self.ids.is_counted(each.id, boot))
        self.handle_pending_change()


@frozen
class _ReplyLine:
    """A line for a client, with the properties of its MQTT message."""

    line: bytes
    correlation: bytes | None = None
    token: str | None = None


class _RemoteExchange(Exchange):
    """A remote client's request that was sent to the server."""

    def __init__(self, remote_request: RemoteRequest, request: Request, *, is_new: bool = False) -> None:
        super().__init__(request)
        self.remote_request = remote_request
        #: whether a `say` request sends its goal for the first time
        self.is_new = is_new
        #: goals that a `cancel` request has ended before they were sent to the server
        self.canceled: list[Goal] = []

    @property
    def goal_id(self) -> str | None:
        """The goal's id if the request is a `say`, otherwise None."""
        return self.request.id if isinstance(self.request, Say) else None


class RemoteSession:
    """One remote client's connection to the server.

    All methods run in the event loop's thread.
    """

    def __init__(self, sessions: RemoteSessions, user: str, reply_topic: str | None) -> None:
        """Create a session that isn't connected to the server yet.

        Args:
            sessions: all sessions, to which this one belongs.
            user: the client's user name at the broker.
            reply_topic: the topic for answers, or None if the client wants no answers.
        """
        #: when the client sent its last request, by the event loop's clock
        self.used_at = 0.0
        self._sessions = sessions
        self.user, self._reply_topic = user, reply_topic
        self._name = policy.sender_name(user)
        self._loop = asyncio.get_running_loop()
        self._server: LocalConnection | None = None
        self._task: asyncio.Task[None] | None = None
        #: requests to send as soon as the server is connected
        self._queue: deque[RemoteRequest] = deque()
        #: ids of the goals whose results the client is waiting for
        self._awaited: set[str] = set()
        self._watching = False
        #: whether the client has said goodbye
        self._said_goodbye = False
        self._has_ended = False

    # -- from the client

    @property
    def idle(self) -> bool:
        """Whether the client has no unanswered requests, awaits no results, and isn't watching the server."""
        return not (self.unanswered or self._awaited or self._watching)

    def submit(self, request: RemoteRequest) -> None:
        """Send a request, and connect to the server first if necessary. Refuse excess requests."""
        self.used_at = self._loop.time()
        if self._said_goodbye:  # the client has returned
            self._said_goodbye, self._reply_topic = False, request.reply_topic
        urgent = isinstance(request.request, Cancel | Status)
        limit = 2 * MAX_WAITING_BYTES if urgent else MAX_WAITING_BYTES
        shared = self._sessions
        waiting_bytes = max(shared.count_unanswered_bytes(), 2 * shared.count_unanswered_bytes(self.user))
        if isinstance(request.request, Log) and request.request.grep is not None and not self._sessions.with_text:
            self.refuse(request, "not_allowed", "the robot's bridge hides all texts (--no-text), so leave out grep")
        elif len(self.unanswered) >= MAX_WAITING_REQUESTS:
            self.refuse(request, Busy.code, f"{MAX_WAITING_REQUESTS} requests of this client are already waiting")
        elif waiting_bytes + request.size_bytes > limit:
            self.refuse(request, Busy.code, f"{MAX_WAITING_BYTES >> 20} MiB of requests are already waiting")
        elif self._server:
            self._send_request(request)
        else:
            self._queue.append(request)
            if self._task is None:
                self._task = asyncio.create_task(self._run(urgent=urgent))

    def handle_goodbye(self) -> None:
        """After the client's goodbye, end the session as soon as requests with a lasting effect are answered.

        The client gets no more answers, and its waiting goals are dropped.
        """
        self._said_goodbye, self._reply_topic = True, None
        self._drop_waiting()
        self._queue = deque(each for each in self._queue if _has_lasting_effect(each))
        self._end_if_done()

    def end(self, why: str | None = None) -> None:
        """End the session, and drop its queued requests.

        The server cancels unfinished requests, if possible.

        Args:
            why: a message for the client, which is sent only if the client is waiting for something.
        """
        if why and not self.idle:
            self._send_gone(why)
        self._has_ended, self._reply_topic = True, None
        self._queue.clear()
        if self._task and self._server:
            self._task.cancel()
        self._clean_up()

    def send_alive(self) -> None:
        """Tell the client if one of its goals is still waiting for room in the server's queue."""
        if self._find_waiting():
            self._publish([_ReplyLine(_ALIVE)])

    @property
    def _exchanges(self) -> list[_RemoteExchange]:
        """The requests that the server has not answered yet."""
        exchanges = self._server.exchanges.values() if self._server else ()
        return [each for each in exchanges if isinstance(each, _RemoteExchange)]

    @property
    def unanswered(self) -> list[RemoteRequest]:
        """The client's unanswered requests, including goals that are waiting for room."""
        return [*self._queue, *(each.remote_request for each in self._exchanges), *self._find_waiting()]

    def _find_waiting(self) -> list[RemoteRequest]:
        """Return the client's goals that are waiting for room in the server's queue."""
        return [request for request, _, session in self._sessions.waiting if session is self]

    def _drop_waiting(self) -> None:
        """Drop the client's goals that are waiting for room, without informing the client."""
        self._sessions.waiting = [each for each in self._sessions.waiting if each[2] is not self]

    def _end_if_done(self) -> None:
        """End the session if its client has left and all requests with a lasting effect are answered.

        If `end` was called before the server was connected, close the connection.
        """
        if self._has_ended or (self._said_goodbye and not any(map(_has_lasting_effect, self.unanswered))):
            self.end()

    # -- to the server

    def _send_request(self, remote_request: RemoteRequest) -> None:
        """Send a client's request to the server. Change, delay or refuse it if necessary."""
        request = remote_request.request
        if isinstance(request, Say) and not request.dry_run:
            self.send_say(remote_request, request)
        elif isinstance(request, Cancel):
            self._send_cancel(remote_request, request)
        elif isinstance(request, Append) and (owner := self._sessions.ids.user_of(request.id)) != self.user:
            code = "not_sender" if owner else "unknown_goal"
            self.refuse(remote_request, code, f"the goal {request.id} was not sent by {self.user}")
        else:
            if isinstance(request, Hello):
                self._name = policy.sender_name(self.user, request.name)
                request = replace(request, name=self._name)
            self._watching = self._watching or isinstance(request, Watch)
            self._send(_RemoteExchange(remote_request, request))

    def send_say(self, remote_request: RemoteRequest, say: Say, *, ignore_limit: bool = False) -> None:
        """Send a goal to the server. If too many goals are pending, delay the goal or reject it.

        Args:
            remote_request: the client's request.
            say: the goal in it.
            ignore_limit: whether to send the goal even if other goals are waiting.
        """
        shared, server = self._sessions, self._server
        assert server
        goal_id = say.id or self._new_goal_id()
        boot, counted = shared.ids.boot_of(goal_id), shared.goals.counts(say)
        owner = shared.ids.user_of(goal_id) or self.user
        if boot not in (None, server.boot):
            words = f"{goal_id} was sent to a server that has ended; it may have been spoken"
            self.refuse(remote_request, "lost", words)
        elif say.more and owner != self.user:
            self.refuse(remote_request, "not_sender", f"the goal {goal_id} was not sent by {self.user}")
        elif ignore_limit or (
            shared.goals.has_room(say, self.user) and not (counted and shared.has_waiting(self.user))
        ):
            request = remote_request.build_say(goal_id, boottime())
            if self._send(_RemoteExchange(remote_request, request, is_new=boot is None)):
                shared.ids.add(goal_id, server.boot, owner, counted=counted)
                if counted:
                    shared.goals.add(goal_id, say.key)
        elif say.patient:
            shared.waiting.append((remote_request, say, self))
        else:
            count, total = shared.goals.count(self.user), len(shared.goals)
            words = f"{total} goals of remote clients are already waiting, {count} of them from {self.user}"
            log.write_limited("full", f"rejected a goal of {self.user}: {words}")
            # Like the server, don't give a rejected goal the id that its client has chosen.
            self.end_goal(remote_request, replace(say, id=None), State.REJECTED, "queue_full", f"not spoken: {words}")

    def _send_cancel(self, remote_request: RemoteRequest, cancel: Cancel) -> None:
        """Cancel waiting goals, and then send the `cancel` request to the server.

        The server doesn't know about waiting goals.
        """
        goals = self._sessions.cancel_waiting(cancel, By(client=Sender(name=self._name)))
        canceled = {each.id for each in goals}
        if cancel.ids is not None:
            cancel = replace(cancel, ids=tuple(each for each in cancel.ids if each not in canceled))
        if cancel.before in canceled:
            cancel = replace(cancel, before=None, ids=cancel.ids or ())
        exchange = _RemoteExchange(remote_request, cancel)
        exchange.canceled = goals
        self._send(exchange)

    def _send(self, exchange: _RemoteExchange) -> bool:
        """Send a request to the server. If it is too long, refuse it and return False."""
        assert self._server
        if not self._server.send(exchange):
            words = f"the request is longer than {MAX_LINE_BYTES:,} bytes"
            self.refuse(exchange.remote_request, "line_too_long", words)
            return False
        return True

    def _new_goal_id(self) -> str:
        """Generate an id for a goal without an id."""
        return f"{self._sessions.name[:_MAX_ID_PREFIX_CHARS]}-x{random.getrandbits(48):012x}"

    # -- from the server

    async def _run(self, *, urgent: bool) -> None:
        """Connect to the server, send queued requests, and publish lines until the connection ends."""
        shared = self._sessions
        try:
            # A session that ends while it connects keeps its slot until the server answers, because a hanging server's
            # backlog also contains closed connections.
            async with shared.dialing:
                if self._has_ended:
                    return
                self._server = server = await LocalConnection.open(shared.socket, name=self._name, urgent=urgent)
            while self._queue:
                self._send_request(self._queue.popleft())
            self._end_if_done()
            while lines := await server.read():
                self._receive(lines)
                await shared.may_read.wait()
            for request in self._find_waiting():
                self.refuse(request, "no_server", _SERVER_GONE)
            self._send_gone(_SERVER_GONE)
        except TalkError as error:  # the connection failed
            code = Busy.code if isinstance(error, Busy) else "no_server"
            while self._queue:
                self.refuse(self._queue.popleft(), code, " ".join(str(error).split()))
        except Exception as error:  # noqa: BLE001 - a bug in one session must not end the others
            log.write_bug("a client's session", error)
        self._clean_up()

    def _receive(self, lines: list[bytes]) -> None:
        """Publish lines from the server for the client. Leave out private texts."""
        answers: list[_ReplyLine] = []
        for line in lines:
            try:
                message = decode(line)
            except BadRequest as error:
                log.write_limited("server", f"the server sent a malformed message: {error}")
                continue
            if "seq" in message:
                answers += self._process_answer(message)
            elif "event" in message:
                is_result = message["event"] == "result"
                if is_result and isinstance(goal := message.get("goal"), dict):
                    self._awaited.discard(str(goal.get("id")))
                if is_result or self._sessions.with_text or message.get("id") in self._awaited:
                    answers.append(_ReplyLine(line + b"\n"))
                elif message["event"] not in {"text", "word"}:
                    answers.append(_ReplyLine(encode(policy.without_texts(message, policy.PRIVATE_FIELDS))))
        self._publish(answers)
        self._end_if_done()

    def _process_answer(self, message: JsonObject) -> list[_ReplyLine]:
        """Convert one line of an answer to lines for the client. Add a token to the answer to `hello`."""
        assert self._server
        exchange = self._server.match(message)
        if not isinstance(exchange, _RemoteExchange):
            return []
        del message["seq"]
        remote_request, request, goal = exchange.remote_request, exchange.remote_request.request, message.get("goal")
        state: State | None = None
        if isinstance(goal, dict):
            state = State.__members__.get(str(goal.get("state")))
            waits = isinstance(request, Wait) or (isinstance(request, Say) and (request.wait or request.feedback))
            if waits and goal.get("id") and state is not None and not state.terminal:
                self._awaited.add(str(goal.get("id")))
        shows_others = isinstance(request, Watch | Log) or (isinstance(request, Status) and request.id is not None)
        if shows_others and not self._sessions.with_text:
            message = policy.without_texts(message, policy.PRIVATE_FIELDS)
        found: list[JsonObject] = []
        if "ok" in message:
            self._server.forget(exchange)
            self._record_say_reply(exchange, state, refused=message["ok"] is not True or state is State.REJECTED)
            found = [{"canceled": each.to_json()} for each in exchange.canceled]
            count = message.get("count")
            if found and isinstance(count, int):
                message["count"] = count + len(found)
        token = self._sessions.new_token() if isinstance(request, Hello) else None
        lines = [encode(item(remote_request.seq, **each)) for each in (*found, message)]
        return [_ReplyLine(each, remote_request.correlation, token) for each in lines]

    def _record_say_reply(self, exchange: _RemoteExchange, state: State | None, *, refused: bool) -> None:
        """Record from the reply to a `say` request whether the goal is pending.

        Forget the id of a refused goal.
        """
        if exchange.goal_id is not None:
            self._sessions.goals.record_reply(exchange.goal_id, pending=state is State.PENDING)
            if exchange.is_new and refused:
                self._sessions.ids.discard(exchange.goal_id)
            self._sessions.handle_pending_change()

    # -- to the client

    def refuse(self, request: RemoteRequest, code: str, message: str) -> None:
        """Answer a client's request with an error. Log the error if the client wants no answers."""
        if self._reply_topic is None:
            log.write_limited(code, f"refused a request of {self.user}: {log.sanitize(message)}")
        self._publish([_ReplyLine(encode(failure(request.seq, code, message)), request.correlation)])

    def end_goal(
        self, remote_request: RemoteRequest, say: Say, state: State, reason: str, message: str, by: By | None = None
    ) -> Goal:
        """End a goal that was never sent to the server, and inform the client. Return the ended goal.

        The client gets the lines that the server would send.

        Args:
            remote_request: the client's request.
            say: the goal in it.
            state: the goal's end state.
            reason: the machine-readable reason for the end.
            message: the human-readable reason for the end.
            by: the client that cancelled the goal, or None.
        """
        goal_id, sender, now = say.id or self._new_goal_id(), Sender(name=policy.sender_name(self.user)), time.time()
        goal = Goal(goal_id, state, say.text, reason, by, message, client=sender, queued_at=now, ended_at=now)
        goal = replace(goal, **{name: getattr(say, name) for name in SHOWN_OPTIONS})
        lines = [_ReplyLine(encode(ok(remote_request.seq, goal=goal.to_json())), remote_request.correlation)]
        if say.wait or say.feedback:
            events = StateChanged(goal_id, state, now).to_json(), Result(goal).to_json()
            lines += [_ReplyLine(encode(each)) for each in events]
        self._publish(lines)
        self._sessions.on_end(goal)
        return goal

    def _send_gone(self, why: str) -> None:
        """Tell the client that the session has ended."""
        self._publish([_ReplyLine(encode({"event": "gone", "message": why}))])

    def _publish(self, lines: list[_ReplyLine]) -> None:
        """Publish lines for the client.

        Consecutive lines with the same properties are published in one message if they fit.
        """
        if self._reply_topic is None:
            return
        limit = self._sessions.max_payload()
        message, reliable = Message(self._reply_topic, b""), False
        for each in lines:
            line = each.line if len(each.line) <= limit else self._shorten_line(each.line, limit)
            same = (each.correlation, each.token) == (message.correlation, message.token)
            if message.payload and not (same and len(message.payload) + len(line) <= limit):
                self._sessions.publish(message, int(reliable))
                message, reliable = replace(message, payload=b""), False
            payload = message.payload + line
            message = replace(message, payload=payload, correlation=each.correlation, token=each.token)
            reliable = reliable or not line.startswith(_UNRELIABLE)
        if message.payload:
            self._sessions.publish(message, int(reliable))

    def _shorten_line(self, line: bytes, limit: int) -> bytes:
        """Shorten a line that is too long for the broker. Return the new line.

        Return the line without texts if that is short enough. Otherwise, return an error in place of a reply, and an
        empty line in place of an event.
        """
        message = decode(line)
        shorter = encode(policy.without_texts(message))
        if len(shorter) <= limit:
            return shorter
        words = f"it has {len(line):,} bytes, but the broker accepts at most {limit:,}"
        if "ok" in message:
            seq = message.get("seq")
            return encode(failure(seq if isinstance(seq, int) else None, "too_long", f"the reply was dropped: {words}"))
        log.write_limited("long", f"dropped a message for a client: {words}")
        return b""

    def _clean_up(self) -> None:
        """Close the connection to the server, and remove this session and its unanswered requests."""
        shared = self._sessions
        self._drop_waiting()
        for exchange in self._exchanges:
            if exchange.goal_id is not None:
                shared.goals.record_reply(exchange.goal_id, pending=False)
        if self._server:
            self._server.exchanges.clear()
            self._server.close()
        shared.forget(self)
        shared.handle_pending_change()


def _has_lasting_effect(remote_request: RemoteRequest) -> bool:
    """Return whether a request must be carried out even if its client has left.

    A `patient` goal is dropped in that case.
    """
    request = remote_request.request
    lasting = Append | Cancel | Set | Pause | Resume
    return not request.patient if isinstance(request, Say) else isinstance(request, lasting)
