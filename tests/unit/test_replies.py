"""The greeting, and the form of replies."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from talkcli import __version__
from talkcli.errors import BadRequest, Busy, ProtocolMismatch
from talkcli.protocol.events import PROTOCOL, busy_greeting, check_greeting, failure, greeting, item, ok, take_seq
from talkcli.protocol.features import FEATURES
from talkcli.protocol.lines import decode, encode

if TYPE_CHECKING:
    from talkcli.goals.goal import JsonObject


def test_a_greeting_has_protocol_version_process_and_boot_id() -> None:
    message = greeting("1.2.3", 4711, "4k7f")
    assert message == {"talk": 1, "version": "1.2.3", "pid": 4711, "boot": "4k7f", "features": [*FEATURES]}
    assert PROTOCOL == 1
    check_greeting(decode(encode(message)))
    check_greeting({**message, "features": ["pause"], "new": {"a": 1}})


@pytest.mark.parametrize(
    ("protocol", "side"),
    [(2, "upgrade this command"), (99, "upgrade this command"), (0, "restart the server"), (-1, "restart the server")],
)
def test_a_protocol_mismatch_names_the_side_to_upgrade(protocol: int, side: str) -> None:
    with pytest.raises(ProtocolMismatch, match=side) as mismatch:
        check_greeting({**greeting("3.0", 1, "4k7f"), "talk": protocol})
    assert mismatch.value.exit_code == 9
    assert __version__ in mismatch.value.message
    assert "3.0" in mismatch.value.message


@pytest.mark.parametrize("message", [{}, {"talk": None}, {"talk": "1"}, {"talk": True}, {"talk": [1]}, {"ok": True}])
def test_an_invalid_greeting_is_a_protocol_mismatch(message: JsonObject) -> None:
    with pytest.raises(ProtocolMismatch):
        check_greeting(message)


@pytest.mark.parametrize(
    ("greeting", "message"),
    [
        (busy_greeting(), "too many clients; .*--max-clients"),
        (busy_greeting("too few descriptors"), "^too few descriptors$"),
        ({"talk": 1, "error": "busy", "message": ["none"]}, "--max-clients"),
        ({"talk": 1, "error": "busy", "message": ""}, "--max-clients"),
        ({"talk": 1, "error": "busy", "message": "\x1b[31m"}, "--max-clients"),
    ],
)
def test_a_full_server_is_busy_and_may_give_a_reason(greeting: JsonObject, message: str) -> None:
    with pytest.raises(Busy, match=message) as busy:
        check_greeting(greeting)
    assert (busy.value.code, busy.value.exit_code) == ("busy", 5)


def test_replies_have_the_number_of_their_request() -> None:
    assert ok(3, goal={}) == {"seq": 3, "ok": True, "goal": {}}
    assert ok(None) == {"ok": True}
    assert item(3, voice={}) == {"seq": 3, "voice": {}}
    assert item(None, voice={}) == {"voice": {}}
    error = {"code": "unknown_goal", "message": "no"}
    assert failure(3, **error) == {"seq": 3, "ok": False, "error": error}
    assert failure(0, "busy", "no")["seq"] == 0


def test_the_number_is_removed_from_a_request() -> None:
    message: JsonObject = {"seq": 7, "request": "status"}
    assert take_seq(message) == 7
    assert message == {"request": "status"}
    assert take_seq(message) is None
    assert take_seq({"seq": None}) is None


@pytest.mark.parametrize("seq", ["1", 1.0, True, [], {}])
def test_a_request_number_that_is_not_an_integer_is_refused(seq: object) -> None:
    with pytest.raises(BadRequest) as refused:
        take_seq({"seq": seq})
    assert refused.value.code == "bad_field"
