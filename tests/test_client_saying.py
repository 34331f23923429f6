"""Texts that are spoken while a block of the program runs."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

import pytest

from talkcli import Client, State
from talkcli.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.support.processes import Talk


@pytest.fixture
def client(scripted: Talk) -> Iterator[Client]:
    with Client(scripted.socket, timeout=1) as result:
        yield result


def test_the_goal_is_cancelled_when_the_block_ends(client: Client) -> None:
    with client.saying("never-ends step back", key="path") as goal:
        assert next(goal.events()).id == goal.id  # type: ignore[union-attr]
        assert goal.goal.key == "path"
    assert (goal.state, goal.goal.reason) == (State.PREEMPTED, "canceled")
    with suppress(ZeroDivisionError), client.saying("never-ends step back", id="mine", follow=False) as goal:
        assert goal.id == "mine"
        raise ZeroDivisionError
    assert goal.state in {State.PREEMPTED, State.RECALLED}


def test_a_goal_that_has_ended_is_not_cancelled(client: Client) -> None:
    with client.saying("length=0") as goal:
        assert goal.wait(10).state is State.SUCCEEDED
    assert goal.state is State.SUCCEEDED
    with pytest.raises(UsageError, match="'rate' must be an integer"), client.saying("hello", rate="fast"):  # type: ignore[arg-type]
        pass
