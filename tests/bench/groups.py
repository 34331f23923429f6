"""The rows of the benchmark by name: what `--only` chooses from, in the order of the table."""

from __future__ import annotations

from typing import TYPE_CHECKING

from talkcli.errors import TalkError
from tests.bench.between import gap, long_text
from tests.bench.crowd import crowd
from tests.bench.failure import FailedError
from tests.bench.idle import idle
from tests.bench.onset import at_once, onset, recorder
from tests.bench.queueing import queueing
from tests.bench.silence import cancel, connection, pause, preempt
from tests.bench.table import Row
from tests.bench.throughput import throughput
from tests.bench.whole_process import commands

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.bench.stage import Stage

GROUPS: dict[str, Callable[[Stage], list[Row]]] = {
    "recorder": recorder,
    "onset": onset,
    "at-once": at_once,
    "cancel": cancel,
    "connection": connection,
    "pause": pause,
    "preempt": preempt,
    "gap": gap,
    "long-text": long_text,
    "commands": commands,
    "idle": idle,
    "throughput": throughput,
    "queue": queueing,
    "crowd": crowd,
}


def measure(name: str, stage: Stage) -> list[Row]:
    """Return the rows of a group; one row that says why, where they could not be measured."""
    try:
        return GROUPS[name](stage)
    except (FailedError, TalkError, AssertionError, TimeoutError, OSError) as error:
        return [Row(name, f"({name})", "", failure=f"{type(error).__name__}: {error}")]
