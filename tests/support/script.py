"""The grammar with which the text of a goal, or a start, tells the scripted engine what to do.

Words of a goal's text, in any order; any other word, one that lacks its value too, is ordinary text, so that plain
sentences are spoken plainly:

| word | the engine |
| --- | --- |
| `length=SECONDS` | takes that long (0.1) |
| `words=N` | reports only the first N words of the text (all), evenly in time |
| `silent-start` | never sends `Started`, and no word |
| `at=PART` | does what the words below say after that part of the length (0.5) |
| `fail=REASON` | fails with that reason |
| `message=WORDS` | … and with that message, `_` for a blank ("scripted REASON") |
| `crash` | dies of SIGSEGV |
| `exit` or `exit=CODE` | exits without a result (0) |
| `hang` | says nothing any more, and ignores everything: stop, quit, SIGTERM, the end of its input |
| `never-ends` | goes on until it is stopped |
| `ignore-stop` | ignores stop and ends by its length; with `never-ends`, never, but shows that it is alive |
| `slow-stop=SECONDS` | ends that long after it was told to stop |
| `on-stop=crash`, `=exit`, `=hang`, `=fail`, `=complete` | does that when it is told to stop |
| `slow-pause=SECONDS` | goes on that long after it was told to pause, before it is silent |
| `stale-pause` | answers each pause but the first at once, as if it were the one before, and then as it is |
| `ignore-pause` | ignores pause and resume, and says nothing about it |
| `volume=X` | tells that it plays to the device "card", at that volume |
| `voice=ID` | tells that it speaks by that voice |
| `muted` | … and that it is muted; fails for it, where the goal is to be audible |
| `linger=SECONDS` | leaves a process that holds the pipe of `TALK_LIVENESS_FD` open so long, whatever happens |

While it is paused all that it has planned waits, and it shows that it is alive.

A start is `fail`, `fail=REASON`, `hang`, `slow`, `slow=SECONDS` (0.5), `crash` or `exit=CODE`, in the environment
variable SCRIPTED_START or, read anew by each start, in the file that SCRIPTED_START_FILE names; else it is ready at
once.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass

#: No scripted process outlives this many seconds of hanging or lingering, whatever happens to the test.
LONGEST = 30.0
_FLAGS = frozenset(
    {"silent-start", "crash", "exit", "hang", "never-ends", "ignore-stop", "stale-pause", "ignore-pause", "muted"}
)
_VALUED = frozenset(
    {
        "length",
        "words",
        "at",
        "fail",
        "message",
        "exit",
        "slow-stop",
        "on-stop",
        "slow-pause",
        "linger",
        "volume",
        "voice",
    }
)


@dataclass(frozen=True, slots=True)
class Script:
    """What a goal's text asks of the engine; see the table above."""

    text: str
    length: float = 0.1
    started: bool = True
    at: float = 0.5
    act: str | None = None  # fail, crash, exit, hang
    reason: str = "engine_failed"
    message: str | None = None
    code: int = 0
    never_ends: bool = False
    ignore_stop: bool = False
    slow_stop: float = 0.0
    on_stop: str | None = None
    slow_pause: float = 0.0
    stale_pause: bool = False
    ignore_pause: bool = False
    linger: float = 0.0
    volume: float | None = None
    voice: str | None = None
    muted: bool = False
    words: tuple[tuple[int, int], ...] = ()

    @property
    def said(self) -> str:
        """The message of a failure."""
        return self.message or f"scripted {self.reason}"


def parse(text: str) -> Script:
    """Return what a goal's text asks for."""
    asked: dict[str, str] = {}
    spans = [match.span() for match in re.finditer(r"\S+", text)]
    for start, end in spans:
        name, equals, value = text[start:end].partition("=")
        if name in (_VALUED if equals else _FLAGS):
            asked[name] = value
    count = int(_number(asked, "words", len(spans)))
    act = next((each for each in ("fail", "crash", "exit", "hang") if each in asked), None)
    return Script(
        text=text,
        length=_number(asked, "length", 0.1),
        started="silent-start" not in asked,
        at=_number(asked, "at", 0.5),
        act=act,
        reason=asked.get("fail") or "engine_failed",
        message=asked["message"].replace("_", " ") if asked.get("message") else None,
        code=int(_number(asked, "exit", 0)),
        never_ends="never-ends" in asked,
        ignore_stop="ignore-stop" in asked,
        slow_stop=_number(asked, "slow-stop", 0),
        on_stop=asked.get("on-stop"),
        slow_pause=_number(asked, "slow-pause", 0),
        stale_pause="stale-pause" in asked,
        ignore_pause="ignore-pause" in asked,
        linger=min(LONGEST, _number(asked, "linger", 0)),
        voice=asked.get("voice"),
        volume=_number(asked, "volume", 1.0) if asked.keys() & {"volume", "muted"} else None,
        muted="muted" in asked,
        words=tuple(spans[:count]) if "silent-start" not in asked else (),
    )


def _number(asked: dict[str, str], name: str, usual: float) -> float:
    """Return a number that was asked for; the usual one where it is none, as in a text that was mutated."""
    try:
        found = float(asked.get(name) or usual)
    except ValueError:
        return usual
    return found if 0 <= found < float("inf") else usual


def start() -> tuple[str, str]:
    """Return what this start shall be and its value, by the environment: ("", "") for a plain one."""
    asked = os.environ.get("SCRIPTED_START", "")
    name = os.environ.get("SCRIPTED_START_FILE")
    if name and os.path.exists(name):
        with open(name, encoding="utf-8") as file:
            asked = file.read().strip()
    what, _, value = asked.partition("=")
    return what, value
