"""Helpers for tests of sound: sentences, started goals, and the processes of a server."""

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

#: Short sentences, and long ones to interrupt. Each starts with a short silence, because the monitor drops up to
#: 10 ms at the start of a stream.
LOW = "battery low"
HOME = "coming home"
HELP = "please help, I am stuck"
SHORTER = "two three four five six seven"
LONG = f"{SHORTER} eight nine ten eleven twelve"

#: The maximum rate in words per minute, for all tests but those of the rate. LONG takes 1.3 s, SHORTER 0.7 s, and HELP
#: 0.6 s.
QUICK = 450

#: Precision of a sample's time in seconds: a block of the monitor, and one of the sink before it.
PRECISION = 0.03
#: Limit in seconds until a started process is found.
_PATIENCE = 5.0


def render_quick(sentences: Sequence[str | Sentence]) -> list[Samples]:
    """Return the samples of each sentence at the rate QUICK."""
    return render(sentences, rate=QUICK)


def send(talk: Talk, text: str, **fields: Any) -> str:
    """Send a goal without waiting for it, and return its id."""
    reply = talk.request("say", text=text, **fields)
    assert reply["ok"], reply
    goal: Message = reply["goal"]
    assert goal["state"] in ("PENDING", "ACTIVE"), goal
    return str(goal["id"])


def await_word(talk: Talk, goal_id: str, number: int = 3) -> None:
    """Wait until this word of a goal is heard. The third one is in mid-sentence."""
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
    """Wait until it is quiet, and return everything that was heard."""
    talk.recording.wait_until_quiet(quiet)
    return talk.recording.samples


def assert_same(samples: Samples, reference: Samples) -> Comparison:
    """Assert that this whole sentence was heard, and nothing else."""
    compared = compare(samples, reference)
    assert compared.same, compared
    return compared


def assert_aborted(goal: Message, reason: str, *texts: str) -> None:
    """Assert that a goal was ABORTED for this reason, with these strings in its message."""
    assert (goal["state"], goal["reason"]) == ("ABORTED", reason), goal
    assert goal["message"].startswith("speech failed: "), goal
    for text in texts:
        assert text in goal["message"], goal


def engine_process(talk: Talk) -> int:
    """Wait until the server has exactly one engine process, and return its id."""
    return _only_child(lambda: talk.pid, "engine")


def player_process(talk: Talk) -> int:
    """Wait until the engine has exactly one player process, and return its id."""
    return _only_child(lambda: engine_process(talk), "player")


def _only_child(parent: Callable[[], int], name: str) -> int:
    end = time.monotonic() + _PATIENCE
    while len(processes := children(parent())) != 1:
        assert time.monotonic() < end, f"not one {name}: {processes}"
        time.sleep(0.005)  # a process that is not our child sends no event
    return processes[0]
