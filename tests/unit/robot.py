"""A scheduler for tests, which plays a script and describes the outcome of each goal in one line.

The steps of a script are separated by semicolons. A single letter sends a goal with this text, followed by its options.
Every other step is a verb:

    a 5 preempt key=k ttl=1     send a goal of priority 5 that preempts; "queue" is preempt=False
    a more stall=2; append a text=door at=4 end broken; left a    send a growing text, add to it, and leave
    starved a; fed a            report as the engine that text is missing, or that it is no longer missing
    heard a; completed a; failed a; stopped a; deaf a   report this as the engine; * is the active goal
    interrupted a 2             report that the goal was interrupted, and continues at this place in its text (1)
    cancel; cancel a b; cancel current before=c key=k
    wait 1; pass 1              let a second pass, with or without a tick
    pause; pause seconds=5; pause connection=x; gone x (the connection x ends); resume
    shutdown; lost; ready; unavailable; missing; room 2 (the places in the queue); set ttl=5 preempt=yes
    loaded joe; unloadable joe; unloaded joe; measured joe 2; chosen a joe      report this about the voice piper/joe

An outcome is "a ACTIVE; c b PENDING; d e RECALLED replaced by c", for example. It lists pending goals in the order of
the queue.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import pytest

from talkcli.goals.goal import By, Sender
from talkcli.goals.options import DEFAULTS, Append, Cancel, Say
from talkcli.goals.reasons import Reason
from talkcli.goals.scheduler import (
    Cancellation,
    Effect,
    EngineOrder,
    Interruption,
    Now,
    Scheduler,
    StateChange,
)
from talkcli.goals.voices import VoiceDropOrder, VoiceLoadOrder, VoiceScheduler

if TYPE_CHECKING:
    from collections.abc import Callable

    from talkcli.goals.record import Record

ARM = Sender(pid=7, uid=1000, command="talk", name="arm")
DOOR = Sender(pid=8, uid=1000, command="talk", name="door")
FLAGS = {"yes": True, "no": False}


@dataclass
class Robot:
    """A scheduler whose effects are recorded. Its time only changes if the test changes it."""

    max_queue: int = 100
    seconds: float = 100.0
    #: the effects in their order, such as "a PENDING" and "a Start"
    seen: list[str] = field(default_factory=list)
    goals: dict[str, Record] = field(default_factory=dict)
    #: the goals that were attached to earlier goals, such as "b is a"
    attached: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        voices = VoiceScheduler(limit_bytes=10, file_size=lambda _: 1)
        self.scheduler = Scheduler("4k7f", max_queue=self.max_queue, settings=DEFAULTS, voices=voices)
        self.scheduler.engine_ready(self.now)

    @property
    def now(self) -> Now:
        return Now(self.seconds, 1.7e9 + self.seconds)

    def collect(self, effects: list[Effect]) -> list[Effect]:
        for effect in effects:
            if isinstance(effect, StateChange):
                self.seen.append(f"{self.name_of(effect.record)} {effect.state.name}")
            elif isinstance(effect, EngineOrder):
                self.seen.append(f"{self.name_of(effect.record)} {effect.order.value}")
            elif isinstance(effect, Interruption):
                self.seen.append(f"{self.name_of(effect.record)} interrupted by {effect.interrupted_by}")
            elif isinstance(effect, VoiceLoadOrder):
                self.seen += [*(f"drop {voice}" for voice in effect.dropped), f"load {effect.voice}"]
            elif isinstance(effect, VoiceDropOrder):
                self.seen.append(f"drop {effect.voice}")
        return effects

    def name_of(self, record: Record) -> str:
        return next((name for name, other in self.goals.items() if other is record), str(record.number))

    # -- single steps

    def submit(self, say: Say, name: str = "", **known: Any) -> Record:
        record, effects = self.scheduler.submit(say, ARM, self.now, **known)
        if name and not effects:
            self.attached.append(f"{name} is {self.name_of(record)}")
        elif name:
            self.goals[name] = record
        self.collect(effects)
        return record

    def say(self, text: str = "door open", *, preempt: bool | None = None, priority: int = 0) -> Record:
        return self.submit(Say(text, preempt=preempt, priority=priority))

    def cancel(self, *ids: str, waiting: tuple[str, ...] = (), **selection: Any) -> Cancellation:
        done = self.scheduler.cancel(Cancel(ids or None, **selection), DOOR, self.now, waiting)
        self.collect(done.effects)
        return done

    def append(self, goal_id: str, **addition: Any) -> None:
        """Add text to a goal, or end its text."""
        record = self.scheduler.find(goal_id)
        assert record
        self.collect(self.scheduler.append(record, Append(goal_id, **addition), self.now))

    def leave(self, goal_id: str) -> None:
        """Report that the sender of a goal has left."""
        record = self.scheduler.find(goal_id)
        assert record
        self.collect(self.scheduler.producer_left(record, self.now))

    def wait(self, seconds: float) -> None:
        self.seconds += seconds
        self.collect(self.scheduler.tick(self.now))

    def end_loading(self, voice: str, error: str | None) -> None:
        """Report as the engine that a voice was loaded or could not be loaded."""
        self.collect(self.scheduler.voice_load_ended(f"piper/{voice}", error, self.now, imported_libraries=True))

    def report(self, event: str, goal_id: str) -> None:
        """Report an event of a goal as the engine."""
        match event:
            case "heard":
                self.scheduler.word_heard(goal_id, 0, 4, 0.25)
            case "completed":
                self.collect(self.scheduler.completed(goal_id, 1.5, self.now))
            case "failed":
                self.collect(self.scheduler.failed(goal_id, Reason.AUDIO_LOST, "device is gone", 1.5, self.now))
            case "deaf":
                self.collect(self.scheduler.failed(goal_id, Reason.NOT_SILENT, "it does not end", None, self.now))
            case "stopped":
                self.collect(self.scheduler.stopped(goal_id, self.now))
            case "interrupted":
                self.collect(self.scheduler.interrupted_at(goal_id, 1, self.now))
            case "starved" | "fed":
                self.scheduler.text_missing(goal_id, 1, self.now, missing=event == "starved")
            case _:
                raise ValueError(event)

    # -- scripts

    def play(self, script: str) -> Robot:
        for step in script.split(";"):
            verb, *words = step.split()
            if len(verb) == 1:
                given = options(words)
                parameters = {"waited": "waited_s", "fault": "server_refusal", "canceled": "canceled_by"}
                known = {name: given.pop(option) for option, name in parameters.items() if option in given}
                if "server_refusal" in known:
                    known["server_refusal"] = Reason(known["server_refusal"]), "it can't be had"
                if "canceled_by" in known:
                    known["canceled_by"] = By(client=DOOR)
                self.submit(Say(**{"text": verb, **given}), verb, **known)
            elif verb == "append":
                self.append(self._id(words[0]), **options(words[1:]))
            elif verb == "left":
                self.leave(self._id(words[0]))
            elif verb == "cancel":
                given = options(words)
                ids = [self._id(word) for word in words if "=" not in word and word != "current"]
                selection: dict[str, Any] = {name: self._id(given[name]) for name in ("before", "key") if name in given}
                self.cancel(*ids, current="current" in given, **selection)
            else:
                self._do(verb, words)
        return self

    def _do(self, verb: str, words: list[str]) -> None:
        scheduler, word = self.scheduler, words[0] if words else ""
        step: Callable[[], object] = {
            "pause": lambda: self.collect(scheduler.pause(DOOR, self.now, **options(words))),
            "resume": lambda: self.collect(scheduler.resume(DOOR, self.now)),
            "gone": lambda: self.collect(scheduler.end_pause(word, self.now)),
            "shutdown": lambda: self.collect(scheduler.shutdown(self.now)),
            "lost": lambda: self.collect(scheduler.engine_lost(self.now)),
            "ready": lambda: self.collect(scheduler.engine_ready(self.now)),
            "missing": lambda: self.collect(scheduler.fail_next("no memory", self.now)),
            "unavailable": lambda: self.collect(scheduler.engine_unavailable(self.now)),
            "loaded": lambda: self.end_loading(word, None),
            "unloadable": lambda: self.end_loading(word, "no json"),
            "unloaded": lambda: self.collect(scheduler.voice_unloaded(f"piper/{word}", self.now)),
            "measured": lambda: self.collect(scheduler.voices_measured(f"piper/{word}", int(words[1]), self.now)),
            "chosen": lambda: self.collect(scheduler.voice_chosen(self._id(word), f"piper/{words[1]}", self.now)),
            "wait": lambda: self.wait(float(word)),
            "pass": lambda: setattr(self, "seconds", self.seconds + float(word)),
            "room": lambda: setattr(scheduler, "max_queue", int(word)),
            "set": lambda: self.collect(scheduler.change_settings(options(words), self.now)),
        }.get(verb, lambda: self.report(verb, self._id(word)))
        step()

    def _id(self, name: str) -> str:
        if name == "*" and self.scheduler.active:
            return self.scheduler.active.id
        return self.goals[name].id if name in self.goals else name

    def outcome(self) -> str:
        """Return the outcome of all goals, and check that each goal agrees with the published events."""
        unfinished = self.scheduler.unfinished()
        groups: dict[str, list[str]] = {}
        for record in [*unfinished, *(ended for ended in self.goals.values() if ended not in unfinished)]:
            groups.setdefault(self._ending(record), []).append(self.name_of(record))
        return "; ".join([*(f"{' '.join(names)} {ending}" for ending, names in groups.items()), *self.attached])

    def _ending(self, record: Record) -> str:
        goal = record.snapshot()
        effects = [effect.split()[1] for effect in self.seen if effect.startswith(f"{self.name_of(record)} ")]
        states = [effect for effect in effects if effect.isupper()]
        assert states[-1] == goal.state.name, f"the goal is {goal.state.name}, but {states} were published"
        assert (goal.started_at is not None) == ("ACTIVE" in states)
        assert (goal.ended_at is not None) == goal.state.terminal
        assert (goal.message is not None) == goal.state.terminal
        parts = [goal.state.name, *(["paused"] if goal.paused else []), *([goal.reason] if goal.reason else [])]
        if goal.interrupted_by:
            names = [name for name, other in self.goals.items() if other.id == goal.interrupted_by]
            parts += ["for", *names]
        if goal.by and goal.by.goal:
            parts += ["by", self.name_of(next(other for other in self.goals.values() if other.id == goal.by.goal))]
        elif goal.by and goal.by.client:
            parts += ["by", str(goal.by.client.name)]
        return " ".join(parts)


def play(script: str) -> Robot:
    return Robot().play(script)


def rules(table: str) -> list[Any]:
    """Return the rows of a table as test parameters. A row is a rule, followed by an indented "script -> outcome"."""
    blocks = re.findall(r"^(#|\w)(.*)\n((?:    .*\n)*)", table, re.MULTILINE)
    title, params = "", []
    for first, rest, example in blocks:
        if first == "#":
            title = f"{rest.strip()}: "
        else:
            script, outcome = " ".join(example.split()).split(" -> ")
            params.append(pytest.param(script, outcome, id=f"{title}{first}{rest}"))
    return params


def options(words: list[str]) -> dict[str, Any]:
    """Return the options of a goal in a step. A number is a priority, and a single word is a flag."""
    values: dict[str, Any] = {}
    for word in words:
        name, is_value, value = word.partition("=")
        if is_value:
            values[name] = FLAGS.get(value, number(value))
        elif name == "queue":
            values["preempt"] = False
        elif isinstance(number(name), int):
            values["priority"] = number(name)
        else:
            values[name] = True
    return values


def number(word: str) -> int | float | str:
    for kind in (int, float):
        try:
            return kind(word)
        except ValueError:
            pass
    return word
