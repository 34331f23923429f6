"""Text from others, made fit to be shown: it moves no cursor, forges no line, turns no direction of reading."""

from __future__ import annotations

import unicodedata

#: Controls, format characters (bidi marks and overrides, zero-width), line and paragraph separators, halves of pairs,
#: and what is not assigned.
_ESCAPED = frozenset({"Cc", "Cf", "Zl", "Zp", "Cs", "Co", "Cn"})
_SHORT = {"\n": "\\n", "\r": "\\r", "\t": "\\t", "\\": "\\\\"}


def printable(text: str, limit: int | None = None) -> str:
    """Return the text with everything that isn't plainly visible escaped, cut after `limit` characters with an …."""
    cut = text if limit is None or len(text) <= limit else text[:limit]
    if not (cut.isascii() and cut.isprintable() and "\\" not in cut):
        cut = "".join(map(_shown, cut))
    return cut if limit is None or len(text) <= limit else f"{cut}…"


def _shown(character: str) -> str:
    if character in _SHORT:
        return _SHORT[character]
    if unicodedata.category(character) not in _ESCAPED:
        return character
    code = ord(character)
    if code < 0x100:
        return f"\\x{code:02x}"
    return f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"
