"""What may be asked of a goal: ranges of its options, the form of its id. Pure checks, the same for client and server.

What depends on the other goals (a full queue, a throttle) is the scheduler's business, what a text must be is `text`'s.
"""

from __future__ import annotations

import re
import sys

from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.requests import MAX_ID

if TYPE_CHECKING:
    from talkcli.goals.requests import Say, Set

#: Words per minute: what libespeak-ng takes.
RATES = (80, 450)
VOLUMES = (0.0, 1.0)
#: 50 is the voice's own pitch.
PITCHES = (0, 100)
#: Far more than anybody needs, and a number that every language's JSON reader holds exactly.
MAX_PRIORITY = 1_000_000
#: A key is a label, shown on one line.
MAX_KEY = 64

#: What stands for the driver's own voice, where a voice is named.
DEFAULT_VOICE = "default"

_ID = re.compile(rf"[A-Za-z0-9._:/][A-Za-z0-9._:/-]{{0,{MAX_ID - 1}}}")
#: A boot id and a number. Digits first and third: so nobody names a goal (`goal-1`, `2024-12`).
_SERVERS_ID = re.compile(r"[0-9][a-z][0-9][a-z]-[0-9]+")


def is_clients_id(goal_id: str) -> bool:
    """Whether this is an id as a client may choose it: no server ever gives one of this form."""
    servers = goal_id.isdecimal() or _SERVERS_ID.fullmatch(goal_id)
    return bool(_ID.fullmatch(goal_id)) and not servers


def bad_option(say: Say) -> str | None:
    """Return what is wrong with a goal's options, for people, or None."""
    if say.format != "text":
        return f"the format {say.format[:MAX_ID]!r} is not known, only 'text'"
    if say.flush and say.preempt is False:
        return "flush preempts: it can't be had together with preempt false"
    if abs(say.priority) > MAX_PRIORITY:
        return f"the priority {say.priority} is not within {-MAX_PRIORITY} to {MAX_PRIORITY}"
    if say.key is not None and not 0 < len(say.key) <= MAX_KEY:
        return f"a key has 1 to {MAX_KEY} characters, this one has {len(say.key)}"
    if say.id is not None and not is_clients_id(say.id):
        return (
            f"the id {say.id[:MAX_ID]!a} is not one that a sender may choose: 1 to {MAX_ID} of A-Z a-z 0-9 . _ : / -, "
            "no '-' in front, not digits alone, and not of the form of a server's own, 4k7f-12"
        )
    return _bad_seconds("throttle", say.throttle) or bad_setting(say)


def bad_setting(settings: Say | Set) -> str | None:
    """Return what is wrong with rate, volume, pitch or ttl, for people, or None."""
    return (
        _outside("rate", settings.rate, RATES, " words per minute")
        or _outside("volume", settings.volume, VOLUMES, "")
        or _outside("pitch", settings.pitch, PITCHES, "")
        or _bad_seconds("ttl", settings.ttl)
        or ("the voice is empty" if settings.voice == "" else None)
    )


def _outside(name: str, value: float | None, limits: tuple[float, float], unit: str) -> str | None:
    # Written so that NaN, which compares with nothing, is outside.
    if value is None or limits[0] <= value <= limits[1]:
        return None
    return f"the {name} {value} is not within {limits[0]:g} to {limits[1]:g}{unit}"


def _bad_seconds(name: str, value: float | None) -> str | None:
    # Written so that NaN is refused, and an integer that is past every float.
    if value is None or 0 <= value <= sys.float_info.max:
        return None
    return f"the {name} {value} is no number of seconds from 0 on"
