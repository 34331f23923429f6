"""Decides which neural voices to load and unload, and how long goals wait for a voice.

This module is pure: its decisions depend on the engine's reports, and the scheduler passes the orders on. The server
knows which voices exist. A neural voice is identified by its id without a speaker. All other voices are always ready
and don't appear here.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from math import inf
from typing import TYPE_CHECKING

from talkcli.frozen import frozen
from talkcli.goals.options import without_speaker

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Sequence

    from talkcli.goals.goal import JsonObject
    from talkcli.goals.record import Record

#: How long a goal waits for its voice to load. Loading takes three seconds on a small machine.
VOICE_PATIENCE_S = 10.0
#: How long before its expiry a goal stops waiting for its voice, so that it can still start.
EXPIRY_MARGIN_S = 0.5
#: Shortest and longest delay before a failed voice is loaded again. The delay doubles with each failure. A failed
#: attempt takes a second of processor time, and a crash of the engine also breaks off the current sentence.
MIN_VOICE_RETRY_S, MAX_VOICE_RETRY_S = 5.0, 3600.0
#: A voice is considered faulty if the engine dies this many times in a row while loading it.
MAX_ENGINE_DEATHS = 2


class VoiceState(Enum):
    """The progress of loading a neural voice."""

    WAITING = "waiting"  # not yet loaded
    LOADING = "loading"
    LOADED = "loaded"
    FAILED = "failed"  # loading failed, so another voice is used


@dataclass(slots=True)
class NeuralVoice:
    """The loading state, failures and memory use of a requested neural voice."""

    #: measured memory use, or the size of the voice's file if it hasn't been measured yet
    size_bytes: int
    state: VoiceState = VoiceState.WAITING
    #: message that explains a failure, or a warning
    why: str | None = None
    #: number of failed attempts since the voice was last loaded
    failures: int = 0
    #: whether the engine should load the voice
    wanted: bool = True
    #: monotonic time before which a failed voice is not tried again
    retry_at: float = 0.0
    #: monotonic time at which loading started, or inf before that
    loading_since: float = inf

    def fail(self, why: str, now: float) -> None:
        """Record that loading the voice failed, and delay the next attempt."""
        self.failures += 1
        self.retry_at = now + min(MAX_VOICE_RETRY_S, MIN_VOICE_RETRY_S * 2 ** (self.failures - 1))
        self.state, self.why = VoiceState.FAILED, why


@frozen
class VoiceLoadOrder:
    """An effect that makes the engine load a voice, after unloading some others."""

    voice: str
    dropped: tuple[str, ...] = ()


@frozen
class VoiceDropOrder:
    """An effect that makes the engine unload a voice to save memory."""

    voice: str


@frozen
class VoiceWarning:
    """An effect that logs a problem with a voice."""

    message: str


class VoiceScheduler:
    """Decides which neural voices the engine loads and drops.

    To drop a voice means to unload it.
    """

    def __init__(self, limit_bytes: int = 0, file_size: Callable[[str], int] = lambda _: 0) -> None:
        """Create a scheduler with no voices.

        Args:
            limit_bytes: memory limit for all loaded voices. A single voice may use more.
            file_size: function that returns the size of a voice's file in bytes, as an estimate of its memory use.
        """
        self._limit_bytes = limit_bytes
        self._file_size = file_size
        #: requested voices by id, least recently requested first
        self._voices: dict[str, NeuralVoice] = {}
        #: last measured memory use of each voice
        self._measured_bytes: dict[str, int] = {}
        #: memory use of all voices, as last reported by the engine
        self._reported_bytes = 0
        #: estimated memory use of all voices, not counting those dropped since the last report
        self._used_bytes = 0
        #: whether the engine has imported the libraries for neural voices
        self.has_libraries = False
        #: the voice that the engine is loading
        self._loading: str | None = None

    # -- requests from goals

    def request(self, voice: str, now: float) -> None:
        """Mark a voice as the most recently requested one, and plan to load it if necessary.

        A failed voice is retried after a delay.
        """
        found = self._voices.pop(voice, None) or self._new_voice(voice)
        self._voices[voice] = found
        if found.state is VoiceState.FAILED and voice != self._loading and now >= found.retry_at:
            found.wanted = True

    def forget_failure(self, voice: str) -> None:
        """Forget that a voice failed to load. The next request loads it without delay."""
        found = self._voices.get(voice)
        if found and found.state is VoiceState.FAILED and voice != self._loading:
            del self._voices[voice]

    def patience_end(self, record: Record, voice: str) -> float:
        """Return the monotonic time at which the next goal stops waiting for its voice, or 0 if it doesn't wait.

        Urgent goals don't wait. Other goals stop waiting before they expire. A `voice_only` goal waits until its voice
        is loaded or has failed.

        Args:
            record: the next goal.
            voice: the voice with which it is to be spoken.
        """
        found = self._voices.get(without_speaker(voice)) if self._voices else None
        if found is None or found.state not in {VoiceState.WAITING, VoiceState.LOADING}:
            return 0.0
        if record.say.voice_only:
            return inf
        if record.preempt or record.say.interject or record.say.priority > 0:
            return 0.0
        start = (found.loading_since if found.loading_since < inf else record.next_since) + VOICE_PATIENCE_S
        return min(start, record.expires_at - EXPIRY_MARGIN_S)

    def failure(self, voice: str) -> str | None:
        """Return the reason why a voice failed to load, or None if it didn't fail."""
        found = self._voices.get(voice)
        return found.why if found and found.state is VoiceState.FAILED else None

    def to_json(self) -> JsonObject:
        """Return the state of each voice for the reply to `status`."""
        return {voice: {"state": each.state.value, "why": each.why} for voice, each in self._voices.items()}

    # -- orders for the engine

    @property
    def can_load(self) -> bool:
        """Whether a waiting voice can be loaded now."""
        return self._loading is None and any(each.wanted for each in self._voices.values())

    def load_next(self, needed: Sequence[str], default_voice: str, now: float) -> VoiceLoadOrder | None:
        """Choose the next voice to load and the voices to drop for it. Return the order, if any.

        Mark the voice as loading and the others as dropped. Return None if no voice can be loaded now. Call this only
        if `can_load` is true. A loaded voice is not dropped if a goal needs it sooner than the next voice, because it
        would have to be loaded again.

        Args:
            needed: the voices that waiting goals need, in the order of the goals.
            default_voice: the voice of goals that don't name one. Unless a goal needs it, no voice is dropped for it.
            now: the time (monotonic).
        """
        before: set[str] = set()
        for voice in (*needed, default_voice):
            found = self._voices.get(voice)
            if found and found.state is VoiceState.LOADED:
                before.add(voice)
            elif found and found.wanted:
                drop = self._voices_to_drop(found.size_bytes, before)
                if drop is None or (drop and voice not in needed):
                    return None
                self._loading, found.wanted = voice, False
                if found.state is VoiceState.WAITING:
                    found.state, found.loading_since = VoiceState.LOADING, now
                for each in drop:
                    self.unloaded(each, needed)
                return VoiceLoadOrder(voice, drop)
        self._cancel_unneeded_loads((*needed, default_voice))
        return None

    def drop_excess(self, kept_voice: str, needed: Sequence[str]) -> list[VoiceDropOrder | VoiceWarning]:
        """Drop voices to meet the memory limit. Return the orders for the engine, and warnings.

        This is necessary if the voices use more memory than estimated.

        Args:
            kept_voice: the voice that speaks now or next. It is never dropped.
            needed: the voices that waiting goals need, in the order of the goals. They are dropped last.
        """
        loaded = self._loaded_bytes()
        order = [each for each in loaded if each not in needed]
        order += [each for each in reversed(needed) if each in loaded]
        dropped: list[str] = []
        total = self._total_bytes()
        for each in order:
            if total > self._limit_bytes and each != kept_voice and len(dropped) < len(loaded) - 1:
                total -= loaded[each]
                dropped.append(each)
        for each in dropped:
            self.unloaded(each, needed)
        return [*map(VoiceDropOrder, dropped), *self._warn_too_large()]

    # -- reports from the engine

    def load_ended(self, voice: str, error: str | None, now: float) -> None:
        """Record that a voice was loaded, or that loading it failed.

        `error` says why loading failed. It is None if the voice was loaded.
        """
        if voice == self._loading:  # for `voice_only` goals, the engine also loads voices without an order
            self._loading = None
        found = self._voices.setdefault(voice, self._new_voice(voice))
        found.wanted = False
        if error is None:
            found.state, found.why, found.failures = VoiceState.LOADED, None, 0
        else:
            found.fail(error, now)

    def measured(self, voice: str, total_bytes: int) -> None:
        """Record how much memory all voices use, and attribute the change to one voice.

        Args:
            voice: the voice that was just loaded or has just spoken, or "" if a voice was dropped.
            total_bytes: the memory of all voices together.
        """
        found, growth = self._voices.get(voice), total_bytes - self._reported_bytes
        self._reported_bytes = self._used_bytes = total_bytes
        if found:
            found.size_bytes = max(0, found.size_bytes + growth if found.state is VoiceState.LOADED else growth)
            self._measured_bytes[voice] = found.size_bytes

    def unloaded(self, voice: str, needed: Collection[str]) -> None:
        """Record that a voice was dropped, and plan to load it again if a goal needs it."""
        found = self._voices.pop(voice, None)
        if found and found.state is VoiceState.LOADED:
            self._used_bytes = max(0, self._used_bytes - found.size_bytes)  # estimated until the next measurement
        if found and voice in needed:
            self._voices[voice] = NeuralVoice(found.size_bytes)

    def engine_lost(self, now: float) -> list[VoiceWarning]:
        """Forget the loaded voices after the engine process exits. Return a warning if a voice is to blame.

        A voice is to blame if the engine has died repeatedly while loading it.
        """
        suspect, self._loading, self.has_libraries = self._loading, None, False
        self._reported_bytes = self._used_bytes = 0
        for voice, found in list(self._voices.items()):
            if voice == suspect and found.failures + 1 >= MAX_ENGINE_DEATHS:
                found.fail("the engine process died while loading the voice", now)
            elif voice == suspect:
                self._voices[voice] = NeuralVoice(found.size_bytes, failures=found.failures + 1)
            elif found.state is not VoiceState.FAILED:
                del self._voices[voice]
        why = self.failure(suspect) if suspect else None
        return [VoiceWarning(f"voice {suspect} is not used: {why}")] if why else []

    def is_loaded(self, voice: str) -> bool:
        """Return whether a voice is loaded."""
        return voice in self._loaded_bytes()

    # -- memory

    def _loaded_bytes(self) -> dict[str, int]:
        """Return the memory use of each loaded voice."""
        return {voice: each.size_bytes for voice, each in self._voices.items() if each.state is VoiceState.LOADED}

    def _total_bytes(self) -> int:
        """Return the total memory use of all voices."""
        return max(self._used_bytes, sum(self._loaded_bytes().values()))

    def _voices_to_drop(self, size_bytes: int, keep: Collection[str]) -> tuple[str, ...] | None:
        """Return the voices to drop to make room for a new voice, or None if the new voice can't fit.

        The least recently used voices are dropped first.

        Args:
            size_bytes: the memory use of the new voice.
            keep: the loaded voices that must stay. If there are none, the new voice always fits.
        """
        total = size_bytes + self._total_bytes()
        dropped = []
        for voice, size in self._loaded_bytes().items():
            if total > self._limit_bytes and voice not in keep:
                total -= size
                dropped.append(voice)
        return None if keep and total > self._limit_bytes else tuple(dropped)

    def _warn_too_large(self) -> list[VoiceWarning]:
        """Return a warning the first time a single loaded voice exceeds the memory limit."""
        loaded = self._loaded_bytes()
        voice = next(iter(loaded), "")
        taken = self._total_bytes()
        if self._loading or len(loaded) != 1 or not 0 < self._limit_bytes < taken or self._voices[voice].why:
            return []
        why = f"it uses {taken / 1e6:.0f} MB, more than --voice-memory {self._limit_bytes / 1e6:.0f} allows"
        self._voices[voice].why = why
        return [VoiceWarning(f"voice {voice}: {why}")]

    def _cancel_unneeded_loads(self, needed: Collection[str]) -> None:
        """Cancel all plans to load voices that are not in `needed`."""
        for voice, found in list(self._voices.items()):
            if found.wanted and voice not in needed:
                found.wanted = False
                if found.state is VoiceState.WAITING:
                    del self._voices[voice]

    def _new_voice(self, voice: str) -> NeuralVoice:
        """Return a new entry for a voice that is not loaded yet, with its expected memory use."""
        return NeuralVoice(self._measured_bytes.get(voice) or self._file_size(voice))
