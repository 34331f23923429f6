"""What the watcher saw of goals that have ended: as it reads in a thread of its own, their end is awaited."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tests.support.processes import Talk


def states(talk: Talk, goal_id: str) -> list[str]:
    """Return all the states of a goal that has ended."""
    talk.watcher.wait_for_terminal(goal_id)
    return talk.watcher.states(goal_id)


def ends(talk: Talk, *goal_ids: str) -> list[int]:
    """Return how many terminal states each of these goals has had, which have ended."""
    for each in goal_ids:
        talk.watcher.wait_for_terminal(each)
    counts = talk.watcher.terminal_counts()
    return [counts[each] for each in goal_ids]
