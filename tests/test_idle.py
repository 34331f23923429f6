"""An idle server uses no processor time. The test counts context switches, which other programs don't affect."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tests.support.usage import descendants
from tests.tools.bench.machine import measure_use

if TYPE_CHECKING:
    from tests.conftest import MakeTalk

MEASURED_S = 2


def test_an_idle_server_switches_context_at_most_once_a_second(make_talk: MakeTalk) -> None:
    talk = make_talk("--player", "null", watched=False)
    assert talk.run("say", "--wait", "--", "ready").code == 0
    processes = [talk.pid, *descendants(talk.pid)]
    assert len(processes) == 2, "the server, and its engine process"
    usage = measure_use(processes, MEASURED_S)
    assert usage.switches <= MEASURED_S, usage
