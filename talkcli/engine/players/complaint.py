"""What a player says on standard error: keeps the one line that names the error.

Pure: bytes go in as they come, one readable line comes out. A player can talk for hours (underruns), so only the line
that is wanted is kept. It is not the last one, as after the error a player may dump its parameters. The patterns are
compiled when a player says something, and not at the start of each engine process: they take 1 ms.
"""

from __future__ import annotations

import re

from talkcli.splitter import LineSplitter

#: Bytes of one line that are kept; error lines are shorter, and a message must stay readable.
LONGEST_LINE = 300

#: What is no error, or none that a user can read: the library's chatter around it, gaps in the sound, and what was
#: meant kindly.
_NOISE = (
    r"ALSA lib |underrun|overrun|Playing |Warning:|please, try |Stream (suspended|successfully|started)|^Got signal"
)
_ERROR = (
    r"error|fail|cannot|can't|could ?n[o']t|unable|no such|not found|not available|refused|denied|invalid|unknown"
    r"|disconnected|busy|broken|terminated|killed|lost"
)
#: `aplay: main:831: text`: function and line mean nothing to a user.
_PLACE = r"^(?P<program>[^\s:]+): \w+:\d+: "


class Complaint:
    """The line of a player's standard error that names the error."""

    def __init__(self) -> None:
        self._lines = LineSplitter(LONGEST_LINE)
        self._named: str | None = None
        self._first: str | None = None

    def feed(self, data: bytes) -> None:
        """Take what the player wrote."""
        for line in self._lines.feed(data):
            self._look(line)

    def line(self) -> str | None:
        """Return the line that names the error, None if nothing was said that could."""
        self._look(self._lines.end())
        return self._named or self._first

    def _look(self, raw: bytes) -> None:
        line = raw.decode("utf-8", "replace").strip()
        if not line or re.search(_NOISE, line, re.IGNORECASE):
            return
        line = re.sub(_PLACE, r"\g<program>: ", line)
        if self._named is None and re.search(_ERROR, line, re.IGNORECASE):
            self._named = line
        if self._first is None:
            self._first = line
