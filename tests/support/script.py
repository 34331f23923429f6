"""The words that control the scripted engine, in the texts of goals and for its starts.

The words in a goal's text can be in any order. All other words, and words without their value, are ordinary text.
Defaults are in parentheses:

| word | the engine |
| --- | --- |
| `length=SECONDS` | speaks for this time (0.1) |
| `words=N` | reports only the first N words of the text (all), at equal intervals |
| `silent-start` | doesn't send `Started` or any words |
| `at=PART` | performs one of the next four actions after this part of the length (0.5) |
| `fail=REASON` | fails with this reason |
| `crash` | crashes with SIGSEGV |
| `exit` or `exit=CODE` | exits without a result (0) |
| `hang` | sends nothing more, and ignores stop, quit, SIGTERM and the end of its input |
| `message=WORDS` | uses this message for a failure, with `_` for blanks ("scripted REASON") |
| `never-ends` | speaks until it is stopped |
| `ignore-stop` | ignores stop, and ends after its length (with `never-ends` never), but sends signs of life |
| `slow-stop=SECONDS` | takes this time to stop |
| `on-stop=crash`, `=exit`, `=hang`, `=fail`, `=complete` | performs this action instead of stopping |
| `slow-pause=SECONDS` | takes this time to pause |
| `stale-pause` | confirms the previous pause again before it confirms a pause |
| `ignore-pause` | ignores pause and resume |
| `volume=X` | reports that it plays to the device "card" at this volume |
| `muted` | reports that the output is muted, and fails if the goal must be audible |
| `voice=ID` | reports this voice |
| `linger=SECONDS` | starts a process that holds the pipe of `TALK_LIVENESS_FD` open for this time |

The words of a growing text are spoken in the same way. All words that are complete take the length together, and so do
the words that were added in the meantime. Then the engine reports that text is missing, or ends the goal if the text
has ended.

A pause delays all planned actions. During a pause, the engine sends signs of life.

A start can be `fail`, `fail=REASON`, `hang`, `slow`, `slow=SECONDS` (0.5), `crash` or `exit=CODE`. It is read from the
file that SCRIPTED_START_FILE names, or from the variable SCRIPTED_START.
"""

from __future__ import annotations

import os
import re

#: Longest time for which a scripted process hangs or lingers, in seconds.
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
    """The words in a goal's text (see the table above)."""

    def __init__(self, text: str) -> None:
        self._values: dict[str, str] = {}
        #: start and end of each word
        self.spans = [match.span() for match in re.finditer(r"\S+", text)]
        for start, end in self.spans:
            name, equals, value = text[start:end].partition("=")
            if name in (_VALUED if equals else _FLAGS):
                self._values[name] = value

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def text(self, name: str) -> str:
        """Return a value, or "" if it is missing."""
        return self._values.get(name, "")

    def number(self, name: str, default: float = 0.0) -> float:
        """Return a value as a number, or the default if it is missing or invalid."""
        try:
            value = float(self._values.get(name) or default)
        except ValueError:
            return default
        return value if 0 <= value < float("inf") else default

    @property
    def act(self) -> str | None:
        """The action of this goal: "fail", "crash", "exit", "hang" or None."""
        return next((action for action in ("fail", "crash", "exit", "hang") if action in self), None)


def start() -> tuple[str, str]:
    """Return the behaviour of this start and its value, or ("", "") for a normal start."""
    behaviour = os.environ.get("SCRIPTED_START", "")
    path = os.environ.get("SCRIPTED_START_FILE")
    if path and os.path.exists(path):
        with open(path, encoding="utf-8") as file:
            behaviour = file.read().strip()
    name, _, value = behaviour.partition("=")
    return name, value
