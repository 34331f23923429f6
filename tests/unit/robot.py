"""A scheduler for tests: its effects written down, its time moved by the test alone."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from talkcli.messages import By, Sender
from talkcli.requests import Cancel, Say
from talkcli.scheduler import Cancelled, Changed, Effect, Now, Scheduler

if TYPE_CHECKING:
    from talkcli.record import Record
    from talkcli.states import State

ARM = Sender(pid=7, uid=1000, command="talk", name="arm")
DOOR = Sender(pid=8, uid=1000, command="talk", name="door")


@dataclass
class Robot:
    """A scheduler whose effects are written down, at a time that only the test moves."""

    preempt: bool = False
    max_queue: int = 100
    seconds: float = 100.0
    seen: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.scheduler = Scheduler("k3fz", preempt=self.preempt, max_queue=self.max_queue)

    @property
    def now(self) -> Now:
        return Now(self.seconds, 1.7e9 + self.seconds)

    def see(self, effects: list[Effect]) -> list[Effect]:
        for effect in effects:
            what = effect.state.name if isinstance(effect, Changed) else type(effect).__name__
            self.seen.append(f"{effect.record.number} {what}")
        return effects

    def says(self, text: str = "door open", *, preempt: bool | None = None) -> Record:
        record, effects = self.scheduler.submit(Say(text, preempt=preempt), ARM, self.now)
        self.see(effects)
        return record

    def cancels(self, *ids: str, current: bool = False, before: str | None = None) -> Cancelled:
        done = self.scheduler.cancel(Cancel(ids or None, current, before), DOOR, self.now)
        self.see(done.effects)
        return done

    def shuts_down(self) -> None:
        self.see(self.scheduler.shutdown(self.now))

    def tells(self, event: str, goal_id: str) -> None:
        """Let the engine tell this of a goal."""
        match event:
            case "heard":
                self.scheduler.heard(goal_id, 4)
            case "completed":
                self.see(self.scheduler.completed(goal_id, 1.5, self.now))
            case "failed":
                self.see(self.scheduler.failed(goal_id, "audio_lost", "device is gone", 1.5, self.now))
            case "stopped":
                self.see(self.scheduler.stopped(goal_id, self.now))

    def waits(self, seconds: float) -> None:
        self.seconds += seconds
        self.see(self.scheduler.tick(self.now))

    def waiting(self) -> list[int]:
        return [each.number for each in self.scheduler.pending()]


def ending(record: Record) -> tuple[State, str | None, By | None]:
    return record.state, record.reason, record.by


def numbers(records: list[Record]) -> list[int]:
    return sorted(each.number for each in records)
