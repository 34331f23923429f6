"""What the wire's document says in sentences: each was asked of a server, and stands there still."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest

from tests.conformance.rawsocket import Raw
from tests.support.documents import WIRE, first_column, tables

if TYPE_CHECKING:
    from tests.support.processes import Talk

SENTENCES = " ".join(WIRE.text.split())
HELLO = b'{"seq": 6, "request": "hello"}\n'


def asked(talk: Talk, *lines: bytes | dict[str, Any]) -> list[dict[str, Any]]:
    """Return all that the server says to these lines, which are the last."""
    data = [each if isinstance(each, bytes) else json.dumps(each).encode() + b"\n" for each in lines]
    with Raw(talk.socket) as raw:
        raw.send(b"".join(data))
        raw.half_close()
        return raw.receive_all()[1:]


def say(**fields: object) -> dict[str, Any]:
    return {"seq": 7, "request": "say", "text": "length=0", **fields}


def test_what_is_bad_field_in_the_table(scripted: Talk) -> None:
    (row,) = [row for row in tables(WIRE.section("Errors and limits"))[0] if row[0] == "`bad_field`"]
    cases: dict[str, list[dict[str, Any]]] = {
        "a value of the wrong type": [say(rate=200.0), say(ttl=True), say(wait=None), say(text=None)],
        "`text` missing": [{"seq": 7, "request": "say"}],
        "`data` past 1 KiB": [say(data={"a": "b" * 1016})],
        "a `name`": [{"seq": 7, "request": "hello", "name": name} for name in ("", "n" * 65)],
        "in `wait`, `cancel` or `status`": [
            {"seq": 7, "request": request, **field}
            for each in ("", "i" * 65)
            for request, field in (
                ("wait", {"ids": [each]}),
                ("cancel", {"ids": [each]}),
                ("cancel", {"before": each}),
                ("status", {"id": each}),
            )
        ],
        "more than 4,096 `ids`": [{"seq": 7, "request": "wait", "ids": ["i"] * 4_097}],
        "a `count` out of its range": [{"seq": 7, "request": "log", "count": count} for count in (0, 2_201)],
    }
    for words, requests in cases.items():
        assert words in row[1]
        for request in requests:
            (error,) = asked(scripted, request)
            assert (error["seq"], error["error"]["code"]) == (7, "bad_field"), request


def test_data_is_counted_as_ascii(scripted: Talk) -> None:
    assert "in ASCII (`é` is `\\u00e9`)" in SENTENCES
    for data, fits in (("b" * 1_015, True), ("b" * 1_016, False), ("é" * 169, True), ("é" * 170, False)):
        (reply,) = asked(scripted, say(data={"a": data}))
        assert reply["ok"] is fits
        assert not fits or reply["goal"]["data"] == {"a": data}


def test_a_rejected_say_that_waits_is_told_its_state_and_result(scripted: Talk) -> None:
    assert "REJECTED (with `wait`, its `state` and its `result` follow then, too)" in SENTENCES
    for extra in ({"wait": True}, {"feedback": True}):
        reply, state, result = asked(scripted, say(**extra) | {"text": ""})
        assert reply["goal"]["state"] == state["state"] == result["goal"]["state"] == "REJECTED"
        assert (state["event"], result["event"]) == ("state", "result")
    assert [each["goal"]["state"] for each in asked(scripted, say(rate=1))] == ["REJECTED"]


def test_the_places_of_words_are_code_points(scripted: Talk) -> None:
    assert "in code points: not bytes, nor UTF-16 units" in SENTENCES
    text = "length=0.05 🤖🤖 e\u0301 end"
    words = [each for each in asked(scripted, say(text=text, feedback=True)) if each.get("event") == "word"]
    assert [(each["start"], each["end"]) for each in words] == [(0, 11), (12, 14), (15, 17), (18, 21)]
    assert [text[each["start"] : each["end"]] for each in words] == [each["word"] for each in words]


def test_an_integer_has_no_fraction(scripted: Talk) -> None:
    assert "`200.0` is none" in SENTENCES
    for request in (say(rate=200.0), say(priority=1.0), {"seq": 7, "request": "set", "pitch": 50.0}):
        assert asked(scripted, request)[0]["error"]["code"] == "bad_field"
    assert asked(scripted, say(ttl=5, volume=1))[0]["goal"]["state"] == "PENDING"  # but a number may be without one


@pytest.mark.parametrize(
    ("line", "code"),
    [
        (b"say hello\n", "bad_json"),
        (b'{"seq": 7, "seq": 7, "request": "hello"}\n', "bad_json"),
        (b'{"seq": 7, "request": "hello", "name": "\xff"}\n', "bad_encoding"),
        (b'{"seq": 7, "request": "hello", "name": "' + b"n" * 65_536, "line_too_long"),
        (b'{"seq": 7.0, "request": "hello"}\n', "bad_field"),
        (b'{"seq": "7", "request": "hello"}\n', "bad_field"),
    ],
)
def test_a_line_in_which_no_seq_can_be_read_is_answered_without(scripted: Talk, line: bytes, code: str) -> None:
    assert f"`{code}`" in SENTENCES.partition("A line in which no `seq` can be read is answered without one:")[2][:200]
    assert code in first_column(tables(WIRE.section("Errors and limits"))[0])
    hello, error = asked(scripted, HELLO, line)
    assert hello == {"seq": 6, "ok": True}
    assert error.keys() == {"ok", "error"}
    assert error["error"]["code"] == code
    assert asked(scripted, b'{"seq": 7, "no": 1}\n')[0]["seq"] == 7  # where it can, any error has it


def test_a_last_line_without_its_end_is_not_taken(scripted: Talk) -> None:
    assert "what has no `\\n` when you close is not taken" in SENTENCES
    assert asked(scripted, HELLO, json.dumps(say()).encode()) == [{"seq": 6, "ok": True}]
    assert scripted.watcher.goals() == []
