"""Work that waits, in a thread of its own: what comes of it, and of work that nobody waits for any more."""

from __future__ import annotations

import asyncio
import threading

import pytest

from talkcli.errors import ServerUnavailable
from talkcli.fleet.local import apart


def test_what_is_done_apart_is_returned_or_raised() -> None:
    def fail() -> None:
        raise ServerUnavailable("nobody is there")

    async def work() -> None:
        assert await apart(threading.get_ident) != threading.get_ident()
        with pytest.raises(ServerUnavailable, match="nobody is there"):
            await apart(fail)

    asyncio.run(work())


def test_what_comes_of_it_is_undone_where_nobody_waits_any_more() -> None:
    go, undone = threading.Event(), asyncio.Event()

    async def give_up() -> None:
        work = apart(lambda: go.wait(5), lambda result: undone.set() if result else None)
        await asyncio.sleep(0)
        work.cancel()
        with pytest.raises(asyncio.CancelledError):
            await work
        go.set()
        await asyncio.wait_for(undone.wait(), 5)

    asyncio.run(give_up())


def test_it_is_over_when_its_thread_is_and_not_when_nobody_waits_any_more(monkeypatch: pytest.MonkeyPatch) -> None:
    go = threading.Event()

    async def give_up() -> None:
        over = asyncio.Event()
        work = apart(lambda: go.wait(5), finished=over.set)
        await asyncio.sleep(0)
        work.cancel()
        with pytest.raises(asyncio.CancelledError):
            await work
        assert not over.is_set()
        go.set()
        await asyncio.wait_for(over.wait(), 5)

    async def fail() -> None:
        over = asyncio.Event()
        with pytest.raises(RuntimeError, match="no more threads"):
            await apart(threading.get_ident, finished=over.set)
        assert over.is_set()

    def no_more(_: threading.Thread) -> None:
        raise RuntimeError("no more threads")

    asyncio.run(give_up())
    monkeypatch.setattr(threading.Thread, "start", no_more)
    asyncio.run(fail())


def test_the_end_does_not_wait_for_it_and_what_comes_of_it_then_is_undone() -> None:
    go, undone = threading.Event(), threading.Event()

    async def leave() -> None:
        work = apart(lambda: go.wait(30), lambda result: undone.set() if result else None)
        await asyncio.sleep(0)
        work.cancel()

    asyncio.run(leave())
    go.set()
    assert undone.wait(5)
