"""The voices that there are, and which one a word means. Which voices are loaded is in `goals.voices`.

The directories of neural voices are read only if somebody asks for a voice that the engine has not listed.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from talkcli.engine.voices import UnknownVoice, find_voice, is_own_driver, speaker_number, unknown_voice_message
from talkcli.goals.options import DEFAULT_VOICE, NEURAL_PREFIX, SPEAKER_MARK, is_neural
from talkcli.goals.reasons import Reason

if TYPE_CHECKING:
    from talkcli.engine.protocol import Voice
    from talkcli.goals.reasons import Refusal


class VoiceCatalog:
    """The voices of a server's engine, and the neural voices whose files are installed.

    `settings_voice` in its methods is the voice that the server speaks with. Its language may mean a neural voice then.
    """

    def __init__(self) -> None:
        #: the voices that the engine has listed; None before that
        self.listed: tuple[Voice, ...] | None = None
        #: the driver that speaks; None for the default, until it is known
        self.driver: str | None = None

    def refusal(self, voice: str | None, settings_voice: str | None = None) -> Refusal | None:
        """Return why a voice can't be had; None if it can or if that isn't known yet."""
        if self._is_unchecked(voice):
            return None
        assert voice
        found = self._find(voice, settings_voice)
        if found is None:
            return Reason.UNKNOWN_VOICE, unknown_voice_message(voice, self._candidates(voice), self._foreign_driver)
        missing = self._missing(found.id) if is_neural(found.id) else None
        return (Reason.UNKNOWN_VOICE, f"the voice {voice[:60]} cannot be spoken: {missing}") if missing else None

    def resolve(self, voice: str | None, settings_voice: str | None = None) -> str | None:
        """Return the id of the neural voice that a word means. Return the word itself if it means another voice."""
        if self._is_unchecked(voice):
            return voice
        assert voice
        found = self._find(voice, settings_voice)
        return found.id if found and is_neural(found.id) else voice

    def find_new_files(self) -> None:
        """Update the list of neural voices to those that are installed now."""
        from talkcli.engine import models

        if self.listed and is_own_driver(self.driver):
            self.listed = (*self._driver_voices, *models.installed_voices())

    @staticmethod
    def file_size(voice: str) -> int:
        """Return the size of a neural voice's file in bytes; 0 if there is no file."""
        from talkcli.engine import models

        try:
            return os.path.getsize(models.find_models()[voice.removeprefix(NEURAL_PREFIX)])
        except (KeyError, OSError):  # the engine will report it
            return 0

    def _is_unchecked(self, voice: str | None) -> bool:
        """Return whether a voice can't be checked: it is the default, or the voices are not listed yet."""
        return not voice or voice == DEFAULT_VOICE or not (self.listed or is_neural(voice))

    def _find(self, voice: str, settings_voice: str | None) -> Voice | None:
        if not (is_neural(voice) or is_neural(settings_voice or "")):
            found = find_voice(voice, self._driver_voices)
            if found is not None:
                return found  # without reading the directories of neural voices
        return find_voice(voice, self._candidates(voice), settings_voice)

    @property
    def _driver_voices(self) -> tuple[Voice, ...]:
        return tuple(each for each in self.listed or () if not is_neural(each.id))

    def _candidates(self, voice: str) -> tuple[Voice, ...]:
        """Return the voices that a word may mean, with the neural voices that are installed now."""
        own = () if is_neural(voice) else self._driver_voices
        if self._foreign_driver is not None:
            return own
        from talkcli.engine import models

        listed = {each.id: each for each in self.listed or ()}
        return (*own, *(listed.get(each.id, each) for each in models.installed_names()))

    @property
    def _foreign_driver(self) -> str | None:
        """The driver, if it is not one of `talk` and so has no neural voices."""
        return None if is_own_driver(self.driver) else self.driver or "the system's own"

    @staticmethod
    def _missing(voice: str) -> str | None:
        """Return what is missing for a neural voice: a package, or the speaker that is asked for."""
        from talkcli.engine import models

        model, mark, speaker = voice.partition(SPEAKER_MARK)
        if mark:
            try:
                about = models.read_description(models.find_models()[model.removeprefix(NEURAL_PREFIX)])
                speaker_number(speaker, about.speaker_names, about.speakers)
            except UnknownVoice as error:
                return str(error)
            except (KeyError, models.VoiceFileError):  # the engine will report it
                pass
        return models.missing_package()
