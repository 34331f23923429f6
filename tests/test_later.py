"""What requests that wait cost: how often room is looked for, how much is kept, how much is written at once.

Work and bytes are counted, not time. What becomes of goals that wait is in `conformance/test_goals_order.py`.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, cast

import pytest

from talkcli.goals.options import Cancel, Say
from talkcli.protocol.requests import Wait
from talkcli.server import later
from talkcli.server.later import ALL_WAITING, EACH, Later

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from talkcli.goals.goal import By


class Client:
    """A connection, as far as a request that waits knows it."""

    def __init__(self) -> None:
        self.owed = 0

    def settle(self) -> None:
        self.owed -= 1

    def has_hung_up(self) -> bool:
        return False


class Surroundings:
    """All that requests wait in: it notes what goes, and what waits to be read; it has as much room as is said."""

    def __init__(self) -> None:
        self.room = 0
        self.asked = 0
        self.gone: list[str] = []
        #: bytes that wait for clients, and those that each goal that goes adds
        self.waiting = 0
        self.told = 0
        self.later = Later(
            asyncio.get_running_loop(), cast("Any", self), cast("Any", self), self._has_room, self._failed
        )

    def keep_waiting(self, _: Client) -> None:
        pass

    def answered(self, _: Client) -> None:
        pass

    def wait(self, client: Client, text: str, **fields: Any) -> None:
        self.later.until_room(cast("Any", client), Say(text, **fields), lambda by: self._go(text, by))

    def too_many(self, client: Client, say: Say) -> tuple[str, str] | None:
        return self.later.too_many(cast("Any", client), say)

    def _go(self, text: str, _: By | None) -> None:
        self.gone.append(text)
        self.room -= 1
        self.waiting += self.told

    def _has_room(self, _: Say) -> bool:
        self.asked += 1
        return self.room > 0

    def _failed(self, what: str, error: Exception) -> None:
        raise AssertionError(what) from error


def play(scene: Callable[[Surroundings], Awaitable[None]]) -> None:
    async def begin() -> None:
        await scene(Surroundings())

    asyncio.run(begin())


async def turn() -> None:
    await asyncio.sleep(0)
    await asyncio.sleep(0)


def test_of_a_thousand_goals_that_lack_the_same_room_one_is_asked_for() -> None:
    async def scene(around: Surroundings) -> None:
        client = Client()
        for number in range(1_000):
            around.wait(client, f"{number}", priority=number % 2)
        around.later.look()
        await turn()
        assert (around.asked, around.gone) == (2, [])
        around.room = 1
        around.later.look()
        await turn()
        assert around.gone == ["0"]
        assert around.asked < 10

    play(scene)


def test_requests_of_all_connections_wait_up_to_a_number_of_bytes() -> None:
    async def scene(around: Surroundings) -> None:
        one, other = Client(), Client()
        text = "w" * 40_000
        count = 0
        while around.too_many(one if count < 900 else other, Say(text)) is None:
            around.wait(one if count < 900 else other, text)
            count += 1
        assert 0.9 * ALL_WAITING < count * (40_000 + EACH) < ALL_WAITING
        assert around.too_many(Client(), Say(text)) == ("queue_full", "64 MiB of requests are waiting already")
        around.later.left(cast("Any", other))
        assert around.too_many(Client(), Say(text)) is None
        around.room = 900
        around.later.look()
        await turn()
        assert (len(around.gone), one.owed) == (900, 0)
        assert around.later._size == 0

    play(scene)


@pytest.mark.parametrize(
    "request_", [Say("w", data={"a": [[] for _ in range(300)]}), Wait(ids=tuple(f"{each}" for each in range(400)))]
)
def test_a_request_is_counted_with_the_memory_that_small_values_take(request_: Say | Wait) -> None:
    assert later._size_of(request_) > EACH + 16_000


def test_goals_that_are_cancelled_are_told_as_fast_as_it_is_read() -> None:
    async def scene(around: Surroundings) -> None:
        client, answered = Client(), []
        around.told = 300_000
        for number in range(100):
            around.wait(client, f"{number}")
        around.later.choose(Cancel(), None)
        around.later.end(lambda: answered.append(len(around.gone)))
        most = 0
        while not answered:
            most = max(most, around.waiting)
            around.waiting = 0  # they have read it
            await asyncio.sleep(0.001)
        assert most < 2_000_000
        assert answered == [100]

    play(scene)


def test_goals_that_are_cancelled_are_told_though_nobody_reads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(later, "_PATIENCE", 0.01)

    async def scene(around: Surroundings) -> None:
        answered = asyncio.Event()
        around.told = 300_000
        for number in range(20):
            around.wait(Client(), f"{number}")
        around.later.choose(Cancel(), None)
        around.later.end(answered.set)
        assert len(around.gone) < 20
        await asyncio.wait_for(answered.wait(), 5)
        assert len(around.gone) == 20

    play(scene)


def test_who_leaves_while_its_goals_are_ended_is_forgotten() -> None:
    async def scene(around: Surroundings) -> None:
        one, other, answered = Client(), Client(), asyncio.Event()
        for number in range(100):
            around.wait(one, f"{number}")
            around.wait(other, f"other {number}")
        around.later.choose(Cancel(), None)
        around.later.end(answered.set)
        around.later.left(cast("Any", one))
        await asyncio.wait_for(answered.wait(), 5)
        assert len([each for each in around.gone if each.startswith("other")]) == 100
        assert len(around.gone) < 200
        assert around.later._size == 0

    play(scene)
