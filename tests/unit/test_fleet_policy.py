"""A robot's rules for messages from the broker, the order of the rules, and the limits of stored data."""

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
from talkcli.goals.goal import Goal, Sender
from talkcli.goals.options import MAX_SENDER_NAME_CHARS, Append, Cancel, Pause, Say, is_clients_id
from talkcli.goals.states import State
from talkcli.protocol.lines import MAX_LINE_BYTES
from talkcli.protocol.requests import REQUEST_TYPES, Sounds

NOW = 1000.0
OWN, PLAIN, CANCEL = (f"talk/robot/anna/{kind}/bob" for kind in ("request", "say", "cancel"))
REPLY = "talk/reply/bob/s1"
SAY = {"request": "say", "text": "hello"}
LONGEST = b"c" * policy.MAX_CORRELATION_BYTES

Decision = RemoteRequest | Refusal | Goodbye | Ignored


def decide(message: Message, *, stale: bool = False, allow: tuple[str, ...] = policy.ALLOWABLE_REQUESTS) -> Decision:
    parsed = topics.parse_request_topic(message.topic)
    assert parsed
    rules = Policy("anna", allow)
    rules.newest_echo_at = NOW - (6.01 if stale else 6)
    return rules.decide(message, *parsed, NOW)


def request(fields: object = SAY, topic: str = OWN, response: str | None = REPLY, **more: object) -> Message:
    payload = fields if isinstance(fields, bytes) else json.dumps(fields).encode()
    return replace(Message(topic, payload, response=response), **more)


def refusal_code(decision: Decision) -> str:
    assert isinstance(decision, Refusal), decision
    return decision.error.code


def accepted(decision: Decision) -> RemoteRequest:
    assert isinstance(decision, RemoteRequest), decision
    return decision


# Accepted requests


@pytest.mark.parametrize("topic", [OWN, "talk/group/all/request/bob", "talk/group/g/request/bob"])
@pytest.mark.parametrize("response", [REPLY, f"{REPLY}/anna"])
def test_a_reply_is_sent_to_a_topic_with_the_robots_name(topic: str, response: str) -> None:
    remote = accepted(decide(request({"seq": 5, **SAY}, topic, response, correlation=b"c")))
    assert (remote.user, remote.reply_topic, remote.seq, remote.correlation) == ("bob", f"{REPLY}/anna", 5, b"c")
    assert (remote.request, remote.start_by) == (Say("hello"), None)


@pytest.mark.parametrize(
    ("topic", "payload", "expected"),
    [
        (OWN, json.dumps(SAY).encode() + b"\n", Say("hello")),
        *((PLAIN, text.encode(), Say(text)) for text in ("hello", '{"request": "cancel"}', "-w", "two\nlines\n", " ")),
        *((CANCEL, payload, Cancel()) for payload in (b"", b"anything", b"\xff", b"x" * 100_000)),
    ],
)
def test_plain_text_is_literal_and_any_cancel_payload_cancels_all(topic: str, payload: bytes, expected: object) -> None:
    remote = accepted(decide(request(payload, topic, None)))
    assert (remote.request, remote.reply_topic) == (expected, None)
    assert remote.size_bytes == (0 if topic == CANCEL else len(payload))
    assert not isinstance(remote.request, Cancel) or remote.request.selects_all


def test_an_empty_request_ends_the_session_that_it_names() -> None:
    assert decide(request(b"")) == Goodbye("bob", f"{REPLY}/anna")
    for topic, response in ((OWN, None), (PLAIN, None), (PLAIN, REPLY)):
        assert isinstance(decide(request(b"", topic, response)), Ignored)


# Refusals, and their order


@pytest.mark.parametrize("payload", [b"", json.dumps(SAY).encode(), b"{", b"x" * 100_000])
@pytest.mark.parametrize("topic", [OWN, PLAIN, CANCEL])
def test_a_retained_message_is_ignored_before_any_other_check(topic: str, payload: bytes) -> None:
    decision = decide(request(payload, topic, retained=True), stale=True, allow=())
    assert isinstance(decision, Ignored)
    assert decision.kind == "retained"


@pytest.mark.parametrize("response", ["talk/reply/eve/s1", "talk/robot/berta/say/bob", "elsewhere", ""])
def test_a_message_with_another_users_response_topic_is_ignored(response: str) -> None:
    decision = decide(request(response=response))
    assert isinstance(decision, Ignored)
    assert decision.kind == "response"


@pytest.mark.parametrize(
    ("payload", "topic", "code"),
    [
        (b"x" * MAX_LINE_BYTES, OWN, "line_too_long"),
        (b" " * (MAX_LINE_BYTES - 1) + b"\n", OWN, "bad_json"),  # the longest valid line
        (b"\xff", OWN, "bad_encoding"),
        (b"{", OWN, "bad_json"),
        (b'{"seq": "x", "request": "say", "text": "a"}', OWN, "bad_field"),
        (b'{"request": "sing"}', OWN, "unknown_request"),
        (b'{"request": "say", "text": "a", "colour": "red"}', OWN, "unknown_field"),
        (b'{"request": "say", "text": "a"}\n{"request": "say", "text": "b"}', OWN, "bad_json"),
        (b"x" * MAX_LINE_BYTES, PLAIN, "line_too_long"),
        (b"a\xff", PLAIN, "bad_encoding"),
    ],
)
def test_a_malformed_request_gets_its_error_even_if_stale_and_forbidden(payload: bytes, topic: str, code: str) -> None:
    assert refusal_code(decide(request(payload, topic), stale=True, allow=())) == code


@pytest.mark.parametrize("response", [REPLY, None])
def test_an_error_repeats_the_number_and_correlation_of_its_request(response: str | None) -> None:
    refusal = decide(request({"seq": 7, "request": "say"}, response=response, correlation=b"c"))
    assert isinstance(refusal, Refusal)
    assert refusal.error.code == "bad_field"
    if response is None:
        assert refusal.reply is None
    else:
        error = {"code": "bad_field", "message": refusal.error.message}
        assert refusal.reply
        assert (refusal.reply.topic, refusal.reply.correlation) == (f"{REPLY}/anna", b"c")
        assert json.loads(refusal.reply.payload) == {"seq": 7, "ok": False, "error": error}


@pytest.mark.parametrize(
    ("fields", "code", "seq"), [(b"{", "bad_json", None), (SAY, "bad_field", None), ({"seq": 7, **SAY}, "bad_field", 7)]
)
def test_correlation_data_that_is_too_long_is_not_returned(fields: object, code: str, seq: int | None) -> None:
    assert accepted(decide(request(correlation=LONGEST))).correlation == LONGEST
    refusal = decide(request(fields, correlation=LONGEST + b"c"), stale=True, allow=())
    assert isinstance(refusal, Refusal)
    assert refusal.reply
    assert (refusal_code(refusal), refusal.reply.correlation) == (code, None)
    assert json.loads(refusal.reply.payload).get("seq") == seq


def test_every_kind_of_request_except_hello_and_watch_can_be_forbidden() -> None:
    assert {*policy.ALLOWABLE_REQUESTS, *policy.ALWAYS_ALLOWED, *policy.ALLOWED_WITH_SAY} == {*REQUEST_TYPES}
    for kind in policy.ALWAYS_ALLOWED:
        assert accepted(decide(request({"request": kind}), allow=())).request.kind == kind
    for kind in policy.ALLOWABLE_REQUESTS:
        fields = {"request": kind, **({"text": "a"} if kind == "say" else {})}
        assert refusal_code(decide(request(fields), allow=())) == "not_allowed"
        assert accepted(decide(request(fields), allow=(kind,))).request.kind == kind
    assert refusal_code(decide(request(b"hi", PLAIN), stale=True, allow=("cancel",))) == "not_allowed"


def test_sounds_may_be_listed_where_sentences_are_allowed() -> None:
    assert accepted(decide(request({"request": "sounds"}), allow=("say",))).request == Sounds()
    assert refusal_code(decide(request({"request": "sounds"}), allow=("voices",))) == "not_allowed"


@pytest.mark.parametrize("stale", [False, True])
def test_text_may_be_added_wherever_sentences_are_allowed_even_late(stale: bool) -> None:
    message = request({"request": "append", "id": "a", "text": "b"})
    assert accepted(decide(message, stale=stale, allow=("say",))).request == Append("a", "b")
    refused = decide(message, allow=("append", "cancel"))
    assert refusal_code(refused) == "not_allowed"
    assert isinstance(refused, Refusal)
    assert "does not allow say requests" in refused.error.message


def test_a_pause_cannot_end_with_a_connection_over_a_broker() -> None:
    fields = {"request": "pause", "seconds": 5}
    assert accepted(decide(request(fields))).request == Pause(5)
    assert refusal_code(decide(request({**fields, "while_connected": True}))) == "bad_option"


def test_a_stale_sentence_is_refused_but_a_stale_cancel_is_accepted() -> None:
    assert refusal_code(decide(request(), stale=True)) == "stale"
    assert refusal_code(decide(request(b"hi", PLAIN), stale=True)) == "stale"
    assert accepted(decide(request({"request": "cancel"}), stale=True)).request == Cancel()


@pytest.mark.parametrize(
    ("token", "stale"),
    [
        *((f"5e55 {NOW - age}", False) for age in (0, 6)),
        *((f"5e55 {NOW - age}", True) for age in (6.01, -0.01)),
        *(
            (token, True)
            for token in (f"another {NOW}", "5e55 nan", "5e55 x", "5e55", "", f" {NOW}", "5e55 " + "9" * 5000)
        ),
    ],
)
@pytest.mark.parametrize("newest_echo_at", [0.0, NOW])
def test_a_sentence_is_as_old_as_its_token_whatever_the_echo_says(
    token: str, stale: bool, newest_echo_at: float
) -> None:
    rules = Policy("anna", policy.ALLOWABLE_REQUESTS, "5e55")
    rules.newest_echo_at = newest_echo_at
    assert rules.new_token(NOW) == f"5e55 {NOW}"
    decision = rules.decide(request(token=token), topics.REQUEST, "bob", NOW)
    assert (isinstance(decision, Refusal) and decision.error.code == "stale") == stale


def test_200_messages_of_a_user_are_due_at_once_and_then_100_per_second() -> None:
    rules = connected(NOW)

    def delay(user: str = "bob", now: float = NOW) -> float | None:
        due = rules.due_time(user, now)
        return due and max(0.0, due - now)

    assert {delay() for _ in range(201)} == {0.0}
    delays = [delay() for _ in range(51)]
    assert delays[:50] == pytest.approx([number / 100 for number in range(1, 51)])
    assert (delays[50], delay(now=NOW + 0.005), delay("eve")) == (None, None, 0.0)
    assert delay(now=NOW + 0.2) == pytest.approx(0.31)
    assert {delay(now=NOW + 1000) for _ in range(201)} == {0.0}
    assert {delay(f"user {number}") for number in range(2_000)} == {0.0}
    assert (delay(now=NOW + 2_000), len(rules._next_due)) == (0.0, 1)


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        (request({"request": "cancel", "ids": ["a"]}), True),
        (request(b'{"seq": 1, "request"  :\t"cancel"}'), True),
        (request(b"", CANCEL), True),
        (request({"request": "say", "text": "cancel", "key": "cancel"}), False),
        (request({"request": "say", "text": '"request": "cancel"'}), False),
        (request(b'"request": "cancel"', PLAIN), False),
    ],
)
def test_only_a_cancel_is_never_delayed(message: Message, expected: bool) -> None:
    kind = topics.parse_request_topic(message.topic)
    assert kind
    assert policy.is_cancel(message, kind[0]) is expected


# Maximum age


@pytest.mark.parametrize(
    ("ttl", "expiry", "waited", "remaining"),
    [
        (None, None, 3, None),
        (5, None, 3, 5),
        (None, 10, 0, 10),
        (0, 10, 0, 10),  # the sentence itself has no limit
        (5, 10, 0, 5),
        (20, 10, 0, 10),
        (20, 10, 4, 6),
        (5, 10, 8, 2),
        (None, 10, 10, 0.001),  # 0 would mean no limit
        (None, 10, 11, 0.001),
    ],
)
def test_a_sentence_expires_no_later_than_its_message(
    ttl: float | None, expiry: int | None, waited: float, remaining: float | None
) -> None:
    remote = accepted(decide(request({**SAY, **({} if ttl is None else {"ttl": ttl})}, expiry=expiry)))
    say = remote.build_say("x", NOW + waited)
    assert (say.ttl, say.id) == (remaining, "x")


def is_stale(rules: Policy, now: float) -> bool:
    """Return whether a sentence that arrives now is refused."""
    decision = rules.decide(request(), topics.REQUEST, "bob", now)
    return isinstance(decision, Refusal) and decision.error.code == "stale"


def return_echo(rules: Policy, sent_at: float, now: float) -> bool:
    """Let an echo come back, and return whether it is the newest one so far."""
    before = rules.newest_echo_at
    rules.record_echo(f"{sent_at}".encode(), now)
    return rules.newest_echo_at > before


def connected(now: float) -> Policy:
    """Return the rules of a robot that has just connected to the broker."""
    rules = Policy("anna", policy.ALLOWABLE_REQUESTS)
    rules.newest_echo_at = now
    return rules


@pytest.mark.parametrize(
    "unknown", [b"20.1", b"0", b"-1", b"", b"one", b"7" * 5000, b"inf", b"nan", b"15.0 15.0", b"\xb2", b"\xff"]
)
def test_an_unknown_echo_is_ignored(unknown: bytes) -> None:
    rules = connected(0.0)
    rules.record_echo(unknown, 20.0)
    assert is_stale(rules, 10.0)
    assert return_echo(rules, 10.0, 20.0)
    assert not return_echo(rules, 10.0, 20.0)  # a duplicate
    assert not is_stale(rules, 10.0)


@given(st.lists(st.tuples(st.sampled_from(["send", "return", "wait"]), st.integers(0, 12)), max_size=60))
def test_messages_older_than_the_newest_echo_allows_are_refused(steps: list[tuple[str, int]]) -> None:
    """If a message arrives after an echo, the broker forwarded it after the echo was sent."""
    now, proved, rules = 0.0, 0.0, connected(0.0)
    sent: list[float] = []
    for action, number in steps:
        if action == "wait":
            now += number
        elif action == "send":
            sent.append(now)
        elif number < len(sent):
            assert return_echo(rules, sent[number], now) == (sent[number] > proved)
            proved = max(proved, sent[number])
        assert is_stale(rules, now) == (now - proved > policy.STALE_AFTER_S)


# Goals that were sent before


def test_the_last_thousand_ids_are_stored_with_the_servers_boot_id() -> None:
    ids = SentIds()
    for number in range(1200):
        ids.add(f"goal-{number}", "1a1a", "bob")
    ids.add("goal-200", "2b2b", "bob")  # added again, it becomes the newest
    ids.add("more", "2b2b", "olga")
    known = {goal_id: ids.boot_of(goal_id) for goal_id in ("goal-200", "goal-201", "goal-202", "more")}
    assert known == {"goal-200": "2b2b", "goal-201": None, "goal-202": "1a1a", "more": "2b2b"}
    assert [ids.user_of(goal_id) for goal_id in ("goal-202", "more", "goal-201")] == ["bob", "olga", None]
    ids.discard("more")
    assert ids.boot_of("more") is None
    ids.discard("never known")


@pytest.mark.parametrize(
    ("pending", "places"),
    [
        ([], 15),
        ([15], 4),
        ([15, 4], 1),
        ([15, 4, 1], 0),
        ([1] * 12, 6),
        ([5], 12),
    ],
)
def test_a_user_may_have_three_pending_goals_for_each_free_place(pending: list[int], places: int) -> None:
    ids = SentIds()
    goals = RemoteGoals(ids)

    def add(user: str) -> None:
        goal_id = f"g{len(goals)}"
        ids.add(goal_id, "1a1a", user)
        goals.add(goal_id, None)

    for number, count in enumerate(pending):
        for _ in range(count):
            add(f"user-{number}")
    while goals.has_room(Say("a"), "bob"):
        add("bob")
    assert goals.count("bob") == places


def test_twenty_goals_may_be_pending_whether_reply_or_event_arrives_first() -> None:
    goals = RemoteGoals(SentIds())
    for number in range(20):
        assert goals.has_room(Say("a"), "bob")
        goals.add(f"g{number}", "battery" if number == 7 else None)
        if number % 2:
            goals.record_pending(f"g{number}", "battery" if number == 7 else None)
            goals.record_reply(f"g{number}", pending=True)
        elif number:  # the first goal stays unanswered
            goals.record_reply(f"g{number}", pending=True)
            goals.record_pending(f"g{number}", None)
    assert (len(goals), goals.pending_count) == (20, 19)
    sentences = [Say("a"), Say("a", key="door"), Say("a", key="battery"), Say("a", flush=True), Say("a", preempt=True)]
    assert [goals.has_room(say, "bob") for say in sentences] == [False, False, True, True, True]
    goals.remove("g3")
    assert goals.has_room(Say("a"), "bob")


def test_unanswered_goals_still_count_after_a_new_watch() -> None:
    goals = RemoteGoals(SentIds())
    goals.add("unanswered", None)
    goals.record_pending("ended", None)
    goals.replace_pending([("there", "k")])
    assert (len(goals), goals.pending_count) == (2, 1)
    goals.replace_pending([])
    assert (len(goals), goals.pending_count) == (1, 0)


@given(
    st.lists(
        st.tuples(st.sampled_from(["sent", "accepted", "refused", "queued", "dequeued"]), st.integers(0, 6)),
        max_size=80,
    )
)
def test_remote_goals_are_counted_as_in_a_simple_model(steps: list[tuple[str, int]]) -> None:
    goals = RemoteGoals(SentIds())
    unanswered: set[int] = set()
    pending: set[int] = set()
    for action, number in steps:
        name = str(number)
        if action == "sent":
            goals.add(name, None)
            unanswered |= {number}
        elif action in ("accepted", "refused"):
            goals.record_reply(name, pending=action == "accepted")
            if number in unanswered and action == "accepted":
                pending |= {number}
            unanswered -= {number}
        elif action == "queued":
            goals.record_pending(name, None)
            pending |= {number}
        else:
            assert goals.remove(name) is (number in unanswered | pending)
            unanswered -= {number}
            pending -= {number}
        assert (len(goals), goals.pending_count) == (len(unanswered | pending), len(pending))


# Names


def test_the_sender_name_of_a_remote_user_has_a_prefix_and_fits() -> None:
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


@pytest.mark.parametrize(
    ("name", "user"),
    [("mqtt:bob", "bob"), ("mqtt:bob patrol 2", "bob"), ("bob", None), (None, None)],
)
def test_the_user_of_a_remote_goal_is_part_of_its_senders_name(name: str | None, user: str | None) -> None:
    assert policy.remote_user(Goal("a", State.PENDING, client=Sender(name=name))) == user
    assert policy.remote_user(Goal("a", State.PENDING)) is None


def test_a_message_without_texts_has_no_field_that_may_quote_one() -> None:
    goal = Goal("a", State.SUCCEEDED, "secret", said="secret", spoken="secret", message="'secret'").to_json()
    kept = policy.without_texts({"goal": goal, "n": 1}, policy.PRIVATE_FIELDS)
    assert "secret" not in str(kept)
    assert kept["n"] == 1
