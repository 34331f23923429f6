"""100,000 mutated requests from a seeded generator: each is answered by one reply, and the server stays what it is."""

from __future__ import annotations

import json
import random
import threading
from typing import TYPE_CHECKING

import pytest

from tests.conformance.rawsocket import Raw

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.conftest import MakeTalk

LINES = [
    '{"request": "hello", "name": "patrol", "urgent": false}',
    '{"request": "say", "text": "length=0 one two", "wait": true, "preempt": true, "format": "text"}',
    '{"request": "say", "text": "length=0 é 😀 \\ud83d", "data": {"a": [1, -2.5e3, null, "b"]}}',
    '{"request": "wait", "ids": ["abcd-1", "7"]}',
    '{"request": "cancel", "ids": ["abcd-1"], "current": true, "before": null}',
    '{"request": "cancel"}',
    '{"request": "status", "id": "abcd-1"}',
    '{"request": "status"}',
    '{"request": "voices"}',
]
COUNT = 100_000
#: Lines on one connection; a hello between them keeps ten bad ones in a row from ending it.
ON_ONE = 10_000


def mutated(source: random.Random) -> Iterator[bytes]:
    """Return lines without end: requests of which some bytes were changed, lost, doubled or taken from others."""
    whole = [each.encode() for each in LINES]
    while True:
        line = bytearray(source.choice(whole))
        for _ in range(source.choice((0, 1, 1, 1, 2, 4, 16))):
            place = source.randrange(len(line) + 1)
            kind = source.randrange(5)
            if kind == 0:
                line[place : place + 1] = bytes([source.randrange(256)])
            elif kind == 1:
                del line[place : place + source.randrange(1, 8)]
            elif kind == 2:
                line[place:place] = line[place : place + source.randrange(1, 20)]
            elif kind == 3:
                other = source.choice(whole)
                line[place:] = other[source.randrange(len(other)) :]
            else:
                line[place:place] = source.choice((b'"', b"{", b"}", b"[", b",", b"null", b"1e999", b"-", b"\\u0000"))
        yield bytes(line).replace(b"\n", b" ") + b"\n"


@pytest.mark.timeout(180)
def test_mutated_lines_get_one_reply_each(make_talk: MakeTalk) -> None:
    talk = make_talk(scripted=True, watched=False)
    lines = mutated(random.Random(20))
    for _ in range(COUNT // ON_ONE):
        batch = [next(lines) for _ in range(ON_ONE)]
        with Raw(talk.socket) as raw:
            data = b"".join(each + b'{"request": "hello"}\n' for each in batch)
            raw.socket.settimeout(60)
            sender = threading.Thread(target=_send, args=(raw, data))
            sender.start()
            replies = _count_replies(raw)
            sender.join()
        assert replies == 2 * ON_ONE
    with talk.connect() as wire:
        assert wire.request("cancel")["ok"]
        assert wire.request("say", text="still here", wait=True)["ok"]
        assert wire.receive_event("result")["goal"]["state"] == "SUCCEEDED"
    assert "a bug" not in talk.log


def _send(raw: Raw, data: bytes) -> None:
    raw.send(data)
    raw.half_close()


def _count_replies(raw: Raw) -> int:
    """Read to the end, and return how many replies there were, each of them well formed."""
    count, rest = 0, b""
    while data := raw.receive(60):
        raw.received.clear()
        *lines, rest = (rest + data).split(b"\n")
        for line in lines:
            message = json.loads(line)
            if "ok" in message:
                count += 1
                assert message["ok"] or message["error"]["code"] != "internal_error", line
    assert not rest
    return count
