"""Which goals a request ends: a cancel, or a goal that replaces or preempts others.

Pure: it looks, and changes nothing but the answer that it fills in.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Sequence
    from typing import Protocol

    from talkcli.goals.effects import Cancelled
    from talkcli.goals.options import Cancel, Say
    from talkcli.goals.queue import Queue
    from talkcli.goals.record import Record

    class Goals(Protocol):
        """What there is to select from: the scheduler's goals."""

        active: Record | None

        def find(self, goal_id: str) -> Record | None: ...

        def unfinished(self) -> list[Record]: ...

        def with_key(self, key: str | None) -> list[Record]: ...


def select(selection: Cancel, goals: Goals, done: Cancelled, waiting: Collection[str | None] = ()) -> list[Record]:
    """Return the selected goals that have not ended; note in `done` what else was named.

    `waiting`: ids of the selected ones that are not accepted yet: they are known, and come after all that are.
    """
    if selection.everything:
        chosen = goals.unfinished()
    else:
        chosen = [*_named(selection, goals, done, waiting), *goals.with_key(selection.key)]
        if selection.current and goals.active:
            chosen.append(goals.active)
        if selection.before is not None:
            chosen += _accepted_until(selection.before, goals, done, waiting)
    once = {each.number: each for each in chosen}.values()
    # The active one last: another must not start, even for the length of this step, and be stopped again.
    return sorted(once, key=lambda each: (each is goals.active, each.number))


def select_waiting(selection: Cancel, waiting: Sequence[Say]) -> list[int]:
    """Return which of the goals that are not accepted yet are selected: their places in the order in which they came.

    `before` selects them only where it names one of them, by its sender's id.
    """
    ids = set(selection.ids or ())
    last = max((place for place, say in enumerate(waiting) if say.id == selection.before), default=-1)
    return [
        place
        for place, say in enumerate(waiting)
        if selection.everything
        or (selection.before is not None and place <= last)
        or (say.id is not None and say.id in ids)
        or (say.key is not None and say.key == selection.key)
    ]


def making_way(say: Say, queue: Queue, max_queue: int, *, preempts: bool) -> list[tuple[Record, str]] | None:
    """Return the pending goals that this one recalls, and the reason; None if it has no room even so."""
    ended = _outdone(say, queue, preempts=preempts)
    if ended or len(queue) < max_queue:
        return ended
    displaced = queue.giving_way_to(say.priority)
    return [(displaced, "displaced")] if displaced else None


def _outdone(say: Say, queue: Queue, *, preempts: bool) -> list[tuple[Record, str]]:
    """Return the goals that it recalls whether there is room or not."""
    replaced = queue.with_key(say.key)
    others: Iterable[Record] = ()
    if say.flush:
        others = queue.up_to(say.priority)
    elif preempts:
        others = queue.preempting_up_to(say.priority)
    preempted = [(each, "preempted") for each in others if each is not replaced]
    return [(replaced, "replaced"), *preempted] if replaced else preempted


def _named(selection: Cancel, goals: Goals, done: Cancelled, waiting: Collection[str | None]) -> Iterator[Record]:
    for goal_id in dict.fromkeys(selection.ids or ()):
        record = goals.find(goal_id)
        if record is None:
            if goal_id not in waiting:
                done.unknown.append(goal_id)
        elif record.state.terminal:
            done.ended.append(record)
        else:
            yield record


def _accepted_until(goal_id: str, goals: Goals, done: Cancelled, waiting: Collection[str | None]) -> list[Record]:
    last = goals.find(goal_id)
    if last is None and goal_id in waiting:
        return goals.unfinished()
    if last is None:
        done.unknown.append(goal_id)
        return []
    return [each for each in goals.unfinished() if each.number <= last.number]
