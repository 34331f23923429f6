"""The rules by which a bridge accepts or refuses messages from the broker.

Rules for this file: no I/O and no clock. A message is refused before anything is sent to the server. An accepted goal
may still be rejected by the server, which makes all decisions about speech. All stored data is limited in size.
"""

from __future__ import annotations

import contextlib
import re
from typing import TYPE_CHECKING

from talkcli.errors import BadRequest, LineTooLong, RequestRefused
from talkcli.fleet import topics
from talkcli.fleet.payloads import Message
from talkcli.frozen import frozen, replace
from talkcli.goals.options import MAX_SENDER_NAME_CHARS, Append, Pause, Say
from talkcli.protocol.events import failure, take_seq
from talkcli.protocol.lines import MAX_LINE_BYTES, decode, encode
from talkcli.protocol.requests import REQUEST_TYPES, Sounds, read_request

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from talkcli.goals.goal import Goal, JsonObject
    from talkcli.protocol.requests import Request

#: Error code for a message that may be outdated.
STALE_CODE = "stale"
#: Requests that are always allowed. They reveal nothing that the bridge doesn't publish anyway.
ALWAYS_ALLOWED = ("hello", "watch")
#: Requests that are allowed if `say` is allowed.
ALLOWED_WITH_SAY = (Append.kind, Sounds.kind)
#: Requests that can be allowed with the option `--allow`.
ALLOWABLE_REQUESTS = tuple(each for each in REQUEST_TYPES if each not in (*ALWAYS_ALLOWED, *ALLOWED_WITH_SAY))

#: How often the bridge sends an echo to itself.
ECHO_EVERY_S = 5.0
#: A message is stale if its token, or the newest returned echo, is older than this. The extra second is for
#: transmission.
STALE_AFTER_S = ECHO_EVERY_S + 1.0
#: Maximum number of pending goals from remote clients. The server's queue has 100 places by default. The others
#: are left to local clients.
MAX_REMOTE_GOALS = 20
#: Maximum number of messages from one user at once, and per second after that. Further messages are delayed by up to
#: MAX_DELAY_S, and then dropped. Otherwise, a flood could fill the broker's queue for the robot, and the broker would
#: drop messages of all users.
MAX_BURST_MESSAGES, MAX_MESSAGES_PER_S, MAX_DELAY_S = 200, 100, 0.5
_BURST_S = MAX_BURST_MESSAGES / MAX_MESSAGES_PER_S
#: A request with this field is treated as a `cancel` before it is parsed.
_CANCEL = re.compile(rb'"request"\s*:\s*"cancel"')
#: Above this number of users, those who have sent no messages lately are forgotten.
_MANY_USERS = 1_000
#: A user can send another goal if the user has fewer pending goals than this many times the free places. This limits
#: one user to 15 of the 20 places, so that another user finds at least 5 free.
_PENDING_PER_FREE_PLACE = 3
#: How many goal ids to remember, so that no goal is spoken twice, even if the server has forgotten it.
MAX_REMEMBERED_IDS = 1_000
#: Maximum size of the correlation data, which is repeated in the header of each answer.
MAX_CORRELATION_BYTES = 256
#: Fields of a goal that may contain its text. The field `message` may quote the text.
PRIVATE_FIELDS = ("text", "said", "spoken", "message")
#: TTL of a goal whose message expired while the goal was waiting for room. Zero would mean no limit.
_EXPIRED_TTL_S = 0.001


@frozen
class RemoteRequest:
    """An accepted request from a remote client."""

    user: str
    #: topic for the answers; None if the client wants no answers
    reply_topic: str | None
    seq: int | None
    request: Request
    correlation: bytes | None = None
    #: size of the payload, which counts towards the limit for waiting requests
    size_bytes: int = 0
    #: latest time at which the goal may start, by the `boottime` clock; None for no limit
    start_by: float | None = None

    def build_say(self, goal_id: str, now: float) -> Say:
        """Return the `say` request to send, with the goal's id and a TTL within the message's expiry.

        Args:
            goal_id: the goal's id.
            now: the current time, by the `boottime` clock.
        """
        assert isinstance(self.request, Say)
        ttl = self.request.ttl
        if self.start_by is not None:
            left = max(_EXPIRED_TTL_S, self.start_by - now)
            ttl = min(ttl or left, left)
        return replace(self.request, id=goal_id, ttl=ttl)


@frozen
class Refusal:
    """The error for a refused request, and the reply to the client."""

    error: RequestRefused
    #: the message that reports the error to the client; None if the client wants no answers
    reply: Message | None


@frozen
class Goodbye:
    """A client's message that ends its session."""

    user: str
    reply_topic: str


@frozen
class Ignored:
    """A message that is only logged. It is neither carried out nor answered."""

    #: key for limiting how often similar messages are logged
    kind: str
    words: str


Decision = RemoteRequest | Refusal | Goodbye | Ignored


class Policy:
    """Decides which messages to a robot are accepted.

    The bridge sends echoes to itself to detect messages that may be outdated. The broker forwards messages in order. A
    message that arrives after an echo must have been forwarded after the echo was sent. Therefore, the age of the
    newest returned echo limits the delay of the next message. There is no need to compare the clocks of different
    machines.

    Echoes don't show how long a message took to reach the broker. Therefore, a client can send a token with a message.
    The robot has created the token shortly before, so the message can't be older than the token.
    """

    def __init__(self, name: str, allow: Collection[str], session: str = "") -> None:
        """Create the policy of one robot.

        Args:
            name: the robot's name.
            allow: requests that the robot accepts, in addition to `ALWAYS_ALLOWED`.
            session: the random id of the bridge process, which is part of its tokens.
        """
        self._session = session
        #: when each user's next request may be carried out, by the `boottime` clock
        self._next_due: dict[str, float] = {}
        self._name = name
        self._allow = {*allow, *ALWAYS_ALLOWED}
        #: when the newest returned echo was sent, or when the connection was opened, by the `boottime` clock
        self.newest_echo_at = 0.0

    def record_echo(self, sent_at_text: bytes, now: float) -> None:
        """Record when a returned echo was sent, unless a newer echo has already returned.

        An echo is a message from the bridge to itself. Ignore it if its time is invalid or later than `now`.
        """
        with contextlib.suppress(ValueError):
            sent_at = float(sent_at_text)
            if self.newest_echo_at < sent_at <= now:
                self.newest_echo_at = sent_at

    def new_token(self, now: float) -> str:
        """Return a token. Every message with this token must have been sent after `now`."""
        return f"{self._session} {now}"

    def due_time(self, user: str, now: float) -> float | None:
        """Count a user's message. Return when to carry out its request, or None to drop the message.

        The time is by the `boottime` clock. It is in the past if the user has sent few messages lately.
        """
        if len(self._next_due) > _MANY_USERS:
            self._next_due = {each: due for each, due in self._next_due.items() if due > now - _BURST_S}
        due = max(self._next_due.get(user, 0.0), now - _BURST_S)
        if due > now + MAX_DELAY_S:
            return None
        self._next_due[user] = due + 1 / MAX_MESSAGES_PER_S
        return due

    def decide(self, message: Message, kind: str, user: str, now: float) -> Decision:
        """Decide whether to accept, refuse or ignore a message, or to end its client's session.

        Args:
            message: a message on a request topic of the robot or one of its groups.
            kind: the kind of request topic: `topics.REQUEST`, `PLAIN_SAY` or `PLAIN_CANCEL`.
            user: the client's user name.
            now: the current time, by the `boottime` clock.
        """
        if message.retained:
            return Ignored("retained", f"dropped a retained message on {message.topic}, because it may be old")
        reply_topic = None
        if message.response is not None:
            reply_topic = topics.checked_reply_topic(message.response, user, self._name)
            if reply_topic is None:
                words = f"its response topic {message.response} belongs to another client"
                return Ignored("response", f"dropped a message of {user}: {words}")
        if not message.payload and kind != topics.PLAIN_CANCEL:
            if reply_topic is None or kind == topics.PLAIN_SAY:
                return Ignored("empty", f"ignored an empty message on {message.topic}")
            return Goodbye(user, reply_topic)
        repeatable = len(message.correlation or b"") <= MAX_CORRELATION_BYTES
        seq, correlation = None, message.correlation if repeatable else None
        try:
            fields = _parse_request_fields(kind, message.payload)
            seq = take_seq(fields)
            if not repeatable:
                raise BadRequest(f"the correlation data is longer than {MAX_CORRELATION_BYTES} bytes", "bad_field")
            request = read_request(fields)
            self._check_request(request, message.token, now)
        except BadRequest as error:
            line = encode(failure(seq, error.code, error.message))
            reply = None if reply_topic is None else Message(reply_topic, line, correlation=correlation)
            return Refusal(error, reply)
        start_by = None if message.expiry is None else now + message.expiry
        size = 0 if kind == topics.PLAIN_CANCEL else len(message.payload)
        return RemoteRequest(user, reply_topic, seq, request, correlation, size, start_by)

    def _check_request(self, request: Request, token: str | None, now: float) -> None:
        """Raise BadRequest if a request from the broker is not allowed, or if a `say` may be too old."""
        needed = Say.kind if request.kind in ALLOWED_WITH_SAY else request.kind
        if needed not in self._allow:
            words = f"this robot's bridge does not allow {needed} requests; add {needed} to its --allow"
            raise BadRequest(words, "not_allowed")
        if isinstance(request, Pause) and request.while_connected:
            raise BadRequest("'while_connected' doesn't work over a broker; use 'seconds' instead", "bad_option")
        if isinstance(request, Say) and self._is_stale(token, now):
            limit = f"{STALE_AFTER_S:g} s"
            why = f"the sentence may be more than {limit} old, because the broker or a connection to it stalled"
            raise BadRequest(f"{why}; send the sentence again if it is still true", STALE_CODE)

    def _is_stale(self, token: str | None, now: float) -> bool:
        """Return whether a message may be too old. If it has no token, judge by the newest echo.

        The time in the token of another bridge process can't be compared, so such a message counts as too old.
        """
        if token is None:
            return now - self.newest_echo_at > STALE_AFTER_S
        session, _, made_at = token.partition(" ")
        try:
            return session != self._session or not 0 <= now - float(made_at) <= STALE_AFTER_S
        except ValueError:
            return True


def _parse_request_fields(kind: str, payload: bytes) -> JsonObject:
    """Parse a payload. Return the fields of the request.

    Raises:
        BadRequest: the payload is malformed.
    """
    if kind == topics.PLAIN_CANCEL:
        return {"request": "cancel"}
    line = payload.removesuffix(b"\n") if kind == topics.REQUEST else payload
    if len(line) >= MAX_LINE_BYTES:
        raise LineTooLong(f"the request is longer than {MAX_LINE_BYTES:,} bytes")
    if kind == topics.REQUEST:
        return decode(line)
    try:
        return {"request": "say", "text": line.decode()}
    except UnicodeDecodeError as error:
        words = f"the text must be UTF-8, but byte {error.start} is invalid"
        raise BadRequest(words, "bad_encoding") from None


class SentIds:
    """The ids of goals that remote clients sent recently, with their senders and servers.

    A server is identified by its boot id.
    """

    def __init__(self) -> None:
        #: for each goal id: the boot id of the goal's server, the sender's user name, and whether the goal counts
        #: towards the limit
        self._sent: dict[str, tuple[str, str, bool]] = {}

    def boot_of(self, goal_id: str) -> str | None:
        """Return the boot id of the server that got a goal. If the goal is unknown, return None."""
        return self._sent[goal_id][0] if goal_id in self._sent else None

    def user_of(self, goal_id: str) -> str | None:
        """Return the user name of a goal's sender. If the goal is unknown, return None."""
        return self._sent[goal_id][1] if goal_id in self._sent else None

    def is_counted(self, goal_id: str, boot: str) -> bool:
        """Return whether a goal was sent to the server with this boot id and counts towards the limit."""
        return self.boot_of(goal_id) == boot and self._sent[goal_id][2]

    def add(self, goal_id: str, boot: str, user: str, *, counted: bool = True) -> None:
        """Record that a user sent a goal to the server with this boot id.

        Forget the oldest goal if there are too many.
        """
        self._sent.pop(goal_id, None)
        self._sent[goal_id] = boot, user, counted
        if len(self._sent) > MAX_REMEMBERED_IDS:
            del self._sent[next(iter(self._sent))]

    def discard(self, goal_id: str) -> None:
        """Forget a goal that the server didn't accept."""
        self._sent.pop(goal_id, None)


class RemoteGoals:
    """Keeps track of remote clients' pending goals, including goals that are being sent.

    Goals with `preempt` or `flush` aren't counted. A goal's reply and its events arrive on different connections, in
    any order.
    """

    def __init__(self, ids: SentIds) -> None:
        """Create an empty collection. `ids` contains the senders of the goals."""
        self._ids = ids
        #: for each goal id: the goal's key, and whether the server has confirmed that the goal is pending
        self._goals: dict[str, tuple[str | None, bool]] = {}

    def __len__(self) -> int:
        return len(self._goals)

    @property
    def pending_count(self) -> int:
        """The number of goals that the server has confirmed as pending."""
        return sum(pending for _, pending in self._goals.values())

    def count(self, user: str) -> int:
        """Return the number of a user's goals."""
        return sum(self._ids.user_of(each) == user for each in self._goals)

    @staticmethod
    def counts(say: Say) -> bool:
        """Return whether a goal counts towards the limit for remote goals."""
        return not (say.preempt or say.flush)

    def has_room(self, say: Say, user: str) -> bool:
        """Return whether a user's goal can be sent without exceeding the limits for remote goals.

        There is always room for a goal that replaces another goal with the same key.
        """
        replaces = say.key is not None and any(key == say.key for key, _ in self._goals.values())
        free = MAX_REMOTE_GOALS - len(self)
        return self.count(user) < _PENDING_PER_FREE_PLACE * free or not self.counts(say) or replaces

    def add(self, goal_id: str, key: str | None) -> None:
        """Add a goal that is being sent to the server, unless it is already known."""
        self._goals.setdefault(goal_id, (key, False))

    def record_reply(self, goal_id: str, *, pending: bool) -> None:
        """Depending on the server's reply to `say`, record that a goal is pending or remove the goal.

        The reply is ignored if an event has already confirmed that the goal is pending.

        Args:
            goal_id: the goal's id.
            pending: whether the goal is pending. Pass False if there will be no reply.
        """
        key, is_known = self._goals.get(goal_id, (None, True))
        if not is_known and pending:
            self._goals[goal_id] = key, True
        elif not is_known:
            del self._goals[goal_id]

    def record_pending(self, goal_id: str, key: str | None) -> None:
        """Record that a goal is pending, as reported by an event."""
        self._goals[goal_id] = key, True

    def remove(self, goal_id: str) -> bool:
        """Remove a goal that is no longer pending. Return whether it was recorded."""
        return self._goals.pop(goal_id, None) is not None

    def replace_pending(self, pending: Iterable[tuple[str, str | None]]) -> None:
        """Replace the goals recorded as pending. Each pair in `pending` is a goal's id and key.

        Goals that are still on their way to the server are kept.
        """
        self._goals = {each: found for each, found in self._goals.items() if not found[1]}
        self._goals |= {goal_id: (key, True) for goal_id, key in pending}


def without_texts(message: JsonObject, hidden: tuple[str, ...] = ("text", "said", "spoken")) -> JsonObject:
    """Return a copy of a message in which the `hidden` fields of each goal are null."""
    return {
        name: {**each, **dict.fromkeys(hidden)} if isinstance(each, dict) and "text" in each else each
        for name, each in message.items()
    }


def is_cancel(message: Message, kind: str) -> bool:
    """Return whether a message looks like a `cancel`, which is neither delayed nor dropped."""
    return kind == topics.PLAIN_CANCEL or (kind == topics.REQUEST and bool(_CANCEL.search(message.payload)))


def sender_name(user: str, name: str | None = None) -> str:
    """Return the name under which the server knows a remote client.

    It consists of the client's user name and the name that the client gave itself, if any.
    """
    return f"{topics.REMOTE_PREFIX}{user} {name}"[:MAX_SENDER_NAME_CHARS] if name else f"{topics.REMOTE_PREFIX}{user}"


def remote_user(goal: Goal) -> str | None:
    """Return the user name of a goal's remote sender. For a local sender, return None."""
    name = (goal.client and goal.client.name) or ""
    return name.removeprefix(topics.REMOTE_PREFIX).split(" ")[0] if name.startswith(topics.REMOTE_PREFIX) else None
