"""Features of the protocol that not every server supports.

The server's greeting contains their names. A client that needs a feature checks for its name, and fails at once if the
name is missing. Otherwise, an older server would refuse the request with a message about an unknown field or value.
"""

from __future__ import annotations

from talkcli.frozen import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Collection

    from talkcli.goals.goal import JsonObject


#: All features. Each entry has a name for error messages, and the field and the value of requests that need the
#: feature. The value None stands for any value. Never remove a feature.
FEATURES: dict[str, tuple[str, str, object]] = {
    "append": ("growing texts", "more", True),
    "dry_run": ("dry runs", "dry_run", True),
    "history": ("filters of the log", "history", True),
    "interject": ("interjections", "interject", True),
    "markdown": ("Markdown", "format", "markdown"),
    "sound": ("sounds", "format", "sound"),
    "sounds": ("lists of sounds", "request", "sounds"),
    "timed_pauses": ("pauses that end", "seconds", None),
}


def missing_features(request: JsonObject, available: Collection[str]) -> list[str]:
    """Return the names of the features that a request needs and the server lacks."""
    needed = (name for name, (_, key, value) in FEATURES.items() if key in request and value in (None, request[key]))
    return [each for each in needed if each not in available]
