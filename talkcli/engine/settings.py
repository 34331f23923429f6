"""A goal's settings as properties of a pyttsx3 engine.

A property is set only where it differs from what the driver has: a foreign driver may not know a property that nobody
asked for. A voice is always set by an id that the driver itself lists.
"""

from __future__ import annotations

from talkcli.engine.synthesizers.base import Sound, UnknownVoice
from talkcli.engine.synthesizers.voices import find_voice, list_voices, unknown_voice
from talkcli.frozen import fields

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from talkcli.engine.protocol import Say, Voice


class SettingFailed(Exception):
    """A setting cannot be had: `reason` is for programs, the text for people."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class Settings:
    """What the properties of one engine were last set to."""

    def __init__(self, engine: Any, driver: str) -> None:
        self._engine = engine
        self._driver = driver
        self._set = fields(Sound())  # what pyttsx3's drivers set themselves
        self._default_voice: Any = None
        self._voices: tuple[Voice, ...] | None = None
        self._voice: str | None = None
        self._error: Exception | None = None
        engine.connect("error", self._note)

    def apply(self, say: Say) -> None:
        """Set what the goal wants; SettingFailed if that cannot be had."""
        self.set_voice(say.voice)
        for name, value in (("rate", say.rate), ("volume", say.volume), ("pitch", say.pitch)):
            if self._set.get(name) == value:
                continue
            error = self._try(name, value)
            if error is not None:
                text = f"the driver {self._driver} cannot set {name} to {value}"
                raise SettingFailed("bad_option", f"{text}: {_text(error)}") from error
            self._set[name] = value

    def set_voice(self, wanted: str | None) -> None:
        """Set the voice; None is the one that the driver started with. SettingFailed if there is no such voice."""
        if wanted == self._voice:
            return
        if self._voice is None:
            self._default_voice = self._engine.getProperty("voice")
        value = self._default_voice if wanted is None else self._driver_id(wanted)
        error = self._try("voice", value)
        if isinstance(error, UnknownVoice):
            text = f"the voice {value} is listed, but it cannot be loaded: {error}"
            raise SettingFailed("unknown_voice", text) from error
        if error is not None:
            text = f"the driver {self._driver} cannot set the voice {wanted}"
            raise SettingFailed("bad_option", f"{text}: {_text(error)}") from error
        self._voice = wanted

    def _driver_id(self, wanted: str) -> str:
        if self._voices is None:  # once: it takes some milliseconds, and they don't change while a process lives
            self._voices = list_voices(self._engine)
        found = find_voice(wanted, self._voices)
        if found is None:
            raise SettingFailed("unknown_voice", unknown_voice(wanted, self._voices))
        return found.id

    def _try(self, name: str, value: Any) -> Exception | None:
        """Set a property and return what went wrong: pyttsx3 reports it by a notification, not by an exception."""
        self._error = None
        self._engine.setProperty(name, value)
        error, self._error = self._error, None
        return error

    def _note(self, exception: Exception, **_: object) -> None:
        self._error = exception


def _text(error: Exception) -> str:
    return str(error.args[0] if error.args else error) or type(error).__name__
