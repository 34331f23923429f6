"""What a robot accepts over the broker, and what the bridge remembers to decide that.

Pure. It decides about messages, never about speech, which is the server's job. A message is refused before anything is
sent to the server. Everything that is remembered has a limit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from talkcli.errors import BadRequest, LineTooLong, RequestRefused
from talkcli.fleet import topics
from talkcli.frozen import frozen, replace
from talkcli.goals.goal import By, Goal, Sender
from talkcli.goals.options import MAX_SENDER_NAME_CHARS, SHOWN_OPTIONS, Say
from talkcli.protocol.events import Result, StateChanged, ok, take_seq
from talkcli.protocol.lines import MAX_DIGITS, MAX_LINE_BYTES, decode
from talkcli.protocol.requests import REQUEST_TYPES, read_request

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from talkcli.fleet.payloads import Message
    from talkcli.goals.goal import JsonObject
    from talkcli.goals.states import State
    from talkcli.protocol.requests import Request

#: The error code for a message that may be old.
STALE_CODE = "stale"
#: Requests that are always allowed. They tell nothing that the broker doesn't publish anyway.
ALWAYS_ALLOWED = ("hello", "watch")
#: Requests that the option `--allow` can name.
ASKABLE = tuple(each for each in REQUEST_TYPES if each not in ALWAYS_ALLOWED)

#: Time between two echoes that the bridge sends to itself.
ECHO_EVERY_S = 5.0
#: If the newest echo that returned was sent longer ago, messages are stale: one interval, and a second for the way.
STALE_AFTER_S = ECHO_EVERY_S + 1.0
#: How many echoes may be on their way: those of half a minute, and some more.
_MAX_ECHOES = 32
#: How many goals of remote clients may be pending. The rest of the queue (usually 100) is for the robot's own goals.
MAX_REMOTE_GOALS = 20
#: How many ids of goals are remembered, so that no goal is spoken twice although the server forgot it.
MAX_REMEMBERED_IDS = 1_000
#: Longest correlation data. They are repeated in the header of each answer.
MAX_CORRELATION_BYTES = 256
#: The ttl of a goal whose message expired while the goal waited for room. Zero would mean no limit.
_EXPIRED_TTL_S = 0.001


@frozen
class RemoteRequest:
    """A request from the broker that may be carried out."""

    user: str
    #: where to publish the answers; None if nobody wants any
    reply_topic: str | None
    seq: int | None
    request: Request
    correlation: bytes | None = None
    #: size of the payload, which counts while the request waits
    size_bytes: int = 0
    #: when its goal must have started, by the clock of `judge`; None for no limit
    start_by: float | None = None

    def say(self, goal_id: str, now: float) -> Say:
        """Return the `say` for the server, with an id, and with a ttl that respects the expiry of the message.

        Args:
            goal_id: the goal's id.
            now: the current time by the clock of `judge`.
        """
        assert isinstance(self.request, Say)
        ttl = self.request.ttl
        if self.start_by is not None:
            left = max(_EXPIRED_TTL_S, self.start_by - now)
            ttl = min(ttl or left, left)
        return replace(self.request, id=goal_id, ttl=ttl)


@frozen
class Refusal:
    """A request that is answered with an error."""

    reply_topic: str | None
    seq: int | None
    correlation: bytes | None
    error: RequestRefused


@frozen
class Goodbye:
    """A message that ends a client's session."""

    user: str
    reply_topic: str


@frozen
class Ignored:
    """A message that gets no answer, only a line in the log."""

    #: for the log, which limits how often it shows the same kind
    kind: str
    words: str


class Policy:
    """The rules for messages to one robot."""

    def __init__(self, name: str, allow: Collection[str]) -> None:
        """`name` is the robot's name, `allow` the kinds of requests that it accepts."""
        self._name = name
        self._allow = {*allow, *ALWAYS_ALLOWED}

    def judge(
        self, message: Message, topic: topics.RequestTopic, now: float, *, stale: bool
    ) -> RemoteRequest | Refusal | Goodbye | Ignored:
        """Decide what to do with a message.

        Args:
            message: the message.
            topic: the parts of its topic.
            now: seconds by a clock that goes on while the robot is suspended.
            stale: whether the message may be old.
        """
        if message.retained:
            return Ignored("retained", f"a retained message on {message.topic} is dropped: it is no request of now")
        reply_topic = None
        if message.response is not None:
            reply_topic = topics.checked_reply(message.response, topic.user, self._name)
            if reply_topic is None:
                words = f"its response topic, {message.response}, is not its own"
                return Ignored("response", f"a message of {topic.user} is dropped: {words}")
        if not message.payload and topic.kind != topics.PLAIN_CANCEL:
            if reply_topic is None or topic.kind == topics.PLAIN_SAY:
                return Ignored("empty", f"an empty message on {message.topic} asks for nothing")
            return Goodbye(topic.user, reply_topic)
        seq, correlation = None, _repeatable(message.correlation)
        try:
            fields = _request_fields(topic.kind, message.payload)
            seq = take_seq(fields)
            if correlation != message.correlation:
                raise BadRequest(f"correlation data have at most {MAX_CORRELATION_BYTES} bytes", "bad_field")
            request = read_request(fields)
            if request.kind not in self._allow:
                words = f"this robot takes no {request.kind} from afar: see its --allow"
                raise BadRequest(words, "not_allowed")
            if stale and isinstance(request, Say):
                words = "the line to the broker stalled, so this may be old: say it again if it still holds"
                raise BadRequest(words, STALE_CODE)
        except BadRequest as error:
            return Refusal(reply_topic, seq, correlation, error)
        start_by = None if message.expiry is None else now + message.expiry
        size = 0 if topic.kind == topics.PLAIN_CANCEL else len(message.payload)
        return RemoteRequest(topic.user, reply_topic, seq, request, correlation, size, start_by)


def _request_fields(kind: str, payload: bytes) -> JsonObject:
    """Return the fields of the request in a payload. Raise BadRequest if there is none."""
    if kind == topics.PLAIN_CANCEL:
        return {"request": "cancel"}
    line = payload.removesuffix(b"\n") if kind == topics.REQUEST else payload
    if len(line) >= MAX_LINE_BYTES:
        raise LineTooLong(f"a request has at most {MAX_LINE_BYTES} bytes")
    if kind == topics.REQUEST:
        return decode(line)
    try:
        return {"request": "say", "text": line.decode()}
    except UnicodeDecodeError as error:
        words = f"a text is UTF-8, but byte {error.start} of this one is not"
        raise BadRequest(words, "bad_encoding") from None


def _repeatable(correlation: bytes | None) -> bytes | None:
    """Return correlation data, or None if they are too long to be repeated in answers."""
    return correlation if len(correlation or b"") <= MAX_CORRELATION_BYTES else None


class EchoTracker:
    """Limits the age of messages, by means of echoes that the bridge sends to itself through the broker.

    The broker forwards messages in order. So a message that comes after an echo was forwarded after the echo was sent,
    and can't be older than that. No clocks are compared.
    """

    def __init__(self, now: float) -> None:
        """`now` is when the connection was made. No message on it is older."""
        self._newest_at = now
        self._sent: dict[int, float] = {}
        self._number = 0

    def add(self, now: float) -> int:
        """Return the number for an echo that is sent now."""
        self._number += 1
        self._sent[self._number] = now
        while len(self._sent) > _MAX_ECHOES:
            del self._sent[next(iter(self._sent))]
        return self._number

    def returned(self, number_text: bytes) -> bool:
        """Record that an echo has returned, and return whether it was awaited."""
        number = int(number_text) if number_text.isdigit() and len(number_text) <= MAX_DIGITS else 0
        sent = self._sent.get(number)
        if sent is None:
            return False
        self._newest_at = max(self._newest_at, sent)
        self._sent = {each: at for each, at in self._sent.items() if each > number}
        return True

    def is_stale(self, now: float) -> bool:
        """Return whether a message that comes now may be too old."""
        return now - self._newest_at > STALE_AFTER_S


class SentIds:
    """The ids of recent goals, each with the boot id of the server that it was sent to."""

    def __init__(self) -> None:
        #: boot id of the server, and whether the goal counts for the limit of remote goals, by id
        self._sent: dict[str, tuple[str, bool]] = {}

    def boot_of(self, goal_id: str) -> str | None:
        """Return the boot id of the server that got this goal, None if the goal is unknown."""
        return self._sent.get(goal_id, (None, False))[0]

    def is_counted(self, goal_id: str, boot: str) -> bool:
        """Return whether this goal of this start of the server counts for the limit of remote goals."""
        return self._sent.get(goal_id) == (boot, True)

    def add(self, goal_id: str, boot: str, *, counted: bool = True) -> None:
        """Record that a goal is sent to the server with this boot id."""
        self._sent.pop(goal_id, None)
        self._sent[goal_id] = boot, counted
        if len(self._sent) > MAX_REMEMBERED_IDS:
            del self._sent[next(iter(self._sent))]

    def discard(self, goal_id: str) -> None:
        """Forget a goal that the server didn't accept, because it can't have been spoken."""
        self._sent.pop(goal_id, None)


class RemoteGoals:
    """The goals of remote clients that are pending at the server, or on their way there.

    Goals with `preempt` or `flush` don't count. A goal's reply and its events come on different connections, so either
    may be first.
    """

    def __init__(self) -> None:
        #: each goal's key, and whether the server has said that the goal is pending, by id
        self._goals: dict[str, tuple[str | None, bool]] = {}

    def __len__(self) -> int:
        return len(self._goals)

    @property
    def pending_count(self) -> int:
        """How many goals are known to be pending."""
        return sum(pending for _, pending in self._goals.values())

    @staticmethod
    def counts(say: Say) -> bool:
        """Return whether a goal counts for the limit."""
        return not (say.preempt or say.flush)

    def has_room(self, say: Say) -> bool:
        """Return whether this goal may be sent. A goal that will replace another one by its key always has room."""
        replaces = say.key is not None and any(key == say.key for key, _ in self._goals.values())
        return len(self) < MAX_REMOTE_GOALS or not self.counts(say) or replaces

    def add(self, goal_id: str, key: str | None) -> None:
        """Count a goal that is sent to the server."""
        self._goals.setdefault(goal_id, (key, False))

    def answered(self, goal_id: str, *, pending: bool) -> None:
        """Record the server's reply to a goal, unless an event has already told more.

        Args:
            goal_id: the goal.
            pending: whether the goal is pending. False also if nobody waits for the reply any more.
        """
        key, is_known = self._goals.get(goal_id, (None, True))
        if not is_known and pending:
            self._goals[goal_id] = key, True
        elif not is_known:
            del self._goals[goal_id]

    def queued(self, goal_id: str, key: str | None) -> None:
        """Record an event that says that a goal is pending."""
        self._goals[goal_id] = key, True

    def dequeued(self, goal_id: str) -> bool:
        """Record an event that says that a goal is no longer pending, and return whether the goal was counted."""
        return self._goals.pop(goal_id, None) is not None

    def reset(self, pending: Iterable[tuple[str, str | None]]) -> None:
        """Replace the pending goals, given as ids and keys. Goals on their way still count."""
        self._goals = {each: found for each, found in self._goals.items() if not found[1]}
        self._goals |= {goal_id: (key, True) for goal_id, key in pending}

    def clear(self) -> None:
        """Forget all goals, because the server is gone."""
        self._goals.clear()


def end_unsent(
    request: RemoteRequest, goal_id: str, state: State, reason: str, words: str, at: float, by: By | None = None
) -> tuple[Goal, list[JsonObject]]:
    """End a goal that was not sent to the server, and return it with the lines for its client.

    The lines are those that the server would send.

    Args:
        request: the `say`.
        goal_id: the goal's id.
        state: how the goal ends.
        reason: why, for programs.
        words: why, for people.
        at: seconds since 1970 UTC.
        by: who ended it, if anybody did.
    """
    say = request.request
    assert isinstance(say, Say)
    goal = Goal(
        goal_id,
        state,
        say.text,
        reason=reason,
        by=by,
        message=words,
        client=Sender(name=sender_name(request.user)),
        queued_at=at,
        ended_at=at,
        **{name: getattr(say, name) for name in SHOWN_OPTIONS},
    )
    lines = [ok(request.seq, goal=goal.to_json())]
    if say.wait or say.feedback:
        lines += [StateChanged(goal_id, state, at).to_json(), Result(goal).to_json()]
    return goal, lines


def without_texts(message: JsonObject) -> JsonObject:
    """Return a message without the texts of its goals, for a line that is longer than the broker accepts."""
    nothing = {"text": None, "spoken": None}
    return {
        name: {**each, **nothing} if isinstance(each, dict) and "text" in each else each
        for name, each in message.items()
    }


def sender_name(user: str, name: str | None = None) -> str:
    """Return what a remote client is called at the server: its user, and the name that it gave itself if any."""
    return f"{topics.REMOTE_PREFIX}{user} {name}"[:MAX_SENDER_NAME_CHARS] if name else f"{topics.REMOTE_PREFIX}{user}"


def is_remote(goal: Goal) -> bool:
    """Return whether a goal came over the broker."""
    return goal.client is not None and (goal.client.name or "").startswith(topics.REMOTE_PREFIX)
