"""A witness of effects alone: what is true of every sequence of them, whatever any model says."""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING

from talkcli.goals.scheduler import Changed, Effect, Order, Ordered
from tests.unit.slow_goal import ENDS, FIRST, TABLE

if TYPE_CHECKING:
    from collections.abc import Iterable


class Witness:
    """Sees effects in their order. It is told the time, when a goal must have begun, and when speech is paused."""

    def __init__(self) -> None:
        self.paths: dict[str, list[str]] = defaultdict(list)
        self.speaking: str | None = None
        self.held: str | None = None
        self.paused = False
        self.now = 0.0
        self.over: dict[str, float] = {}
        self.told_to_stop: set[str] = set()
        self.started: list[str] = []

    def see(self, effects: Iterable[Effect]) -> None:
        for effect in effects:
            goal_id = effect.record.id
            match effect:
                case Changed(state=state):
                    self._changed(goal_id, state.name)
                case Ordered(order=Order.START):
                    self._started(goal_id)
                case Ordered(order=Order.STOP):
                    assert goal_id == self.speaking, "a stop for a goal that the engine doesn't have"
                    assert goal_id not in self.told_to_stop, "a goal was told to stop twice"
                    self.told_to_stop.add(goal_id)
                    self.held = None
                case Ordered(order=Order.HOLD):
                    assert self.paused, "a goal was held though nobody paused"
                    assert self.held is None, "a goal was held twice"
                    assert goal_id == self.speaking, "the engine shall hold a goal that it doesn't have"
                    assert goal_id not in self.told_to_stop, "the engine shall hold a goal that it shall stop"
                    self.held = goal_id
                case Ordered(order=Order.RESUME):
                    assert not self.paused, "a goal goes on though speech is paused"
                    assert goal_id == self.held, "a goal goes on that was not held"
                    self.held = None
                case Ordered(order=Order.GIVE_UP):
                    assert goal_id in self.told_to_stop, "an engine was given up that nobody told to stop"
                    assert self.started[-1] == goal_id, "an engine was given up that has the next goal already"

    def _started(self, goal_id: str) -> None:
        assert self.speaking is None, "a goal started before the old one had ended"
        assert goal_id not in self.started, "a goal started twice"
        assert not self.paused, "a goal started while speech was paused"
        assert self.now < self.over.get(goal_id, self.now + 1), "a goal started when its time was over"
        assert self.paths[goal_id][-1] == "ACTIVE", "a goal started that is not ACTIVE"
        self.speaking = goal_id
        self.started.append(goal_id)

    def _changed(self, goal_id: str, state: str) -> None:
        path = self.paths[goal_id]
        assert state in (TABLE.get(path[-1], set()) if path else FIRST), f"{goal_id}: {path} then {state}"
        path.append(state)
        busy = [each for each, states in self.paths.items() if states[-1] in {"ACTIVE", "PREEMPTING"}]
        assert len(busy) <= 1, f"{busy} at once"
        if state in ENDS and goal_id == self.speaking:
            self.speaking = self.held = None
