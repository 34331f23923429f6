"""Pieces of a text that is too long to be given to an engine at once. Pure."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from talkcli.goals.options import MAX_CHARACTERS

if TYPE_CHECKING:
    from collections.abc import Iterator

#: Characters of a piece, as many as a goal may have: the engine says nothing while it prepares them.
LONGEST = MAX_CHARACTERS
#: Where a text may be cut and sounds as if it were whole: behind the end of a sentence, or of a line.
_SENTENCE_END = re.compile(r"""[.!?…]["')\]»”’]*\s+|[。！？।]|\n\s*""")
_BLANK = re.compile(r"\s+")


def pieces(text: str) -> Iterator[str]:
    """Cut a text into pieces that are not too long, and that are the text when they are joined."""
    start = 0
    while len(text) - start > LONGEST:
        end = start + LONGEST
        for where in (_SENTENCE_END, _BLANK):
            ends = [each.end() for each in where.finditer(text, start, end)]
            if ends:
                end = ends[-1]
                break
        yield text[start:end]
        start = end
    yield text[start:]
