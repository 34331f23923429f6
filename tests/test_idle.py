"""An idle server takes no processor time: its context switches are counted, which no other program adds to."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tests.support.usage import descendants
from tests.tools.bench.machine import taken_in

if TYPE_CHECKING:
    from tests.conftest import MakeTalk

SECONDS = 3


def test_an_idle_server_switches_context_at_most_once_a_second(make_talk: MakeTalk) -> None:
    talk = make_talk("--player", "null", watched=False)
    assert talk.run("say", "--wait", "--", "ready").code == 0
    processes = [talk.pid, *descendants(talk.pid)]
    assert len(processes) == 2, "the server, and its engine process"
    found = taken_in(processes, SECONDS)
    assert found.switches <= SECONDS, found
