"""Pronunciations: how to say terms that the synthesizer would mispronounce.

A file has a line such as `GmbH = gay em bay ha` for each term. Before a text is spoken, its terms are replaced. Words
are still reported with their places in the text that was sent, so `SpokenText` keeps track of what was replaced.

- A term only matches whole words. Of several terms, the longest one matches.
- A term without capital letters matches any case. Any other term only matches in its own case.
- In a replacement, `[[` and `]]` enclose phonemes of libespeak-ng. The marks have no meaning in a sender's text.
"""

from __future__ import annotations

import bisect
import os
import re
import stat
from collections import defaultdict

from talkcli.errors import UsageError
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.options import MARKDOWN, MAX_TEXT_CHARS, is_visible

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from talkcli.goals.goal import JsonObject

#: The maximum size of a file of pronunciations, which has room for about two thousand terms.
MAX_FILE_BYTES = 32 * 1024
#: The maximum length of a line.
_MAX_LINE_CHARS = 200
#: The maximum number of faulty lines to name.
_MAX_NAMED_FAULTS = 10

#: Matches plain text and phonemes. Phonemes are ASCII, and libespeak-ng needs room for at most 60 of them in a word.
_REPLACEMENT = re.compile(r"(?:[^\[\]]|\[\[[ -Z\\^-~]{1,60}\]\])+")
_PHONEMES = re.compile(r"\[\[[^\]]*\]\]")
_UNSPEAKABLE = re.compile("[\0-\b\x0e-\x1f\x7f-\x9f\ud800-\udfff]")
#: A letter, a digit or an accent in a script that separates words with blanks. Other scripts begin at U+2E80.
_LETTER = r"(?:[^\W\u2e80-\U0010ffff]|[\u0300-\u036f])"
#: A place where a word may begin or end. Numbers such as "2.5" count as one word.
_BORDER = re.compile(rf"(?:(?<!{_LETTER})|(?!{_LETTER}))(?!(?<=\d)[.,:]\d)(?<!\d[.,:](?=\d))")
#: A piece of a term: a word, or any other visible character.
_PIECE = re.compile(rf"{_LETTER}+|\S")
#: In a text with phonemes, the sender's brackets become parentheses, which sound the same.
_WITHOUT_BRACKETS = str.maketrans("[]", "()")


class SpokenText:
    """A part of a text, in which terms are replaced by their pronunciations.

    Attributes:
        text: the text as it is said.
        end: the offset after the part in the text that was sent. It may be greater than requested, because no term is
            cut in two.
        has_phonemes: whether `[[` and `]]` enclose phonemes.
    """

    def __init__(self, text: str, start: int, end: int, replacements: list[tuple[int, int, str]]) -> None:
        """Replace terms in the part of a text from `start` to `end`.

        `replacements` has the start, the end and the replacement of each term.
        """
        self.has_phonemes = any("[[" in each for _, _, each in replacements)
        #: for each section: its offset in the new text, its offset in the text that was sent, and the length of the
        #: term that it replaces, or 0
        self._sections: list[tuple[int, int, int]] = []
        self.text, self.end = "", start
        kept = text.translate(_WITHOUT_BRACKETS) if self.has_phonemes else text
        for term_start, term_end, replacement in replacements:
            self._append(kept[self.end : term_start], self.end, 0)
            self._append(replacement, term_start, term_end - term_start)
            self.end = term_end
        self._append(kept[self.end : end], self.end, 0)
        self.end = max(self.end, end)

    def _append(self, text: str, start: int, term_chars: int) -> None:
        """Append a section, which begins at the offset `start` in the sent text.

        Phonemes are separated by blanks. Otherwise, libespeak-ng ignores phonemes after a bracket, and a hyphen after
        phonemes crashes Vietnamese voices.
        """
        before, after = self.text[-1:].strip(), text[:1].strip()
        if before and after and self.has_phonemes and (before == "]" or after == "["):
            self.text += " "
        self._sections.append((len(self.text), start, term_chars))
        self.text += text

    def locate(self, start: int, length: int) -> tuple[int, int]:
        """Convert a word's start and length in the spoken text to those in the sent text.

        A replaced term counts as one word.
        """
        begin, original, term_chars = self._sections[self._find_section(start)]
        if term_chars:
            return original, term_chars
        place, last = original + start - begin, start + length - 1
        begin, original, term_chars = self._sections[self._find_section(last)]
        return place, original + (term_chars or last - begin + 1) - place

    def _find_section(self, place: int) -> int:
        """Return the index of the section that contains an offset in the spoken text."""
        return max(0, bisect.bisect_right(self._sections, place, key=lambda each: each[0]) - 1)


class Pronunciations:
    """A table of terms with their replacements."""

    def __init__(self, terms: dict[str, str]) -> None:
        self.terms = terms
        #: the possible numbers of pieces in a term, by the term's first piece in lower case
        self._lengths = defaultdict[str, set[int]](set)
        for pieces in map(_PIECE.findall, terms):
            self._lengths[pieces[0].lower()].add(len(pieces))

    def apply(self, text: str, start: int = 0, end: int | None = None) -> SpokenText:
        """Replace the terms in a text, or in a part of it. Return the result as a SpokenText.

        The part begins at the offset `start`. It ends before `end`, or at the end of the text if `end` is None.
        """
        end, replacements, added = len(text) if end is None else end, [], 0
        for first, last, replacement in self._find(text, start):
            if first >= end or added > MAX_TEXT_CHARS:  # later terms are spoken unchanged
                break
            added += len(replacement)
            replacements.append((first, last, replacement))
        return SpokenText(text, start, end, replacements)

    def _find(self, text: str, start: int) -> Iterator[tuple[int, int, str]]:
        """Yield the start, the end and the replacement of each term found after an offset."""
        # A regular expression for all terms would take seconds for a long text.
        pieces, joined, end = list(_PIECE.finditer(text, start)) if self.terms else [], list[str](), start
        for piece in pieces:
            # The words of a term may be separated by any blanks in the text, but not by the end of a paragraph.
            gap, end = text[end : piece.start()], piece.end()
            joined.append((gap and (" " if gap.count("\n") < 2 else gap)) + piece[0])
        end = start
        for index, first in enumerate(pieces):
            if first.start() < end or not _BORDER.match(text, first.start()):
                continue
            for length in sorted(self._lengths.get(first[0].lower(), ()), reverse=True):
                found, last = "".join(joined[index : index + length]).lstrip(), pieces[index : index + length][-1].end()
                replacement = self.terms.get(found) or self.terms.get(found.lower())
                if replacement and _BORDER.match(text, last):
                    yield first.start(), last, replacement
                    end = last
                    break

    def spoken_form(self, text: str, text_format: str) -> str | None:
        """Return a readable form of a text as it is spoken, or None if it is spoken as it was sent."""
        if text_format == MARKDOWN:
            from talkcli.engine.markdown import blank_markdown  # this import is slow and rarely needed

            said = " ".join(self.apply(blank_markdown(text)).text.split())
        else:
            said = self.apply(text).text
        return None if said == text else said


def parse_pronunciations(data: bytes) -> tuple[dict[str, str], list[str]]:
    """Parse a file of pronunciations. Return the terms, and a message about each faulty line."""
    terms: dict[str, str] = {}
    faults = []
    for number, line in enumerate(data.decode("utf-8-sig", "surrogateescape").split("\n"), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        term, _, replacement = (" ".join(each.split()) for each in line.partition("="))
        problems = {
            "it has a control character, or is not valid UTF-8": _UNSPEAKABLE.search(line),
            "write it like this: WORD = how it is said": not (term and is_visible(replacement)),
            f"it has more than {_MAX_LINE_CHARS} characters": len(line) > _MAX_LINE_CHARS,
            "phonemes are 1 to 60 ASCII characters between [[ and ]]": not _REPLACEMENT.fullmatch(replacement),
            f"'{term}' is already in an earlier line": term in terms,
        }
        if fault := next((words for words, applies in problems.items() if applies), None):
            faults.append(f"line {number}: {fault}")
        else:
            terms[term] = " ".join(_PHONEMES.sub(r" \g<0> ", replacement).split())
    return terms, faults


class PronunciationFile:
    """A file of pronunciations, which is read again when it has changed.

    If the file can't be read later, the last table stays in use.
    """

    def __init__(self, path: str, report: Callable[[str], None]) -> None:
        """Read the file. Call `report` with each message for the log, now and later.

        Raises:
            UsageError: the file can't be read.
        """
        self.path, self._report = os.path.abspath(path), report
        #: the file's identity, size and times, at least one of which differs after a change
        self._stamp: tuple[int, ...] = ()
        #: the reason why the file can't be read any more, or "", and a limited number of messages about faulty lines
        self._problem, self._faults = "", list[str]()
        self._table = Pronunciations({})
        self.refresh()

    def refresh(self) -> Pronunciations:
        """Read the file again if it has changed. Return the table.

        If the file can't be read, report this once, and return the last table.
        """
        problem = ""
        try:
            self._read()
        except (OSError, ValueError) as error:
            problem = f"can't be read: {error.strerror if isinstance(error, OSError) else error}"
            if not self._stamp:
                raise UsageError(f"--pronounce: {self.path} {problem}") from error
            if problem != self._problem:
                self._report(f"{self.path} {problem}; the terms that were read last stay in use")
        self._problem = problem
        return self._table

    def _read(self) -> None:
        """Read the file if it has changed, without waiting for a pipe or a device.

        Raises:
            OSError, ValueError: the file can't be read.
        """
        if not stat.S_ISREG(os.stat(self.path).st_mode):
            raise ValueError("it is not a regular file")
        with open(os.open(self.path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
            found = os.fstat(file.fileno())
            stamp = found.st_mtime_ns, found.st_ctime_ns, found.st_size, found.st_ino, found.st_dev
            if stamp == self._stamp:
                return
            data = file.read(MAX_FILE_BYTES + 1)
        if len(data) > MAX_FILE_BYTES:
            raise ValueError(f"it is larger than {MAX_FILE_BYTES >> 10} KiB")
        terms, faults = parse_pronunciations(data)
        self._table, self._stamp, self._faults = Pronunciations(terms), stamp, faults[:_MAX_NAMED_FAULTS]
        for each in self._faults:
            self._report(f"{self.path}, {each}; the line is left out")

    def describe(self) -> JsonObject:
        """Read the file again if it has changed. Return its path, term count and problems for `status`."""
        terms, problems = len(self.refresh().terms), [*filter(None, [self._problem]), *self._faults]
        return {"file": self.path, "terms": terms, "problems": problems}
