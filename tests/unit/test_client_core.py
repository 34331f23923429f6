"""The client core without a socket: requests, answers, time limits, new connections, and the delivery of events."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from talkcli.client.core import (
    MAX_FEEDBACK_EVENTS,
    MAX_STATE_EVENTS,
    SILENCE_LIMIT_S,
    ClientCore,
    EventBuffer,
    Exchange,
    ServerInfo,
    TrackedGoal,
)
from talkcli.errors import (
    Lost,
    ProtocolMismatch,
    RequestRefused,
    ServerUnavailable,
    TalkError,
    UnknownGoal,
)
from talkcli.goals.goal import Goal
from talkcli.goals.options import Append, Cancel, Pause, Say
from talkcli.goals.states import State
from talkcli.protocol.events import (
    GoalInterrupted,
    PausedChanged,
    Result,
    Snapshot,
    StateChanged,
    TextAdded,
    TextMissing,
    WordHeard,
)
from talkcli.protocol.lines import decode, encode
from talkcli.protocol.requests import Status, Wait

if TYPE_CHECKING:
    from talkcli.goals.goal import JsonObject
    from talkcli.protocol.events import Event
    from talkcli.protocol.requests import Request

TIMEOUT_S = 5.0
HELLO = b'{"request": "hello"}\n'


class Reconnecting(ClientCore):
    """A client core whose owner connects again after a disconnect."""

    def break_off(self, why: str, now: float) -> None:
        self.disconnected(why, now)


def core_of(kind: type[ClientCore] = ClientCore) -> ClientCore:
    core = kind(TIMEOUT_S, 0.0)
    core.path, core.server = "/s", ServerInfo("4k7f")
    return core


@pytest.fixture
def core() -> ClientCore:
    return core_of()


@pytest.fixture
def reconnecting() -> ClientCore:
    return core_of(Reconnecting)


def submit(core: ClientCore, request: Request, now: float = 0.0, **options: Any) -> Exchange:
    exchange = Exchange(request, **options)
    core.register(exchange, now)
    core.queue(core.line(exchange), exchange)
    return exchange


def send_all(core: ClientCore) -> list[JsonObject]:
    """Send all queued lines, and return their messages."""
    data = core.outgoing()
    core.mark_sent(len(data))
    return [decode(line) for line in data.splitlines()]


def receive(core: ClientCore, *messages: JsonObject, now: float = 1.0) -> None:
    core.receive(b"".join(map(encode, messages)), now)


def goal(state: str = "PENDING", goal_id: str = "g") -> JsonObject:
    return Goal(goal_id, State[state], "a").to_json()


def state(name: str, number: int = 1) -> JsonObject:
    return {"event": "state", "id": "g", "state": name, "n": number, "at": 0.0}


def word(number: int) -> JsonObject:
    place = {"start": 0, "end": 1, "number": number, "time": 0.0}
    return {"event": "word", "id": "g", "word": "a", **place, "n": number, "at": 0.0}


def say(core: ClientCore, now: float = 0.0, **options: Any) -> TrackedGoal:
    """Say something without waiting for the answer, as `Client.say(block=False)` does."""
    request = Say("a", wait=True, id="g", **options)
    tracked = TrackedGoal(Goal("", State.PENDING))
    tracked._set_request(request, now)

    def on_reply(reply: JsonObject, _: list[JsonObject]) -> None:
        tracked._accept(reply)
        tracked._listen_to(core.listeners, feedback=request.feedback, followed_at=now)

    submit(core, request, now, on_reply=on_reply, on_failure=tracked._fail)
    return tracked


def greet(core: ClientCore, boot: str = "4k7f", now: float = 2.0) -> None:
    core.connecting(HELLO)
    core.mark_sent(len(HELLO))
    receive(core, {"talk": 1, "version": "1.0", "pid": 7, "boot": boot, "features": []}, now=now)


# Requests and answers


@pytest.mark.parametrize(
    ("form", "features", "message"),
    [
        ("markdown", (), "the server (version 0.1.0) does not support Markdown; restart it"),
        ("markdown", ("other",), "the server (version 0.1.0) does not support Markdown; restart it"),
        ("markdown", ("markdown", "other"), None),
        ("markdown", None, None),  # the bridge of a robot didn't tell, so the server may refuse the request
        ("sound", ("markdown",), "the server (version 0.1.0) does not support sounds; restart it"),
        ("text", (), None),
    ],
)
def test_a_request_is_unsupported_if_the_server_lacks_a_feature(
    core: ClientCore, form: str, features: tuple[str, ...] | None, message: str | None
) -> None:
    core.server = ServerInfo("4k7f", 7, "0.1.0", features)
    error = core.unsupported(Say("a", format=form))
    assert (None if error is None else error.message) == message
    assert error is None or isinstance(error, ProtocolMismatch)


def test_a_waiting_request_fails_if_the_server_is_replaced_by_an_older_one(reconnecting: ClientCore) -> None:
    reconnecting.break_off("gone", 1.0)
    exchange = submit(reconnecting, Say("a", format="markdown"), on_failure=lambda _: None)
    other = submit(reconnecting, Status(), on_failure=lambda _: None)
    greet(reconnecting)
    assert str(exchange.error) == "the server (version 1.0) does not support Markdown; restart it"
    assert [message["seq"] for message in send_all(reconnecting)] == [other.number]


def test_a_server_describes_itself_and_malformed_fields_count_as_missing() -> None:
    description: JsonObject = {"boot": "4k7f", "pid": 7, "version": "1.0", "features": ["markdown"], "new": 1}
    assert ServerInfo.read(description) == ServerInfo("4k7f", 7, "1.0", ("markdown",))
    assert ServerInfo.read({"boot": 1, "pid": "x", "version": None, "features": "all"}) == ServerInfo()


def test_requests_are_numbered_and_sent_in_order(core: ClientCore) -> None:
    submit(core, Status())
    submit(core, Say("a", wait=True))
    assert send_all(core) == [
        {"seq": 1, "request": "status"},
        {"seq": 2, "request": "say", "text": "a", "wait": True},
    ]
    assert core.outgoing() == b""


def test_items_belong_to_their_reply_and_replies_may_come_out_of_order(core: ClientCore) -> None:
    tracked = TrackedGoal(Goal("g", State.PENDING))
    tracked._listen_to(core.listeners, feedback=False, followed_at=0.0)
    heard: list[object] = []

    def on_reply(reply: JsonObject, items: list[JsonObject]) -> None:
        heard.append((reply["count"], len(items), tracked._has_event()))

    first = submit(core, Wait(("g",)), on_reply=on_reply)
    second = submit(core, Status())
    receive(core, {"seq": 1, "goal": goal()}, {"seq": 2, "ok": True})
    assert (first.over, second.over) == (False, True)
    receive(core, {"seq": 1, "ok": True, "count": 1}, state("ACTIVE"), {"seq": 1, "ok": True, "count": 2})
    assert core.answer(first) == ({"seq": 1, "ok": True, "count": 1}, [{"seq": 1, "goal": goal()}])
    assert (heard, tracked._take()) == ([(1, 1, False)], StateChanged("g", State.ACTIVE, 0.0, 1))


def test_a_refusal_raises_an_error_with_the_items_received_before(core: ClientCore) -> None:
    exchange = submit(core, Cancel(("x",)))
    receive(core, {"seq": 1, "ended": goal("SUCCEEDED")})
    receive(core, {"seq": 1, "ok": False, "error": {"code": "unknown_goal", "message": "no x"}})
    with pytest.raises(UnknownGoal, match="no x") as refused:
        core.answer(exchange)
    assert len(refused.value.items) == 1


@pytest.mark.parametrize("error", [None, "no", {}, {"code": "bad_text", "message": None}, {"message": ""}])
def test_a_refusal_without_a_reason_gets_a_default_message(core: ClientCore, error: object) -> None:
    exchange = submit(core, Pause())
    receive(core, {"seq": 1, "ok": False, "error": error})
    with pytest.raises(RequestRefused, match=r"^the server refused the request without a reason$"):
        core.answer(exchange)


@given(st.lists(st.integers(1, 40)))
def test_outgoing_bytes_may_be_sent_in_chunks_of_any_size(counts: list[int]) -> None:
    core = core_of()
    exchanges = [submit(core, Say("a" * size)) for size in range(3)]
    whole = core.outgoing()
    ends = [place + 1 for place, byte in enumerate(whole) if byte == ord("\n")]
    taken = b""
    for count in [*counts, len(whole)]:
        portion = core.outgoing()[:count]
        core.mark_sent(len(portion))
        taken += portion
        assert core.unsent_bytes == len(whole) - len(taken)
        assert [exchange.sent for exchange in exchanges] == [len(taken) >= end for end in ends]
    assert taken == whole


@given(st.lists(st.integers(1, 80)))
def test_incoming_bytes_may_arrive_in_chunks_of_any_size(counts: list[int]) -> None:
    core = core_of()
    exchange = submit(core, Status())
    data = encode({"seq": 1, "pending": goal()}) + encode({"event": "alive"}) + encode({"seq": 1, "ok": True})
    for count in [*counts, len(data)]:
        core.receive(data[:count], 0.0)
        data = data[count:]
    assert core.answer(exchange)[1] == [{"seq": 1, "pending": goal()}]


def test_a_request_that_was_sent_early_is_not_sent_again(core: ClientCore) -> None:
    line = encode({"seq": 1, "request": "status"})
    core._sent_early = line[:5]
    exchange = submit(core, Status())
    assert (core.outgoing(), exchange.sent) == (line[5:], False)
    core = core_of()
    core._sent_early = line
    exchange = submit(core, Status())
    assert (core.outgoing(), exchange.sent) == (b"", True)
    core = core_of()
    core._sent_early = line
    with pytest.raises(AssertionError, match="early"):
        submit(core, Pause())


def test_a_request_can_be_withdrawn_until_a_part_of_it_is_sent(core: ClientCore) -> None:
    first, second, third = (submit(core, Say(text)) for text in "abc")
    core.mark_sent(3)
    assert core.forget(second)
    assert [decode(line)["text"] for line in (b'{"s' + core.outgoing()).splitlines()] == ["a", "c"]
    assert not core.forget(first)
    assert core.forget(third)
    assert core.exchanges == {}


def test_requests_sent_before_sending_stopped_are_still_answered(core: ClientCore) -> None:
    first = submit(core, Status())
    send_all(core)
    second = submit(core, Status())
    core.stop_sending("it is gone")
    with pytest.raises(ServerUnavailable, match="nothing was sent to the server at /s: it is gone"):
        core.answer(second)
    with pytest.raises(ServerUnavailable, match="nothing was sent to the server at /s: it is gone"):
        submit(core, Status())
    receive(core, {"seq": 1, "ok": True})
    assert core.answer(first)


# The end of the connection


@pytest.mark.parametrize(
    ("request_", "is_sent", "error"),
    [
        (Say("a"), True, Lost),
        (Say("a"), False, ServerUnavailable),
        (Cancel(), True, ServerUnavailable),
        (Status(), False, ServerUnavailable),
    ],
)
def test_the_end_of_the_connection_fails_every_request(
    core: ClientCore, request_: Request, is_sent: bool, error: type[TalkError]
) -> None:
    exchange = submit(core, request_)
    if is_sent:
        send_all(core)
    else:
        core.mark_sent(5)
    core.end("it is gone")
    with pytest.raises(error, match="it is gone") as raised:
        core.answer(exchange)
    assert ("nothing was sent" in raised.value.message) != is_sent
    with pytest.raises(ServerUnavailable, match="nothing was sent"):
        submit(core, Status())


def test_the_servers_last_error_explains_why_the_connection_ended(core: ClientCore) -> None:
    receive(core, {"ok": False, "error": {"code": "too_slow", "message": "you are too slow"}})
    core.end("the server went away")
    assert core.ended == "the server closed the connection: you are too slow"


MALFORMED = [
    *(b"{", b"[]", b'{"event": "state", "id": "g", "state": "BORED"}', b'{"event": "result"}'),
    *(
        encode({**word(1), **wrong}).strip()
        for wrong in ({"word": 1}, {"start": "0"}, {"number": True}, {"time": None}, {"id": None})
    ),
]


@pytest.mark.parametrize("line", MALFORMED)
def test_a_malformed_line_ends_the_connection_and_later_lines_are_ignored(core: ClientCore, line: bytes) -> None:
    exchange = submit(core, Status())
    core.receive(line + b"\n" + encode({"seq": 1, "ok": True}), 0.0)
    assert (core.ended or "").startswith("the server sent a malformed message")
    assert exchange.reply is None


def test_a_goal_is_lost_if_the_reply_contains_a_malformed_goal(core: ClientCore) -> None:
    tracked = say(core)
    send_all(core)
    receive(core, {"seq": 1, "ok": True, "goal": {"id": "g", "state": "BORED"}})
    assert (tracked.goal.state, tracked.goal.reason, core.exchanges) == (State.LOST, "lost", {})


# Time limits


def test_each_line_of_an_answer_extends_its_deadline(core: ClientCore) -> None:
    exchange = submit(core, Status(), now=1.0)
    assert core.answer_deadline(exchange) == 1.0 + TIMEOUT_S
    send_all(core)
    receive(core, {"seq": 1, "recent": goal()}, now=3.0)
    assert core.answer_deadline(exchange) == 3.0 + TIMEOUT_S
    for request in (Say("a", patient=True), Append("a", "b"), Pause()):
        slow = submit(core, request, now=1.0)
        assert core.answer_deadline(slow) == 1.0 + TIMEOUT_S  # the request must be sent first
        send_all(core)
        assert core.answer_deadline(slow) == float("inf")
    broken = submit(core, Append("a", broken=True), now=1.0)
    send_all(core)
    assert core.answer_deadline(broken) == 1.0 + TIMEOUT_S


def test_a_silent_server_is_considered_gone(core: ClientCore) -> None:
    assert core.silence_deadline(2.0) == (2.0 + SILENCE_LIMIT_S, "the server sent nothing for 15 s")
    receive(core, {"event": "alive"}, now=7.0)
    assert core.silence_deadline(2.0)[0] == 7.0 + SILENCE_LIMIT_S


def test_an_unanswered_goal_is_lost_if_it_was_sent_and_rejected_otherwise(core: ClientCore) -> None:
    tracked = say(core, now=1.0)
    assert core.next_expiry() == 1.0 + TIMEOUT_S
    send_all(core)
    late = say(core, now=1.5)
    assert core.expire(5.9)
    assert (tracked.goal.state, tracked._has_event()) == (State.PENDING, False)
    assert core.expire(7.0)
    assert (tracked.goal.state, tracked.goal.reason, tracked.goal.id) == (State.LOST, "lost", "g")
    assert (late.goal.state, late.goal.reason) == (State.REJECTED, "not_sent")
    assert [tracked._take(), late._take()] == [Result(tracked.goal), Result(late.goal)]
    assert (core.next_expiry(), core.outgoing(), core.exchanges) == (float("inf"), b"", {})


def test_a_partly_sent_goal_is_rejected_and_its_connection_is_unusable(core: ClientCore) -> None:
    tracked = say(core)
    core.mark_sent(5)
    assert not core.expire(TIMEOUT_S)
    assert (tracked.goal.state, tracked.goal.reason) == (State.REJECTED, "not_sent")


def test_a_goal_that_expires_before_it_is_sent_is_rejected(core: ClientCore) -> None:
    tracked = say(core, ttl=2)
    assert core.next_expiry() == 2.0
    core.expire(2.0)
    assert tracked.goal.reason == "not_sent"


def test_a_refused_goal_is_rejected_with_the_servers_code(core: ClientCore) -> None:
    tracked = say(core)
    send_all(core)
    receive(core, {"seq": 1, "ok": False, "error": {"code": "unknown_field", "message": "no melody"}})
    assert (tracked.goal.state, tracked.goal.reason) == (State.REJECTED, "unknown_field")
    assert (tracked.goal.message, core.exchanges) == ("not spoken: no melody", {})


# A lost connection, and a new one


def test_a_disconnect_loses_unanswered_goals_and_rejects_unsent_ones(reconnecting: ClientCore) -> None:
    answered = submit(reconnecting, Status())
    unanswered, following = say(reconnecting), say(reconnecting)
    send_all(reconnecting)
    receive(reconnecting, {"seq": 1, "ok": True}, {"seq": 3, "ok": True, "goal": goal()})
    partly = say(reconnecting)
    reconnecting.mark_sent(5)
    reconnecting.disconnected("it is gone", 1.0)
    assert answered.reply is not None
    assert (unanswered.goal.state, partly.goal.reason) == (State.LOST, "not_sent")
    assert (following.goal.state, following._has_event()) == (State.PENDING, False)
    assert (reconnecting.outgoing(), reconnecting.ended) == (b"", None)


def test_goals_are_followed_again_after_reconnecting_to_the_same_server(reconnecting: ClientCore) -> None:
    tracked = say(reconnecting, feedback=True)
    send_all(reconnecting)
    receive(reconnecting, {"seq": 1, "ok": True, "goal": goal()}, state("PENDING"))
    assert tracked._take() == StateChanged("g", State.PENDING, 0.0, 1)
    reconnecting.disconnected("it is gone", 1.0)
    late = submit(reconnecting, Status(), now=1.5, on_failure=lambda _: None)
    greet(reconnecting)
    assert send_all(reconnecting) == [
        {"seq": 3, "request": "wait", "ids": ["g"], "feedback": True},
        {"seq": 2, "request": "status"},
    ]
    receive(reconnecting, {"seq": 3, "goal": goal("ACTIVE")}, {"seq": 3, "ok": True}, word(5), {"seq": 2, "ok": True})
    events = [tracked._take(), tracked._take()]
    assert [type(event) for event in events] == [StateChanged, WordHeard]
    assert (tracked.goal.state, late.over) == (State.ACTIVE, True)
    receive(reconnecting, {"event": "result", "goal": goal("SUCCEEDED")})
    assert tracked.goal.state is State.SUCCEEDED


def test_an_incomplete_text_is_claimed_after_reconnecting_and_grows_once(reconnecting: ClientCore) -> None:
    tracked = say(reconnecting)
    send_all(reconnecting)
    receive(reconnecting, {"seq": 1, "ok": True, "goal": {**goal(), "more": True}})
    tracked._grow(Append("g", "b", 1))
    reconnecting.disconnected("it is gone", 1.0)
    greet(reconnecting)
    claim, wait = send_all(reconnecting)
    assert (claim, wait["request"]) == ({"seq": 2, "request": "append", "id": "g"}, "wait")
    receive(reconnecting, {"seq": 3, "goal": {**goal(), "text": "abc", "more": True}}, {"seq": 3, "ok": True})
    tracked._grow(Append("g", "c", 2, end=True))  # the answer to the first attempt was lost
    assert (tracked.goal.text, tracked.goal.more, reconnecting.listeners.growing) == ("abc", False, [])


def test_goals_are_lost_if_the_server_was_restarted(reconnecting: ClientCore) -> None:
    tracked = say(reconnecting)
    send_all(reconnecting)
    receive(reconnecting, {"seq": 1, "ok": True, "goal": goal()})
    reconnecting.disconnected("it is gone", 1.0)
    greet(reconnecting, "5m8g")
    assert (tracked.goal.state, send_all(reconnecting), reconnecting.boot) == (State.LOST, [], "5m8g")
    assert tracked.goal.message == "result unknown: it is gone; the sentence may still be spoken"


def test_a_goal_that_the_server_has_forgotten_is_lost(reconnecting: ClientCore) -> None:
    tracked = say(reconnecting)
    send_all(reconnecting)
    receive(reconnecting, {"seq": 1, "ok": True, "goal": goal()})
    reconnecting.disconnected("it is gone", 1.0)
    greet(reconnecting)
    send_all(reconnecting)
    reconnecting.disconnected("gone again", 2.5)
    assert tracked.goal.state is State.PENDING
    greet(reconnecting)
    receive(reconnecting, {"seq": 3, "ok": False, "error": {"code": "unknown_goal", "message": "no g"}})
    assert (tracked.goal.state, tracked.goal.message) == (
        State.LOST,
        "result unknown: no g; the sentence may have been spoken",
    )


def test_goals_are_lost_if_no_connection_is_made_in_time(reconnecting: ClientCore) -> None:
    tracked = say(reconnecting)
    send_all(reconnecting)
    receive(reconnecting, {"seq": 1, "ok": True, "goal": goal()})
    reconnecting.disconnected("it is gone", 1.0)
    assert reconnecting.next_expiry() == 1.0 + TIMEOUT_S
    reconnecting.not_connected(ServerUnavailable("no server"))
    reconnecting.expire(5.9)
    assert tracked.goal.state is State.PENDING
    reconnecting.expire(6.0)
    assert (tracked.goal.state, tracked.goal.message) == (
        State.LOST,
        "result unknown: it is gone; the sentence may still be spoken",
    )


def test_a_goal_requested_while_disconnected_waits_for_a_connection(reconnecting: ClientCore) -> None:
    reconnecting.disconnected("it is gone", 1.0)
    tracked, other = say(reconnecting, now=2.0, ttl=4), say(reconnecting, now=2.0)
    status_request = submit(reconnecting, Status(), now=2.0)
    reconnecting.not_connected(ServerUnavailable("no server"))
    with pytest.raises(ServerUnavailable, match="no server"):
        reconnecting.answer(status_request)
    reconnecting.connecting(HELLO)
    assert reconnecting.outgoing() == HELLO
    reconnecting.mark_sent(len(HELLO))
    assert reconnecting.outgoing() == b""
    greet(reconnecting, "5m8g", now=3.0)
    assert [request.get("ttl") for request in send_all(reconnecting)] == [3.0, None]
    reconnecting.expire(7.9)
    assert [tracked._has_event(), other._has_event()] == [False, False]  # the limit starts at the greeting
    reconnecting.expire(8.0)
    assert other.goal.state is State.LOST


def test_a_goal_requested_while_disconnected_is_rejected_after_the_limit(reconnecting: ClientCore) -> None:
    reconnecting.disconnected("it is gone", 1.0)
    tracked = say(reconnecting, now=2.0)
    reconnecting.not_connected(ServerUnavailable("no server found; tried:\n  /s"))
    assert reconnecting.next_expiry() == 2.0 + TIMEOUT_S
    assert reconnecting.expire(7.0)
    message = "not spoken: nothing was sent to the server at /s: no server found; tried: /s"
    assert (tracked.goal.reason, tracked.goal.message) == ("not_sent", message)


def test_a_greeting_that_refuses_the_client_raises_an_error(reconnecting: ClientCore) -> None:
    reconnecting.disconnected("it is gone", 1.0)
    reconnecting.connecting(HELLO)
    with pytest.raises(ProtocolMismatch):
        receive(reconnecting, {"talk": 2})


# Events


def test_a_watch_ends_at_a_disconnect_or_resumes_with_a_new_snapshot(reconnecting: ClientCore) -> None:
    ending, lasting = EventBuffer(), EventBuffer(reconnects=True)
    reconnecting.listeners.watches.add(ending)
    reconnecting.listeners.watches.add(lasting)
    receive(reconnecting, state("ACTIVE", 5))
    reconnecting.disconnected("it is gone", 1.0)
    greet(reconnecting, "5m8g")
    assert send_all(reconnecting) == [{"seq": 1, "request": "watch"}]
    receive(reconnecting, {"seq": 1, "ok": True, "server": {"pid": 7}, "active": None}, state("ACTIVE", 5))
    assert ending.closed == "no more events from the server at /s: it is gone"
    assert taken(ending) == [StateChanged]
    assert (lasting.closed, taken(lasting)) == (None, [StateChanged, Snapshot, StateChanged])
    del lasting
    reconnecting.disconnected("it is gone", 3.0)
    greet(reconnecting, "5m8g")
    assert send_all(reconnecting) == []


def test_a_watch_ends_if_it_is_refused_after_reconnecting(reconnecting: ClientCore) -> None:
    buffer = EventBuffer(reconnects=True)
    reconnecting.listeners.watches.add(buffer)
    reconnecting.disconnected("it is gone", 1.0)
    greet(reconnecting)
    receive(reconnecting, {"seq": 1, "ok": False, "error": {"code": "busy", "message": "no"}})
    assert buffer.closed == "no"


def taken(buffer: EventBuffer) -> list[type[Event]]:
    kinds = []
    while event := buffer.take():
        kinds.append(type(event))
    return kinds


def test_a_buffer_keeps_the_order_and_drops_the_oldest_feedback() -> None:
    buffer = EventBuffer()
    changed, heard = StateChanged("g", State.ACTIVE), WordHeard("g", "a", 0, 1, 1, 0.0)
    for number in range(MAX_FEEDBACK_EVENTS + 2):
        buffer.add(WordHeard("g", "a", 0, 1, number, 0.0))
        if number == 5:
            buffer.add(changed)
    assert buffer.take() == WordHeard("g", "a", 0, 1, 2, 0.0)  # 0 and 1 were dropped
    assert [buffer.take() for _ in range(4)][3] == changed
    assert buffer.take() == WordHeard("g", "a", 0, 1, 6, 0.0)
    taken(buffer)
    for _ in range(MAX_STATE_EVENTS):
        buffer.add(changed)
    assert buffer.closed is None
    buffer.add(changed)
    buffer.add(heard)
    assert "read too slowly" in (buffer.closed or "")
    assert len(taken(buffer)) == MAX_STATE_EVENTS  # no event after the one that did not fit


def test_word_events_are_kept_only_with_feedback_and_unknown_events_never(core: ClientCore) -> None:
    plain, fed = say(core), say(core, feedback=True)
    for number in (1, 2):
        receive(core, {"seq": number, "ok": True, "goal": goal()})
    paused: JsonObject = {"event": "paused", "paused": True, "id": "g", "by": None, "n": 3}
    receive(core, {"event": "viseme", "id": "g"}, {"event": None}, {**word(1), "viseme": "o"}, paused)
    receive(core, {"event": "waits", "id": "g", "waits": True, "n": 4})
    assert plain.goal.waits
    assert fed.goal.waits
    receive(core, {"event": "result", "goal": goal("SUCCEEDED")})
    for tracked, kinds in ((plain, [Result]), (fed, [WordHeard, PausedChanged, TextMissing, Result])):
        assert [type(tracked._take()) for _ in kinds] == kinds
        assert tracked.speech_paused


def test_an_interrupted_goal_is_paused_until_it_continues(core: ClientCore) -> None:
    tracked = say(core)
    receive(core, {"seq": 1, "ok": True, "goal": goal()}, state("ACTIVE", 1))
    receive(core, {"event": "interrupted", "id": "g", "by": {"goal": "aside"}, "n": 2})
    resumed: JsonObject = {"event": "paused", "paused": False, "id": "aside", "by": None, "n": 3}
    receive(core, resumed)  # a pause of the other goal has ended
    assert (tracked.goal.state, tracked.goal.paused, tracked.goal.interrupted_by) == (State.ACTIVE, True, "aside")
    receive(core, state("ACTIVE", 4))
    assert (tracked.goal.state, tracked.goal.paused, tracked.goal.interrupted_by) == (State.ACTIVE, False, None)
    kinds = [StateChanged, GoalInterrupted, StateChanged]
    assert [type(tracked._take()) for _ in kinds] == kinds


def test_a_watch_gets_each_state_once_with_the_full_goal(core: ClientCore) -> None:
    """A connection that waits for a goal and watches all goals receives each state twice."""
    watching = EventBuffer()
    core.listeners.watches.add(watching)
    tracked = say(core)
    receive(core, {"seq": 1, "ok": True, "goal": goal()})
    for number, name in enumerate(("PENDING", "ACTIVE", "SUCCEEDED"), 1):
        whole: JsonObject = {} if name == "ACTIVE" else {"goal": goal(name)}
        receive(core, state(name, number), {**state(name, number), **whole})
    receive(core, {"event": "result", "goal": goal("SUCCEEDED")})
    states = [State.PENDING, State.ACTIVE, State.SUCCEEDED]
    own = [tracked._take() for _ in range(4)]
    assert [event.state for event in own if isinstance(event, StateChanged)] == states
    assert isinstance(own[-1], Result)
    seen = [event for event in iter(watching.take, None) if isinstance(event, StateChanged)]
    assert [event.state for event in seen] == states
    assert [event.goal is not None for event in seen] == [True, False, True]


def test_a_watch_gets_added_text(core: ClientCore) -> None:
    watching = EventBuffer()
    core.listeners.watches.add(watching)
    tracked = say(core)
    receive(core, {"seq": 1, "ok": True, "goal": goal()})
    receive(core, {"event": "text", "id": "g", "start": 1, "text": "b", "n": 1})
    receive(core, {"event": "waits", "id": "g", "waits": False, "n": 2})
    assert list(iter(watching.take, None)) == [TextAdded("g", 1, "b", n=1), TextMissing("g", waits=False, n=2)]
    receive(core, {"event": "result", "goal": goal("SUCCEEDED")})
    tracked._grow(Append("g", "c", 1))  # the reply came after the result, which has the whole text
    assert tracked.goal.text == "a"


def test_a_duplicate_event_is_kept_once() -> None:
    buffer = EventBuffer()
    for number in (1, 1, 2, None, None):
        buffer.add(StateChanged("g", State.ACTIVE, n=number))
    assert len(buffer) == 4


def test_an_ended_goal_ignores_later_events(core: ClientCore) -> None:
    tracked = say(core)
    send_all(core)
    receive(core, {"seq": 1, "ok": True, "goal": goal(), "attached": True, "paused": True})
    assert (tracked.attached, tracked.speech_paused) == (True, True)
    receive(core, state("ACTIVE"), word(1), {"event": "paused", "paused": True, "id": "g", "by": None, "n": 2})
    assert (tracked.goal.paused, core.listeners.goals) == (True, {"g": False})
    receive(core, {"event": "result", "goal": goal("SUCCEEDED")}, state("ACTIVE"))
    assert [type(event) for event in (tracked._take(), tracked._take(), tracked._take())] == [
        StateChanged,
        Result,
        Result,
    ]
    tracked._fail(Lost("too late"))
    tracked._update(Goal("g", State.ACTIVE))
    assert (tracked.goal.state, core.listeners.goals) == (State.SUCCEEDED, {})
