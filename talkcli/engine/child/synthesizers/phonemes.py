"""A text as a neural voice takes it: sentence by sentence, as the sounds that libespeak-ng has for it, with its words.

The library says the sounds of each clause, with blanks between words, and of its own voice where in the text each word
is. It speaks several words as one ("in the") and one as several ("1,000"), so the two are laid side by side. Who has
the library is handed in, so that the rest is what it is without one.
"""

from __future__ import annotations

import bisect
import itertools
import re
import unicodedata

from talkcli.frozen import TYPE_CHECKING, frozen

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from typing import Protocol
else:
    Protocol = object

#: The most sounds of a piece. What a model needs for them grows with their square: on a PC 250 take 0.25 s and 60 MB
#: beside the model, 800 take 2 s and 450 MB.
LONGEST = 250
#: The most pairs of sounds that are compared to lay two strings side by side, which takes up to 50 ms: those of a
#: clause of 1,000 sounds, as the library never makes a clause of more than 800 bytes. In a number of 800 digits, which
#: has ten times as many, nobody can tell where a word begins.
_COMPARED = 1 << 20
#: Sounds after which a piece may end at a comma, too.
_LONG = 150
#: What ends a clause in Piper's voices; behind the last three ends a sentence.
STOPS = ",;:.!?"
#: What ends one in a text, by what of these it is.
_STOPS = {
    **{each: each for each in STOPS},
    **dict.fromkeys("，、،", ","),
    **dict.fromkeys("；؛", ";"),
    "：": ":",
    **dict.fromkeys("。।॥։…", "."),
    "！": "!",
    **dict.fromkeys("？؟՞", "?"),
}
_ENDS = ".!?"
_STOP = re.compile(rf"[{re.escape(''.join(_STOPS))}](?=[^\w]*\Z)")
#: The mark of another language around a word: "(en)hello(de)".
_SWITCH = re.compile(r"\([^()]*\)")


class Speller(Protocol):
    """What knows the sounds of a language: libespeak-ng with one of its voices. Places are characters from 0."""

    def clauses(self, text: str) -> list[tuple[str, str]]:
        """Return the clauses of a text, which are the text when they are joined, each with its sounds in IPA."""

    def places(self, clause: str) -> list[tuple[int, int]]:
        """Return where the words of a clause begin, and how long they are there, 1 or more."""

    def abbreviates(self, clause: str) -> bool:
        """Tell whether the dot at the end of a clause belongs to its last word, as that of "Mr."."""


@frozen
class Piece:
    """A sentence, or as much of one as is spoken at once."""

    #: characters of IPA, a stop and blanks among them; never none
    sounds: tuple[str, ...]
    #: where among the sounds a word begins, where in the text, and its length there; where it begins never decreases
    words: tuple[tuple[int, int, int], ...]
    #: whether a sentence ends with it, so that a pause follows
    ends: bool


def pieces(speller: Speller, text: str) -> Iterator[Piece]:
    """Yield the pieces of a text; none where nothing in it has a sound. The speller is asked as they are taken."""
    offset = 0
    begun = _Begun()
    for clause, said in speller.clauses(text):
        groups = _groups(said)
        if len(begun.sounds) > _LONG:
            yield begun.piece(ends=False)
        for group, words in _spoken(speller, clause, groups, offset):
            # A blank goes between them, and a stop may follow.
            if begun.sounds and len(begun.sounds) + 1 + len(group) >= LONGEST:
                yield begun.piece(ends=False)
            yield from begun.add(group, words)
        stop = _STOP.search(clause) if groups else None
        last = offset + len(clause) == len(text)
        if stop is not None and (last or stop.group() != "." or not speller.abbreviates(clause)):
            begun.sounds.append(_STOPS[stop.group()])
            if begun.sounds[-1] in _ENDS:
                yield begun.piece(ends=True)
        offset += len(clause)
    if begun.sounds:
        yield begun.piece(ends=True)


class _Begun:
    """The piece that is being put together."""

    def __init__(self) -> None:
        self.sounds: list[str] = []
        self._words: list[tuple[int, int, int]] = []

    def add(self, group: str, words: Sequence[tuple[int, int, int]]) -> Iterator[Piece]:
        """Add sounds that are spoken as one, with the words that begin among them; yield what is full before that."""
        if self.sounds:
            self.sounds.append(" ")
        for at in range(0, len(group), LONGEST - 1):
            if at:
                yield self.piece(ends=False)
            part = group[at : at + LONGEST - 1]
            inside = [each for each in words if at <= each[0] < at + len(part)]
            self._words += [(len(self.sounds) + place - at, start, length) for place, start, length in inside]
            self.sounds += part

    def piece(self, *, ends: bool) -> Piece:
        """Return it, and begin another."""
        piece = Piece(tuple(self.sounds), tuple(self._words), ends)
        self.sounds, self._words = [], []
        return piece


def _groups(said: str) -> list[str]:
    """Return the sounds of a clause by what is spoken as one, a character each."""
    return [unicodedata.normalize("NFD", each) for each in _SWITCH.sub(" ", said).split()]


def _spoken(
    speller: Speller, clause: str, groups: Sequence[str], offset: int
) -> Iterator[tuple[str, list[tuple[int, int, int]]]]:
    """Yield each group with the words that begin in it: where among its sounds, where in the text, and their length."""
    begins = _beginnings(speller, clause, groups) if groups else []
    at = 0
    for group in groups:
        inside = [each for each in begins if at <= each[0] < at + len(group)]
        yield group, [(place - at, offset + start, length) for place, start, length in inside]
        at += len(group)


def _beginnings(speller: Speller, clause: str, groups: Sequence[str]) -> list[tuple[int, int, int]]:
    """Return of each word of a clause which of its sounds it begins with, where it is in the clause, and its length."""
    places = speller.places(clause)
    starts = [0, *itertools.accumulate(map(len, groups))]
    if len(places) == len(groups):
        return [(start, *place) for start, place in zip(starts, places, strict=False)]
    if not places:  # it has sounds, and nobody says of which word
        return []
    places = _forward(places)
    nexts = [*(start for start, _ in places[1:]), len(clause)]
    alone = [
        _alone(speller, clause[start : min(start + length, after)])
        for (start, length), after in zip(places, nexts, strict=True)
    ]
    ends = [0, *itertools.accumulate(map(len, alone))]
    found = _side_by_side("".join(alone), "".join(groups), ends[:-1])
    last = max(0, starts[-1] - 1)
    return [(min(start, last), *place) for start, place in zip(found, places, strict=True)]


def _forward(places: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the places that are behind those before: of a word that it spells the library tells one for each letter.

    It is the word's, again and again.
    """
    found: list[tuple[int, int]] = []
    for place in places:
        if not found or place[0] > found[-1][0]:
            found.append(place)
    return found


def _alone(speller: Speller, word: str) -> str:
    return "".join("".join(_groups(said)) for _, said in speller.clauses(word))


def _side_by_side(first: str, second: str, places: Sequence[int]) -> list[int]:
    """Return where in the second string is what is at these places of the first, which is much like it."""
    if len(first) * len(second) > _COMPARED:
        return [place * len(second) // len(first) for place in places]
    import difflib

    blocks = difflib.SequenceMatcher(None, first, second, autojunk=False).get_matching_blocks()
    begins = [each.a for each in blocks]
    found = []
    for place in places:
        number = bisect.bisect_right(begins, place) - 1
        if number < 0:
            found.append(0)
        else:
            block = blocks[number]
            found.append(block.b + min(place - block.a, block.size))
    return found
