"""What requests that wait cost: how often room is looked for, how much is kept, how much is told at once.

Work and bytes are counted, not time. What becomes of goals that wait is in `conformance/test_goals_order.py`.
"""

from __future__ import annotations

import asyncio
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import pytest

from talkcli.goals.goal import Sender
from talkcli.goals.options import Cancel, Say
from talkcli.goals.scheduler import Scheduler
from talkcli.protocol.requests import Status, Wait, Watch
from talkcli.server import subscribers
from talkcli.server.call import Call
from talkcli.server.requests import ALL_WAITING, EACH, Requests
from talkcli.server.speech import Speech
from talkcli.server.subscribers import News

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable

    from talkcli.goals.goal import JsonObject
    from talkcli.goals.options import Set
    from talkcli.protocol.requests import Request


class Client:
    """A connection, as far as requests know it: it notes what it is told."""

    sender = Sender(1, 1, "client")

    def __init__(self) -> None:
        self.told: list[JsonObject] = []

    def send(self, message: JsonObject) -> None:
        self.told.append(message)

    def send_list(self, messages: Iterable[JsonObject]) -> None:
        self.told += messages

    def publish(self, event: bytes, *, feedback: bool = False) -> None:
        """Take note of nothing: these tests count replies."""

    def has_hung_up(self) -> bool:
        return False

    def goals(self) -> list[str]:
        """Return the texts of the goals that it was told of."""
        return [str(cast("Any", each)["goal"]["text"]) for each in self.told]


class Engine:
    """Takes every goal, and says nothing."""

    def say(self, _: object) -> None:
        pass

    def stop(self, _: str) -> None:
        pass

    def follow(self, _: str, followed: bool, by_neural: bool) -> None:
        """Take note of what makes no difference here."""


class Server:
    """What requests wait in: a goal is spoken, and as many wait behind it as may."""

    def __init__(self, max_queue: int = 1) -> None:
        self.speech = Speech(Scheduler("4k7f", max_queue=max_queue))
        self.speech.engine = cast("Any", Engine())
        self.speech.scheduler.engine_ready(self.speech.now())
        self.requests = Requests(self.speech, dict)
        self.asked = 0
        has_room = self.speech.scheduler.has_room

        def counted(say: Say) -> bool:
            self.asked += 1
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
        """End the goal that is pending."""
        (pending,) = self.speech.scheduler.pending()
        self.speech.apply(self.speech.scheduler.cancel(Cancel(ids=(pending.id,)), None, self.speech.now()).effects)


def play(scene: Callable[[], Awaitable[None]]) -> None:
    async def begin() -> None:
        await scene()

    asyncio.run(begin())


async def turn() -> None:
    await asyncio.sleep(0)
    await asyncio.sleep(0)


async def all_told(line: News) -> None:
    for _ in range(1_000_000):
        if line.told:
            return
        await asyncio.sleep(0)


def test_of_a_thousand_goals_that_lack_the_same_room_one_is_asked_for() -> None:
    async def scene() -> None:
        server, client = Server(), Client()
        server.fill()
        for number in range(1_000):
            server.wait(client, f"{number}", priority=-(number % 2))
        server.asked = 0
        server.requests._look()
        await turn()
        assert (server.asked, client.told) == (2, [])
        server.make_room()
        await turn()
        assert client.goals() == ["0"]
        assert server.asked < 10

    play(scene)


def test_requests_of_all_connections_wait_up_to_a_number_of_bytes() -> None:
    async def scene() -> None:
        server, one, other = Server(), Client(), Client()
        server.fill()
        count = 0
        while not other.told:
            server.wait(one if count < 900 else other, "w" * 9_000, data={"a": ["w" * 30_000]})
            count += 1
        assert 0.9 * ALL_WAITING < (count - 1) * (39_000 + EACH) < ALL_WAITING
        (refused,) = cast("Any", other.told)
        assert refused["goal"]["reason"] == "queue_full"
        assert "64 MiB of requests are waiting already" in refused["goal"]["message"]
        server.requests.left(cast("Any", other))
        assert not server.requests.owes(cast("Any", other))
        third = Client()
        server.wait(third, "there is room again")
        assert third.told == []
        server.requests.left(cast("Any", one))
        server.requests.left(cast("Any", third))
        assert server.requests._size == 0

    play(scene)


@pytest.mark.parametrize(
    "request_", [Say("w", data={"a": [[] for _ in range(300)]}), Wait(ids=tuple(f"{each}" for each in range(400)))]
)
def test_a_request_is_counted_with_the_memory_that_small_values_take(request_: Say | Wait) -> None:
    async def scene() -> None:
        server = Server()
        assert server.requests._keep(Call(cast("Any", Client()), None, request_))
        assert server.requests._size > EACH + 16_000

    play(scene)


def test_who_leaves_while_its_goals_are_ended_is_forgotten() -> None:
    async def scene() -> None:
        server, one, other, canceling = Server(), Client(), Client(), Client()
        server.fill()
        for number in range(100):
            server.wait(one, f"{number}")
            server.wait(other, f"other {number}")
        server.ask(canceling, Cancel())
        server.requests.left(cast("Any", one))
        await all_told(server.speech.news)
        assert len(other.told) == 100
        assert len(one.told) < 100
        assert server.requests._size == 0
        assert not server.requests.owes(cast("Any", other))

    play(scene)


def test_a_bug_that_a_request_meets_after_it_waited_is_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    async def scene() -> None:
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
        first, second = cast("Any", client.told)
        assert first["error"]["code"] == "internal_error"
        assert second["goal"]["text"] == "two"
        assert not server.requests.owes(cast("Any", client))
        assert server.requests._size == 0

    play(scene)


# -- news


class Readers:
    """All clients' streams: so much was written, and not read."""

    waiting = 0

    def __init__(self) -> None:
        self.loop = asyncio.get_running_loop()


def test_a_cancel_of_thousands_of_pending_goals_leaves_the_others_their_turns() -> None:
    count = 2_000

    async def scene() -> None:
        server, watcher, canceling, asking = Server(count), Client(), Client(), Client()
        server.fill(1)
        ended = []
        server.speech.subscribers.changed = lambda record, *_: ended.append(record.id)  # type: ignore[method-assign]
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
        assert most <= 2 * subscribers._PORTION
        assert len(asking.told) > count / subscribers._PORTION / 2

    play(scene)


def test_who_begins_to_watch_while_much_is_told_hears_what_happens_from_then_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    count = 500

    async def scene() -> None:
        server, watcher = Server(count), Client()
        server.fill(1 + count)
        server.ask(Client(), Cancel(before=f"4k7f-{count + 1}"))
        told: list[str] = []
        subscribed = server.speech.subscribers
        monkeypatch.setattr(subscribed, "watch", lambda _: told.append(str(subscribed._numbers)))
        server.ask(watcher, Watch())
        assert (told, server.speech.news.told) == ([], False)
        await all_told(server.speech.news)
        assert told == [str(subscribed._numbers)]

    play(scene)


def test_news_are_told_as_fast_as_they_are_read() -> None:
    async def scene() -> None:
        readers, told = Readers(), []
        line = News(cast("Any", readers))

        def tell(number: int) -> None:
            told.append(number)
            readers.waiting += 300_000

        line.tell([partial(tell, number) for number in range(100)])
        most = 0
        while not line.told:
            most = max(most, readers.waiting)
            readers.waiting = 0  # they have read it
            await asyncio.sleep(0.001)
        assert most < 2_000_000
        assert told == list(range(100))

    play(scene)


def test_news_are_told_though_nobody_reads_and_that_is_waited_for_only_so_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subscribers, "_PATIENCE", 0.02)
    monkeypatch.setattr(subscribers, "_LESS", 0.1)

    async def scene() -> None:
        loop, readers, told = asyncio.get_running_loop(), Readers(), []
        waits = []
        later = loop.call_later
        loop.call_later = lambda *values: waits.append(values) or later(*values)  # type: ignore[method-assign, func-returns-value]
        line = News(cast("Any", readers))

        def tell(number: int) -> None:
            told.append(number)
            readers.waiting += 300_000

        line.tell([partial(tell, number) for number in range(400)])
        assert len(told) < 20
        await all_told(line)
        assert told == list(range(400))
        # A look for each of a hundred portions but the last, and for the first few each two milliseconds.
        assert 99 <= len(waits) < 120

    play(scene)


def test_what_comes_of_news_is_told_with_them_and_what_fails_takes_no_other() -> None:
    async def scene() -> None:
        told: list[str] = []
        line = News(cast("Any", Readers()))

        def first() -> None:
            told.append("first")
            line.tell([lambda: told.append("of the first")])
            raise ZeroDivisionError("a bug")

        line.tell([first, lambda: told.append("second")])
        assert told == ["first", "of the first", "second"]

    play(scene)
