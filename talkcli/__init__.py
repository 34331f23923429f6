"""talk: speech for robots with action semantics and no robot middleware.

`from talkcli import Client` is the library; the command `talk` is `talkcli.cli`. Nothing is imported here before it is
asked for, because every start of the command pays for it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from talkcli.client import Client as Client
    from talkcli.client import GoalHandle as GoalHandle

__version__ = "0.1.0"
__all__ = ["Client", "GoalHandle", "__version__"]


def __getattr__(name: str) -> object:
    if name in {"Client", "GoalHandle"}:
        from talkcli import client

        return getattr(client, name)
    raise AttributeError(f"module 'talkcli' has no attribute {name!r}")
