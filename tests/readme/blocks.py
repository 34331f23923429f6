"""The documents' examples by name: each block of code, and which test runs it.

A name is the heading that the block stands under, with the bold words that begin the paragraph before it, and a number
from the second one on: "A tour: Speak", "Start #2". So an example that is added has a name that no test has.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, TypeVar

from tests.support.documents import DOCUMENTS

if TYPE_CHECKING:
    from collections.abc import Callable

_F = TypeVar("_F", bound="Callable[..., object]")
_PARTS = re.compile(
    r"^```(?P<language>\w+)\n(?P<code>.*?)^```$|^#+ (?P<heading>[^\n]+)$|^(?:- )?\*\*(?P<lead>[^\n]+?)[.,]?\*\*",
    re.MULTILINE | re.DOTALL,
)


def _blocks() -> dict[str, tuple[str, str]]:
    blocks: dict[str, tuple[str, str]] = {}
    heading, lead = "", ""
    for part in (part for document in DOCUMENTS for part in _PARTS.finditer(document.text)):
        if part["heading"]:
            heading, lead = part["heading"].replace("`", ""), ""
        elif part["lead"]:
            lead = f": {part['lead']}"
        else:
            name = f"{heading}{lead}"
            number = 1 + sum(existing == name or existing.startswith(f"{name} #") for existing in blocks)
            blocks[name if number == 1 else f"{name} #{number}"] = part["language"], part["code"]
    return blocks


#: The language and the text of each block, by its name.
BLOCKS = _blocks()
#: Which test runs a block: filled by `runs`.
RUN: dict[str, str] = {}


def block(name: str) -> str:
    """Return the text of a block."""
    assert name in BLOCKS, f"no document has {name!r}; they have: {', '.join(BLOCKS)}"
    return BLOCKS[name][1]


def commands(name: str) -> list[str]:
    """Return the commands of a block of which each stands on a line of its own, without the notes beside them."""
    lines = (re.sub(r"(^|\s)#\s.*$", "", line).strip() for line in block(name).splitlines())
    return [line for line in lines if line]


def runs(*names: str) -> Callable[[_F], _F]:
    """Mark a test as the one that runs these blocks."""

    def mark(test: _F) -> _F:
        for name in names:
            block(name)
            RUN[name] = f"{test.__module__}.{test.__name__}"
        return test

    return mark
