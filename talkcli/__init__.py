"""A speech server for robots, and its Python client library.

Use the library with `from talkcli import Client`. The command `talk` is in `talkcli.cli`. Modules are imported when one
of their names is first used, so that the command starts quickly.
"""

from __future__ import annotations

TYPE_CHECKING = False  # importing `typing` would delay the start of the command
if TYPE_CHECKING:
    from talkcli.client.client import Client
    from talkcli.client.goal import GoalHandle
    from talkcli.client.stream import SpeechStream
    from talkcli.fleet.api import Fleet
    from talkcli.fleet.desk.request import Outcome
    from talkcli.fleet.payloads import Presence
    from talkcli.goals.goal import Goal
    from talkcli.goals.states import State
    from talkcli.protocol.events import (
        Canceled,
        GoalInterrupted,
        PausedChanged,
        Result,
        ServerStatus,
        Snapshot,
        StateChanged,
        TextAdded,
        TextMissing,
        WordHeard,
    )

__version__ = "0.2.0"
__all__ = [
    "Canceled",
    "Client",
    "Fleet",
    "Goal",
    "GoalHandle",
    "GoalInterrupted",
    "Outcome",
    "PausedChanged",
    "Presence",
    "Result",
    "ServerStatus",
    "Snapshot",
    "SpeechStream",
    "State",
    "StateChanged",
    "TextAdded",
    "TextMissing",
    "WordHeard",
    "__version__",
]


#: Modules that define the exported names. All other names are defined in `protocol.events`.
_MODULES = {
    "Client": "client.client",
    "Fleet": "fleet.api",
    "Goal": "goals.goal",
    "GoalHandle": "client.client",
    "Outcome": "fleet.desk.request",
    "Presence": "fleet.payloads",
    "SpeechStream": "client.stream",
    "State": "goals.states",
}


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module 'talkcli' has no attribute {name!r}")
    return getattr(__import__(f"talkcli.{_MODULES.get(name, 'protocol.events')}", fromlist=[name]), name)
