"""Voices as pyttsx3's drivers list them, in the protocol's form, and how a user's word is matched with them.

It asks the driver and sets nothing.
"""

from __future__ import annotations

from typing import Any

from talkcli.engine.protocol import Voice


def list_voices(engine: Any) -> tuple[Voice, ...]:
    """Return all voices of the engine's driver."""
    return tuple(_voice(each) for each in engine.getProperty("voices") or ())


def find_voice(wanted: str, voices: tuple[Voice, ...]) -> Voice | None:
    """Return the voice with this id, name or language, in this order; case does not count."""
    word = wanted.casefold()
    for field in ("id", "name", "language"):
        for voice in voices:
            if (getattr(voice, field) or "").casefold() == word:
                return voice
    return None


def unknown_voice(wanted: str, voices: tuple[Voice, ...]) -> str:
    """Return the message for a voice that is not there: what comes near, and the next step."""
    import difflib

    known = {word.casefold(): word for voice in voices for word in (voice.language, voice.name, voice.id) if word}
    within = [known[word] for word in known if len(wanted) > 2 and wanted.casefold() in word][:3]
    near = within or [known[word] for word in difflib.get_close_matches(wanted.casefold(), known, n=3, cutoff=0.5)]
    hint = f"did you mean {' or '.join(repr(word) for word in near)}? " if near else ""
    return f'unknown voice "{wanted}": {hint}"talk voices" lists them'


def _voice(found: Any) -> Voice:
    languages = found.languages or []
    language = languages[0] if languages else None
    if isinstance(language, bytes):  # older drivers: a priority byte, then the language
        language = language[1:].decode("utf-8", "replace")
    return Voice(id=str(found.id), language=language or None, name=str(found.name or found.id))
