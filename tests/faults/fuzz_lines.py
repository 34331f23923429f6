"""A fuzzer of the socket: mutated requests from a seeded generator, each answered by one reply.

python -m tests.faults.fuzz_lines [--count 100000 | --seconds 3600] [--seed N]
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import threading
import time
from dataclasses import dataclass, field
from itertools import islice
from typing import TYPE_CHECKING

from tests.conformance.rawsocket import Raw
from tests.support import census
from tests.support.processes import Talk

if TYPE_CHECKING:
    from collections.abc import Iterator

LINES = [
    '{"request": "hello", "name": "patrol", "urgent": false}',
    '{"request": "say", "text": "length=0 one two", "wait": true, "preempt": true, "format": "text"}',
    '{"request": "say", "text": "length=0 é 😀 \\ud83d", "data": {"a": [1, -2.5e3, null, "b"]}}',
    '{"request": "say", "text": "length=0", "key": "eta", "throttle": 0.5, "ttl": 2, "priority": -3, "flush": true}',
    '{"request": "say", "text": "length=0", "id": "dock17", "rate": 300, "volume": 0.25, "pitch": 70, "voice": "en"}',
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
#: Lines on one connection. Each is followed by a hello, which keeps ten bad ones in a row from ending it.
ON_ONE = 1_000
_HELLO = b'{"request": "hello"}\n'
#: kB that the server may grow by: the texts that it keeps, and what those are told who watch and wait.
GROWN = 24 * 1024


@dataclass(slots=True)
class Report:
    """What a run of the fuzzer did and found."""

    seed: int
    lines: int = 0
    errors: dict[str, int] = field(default_factory=dict)
    failures: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        errors = ", ".join(f"{count} {code}" for code, count in sorted(self.errors.items()))
        return "\n".join((f"seed {self.seed}, {self.lines} lines; {errors}", *map("FAILED: {}".format, self.failures)))


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


def fuzz(seed: int, *, count: int | None = None, seconds: float | None = None) -> Report:
    """Send so many lines, or for so long, to a server with the scripted engine, and see that it stays what it is."""
    report = Report(seed)
    lines = mutated(random.Random(seed))
    end = None if seconds is None else time.monotonic() + seconds
    talk = Talk(scripted=True, watched=False)
    try:
        with talk.connect() as wire:
            assert wire.request("say", text="length=0", wait=True)["ok"]
            assert wire.receive_event("result")["goal"]["state"] == "SUCCEEDED"
        before = census.count(talk.pid)  # the engine runs
        while (count is None or report.lines < count) and (end is None or time.monotonic() < end):
            _send_batch(talk, list(islice(lines, ON_ONE)), report)
        with talk.connect() as wire:
            assert wire.request("resume")["ok"]
            assert wire.request("cancel")["ok"]
            assert wire.request("say", text="still here", wait=True)["ok"]
            assert wire.receive_event("result")["goal"]["state"] == "SUCCEEDED"
        census.assert_as_before(talk.pid, before, memory=GROWN)
        talk.stop()
    except (AssertionError, OSError, EOFError) as error:
        report.failures.append(f"{type(error).__name__}: {error}")
    if "a bug" in talk.log:
        report.failures.append(next(each for each in talk.log.splitlines() if "a bug" in each))
    talk.close()
    return report


def _send_batch(talk: Talk, batch: list[bytes], report: Report) -> None:
    with Raw(talk.socket) as raw:
        data = b"".join(each + _HELLO for each in batch)
        raw.socket.settimeout(60)
        sender = threading.Thread(target=raw.send, args=(data,))
        sender.start()
        replies = _read_replies(raw, 2 * len(batch), report)
        sender.join()
    assert replies == 2 * len(batch), f"{replies} replies to {2 * len(batch)} lines"
    report.lines += len(batch)


def _read_replies(raw: Raw, wanted: int, report: Report) -> int:
    """Read so many replies, each of them well formed; fewer if the server closes."""
    count, rest = 0, b""
    while count < wanted and (data := raw.receive(60)):
        raw.received.clear()
        *lines, rest = (rest + data).split(b"\n")
        for line in lines:
            message = json.loads(line)
            if "ok" not in message:
                continue
            count += 1
            code = "no error" if message["ok"] else message["error"]["code"]
            report.errors[code] = report.errors.get(code, 0) + 1
            assert code != "internal_error", line
    return count


def main() -> None:
    """Fuzz as the command line says, and print what was found."""
    parser = argparse.ArgumentParser(description="Mutated requests, each of which must have one reply.")
    how_long = parser.add_mutually_exclusive_group()
    how_long.add_argument("--count", type=int)
    how_long.add_argument("--seconds", type=float)
    parser.add_argument("--seed", type=int, default=int(time.time()))
    options = parser.parse_args()
    count = 100_000 if options.count is None and options.seconds is None else options.count
    report = fuzz(options.seed, count=count, seconds=options.seconds)
    print(report)
    sys.exit(bool(report.failures))


if __name__ == "__main__":
    main()
