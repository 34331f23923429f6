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
import unicodedata
from functools import lru_cache

from talkcli.errors import UsageError
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.options import MARKDOWN, MAX_TEXT_CHARS, is_visible

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from talkcli.goals.goal import JsonObject

    #: a term and its place in a text: start, end, the term as it is in the file, and its replacement
    Match = tuple[int, int, str, str]

#: The maximum size of a file of pronunciations, which has room for thousands of terms.
MAX_FILE_BYTES = 64 * 1024
#: The maximum length of a term and of its replacement. Longer phonemes could overrun a buffer of libespeak-ng.
_MAX_TERM_CHARS, _MAX_REPLACEMENT_CHARS = 100, 200
#: How many characters the replacements may add to a text. After that, terms are spoken as they are.
_MAX_ADDED_CHARS = MAX_TEXT_CHARS
#: The maximum number of faulty lines to list.
_MAX_SHOWN_FAULTS = 10

#: Matches plain text and phonemes. Phonemes are ASCII, and libespeak-ng needs room for at most 60 of them in a word.
_REPLACEMENT = re.compile(r"(?:[^\[\]]|\[\[[ -Z\\^-~]{1,60}\]\])+")
_PHONEMES = re.compile(r"\[\[[^\]]*\]\]")
#: A place where a term may begin: a word, or any other visible character. Scripts without blanks between words begin
#: at U+2E80. Each of their characters is a place of its own.
_CHUNK = re.compile(r"[^\W\u2e80-\U0010ffff]+|\S")
_FIRST_UNSPACED = "\u2e80"
#: A blank between two words of a term, which is not the end of a paragraph.
_GAP = r"(?:(?!\n\s*\n)\s)+"
#: The marks that stand for a pause in Markdown, and the usual marks outside Chinese and Japanese.
_PAUSES = {"。": ". ", "，": ", "}
_PAUSE_MARK = re.compile(r"\s*([。，])")
_NUMBER_MARK = re.compile(r"\d[.,:]\d")
#: In a text with phonemes, the sender's brackets become parentheses, which sound the same.
_WITHOUT_BRACKETS = str.maketrans("[]", "()")


class SpokenText:
    """A part of a text with replaced terms.

    Attributes:
        text: what is said.
        end: the offset after the part in the text that was sent. It may be greater than requested, because no term is
            cut in two.
        has_phonemes: whether `[[` and `]]` enclose phonemes.
        replaced: the terms that were replaced, with their replacements.
    """

    def __init__(self, text: str, start: int, end: int, matches: list[Match]) -> None:
        """Replace terms in the part of a text from `start` to `end`."""
        self.end = max(end, matches[-1][1]) if matches else end
        self.has_phonemes = any("[[" in replacement for _, _, _, replacement in matches)
        self.replaced = {term: replacement for _, _, term, replacement in matches}
        #: for each section of the new text: where it begins there and in the text that was sent, and the length of the
        #: term that it replaces, or 0
        self._sections: list[tuple[int, int, int]] = []
        self._last_term = -1
        self.text, at = "", start
        kept = text.translate(_WITHOUT_BRACKETS) if self.has_phonemes else text
        for begin, term_end, _, replacement in matches:
            self._append(kept[at:begin], at, 0)
            self._append(replacement, begin, term_end - begin)
            at = term_end
        self._append(kept[at : self.end], at, 0)

    def _append(self, text: str, start: int, term_chars: int) -> None:
        """Append a section, which begins at the offset `start` in the sent text.

        Phonemes are separated by blanks. Otherwise, libespeak-ng ignores phonemes after a bracket, and a hyphen after
        phonemes crashes Vietnamese voices.
        """
        meets_phonemes = self.has_phonemes and (self.text.endswith("]]") or text.startswith("[["))
        if meets_phonemes and not (self.text[-1:].isspace() or text[:1].isspace()) and self.text and text:
            self.text += " "
        self._sections.append((len(self.text), start, term_chars))
        self.text += text

    def locate(self, start: int, length: int) -> tuple[int, int] | None:
        """Return the place and length in the sent text of a word of the spoken text.

        A replaced term is located only once, even if it is spoken as several words. After that, return None.
        """
        section, begin = self._map(start)
        _, original, term_chars = self._sections[section]
        if not term_chars:
            last, end = self._map(start + length - 1)
            _, original, term_chars = self._sections[last]
            return begin, (original + term_chars if term_chars else end + 1) - begin
        if section == self._last_term:
            return None
        self._last_term = section
        return original, term_chars

    def for_people(self, text_format: str) -> str:
        """Return the spoken text for people to read. The marks of Markdown leave no blanks and no wide punctuation."""
        if text_format != MARKDOWN:
            return self.text
        narrow = _PAUSE_MARK.sub(lambda found: _PAUSES[found[1]], self.text)
        return " ".join((self.text if max(narrow, default="") >= _FIRST_UNSPACED else narrow).split())

    def _map(self, place: int) -> tuple[int, int]:
        """Find an offset of the spoken text. Return its section, and the matching offset in the sent text.

        In a replaced term, only the section is valid.
        """
        section = max(0, bisect.bisect_right(self._sections, place, key=lambda each: each[0]) - 1)
        begin, original, _ = self._sections[section]
        return section, original + place - begin


class Pronunciations:
    """A table of terms with their replacements."""

    def __init__(self, terms: Mapping[str, str]) -> None:
        self.terms = terms
        #: the terms by their first chunk in lower case. The longest term comes first, and its exact case before others.
        self._by_chunk: dict[str, list[tuple[str, str]]] = {}
        for term in sorted(terms, key=lambda each: (-len(each), each == each.lower())):
            for form in dict.fromkeys((term, *(unicodedata.normalize(each, term) for each in ("NFC", "NFD")))):
                first = _CHUNK.match(form)
                assert first
                self._by_chunk.setdefault(first.group().lower(), []).append((form, term))

    def apply(self, text: str, start: int = 0, end: int | None = None) -> SpokenText:
        """Return a text, or its part from `start` to `end`, with all terms replaced."""
        end = len(text) if end is None else end
        return SpokenText(text, start, end, list(self._find(text, start, end)))

    def apply_to_goal(self, text: str, text_format: str) -> SpokenText:
        """Replace the terms in a goal's text, without the marks of Markdown."""
        if text_format == MARKDOWN:
            from talkcli.engine.markdown import blank_markdown  # rarely needed, and slow to import

            text = blank_markdown(text)
        return self.apply(text)

    def _find(self, text: str, start: int, end: int) -> Iterator[Match]:
        """Yield each term that begins in a part of a text, with its place and its replacement."""
        at, added = start, 0
        for chunk in _CHUNK.finditer(text, start) if self.terms else ():
            begin = chunk.start()
            if begin >= end or added > _MAX_ADDED_CHARS:
                return
            for form, term in self._by_chunk.get(chunk.group().lower(), ()) if begin >= at else ():
                found = _compile(form).match(text, begin)
                if found and _is_border(text, begin) and _is_border(text, found.end()):
                    at = found.end()
                    added += len(self.terms[term])
                    yield begin, at, term, self.terms[term]
                    break


@lru_cache(1_000)
def _compile(term: str) -> re.Pattern[str]:
    """Return a regular expression for a term. Compiling all terms of a file would take too long."""
    return re.compile(_GAP.join(map(re.escape, term.split())), re.IGNORECASE if term == term.lower() else 0)


def _is_border(text: str, at: int) -> bool:
    """Return whether a word may begin or end at an offset. Numbers such as "2.5" count as one word."""
    if any(at >= back and _NUMBER_MARK.match(text, at - back) for back in (1, 2)):
        return False
    return not (_is_word_character(text[max(0, at - 1) : at]) and _is_word_character(text[at : at + 1]))


def _is_word_character(character: str) -> bool:
    """Return whether a character belongs to a word, in a script that separates words with blanks."""
    if not character or character >= _FIRST_UNSPACED:
        return False
    return character.isalnum() or character in "_\u200c\u200d" or unicodedata.category(character).startswith("M")


def parse_pronunciations(data: bytes, *, phonemes: bool = True) -> tuple[dict[str, str], list[str]]:
    """Parse a file of pronunciations. Return the terms, and a message about each faulty line.

    If `phonemes` is false, lines with phonemes are faulty, because the driver doesn't support them.
    """
    terms: dict[str, str] = {}
    lines: dict[str, int] = {}
    faults = []
    for number, line in enumerate(data.decode("utf-8-sig", "surrogateescape").split("\n"), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        term, equals, replacement = (" ".join(each.split()) for each in line.partition("="))
        fault = _find_fault(term, replacement) if equals else "'=' is missing; write: WORD = how it is said"
        if not fault and "[[" in replacement and not phonemes:
            fault = "this driver can't speak phonemes"
        if not fault and term in terms:
            fault = f"'{term}' is already in line {lines[term]}"
        if fault:
            faults.append(f"line {number}: {fault}")
        else:
            terms[term], lines[term] = " ".join(_PHONEMES.sub(r" \g<0> ", replacement).split()), number
    return terms, faults


def _find_fault(term: str, replacement: str) -> str | None:
    """Return an error message if a term or its replacement is not valid."""
    if any(unicodedata.category(each) in ("Cc", "Cs") for each in term + replacement):
        return "it has a control character, or is not valid UTF-8"
    if not term:
        return "the word before '=' is missing"
    if not is_visible(replacement):
        return "the text after '=' is missing"
    if len(term) > _MAX_TERM_CHARS or len(replacement) > _MAX_REPLACEMENT_CHARS:
        return f"a word has at most {_MAX_TERM_CHARS} characters, and its replacement {_MAX_REPLACEMENT_CHARS}"
    if not _REPLACEMENT.fullmatch(replacement):
        return "phonemes must be 1 to 60 ASCII characters between [[ and ]]"
    return None


class PronunciationFile:
    """A file of pronunciations, which is read again when it has changed.

    If the file can't be read later, the last table stays in use.
    """

    def __init__(self, path: str, report: Callable[[str], None] = lambda _: None, *, phonemes: bool = True) -> None:
        """Read the file.

        Args:
            path: the path of the file.
            report: called with each message for the log.
            phonemes: whether the driver supports phonemes.

        Raises:
            UsageError: the file can't be read.
        """
        self.path = os.path.abspath(path)
        self._report, self._phonemes = report, phonemes
        self.table = Pronunciations({})
        #: messages about the faulty lines
        self.faults: list[str] = []
        #: why the file can't be read any more, or None
        self.problem: str | None = None
        self._stamp: tuple[int, ...] = ()
        try:
            self._read()
        except (OSError, ValueError) as error:
            raise UsageError(f"--pronounce: {self.path} {_explain(error)}") from error

    def refresh(self) -> Pronunciations:
        """Read the file again if it has changed. Return the table.

        If the file can't be read, report this once, and return the last table.
        """
        before, self.problem = self.problem, None
        try:
            self._read()
        except (OSError, ValueError) as error:
            self.problem = _explain(error)
            if self.problem != before:
                self._report(f"{self.path} {self.problem}; the terms that were read last stay in use")
        return self.table

    def _read(self) -> None:
        """Read the file if it has changed. This never waits for a pipe or a device.

        Raises:
            OSError, ValueError: the file can't be read.
        """
        if (stamp := _stamp(_require_file(os.stat(self.path)))) != self._stamp:
            descriptor = os.open(self.path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
            with open(descriptor, "rb") as file:
                stamp = _stamp(_require_file(os.fstat(descriptor)))
                terms, self.faults = parse_pronunciations(file.read(MAX_FILE_BYTES), phonemes=self._phonemes)
            self.table, self._stamp = Pronunciations(terms), stamp
            self._report(f"read {len(terms)} pronunciation{'s' * (len(terms) != 1)} from {self.path}")
            for each in self.describe_faults():
                self._report(each)

    def describe_faults(self) -> list[str]:
        """Return a message about each faulty line, up to a limit."""
        more = len(self.faults) - _MAX_SHOWN_FAULTS
        shown = [f"{self.path}, {each} (the line is left out)" for each in self.faults[:_MAX_SHOWN_FAULTS]]
        return [*shown, f"{self.path}: {more} more faulty lines"] if more > 0 else shown

    def describe(self) -> JsonObject:
        """Read the file again if it has changed. Return its path, number of terms and faults for `status`."""
        self.refresh()
        return {
            "file": self.path,
            "terms": len(self.table.terms),
            "faults": self.faults[:_MAX_SHOWN_FAULTS],
            "problem": self.problem,
        }


def _explain(error: OSError | ValueError) -> str:
    """Return why a file can't be read."""
    return f"can't be read: {error.strerror if isinstance(error, OSError) else error}"


def _require_file(found: os.stat_result) -> os.stat_result:
    """Return the argument if it describes a regular file of limited size. Otherwise, raise ValueError."""
    if not stat.S_ISREG(found.st_mode):
        raise ValueError("it is not a regular file")
    if found.st_size > MAX_FILE_BYTES:
        raise ValueError(f"it is larger than {MAX_FILE_BYTES >> 10} KiB")
    return found


def _stamp(found: os.stat_result) -> tuple[int, ...]:
    """Return a file's times, size and identity, which show whether the file has changed."""
    return found.st_mtime_ns, found.st_ctime_ns, found.st_size, found.st_ino, found.st_dev
