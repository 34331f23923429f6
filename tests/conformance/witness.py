"""What the watcher saw of goals that have ended: as it reads in a thread of its own, their end is awaited."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tests.support.watcher import TERMINAL

if TYPE_CHECKING:
    from collections.abc import Iterable

    from tests.support.processes import Talk


def states(talk: Talk, goal_id: str) -> list[str]:
    """Return all the states of a goal that has ended."""
    talk.watcher.wait_for_terminal(goal_id)
    return talk.watcher.states(goal_id)


def ends(talk: Talk, *goal_ids: str) -> list[int]:
    """Return how many terminal states each of these goals has had, which have ended."""
    await_ends(talk, goal_ids)
    counts = talk.watcher.terminal_counts()
    return [counts[goal_id] for goal_id in goal_ids]


def await_ends(talk: Talk, goal_ids: Iterable[str]) -> None:
    """Wait until these goals have ended, if they were accepted; a thousand that have are seen at one look."""
    seen = {(event.get("id"), event.get("state")) for event in talk.watcher.events()}
    ended = {goal_id for goal_id, state in seen if state in TERMINAL - {"REJECTED"}}
    rejected = {goal_id for goal_id, state in seen if state == "REJECTED" and (goal_id, "PENDING") not in seen}
    done = ended | rejected
    for goal_id in goal_ids:
        if goal_id not in done:
            talk.watcher.wait_for_terminal(goal_id)
