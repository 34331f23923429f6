"""The rules for messages from the broker: each rule, the order of the rules, and the limits of stored data."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from talkcli.fleet import topics
from talkcli.fleet.bridge import policy
from talkcli.fleet.bridge.policy import (
    Goodbye,
    Ignored,
    Policy,
    Refusal,
    RemoteGoals,
    RemoteRequest,
    SentIds,
)
from talkcli.fleet.payloads import Message
from talkcli.frozen import replace
from talkcli.goals.options import MAX_SENDER_NAME_CHARS, Cancel, Say, is_clients_id
from talkcli.protocol.lines import MAX_LINE_BYTES
from talkcli.protocol.requests import REQUEST_TYPES

NOW = 1000.0
OWN, PLAIN, CANCEL = (f"talk/robot/anna/{kind}/bob" for kind in ("request", "say", "cancel"))
REPLY = "talk/reply/bob/s1"
SAY = {"request": "say", "text": "hello"}
LONGEST = b"c" * policy.MAX_CORRELATION_BYTES

Judged = RemoteRequest | Refusal | Goodbye | Ignored


def judge(message: Message, *, stale: bool = False, allow: tuple[str, ...] = policy.ALLOWABLE_REQUESTS) -> Judged:
    asked = topics.parse_request(message.topic)
    assert asked
    rules = Policy("anna", allow)
    rules.newest_echo_at = NOW - (6.01 if stale else 6)
    return rules.decide(message, *asked, NOW)


def request(fields: object = SAY, topic: str = OWN, response: str | None = REPLY, **more: object) -> Message:
    payload = fields if isinstance(fields, bytes) else json.dumps(fields).encode()
    return replace(Message(topic, payload, response=response), **more)


def refused(judged: Judged) -> str:
    assert isinstance(judged, Refusal), judged
    return judged.error.code


def asked(judged: Judged) -> RemoteRequest:
    assert isinstance(judged, RemoteRequest), judged
    return judged


# Accepted requests


@pytest.mark.parametrize("topic", [OWN, "talk/group/all/request/bob", "talk/group/g/request/bob"])
@pytest.mark.parametrize("response", [REPLY, f"{REPLY}/anna"])
def test_a_request_is_answered_under_the_robots_name(topic: str, response: str) -> None:
    found = asked(judge(request({"seq": 5, **SAY}, topic, response, correlation=b"c")))
    assert (found.user, found.reply_topic, found.seq, found.correlation) == ("bob", f"{REPLY}/anna", 5, b"c")
    assert (found.request, found.start_by) == (Say("hello"), None)


@pytest.mark.parametrize(
    ("topic", "payload", "wanted"),
    [
        (OWN, json.dumps(SAY).encode() + b"\n", Say("hello")),
        *((PLAIN, text.encode(), Say(text)) for text in ("hello", '{"request": "cancel"}', "-w", "two\nlines\n", " ")),
        *((CANCEL, payload, Cancel()) for payload in (b"", b"anything", b"\xff", b"x" * 100_000)),
    ],
)
def test_a_plain_text_is_literal_and_anything_cancels_everything(topic: str, payload: bytes, wanted: object) -> None:
    found = asked(judge(request(payload, topic, None)))
    assert (found.request, found.reply_topic) == (wanted, None)
    assert found.size_bytes == (0 if topic == CANCEL else len(payload))
    assert not isinstance(found.request, Cancel) or found.request.selects_all


def test_an_empty_request_is_the_goodbye_of_the_session_that_it_names() -> None:
    assert judge(request(b"")) == Goodbye("bob", f"{REPLY}/anna")
    for topic, response in ((OWN, None), (PLAIN, None), (PLAIN, REPLY)):
        assert isinstance(judge(request(b"", topic, response)), Ignored)


# Refusals, and their order


@pytest.mark.parametrize("payload", [b"", json.dumps(SAY).encode(), b"{", b"x" * 100_000])
@pytest.mark.parametrize("topic", [OWN, PLAIN, CANCEL])
def test_a_retained_message_is_dropped_before_anything_else(topic: str, payload: bytes) -> None:
    found = judge(request(payload, topic, retained=True), stale=True, allow=())
    assert isinstance(found, Ignored)
    assert found.kind == "retained"


@pytest.mark.parametrize("response", ["talk/reply/eve/s1", "talk/robot/berta/say/bob", "elsewhere", ""])
def test_a_message_with_the_response_topic_of_another_is_dropped(response: str) -> None:
    found = judge(request(response=response))
    assert isinstance(found, Ignored)
    assert found.kind == "response"


@pytest.mark.parametrize(
    ("payload", "topic", "code"),
    [
        (b"x" * MAX_LINE_BYTES, OWN, "line_too_long"),
        (b" " * (MAX_LINE_BYTES - 1) + b"\n", OWN, "bad_json"),  # as long as a line may be
        (b"\xff", OWN, "bad_encoding"),
        (b"{", OWN, "bad_json"),
        (b"[1]", OWN, "bad_json"),
        (b'{"request": "say", "text": "a", "text": "b"}', OWN, "bad_json"),
        (b'{"seq": "x", "request": "say", "text": "a"}', OWN, "bad_field"),
        (b"{}", OWN, "bad_request"),
        (b'{"request": "sing"}', OWN, "unknown_request"),
        (b'{"request": "say", "text": "a", "colour": "red"}', OWN, "unknown_field"),
        (b'{"request": "say"}', OWN, "bad_field"),
        (b'{"request": "say", "text": 1}', OWN, "bad_field"),
        (b'{"request": "say", "text": "a"}\n{"request": "say", "text": "b"}', OWN, "bad_json"),
        (b"x" * MAX_LINE_BYTES, PLAIN, "line_too_long"),
        (b"a\xff", PLAIN, "bad_encoding"),
    ],
)
def test_a_malformed_request_has_the_error_of_the_wire_also_if_it_is_stale_and_not_allowed(
    payload: bytes, topic: str, code: str
) -> None:
    assert refused(judge(request(payload, topic), stale=True, allow=())) == code


@pytest.mark.parametrize("response", [REPLY, None])
def test_an_error_has_the_number_and_the_correlation_of_its_request(response: str | None) -> None:
    found = judge(request({"seq": 7, "request": "say"}, response=response, correlation=b"c"))
    assert isinstance(found, Refusal)
    assert found.error.code == "bad_field"
    if response is None:
        assert found.reply is None
    else:
        error = {"code": "bad_field", "message": found.error.message}
        assert found.reply
        assert (found.reply.topic, found.reply.correlation) == (f"{REPLY}/anna", b"c")
        assert json.loads(found.reply.payload) == {"seq": 7, "ok": False, "error": error}


@pytest.mark.parametrize(
    ("fields", "code", "seq"), [(b"{", "bad_json", None), (SAY, "bad_field", None), ({"seq": 7, **SAY}, "bad_field", 7)]
)
def test_correlation_data_that_are_too_long_are_on_no_answer(fields: object, code: str, seq: int | None) -> None:
    assert asked(judge(request(correlation=LONGEST))).correlation == LONGEST
    found = judge(request(fields, correlation=LONGEST + b"c"), stale=True, allow=())
    assert isinstance(found, Refusal)
    assert found.reply
    assert (refused(found), found.reply.correlation) == (code, None)
    assert json.loads(found.reply.payload).get("seq") == seq


def test_each_kind_of_request_can_be_forbidden_but_hello_and_watch() -> None:
    assert {*policy.ALLOWABLE_REQUESTS, *policy.ALWAYS_ALLOWED} == {*REQUEST_TYPES}
    for kind in policy.ALWAYS_ALLOWED:
        assert asked(judge(request({"request": kind}), allow=())).request.kind == kind
    for kind in policy.ALLOWABLE_REQUESTS:
        fields = {"request": kind, **({"text": "a"} if kind == "say" else {})}
        assert refused(judge(request(fields), allow=())) == "not_allowed"
        assert asked(judge(request(fields), allow=(kind,))).request.kind == kind
    assert refused(judge(request(b"hi", PLAIN), stale=True, allow=("cancel",))) == "not_allowed"


def test_a_stale_sentence_is_refused_and_a_stale_cancel_is_not() -> None:
    assert refused(judge(request(), stale=True)) == "stale"
    assert refused(judge(request(b"hi", PLAIN), stale=True)) == "stale"
    assert asked(judge(request({"request": "cancel"}), stale=True)).request == Cancel()


# Maximum age


@pytest.mark.parametrize(
    ("ttl", "expiry", "waited", "left"),
    [
        (None, None, 3, None),
        (5, None, 3, 5),
        (None, 10, 0, 10),
        (0, 10, 0, 10),  # no limit of its own
        (5, 10, 0, 5),
        (20, 10, 0, 10),
        (20, 10, 4, 6),
        (5, 10, 8, 2),
        (None, 10, 10, 0.001),  # 0 would be no limit
        (None, 10, 11, 0.001),
    ],
)
def test_a_sentence_must_begin_before_its_message_expires(
    ttl: float | None, expiry: int | None, waited: float, left: float | None
) -> None:
    found = asked(judge(request({**SAY, **({} if ttl is None else {"ttl": ttl})}, expiry=expiry)))
    say = found.build_say("x", NOW + waited)
    assert (say.ttl, say.id) == (left, "x")


def is_stale(rules: Policy, now: float) -> bool:
    """Return whether a sentence that arrives now is refused."""
    found = rules.decide(request(), topics.REQUEST, "bob", now)
    return isinstance(found, Refusal) and found.error.code == "stale"


def returned(rules: Policy, sent_at: float, now: float) -> bool:
    """Return an echo to the robot, and tell whether it is the newest one."""
    before = rules.newest_echo_at
    rules.record_echo(f"{sent_at}".encode(), now)
    return rules.newest_echo_at > before


def connected(now: float) -> Policy:
    """Return the rules of a robot that has just connected to the broker."""
    rules = Policy("anna", policy.ALLOWABLE_REQUESTS)
    rules.newest_echo_at = now
    return rules


def test_what_comes_within_six_seconds_of_the_newest_echo_that_came_back_is_taken() -> None:
    rules = connected(100.0)
    assert not is_stale(rules, 106.0)
    assert is_stale(rules, 106.01)
    assert returned(rules, 104.0, 105.0)
    assert not is_stale(rules, 110.0)
    assert is_stale(rules, 110.01)
    assert returned(rules, 105.0, 105.1)
    assert not is_stale(rules, 111.0)


@pytest.mark.parametrize(
    "unknown", [b"20.1", b"0", b"-1", b"", b"one", b"7" * 5000, b"inf", b"nan", b"15.0 15.0", b"\xb2", b"\xff"]
)
def test_an_unknown_echo_tells_nothing(unknown: bytes) -> None:
    rules = connected(0.0)
    rules.record_echo(unknown, 20.0)
    assert is_stale(rules, 10.0)
    assert returned(rules, 10.0, 20.0)
    assert not returned(rules, 10.0, 20.0)  # twice
    assert not is_stale(rules, 10.0)


@given(st.lists(st.tuples(st.sampled_from(["send", "come", "wait"]), st.integers(0, 12)), max_size=60))
def test_messages_older_than_the_newest_echo_allows_are_refused(steps: list[tuple[str, int]]) -> None:
    """The broker forwards a message that arrives after an echo no earlier than the echo was sent."""
    now, proved, rules = 0.0, 0.0, connected(0.0)
    sent: list[float] = []
    for what, number in steps:
        if what == "wait":
            now += number
        elif what == "send":
            sent.append(now)
        elif number < len(sent):
            assert returned(rules, sent[number], now) == (sent[number] > proved)
            proved = max(proved, sent[number])
        assert is_stale(rules, now) == (now - proved > policy.STALE_AFTER_S)


def test_an_echo_that_comes_after_a_newer_one_tells_nothing() -> None:
    rules = connected(0.0)
    assert sum(returned(rules, float(each), 1000.0) for each in reversed(range(1000))) == 1
    assert not is_stale(rules, 1005.0)
    assert is_stale(rules, 1005.01)


# Goals that were sent before


def test_the_last_thousand_ids_are_remembered_with_the_servers_start() -> None:
    ids = SentIds()
    for each in range(1200):
        ids.add(f"goal-{each}", "1a1a")
    ids.add("goal-200", "2b2b")  # added again, it becomes the newest
    ids.add("more", "2b2b")
    known = {each: ids.boot_of(each) for each in ("goal-200", "goal-201", "goal-202", "more")}
    assert known == {"goal-200": "2b2b", "goal-201": None, "goal-202": "1a1a", "more": "2b2b"}
    ids.discard("more")
    assert ids.boot_of("more") is None
    ids.discard("never known")


def test_twenty_goals_may_be_pending_whichever_of_reply_and_event_comes_first() -> None:
    share = RemoteGoals()
    for each in range(20):
        assert share.has_room(Say("a"))
        share.add(f"g{each}", "battery" if each == 7 else None)
        if each % 2:
            share.record_pending(f"g{each}", "battery" if each == 7 else None)
            share.record_reply(f"g{each}", pending=True)
        elif each:  # the first goal is still on its way
            share.record_reply(f"g{each}", pending=True)
            share.record_pending(f"g{each}", None)
    assert (len(share), share.pending_count) == (20, 19)
    sentences = [Say("a"), Say("a", key="door"), Say("a", key="battery"), Say("a", flush=True), Say("a", preempt=True)]
    assert [share.has_room(each) for each in sentences] == [False, False, True, True, True]
    share.remove("g3")
    assert share.has_room(Say("a"))


def test_goals_on_their_way_still_count_if_the_server_is_watched_anew() -> None:
    share = RemoteGoals()
    share.add("on its way", None)
    share.record_pending("over", None)
    share.replace_pending([("there", "k")])
    assert (len(share), share.pending_count) == (2, 1)
    share.replace_pending([])
    assert (len(share), share.pending_count) == (1, 0)


@given(
    st.lists(
        st.tuples(st.sampled_from(["sent", "accepted", "refused", "came", "left"]), st.integers(0, 6)), max_size=80
    )
)
def test_the_share_counts_like_a_slow_model(steps: list[tuple[str, int]]) -> None:
    share = RemoteGoals()
    on_way: set[int] = set()
    pending: set[int] = set()
    for what, number in steps:
        name = str(number)
        if what == "sent":
            share.add(name, None)
            on_way |= {number}
        elif what in ("accepted", "refused"):
            share.record_reply(name, pending=what == "accepted")
            if number in on_way and what == "accepted":
                pending |= {number}
            on_way -= {number}
        elif what == "came":
            share.record_pending(name, None)
            pending |= {number}
        else:
            assert share.remove(name) is (number in on_way | pending)
            on_way -= {number}
            pending -= {number}
        assert (len(share), share.pending_count) == (len(on_way | pending), len(pending))


# Names


def test_the_name_of_a_user_from_afar_fits_and_says_so() -> None:
    longest = "u" * topics.MAX_NAME_CHARS
    assert policy.sender_name("bob") == "mqtt:bob"
    assert policy.sender_name("bob", "patrol") == "mqtt:bob patrol"
    assert policy.sender_name(longest) == f"mqtt:{longest}"
    assert (
        len(policy.sender_name(longest))
        == len(policy.sender_name("bob", "n" * MAX_SENDER_NAME_CHARS))
        == MAX_SENDER_NAME_CHARS
    )
    assert is_clients_id(f"{longest[:48]}-x{0:012x}")
