"""Features of the protocol that not every server supports.

The server's greeting contains their names. A client that needs a feature checks for its name, and fails at once if the
name is missing. Otherwise, an older server would refuse the request with a message about an unknown field or value.
"""

from __future__ import annotations

from talkcli.frozen import TYPE_CHECKING, frozen

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from talkcli.goals.goal import JsonObject


@frozen
class Feature:
    """A feature of the protocol that older servers lack."""

    #: the feature's name in error messages, for example "growing texts"
    name: str
    #: function that returns whether a request needs the feature
    is_needed: Callable[[JsonObject], bool]


#: All features, by name. Never remove one.
FEATURES = {
    "append": Feature("growing texts", lambda request: request.get("more") is True),
    "markdown": Feature("Markdown", lambda request: request.get("format") == "markdown"),
}


def missing_features(request: JsonObject, available: Collection[str]) -> list[str]:
    """Return the names of the features that a request needs and the server lacks."""
    return [name for name, each in FEATURES.items() if name not in available and each.is_needed(request)]
