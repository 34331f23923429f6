"""Writing and reading requests, and refusing unknown fields and wrong types."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from talkcli.errors import BadRequest
from talkcli.goals.options import (
    END_STATES,
    MAX_DATA_BYTES,
    MAX_ID_CHARS,
    MAX_IDS,
    MAX_LOG_GOALS,
    MAX_SENDER_NAME_CHARS,
    Cancel,
    Log,
    Say,
)
from talkcli.protocol.events import failure
from talkcli.protocol.lines import decode, encode, request_line, request_to_json
from talkcli.protocol.requests import REQUEST_TYPES, Request, Status, Wait, read_request
from tests.unit.test_lines import values

if TYPE_CHECKING:
    from talkcli.goals.goal import JsonObject
    from talkcli.goals.options import Option

integers = st.integers(-(10**18), 10**18)
goal_ids = st.text(min_size=1, max_size=MAX_ID_CHARS)
#: Values of each kind of option.
BY_KIND: dict[str, st.SearchStrategy[object]] = {
    "boolean": st.booleans(),
    "string": st.text(max_size=8),
    "integer": integers,
    "number": integers | st.floats(allow_nan=False, allow_infinity=False),
    "object": st.dictionaries(st.text(max_size=5), st.none() | st.booleans() | st.text(max_size=5), max_size=3),
    "id": goal_ids,
    "list": st.lists(goal_ids, max_size=4).map(tuple),
}


def requests_of(kind: type[Request]) -> st.SearchStrategy[Request]:
    fields = {option.name: BY_KIND[option.kind.name] for option in kind.options}
    optional = {option.name: st.none() | fields[option.name] for option in kind.options if option.default is None}
    limited = {
        "name": st.none() | st.text(min_size=1, max_size=MAX_SENDER_NAME_CHARS),
        "count": st.integers(1, MAX_LOG_GOALS),
        "at": st.none() | st.integers(0, 10**18),
        "state": st.none() | st.sampled_from(END_STATES),
        **dict.fromkeys(("since", "until"), st.none() | st.floats(-1e15, 1e15)),
    }
    return st.builds(kind, **{**fields, **optional, **{name: limited[name] for name in fields if name in limited}})


requests = st.one_of(*map(requests_of, REQUEST_TYPES.values()))
SETTINGS = {"rate", "volume", "voice", "pitch", "preempt", "ttl"}
ALL_FIELDS = sorted({option.name for kind in REQUEST_TYPES.values() for option in kind.options})


#: Required fields.
REQUIRED: dict[str, JsonObject] = {"say": {"text": "hi"}, "append": {"id": "4k7f-1"}}


def minimal(kind: str, **fields: object) -> JsonObject:
    """Return a request of a kind with these fields, and with those that the kind requires."""
    return {"request": kind, **REQUIRED.get(kind, {}), **fields}


def refusal(message: JsonObject) -> BadRequest:
    with pytest.raises(BadRequest) as refused:
        read_request(message)
    encode(failure(1, refused.value.code, refused.value.message))
    return refused.value


@given(requests, st.none() | integers)
def test_a_written_request_is_read_back_unchanged(request: Request, number: int | None) -> None:
    message: JsonObject = {"seq": number, **request_to_json(request)}
    line = request_line(message)
    assert line == encode(message)
    assert decode(line).pop("seq") == number
    assert read_request(decode(encode(request_to_json(request)))) == request


@pytest.mark.parametrize("text", ["\ud800", "Grüße \udc80", '"\\\b\n\x00\x7f\u2028🤖'])
def test_any_text_is_written_as_one_line(text: str) -> None:
    for request in (Say(text, key=text, data={text: [text, None, 1e300, True]}), Cancel((text, text), before=text)):
        assert request_line(request_to_json(request)) == encode(request_to_json(request))


@pytest.mark.parametrize("data", [{"x": float("nan")}, {"x": [-float("inf")]}, {"x": object()}])
def test_data_that_is_not_json_is_not_written(data: JsonObject) -> None:
    with pytest.raises((ValueError, TypeError)):
        request_line({"data": data})


@pytest.mark.parametrize("kind", REQUEST_TYPES)
def test_fields_at_their_defaults_are_not_written(kind: str) -> None:
    assert request_to_json(read_request(minimal(kind))) == minimal(kind)


def test_a_cancel_with_a_selector_does_not_select_all_goals() -> None:
    assert Cancel().selects_all
    for selection in ({"ids": ("4k7f-1",)}, {"ids": ()}, {"current": True}, {"before": "4k7f-1"}, {"key": ""}):
        assert not Cancel(**selection).selects_all


@pytest.mark.parametrize("kind", REQUEST_TYPES)
def test_an_unknown_field_is_refused_by_name(kind: str) -> None:
    for name in ("", "loudness", "Text", "seq", "request2", "a" * 5_000, "\x1b[31m", "\ud800"):
        refused = refusal(minimal(kind, **{name: None}))
        assert refused.code == "unknown_field"
        assert repr(name[:60])[1:-1] in refused.message
        assert len(refused.message) < 500


@pytest.mark.parametrize("kind", REQUEST_TYPES)
def test_a_request_accepts_only_its_own_fields(kind: str) -> None:
    for name in set(ALL_FIELDS) - {option.name for option in REQUEST_TYPES[kind].options}:
        assert refusal(minimal(kind, **{name: None})).code == "unknown_field"


@pytest.mark.parametrize("kind", ["", "SAY", "sing", "say ", "a" * 60_000, "\x1b]0;", "\ud800"])
def test_an_unknown_request_is_refused_with_a_list_of_known_ones(kind: str) -> None:
    refused = refusal({"request": kind})
    assert refused.code == "unknown_request"
    assert all(name in refused.message for name in REQUEST_TYPES)
    assert len(refused.message) < 500


@pytest.mark.parametrize("message", [{}, {"text": "hi"}, {"request": None}, {"request": 1}, {"request": ["say"]}])
def test_an_object_without_a_request_is_refused(message: JsonObject) -> None:
    assert refusal(message).code == "bad_request"


#: Invalid values of each kind.
WRONG: dict[str, list[object]] = {
    "boolean": [0, 1, "true", [], {}],
    "string": [1, True, ["hi"], {}],
    "integer": [1.0, 0.5, "5", True, [5]],
    "number": ["1", True, [1], {}],
    "object": [1, "a", [], True, {"a": "b" * MAX_DATA_BYTES}],
    "id": ["", 7, True, [], ["4k7f-1"], "a" * 65],
    "list": ["4k7f-1", 7, {"4k7f-1": 1}, [1], [None], [True], [""], ["a" * 65], [["4k7f-1"]], ["a"] * 4_097],
}
#: Invalid values of single fields.
OUTSIDE: dict[str, list[object]] = {"hello name": ["", "a" * 65], "append at": [-1], "log count": [0, -1, 2_201]}
OUTSIDE |= {"log state": ["", "PENDING", "aborted"], "log name": ["", "a" * 65], "log since": [1e16, -1e16, 10**400]}


@pytest.mark.parametrize(
    ("kind", "option"),
    [(kind, option) for kind in REQUEST_TYPES for option in REQUEST_TYPES[kind].options],
    ids=lambda value: getattr(value, "name", value),
)
def test_a_value_of_wrong_type_or_length_is_refused_with_its_field(kind: str, option: Option) -> None:
    null_fields = [] if option.default is None else [None]
    for value in [*WRONG[option.kind.name], *OUTSIDE.get(f"{kind} {option.name}", []), *null_fields]:
        refused = refusal(minimal(kind, **{option.name: value}))
        assert refused.code == "bad_field", value
        assert repr(option.name) in refused.message
        assert len(refused.message) < 500


@pytest.mark.parametrize("kind", REQUIRED)
def test_a_request_without_a_required_field_is_refused(kind: str) -> None:
    assert refusal({"request": kind}).code == "bad_field"


def test_values_at_their_limits_are_accepted() -> None:
    exact: JsonObject = {"a": "b" * (MAX_DATA_BYTES - len('{"a": ""}'))}
    assert MAX_DATA_BYTES == 1024
    assert read_request({"request": "say", "text": "", "data": exact}) == Say("", data=exact)
    longest = "a" * MAX_ID_CHARS
    assert read_request({"request": "status", "id": longest}) == Status(longest)
    assert read_request({"request": "wait", "ids": [longest] * MAX_IDS}) == Wait((longest,) * MAX_IDS)
    assert read_request({"request": "log", "count": 1}) == Log(1)
    assert read_request({"request": "log", "count": MAX_LOG_GOALS}) == Log(MAX_LOG_GOALS)


def test_values_out_of_range_are_read_because_they_reject_only_the_goal() -> None:
    wild: JsonObject = {"rate": 10**6, "volume": -1, "pitch": 101, "ttl": -0.5, "throttle": -1, "key": "", "id": "-"}
    read = read_request({"request": "say", "text": "hi", "priority": 10**12, **wild})
    assert isinstance(read, Say)
    assert {name: getattr(read, name) for name in wild} == wild
    assert read.priority == 10**12


@pytest.mark.parametrize("kind", REQUEST_TYPES)
def test_null_means_the_default_for_optional_fields(kind: str) -> None:
    null_fields = {option.name: None for option in REQUEST_TYPES[kind].options if option.default is None}
    assert read_request(minimal(kind, **null_fields)) == read_request(minimal(kind))


def test_deeply_nested_data_is_refused() -> None:
    for depth in range(900, 1_050):
        line = b'{"request": "say", "text": "hi", "data": {"a": ' + b"[" * depth + b"]" * depth + b"}}"
        with pytest.raises(BadRequest):
            read_request(decode(line))


@given(
    st.fixed_dictionaries({"request": st.sampled_from(sorted(REQUEST_TYPES)) | values})
    | st.dictionaries(st.sampled_from(["request", *ALL_FIELDS]) | st.text(max_size=3), values),
    st.dictionaries(st.sampled_from(ALL_FIELDS), values, max_size=3),
)
def test_any_object_is_read_as_a_request_or_refused(head: dict[str, object], fields: dict[str, object]) -> None:
    message = {**head, **fields}
    before = dict(message)
    assert outcome(message) in {"request", "bad_request", "unknown_request", "unknown_field", "bad_field"}
    assert message == before


def outcome(message: JsonObject) -> str:
    """Return "request" or the code of the refusal."""
    try:
        request = read_request(message)
    except BadRequest as refused:
        return refused.code
    assert read_request(request_to_json(request)) == request
    return "request"
