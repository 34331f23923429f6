"""What a text must be to be spoken: pure checks, before a goal is queued.

Whether a synthesiser finds something to say in it is another question, which only the engine can answer.
"""

from __future__ import annotations

import unicodedata

from talkcli.goals.options import MAX_BYTES, MAX_CHARACTERS
from talkcli.goals.reasons import Reason, Refusal

#: Categories that make no sound by themselves: separators, controls, format characters such as the zero-width space,
#: and code points that are not assigned or private.
_SILENT = frozenset({"Zs", "Zl", "Zp", "Cc", "Cf", "Cn", "Co"})


def fault(text: str, max_characters: int | None = MAX_CHARACTERS) -> Refusal | None:
    """Return the reason and the words for people why this text can't be a goal, or None if it can.

    `max_characters`: None for one that is no goal, and may have any length.
    """
    if max_characters is not None and len(text) > max_characters:
        return Reason.TEXT_TOO_LONG, f"the text has {len(text):,} characters, the longest allowed is {max_characters:,}"
    try:
        size = len(text.encode())
    except UnicodeEncodeError as error:
        words = f"character {error.start + 1} of the text is half of a surrogate pair: it is not valid UTF-8"
        return Reason.INVALID_TEXT, words
    if max_characters is not None and size > MAX_BYTES:
        return Reason.TEXT_TOO_LONG, f"the text has {size:,} bytes, the longest allowed is {MAX_BYTES:,}"
    if "\0" in text:
        return Reason.INVALID_TEXT, f"character {text.index(chr(0)) + 1} of the text is NUL"
    if all(unicodedata.category(each) in _SILENT for each in text):
        return Reason.INVALID_TEXT, "the text is empty" if not text.strip() else "the text has nothing that can be seen"
    return None
