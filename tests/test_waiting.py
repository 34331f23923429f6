"""The server between engine and clients: waiting requests, batches of notifications, and the order of events.

The tests count steps and bytes, not time. `conformance/test_goals_order.py` tests the order of waiting goals.
"""

from __future__ import annotations

import asyncio
import threading
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import pytest

from talkcli.daemon import log
from talkcli.engine import protocol
from talkcli.goals.goal import Sender
from talkcli.goals.options import Cancel, Say
from talkcli.goals.scheduler import Scheduler
from talkcli.protocol.requests import Status, Wait, Watch
from talkcli.server import subscribers
from talkcli.server.connection import PendingRequest
from talkcli.server.requests import MAX_KEPT_REQUEST_BYTES, REQUEST_BYTES, Requests
from talkcli.server.speech import REPORTS_PER_TURN, Speech
from talkcli.server.subscribers import Notifications
from tests.support.loop import in_loop

if TYPE_CHECKING:
    from collections.abc import Iterable

    from talkcli.goals.goal import JsonObject
    from talkcli.goals.options import Set
    from talkcli.goals.record import Record
    from talkcli.goals.states import State
    from talkcli.protocol.requests import Request


class Client:
    """A connection that records its replies."""

    client = Sender(1, 1, "client")

    def __init__(self) -> None:
        self.replies: list[JsonObject] = []
        self.unanswered: dict[PendingRequest, None] = {}

    def send(self, message: JsonObject) -> None:
        self.replies.append(message)

    def send_list(self, messages: Iterable[JsonObject]) -> None:
        self.replies += messages

    def publish(self, event: bytes, *, feedback: bool = False) -> None:
        """Ignore events: these tests count replies."""

    def detect_hang_up(self) -> bool:
        return False

    def goals(self) -> list[str]:
        """Return the texts of the goals in the recorded replies."""
        return [str(cast("Any", reply)["goal"]["text"]) for reply in self.replies]


class Engine:
    """An engine that accepts every goal and reports nothing. It notes its requests in the same list as the test."""

    def __init__(self) -> None:
        self.written: list[str] = []

    def speak(self, goal: protocol.Speak) -> None:
        self.written.append(f"say {goal.text}")

    def stop(self, _: str) -> None:
        self.written.append("stop")

    def announce_next(self, _: str, next_waits: bool, next_is_neural: bool) -> None:
        """Do nothing."""


class Server:
    """The requests of a server with an active goal and a full queue."""

    def __init__(self, max_queue: int = 1) -> None:
        self.speech = Speech(Scheduler("4k7f", max_queue=max_queue))
        self.speech.engine = cast("Any", Engine())
        self.speech.scheduler.engine_ready(self.speech.advance_time())
        self.requests = Requests(self.speech, dict)
        self.room_checks = 0
        has_room = self.speech.scheduler.has_room

        def counted(say: Say) -> bool:
            self.room_checks += 1
            return has_room(say)

        self.speech.scheduler.has_room = counted  # type: ignore[method-assign]

    def ask(self, client: Client, request: Request | Set) -> None:
        self.requests.handle(cast("Any", client), None, cast("Any", request))

    def fill(self, count: int = 2) -> None:
        for number in range(count):
            self.ask(Client(), Say(f"before {number}"))

    def wait(self, client: Client, text: str, **fields: Any) -> None:
        self.ask(client, Say(text, patient=True, **fields))

    def make_room(self) -> None:
        """Cancel the pending goal."""
        (pending,) = self.speech.scheduler.pending
        self.speech.apply(
            self.speech.scheduler.cancel(Cancel(ids=(pending.id,)), None, self.speech.advance_time()).effects
        )


async def turn() -> None:
    await asyncio.sleep(0)
    await asyncio.sleep(0)


async def all_notified(notifications: Notifications) -> None:
    for _ in range(1_000_000):
        if notifications.done:
            return
        await asyncio.sleep(0)


@in_loop
async def test_a_room_check_asks_once_per_priority() -> None:
    server, client = Server(), Client()
    server.fill()
    for number in range(1_000):
        server.wait(client, f"{number}", priority=-(number % 2))
    server.room_checks = 0
    server.requests._schedule_room_check()
    await turn()
    assert (server.room_checks, client.replies) == (2, [])
    server.make_room()
    await turn()
    assert client.goals() == ["0"]
    assert server.room_checks < 10


@in_loop
async def test_room_is_checked_only_after_the_queue_has_changed() -> None:
    server, client, checks = Server(), Client(), []
    server.fill()
    server.wait(client, "patient")
    await turn()
    server.requests._submit_waiting_goals = lambda: checks.append("a check")  # type: ignore[method-assign]
    server.ask(client, Say("refused"))
    await turn()
    assert (client.goals(), checks) == (["refused"], [])


@in_loop
async def test_the_memory_for_all_waiting_requests_is_limited() -> None:
    server, one, other = Server(), Client(), Client()
    server.fill()
    count = 0
    while not other.replies:
        server.wait(one if count < 900 else other, "w" * 9_000, data={"a": ["w" * 30_000]})
        count += 1
    assert 0.9 * MAX_KEPT_REQUEST_BYTES < (count - 1) * (39_000 + REQUEST_BYTES) < MAX_KEPT_REQUEST_BYTES
    (refused,) = cast("Any", other.replies)
    assert refused["goal"]["reason"] == "queue_full"
    assert "too many requests are waiting (64 MiB)" in refused["goal"]["message"]
    server.requests.left(cast("Any", other))
    assert not server.requests.is_waiting(cast("Any", other))
    third = Client()
    server.wait(third, "there is room again")
    assert third.replies == []
    server.requests.left(cast("Any", one))
    server.requests.left(cast("Any", third))
    assert server.requests._waiting_bytes == 0


@pytest.mark.parametrize(
    "request_", [Say("w", data={"a": [[] for _ in range(300)]}), Wait(ids=tuple(f"{number}" for number in range(400)))]
)
@in_loop
async def test_small_values_are_counted_with_their_real_memory_use(request_: Say | Wait) -> None:
    server = Server()
    assert server.requests._reserve_memory(PendingRequest(cast("Any", Client()), None, request_))
    assert server.requests._waiting_bytes > REQUEST_BYTES + 16_000


@in_loop
async def test_a_client_that_leaves_during_a_cancel_is_forgotten() -> None:
    server, one, other, canceling = Server(), Client(), Client(), Client()
    server.fill()
    for number in range(100):
        server.wait(one, f"{number}")
        server.wait(other, f"other {number}")
    server.ask(canceling, Cancel())
    server.requests.left(cast("Any", one))
    await all_notified(server.speech.notifications)
    assert len(other.replies) == 100
    assert len(one.replies) < 100
    assert server.requests._waiting_bytes == 0
    assert not server.requests.is_waiting(cast("Any", other))


@in_loop
async def test_a_server_ends_only_after_answering_every_waiting_goal() -> None:
    server, one, count = Server(), Client(), 3 * subscribers._MAX_CALLS_PER_TURN
    server.speech.scheduler.pause(Sender(), server.speech.advance_time())
    server.fill(1)
    for number in range(count):
        server.wait(one, f"{number}")
    server.requests.shut_down()
    assert not server.speech.finished.is_set()
    await all_notified(server.speech.notifications)
    assert len(one.replies) == count
    assert server.speech.finished.is_set()


@in_loop
async def test_a_request_during_shutdown_is_answered_before_the_server_ends() -> None:
    count = 3 * subscribers._MAX_CALLS_PER_TURN
    server, late = Server(count), Client()
    server.speech.scheduler.pause(Sender(), server.speech.advance_time())
    server.fill(count)
    server.requests.shut_down()
    server.ask(late, Wait())
    assert late.replies == []
    assert not server.speech.finished.is_set()
    await all_notified(server.speech.notifications)
    assert late.replies == [{"ok": True, "count": 0}]
    assert server.speech.finished.is_set()


@in_loop
async def test_a_bug_in_a_waiting_request_does_not_affect_others(monkeypatch: pytest.MonkeyPatch) -> None:
    server, client = Server(), Client()
    server.fill()
    server.wait(client, "one")
    server.wait(client, "two")
    submit = server.speech.scheduler.submit

    def fails_once(say: Say, *values: Any) -> Any:
        if say.text == "one":
            raise ZeroDivisionError("a bug")
        return submit(say, *values)

    monkeypatch.setattr(server.speech.scheduler, "submit", fails_once)
    server.make_room()
    await turn()
    first, second = cast("Any", client.replies)
    assert first["error"]["code"] == "internal_error"
    assert second["goal"]["text"] == "two"
    assert not server.requests.is_waiting(cast("Any", client))
    assert server.requests._waiting_bytes == 0


class Readers:
    """A replacement for the streams of all clients. It records the received numbers and counts unread bytes."""

    def __init__(self) -> None:
        self.loop = asyncio.get_running_loop()
        self.unread_bytes = 0
        self.received: list[int] = []

    def notify(self, number: int) -> None:
        self.received.append(number)
        self.unread_bytes += 300_000


@in_loop
async def test_cancelling_thousands_of_goals_does_not_block_other_clients() -> None:
    count = 2_000
    server, watcher, canceling, asking = Server(count), Client(), Client(), Client()
    server.fill(1)
    ended = []
    server.speech.subscribers.state_changed = lambda record, *_: ended.append(record.id)  # type: ignore[method-assign]
    server.ask(watcher, Cancel(ids=()))
    for number in range(count):
        server.ask(watcher, Say(f"{number}"))
    ended.clear()
    server.ask(canceling, Cancel(before=f"4k7f-{count + 1}"))
    most = 0
    while len(ended) < count:
        before = len(ended)
        server.ask(asking, Status(id="4k7f-1"))
        await asyncio.sleep(0)
        most = max(most, len(ended) - before)
    assert most <= 2 * subscribers._MAX_CALLS_PER_TURN
    assert len(asking.replies) > count / subscribers._MAX_CALLS_PER_TURN / 2


@in_loop
async def test_a_new_watcher_gets_only_events_after_its_snapshot(monkeypatch: pytest.MonkeyPatch) -> None:
    count = 500
    server, watcher = Server(count), Client()
    server.fill(1 + count)
    server.ask(Client(), Cancel(before=f"4k7f-{count + 1}"))
    numbers: list[str] = []
    subscribed = server.speech.subscribers
    monkeypatch.setattr(subscribed, "watch", lambda _: numbers.append(str(subscribed._numbers)))
    server.ask(watcher, Watch())
    assert (numbers, server.speech.notifications.done) == ([], False)
    await all_notified(server.speech.notifications)
    assert numbers == [str(subscribed._numbers)]


@in_loop
async def test_notifications_are_sent_as_fast_as_clients_read() -> None:
    readers = Readers()
    notifications = Notifications(cast("Any", readers))
    notifications.add([partial(readers.notify, number) for number in range(100)])
    most = 0
    while not notifications.done:
        most = max(most, readers.unread_bytes)
        readers.unread_bytes = 0  # all clients have read
        await asyncio.sleep(0.001)
    assert most < 2_000_000
    assert readers.received == list(range(100))


@in_loop
async def test_the_wait_for_clients_that_do_not_read_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subscribers, "_READ_TIME_S", 0.02)
    monkeypatch.setattr(subscribers, "_READ_TIME_FACTOR", 0.1)
    loop, readers, waits = asyncio.get_running_loop(), Readers(), []
    later = loop.call_later
    loop.call_later = lambda *values: waits.append(values) or later(*values)  # type: ignore[method-assign, func-returns-value]
    notifications = Notifications(cast("Any", readers))
    notifications.add([partial(readers.notify, number) for number in range(400)])
    assert len(readers.received) < 20
    await all_notified(notifications)
    assert readers.received == list(range(400))
    # There is a wait after each of a hundred batches but the last, and every 2 ms for the first few.
    assert 99 <= len(waits) < 120


@in_loop
async def test_nested_notifications_are_sent_in_order_despite_a_bug() -> None:
    sent: list[str] = []
    notifications = Notifications(cast("Any", Readers()))

    def first() -> None:
        sent.append("first")
        notifications.add([lambda: sent.append("of the first")])
        raise ZeroDivisionError("a bug")

    notifications.add([first, lambda: sent.append("second")])
    assert sent == ["first", "of the first", "second"]


@in_loop
async def test_many_words_at_once_do_not_block_clients() -> None:
    loop, count = asyncio.get_running_loop(), 5 * REPORTS_PER_TURN + 1
    taken: list[object] = []
    wakes = []
    served = Speech(Scheduler("4k7f", max_queue=1))
    served._process_report = taken.append  # type: ignore[method-assign, assignment]
    call = loop.call_soon_threadsafe
    loop.call_soon_threadsafe = lambda *values: wakes.append(call(*values))  # type: ignore[assignment, method-assign]
    words = [protocol.Word("4k7f-1", 0, 1, number, 0.0) for number in range(count)]

    def post_all() -> None:
        for word in words:
            served.report(word)

    thread = threading.Thread(target=post_all)
    thread.start()
    thread.join()
    assert len(wakes) == 1  # one for all words
    turns = 0
    while len(taken) < count:
        await asyncio.sleep(0)
        turns += 1
        assert len(taken) <= turns * REPORTS_PER_TURN
    assert taken == words
    served.report(words[0])
    assert len(wakes) == 2


@in_loop
async def test_a_bug_in_a_report_does_not_affect_other_reports(monkeypatch: pytest.MonkeyPatch) -> None:
    taken, failed = [], []

    def take(report: protocol.Event) -> None:
        taken.append(report)
        if len(taken) == 1:
            raise ZeroDivisionError("a bug")

    monkeypatch.setattr(log, "write_bug", lambda context, error: failed.append((context, type(error))))
    served = Speech(Scheduler("4k7f", max_queue=1))
    served._process_report = take  # type: ignore[method-assign, assignment]
    for number in range(3):
        served.report(protocol.Alive(f"4k7f-{number}"))
    await asyncio.sleep(0)
    assert len(taken) == 3
    assert failed == [("a report from the engine", ZeroDivisionError)]


@in_loop
async def test_the_engine_gets_its_next_task_before_clients_get_events() -> None:
    engine = Engine()
    written, served = engine.written, Speech(Scheduler("4k7f", max_queue=1))
    served.engine = cast("Any", engine)
    served.scheduler.engine_ready(served.advance_time())

    def changed(record: Record, state: State, _: float) -> None:
        written.append(f"{state.name} {record.say.text}")

    served.subscribers.state_changed = changed  # type: ignore[assignment, method-assign]
    for text, preempt in (("first", False), ("second", True)):
        served.apply(served.scheduler.submit(Say(text, preempt=preempt), Sender(), served.advance_time())[1])
    served.report(protocol.Ended("4k7f-1", protocol.OUTCOME_STOPPED))
    await asyncio.sleep(0)
    assert written == [
        *("say first", "PENDING first", "ACTIVE first"),
        *("stop", "PENDING second", "PREEMPTING first"),
        *("say second", "PREEMPTED first", "ACTIVE second"),
    ]
