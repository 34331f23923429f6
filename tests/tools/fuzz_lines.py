"""Send mutated requests to a server, and check that each gets one reply.

python -m tests.tools.fuzz_lines [--count 100000 | --seconds 3600] [--seed N]
"""

from __future__ import annotations

import argparse
import contextlib
import json
import random
import threading
import time
from collections import Counter
from itertools import islice
from typing import TYPE_CHECKING

from tests.conformance.rawsocket import Raw
from tests.support import usage
from tests.support.processes import Talk

if TYPE_CHECKING:
    from collections.abc import Iterator

LINES = [
    '{"request": "hello", "name": "patrol", "urgent": false}',
    '{"request": "say", "text": "length=0 one two", "wait": true, "preempt": true, "format": "text"}',
    '{"request": "say", "text": "length=0 é 😀 \\ud83d", "data": {"a": [1, -2.5e3, null, "b"]}}',
    '{"request": "say", "text": "length=0", "key": "eta", "throttle": 0.5, "ttl": 2, "priority": -3, "flush": true}',
    '{"request": "say", "text": "length=0", "id": "dock17", "rate": 300, "volume": 0.25, "pitch": 70, "voice": "en"}',
    '{"request": "say", "text": "length=0 one ", "more": true, "stall": 1, "wait": true, "feedback": true}',
    '{"request": "append", "id": "grows1", "text": "two. ", "at": 13, "end": false, "broken": false}',
    '{"request": "wait", "ids": ["1b2d-1", "7"], "feedback": true}',
    '{"request": "cancel", "ids": ["1b2d-1"], "current": true, "before": null, "key": "eta"}',
    '{"request": "cancel"}',
    '{"request": "status", "id": "1b2d-1"}',
    '{"request": "status"}',
    '{"request": "voices"}',
    '{"request": "watch"}',
    '{"request": "log", "count": 3}',
    '{"request": "set", "rate": 200, "volume": 1.0, "voice": "default", "pitch": 50, "preempt": false, "ttl": 0}',
    '{"request": "pause"}',
    '{"request": "resume"}',
]
#: Values of the fields of an `append`. The first ones are right.
_ADDITIONS: dict[str, tuple[object, ...]] = {
    "text": ("two ", "two. ", "", " ", "\0", "\ud83d", "é 😀 ", "\n" * 50, "long " * 2_500, "длинный" * 1_500, None, 5),
    "at": (13, 0, 17, 9, 1 << 40, -1, 1e300, 1.5, None, True, "13", [13]),
    "end": (False, True, None, 0, "true"),
    "broken": (False, False, False, False, True, None, 1),
    "more": (True, 1),
}
#: Names of goals that the additions are for.
_GROWING = 5
_INSERTED = (b'"', b"{", b"}", b"[", b",", b"null", b"1e999", b"-", b"\\u0000")
#: Lines per connection. Each is followed by a hello, because the server closes after ten bad lines in a row.
BATCH = 1_000
_HELLO = b'{"request": "hello"}\n'
#: Ends each batch, because the reply to an addition to a long text only comes when the text was heard or its goal has
#: ended.
_CANCEL = b'{"request": "cancel"}\n'
#: The server keeps texts, and events that clients haven't read yet.
_GROWTH_LIMIT_KB = 24 * 1024
_REPLY_LIMIT_S = 60


def additions(source: random.Random) -> Iterator[str]:
    """Yield growing texts, and additions with valid and invalid fields to the latest ones."""
    count = 0
    while True:
        if source.random() < 0.2:
            count += 1
            goal = {"request": "say", "id": f"grows{count}", "text": source.choice(("length=0 one ", "length=0 o"))}
            yield json.dumps({**goal, "more": True, "stall": 1, "wait": source.random() < 0.5})
        fields = {"id": f"grows{source.randrange(max(0, count - _GROWING), count + 2)}"}
        chosen = source.sample([*_ADDITIONS], source.choice((1, 1, 1, 2, 2, 3, 4)))
        yield json.dumps({"request": "append", **fields, **{name: source.choice(_ADDITIONS[name]) for name in chosen}})


def mutated_lines(source: random.Random) -> Iterator[bytes]:
    """Yield requests in which bytes are changed, removed, repeated, inserted or replaced by other requests."""
    lines = [line.encode() for line in LINES]
    growing = additions(source)
    while True:
        if source.random() < 0.2:
            yield next(growing).encode() + b"\n"
            continue
        line = bytearray(source.choice(lines))
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
                other = source.choice(lines)
                line[place:] = other[source.randrange(len(other)) :]
            else:
                line[place:place] = source.choice(_INSERTED)
        yield bytes(line).replace(b"\n", b" ") + b"\n"


def fuzz(seed: int, *, count: float = float("inf"), seconds: float = float("inf")) -> Counter[str]:
    """Send mutated lines to a server until the count or the time is reached, and count the replies by error code."""
    replies: Counter[str] = Counter()
    lines = mutated_lines(random.Random(seed))
    with contextlib.closing(Talk(scripted=True, watched=False)) as talk:
        end = time.monotonic() + seconds
        _speak(talk, "length=0")
        before = usage.count(talk.pid)  # now the engine runs
        while replies.total() < 2 * count and time.monotonic() < end:
            _send_batch(talk, list(islice(lines, BATCH)), replies)
        assert talk.request("resume")["ok"]
        assert talk.request("cancel")["ok"]
        _speak(talk, "still here")
        usage.assert_not_grown(talk.pid, before, memory=_GROWTH_LIMIT_KB)
        talk.stop()
        assert "a bug" not in talk.log, talk.log[-2000:]
    return replies


def _speak(talk: Talk, text: str) -> None:
    with talk.connect() as wire:
        assert wire.request("say", text=text, wait=True)["ok"]
        assert wire.receive_event("result")["goal"]["state"] == "SUCCEEDED"


def _send_batch(talk: Talk, batch: list[bytes], replies: Counter[str]) -> None:
    wanted = replies.total() + 2 * len(batch) + 1
    end = time.monotonic() + _REPLY_LIMIT_S  # the server shows that it is alive all the time
    with Raw(talk.socket) as raw:
        raw.socket.settimeout(_REPLY_LIMIT_S)
        sender = threading.Thread(target=raw.send, args=(b"".join(line + _HELLO for line in batch) + _CANCEL,))
        sender.start()
        rest = b""
        while replies.total() < wanted and time.monotonic() < end and (data := raw.receive(_REPLY_LIMIT_S)):
            raw.received.clear()
            *lines, rest = (rest + data).split(b"\n")
            for line in lines:
                message = json.loads(line)
                if "ok" in message:
                    code = "no error" if message["ok"] else message["error"]["code"]
                    replies[code] += 1
                    assert code != "internal_error", line
        sender.join()
    assert replies.total() == wanted, f"{wanted - replies.total()} of {2 * len(batch) + 1} lines have no reply"


def main() -> None:
    parser = argparse.ArgumentParser(description="Check that each mutated request gets one reply.")
    limit = parser.add_mutually_exclusive_group()
    limit.add_argument("--count", type=float, default=100_000)
    limit.add_argument("--seconds", type=float)
    parser.add_argument("--seed", type=int, default=int(time.time()))
    options = parser.parse_args()
    limits = {"seconds": options.seconds} if options.seconds else {"count": options.count}
    print(f"seed {options.seed}", flush=True)
    print(fuzz(options.seed, **limits))


if __name__ == "__main__":
    main()
