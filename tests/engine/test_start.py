"""What an engine process imports before it has spoken: after a crash somebody waits for it."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest

from talkcli.engine import protocol
from tests.engine.spawned import Spawned

if TYPE_CHECKING:
    from tests.engine.programs import Player

#: Each takes milliseconds of the start, on a Raspberry Pi ten times as many, and nothing in the process needs it.
_NOT_NEEDED = (
    "typing",
    "dataclasses",
    "inspect",
    "subprocess",
    "threading",
    "selectors",
    "asyncio",
    "socket",
    "logging",
)
_TELL = """
import atexit
atexit.register(lambda: sys.stderr.write(" ".join(sys.modules)))
"""


@pytest.mark.parametrize("text", ["battery low. Please come home", "..."])
def test_a_process_imports_nothing_that_it_does_not_need(player: Player, text: str) -> None:
    with Spawned(player.plays(), before=_TELL) as engine:
        engine.until(protocol.Ready)
        engine.spoken(text)
        engine.leave()
        imported = set(engine.errors().split())
    assert "talkcli.engine.playback" in imported
    assert imported.isdisjoint(_NOT_NEEDED), imported.intersection(_NOT_NEEDED)


@pytest.mark.parametrize("less", [0, 1 << 20])
def test_a_process_gets_no_more_than_half_of_the_machines_memory(less: int) -> None:
    """Or a billion bytes, where that is more; and less where somebody has set less."""
    most = max(1 << 30, os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2)
    before = f"import resource\nresource.setrlimit(resource.RLIMIT_DATA, ({most - less}, -1))" if less else ""
    with Spawned(before=before) as engine:
        engine.until(protocol.Ready)
        with open(f"/proc/{engine.process.pid}/limits", encoding="ascii") as file:
            soft = next(line for line in file if line.startswith("Max data size")).split()[3]
    assert int(soft) == most - less
