"""The clients of the soak tests: threads that work until they are stopped."""

from __future__ import annotations

import threading
import time
from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np

from tests.support.compare import similarity
from tests.support.recording import LOUD
from tests.support.reference import RATE, render

if TYPE_CHECKING:
    import random
    from collections.abc import Callable

    from tests.conformance.hearing import Samples
    from tests.support.connection import Message, Wire
    from tests.support.processes import Talk
    from tests.support.sink import Sink

#: Time limit until a goal ends. Each fault may delay the queue by some seconds.
PATIENCE_S = 120.0
_RATE = 450
_SENTENCES = (
    "the robot is coming home to the charger now",
    "please step back from the moving platform",
    "battery is at twenty percent and falling",
)
#: Allowed difference in length from the reference, and the lowest allowed `similarity`.
_LENGTH_TOLERANCE_S = 0.06
MIN_SIMILARITY = 0.3
_FRAME_SAMPLES = RATE // 100
#: Precision of a recording's times.
_BLOCK_S = 0.01

_TEXTS = ("obstacle ahead", "turning left at the next corner", "door three is open", "one two three four five six")
_OPTIONS: tuple[dict[str, Any], ...] = (
    *({},) * 4,
    *({"preempt": True}, {"preempt": True}, {"flush": True}, {"priority": 3}, {"priority": -2, "ttl": 0.2}),
    *({"ttl": 0.5}, {"key": "one"}, {"key": "two", "preempt": True}, {"throttle": 0.2}, {"rate": 450, "pitch": 80}),
    *({"volume": 0.3}, {"voice": "en-us"}, {"voice": "de"}),
)


class Workers:
    """Threads that run until `stop`, and their failures."""

    def __init__(self) -> None:
        self.failures: list[str] = []
        self._over = threading.Event()
        self._threads: list[threading.Thread] = []

    def start(self, name: str, work: Callable[[threading.Event], None]) -> None:
        """Start a thread that calls `work` with an event. The work must end when the event is set."""

        def run() -> None:
            try:
                work(self._over)
            except Exception as error:  # noqa: BLE001 - reported by `stop`
                self.failures.append(f"{name}: {type(error).__name__}: {error}")

        self._threads.append(threading.Thread(target=run, name=name))
        self._threads[-1].start()

    def stop(self, details: str = "") -> None:
        """Wait until all threads have ended, and raise an error if one has failed."""
        self._over.set()
        end = time.monotonic() + 2 * PATIENCE_S
        for thread in self._threads:
            thread.join(max(0.0, end - time.monotonic()))
            if thread.is_alive():
                self.failures.append(f"{thread.name} hangs")
        assert not self.failures, f"{self.failures} {details}"


def send_goals(talk: Talk, rng: random.Random, over: threading.Event) -> None:
    """Send, cancel and preempt random goals. Each must end in time."""
    while not over.is_set():
        with talk.connect() as wire:
            for _ in range(rng.randrange(1, 20)):
                if not over.is_set():
                    _send_goal(talk, wire, rng, over)


def _send_goal(talk: Talk, wire: Wire, rng: random.Random, over: threading.Event) -> None:
    waits = rng.random() < 0.8
    goal = wire.request("say", text=rng.choice(_TEXTS), wait=waits, **rng.choice(_OPTIONS))["goal"]
    assert goal["state"] in {"PENDING", "REJECTED"}, goal
    over.wait(rng.random() * 0.3)
    if rng.random() < 0.9:
        assert wire.request("cancel", ids=[goal["id"]])["ok"]
    if waits:
        try:
            result = wire.receive_event("result", timeout=PATIENCE_S)["goal"]
        except TimeoutError:
            raise AssertionError(f"{goal} has not ended; the server's status: {talk.request('status')}") from None
        assert result["id"] == goal["id"], result


class Narrator:
    """Speaks sentences with a high priority. If a sentence SUCCEEDED, it must have been heard completely."""

    def __init__(self, talk: Talk, sink: Sink, calm_since: Callable[[float], bool]) -> None:
        """`calm_since` returns whether no fault has disturbed the sound since a monotonic time."""
        self._talk, self._sink, self._calm_since = talk, sink, calm_since
        self._references = {text: render([text], rate=_RATE)[0] for text in _SENTENCES}
        self.heard_whole = 0
        self.ends: Counter[str] = Counter()

    def run(self, over: threading.Event) -> None:
        while not over.wait(0.2):
            self._narrate(_SENTENCES[self.ends.total() % len(_SENTENCES)])

    def _narrate(self, text: str) -> None:
        with self._talk.connect() as wire, self._sink.record() as recording:
            assert wire.request("say", text=text, rate=_RATE, priority=100, wait=True)["ok"]
            times, goal = _follow(wire)
        self.ends[goal["state"]] += 1
        if goal["state"] != "SUCCEEDED" or not self._calm_since(times["ACTIVE"]):
            return
        # Use the server's times, because this thread may be late, and the next sentence follows at once.
        samples = recording.between(times["ACTIVE"] - _BLOCK_S, times["SUCCEEDED"] + _BLOCK_S)
        heard, wanted = _seconds_of_sound(samples), _seconds_of_sound(self._references[text])
        found = similarity(samples, self._references[text])
        details = f"{goal['id']} SUCCEEDED, but {heard:.2f} of {wanted:.2f} s were heard, similarity {found:.2f}"
        assert abs(heard - wanted) <= _LENGTH_TOLERANCE_S, details
        assert found >= MIN_SIMILARITY, details
        self.heard_whole += 1


def _follow(wire: Wire) -> tuple[dict[str, float], Message]:
    """Return the monotonic time of each state of a goal, and the ended goal."""
    clock = time.monotonic() - time.time()
    times: dict[str, float] = {}
    while (message := wire.receive(PATIENCE_S)).get("event") != "result":
        if message.get("event") == "state":
            times[message["state"]] = message["at"] + clock
    return times, message["goal"]


def _seconds_of_sound(samples: Samples) -> float:
    """Return the seconds of sound, without the gaps that occur if a player runs dry on a busy machine."""
    frames = np.abs(samples[: len(samples) // _FRAME_SAMPLES * _FRAME_SAMPLES].astype(np.int32))
    loud = np.count_nonzero(frames.reshape(-1, _FRAME_SAMPLES).max(axis=1) > LOUD)
    return float(loud) * _FRAME_SAMPLES / RATE
