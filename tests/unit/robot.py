"""A scheduler for tests: its effects written down, its time moved by the test alone."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from talkcli.frozen import replace
from talkcli.goals.goal import By, Sender
from talkcli.goals.options import INITIAL, Cancel, Say
from talkcli.goals.scheduler import Cancelled, Changed, Effect, Now, Scheduler, Submitted

if TYPE_CHECKING:
    from talkcli.goals.record import Record
    from talkcli.goals.states import State

ARM = Sender(pid=7, uid=1000, command="talk", name="arm")
DOOR = Sender(pid=8, uid=1000, command="talk", name="door")


@dataclass
class Robot:
    """A scheduler whose effects are written down, at a time that only the test moves."""

    preempt: bool = False
    max_queue: int = 100
    ttl: float = 0.0
    seconds: float = 100.0
    seen: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        settings = replace(INITIAL, preempt=self.preempt, ttl=self.ttl)
        self.scheduler = Scheduler("4k7f", max_queue=self.max_queue, settings=settings)

    @property
    def now(self) -> Now:
        return Now(self.seconds, 1.7e9 + self.seconds)

    def see(self, effects: list[Effect]) -> list[Effect]:
        for effect in effects:
            what = effect.state.name if isinstance(effect, Changed) else effect.order.value
            self.seen.append(f"{effect.record.number} {what}")
        return effects

    def submits(self, say: Say, fault: tuple[str, str] | None = None) -> Submitted:
        done = self.scheduler.submit(say, ARM, self.now, fault)
        self.see(done.effects)
        return done

    def asks(self, say: Say) -> Record:
        return self.submits(say).record

    def says(self, text: str = "door open", *, preempt: bool | None = None, priority: int = 0) -> Record:
        return self.asks(Say(text, preempt=preempt, priority=priority))

    def lacks_room(self, say: Say, fault: tuple[str, str] | None = None) -> bool:
        return self.scheduler.lacks_room(say, self.now, fault)

    def cancels(self, *ids: str, current: bool = False, before: str | None = None, key: str | None = None) -> Cancelled:
        done = self.scheduler.cancel(Cancel(ids or None, current, before, key), DOOR, self.now)
        self.see(done.effects)
        return done

    def pauses(self) -> None:
        self.see(self.scheduler.pause())

    def resumes(self) -> None:
        self.see(self.scheduler.resume(self.now))

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

    def speaks_the_rest(self) -> list[str]:
        """Let the engine speak to the end all that is active or waits; return the texts from the next one on."""
        spoken = []
        while self.scheduler.active:
            self.tells("completed", self.scheduler.active.id)
            if self.scheduler.active:
                spoken.append(str(self.scheduler.active.text))
        return spoken

    def waits(self, seconds: float) -> None:
        self.seconds += seconds
        self.see(self.scheduler.tick(self.now))

    def waiting(self) -> list[int]:
        return [each.number for each in self.scheduler.pending()]


def ending(record: Record) -> tuple[State, str | None, By | None]:
    return record.state, record.reason, record.by


def numbers(records: list[Record]) -> list[int]:
    return sorted(each.number for each in records)
