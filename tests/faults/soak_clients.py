"""The clients of a soak: some that send, cancel, preempt and let expire, and one whose every sentence must be heard."""

from __future__ import annotations

import threading
import time
from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np

from tests.support.compare import alike, extent
from tests.support.recording import LOUD
from tests.support.reference import RATE, render

if TYPE_CHECKING:
    import random
    from collections.abc import Callable

    from tests.conformance.hearing import Samples
    from tests.support.connection import Message, Wire
    from tests.support.processes import Talk
    from tests.support.sink import Sink

#: Seconds in which any goal ends, whatever faults there are: each holds up the queue for some seconds.
PATIENCE = 120.0
#: Words per minute of the narrator, the fastest there are: more sentences in the time.
_RATE = 450
_SENTENCES = (
    "the robot is coming home to the charger now",
    "please step back from the moving platform",
    "battery is at twenty percent and falling",
)
#: Seconds by which a sentence may be shorter or longer than in a fresh process, and how much alike it is at least, by
#: `alike`, which says what the figure is for the right sentence and for another.
_EXTENT = 0.06
ALIKE = 0.3

#: Samples of a hundredth of a second.
_FRAME = RATE // 100
#: Seconds to which a recording's times are good.
_BLOCK = 0.01

_TEXTS = ("obstacle ahead", "turning left at the next corner", "door three is open", "one two three four five six")
_OPTIONS: tuple[dict[str, Any], ...] = (
    *({},) * 4,
    {"preempt": True},
    {"preempt": True},
    {"flush": True},
    {"priority": 3},
    {"priority": -2, "ttl": 0.2},
    {"ttl": 0.5},
    {"key": "one"},
    {"key": "two", "preempt": True},
    {"throttle": 0.2},
    {"rate": 450, "pitch": 80},
    {"volume": 0.3},
    {"voice": "en-us"},
    {"voice": "de"},
)


class Senders:
    """Clients that send goals until they are told to stop; `failures` are what went wrong."""

    def __init__(self, talk: Talk, count: int, chance: Callable[[int], random.Random]) -> None:
        self._talk = talk
        self._over = threading.Event()
        self.failures: list[str] = []
        self._threads = [threading.Thread(target=self._run, args=(chance(each),)) for each in range(count)]
        for each in self._threads:
            each.start()

    def stop(self) -> None:
        self._over.set()
        for each in self._threads:
            each.join(PATIENCE)
            if each.is_alive():
                self.failures.append("a client hangs")

    def _run(self, chance: random.Random) -> None:
        try:
            while not self._over.is_set():
                # A connection for some goals, as scripts have it.
                with self._talk.connect() as wire:
                    for _ in range(chance.randrange(1, 20)):
                        self._say(wire, chance)
        except Exception as error:  # noqa: BLE001 - told by the soak, in its own thread
            self.failures.append(f"a client: {type(error).__name__}: {error}")

    def _say(self, wire: Wire, chance: random.Random) -> None:
        if self._over.is_set():
            return
        waits = chance.random() < 0.8
        reply = wire.request("say", text=chance.choice(_TEXTS), wait=waits, **chance.choice(_OPTIONS))
        goal = reply["goal"]
        assert goal["state"] in {"PENDING", "REJECTED"}, goal
        self._over.wait(chance.random() * 0.3)
        if chance.random() < 0.9:
            assert wire.request("cancel", ids=[goal["id"]])["ok"]
        if waits:
            try:
                result = wire.receive_event("result", timeout=PATIENCE)["goal"]
            except TimeoutError:
                raise AssertionError(f"{goal} has not ended; the server: {self._talk.request('status')}") from None
            assert result["id"] == goal["id"], result


class Narrator:
    """Says sentences before all others, and listens to each: what has SUCCEEDED was heard whole."""

    def __init__(self, talk: Talk, sink: Sink, calm_since: Callable[[float], bool], last: Callable[[], str]) -> None:
        """`calm_since` tells whether nothing made sentences sound otherwise since a time; `last` is the last fault."""
        self._talk = talk
        self._sink = sink
        self._calm_since = calm_since
        self._last = last
        self._over = threading.Event()
        self._references = {text: render([text], rate=_RATE)[0] for text in _SENTENCES}
        self.heard_whole = 0
        self.ends: Counter[str] = Counter()
        self.failures: list[str] = []
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def stop(self) -> None:
        self._over.set()
        self._thread.join(PATIENCE)
        if self._thread.is_alive():
            self.failures.append("the narrator hangs")

    def _run(self) -> None:
        try:
            number = 0
            while not self._over.wait(0.2):
                self._narrate(_SENTENCES[number % len(_SENTENCES)])
                number += 1
        except Exception as error:  # noqa: BLE001 - told by the soak, in its own thread
            self.failures.append(f"the narrator: {type(error).__name__}: {error}")

    def _narrate(self, text: str) -> None:
        with self._talk.connect() as wire, self._sink.record() as recording:
            goal_id = wire.request("say", text=text, rate=_RATE, priority=100, wait=True)["goal"]["id"]
            times, goal = _follow(wire)
        self.ends[goal["state"]] += 1
        if goal["state"] != "SUCCEEDED" or not self._calm_since(times["ACTIVE"]):
            return
        # By the server's own times: this thread may be late, and the next sentence follows at once.
        samples = recording.between(times["ACTIVE"] - _BLOCK, times["SUCCEEDED"] + _BLOCK)
        reference = self._references[text]
        likeness = alike(samples, reference)
        if abs(_sound(samples) - _sound(reference)) <= _EXTENT and likeness >= ALIKE:
            self.heard_whole += 1
        else:
            sound = f"{_sound(samples):.2f} of {_sound(reference):.2f} s of sound, {likeness:.2f} alike"
            how = f"{sound}{_gaps(samples)}; after {self._last()}"
            self.failures.append(f"{goal_id} SUCCEEDED, but was not heard as it should: {how}")


def _follow(wire: Wire) -> tuple[dict[str, float], Message]:
    """Return when a goal came to its states, on the monotonic clock, and how it ended."""
    clock = time.monotonic() - time.time()
    times: dict[str, float] = {}
    while (message := wire.receive(PATIENCE)).get("event") != "result":
        if message.get("event") == "state":
            times[message["state"]] = message["at"] + clock
    return times, message["goal"]


def _sound(samples: Samples) -> float:
    """Return the seconds that are sound: a gap where a busy machine let the player run dry is none."""
    frames = np.abs(samples[: len(samples) // _FRAME * _FRAME].astype(np.int32)).reshape(-1, _FRAME)
    return float(np.count_nonzero(frames.max(axis=1) > LOUD)) * _FRAME / RATE


def _gaps(samples: Samples) -> str:
    """Return where a sentence was silent for a twentieth of a second, for messages."""
    inside = extent(samples)
    if inside is None:
        return ""
    loud = np.flatnonzero(np.abs(samples[inside[0] : inside[1]].astype(np.int32)) > LOUD)
    gaps = [(int(loud[at]), int(gap)) for at, gap in enumerate(np.diff(loud)) if gap > RATE // 20]
    return "".join(f"; silent for {gap / RATE:.3f} s at {at / RATE:.3f} s" for at, gap in gaps)
