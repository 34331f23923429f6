"""An idle server stands still: what it takes is counted in context switches, which no other program makes more."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from tests.bench.idle import settle, taken
from tests.support.census import descendants

if TYPE_CHECKING:
    from tests.conftest import MakeTalk

SECONDS = 3
#: The chapter's loop had ten a second.
AT_MOST = 1


def test_an_idle_server_and_its_engine_switch_once_a_second_at_most(make_talk: MakeTalk) -> None:
    talk = make_talk("--player", "null", watched=False)
    assert talk.run("say", "--wait", "--", "ready").code == 0
    processes = [talk.pid, *descendants(talk.pid)]
    assert len(processes) == 2, "the server, and its engine process"
    settle(processes)
    before = taken(processes)
    time.sleep(SECONDS)
    found = taken(processes).since(before)
    assert found.switches <= AT_MOST * SECONDS, found
