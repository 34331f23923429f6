"""Protection against texts that crash libespeak-ng.

Dangerous characters are replaced one by one, so all positions in the text stay the same. Ordinary text is never
changed. Each rule prevents one known crash, and a comment explains its numbers. Some crashes remain possible, but they
only affect the engine process. The module is pure.

The numbers are the sizes of buffers that libespeak-ng 1.51 overruns (N_WORD_BYTES, N_CLAUSE_WORDS and N_TR_SOURCE in
`translate.h`). Version 1.52 has fixed some of these faults.
"""

from __future__ import annotations

import re
import unicodedata

#: Characters to replace with blanks. For the library, 0x01 starts a command (such as a new pitch or voice), 0x02 after
#: a "[" starts phonemes, and NUL ends the text. Tabs and line ends are harmless. U+FFFD, which replaces unreadable
#: bytes, is silent, but the library would report it as a word in place of the next word.
_BLANKED = {code: " " for code in (*range(0x20), *range(0x7F, 0xA0), 0xFFFD) if chr(code) not in "\t\n\r"}

#: The usable size of the buffer for initials such as "U.S.A.", which the library looks up as one word. The buffer holds
#: each letter with its dot, and the whole word after the last dot. It has 160 bytes (N_WORD_BYTES), including the end
#: mark. 'a.' * 85 and 'a.' + 'b' * 170 overrun it.
_LOOKUP_BYTES = 156
#: The usable size of the buffer in which the library spells out initials. It has 80 bytes. The library never speaks
#: more than 50 of the letters anyway.
_SPELLING_BYTES = 78
#: The maximum number of words before initials in a clause. For each initial, the library marks up to two later words as
#: spoken. Its table has room for 300 words per clause (N_CLAUSE_WORDS), and it doesn't check this limit.
_MAX_CLAUSE_WORDS = 220
#: After this number of bytes, the library ends a clause at the next blank. The buffer has 800 bytes (N_TR_SOURCE), of
#: which 75 are reserved.
_MAX_CLAUSE_BYTES = 725
#: The maximum length of a word. The library may replace the ending of a word, so the result has to fit into a buffer of
#: 160 bytes (N_WORD_BYTES).
_MAX_WORD_BYTES = 150
#: The maximum number of apostrophes in a word. The library treats each "'s" as an ending. The phonemes of all endings
#: share a buffer of 200 bytes, which 70 endings overrun.
_MAX_WORD_APOSTROPHES = 30

#: Matches a character that the library treats as part of a word. This is a letter, a digit, an apostrophe, or nearly
#: any character outside ASCII, including combining accents.
_WORD_CHARACTER = (
    r"(?:[A-Za-z0-9'’]|(?![\s\u0080-\u00a9\u00ab-\u00b4\u00b6-\u00b9\u00bb-\u00bf\u2000-\u200a\u2010-\u205f\u3000-\u303f"
    r"\uff00-\uff0f])[^\x00-\x7f])"
)
_WORD_OR_GAP = re.compile(f"({_WORD_CHARACTER}+)|((?:(?!{_WORD_CHARACTER}).)+)", re.DOTALL)
#: Symbols that the library treats as letters: circled letters and numbers, and Braille.
_SYMBOL_LETTERS = frozenset(map(chr, (*range(0x2460, 0x2500), *range(0x2800, 0x2900))))
#: Matches the end of a clause. Western punctuation ends a clause only before a blank, a bracket, a quote or the end of
#: the text. Other punctuation always does.
_CLAUSE_END = re.compile(r"[.,;:!?…](?:[\s()\[\]{}<>\"«»“”‘’„]|\Z)|[。、，！？：；︒؟،؛।॥։՝]|\n\s*\n")
#: Matches a hyphen between a symbol and a letter.
_HYPHEN = re.compile(r"(?<=[^\w\s]|_)-(?=[^\W\d_])")
#: The library treats every character from U+2E80 upwards as a separate word. The other two are the first and the last
#: Hangul syllable. The library splits each syllable into letters of three bytes.
_IDEOGRAPHS, _HANGUL, _HANGUL_END = "\u2e80", "\uac00", "\ud7a3"
#: Characters that crash all voices except those of the given languages. If a voice doesn't know a character, the
#: library loads the default language of its script. If that language has no name for the character, the library loads
#: English, and then uses memory that it has just freed (`LookupLetter` in `numbers.c`). To find these characters, every
#: character was spoken with each of the 131 voices of version 1.51 while freed memory was overwritten. Blanking them
#: loses no speech, except for the four Greek symbols.
_CRASHING_CHARACTERS = {
    ("el", "grc"): "\u0384\u0385\u0387\u03f6",
    ("hy",): "\u055a\u058d-\u058f",
    ("hi", "kok", "mr", "ne", "sd", "ur"): "\u0970",
    ("as", "bn", "bpy"): "\u09e6-\u09ef\u09f2\u09f3\u09f7-\u09f9\u09fb\u09fd\u09fe",
    ("pa",): "\u0a66-\u0a6f\u0a76",
    ("gu", "pa"): "\u0ae6-\u0af1\u0afd-\u0aff",
    ("ta",): "\u0be6-\u0bef",
    ("kn",): "\u0c80\u0c81\u0c84\u0c8c\u0cdd\u0ce1-\u0ce3\u0ce6-\u0cef\u0cf1\u0cf2",
    ("ml",): "\u0d00\u0d01\u0d04\u0d0c\u0d29\u0d3a-\u0d3c\u0d4f\u0d54-\u0d56\u0d58-\u0d5f\u0d62\u0d63\u0d66-\u0d79",
    ("si",): "\u0de6-\u0def",
    ("ka",): "\u10fb",
    ("ko",): "\u1180-\u11a7\u11c3-\u11ff",
}
#: Matches a number, with or without thousands separators.
_SPOKEN_NUMBER = re.compile(r"[0-9]+(?:,[0-9]{3})*")
#: Numbers with this many digits (minimum and maximum) crash the Cantonese and Shan voices, because their phonemes need
#: more than 200 bytes (N_WORD_PHONEMES). Longer numbers are spoken digit by digit. All 131 voices were tested with 382
#: numbers of 6 to 39 digits.
_UNSAFE_DIGIT_COUNTS = {"yue": (13, 14), "shn": (13, 14)}
#: Replaces a digit with its superscript, which the Cantonese and Shan voices speak separately. This splits a number in
#: two. Two superscripts in a row would be silent.
_SEPARATE_DIGITS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


def guarded(text: str, voice: str = "") -> str:
    """Replace the parts of a text that would crash libespeak-ng. Return the new text.

    The length of the text stays the same.

    Args:
        text: The text to make safe.
        voice: The library's id of the voice, such as "gmw/en-US" or "ko+f3", or "" if the language is unknown.
    """
    text = text.translate(_BLANKED)
    language = re.split(r"[-+]", voice.rpartition("/")[2], maxsplit=1)[0]
    if not text.isascii():
        text = _unsafe_characters(language).sub(" ", text)
    if language in _UNSAFE_DIGIT_COUNTS:
        text = _SPOKEN_NUMBER.sub(lambda found: _split_number(found[0], *_UNSAFE_DIGIT_COUNTS[language]), text)
    return _WORD_OR_GAP.sub(_split_word, _blank_crashing_hyphens(_without_long_initials(text)))


def _unsafe_characters(language: str) -> re.Pattern[str]:
    """Return a regular expression for characters that crash a language's voices."""
    found = (signs for languages, signs in _CRASHING_CHARACTERS.items() if language not in languages)
    return re.compile(f"[{''.join(found)}]")


def _split_number(number: str, min_digits: int, max_digits: int) -> str:
    """Split a number of `min_digits` to `max_digits` digits by making one digit a superscript.

    Return any other number unchanged.
    """
    if not min_digits <= sum(map(str.isdigit, number)) <= max_digits:
        return number
    middle = next(place for place in range(len(number) // 2, len(number)) if number[place].isdigit())
    return number[:middle] + number[middle].translate(_SEPARATE_DIGITS) + number[middle + 1 :]


def _without_long_initials(text: str) -> str:
    """Replace the dots in long sequences of initials with blanks."""
    result = list(text)
    looked_up = spelled = words = size = 0
    dots: list[int] = []
    for piece in _WORD_OR_GAP.finditer(text):
        word, between = piece.groups()
        size += _utf8_bytes(piece.group())
        if between is not None:
            words += len("".join(between.split()))
            if size > _MAX_CLAUSE_BYTES or _ends_clause(text, piece.start(), piece.end()):
                words = size = 0
            dots = [at for at in range(piece.start(), piece.end()) if text[at] == "."]
            if not dots:
                looked_up = spelled = 0
            continue
        room = sum(map(_max_bytes, word))
        words += len(word) if word[0] >= _IDEOGRAPHS else 1
        single = sum(map(_is_letter, word)) < 2
        too_long = looked_up + room > _LOOKUP_BYTES or (single and spelled + room > _SPELLING_BYTES)
        if looked_up and (too_long or words > _MAX_CLAUSE_WORDS):
            for at in dots:
                result[at] = " "
            looked_up = spelled = 0
        looked_up, spelled = (looked_up + room + 1, spelled + room) if single else (0, 0)
    return "".join(result)


def _ends_clause(text: str, start: int, end: int) -> bool:
    """Return whether a clause ends between two positions.

    A dot doesn't end a clause if a lower-case letter follows, because it then belongs to an abbreviation.
    """
    behind = text[end : end + 1]
    stops = _CLAUSE_END.finditer(text, start, end + len(behind))
    return any(text[each.start()] != "." or not behind.islower() for each in stops)


def _is_letter(character: str) -> bool:
    """Return whether the library counts a character of a word as a letter.

    Quotes and joiners don't count.
    """
    return character.isalnum() or character in _SYMBOL_LETTERS or unicodedata.category(character).startswith("M")


def _utf8_bytes(text: str) -> int:
    """Return the number of bytes that a text has in UTF-8.

    A lone surrogate counts as one byte, because it is replaced.
    """
    return len(text.encode("utf-8", "replace"))


def _max_bytes(character: str) -> int:
    """Return the maximum number of bytes that the library may need for a character."""
    if _HANGUL <= character <= _HANGUL_END:
        return 9
    return max(2, _utf8_bytes(character), _utf8_bytes(character.lower()))


def _blank_crashing_hyphens(text: str) -> str:
    """Replace hyphens with blanks if they would crash the library.

    The library doesn't mark the beginning of the word after such a hyphen. Later, it looks for the mark and reads
    beyond the start of its list of phonemes. This crashes Vietnamese, Danish, Hindi and other voices.
    """

    def blanked(found: re.Match[str]) -> str:
        at = start = found.start()
        while start and not text[start - 1].isalnum():
            start -= 1
        return " " if start == 0 or _ends_clause(text, start, at) else "-"

    return _HYPHEN.sub(blanked, text)


def _split_word(match: re.Match[str]) -> str:
    """Return a matched word, split if it is too long for the library or has too many apostrophes.

    The length stays the same: apostrophes become blanks, or pairs of letters change case.
    """
    word = match.group(1) or ""
    # If a script has no capital letters, its words can only be split at apostrophes.
    short = _utf8_bytes(word) <= _MAX_WORD_BYTES or word.lower() == word.upper()
    if short and word.count("'") + word.count("’") <= _MAX_WORD_APOSTROPHES:
        return match.group()
    result = list(word)
    size = endings = 0
    for at, character in enumerate(word):
        size += _utf8_bytes(character)
        endings += character in "'’"
        before, here = result[at - 1].lower(), character.upper()
        if endings > _MAX_WORD_APOSTROPHES:
            result[at] = " "
            size = endings = 0
        elif size > _MAX_WORD_BYTES and before.islower() and here.isupper() and len(before) == len(here) == 1:
            result[at - 1], result[at] = before, here
            size = _utf8_bytes(here)
    return "".join(result)
