"""What makes sound of a text: libespeak-ng, neural voices; here the names of `talk`'s own synthesizers.

`base` has what a synthesizer does and may raise: a new one is a module here and a line of the table, and goes through
`tests/engine/test_synthesizer_contract.py`. It may import the players and the engine's own small parts. It runs in the
engine process alone, which may die of it; the table loads none of them.
"""

from __future__ import annotations

import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable

    from talkcli.engine.child.synthesizers.choice import Choice


def _espeak() -> Choice:
    from talkcli.engine.child.synthesizers.choice import Choice
    from talkcli.engine.child.synthesizers.espeak import Espeak

    return Choice(Espeak())


#: The synthesizers, the usual one first: what makes each, by what users call it. It stands in for a driver of pyttsx3's
#: of that name.
SYNTHESIZERS: dict[str, Callable[[], Choice]] = {"espeak": _espeak}


def is_own(driver: str | None) -> bool:
    """Tell whether a driver is `talk`'s own, which plays through a player; others play by themselves."""
    return sys.platform.startswith("linux") and driver in (None, *SYNTHESIZERS)
