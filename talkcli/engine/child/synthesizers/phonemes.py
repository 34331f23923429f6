"""Functions that split a text into sentences and convert them to phonemes.

libespeak-ng returns the phonemes of each clause with blanks between words. When it speaks the clause, it reports the
positions of the words in the text. These two lists have to be aligned, because the phonemes of some words are joined
("in the"), while a number such as "1,000" has several words. Access to the library is through a `Phonemizer`.
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

#: The maximum number of phonemes in one run of a model. The time and memory for a run grow with the square of this
#: number. On a PC, 250 phonemes take 0.25 s and 60 MB, and 800 phonemes take 2 s and 450 MB.
MAX_PART_PHONEMES = 250
#: The maximum number of phonemes in a part, not counting the punctuation mark at its end.
_MAX_SECTION_PHONEMES = MAX_PART_PHONEMES - 1
#: If a part is longer than this, it ends at the next comma instead of at the end of the sentence.
_LONG_PART_PHONEMES = 150
#: The maximum number of comparisons for aligning two strings of phonemes. They take up to 50 ms. This is enough for a
#: clause of 1,000 phonemes. libespeak-ng ends every clause after 800 bytes, so only very long numbers exceed the limit.
#: In such a number, the exact positions of words don't matter.
_MAX_COMPARISONS = 1 << 20
#: The punctuation marks for which Piper's voices make a pause. The last three end a sentence.
PAUSE_MARKS = ",;:.!?"
#: For each punctuation character in a text, the mark to pass to Piper's voices.
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
#: Matches a change of language between phonemes, such as "(en)" in "(en)hello(de)".
_LANGUAGE_MARK = re.compile(r"\([^()]*\)")


class Phonemizer(Protocol):
    """Converts text to phonemes in one language.

    Positions are counted in characters from 0.
    """

    def clauses(self, text: str) -> list[tuple[str, str]]:
        """Split a text into clauses. Return each clause with its phonemes in IPA."""

    def word_positions(self, clause: str) -> list[tuple[int, int]]:
        """Return the start and the length of each word in a clause. The length is at least 1."""

    def ends_with_abbreviation(self, clause: str) -> bool:
        """Return whether a clause ends with an abbreviation such as "Mr."."""


@frozen
class SpeechPart:
    """The phonemes of a sentence, or of a part of a long sentence."""

    #: IPA characters, blanks and punctuation marks; never empty
    phonemes: tuple[str, ...]
    #: for each word, the index of its first phoneme, its start in the text and its length. The indexes never decrease.
    words: tuple[tuple[int, int, int], ...]
    #: whether the part ends a sentence, so that a pause follows
    ends_sentence: bool


def split_text(phonemizer: Phonemizer, text: str, *, ends_text: bool = True) -> Iterator[SpeechPart]:
    """Yield a text's phonemes in parts that are short enough for one run of a model.

    A text without any speech has no parts. The phonemizer is used only while a part is being requested.

    Args:
        phonemizer: converts text to phonemes.
        text: the text.
        ends_text: whether no other part of the text follows, so that a pause is made even if there is no mark.
    """
    phonemes: list[str] = []
    words: list[tuple[int, int, int]] = []

    def finish(*, ends_sentence: bool) -> SpeechPart:
        """Return the current part, and start a new one."""
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
        for section in _split_long_groups(groups):
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
        yield finish(ends_sentence=ends_text)


def _split_long_groups(phoneme_groups: Sequence[str]) -> Iterator[str]:
    """Yield groups of phonemes. Split groups that are too long for the model."""
    for group in phoneme_groups:
        for begin in range(0, len(group), _MAX_SECTION_PHONEMES):
            yield group[begin : begin + _MAX_SECTION_PHONEMES]


def _phoneme_groups(ipa: str) -> list[str]:
    """Split IPA text at blanks and language marks. Each character in a group is a phoneme."""
    return [unicodedata.normalize("NFD", each) for each in _LANGUAGE_MARK.sub(" ", ipa).split()]


def _locate_words(phonemizer: Phonemizer, clause: str, phoneme_groups: Sequence[str]) -> list[tuple[int, int, int]]:
    """Locate the words of a clause. Return each word's phoneme index, start and length.

    The phonemes are counted across all groups.
    """
    positions = phonemizer.word_positions(clause)
    group_starts = [0, *itertools.accumulate(map(len, phoneme_groups))]
    if len(positions) == len(phoneme_groups):
        return [(start, *position) for start, position in zip(group_starts, positions, strict=False)]
    if not positions:  # The library has reported no words for these phonemes.
        return []
    # If a word is spelled out, the library reports the same position for each letter.
    positions = _drop_repeated_positions(positions)
    next_starts = [*(start for start, _ in positions[1:]), len(clause)]
    # Convert each word on its own, and align the results with the phonemes of the whole clause.
    limits = zip(positions, next_starts, strict=True)
    words = [clause[start : min(start + length, next_start)] for (start, length), next_start in limits]
    alone = ["".join(itertools.chain(*(_phoneme_groups(ipa) for _, ipa in phonemizer.clauses(word)))) for word in words]
    ends = [0, *itertools.accumulate(map(len, alone))]
    found = _map_indexes("".join(alone), "".join(phoneme_groups), ends[:-1])
    last = max(0, group_starts[-1] - 1)
    return [(min(start, last), *position) for start, position in zip(found, positions, strict=True)]


def _drop_repeated_positions(positions: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Remove word positions that are repeated or out of order."""
    found: list[tuple[int, int]] = []
    for position in positions:
        if not found or position[0] > found[-1][0]:
            found.append(position)
    return found


def _map_indexes(first: str, second: str, indexes: Sequence[int]) -> list[int]:
    """Convert indexes in `first` to the matching indexes in `second`."""
    if len(first) * len(second) > _MAX_COMPARISONS:
        return [place * len(second) // len(first) for place in indexes]
    import difflib

    matcher = difflib.SequenceMatcher(None, first, second, autojunk=False)
    blocks = [difflib.Match(0, 0, 0), *matcher.get_matching_blocks()]
    found = []
    for place in indexes:
        block = blocks[bisect.bisect_right(blocks, place, key=lambda each: each.a) - 1]
        found.append(block.b + min(place - block.a, block.size))
    return found
