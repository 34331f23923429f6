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


def printable_json(line: str) -> str:
    """Return a line of JSON, which stays the same JSON, with everything that isn't plainly visible escaped."""
    return line if line.isascii() and line.isprintable() else "".join(map(_escaped, line))


def _escaped(character: str) -> str:
    """Return a character of a JSON line as it is, or as JSON escapes it: none of those stands outside of a string."""
    if unicodedata.category(character) not in _ESCAPED:
        return character
    units = character.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[at]:02x}{units[at + 1]:02x}" for at in range(0, len(units), 2))


def _shown(character: str) -> str:
    if character in _SHORT:
        return _SHORT[character]
    if unicodedata.category(character) not in _ESCAPED:
        return character
    code = ord(character)
    if code < 0x100:
        return f"\\x{code:02x}"
    return f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"
