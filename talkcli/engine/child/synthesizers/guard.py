"""The guard before libespeak-ng: replaces the few characters of a text that are known to kill the library.

Pure. One character takes the place of one, so that every offset stays what it was. Ordinary text must come out as it
went in: a rule looks for a cause, says where its numbers come from, and touches nothing where that cause is not there.
It makes crashes rare, no more; what is relied upon is that the library runs in a process of its own. And the first
sound waits for it: a rule that goes through a text character by character, 20 ms for a long one, does so only where a
quick look has found that it may have to.

The numbers are sizes of buffers into which libespeak-ng 1.51 writes without looking (N_WORD_BYTES, N_CLAUSE_WORDS and
N_TR_SOURCE in its `translate.h`); 1.52 has mended some of them.
"""

from __future__ import annotations

import functools
import re
import unicodedata

#: Control characters: 0x01 starts a command to the library (another pitch, voice, punctuation), 0x02 behind a "["
#: phonemes, NUL ends its text. Tab, newline and return are blanks to it already. U+FFFD, for what could not be read, is
#: as silent to it as a blank, but it would report that as a word, and not the one behind it.
_BLANKED = {code: " " for code in (*range(0x20), *range(0x7F, 0xA0), 0xFFFD) if chr(code) not in "\t\n\r"}

#: Bytes for letters with dots, "U.S.A.", where they are looked up: each letter and a dot, then the word behind the last
#: dot whole (N_WORD_BYTES, 160, less its end). 'a.' * 85 and 'a.' + 'b' * 170 are more.
_LOOKED_UP = 156
#: Bytes for the same letters where they are spelled: 80. No more than 50 of them are heard anyway.
_SPELLED = 78
#: Each of those letters marks up to two words behind it as spoken, in a table of 300 words a clause (N_CLAUSE_WORDS)
#: without an end that is looked at. So behind this many words there must be none.
_WORDS = 220
#: Bytes after which the library ends a clause by itself, behind the next blank (N_TR_SOURCE, 800, less 75).
_CLAUSE = 725
#: Bytes of a word where its ending is taken off it: 160 (N_WORD_BYTES), less what is put in its place.
_LONGEST_WORD = 150
#: Apostrophes of a word: each "'s" is an ending of its own, whose sounds are collected in 200 bytes; 70 are too many.
_ENDINGS = 30

#: What the library takes for a part of a word: letters, digits, apostrophes, and nearly all that is not ASCII, accents
#: that stand alone included.
_WORD = (
    r"(?:[A-Za-z0-9'’]|(?![\s\u0080-\u00a9\u00ab-\u00b4\u00b6-\u00b9\u00bb-\u00bf\u2000-\u200a\u2010-\u205f\u3000-\u303f"
    r"\uff00-\uff0f])[^\x00-\x7f])"
)
_IN_WORD = re.compile(_WORD)
_PIECE = re.compile(f"({_WORD}+)|((?:(?!{_WORD}).)+)", re.DOTALL)
#: What may hold a word with more than `_ENDINGS` characters.
_LONG_RUN = re.compile(rf"\S{{{_ENDINGS + 1},}}")
#: Signs that the library takes for letters: in circles, Braille.
_SIGN_LETTERS = frozenset(map(chr, (*range(0x2460, 0x2500), *range(0x2800, 0x2900))))
#: What ends a clause: the first where a blank, a bracket or nothing follows, the second anywhere.
_STOP = re.compile(r"[.,;:!?…](?:[\s()\[\]{}<>\"«»“”‘’„]|\Z)|[。、，！？：；︒؟،؛।॥։՝]|\n\s*\n")
#: The plainest of those ends: where one of these is, a clause ends for certain.
_PLAIN_STOP = re.compile(r"[,;:!?]\s|\.\s+[A-Z]")
#: A hyphen behind a sign, before a letter.
_HYPHEN = re.compile(r"(?<=[^\w\s]|_)-(?=[^\W\d_])")
#: Scripts whose characters are words of their own, and the syllables that are taken apart into letters of three bytes.
_IDEOGRAPHS, _HANGUL, _HANGUL_END = "\u2e80", "\uac00", "\ud7a3"
#: Characters that the language of their script has no word for, by the languages that get along with them all the same.
#: In any other voice the library loads that language for them, finds nothing, loads English in its place, and goes on
#: with what it has just freed (`LookupLetter` in its `numbers.c`): what becomes of it depends on who got the memory.
#: Found in 1.51 by speaking every character in each of the 131 voices with that memory overwritten. None of them is
#: heard in those voices but the four Greek signs, as names of signs.
_UNKNOWN_TO_THEIR_SCRIPT = {
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
#: Digits of a number, with what separates thousands.
_NUMBER = re.compile(r"[0-9]+(?:,[0-9]{3})*")
#: Digits of which the library can't say a number in Cantonese and Shan: its words are more than 200 bytes of sounds
#: (N_WORD_PHONEMES). Numbers that are longer it says digit by digit. Each of 382 numbers of 6 to 39 digits was spoken
#: in each of the 131 voices.
_TOO_LONG_TO_SAY = {"yue": (13, 14), "shn": (13, 14)}
#: One of these between digits is said by itself in those voices, and so parts a number; two in a row are silent.
_ALONE = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


def guarded(text: str, voice: str = "") -> str:
    """Return the text with what would kill libespeak-ng replaced; its length is the same.

    The voice is an id as the library has it, "gmw/en-US" or "ko+f3", or empty: of no language.
    """
    text = text.translate(_BLANKED)
    language = re.split(r"[-+]", voice.rpartition("/")[2], maxsplit=1)[0]
    if not text.isascii():
        text = _unknown_in(language).sub(" ", text)
    if language in _TOO_LONG_TO_SAY:
        text = _NUMBER.sub(lambda found: _parted(found[0], *_TOO_LONG_TO_SAY[language]), text)
    if _may_have_long_initials(text):
        text = _without_long_initials(text)
    if "-" in text:
        text = _without_leading_hyphens(text)
    return _without_endless_words(text)


@functools.lru_cache(maxsize=8)
def _unknown_in(language: str) -> re.Pattern[str]:
    """Return what finds the characters that no voice but those of their script may be given."""
    found = (signs for languages, signs in _UNKNOWN_TO_THEIR_SCRIPT.items() if language not in languages)
    return re.compile(f"[{''.join(found)}]")


def _parted(number: str, least: int, most: int) -> str:
    """Return a number of so many digits as two, with a digit between them that is said by itself."""
    if not least <= sum(map(str.isdigit, number)) <= most:
        return number
    middle = next(place for place in range(len(number) // 2, len(number)) if number[place].isdigit())
    return number[:middle] + number[middle].translate(_ALONE) + number[middle + 1 :]


def _may_have_long_initials(text: str) -> bool:
    """Tell whether there may be more letters with dots in a row, or words before them, than is good. Looks at dots."""
    dot = text.find(".")
    while dot >= 0 and (behind := _IN_WORD.search(text, dot)):
        start = _initial_before(text, dot)
        if start is not None and _may_be_long(text, start):
            return True
        dot = text.find(".", behind.start())
    return False


def _initial_before(text: str, dot: int) -> int | None:
    """Return where the last word before a dot begins if that has no more than one letter."""
    end = dot
    while end and not _IN_WORD.match(text[end - 1]):
        end -= 1
    start, letters = end, 0
    while start and letters < 2 and _IN_WORD.match(text[start - 1]):
        start -= 1
        letters += _is_letter(text[start])
    return start if start < end and letters < 2 else None


def _may_be_long(text: str, start: int) -> bool:
    """Tell whether the letters with dots that begin there may be too many, with the word behind them."""
    room = 0
    for piece in _PIECE.finditer(text, start):
        word, between = piece.groups()
        if between is not None:
            if "." not in between:
                return False
            continue
        room += (2 * len(word) if word.isascii() else sum(map(_room, word))) + 1
        before = piece.end() - _WORDS  # there are no more words than characters
        if room > _SPELLED or (before > 0 and not _PLAIN_STOP.search(text, before, start + 1)):
            return True
        if sum(map(_is_letter, word)) > 1:
            return False
    return False


def _without_long_initials(text: str) -> str:
    """Blank the dots between single letters where the library would collect more of them than it has room for."""
    result = list(text)
    looked_up = spelled = words = size = 0
    dots: list[int] = []
    for piece in _PIECE.finditer(text):
        word, between = piece.groups()
        size += len(piece.group().encode())
        if between is not None:
            words += len("".join(between.split()))
            if size > _CLAUSE or _ends_clause(text, piece.start(), piece.end()):
                words = size = 0
            dots = [at for at in range(piece.start(), piece.end()) if text[at] == "."]
            if not dots:
                looked_up = spelled = 0
            continue
        room = sum(map(_room, word))
        words += len(word) if word[0] >= _IDEOGRAPHS else 1
        single = sum(map(_is_letter, word)) < 2
        if looked_up and (looked_up + room > _LOOKED_UP or (single and spelled + room > _SPELLED) or words > _WORDS):
            for at in dots:
                result[at] = " "
            looked_up = spelled = 0
        looked_up, spelled = (looked_up + room + 1, spelled + room) if single else (0, 0)
    return "".join(result)


def _ends_clause(text: str, start: int, end: int) -> bool:
    """Tell whether a clause ends among these signs; a dot before a small letter is an abbreviation's."""
    behind = text[end : end + 1]
    stops = _STOP.finditer(text, start, end + len(behind))
    return any(text[each.start()] != "." or not behind.islower() for each in stops)


def _is_letter(character: str) -> bool:
    """Tell whether it makes a word longer: not the quotes, joiners and signs around a letter."""
    return character.isalnum() or character in _SIGN_LETTERS or unicodedata.category(character).startswith("M")


def _room(character: str) -> int:
    """Return the bytes that a character may need: some voices put other letters in its place."""
    if _HANGUL <= character <= _HANGUL_END:
        return 9
    return max(2, len(character.encode()), len(character.lower().encode()))


def _without_leading_hyphens(text: str) -> str:
    """Blank a hyphen that joins a word to a sign with which its clause begins, as in "'-o".

    The library marks no beginning of that word, and looks for it before the first phoneme of its list: in Vietnamese,
    Danish, Hindi and others what it finds there kills it. Nor does it report the word.
    """

    def blanked(found: re.Match[str]) -> str:
        at = start = found.start()
        while start and not text[start - 1].isalnum():
            start -= 1
        return " " if start == 0 or _ends_clause(text, start, at) else "-"

    return _HYPHEN.sub(blanked, text)


def _without_endless_words(text: str) -> str:
    """Have a word that is too much for the library's buffers end earlier: at an apostrophe, or before a capital."""
    return _LONG_RUN.sub(lambda run: _PIECE.sub(_shortened, run.group()), text)


def _shortened(piece: re.Match[str]) -> str:
    word = piece.group(1)
    # Where a script has no capitals there is no place but an apostrophe.
    if word is None or (
        word.count("'") + word.count("’") <= _ENDINGS
        and (len(word.encode()) <= _LONGEST_WORD or word.lower() == word.upper())
    ):
        return piece.group()
    result = list(word)
    size = endings = 0
    for at, character in enumerate(word):
        size += len(character.encode())
        endings += character in "'’"
        before, here = result[at - 1].lower(), character.upper()
        if endings > _ENDINGS:
            result[at] = " "
            size = endings = 0
        elif size > _LONGEST_WORD and before.islower() and here.isupper() and len(before) == len(here) == 1:
            result[at - 1], result[at] = before, here
            size = len(here.encode())
    return "".join(result)
