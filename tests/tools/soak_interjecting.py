"""The clients of the soak test that interrupt sentences, and the client whose sentences are interrupted."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tests.support.watcher import TERMINAL
from tests.tools.soak_clients import PATIENCE_S

if TYPE_CHECKING:
    import random
    import threading
    from collections import Counter

    from tests.support.connection import Message, Wire
    from tests.support.processes import Talk

#: Texts without digits and colons, because the rest of such a text may have other words. The last one grows.
_STORIES = (
    "The first shelf holds seven hundred small boxes, and behind it in the corner there are many barrels of water.",
    "It's the well-known hall. Dr. Smith waits for the U.S.A. team, e.g. there. Go on!",
    "One two three four five six seven eight nine ten eleven twelve, and «so on».",
    "I found the charger. It is near the door, behind the table. Shall I go there now?",
)
#: Usual goals neither preempt the stories nor go before them.
_PRIORITY = 50
_RATE = 450


def read_stories(wire: Wire) -> dict[str, list[tuple[int, int, int]]]:
    """Speak each text without interruption, and return its words."""
    stories = {}
    for text in _STORIES:
        assert wire.request("say", text=text, rate=_RATE, feedback=True)["ok"]
        words, goal, _ = _follow(wire)
        assert goal["state"] == "SUCCEEDED", goal
        stories[text] = words
    return stories


def tell_stories(
    talk: Talk,
    stories: dict[str, list[tuple[int, int, int]]],
    ends: Counter[tuple[str, bool]],
    rng: random.Random,
    over: threading.Event,
) -> None:
    """Speak texts that others interrupt. Each that SUCCEEDED must have the words of the uninterrupted text.

    `ends` counts the goals by their final state, and by whether they were interrupted.
    """
    while not over.is_set():
        with talk.connect() as wire:
            for _ in range(10):
                text = rng.choice(_STORIES)
                words, goal, interruptions = _tell(wire, text, rng)
                _check(goal, words, stories[text])
                ends[goal["state"], interruptions > 0] += 1
                if over.wait(rng.random() * 0.2):
                    return


def _tell(wire: Wire, text: str, rng: random.Random) -> tuple[list[tuple[int, int, int]], Message, int]:
    """Speak a text, and return its words, the ended goal, and the number of its interruptions."""
    options = {"rate": _RATE, "priority": _PRIORITY, "feedback": True}
    if text != _STORIES[-1]:
        assert wire.request("say", text=text, **options)["ok"]
        return _follow(wire)
    goal_id = wire.request("say", text=text[:5], more=True, **options)["goal"]["id"]
    for at in range(5, len(text), 20):
        wire.request("append", id=goal_id, text=text[at : at + 20], at=at)  # the goal may have ended
        if rng.random() < 0.3:
            wire.request("status")
    wire.request("append", id=goal_id, end=True)
    return _follow(wire)


def _follow(wire: Wire) -> tuple[list[tuple[int, int, int]], Message, int]:
    words, interruptions = [], 0
    while True:
        event = wire.events.pop(0) if wire.events else wire.receive(PATIENCE_S)
        if event["event"] == "word":
            words.append((event["number"], event["start"], event["end"]))
        interruptions += event["event"] == "interrupted"
        if event["event"] == "result":
            return words, event["goal"], interruptions


def _check(goal: Message, words: list[tuple[int, int, int]], wanted: list[tuple[int, int, int]]) -> None:
    details = f"{goal}: the words {words} instead of {wanted}"
    assert goal["state"] in TERMINAL, details
    assert (goal["paused"], goal["interrupted_by"]) == (False, None), details
    assert words == wanted[: len(words)], details
    if goal["state"] == "SUCCEEDED":
        assert words == wanted, details
        assert goal["spoken_end"] == len(goal["text"]), details
        assert abs(goal["heard"] - goal["duration"]) < 0.001, details
    elif words:
        assert goal["spoken"] == goal["text"][: words[-1][2]], details


def interject(talk: Talk, rng: random.Random, over: threading.Event) -> None:
    """Interrupt whatever is spoken."""
    with talk.connect() as wire:
        while not over.wait(rng.random() * 2):
            priority = rng.choice((_PRIORITY, _PRIORITY, _PRIORITY + 1))
            text = rng.choice(("step aside", "excuse me, please", "no"))
            goal = wire.request("say", text=text, interject=True, priority=priority, rate=_RATE, wait=True)["goal"]
            if rng.random() < 0.1:
                assert wire.request("cancel", current=True)["ok"]
            elif rng.random() < 0.05:
                assert wire.request("say", text="stop", preempt=True, priority=priority, rate=_RATE)["ok"]
            while wire.receive_event("result", PATIENCE_S)["goal"]["id"] != goal["id"]:
                pass
