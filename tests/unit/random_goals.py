"""Goals for the machine that compares the scheduler with its model: any options, and some that are always refused."""

from __future__ import annotations

from itertools import product
from typing import Any

from hypothesis import strategies as st

BOOT = "4k7f"
MAX_TEXT = 20
Fields = dict[str, Any]

TEXTS = ["door open", "battery low", "é日🤖"]
OWN_IDS = ["mine", "arm.1"]
#: Few values of each, so that goals meet; times are multiples of the clock's steps, so that they meet to the instant.
OPTIONS: dict[str, list[Any]] = {
    "preempt": [True, False],
    "flush": [True],
    "priority": [1, 5, -1],
    "key": ["battery", "door"],
    "ttl": [0.5, 0.0, 3.0],
    "throttle": [10.0, 1.5, 0.0],
    "id": list(OWN_IDS),
    "voice": ["piper/joe", "piper/amy#2"],
    "voice_only": [True],
}


def says_with(*names: str) -> st.SearchStrategy[Fields]:
    """Return fields of goals with any of these options, few of them first: that is where examples shrink to.

    A list to draw one from, because hypothesis takes its time for each draw; fields, because they are short to read in
    the sequence that it prints.
    """
    choices: list[list[dict[str, Any]]] = [[{}, *({name: value} for value in OPTIONS[name])] for name in names]
    options = [{name: value for each in chosen for name, value in each.items()} for chosen in product(*choices)]
    possible = [each for each in options if "flush" not in each or each.get("preempt") is not False]
    return st.sampled_from([{"text": text} | each for each in sorted(possible, key=len) for text in TEXTS])


#: Goals that are refused whatever else is so, and why; each would do harm if it were not.
BAD_SAYS: list[tuple[Fields, str]] = [
    ({"text": "", "flush": True}, "invalid_text"),
    ({"text": " \n"}, "invalid_text"),
    ({"text": "a\0b", "preempt": True}, "invalid_text"),
    ({"text": "\ud800", "flush": True, "key": "battery"}, "invalid_text"),
    ({"text": "a" * (MAX_TEXT + 1), "preempt": True}, "text_too_long"),
    ({"text": "hi", "preempt": True, "format": "ssml"}, "bad_option"),
    ({"text": "hi", "preempt": False, "flush": True}, "bad_option"),
    ({"text": "hi", "key": "battery", "rate": 79}, "bad_option"),
    ({"text": "hi", "flush": True, "ttl": -1}, "bad_option"),
    ({"text": "hi", "flush": True, "priority": 5, "throttle": float("nan")}, "bad_option"),
    ({"text": "hi", "flush": True, "id": f"{BOOT}-1"}, "bad_option"),
    ({"text": "hi", "flush": True, "key": "battery", "voice": "klingon"}, "unknown_voice"),
]
