"""Clients that don't read, or write too slowly, are limited, and other clients are not affected."""

from __future__ import annotations

import contextlib
import gc
import itertools
import json
import os
import socket
import threading
import time
from typing import TYPE_CHECKING

import pytest

from tests.conformance.checks import assert_event_order
from tests.conformance.rawsocket import Raw
from tests.support.patched_serve import patched_serve
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    import pathlib
    from collections.abc import Iterator

    from tests.conftest import MakeTalk
    from tests.support.processes import Talk

#: The server's limits in seconds, and the additional delay on a loaded machine.
FIRST_REQUEST = 5.0
LINE = 10.0
ALIVE_EVERY = 5.0
LATE = 1.0
HELLO = b'{"request": "hello"}\n'


def line(**fields: object) -> bytes:
    return json.dumps(fields).encode() + b"\n"


@contextlib.contextmanager
def time_other_client(talk: Talk, speak: str | None = None) -> Iterator[list[float]]:
    """Time the `status` requests of another client during the block, and speak a text at its end."""
    times: list[float] = []
    done = threading.Event()

    def ask() -> None:
        with talk.connect() as wire:
            while not done.is_set():
                wire.items.clear()
                started_at = time.monotonic()
                assert wire.request("status", timeout=20)["ok"]
                times.append(time.monotonic() - started_at)
                done.wait(0.005)

    thread = threading.Thread(target=ask)
    # Garbage collection in the test must not count as the server's time.
    gc.collect()
    gc.disable()
    thread.start()
    try:
        yield times
        if speak is not None:
            with talk.connect() as wire:
                assert wire.request("say", text=speak, wait=True)["ok"]
                assert wire.receive_event("result")["goal"]["state"] == "SUCCEEDED"
    finally:
        gc.enable()
        done.set()
        thread.join()
    assert times


def test_10000_requests_with_unread_replies_do_not_delay_other_clients(scripted: Talk) -> None:
    count = 10_000

    with limits(), Raw(scripted.socket) as raw:
        requests = b"".join(b'{"seq": %d, "request": "status"}'.ljust(200) % number + b"\n" for number in range(count))
        sender = threading.Thread(target=raw.send, args=(requests,))
        with time_other_client(scripted, "length=0") as times:
            raw.socket.settimeout(30)
            sender.start()
            sender.join(0.5)
            numbers: list[int] = []
            while len(numbers) < count:
                raw.receive()
                done, _, rest = bytes(raw.received).rpartition(b"\n")
                numbers += [message["seq"] for message in map(json.loads, done.split(b"\n")) if message.get("ok")]
                raw.received = bytearray(rest)
            sender.join()
        assert numbers == list(range(count))
        assert_within(max(times), 0.1, "status for another client")


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="needs the memory of a process from /proc")
def test_unanswered_requests_do_not_fill_the_servers_memory(scripted: Talk) -> None:
    with Raw(scripted.socket) as raw:
        before = peak_memory(scripted.pid)
        sender = threading.Thread(target=raw.send, args=(HELLO * 1_500_000,))
        with time_other_client(scripted, "length=0"):
            raw.socket.settimeout(20)
            sender.start()
            sender.join(1)
            grown = peak_memory(scripted.pid) - before
        with contextlib.suppress(OSError):
            raw.socket.shutdown(socket.SHUT_RDWR)
        sender.join()
    assert grown < 16 * 1024, f"31 MB of requests took {grown} kB of the server's memory"


def peak_memory(pid: int) -> int:
    """Return the most memory that a process has had, in kB."""
    with open(f"/proc/{pid}/status", encoding="utf-8") as file:
        return next(int(line.split()[1]) for line in file if line.startswith("VmHWM:"))


def test_a_watcher_that_does_not_read_loses_only_feedback(scripted: Talk) -> None:
    text = "length=1 " + "a " * 4_900
    with scripted.connect() as stuck:
        assert stuck.request("watch")["ok"]
        with time_other_client(scripted) as times:
            goal_id = scripted.request("say", text=text)["goal"]["id"]
            scripted.watcher.wait_for(goal_id, "SUCCEEDED", timeout=30)
        assert stuck.request("hello")["ok"]  # when it is answered, all waiting events have been sent
        events = stuck.events
    everything = scripted.watcher.events()
    seen = [event for event in events if "n" in event]
    assert len(seen) < everything[-1]["n"], "the watcher was not late: the test must send more"
    assert max(times) < 1
    unordered = [event for last, event in itertools.pairwise(seen) if event["n"] < last["n"]]
    assert not unordered, f"{len(unordered)} events came late, for example {unordered[0]}"
    assert [event["state"] for event in seen if event["event"] == "state"] == ["PENDING", "ACTIVE", "SUCCEEDED"]
    assert_event_order(scripted)  # for a client that reads


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="needs the memory of a process from /proc")
@pytest.mark.parametrize("kind", ["wait", "cancel"])
def test_unread_lists_use_limited_memory(make_talk: MakeTalk, kind: str) -> None:
    count, clients = 1_000, 40
    talk = make_talk("--max-queue", str(count), scripted=True)
    with talk.connect() as wire, contextlib.ExitStack() as stack:
        wire.send_raw(line(request="pause") + line(request="say", text="length=0") * count)
        assert wire.request("cancel")["count"] == count
        ids = [item["canceled"]["id"] for item in wire.items if "canceled" in item]
        before = peak_memory(talk.pid)
        raws = [stack.enter_context(Raw(talk.socket)) for _ in range(clients)]
        for raw in raws:
            raw.send(line(request=kind, ids=ids))
        for raw in raws:
            raw.socket.recv(4_096, socket.MSG_WAITALL)  # the start of its list
        assert wire.request("status")["ok"]
        grown = (peak_memory(talk.pid) - before) / 1024
    # The output buffer of a client has a quarter of a megabyte, and at most half a megabyte while it is sent.
    assert grown < clients * 0.6, f"{grown:.0f} MiB"


@pytest.mark.parametrize("share", [0.1, pytest.param(1.0, marks=pytest.mark.slow)])
def test_slow_clients_are_disconnected_in_time(make_talk: MakeTalk, tmp_path: pathlib.Path, share: float) -> None:
    """All kinds of slow clients at once, for 12 s or a tenth of that. The longest limit is 10 s."""
    first, line, every = share * FIRST_REQUEST, share * LINE, share * ALIVE_EVERY
    constants = {
        "connection__FIRST_REQUEST_S": first,
        "connection__LINE_LIMIT_S": line,
        "subscribers__CLIENT_ALIVE_INTERVAL_S": every,
    }
    talk = make_talk(program=patched_serve(tmp_path, **constants))
    with limits(), contextlib.ExitStack() as stack:
        started_at = time.monotonic()
        raws = [stack.enter_context(Raw(talk.socket)) for _ in range(100)]
        silent, partial, idle, waiting, tls, *dripping = raws
        dripping_later = dripping[:45]
        for raw in (partial, idle, waiting, *dripping_later):
            raw.send(HELLO)
        partial.send(b'{"request": "sa')
        waiting.send(b'{"request": "say", "text": "never-ends", "wait": true}\n')
        tls.send(b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(range(11, 255)))
        closed: dict[int, float] = {}
        times = stack.enter_context(time_other_client(talk))
        while time.monotonic() < started_at + 1.2 * line or len(closed) < len(raws) - 2:
            assert time.monotonic() < started_at + line + 2 * LATE, "the connections were not closed"
            for raw in dripping:
                raw.send(b"x")
            _collect(raws, closed, started_at, share)
        assert_within(max(times), 1, "status for another client")
        for limit, clients in ((first, (silent, tls, *dripping[45:])), (line, (partial, *dripping_later))):
            for raw in clients:
                assert closed[id(raw)] >= limit - 0.1
                assert_within(closed[id(raw)], limit + LATE, "the end of a slow client")
        for raw in (silent, partial, tls, *dripping):
            assert raw.lines[-1]["error"]["code"] == "too_slow"
        assert not {id(idle), id(waiting)} & closed.keys()
        alive = [message for message in waiting.lines if message.get("event") == "alive"]
        assert 1.2 * line // every <= len(alive) <= (time.monotonic() - started_at) / every + 1
        assert len(idle.lines) == 2  # no `alive` events, because it does not wait
        idle.send(b'{"seq": 3, "request": "cancel"}\n')  # a connection may be idle forever
        assert idle.receive_lines(4)[-1] == {"seq": 3, "ok": True, "count": 1}
        while waiting.lines[-1].get("event") != "result":
            waiting.receive()
        assert waiting.lines[-1]["goal"]["state"] == "PREEMPTED"


def _collect(raws: list[Raw], closed: dict[int, float], started_at: float, seconds: float) -> None:
    """Read from all connections for some seconds, and record when they are closed."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        for raw in [raw for raw in raws if id(raw) not in closed]:
            with contextlib.suppress(TimeoutError, BlockingIOError):
                if not raw.receive(0.0):
                    closed[id(raw)] = time.monotonic() - started_at
        time.sleep(0.02)
