"""Which robots of a fleet `--robot` means: one by its name, those that a glob matches, those of a group. Pure."""

from __future__ import annotations

import re
from fnmatch import translate

from talkcli.fleet import topics
from talkcli.frozen import TYPE_CHECKING

if TYPE_CHECKING:
    from talkcli.fleet.presence import Presence

#: What stands before a group's name, and the characters of which one makes a glob of a name.
_GROUP, _GLOB = "@", "*?["
#: What may stand in a glob that some name can match: the characters of names, and those of globs.
_OF_GLOBS = re.compile(r"[A-Za-z0-9._*?\[\]!-]+")


def several(text: str) -> bool:
    """Whether this may mean more than one robot: a glob or a group."""
    return text.startswith(_GROUP) or any(each in text for each in _GLOB)


class Selection:
    """What `--robot` picks out of all robots."""

    def __init__(self, text: str) -> None:
        """`text`: a name, a glob (`*`, `?`, `[abc]`, as in a shell), or `@GROUP`; `@all` is everybody."""
        self.text = text
        #: the group that it names, None where it names none
        self.group = text.removeprefix(_GROUP) if text.startswith(_GROUP) else None
        #: the robot that it names, None where it may mean several
        self.only = None if several(text) else text
        self._glob = re.compile(translate(text)) if self.group is None and several(text) else None

    @property
    def fault(self) -> str | None:
        """What is wrong with it, for people; None where it can pick a robot."""
        if self.group is not None:
            fault = topics.fault(self.group)
            return fault and f"no group can be called '{self.group}': a name {fault}"
        if self.only is not None:
            fault = topics.fault(self.only)
            return fault and f"no robot can be called '{self.only}': a name {fault}"
        if not _OF_GLOBS.fullmatch(self.text) or _is_open(self.text):
            return f"the glob '{self.text}' matches no robot's name: it has A-Z a-z 0-9 . _ - with *, ? and [ ] alone"
        return None

    def picks(self, presence: Presence) -> bool:
        """Whether this robot is one of them, be it there or not."""
        if self.group is not None:
            return self.group == topics.EVERYBODY or self.group in presence.groups
        if self._glob is not None:
            return self._glob.match(presence.name) is not None
        return self.text == presence.name


def _is_open(glob: str) -> bool:
    """Whether a bracket of a glob is not closed, so that it stands for itself."""
    return "[" in re.sub(r"\[!?[^]]+\]", "", glob)
