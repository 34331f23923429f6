"""What a robot takes from the broker, and what not: who may ask for what, how old it may be, how much may wait.

Rules for this file: pure, the time comes in as an argument; it decides about messages, never about speech: that is the
server's. What is refused is refused before anything is sent there. All that it keeps has a limit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from talkcli.errors import BadRequest, LineTooLong
from talkcli.fleet import topics
from talkcli.frozen import frozen
from talkcli.goals.goal import By, Goal, Sender
from talkcli.goals.option import MAX_NAME
from talkcli.goals.options import SHOWN, Say
from talkcli.protocol.events import Result, StateChanged, failure, ok, take_seq
from talkcli.protocol.lines import MAX_DIGITS, MAX_LINE, decode
from talkcli.protocol.requests import KINDS, read_request

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from talkcli.fleet.message import Message
    from talkcli.goals.goal import JsonObject
    from talkcli.goals.states import State
    from talkcli.protocol.requests import Request

#: The code of what is refused because it may be old.
STALE = "stale"
#: What may be asked for in any case: who one is, and what can be read from the broker anyway.
ALWAYS = ("hello", "watch")
#: What else there is to be asked for.
ASKABLE = tuple(each for each in KINDS if each not in ALWAYS)

#: How everybody is called at the server who asks by the broker.
AFAR = "mqtt:"
#: Seconds between two echoes that a bridge sends itself, and those after which a message may be as old as the newest of
#: them that came back: with a second for the way.
ECHO_EVERY = 5.0
STALE_AFTER = ECHO_EVERY + 1.0
#: Echoes on their way that are remembered: those of half a minute, and some that were sent in between.
_ECHOES = 32
#: Goals from the broker that may be pending at once: the others' places in the queue (100 usually) are the robot's own.
SHARE = 20
#: Ids of goals that are remembered, so that none is spoken twice though the server has forgotten it.
REMEMBERED = 1_000
#: Bytes of the correlation data that stand on what answers a request: they go into each packet's head.
MAX_CORRELATION = 256
#: Seconds of a time to live that is over, for a goal that has waited here: 0 would be no limit.
_OVER = 0.001


@frozen
class Ask:
    """A request that may be carried out."""

    user: str
    #: where its answers go; None for nowhere
    topic: str | None
    seq: int | None
    request: Request
    #: as it came, without its number
    message: JsonObject
    correlation: bytes | None = None
    #: bytes that it takes while it waits
    size: int = 0
    #: when it must have begun, by the clock that it was judged by; None for no limit
    until: float | None = None

    def line(self, now: float, goal_id: str | None) -> JsonObject:
        """Return what the server is asked, without a number; `goal_id`: the goal's, if this is one."""
        message = dict(self.message)
        if goal_id is not None:
            message["id"] = goal_id
        if self.until is not None and isinstance(self.request, Say):
            left = max(_OVER, self.until - now)
            message["ttl"] = min(self.request.ttl or left, left)
        return message


@frozen
class Refused:
    """A message that is answered with an error, where there is anybody to answer."""

    topic: str | None
    answer: JsonObject
    correlation: bytes | None
    #: why, for programs and for people
    code: str
    words: str


@frozen
class HungUp:
    """The asker says goodbye."""

    user: str
    topic: str


@frozen
class Dropped:
    """A message that nobody is told of but the log; `kind` says of what kind it is there."""

    kind: str
    words: str


class Policy:
    """What this robot takes."""

    def __init__(self, name: str, allow: Collection[str]) -> None:
        """`name`: the robot's; `allow`: the kinds of requests that may be asked for."""
        self._name = name
        self._allow = {*allow, *ALWAYS}

    def judge(
        self, message: Message, asked: topics.Asked, now: float, *, stale: bool
    ) -> Ask | Refused | HungUp | Dropped:
        """Return what is to be done about a message.

        `asked`: what its topic asks for; `now`: seconds by a clock that goes on while the robot is suspended; `stale`:
        whether the message may be old.
        """
        if message.retained:
            return Dropped("retained", f"a retained message on {message.topic} is dropped: it is no request of now")
        topic = None
        if message.response is not None:
            topic = topics.answer(message.response, asked.user, self._name)
            if topic is None:
                words = f"its response topic, {message.response}, is not its own"
                return Dropped("response", f"a message of {asked.user} is dropped: {words}")
        if not message.payload and asked.kind != topics.CANCEL:
            if topic is None or asked.kind == topics.SAY:
                return Dropped("empty", f"an empty message on {message.topic} asks for nothing")
            return HungUp(asked.user, topic)
        seq, correlation = None, _repeatable(message.correlation)
        try:
            fields = _fields(asked.kind, message.payload)
            seq = take_seq(fields)
            if correlation != message.correlation:
                raise BadRequest(f"correlation data have at most {MAX_CORRELATION} bytes", "bad_field")
            request = read_request(fields)
            if request.kind not in self._allow:
                words = f"this robot takes no {request.kind} from afar: see its --allow"
                raise BadRequest(words, "not_allowed")
            if stale and isinstance(request, Say):
                words = "the line to the broker stalled, so this may be old: say it again if it still holds"
                raise BadRequest(words, STALE)
        except BadRequest as error:
            answer = failure(seq, error.code, error.message)
            return Refused(topic, answer, correlation, error.code, error.message)
        until = None if message.expiry is None else now + message.expiry
        size = 0 if asked.kind == topics.CANCEL else len(message.payload)
        return Ask(asked.user, topic, seq, request, fields, correlation, size, until)


def _fields(kind: str, payload: bytes) -> JsonObject:
    """Return the request in a payload as an object; BadRequest where there is none."""
    if kind == topics.CANCEL:
        return {"request": "cancel"}
    line = payload.removesuffix(b"\n") if kind == topics.REQUEST else payload
    if len(line) >= MAX_LINE:
        raise LineTooLong(f"a request has at most {MAX_LINE} bytes")
    if kind == topics.REQUEST:
        return decode(line)
    try:
        return {"request": "say", "text": line.decode()}
    except UnicodeDecodeError as error:
        words = f"a text is UTF-8, but byte {error.start} of this one is not"
        raise BadRequest(words, "bad_encoding") from None


def _repeatable(correlation: bytes | None) -> bytes | None:
    """Return correlation data, or None where they are too long to be repeated."""
    return correlation if len(correlation or b"") <= MAX_CORRELATION else None


class Echoes:
    """How old a message may be that comes now, by what the robot sent itself through the broker.

    Whatever comes after an echo was sent on by the broker after that was. So no clocks are compared.
    """

    def __init__(self, now: float) -> None:
        """`now`: when the connection was made: nothing in it is older."""
        self._known = now
        self._sent: dict[int, float] = {}
        self._number = 0

    def send(self, now: float) -> int:
        """Return the number of an echo that is sent now."""
        self._number += 1
        self._sent[self._number] = now
        while len(self._sent) > _ECHOES:
            del self._sent[next(iter(self._sent))]
        return self._number

    def came(self, text: bytes) -> bool:
        """Note that the echo of this number has come back; return False if it is not one that is awaited."""
        number = int(text) if text.isdigit() and len(text) <= MAX_DIGITS else 0
        sent = self._sent.get(number)
        if sent is None:
            return False
        self._known = max(self._known, sent)
        self._sent = {each: at for each, at in self._sent.items() if each > number}
        return True

    def stale(self, now: float) -> bool:
        """Whether what comes now may be too old."""
        return now - self._known > STALE_AFTER


class Ids:
    """The ids of the goals that were last sent to a server, each with that server's boot id."""

    def __init__(self) -> None:
        #: by id: the boot id, and whether the goal takes a place of the share
        self._sent: dict[str, tuple[str, bool]] = {}

    def boot_of(self, goal_id: str) -> str | None:
        """Return the boot id of the server that a goal was sent to; None for one that is not known."""
        return self._sent.get(goal_id, (None, False))[0]

    def in_share(self, goal_id: str, boot: str) -> bool:
        """Whether a goal that is pending at the server of this boot takes a place of the share."""
        return self._sent.get(goal_id) == (boot, True)

    def note(self, goal_id: str, boot: str, *, in_share: bool = True) -> None:
        """Note that a goal is sent to this server."""
        self._sent.pop(goal_id, None)
        self._sent[goal_id] = boot, in_share
        if len(self._sent) > REMEMBERED:
            del self._sent[next(iter(self._sent))]

    def forget(self, goal_id: str) -> None:
        """Forget a goal that the server did not take: it can't have been spoken."""
        self._sent.pop(goal_id, None)


class Share:
    """The goals from the broker that are pending at the server, or on their way there: by their ids, with their keys.

    Goals that bring `preempt` or `flush` are not counted. A goal's reply and its events come on different connections,
    so either may be first.
    """

    def __init__(self) -> None:
        self._sent: dict[str, str | None] = {}
        self._pending: dict[str, str | None] = {}

    def __len__(self) -> int:
        return len(self._sent.keys() | self._pending.keys())

    @property
    def pending(self) -> int:
        """How many the server says are pending."""
        return len(self._pending)

    @staticmethod
    def counts(say: Say) -> bool:
        """Whether a goal needs a place of the share, or else goes past it."""
        return not (say.preempt or say.flush)

    def has_room(self, say: Say) -> bool:
        """Whether one more may be sent: also where it is sure to take another's place."""
        keys = (*self._sent.values(), *self._pending.values())
        return len(self) < SHARE or not self.counts(say) or (say.key is not None and say.key in keys)

    def sent(self, goal_id: str, key: str | None) -> None:
        """Count a goal that is sent to the server."""
        self._sent[goal_id] = key

    def answered(self, goal_id: str, *, pending: bool) -> None:
        """Note the reply: whether it is pending, unless it has left already. One that nobody waits for is none."""
        if goal_id in self._sent:
            key = self._sent.pop(goal_id)
            if pending:
                self._pending[goal_id] = key

    def came(self, goal_id: str, key: str | None) -> None:
        """Note that it is pending, as the server tells everybody."""
        self._pending[goal_id] = key

    def left(self, goal_id: str) -> bool:
        """Note that a goal is pending no more, as the server tells everybody, and return whether it was counted."""
        before = len(self)
        self._sent.pop(goal_id, None)
        self._pending.pop(goal_id, None)
        return len(self) < before

    def begin(self, pending: Iterable[tuple[str, str | None]]) -> None:
        """Begin anew with what is pending now; what is on its way is still."""
        self._pending = dict(pending)

    def clear(self) -> None:
        """Forget all: the server is gone."""
        self._sent.clear()
        self._pending.clear()


def not_taken(
    ask: Ask, goal_id: str, state: State, reason: str, words: str, at: float, by: By | None = None
) -> tuple[Goal, list[JsonObject]]:
    """Return a goal that never came to the server, and what its asker is told, as the server would tell it.

    `at`: seconds since 1970 UTC.
    """
    say = ask.request
    assert isinstance(say, Say)
    goal = Goal(
        goal_id,
        state,
        say.text,
        reason=reason,
        by=by,
        message=words,
        client=Sender(name=sender(ask.user)),
        queued_at=at,
        ended_at=at,
        **{name: getattr(say, name) for name in SHOWN},
    )
    lines = [ok(ask.seq, goal=goal.to_json())]
    if say.wait or say.feedback:
        lines += [StateChanged(goal_id, state, at).to_json(), Result(goal).to_json()]
    return goal, lines


def unworded(message: JsonObject) -> JsonObject:
    """Return a line that is longer than the broker takes, without what the goals in it say."""
    nothing = {"text": None, "spoken": None}
    return {
        name: {**each, **nothing} if isinstance(each, dict) and "text" in each else each
        for name, each in message.items()
    }


def sender(user: str, name: str | None = None) -> str:
    """Return what a user from afar is called at the server; `name`: what they call themselves."""
    return f"{AFAR}{user} {name}"[:MAX_NAME] if name else f"{AFAR}{user}"
