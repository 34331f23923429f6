"""Code that finds the voice that a client asks for.

`goals.voices` decides when voices are loaded.

The directories of neural voices are read only if a client asks for a voice that the engine has not listed.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from talkcli.engine import models
from talkcli.engine.voices import UnknownVoice, find_voice, is_own_driver, speaker_number, unknown_voice_message
from talkcli.goals.options import DEFAULT_VOICE, NEURAL_PREFIX, SPEAKER_MARK, is_neural
from talkcli.goals.reasons import Reason, Refusal

if TYPE_CHECKING:
    from talkcli.engine.protocol import Voice


class VoiceCatalog:
    """The voices of a server's engine, including the installed neural voices."""

    def __init__(self) -> None:
        #: voices listed by the engine, or None if it hasn't listed them yet
        self.listed: tuple[Voice, ...] | None = None
        #: name of the engine's driver, or None while the default driver is unknown
        self.driver: str | None = None

    def look_up(self, voice: str | None, settings_voice: str | None = None) -> tuple[str | None, Refusal | None]:
        """Return the id or name of the requested voice, and a refusal if the voice isn't available.

        For a neural voice, the first value is the id. For every other voice, it is the client's input. The default
        voice is never checked, and other voices are not checked before the engine has listed its voices.

        Args:
            voice: the client's input.
            settings_voice: the voice in the server's settings. If it is neural, its language is another name for it.
        """
        if not voice or voice == DEFAULT_VOICE or not (self.listed or is_neural(voice)):
            return voice, None
        found = self._find(voice, settings_voice)
        if found is None:
            words = unknown_voice_message(voice, self._candidates(voice), self._foreign_driver)
            return voice, (Reason.UNKNOWN_VOICE, words)
        if not is_neural(found.id):
            return voice, None
        missing = self._missing_part(found.id)
        words = f"the voice {voice[:60]} can't be used: {missing}"
        return found.id, (Reason.UNKNOWN_VOICE, words) if missing else None

    def find_new_files(self) -> None:
        """Refresh the list of neural voices from the installed files."""
        if self.listed and is_own_driver(self.driver):
            self.listed = (*self._driver_voices, *models.installed_voices())

    @staticmethod
    def file_size(voice: str) -> int:
        """Return the size of a neural voice's file in bytes, or 0 if there is no file."""
        try:
            return os.path.getsize(models.find_models()[voice.removeprefix(NEURAL_PREFIX)])
        except (KeyError, OSError):  # the engine will report the error when it loads the voice
            return 0

    def _find(self, voice: str, settings_voice: str | None) -> Voice | None:
        """Return the voice that matches the client's input, if any. For a language, prefer the settings' voice.

        Read directories only if necessary.
        """
        if not (is_neural(voice) or is_neural(settings_voice or "")):
            found = find_voice(voice, self._driver_voices)
            if found is not None:
                return found  # the directories of neural voices don't have to be read
        return find_voice(voice, self._candidates(voice), settings_voice)

    @property
    def _driver_voices(self) -> tuple[Voice, ...]:
        """The voices listed by the engine, except neural voices."""
        return tuple(each for each in self.listed or () if not is_neural(each.id))

    def _candidates(self, voice: str) -> tuple[Voice, ...]:
        """Return all voices that could have this name or id."""
        own = () if is_neural(voice) else self._driver_voices
        if self._foreign_driver is not None:
            return own
        listed = {each.id: each for each in self.listed or ()}
        return (*own, *(listed.get(each.id, each) for each in models.undescribed_voices()))

    @property
    def _foreign_driver(self) -> str | None:
        """The name of the engine's driver, unless it is one of `talk`'s own.

        Other drivers have no neural voices.
        """
        return None if is_own_driver(self.driver) else self.driver or "the system's own"

    @staticmethod
    def _missing_part(voice: str) -> str | None:
        """Return an error message if a neural voice's speaker or a required package is missing."""
        model, mark, speaker = voice.partition(SPEAKER_MARK)
        if mark:
            try:
                about = models.read_description(models.find_models()[model.removeprefix(NEURAL_PREFIX)])
                speaker_number(speaker, about.speaker_names, about.speakers)
            except UnknownVoice as error:
                return str(error)
            except (KeyError, models.VoiceFileError):  # the engine will report the error when it loads the voice
                pass
        return models.missing_package()
