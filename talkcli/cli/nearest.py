"""What was probably meant by a word that was mistyped. It knows no click, nor what the words are."""

from __future__ import annotations

from talkcli.frozen import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable


def nearest(word: str, known: Iterable[str]) -> str | None:
    """Return the one of these that was most likely meant, None where none is near."""
    import difflib

    by_name = {each.lower(): each for each in known}
    found = difflib.get_close_matches(word.lower(), by_name, n=1)
    return by_name[found[0]] if found else None
