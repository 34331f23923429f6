"""Shared by the tests of sound: sentences, goals that have begun, and the processes behind a server."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from tests.support.compare import compare
from tests.support.processes import children
from tests.support.reference import render

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy as np
    import numpy.typing as npt

    from tests.support.compare import Comparison
    from tests.support.connection import Message
    from tests.support.processes import Process, Talk
    from tests.support.reference import Sentence

    Samples = npt.NDArray[np.int16]

#: Short sentences, and a long one to interrupt. Each begins with a moment of silence before its "b" or "c", which takes
#: the place of the sound that the monitor drops at the start of a stream, up to 10 ms.
LOW = "battery low"
HOME = "coming home"
HELP = "please help, I am stuck"
LONG = "two three four five six seven eight nine ten eleven twelve"

#: Words per minute for tests of anything but the rate: the fastest there are. LONG takes 1.3 s, HELP 0.6 s.
QUICK = 450

#: Seconds by which the time of a sample is known: blocks of the monitor, and of the sink before it.
PRECISION = 0.03
#: Seconds in which a process that was started must be there.
_PATIENCE = 5.0


def render_quick(sentences: Sequence[str | Sentence]) -> list[Samples]:
    """Return the samples of each sentence as a server at that rate speaks them."""
    return render(sentences, rate=QUICK)


def send(talk: Talk, text: str, **fields: Any) -> str:
    """Send a goal without waiting for it, and return its id."""
    reply = talk.request("say", text=text, **fields)
    assert reply["ok"], reply
    goal: Message = reply["goal"]
    assert goal["state"] in ("PENDING", "ACTIVE"), goal
    return str(goal["id"])


def await_word(talk: Talk, goal_id: str, number: int = 3) -> None:
    """Wait until this word of a goal is heard; the third is in mid-sentence."""
    wanted = {"event": "word", "id": goal_id, "number": number}
    talk.watcher.wait_until(lambda event: wanted.items() <= event.items(), what=f"word {number} of {goal_id}")


def start_goal(talk: Talk, text: str, *, number: int = 3, **fields: Any) -> str:
    """Send a goal, wait until this word of it is heard, and return its id."""
    goal_id = send(talk, text, **fields)
    await_word(talk, goal_id, number)
    return goal_id


def start_goal_with_client(talk: Talk, text: str, *options: str) -> tuple[str, Process]:
    """Start a client that waits for its goal, wait until its third word is heard, and return the id and the client."""
    known = {None, *talk.watcher.goals()}
    client = talk.start("say", "--wait", *options, "--", text)
    goal_id = str(talk.watcher.wait_until(lambda event: event.get("id") not in known)["id"])
    await_word(talk, goal_id)
    return goal_id, client


def heard(talk: Talk, quiet: float = 0.2) -> Samples:
    """Return everything that was heard, once it is quiet."""
    talk.recording.wait_until_quiet(quiet)
    return talk.recording.samples


def assert_same(samples: Samples, reference: Samples) -> Comparison:
    """Assert that one whole sentence was heard, and nothing else."""
    compared = compare(samples, reference)
    assert compared.same, compared
    return compared


def assert_aborted(goal: Message, reason: str, *words: str) -> None:
    """Assert that a goal was ABORTED for that reason, with these words in its message."""
    assert (goal["state"], goal["reason"]) == ("ABORTED", reason), goal
    assert goal["message"].startswith("speech failed: "), goal
    for word in words:
        assert word in goal["message"], goal


def engine_process(talk: Talk) -> int:
    """Return the process id of the server's engine, once there is exactly one."""
    return _only_child(lambda: talk.pid, "engine")


def player_process(talk: Talk) -> int:
    """Return the process id of the player of the goal that is being spoken."""
    return _only_child(lambda: engine_process(talk), "player")


def _only_child(parent: Callable[[], int], name: str) -> int:
    end = time.monotonic() + _PATIENCE
    while len(processes := children(parent())) != 1:
        assert time.monotonic() < end, f"not one {name}: {processes}"
        time.sleep(0.005)  # the child of a child sends no event
    return processes[0]
