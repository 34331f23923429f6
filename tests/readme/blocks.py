"""The examples of the documents by name, and the tests that run them.

A name consists of the heading, the bold words at the start of the paragraph before the block, and a number from the
second block on: "A tour: Speak", "Start #2". A new example has a new name, so a test fails until it is run.
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


#: The language and the text of each block by its name.
BLOCKS = _blocks()
#: The test that runs each block, filled by `runs`.
RUN: dict[str, str] = {}


def block(name: str) -> str:
    """Return the text of a block."""
    assert name in BLOCKS, f"no document has the example {name!r}; the examples are: {', '.join(BLOCKS)}"
    return BLOCKS[name][1]


def commands(name: str) -> list[str]:
    """Return the commands of a block, which has one command per line, without comments."""
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
