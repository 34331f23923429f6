"""Goals for the machine that compares the scheduler with its model: any options, and some that are always refused."""

from __future__ import annotations

from itertools import product

from hypothesis import strategies as st

from talkcli.requests import Say

BOOT = "k3fz"
MAX_TEXT = 20
TEXTS = ["door open", "battery low", "é日🤖"]
OWN_IDS = ["mine", "arm.1"]
#: Few values of each, so that goals meet; times are multiples of the clock's steps, so that they meet to the instant.
OPTIONS: dict[str, list[object]] = {
    "preempt": [True, False],
    "flush": [True],
    "priority": [1, 5, -1],
    "key": ["battery", "door"],
    "ttl": [0.5, 0.0, 3.0],
    "throttle": [10.0, 1.5, 0.0],
    "id": list(OWN_IDS),
}


def says_with(*names: str) -> st.SearchStrategy[Say]:
    """Return goals with any of these options, those with few of them first: that is where examples shrink to.

    A list to draw one from, because hypothesis takes its time for each draw.
    """
    choices = [[{}, *({name: value} for value in OPTIONS[name])] for name in names]
    options = [{name: value for each in chosen for name, value in each.items()} for chosen in product(*choices)]
    possible = [each for each in options if "flush" not in each or each.get("preempt") is not False]
    return st.sampled_from([Say(text, **each) for each in sorted(possible, key=len) for text in TEXTS])


#: Goals that are refused whatever else is so, and why; each would do harm if it were not.
BAD_SAYS = [
    (Say("", flush=True), "invalid_text"),
    (Say(" \n"), "invalid_text"),
    (Say("a\0b", preempt=True), "invalid_text"),
    (Say("\ud800", flush=True, key="battery"), "invalid_text"),
    (Say("a" * (MAX_TEXT + 1), preempt=True), "text_too_long"),
    (Say("hi", preempt=True, format="ssml"), "bad_option"),
    (Say("hi", preempt=False, flush=True), "bad_option"),
    (Say("hi", key="battery", rate=79), "bad_option"),
    (Say("hi", flush=True, ttl=-1), "bad_option"),
    (Say("hi", flush=True, priority=5, throttle=float("nan")), "bad_option"),
    (Say("hi", flush=True, id=f"{BOOT}-1"), "bad_option"),
    (Say("hi", flush=True, key="battery", voice="klingon"), "unknown_voice"),
]
