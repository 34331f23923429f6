"""What a robot takes from the broker: each rule, its order among the others, and the limits of what is remembered."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from talkcli.fleet import policy, topics
from talkcli.fleet.message import Message
from talkcli.fleet.policy import Ask, Dropped, Echoes, HungUp, Ids, Policy, Refused, Share
from talkcli.frozen import replace
from talkcli.goals.goal import By, Goal, Sender
from talkcli.goals.option import MAX_NAME, is_clients_id
from talkcli.goals.options import Cancel, Say
from talkcli.goals.states import State
from talkcli.protocol.lines import MAX_LINE
from talkcli.protocol.requests import KINDS

NOW = 1000.0
OWN = "talk/robot/anna/request/bob"
REPLY = "talk/reply/bob/s1"
SAY = {"request": "say", "text": "hello"}

Judged = Ask | Refused | HungUp | Dropped


def judge(message: Message, *, stale: bool = False, allow: tuple[str, ...] = policy.ASKABLE) -> Judged:
    asked = topics.asked(message.topic)
    assert asked
    return Policy("anna", allow).judge(message, asked, NOW, stale=stale)


def request(fields: object = SAY, topic: str = OWN, response: str | None = REPLY, **more: object) -> Message:
    payload = fields if isinstance(fields, bytes) else json.dumps(fields).encode()
    return replace(Message(topic, payload, response=response), **more)


def refused(judged: Judged) -> str:
    assert isinstance(judged, Refused), judged
    error = judged.answer["error"]
    assert isinstance(error, dict)
    assert (error["code"], error["message"]) == (judged.code, judged.words)
    assert judged.answer["ok"] is False
    return judged.code


def asked(judged: Judged) -> Ask:
    assert isinstance(judged, Ask), judged
    return judged


# What a message asks for


@pytest.mark.parametrize("topic", [OWN, "talk/group/all/request/bob", "talk/group/g/request/bob"])
@pytest.mark.parametrize("response", [REPLY, f"{REPLY}/anna"])
def test_a_request_is_carried_out_for_its_user_and_answered_under_the_robots_name(topic: str, response: str) -> None:
    found = asked(judge(request({"seq": 5, **SAY}, topic, response, correlation=b"c")))
    assert (found.user, found.topic, found.seq, found.correlation) == ("bob", f"{REPLY}/anna", 5, b"c")
    assert (found.request, found.message, found.until) == (Say("hello"), SAY, None)


def test_a_newline_at_the_end_of_a_request_is_as_on_the_socket() -> None:
    assert asked(judge(request(json.dumps(SAY).encode() + b"\n"))).request == Say("hello")


def test_without_a_response_topic_nobody_is_answered() -> None:
    assert asked(judge(request(response=None))).topic is None
    found = judge(request(b"{", response=None))
    assert isinstance(found, Refused)
    assert found.topic is None


@pytest.mark.parametrize("text", ["hello", '{"request": "cancel"}', "-w", "two\nlines\n", " "])
def test_plain_text_is_always_literal(text: str) -> None:
    found = asked(judge(request(text.encode(), "talk/robot/anna/say/bob", None)))
    assert found.request == Say(text)


@pytest.mark.parametrize("payload", [b"", b"anything", b"\xff", b"x" * 100_000])
def test_whatever_comes_to_cancel_cancels_everything(payload: bytes) -> None:
    found = asked(judge(request(payload, "talk/robot/anna/cancel/bob", None)))
    assert found.request == Cancel()
    assert found.request.everything


def test_an_empty_request_is_the_goodbye_of_whom_it_names() -> None:
    assert judge(request(b"")) == HungUp("bob", f"{REPLY}/anna")


@pytest.mark.parametrize(("topic", "response"), [(OWN, None), ("talk/robot/anna/say/bob", None)])
def test_an_empty_message_that_names_nobody_is_nothing(topic: str, response: str | None) -> None:
    assert isinstance(judge(request(b"", topic, response)), Dropped)


# What is refused, and in which order


@pytest.mark.parametrize("payload", [b"", json.dumps(SAY).encode(), b"{", b"x" * 100_000])
@pytest.mark.parametrize("kind", ["request", "say", "cancel"])
def test_what_was_retained_is_dropped_before_anything_else(kind: str, payload: bytes) -> None:
    found = judge(request(payload, f"talk/robot/anna/{kind}/bob", retained=True), stale=True, allow=())
    assert isinstance(found, Dropped)
    assert found.kind == "retained"


@pytest.mark.parametrize(
    "response",
    [
        "talk/reply/eve/s1",
        "talk/reply/bob",
        "talk/reply/bob/s1/berta",
        "talk/reply/bob/s1/anna/more",
        "talk/robot/berta/say/bob",
        "talk/reply/bob/+",
        "elsewhere",
        "",
    ],
)
def test_nobody_has_the_robot_publish_anywhere_but_to_themselves(response: str) -> None:
    found = judge(request(response=response))
    assert isinstance(found, Dropped)
    assert found.kind == "response"


@pytest.mark.parametrize(
    ("payload", "code"),
    [
        (b"x" * MAX_LINE, "line_too_long"),
        (b" " * (MAX_LINE - 1) + b"\n", "bad_json"),  # as long as a line may be
        (b"\xff", "bad_encoding"),
        (b"{", "bad_json"),
        (b"[1]", "bad_json"),
        (b'{"request": "say", "text": "a", "text": "b"}', "bad_json"),
        (b'{"seq": "x", "request": "say", "text": "a"}', "bad_field"),
        (b"{}", "bad_request"),
        (b'{"request": "sing"}', "unknown_request"),
        (b'{"request": "say", "text": "a", "colour": "red"}', "unknown_field"),
        (b'{"request": "say"}', "bad_field"),
        (b'{"request": "say", "text": 1}', "bad_field"),
    ],
)
def test_what_is_no_request_has_the_wires_own_error_though_it_is_stale_and_not_allowed(
    payload: bytes, code: str
) -> None:
    assert refused(judge(request(payload), stale=True, allow=())) == code


@pytest.mark.parametrize(("payload", "code"), [(b"x" * MAX_LINE, "line_too_long"), (b"a\xff", "bad_encoding")])
def test_plain_text_that_cannot_be_said_is_refused(payload: bytes, code: str) -> None:
    assert refused(judge(request(payload, "talk/robot/anna/say/bob"))) == code


def test_an_error_has_the_number_and_the_correlation_of_its_request() -> None:
    found = judge(request({"seq": 7, "request": "say"}, correlation=b"c"))
    assert isinstance(found, Refused)
    assert (found.answer["seq"], found.correlation, found.topic) == (7, b"c", f"{REPLY}/anna")


@pytest.mark.parametrize("fields", [b"{", SAY])
def test_correlation_data_that_are_too_long_stand_on_no_answer(fields: object) -> None:
    longest = b"c" * policy.MAX_CORRELATION
    assert asked(judge(request(correlation=longest))).correlation == longest
    found = judge(request(fields, correlation=longest + b"c"))
    assert isinstance(found, Refused)
    assert found.correlation is None
    assert refused(found) == ("bad_json" if fields == b"{" else "bad_field")
    found = judge(request({"seq": 7, **SAY}, correlation=longest + b"c"), stale=True, allow=())
    assert isinstance(found, Refused)
    assert (found.code, found.answer["seq"]) == ("bad_field", 7)


def test_what_is_not_allowed_is_refused_though_it_is_stale() -> None:
    assert refused(judge(request(), stale=True, allow=("cancel",))) == "not_allowed"
    assert refused(judge(request(b"hi", "talk/robot/anna/say/bob"), allow=("cancel",))) == "not_allowed"


@pytest.mark.parametrize("kind", ["hello", "watch"])
def test_who_one_is_and_what_happens_may_always_be_asked(kind: str) -> None:
    assert asked(judge(request({"request": kind}), allow=())).request.kind == kind


def test_what_may_be_forbidden_and_what_may_not_are_all_requests() -> None:
    assert {*policy.ASKABLE, *policy.ALWAYS} == {*KINDS}
    for kind in policy.ASKABLE:
        fields = {"request": kind, **({"text": "a"} if kind == "say" else {})}
        assert refused(judge(request(fields), allow=())) == "not_allowed"
        assert asked(judge(request(fields), allow=(kind,))).request.kind == kind


def test_of_what_may_be_old_a_sentence_alone_is_refused() -> None:
    assert refused(judge(request(), stale=True)) == "stale"
    assert refused(judge(request(b"hi", "talk/robot/anna/say/bob"), stale=True)) == "stale"
    assert asked(judge(request({"request": "cancel"}), stale=True)).request == Cancel()


# How long it has to begin


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
def test_a_sentence_begins_before_its_message_has_expired(
    ttl: float | None, expiry: int | None, waited: float, left: float | None
) -> None:
    found = asked(judge(request({**SAY, **({} if ttl is None else {"ttl": ttl})}, expiry=expiry)))
    assert found.line(NOW + waited, "x").get("ttl") == left
    assert found.line(NOW + waited, "x")["id"] == "x"


def test_a_message_that_expires_gives_nothing_but_a_sentence_a_time_to_live() -> None:
    assert asked(judge(request({"request": "cancel"}, expiry=5))).line(NOW, None) == {"request": "cancel"}


# How old it may be


def text(number: int) -> bytes:
    """Return the number of an echo as the echo has it."""
    return f"{number}".encode()


def test_what_comes_within_six_seconds_of_the_newest_echo_that_came_back_is_taken() -> None:
    echoes = Echoes(100.0)
    assert not echoes.stale(106.0)
    assert echoes.stale(106.01)
    first, second = echoes.send(104.0), echoes.send(105.0)
    assert echoes.came(text(first))
    assert not echoes.stale(110.0)
    assert echoes.stale(110.01)
    assert echoes.came(text(second))
    assert not echoes.stale(111.0)


def test_an_echo_counts_from_when_it_was_sent_not_from_when_it_came() -> None:
    echoes = Echoes(0.0)
    assert echoes.came(text(echoes.send(1.0)))
    assert echoes.stale(50.0)


@pytest.mark.parametrize("unknown", [b"2", b"0", b"-1", b"", b"1.0", b"one", b"7" * 5000, b"\xb2", b"\xff"])
def test_an_echo_that_is_not_known_tells_nothing(unknown: bytes) -> None:
    echoes = Echoes(0.0)
    number = text(echoes.send(10.0))
    assert not echoes.came(unknown)
    assert echoes.stale(10.0)
    assert echoes.came(number)
    assert not echoes.came(number)  # twice
    assert not echoes.stale(10.0)


@given(st.lists(st.tuples(st.sampled_from(["send", "come", "wait"]), st.integers(0, 12)), max_size=60))
def test_nothing_is_taken_that_is_older_than_what_the_echoes_prove(steps: list[tuple[str, int]]) -> None:
    """A message that comes with an echo was sent on by the broker no earlier than that echo was sent."""
    now, proved, echoes = 0.0, 0.0, Echoes(0.0)
    sent: dict[int, float] = {}
    for what, number in steps:
        if what == "wait":
            now += number
        elif what == "send":
            sent[echoes.send(now)] = now
        elif echoes.came(text(number)):
            proved = max(proved, sent[number])
        assert echoes.stale(now) == (now - proved > policy.STALE_AFTER)


def test_echoes_that_never_come_back_are_not_kept_for_ever() -> None:
    echoes = Echoes(0.0)
    numbers = [echoes.send(float(each)) for each in range(1000)]
    assert (
        sum(echoes.came(text(each)) for each in reversed(numbers)) == 1
    )  # the newest; those before it tell nothing more
    assert echoes.send(0.0) == 1001


# What was sent before


def test_the_last_thousand_ids_are_remembered_with_the_servers_start() -> None:
    ids = Ids()
    for each in range(1200):
        ids.note(f"goal-{each}", "1a1a")
    ids.note("goal-200", "2b2b")  # anew: it is the newest now
    ids.note("more", "2b2b")
    assert ids.boot_of("goal-200") == "2b2b"
    assert ids.boot_of("goal-201") is None
    assert ids.boot_of("goal-202") == "1a1a"
    ids.forget("more")
    assert ids.boot_of("more") is None
    ids.forget("never known")


# The share


def test_twenty_goals_may_be_pending_whichever_of_reply_and_event_comes_first() -> None:
    share = Share()
    for each in range(20):
        assert share.has_room(Say("a"))
        share.sent(f"g{each}", None)
        if each % 2:
            share.came(f"g{each}", None)
            share.answered(f"g{each}", pending=True)
        else:
            share.answered(f"g{each}", pending=True)
            share.came(f"g{each}", None)
    assert (len(share), share.pending) == (20, 20)
    assert not share.has_room(Say("a"))
    share.left("g3")
    assert share.has_room(Say("a"))


def test_a_goal_that_has_left_before_its_reply_is_not_counted_again() -> None:
    share = Share()
    share.sent("a", None)
    share.came("a", None)
    share.left("a")
    share.answered("a", pending=True)
    assert len(share) == 0


def test_what_is_refused_or_rejected_gives_its_place_back() -> None:
    share = Share()
    share.sent("a", None)
    share.answered("a", pending=False)
    assert len(share) == 0


def test_a_goal_that_takes_anothers_place_or_preempts_needs_no_room() -> None:
    share = Share()
    for each in range(20):
        share.sent(f"g{each}", "battery" if each == 7 else None)
    assert share.has_room(Say("a", flush=True))
    assert share.has_room(Say("a", key="battery"))
    assert not share.has_room(Say("a", key="door"))
    assert share.has_room(Say("a", preempt=True))


def test_as_the_server_is_watched_anew_what_is_on_its_way_still_counts() -> None:
    share = Share()
    share.sent("on its way", None)
    share.came("over", None)
    share.begin([("there", "k")])
    assert (len(share), share.pending) == (2, 1)
    share.clear()
    assert len(share) == 0


@given(
    st.lists(
        st.tuples(st.sampled_from(["sent", "accepted", "refused", "came", "left"]), st.integers(0, 6)), max_size=80
    )
)
def test_the_share_counts_what_a_slow_model_counts(steps: list[tuple[str, int]]) -> None:
    share = Share()
    on_way: set[int] = set()
    pending: set[int] = set()
    for what, number in steps:
        name = str(number)
        if what == "sent":
            share.sent(name, None)
            on_way |= {number}
        elif what in ("accepted", "refused"):
            share.answered(name, pending=what == "accepted")
            if number in on_way and what == "accepted":
                pending |= {number}
            on_way -= {number}
        elif what == "came":
            share.came(name, None)
            pending |= {number}
        else:
            assert share.left(name) is (number in on_way | pending)
            on_way -= {number}
            pending -= {number}
        assert (len(share), share.pending) == (len(on_way | pending), len(pending))


# What a robot says in its server's place


@pytest.mark.parametrize(("wait", "feedback"), [(False, False), (True, False), (False, True)])
def test_a_goal_that_never_came_to_the_server_is_told_as_the_server_would(wait: bool, feedback: bool) -> None:
    say = {"seq": 3, **SAY, "wait": wait, "feedback": feedback, "key": "k", "priority": 2}
    goal, lines = policy.not_taken(
        asked(judge(request(say))), "anna-x1", State.RECALLED, "canceled", "words", 5.0, By(client=Sender(name="x"))
    )
    assert Goal.from_json(lines[0]["goal"]) == goal
    assert (lines[0]["seq"], lines[0]["ok"]) == (3, True)
    assert (goal.text, goal.key, goal.priority, goal.reason) == ("hello", "k", 2, "canceled")
    assert goal.client == Sender(name="mqtt:bob")
    assert [each["event"] for each in lines[1:]] == (["state", "result"] if wait or feedback else [])


def test_the_name_of_a_user_from_afar_fits_and_says_so() -> None:
    longest = "u" * topics.LONGEST
    assert policy.sender("bob") == "mqtt:bob"
    assert policy.sender("bob", "patrol") == "mqtt:bob patrol"
    assert policy.sender(longest) == f"mqtt:{longest}"
    assert len(policy.sender(longest)) == len(policy.sender("bob", "n" * MAX_NAME)) == MAX_NAME
    assert is_clients_id(f"{longest[:48]}-x{0:012x}")
