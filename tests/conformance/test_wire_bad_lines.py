"""Malformed lines get an error or close the connection. They change nothing, and neither do refused clients."""

from __future__ import annotations

import array
import contextlib
import itertools
import json
import os
import socket
import time
from typing import TYPE_CHECKING, Any

import pytest

from talkcli.server.run import MAX_EXTRA_CLIENTS
from tests.conformance.rawsocket import Raw

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.conftest import MakeTalk
    from tests.support.connection import Wire
    from tests.support.processes import Talk


MAX_LINE = 64 * 1024
STATUS = b'{"seq": 7, "request": "status"}\n'


def say(rest: str) -> bytes:
    return b'{"request": "say", "text": "hello"' + rest.encode() + b"}"


#: Lines, and the codes of their errors. `tests/unit/test_lines.py` has many more.
REFUSED: dict[str, tuple[bytes, str]] = {
    "a blank line": (b"", "bad_json"),
    "an array": (b'[{"request": "say", "text": "hello"}]', "bad_json"),
    "brackets 60,000 deep": (b"[" * 60_000, "bad_json"),
    "objects 9,000 deep": (say(', "data": ' + '{"a":' * 9_000), "bad_json"),
    "an integer of 5,000 digits": (say(', "seq": ' + "9" * 5_000), "bad_json"),
    "NaN": (say(', "data": {"a": NaN}'), "bad_json"),
    "a key twice": (say(', "text": "good bye"'), "bad_json"),
    "invalid UTF-8": (b'{"request": "say", "text": "hell\xf6"}', "bad_encoding"),
    "a NUL": (b'{"request": "say",\0 "text": "hello"}', "bad_json"),
    "a greeting of another protocol": (b'{"talk": 2, "version": "9"}', "bad_request"),
    "an unknown request": (b'{"request": "sing", "text": "hello"}', "unknown_request"),
    "an unknown field": (say(', "loud": true'), "unknown_field"),
    "a number that is not an integer": (say(', "seq": 1.5'), "bad_field"),
    "a number that is a string": (say(', "seq": "7"'), "bad_field"),
    "a TLS hello": (b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(range(128, 255)), "bad_encoding"),
    "an HTTP request": (b"GET /say?text=hello HTTP/1.1\r", "bad_json"),
}
#: `tests/unit/test_requests.py` has all of them.
WRONG_TYPES: list[tuple[str, str, object]] = [
    ("say", "text", None),
    ("say", "data", {"a": "é" * 170}),  # its length counts in ASCII
    ("hello", "name", ""),
    ("cancel", "ids", [7]),
    ("wait", "ids", ["i"] * 4_097),
    ("status", "id", "a" * 65),
]


@pytest.fixture
def talk(scripted: Talk) -> Iterator[Talk]:
    """A server that must speak no goal of the test, leak no descriptor, and still work at the end."""

    def speak(wire: Wire) -> str:
        goal_id = wire.request("say", text="length=0", wait=True)["goal"]["id"]
        assert wire.receive_event("result")["goal"]["state"] == "SUCCEEDED"
        return str(goal_id)

    with scripted.connect() as wire:
        spoken = speak(wire)
        before = descriptors(scripted)
        yield scripted
        assert wire.request("status")["active"] is None
        assert [item["recent"]["id"] for item in wire.items] == [spoken]
        last = speak(wire)
        scripted.watcher.wait_for_terminal(last)
        rejected = [goal_id for goal_id in scripted.watcher.goals() if scripted.watcher.states(goal_id) == ["REJECTED"]]
        assert scripted.watcher.goals() == [spoken, *rejected, last]
        end = time.monotonic() + 2
        while descriptors(scripted) > before and time.monotonic() < end:
            wire.request("status")  # the server may notice the end of a connection a little later
        assert descriptors(scripted) <= before
    assert "a bug" not in scripted.log


def descriptors(talk: Talk) -> int:
    """Return the number of descriptors that the server has open, or 0 if it is unknown."""
    folder = f"/proc/{talk.pid}/fd"
    return len(os.listdir(folder)) if os.path.isdir(folder) else 0


def assert_error(reply: dict[str, Any], code: str) -> None:
    assert (reply["ok"], reply["error"]["code"]) == (False, code), reply
    assert reply["error"]["message"]
    assert reply.keys() <= {"ok", "error", "seq"}


def test_bad_lines_are_answered_with_an_error_code(talk: Talk) -> None:
    for name, (line, code) in REFUSED.items():
        with Raw(talk.socket) as raw:
            raw.send(line + b"\n" + STATUS)
            _, error, *status = raw.receive_lines(4)
            assert_error(error, code)
            assert "seq" not in error, "an unreadable line has no `seq`"
            assert [message.keys() - {"recent"} for message in status[:-1]] == [{"seq"}], f"{name}: {status}"
            assert (status[-1]["seq"], status[-1]["ok"]) == (7, True), name


def test_fields_of_the_wrong_type_are_refused(talk: Talk) -> None:
    with talk.connect() as wire:
        for kind, field, value in WRONG_TYPES:
            text = {"text": "hello"} if kind == "say" else {}
            wire.send({"seq": 2**40, "request": kind, **text, field: value})
            reply = wire.receive()
            assert_error(reply, "bad_field")
            assert (field in reply["error"]["message"], reply["seq"]) == (True, 2**40), reply
            assert wire.request("status")["ok"]  # ten bad requests in a row would close the connection


def test_row_49_an_unknown_field_is_an_error(talk: Talk) -> None:
    kinds = ("hello", "say", "cancel", "watch")
    names = ("loudness", "Text", "", "x" * 1000, "\ud800")
    with talk.connect() as wire:
        for kind, name in itertools.product(kinds, names):
            text = {"text": "never-ends"} if kind == "say" else {}
            wire.send_raw(json.dumps({"request": kind, **text, name: 1}).encode() + b"\n")
            assert_error(wire.receive(), "unknown_field")
            assert wire.request("status")["active"] is None


def test_nested_data_of_any_depth_is_accepted_or_refused(talk: Talk) -> None:
    with talk.connect() as wire:
        for depth in (*range(160, 180), *range(960, 1_010)):
            data = '{"":' * depth + "1" + "}" * depth
            wire.send_raw(say(f', "format": "none", "data": {data}') + b"\n")
            reply = wire.receive()
            if reply["ok"]:
                assert reply["goal"]["state"] == "REJECTED"  # because of its unknown format, so nothing is spoken
            else:
                assert reply["error"]["code"] in {"bad_field", "bad_json"}
            assert wire.request("status")["ok"]


def test_an_overlong_line_closes_the_connection(talk: Talk) -> None:
    longest = say("").ljust(MAX_LINE - 1) + b"\n"
    for bad in (b" " + longest, b"a" * MAX_LINE, b"a" * 10_000_000, STATUS[:-1].ljust(MAX_LINE) + b"\n"):
        with Raw(talk.socket) as raw:
            raw.send(bad)
            _, error = raw.receive_all()
            assert_error(error, "line_too_long")
    with Raw(talk.socket) as raw:
        raw.send(STATUS[:-1].ljust(MAX_LINE - 1) + b"\n")
        assert raw.receive_lines(3)[2]["ok"]


def test_ten_bad_lines_in_a_row_close_the_connection(talk: Talk) -> None:
    for lines in (b"\n" * 10_000, b"GET / HTTP/1.1\r\nHost: robot\r\n" + b"X: y\r\n" * 20 + b"\r\n"):
        with Raw(talk.socket) as raw:
            raw.send(lines)
            _, *errors = raw.receive_all()
            assert 1 <= len(errors) <= 10
            for error in errors:
                assert_error(error, "bad_json")


def test_a_connection_that_closes_early_changes_nothing(talk: Talk) -> None:
    talk.request("status")  # when the reply arrives, all earlier events are logged
    before = talk.log
    for data in (b"", b"{", say(""), b"\n", b'{"request": "say", "text": "hel'):
        Raw(talk.socket).__exit__()
        for half in (True, False):
            with Raw(talk.socket) as raw:
                raw.send(data)
                if half:
                    raw.half_close()
                    assert len(raw.receive_all()) == (2 if data == b"\n" else 1)  # the greeting, and perhaps an error
    assert talk.request("status")["ok"]
    assert talk.log == before


@pytest.mark.skipif(not hasattr(socket, "SCM_RIGHTS"), reason="this system cannot pass descriptors")
def test_passed_descriptors_are_not_kept(talk: Talk) -> None:
    with Raw(talk.socket) as raw, open(os.devnull, "rb") as file:
        for _ in range(20):
            passed = array.array("i", [file.fileno()] * 5)
            raw.socket.sendmsg([STATUS], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, passed)])
        replies = [message for message in raw.receive_lines(1 + 2 * 20) if "ok" in message]
        assert [reply["ok"] for reply in replies] == [True] * 20


def test_requests_of_a_refused_client_are_ignored(make_talk: MakeTalk) -> None:
    talk = make_talk("--max-clients", "1", scripted=True, watched=False)
    with contextlib.ExitStack() as stack:
        asking = stack.enter_context(talk.connect())
        before = asking.request("status")["server"]
        for _ in range(MAX_EXTRA_CLIENTS):
            stack.enter_context(Raw(talk.socket))
        asking.request("hello", urgent=True)
        send_and_go(talk, b'{"request":"set","volume":0.1,"preempt":true}\n', b'{"request":"pause"}\n')
        with Raw(talk.socket) as last:  # when it is answered, the earlier clients have been handled
            last.receive_all()
        after = asking.request("status")["server"]
    changed = {setting for setting in ("volume", "preempt", "paused") if before[setting] != after[setting]}
    assert not changed
    assert "a bug" not in talk.log


def test_a_request_after_ten_bad_lines_is_ignored(scripted: Talk) -> None:
    send_and_go(scripted, b"garbage\n" * 10 + b'{"request":"pause"}\n')
    assert scripted.request("status")["server"]["paused"] is False


def send_and_go(talk: Talk, *lines: bytes) -> None:
    """Connect, send and close once for each of these lines, while the server is frozen."""
    talk.freeze()
    for line in lines:
        with Raw(talk.socket) as client:
            client.send(line)
    talk.thaw()
