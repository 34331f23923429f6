"""The words in the text of a goal, or of a start, that tell the scripted engine what to do.

The words of a goal may come in any order. All other words, and words without their value, are ordinary text:

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
| `hang` | sends nothing more, and ignores stop, quit, SIGTERM and the end of its input |
| `never-ends` | goes on until it is stopped |
| `ignore-stop` | ignores stop and ends after its length, with `never-ends` never, but shows that it is alive |
| `slow-stop=SECONDS` | ends that long after it was told to stop |
| `on-stop=crash`, `=exit`, `=hang`, `=fail`, `=complete` | does that when it is told to stop |
| `slow-pause=SECONDS` | is silent that long after it was told to pause |
| `stale-pause` | first answers each pause but the first with the number of the pause before it |
| `ignore-pause` | ignores pause and resume |
| `volume=X` | reports that it plays to the device "card", at that volume |
| `muted` | … and that it is muted, and fails if the goal is to be audible |
| `voice=ID` | reports that voice |
| `linger=SECONDS` | leaves a process that holds the pipe of `TALK_LIVENESS_FD` open so long |

The words of a text that grows are spoken in the same way: those that are complete take the length, and so do those that
were added meanwhile. Then the engine reports that text is missing, or ends the goal if the text has ended.

A pause delays everything that is planned, and meanwhile the engine shows that it is alive.

A start is `fail`, `fail=REASON`, `hang`, `slow`, `slow=SECONDS` (0.5), `crash` or `exit=CODE`. It comes from the file
that SCRIPTED_START_FILE names, or from the variable SCRIPTED_START.
"""

from __future__ import annotations

import os
import re

#: No scripted process hangs or lingers for more seconds than this.
LONGEST = 30.0
_FLAGS = frozenset(
    {"silent-start", "crash", "exit", "hang", "never-ends", "ignore-stop", "stale-pause", "ignore-pause", "muted"}
)
_VALUED = frozenset(
    {
        *("length", "words", "at", "fail", "message", "exit", "slow-stop", "on-stop", "slow-pause", "linger"),
        *("volume", "voice"),
    }
)


class Script:
    """The words of a goal's text; see the table above."""

    def __init__(self, text: str) -> None:
        self._asked: dict[str, str] = {}
        #: the start and the end of each word
        self.spans = [match.span() for match in re.finditer(r"\S+", text)]
        for start, end in self.spans:
            name, equals, value = text[start:end].partition("=")
            if name in (_VALUED if equals else _FLAGS):
                self._asked[name] = value

    def __contains__(self, name: str) -> bool:
        return name in self._asked

    def text(self, name: str) -> str:
        """Return a value, "" if it is missing."""
        return self._asked.get(name, "")

    def number(self, name: str, default: float = 0.0) -> float:
        """Return a value as a number, or the default if it is missing or wrong."""
        try:
            found = float(self._asked.get(name) or default)
        except ValueError:
            return default
        return found if 0 <= found < float("inf") else default

    @property
    def act(self) -> str | None:
        """The first of these words, if there is one."""
        return next((each for each in ("fail", "crash", "exit", "hang") if each in self), None)


def start() -> tuple[str, str]:
    """Return the behaviour of this start and its value, ("", "") for a plain start."""
    asked = os.environ.get("SCRIPTED_START", "")
    name = os.environ.get("SCRIPTED_START_FILE")
    if name and os.path.exists(name):
        with open(name, encoding="utf-8") as file:
            asked = file.read().strip()
    what, _, value = asked.partition("=")
    return what, value
