"""The parts of a text that a neural voice speaks: phonemes from libespeak-ng, with the positions of the words.

libespeak-ng returns the phonemes of each clause with blanks between words, and separately, for its own speech, the
positions of the words in the text. It joins some words ("in the") and splits others ("1,000"), so the two lists have to
be aligned. This module doesn't use the library itself: it gets a `Phonemizer`.
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

#: The most phonemes of a part. The time and memory of a model grow with their square: on a PC, 250 phonemes take 0.25 s
#: and 60 MB, and 800 take 2 s and 450 MB.
MAX_PART_PHONEMES = 250
#: The number of phonemes from which a part may also end at a comma.
_LONG_PART_PHONEMES = 150
#: The most comparisons for aligning two strings, which take up to 50 ms. It allows a clause of 1,000 phonemes;
#: libespeak-ng ends every clause after 800 bytes. Only a number of 800 digits has ten times as many phonemes, and
#: nobody can tell where a word begins in it.
_MAX_COMPARISONS = 1 << 20
#: The marks between clauses that Piper's voices know; the last three end a sentence.
PAUSE_MARKS = ",;:.!?"
#: The punctuation in texts, and the pause mark for each.
_PUNCTUATION = {
    **{each: each for each in PAUSE_MARKS},
    **dict.fromkeys("，、،", ","),
    **dict.fromkeys("；؛", ";"),
    "：": ":",
    **dict.fromkeys("。।॥։…", "."),
    "！": "!",
    **dict.fromkeys("？؟՞", "?"),
}
_SENTENCE_ENDS = ".!?"
_LAST_PUNCTUATION = re.compile(rf"[{re.escape(''.join(_PUNCTUATION))}](?=[^\w]*\Z)")
#: The mark of a change of language: "(en)hello(de)".
_LANGUAGE_MARK = re.compile(r"\([^()]*\)")


class Phonemizer(Protocol):
    """A source of the phonemes of a language: libespeak-ng with one of its voices.

    Positions are characters from 0.
    """

    def clauses(self, text: str) -> list[tuple[str, str]]:
        """Return the clauses of a text, which add up to the text, each with its phonemes in IPA."""

    def word_positions(self, clause: str) -> list[tuple[int, int]]:
        """Return the start and the length (at least 1) of each word in a clause."""

    def ends_with_abbreviation(self, clause: str) -> bool:
        """Return whether the dot at the end of a clause belongs to its last word, as in "Mr."."""


@frozen
class SpeechPart:
    """A sentence, or the part of a long sentence that a model speaks at a time."""

    #: characters of IPA, blanks and pause marks; never empty
    phonemes: tuple[str, ...]
    #: for each word: the index of its first phoneme, and its start and length in the text; the indexes never decrease
    words: tuple[tuple[int, int, int], ...]
    #: whether it ends a sentence, so that a pause follows
    ends_sentence: bool


def split_text(phonemizer: Phonemizer, text: str) -> Iterator[SpeechPart]:
    """Yield the parts of a text, or none if nothing in it can be spoken.

    The phonemizer is used only as parts are taken.
    """
    offset = 0
    pending = _PendingPart()
    for clause, ipa in phonemizer.clauses(text):
        groups = _phoneme_groups(ipa)
        clause_words = _locate_words(phonemizer, clause, groups) if groups else []
        at = 0
        if len(pending.phonemes) > _LONG_PART_PHONEMES:
            yield pending.finish(ends_sentence=False)
        for group in groups:
            inside = [each for each in clause_words if at <= each[0] < at + len(group)]
            words = [(place - at, offset + start, length) for place, start, length in inside]
            at += len(group)
            # There must be room for a blank before the group and a pause mark after it.
            if pending.phonemes and len(pending.phonemes) + 1 + len(group) >= MAX_PART_PHONEMES:
                yield pending.finish(ends_sentence=False)
            yield from pending.add(group, words)
        mark = _LAST_PUNCTUATION.search(clause) if groups else None
        last = offset + len(clause) == len(text)
        if mark is not None and (last or mark.group() != "." or not phonemizer.ends_with_abbreviation(clause)):
            pending.phonemes.append(_PUNCTUATION[mark.group()])
            if pending.phonemes[-1] in _SENTENCE_ENDS:
                yield pending.finish(ends_sentence=True)
        offset += len(clause)
    if pending.phonemes:
        yield pending.finish(ends_sentence=True)


class _PendingPart:
    """The part that is being filled."""

    def __init__(self) -> None:
        self.phonemes: list[str] = []
        self._words: list[tuple[int, int, int]] = []

    def add(self, group: str, words: Sequence[tuple[int, int, int]]) -> Iterator[SpeechPart]:
        """Add a group of phonemes with the words that begin in it, and yield parts that are full."""
        if self.phonemes:
            self.phonemes.append(" ")
        for at in range(0, len(group), MAX_PART_PHONEMES - 1):
            if at:
                yield self.finish(ends_sentence=False)
            section = group[at : at + MAX_PART_PHONEMES - 1]
            inside = [each for each in words if at <= each[0] < at + len(section)]
            self._words += [(len(self.phonemes) + place - at, start, length) for place, start, length in inside]
            self.phonemes += section

    def finish(self, *, ends_sentence: bool) -> SpeechPart:
        """Return the part, and start another one."""
        part = SpeechPart(tuple(self.phonemes), tuple(self._words), ends_sentence)
        self.phonemes, self._words = [], []
        return part


def _phoneme_groups(ipa: str) -> list[str]:
    """Return the groups of phonemes between blanks; each character of a group is a phoneme."""
    return [unicodedata.normalize("NFD", each) for each in _LANGUAGE_MARK.sub(" ", ipa).split()]


def _locate_words(phonemizer: Phonemizer, clause: str, groups: Sequence[str]) -> list[tuple[int, int, int]]:
    """Return, for each word of a clause, the index of its first phoneme, its start and its length."""
    positions = phonemizer.word_positions(clause)
    group_starts = [0, *itertools.accumulate(map(len, groups))]
    if len(positions) == len(groups):
        return [(start, *position) for start, position in zip(group_starts, positions, strict=False)]
    if not positions:  # there are phonemes, but their words are unknown
        return []
    # A word that is spelled out is reported once for each letter, always with the word's position.
    positions = _increasing(positions)
    next_starts = [*(start for start, _ in positions[1:]), len(clause)]
    # Each word is spoken alone, and the result is aligned with the phonemes of the whole clause.
    limits = zip(positions, next_starts, strict=True)
    words = [clause[start : min(start + length, next_start)] for (start, length), next_start in limits]
    alone = ["".join(itertools.chain(*(_phoneme_groups(ipa) for _, ipa in phonemizer.clauses(word)))) for word in words]
    ends = [0, *itertools.accumulate(map(len, alone))]
    found = _align("".join(alone), "".join(groups), ends[:-1])
    last = max(0, group_starts[-1] - 1)
    return [(min(start, last), *position) for start, position in zip(found, positions, strict=True)]


def _increasing(positions: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the positions that come after all previous ones."""
    found: list[tuple[int, int]] = []
    for position in positions:
        if not found or position[0] > found[-1][0]:
            found.append(position)
    return found


def _align(first: str, second: str, places: Sequence[int]) -> list[int]:
    """Return the places in the second string that correspond to places in the similar first string."""
    if len(first) * len(second) > _MAX_COMPARISONS:
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
