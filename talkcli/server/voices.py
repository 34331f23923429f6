"""The voices that a server has: what their names mean, and what has become of the neural ones, which must be loaded.

What is loaded is in the engine process, and gone with it; this is what the server knows of it. It loads nothing and
tells nobody: that is for `speech`. It looks at no files but where somebody asks for a voice that it doesn't know.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

from talkcli.engine.voices import (
    NEURAL_PREFIX,
    UnknownVoice,
    find_voice,
    is_neural,
    is_own_driver,
    speaker_number,
    unknown_voice_message,
)
from talkcli.goals.options import DEFAULT_VOICE, SPEAKER
from talkcli.goals.reasons import Reason

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from talkcli.engine.protocol import Voice
    from talkcli.goals.goal import JsonObject
    from talkcli.goals.reasons import Refusal

#: Seconds after which a voice that failed may be loaded again, where a goal asks for it: twice as long each time, up to
#: an hour, as one that can't be loaded costs a second of the processor, and one that kills the engine a sentence.
RETRY_AFTER, RETRY_AT_LAST = 5.0, 3600.0
#: Deaths of the engine while a voice is loaded, after which that voice is taken for the cause.
DEATHS = 2


class Readiness(Enum):
    """What has become of a neural voice that was asked for."""

    WAITING = "waiting"  # to be loaded
    LOADING = "loading"
    LOADED = "loaded"
    FAILED = "failed"  # another speaks in its place


@dataclass(slots=True)
class Neural:
    """A neural voice that was asked for."""

    #: bytes that it takes in memory, as the engine has measured them; until it has, those of its file
    size: int
    state: Readiness = Readiness.WAITING
    #: why it can't be had, for people
    why: str | None = None
    #: how often in a row it could not be loaded
    failures: int = 0
    #: whether it is to be loaded, for the first time or, where it failed, again
    wanted: bool = True
    #: the monotonic time from which on one that failed may be tried again
    again_at: float = 0.0

    def fail(self, why: str, now: float) -> None:
        """Take note that it could not be loaded."""
        self.failures += 1
        self.again_at = now + min(RETRY_AT_LAST, RETRY_AFTER * 2 ** (self.failures - 1))
        self.state, self.why = Readiness.FAILED, why


class Voices:
    """The voices of one server."""

    def __init__(self, memory: int) -> None:
        """`memory`: bytes that neural voices may take in the engine, unless the one that speaks takes more alone."""
        self._memory = memory
        #: bytes by which the engine process has grown by its voices, as it told last, and without those dropped since
        self._told = self._grown = 0
        #: what each voice took when it was loaded last
        self._measured: dict[str, int] = {}
        #: all that the engine lists; None before it has
        self.listed: tuple[Voice, ...] | None = None
        #: the driver that speaks; None for the usual one, before it is known
        self.driver: str | None = None
        #: by id, without a speaker; the one that was asked for last behind the others
        self.neural: dict[str, Neural] = {}
        #: whether the engine process has the libraries, as one was loaded, or failed in that
        self.warm = False
        #: the one that the engine is loading
        self._loading: str | None = None

    def fault(self, voice: str | None, usual: str | None = None) -> Refusal | None:
        """Return reason and words why a voice can't be had; None also where that is not known.

        `usual`: the one that the server speaks with, where a goal is looked at.
        """
        if voice is None or voice == DEFAULT_VOICE or not (self.listed or is_neural(voice)):
            return None
        found = self._find(voice, usual)
        if found is None:
            return Reason.UNKNOWN_VOICE, unknown_voice_message(voice, self._known(voice), self._foreign)
        lacking = self._lacking(found.id) if is_neural(found.id) else None
        return (Reason.UNKNOWN_VOICE, f"the voice {voice[:60]} cannot be spoken: {lacking}") if lacking else None

    def meant(self, voice: str | None, usual: str | None = None) -> str | None:
        """Return a voice as it was asked for, a neural one by its id; `usual`: the one that the server speaks with."""
        if not voice or voice == DEFAULT_VOICE or not (self.listed or is_neural(voice)):
            return voice
        found = self._find(voice, usual)
        return found.id if found and is_neural(found.id) else voice

    def _find(self, voice: str, usual: str | None) -> Voice | None:
        if not (is_neural(voice) or is_neural(usual or "")):
            found = find_voice(voice, self._of_driver)
            if found is not None:
                return found  # without a look into the directories of neural voices
        return find_voice(voice, self._known(voice), usual)

    @property
    def _of_driver(self) -> tuple[Voice, ...]:
        return tuple(each for each in self.listed or () if not is_neural(each.id))

    def _known(self, voice: str) -> tuple[Voice, ...]:
        """Return the voices that a word may mean: of neural ones those whose files are there now."""
        if self._foreign is not None:
            return () if is_neural(voice) else self._of_driver
        from talkcli.engine import models

        listed = {each.id: each for each in self.listed or ()}
        neural = (listed.get(each.id, each) for each in models.installed_names())
        return (*(() if is_neural(voice) else self._of_driver), *neural)

    @property
    def _foreign(self) -> str | None:
        """The driver, where it is none of `talk`'s own; on another system than Linux all are."""
        return None if is_own_driver(self.driver) else self.driver or "the system's own"

    @staticmethod
    def _lacking(voice: str) -> str | None:
        """Return what a neural voice lacks, by its id: a package, or the speaker that is asked for."""
        from talkcli.engine import models

        model, mark, speaker = voice.partition(SPEAKER)
        if mark:
            try:
                about = models.read_description(models.find_models()[model.removeprefix(NEURAL_PREFIX)])
                speaker_number(speaker, about.speaker_names, about.speakers)
            except UnknownVoice as error:
                return str(error)
            except (KeyError, models.VoiceFileError):  # it comes again where it is loaded
                pass
        return models.missing_package()

    def look_for_files(self) -> None:
        """Find what neural voices were put there, or taken away, since the engine listed its voices.

        It takes no more than to read some directories, and only where somebody asks.
        """
        if self.listed and is_own_driver(self.driver):
            self.listed = (*(each for each in self.listed if not is_neural(each.id)), *self._files())

    # -- what is loaded

    def want(self, voice: str, now: float) -> Readiness:
        """Take note that a neural voice is asked for, and return how it is."""
        found = self.neural.pop(voice, None) or self._new(voice)
        self.neural[voice] = found
        if found.state is Readiness.FAILED and voice != self._loading and now >= found.again_at:
            found.wanted = True
        return found.state

    @property
    def lacking(self) -> bool:
        """Whether one could be loaded now."""
        return self._loading is None and any(each.wanted for each in self.neural.values())

    def next(self, needed: Sequence[str], usual: str = "") -> tuple[str, tuple[str, ...]] | None:
        """Return a voice to be loaded now, and those to be dropped for it; it is taken for begun with then.

        `needed`: those of the goals that wait, in their order. One at a time, and none for which one would have to be
        dropped that is needed before it: that would be loaded again, and so on. `usual`: the server's own, for which
        nothing is dropped while no goal needs it.
        """
        if not self.lacking:
            return None
        before: dict[str, int] = {}
        for voice in (*needed, usual):
            found = self.neural.get(voice)
            if found and found.state is Readiness.LOADED:
                before[voice] = found.size
            elif found and found.wanted:
                drop = self._make_room(sum(before.values()) + found.size, before)
                if drop is None or (drop and voice not in needed):
                    return None
                self._loading, found.wanted = voice, False
                if found.state is Readiness.WAITING:
                    found.state = Readiness.LOADING
                for each in drop:
                    self.unloaded(each, needed)
                return voice, drop
        self._forget_what_nobody_needs((*needed, usual))
        return None

    def loaded(self, voice: str, error: str | None, now: float) -> None:
        """Take note of what came of loading a voice; `error`: why it can't be had."""
        if voice == self._loading:  # one that a goal insists on is loaded by the engine itself
            self._loading = None
        found = self.neural.setdefault(voice, self._new(voice))
        found.wanted = False
        if error is None:
            found.state, found.why, found.failures = Readiness.LOADED, None, 0
        else:
            found.fail(error, now)

    def grown(self, voice: str, memory: int) -> None:
        """Take note of the bytes by which the engine has grown by its voices, the last of them by this one.

        `voice`: the one that has been loaded or has spoken; "" if one was dropped.
        """
        found, more = self.neural.get(voice), memory - self._told
        self._told = self._grown = memory
        if found:
            found.size = max(0, found.size + more if found.state is Readiness.LOADED else more)
            self._measured[voice] = found.size

    def excess(self, first: str, needed: Sequence[str]) -> tuple[str, ...]:
        """Return what has to be dropped now, as voices take more than was known when they were loaded.

        `first`: the voice that will speak next, or else the one that speaks; it is kept. `needed`: as in `next`; these
        are dropped last.
        """
        loaded = self._loaded()
        order = [each for each in loaded if each not in needed]
        order += [each for each in reversed(needed) if each in loaded]
        drop: list[str] = []
        total = self._rest() + sum(loaded.values())
        for each in order:
            if total > self._memory and each != first and len(drop) < len(loaded) - 1:
                total -= loaded[each]
                drop.append(each)
        for each in drop:
            self.unloaded(each, needed)
        return tuple(drop)

    def too_large(self) -> str | None:
        """Return a warning about the only loaded voice if it takes too much memory; None if it was told before."""
        loaded = self._loaded()
        voice = next(iter(loaded), "")
        taken = self._rest() + sum(loaded.values())
        if self._loading or len(loaded) != 1 or not 0 < self._memory < taken or self.neural[voice].why:
            return None
        self.neural[voice].why = f"it takes {taken / 1e6:.0f} MB, more than --voice-memory {self._memory / 1e6:.0f}"
        return f"voice {voice}: {self.neural[voice].why}"

    def is_loaded(self, voice: str) -> bool:
        """Tell whether a neural voice is loaded, and has not been dropped."""
        return voice in self._loaded()

    def _loaded(self) -> dict[str, int]:
        return {voice: each.size for voice, each in self.neural.items() if each.state is Readiness.LOADED}

    def _rest(self) -> int:
        """Return the bytes that the engine has grown by beside what each of its voices is known to take."""
        return max(0, self._grown - sum(self._loaded().values()))

    def unloaded(self, voice: str, needed: Sequence[str]) -> None:
        """Take note that a voice is loaded no more; it is to be again where it is needed."""
        found = self.neural.pop(voice, None)
        if found and found.state is Readiness.LOADED:
            self._grown = max(0, self._grown - found.size)  # until the engine tells what it got back
        if found and voice in needed:
            self.neural[voice] = Neural(found.size)

    def engine_lost(self, now: float) -> str | None:
        """Take note that nothing is loaded any more; a voice that was being loaded may be why.

        Return it where it is taken for the cause from now on.
        """
        at, self._loading, self.warm = self._loading, None, False
        self._told = self._grown = 0
        for voice, found in list(self.neural.items()):
            if voice == at and found.failures + 1 >= DEATHS:
                found.fail("the engine process ended while it was being loaded", now)
            elif voice == at:
                self.neural[voice] = Neural(found.size, failures=found.failures + 1)
            elif found.state is not Readiness.FAILED:
                del self.neural[voice]
        return at if at and self.failure(at) else None

    def forgive(self, voice: str) -> None:
        """Forget what was wrong with a voice."""
        found = self.neural.get(voice)
        if found and found.state is Readiness.FAILED and voice != self._loading:
            del self.neural[voice]

    def failure(self, voice: str) -> str | None:
        """Return why a voice can't be had; None for one that can, or may."""
        found = self.neural.get(voice)
        return found.why if found and found.state is Readiness.FAILED else None

    def _make_room(self, size: int, keep: Collection[str]) -> tuple[str, ...] | None:
        """Return what has to be dropped for so many bytes in all, the least asked for first; None if that won't do."""
        others = {voice: each for voice, each in self._loaded().items() if voice not in keep}
        total = size + self._rest() + sum(others.values())
        drop = []
        for voice, each in others.items():
            if total > self._memory:
                total -= each
                drop.append(voice)
        return None if keep and total > self._memory else tuple(drop)

    def _forget_what_nobody_needs(self, needed: Collection[str]) -> None:
        for voice, found in list(self.neural.items()):
            if found.wanted and voice not in needed:
                found.wanted = False
                if found.state is Readiness.WAITING:
                    del self.neural[voice]

    def _new(self, voice: str) -> Neural:
        return Neural(self._measured.get(voice) or self._size(voice))

    @staticmethod
    def _size(voice: str) -> int:
        from talkcli.engine import models

        try:
            return os.path.getsize(models.find_models()[voice.removeprefix(NEURAL_PREFIX)])
        except (KeyError, OSError):  # gone: the engine says so
            return 0

    def to_json(self) -> JsonObject:
        """Return what has become of each neural voice that was asked for, as a server tells it of itself."""
        return {voice: {"state": each.state.value, "why": each.why} for voice, each in self.neural.items()}

    @staticmethod
    def _files() -> tuple[Voice, ...]:
        from talkcli.engine import models

        return models.installed_voices()
