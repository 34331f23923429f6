"""The split of a text into parts for a neural voice, with phonemes from libespeak-ng and the positions of words.

libespeak-ng returns the phonemes of each clause with blanks between words. When it speaks the clause, it reports the
positions of the words in the text. These two lists have to be aligned, because some words are joined in the phonemes
("in the") and others are split ("1,000"). This module doesn't use the library itself, but a `Phonemizer`.
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

#: The maximum number of phonemes in a part. The time and memory that a model needs grow with their square. On a PC, 250
#: phonemes take 0.25 s and 60 MB, and 800 phonemes take 2 s and 450 MB.
MAX_PART_PHONEMES = 250
#: The maximum number of phonemes in a part without the pause mark at its end.
_MAX_SECTION_PHONEMES = MAX_PART_PHONEMES - 1
#: The number of phonemes after which a part may also end at a comma.
_LONG_PART_PHONEMES = 150
#: The maximum number of comparisons for aligning two strings, which take up to 50 ms. This is enough for a clause of
#: 1,000 phonemes, and libespeak-ng ends every clause after 800 bytes. Only a number of 800 digits has ten times as many
#: phonemes, and nobody can tell where a word begins in it.
_MAX_COMPARISONS = 1 << 20
#: The marks between clauses that Piper's voices know. The last three end a sentence.
PAUSE_MARKS = ",;:.!?"
#: The pause mark for each punctuation character in a text.
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
#: A change of language in phonemes: "(en)hello(de)".
_LANGUAGE_MARK = re.compile(r"\([^()]*\)")


class Phonemizer(Protocol):
    """Returns the phonemes of a language, as libespeak-ng does with one of its voices.

    Positions are characters from 0.
    """

    def clauses(self, text: str) -> list[tuple[str, str]]:
        """Return the clauses of a text, each with its phonemes in IPA; joined, the clauses are the text."""

    def word_positions(self, clause: str) -> list[tuple[int, int]]:
        """Return the start and the length (at least 1) of each word in a clause."""

    def ends_with_abbreviation(self, clause: str) -> bool:
        """Return whether the dot at the end of a clause belongs to its last word, as in "Mr."."""


@frozen
class SpeechPart:
    """A sentence, or a part of a long sentence, that a model speaks in one run."""

    #: characters of IPA, blanks and pause marks; never empty
    phonemes: tuple[str, ...]
    #: the index of each word's first phoneme (never decreasing), with the word's start and length in the text
    words: tuple[tuple[int, int, int], ...]
    #: whether the part ends a sentence, so that a pause follows
    ends_sentence: bool


def split_text(phonemizer: Phonemizer, text: str) -> Iterator[SpeechPart]:
    """Yield the parts of a text. A text without any speech has no parts.

    The phonemizer is only used when the next part is requested.
    """
    phonemes: list[str] = []
    words: list[tuple[int, int, int]] = []

    def finish(*, ends_sentence: bool) -> SpeechPart:
        """Return the collected part, and start a new one."""
        part = SpeechPart(tuple(phonemes), tuple(words), ends_sentence)
        phonemes.clear()
        words.clear()
        return part

    offset = 0
    for clause, ipa in phonemizer.clauses(text):
        groups = _phoneme_groups(ipa)
        clause_words = _locate_words(phonemizer, clause, groups) if groups else []
        at = 0
        if len(phonemes) > _LONG_PART_PHONEMES:
            yield finish(ends_sentence=False)
        for section in _sections(groups):
            if phonemes and len(phonemes) + 1 + len(section) > _MAX_SECTION_PHONEMES:
                yield finish(ends_sentence=False)
            if phonemes:
                phonemes.append(" ")
            inside = [each for each in clause_words if at <= each[0] < at + len(section)]
            words += [(len(phonemes) + place - at, offset + start, length) for place, start, length in inside]
            phonemes += section
            at += len(section)
        mark = _LAST_PUNCTUATION.search(clause) if groups else None
        last = offset + len(clause) == len(text)
        if mark is not None and (last or mark.group() != "." or not phonemizer.ends_with_abbreviation(clause)):
            phonemes.append(_PUNCTUATION[mark.group()])
            if phonemes[-1] in _SENTENCE_ENDS:
                yield finish(ends_sentence=True)
        offset += len(clause)
    if phonemes:
        yield finish(ends_sentence=True)


def _sections(groups: Sequence[str]) -> Iterator[str]:
    """Yield the groups of phonemes, and those that are too long for a part in several sections."""
    for group in groups:
        for begin in range(0, len(group), _MAX_SECTION_PHONEMES):
            yield group[begin : begin + _MAX_SECTION_PHONEMES]


def _phoneme_groups(ipa: str) -> list[str]:
    """Return the groups of phonemes between blanks; each character of a group is a phoneme."""
    return [unicodedata.normalize("NFD", each) for each in _LANGUAGE_MARK.sub(" ", ipa).split()]


def _locate_words(phonemizer: Phonemizer, clause: str, groups: Sequence[str]) -> list[tuple[int, int, int]]:
    """Return the index of the first phoneme, the start and the length of each word in a clause."""
    positions = phonemizer.word_positions(clause)
    group_starts = [0, *itertools.accumulate(map(len, groups))]
    if len(positions) == len(groups):
        return [(start, *position) for start, position in zip(group_starts, positions, strict=False)]
    if not positions:  # there are phonemes, but their words are unknown
        return []
    # A spelled word is reported once per letter, always with the position of the word.
    positions = _increasing(positions)
    next_starts = [*(start for start, _ in positions[1:]), len(clause)]
    # Each word is converted alone. The result is aligned with the phonemes of the whole clause.
    limits = zip(positions, next_starts, strict=True)
    words = [clause[start : min(start + length, next_start)] for (start, length), next_start in limits]
    alone = ["".join(itertools.chain(*(_phoneme_groups(ipa) for _, ipa in phonemizer.clauses(word)))) for word in words]
    ends = [0, *itertools.accumulate(map(len, alone))]
    found = _align("".join(alone), "".join(groups), ends[:-1])
    last = max(0, group_starts[-1] - 1)
    return [(min(start, last), *position) for start, position in zip(found, positions, strict=True)]


def _increasing(positions: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return only the positions that come after all previous ones."""
    found: list[tuple[int, int]] = []
    for position in positions:
        if not found or position[0] > found[-1][0]:
            found.append(position)
    return found


def _align(first: str, second: str, places: Sequence[int]) -> list[int]:
    """Return the places in the second string that correspond to `places` in the similar first string."""
    if len(first) * len(second) > _MAX_COMPARISONS:
        return [place * len(second) // len(first) for place in places]
    import difflib

    matcher = difflib.SequenceMatcher(None, first, second, autojunk=False)
    blocks = [difflib.Match(0, 0, 0), *matcher.get_matching_blocks()]
    found = []
    for place in places:
        block = blocks[bisect.bisect_right(blocks, place, key=lambda each: each.a) - 1]
        found.append(block.b + min(place - block.a, block.size))
    return found
