"""The guard for libespeak-ng, which replaces the few characters of a text that would crash the library.

The module is pure. It replaces each of these characters by another one, so every position in the text stays the same.
Ordinary text must pass unchanged. Each rule is for a known cause of a crash, documents its numbers, and changes nothing
without that cause. The guard only makes crashes rare. If a crash happens nevertheless, only the engine process is lost.

The numbers are the sizes of buffers that libespeak-ng 1.51 overruns (N_WORD_BYTES, N_CLAUSE_WORDS and N_TR_SOURCE in
`translate.h`). Version 1.52 has fixed some of these faults.
"""

from __future__ import annotations

import re
import unicodedata

#: The characters that become blanks. 0x01 starts a command to the library (a new pitch or voice), 0x02 after a "["
#: starts phonemes, and NUL ends the text. Tabs and line ends are harmless. U+FFFD, the replacement for unreadable
#: bytes, is silent, but the library would report it as a word instead of the next word.
_BLANKED = {code: " " for code in (*range(0x20), *range(0x7F, 0xA0), 0xFFFD) if chr(code) not in "\t\n\r"}

#: The usable size of the buffer for looking up initials such as "U.S.A.". It contains each letter with its dot, and the
#: whole word after the last dot (N_WORD_BYTES is 160, including the end). 'a.' * 85 and 'a.' + 'b' * 170 overrun it.
_LOOKUP_BYTES = 156
#: The usable size of the buffer for spelling out initials, which has 80 bytes. At most 50 letters are spoken anyway.
_SPELLING_BYTES = 78
#: The maximum number of words before initials in a clause. Each initial marks up to two words after it as spoken, in a
#: table of 300 words per clause (N_CLAUSE_WORDS), without a check of the limit.
_MAX_CLAUSE_WORDS = 220
#: The number of bytes after which the library ends a clause at the next blank (N_TR_SOURCE is 800, of which 75 are
#: reserved).
_MAX_CLAUSE_BYTES = 725
#: The maximum length of a word from which the library may remove an ending: N_WORD_BYTES without room for the
#: replacement.
_MAX_WORD_BYTES = 150
#: The maximum number of apostrophes in a word. Each "'s" is an ending, and the phonemes of all endings share a buffer
#: of 200 bytes, which 70 endings overrun.
_MAX_WORD_APOSTROPHES = 30

#: A character that the library treats as a part of a word: a letter, a digit, an apostrophe, and nearly every character
#: outside ASCII, including separate accents.
_WORD_CHARACTER = (
    r"(?:[A-Za-z0-9'’]|(?![\s\u0080-\u00a9\u00ab-\u00b4\u00b6-\u00b9\u00bb-\u00bf\u2000-\u200a\u2010-\u205f\u3000-\u303f"
    r"\uff00-\uff0f])[^\x00-\x7f])"
)
_WORD_OR_GAP = re.compile(f"({_WORD_CHARACTER}+)|((?:(?!{_WORD_CHARACTER}).)+)", re.DOTALL)
#: Symbols that the library treats as letters (enclosed characters and Braille).
_SYMBOL_LETTERS = frozenset(map(chr, (*range(0x2460, 0x2500), *range(0x2800, 0x2900))))
#: The end of a clause: Western punctuation before a blank, a bracket or the end of the text, and other punctuation
#: anywhere.
_CLAUSE_END = re.compile(r"[.,;:!?…](?:[\s()\[\]{}<>\"«»“”‘’„]|\Z)|[。、，！？：；︒؟،؛।॥։՝]|\n\s*\n")
#: A hyphen between a symbol and a letter.
_HYPHEN = re.compile(r"(?<=[^\w\s]|_)-(?=[^\W\d_])")
#: The first character of the scripts in which each character is a word, and the first and last Hangul syllables. The
#: library splits these syllables into letters of three bytes.
_IDEOGRAPHS, _HANGUL, _HANGUL_END = "\u2e80", "\uac00", "\ud7a3"
#: Characters that have no name in the default language of their script, with the languages that can process them. For
#: any other voice, the library loads that default language, finds no name, loads English instead, and continues with
#: memory that it has just freed (`LookupLetter` in `numbers.c`). The characters were found in 1.51 by speaking every
#: character in each of the 131 voices while freed memory was overwritten. These voices are silent for all of them
#: except the four Greek symbols.
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
#: A number, with or without thousands separators.
_SPOKEN_NUMBER = re.compile(r"[0-9]+(?:,[0-9]{3})*")
#: The minimum and maximum number of digits with which a number crashes the Cantonese and Shan voices, because its words
#: have more than 200 bytes of phonemes (N_WORD_PHONEMES). Longer numbers are spoken digit by digit. This was measured
#: by speaking 382 numbers of 6 to 39 digits in each of the 131 voices.
_UNSAFE_DIGIT_COUNTS = {"yue": (13, 14), "shn": (13, 14)}
#: Replacements for digits that these voices speak separately, so that they split a number. Two of them in a row would
#: be silent.
_SEPARATE_DIGITS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


def guarded(text: str, voice: str = "") -> str:
    """Return a text of the same length that doesn't crash libespeak-ng.

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
    return _WORD_OR_GAP.sub(_split_word, _without_leading_hyphens(_without_long_initials(text)))


def _unsafe_characters(language: str) -> re.Pattern[str]:
    """Return a pattern for the characters that crash the voices of a language."""
    found = (signs for languages, signs in _CRASHING_CHARACTERS.items() if language not in languages)
    return re.compile(f"[{''.join(found)}]")


def _split_number(number: str, least: int, most: int) -> str:
    """Return a number, with one digit replaced to split it if it has `least` to `most` digits."""
    if not least <= sum(map(str.isdigit, number)) <= most:
        return number
    middle = next(place for place in range(len(number) // 2, len(number)) if number[place].isdigit())
    return number[:middle] + number[middle].translate(_SEPARATE_DIGITS) + number[middle + 1 :]


def _without_long_initials(text: str) -> str:
    """Blank the dots after initials that would overrun the library's buffers."""
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
    """Return whether a clause ends between two positions; a dot before a lower-case letter means an abbreviation."""
    behind = text[end : end + 1]
    stops = _CLAUSE_END.finditer(text, start, end + len(behind))
    return any(text[each.start()] != "." or not behind.islower() for each in stops)


def _is_letter(character: str) -> bool:
    """Return whether a character of a word counts as a letter, unlike quotes and joiners."""
    return character.isalnum() or character in _SYMBOL_LETTERS or unicodedata.category(character).startswith("M")


def _utf8_bytes(text: str) -> int:
    """Return the length of a text in UTF-8, where the library gets a single byte for a lone surrogate."""
    return len(text.encode("utf-8", "replace"))


def _max_bytes(character: str) -> int:
    """Return the number of bytes that a character may need, because some voices replace it by other letters."""
    if _HANGUL <= character <= _HANGUL_END:
        return 9
    return max(2, _utf8_bytes(character), _utf8_bytes(character.lower()))


def _without_leading_hyphens(text: str) -> str:
    """Blank a hyphen between the first symbol of a clause and a word, as in "'-o".

    The library doesn't mark the beginning of this word, and searches for the mark before the start of its list of
    phonemes. This crashes Vietnamese, Danish, Hindi and other voices. The library doesn't report the word either.
    """

    def blanked(found: re.Match[str]) -> str:
        at = start = found.start()
        while start and not text[start - 1].isalnum():
            start -= 1
        return " " if start == 0 or _ends_clause(text, start, at) else "-"

    return _HYPHEN.sub(blanked, text)


def _split_word(piece: re.Match[str]) -> str:
    """Split a word that would overrun the library's buffers, by blanking apostrophes or capitalizing letters."""
    word = piece.group(1) or ""
    # Words in scripts without capital letters can only be split at an apostrophe.
    short = _utf8_bytes(word) <= _MAX_WORD_BYTES or word.lower() == word.upper()
    if short and word.count("'") + word.count("’") <= _MAX_WORD_APOSTROPHES:
        return piece.group()
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
