"""Neural voices: which one is loaded next, which ones are dropped, and how long a goal waits for its voice.

Pure: decisions depend on the engine's reports, and the scheduler passes the orders on. The server knows which voices
exist. A neural voice is identified by its id without a speaker. All other voices are always ready and don't appear
here.
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

#: How long a goal waits for a voice that is being loaded. Loading takes three seconds on a small machine.
VOICE_PATIENCE_S = 10.0
#: A goal stops waiting for its voice this long before it expires, so that it can still start.
EXPIRY_MARGIN_S = 0.5
#: Shortest and longest delay before a goal may load a failed voice again. The delay doubles with each failure. A failed
#: attempt costs a second of processor time, or even a sentence if it kills the engine.
FIRST_VOICE_RETRY_S, LAST_VOICE_RETRY_S = 5.0, 3600.0
#: A voice is considered faulty if the engine dies this many times in a row while loading it.
MAX_ENGINE_DEATHS = 2


class VoiceState(Enum):
    """The state of a neural voice that a goal has asked for."""

    WAITING = "waiting"  # not loaded yet
    LOADING = "loading"
    LOADED = "loaded"
    FAILED = "failed"  # could not be loaded, so another voice speaks instead


@dataclass(slots=True)
class NeuralVoice:
    """A neural voice that a goal has asked for."""

    #: memory use as measured by the engine, or the size of the voice's file before the first measurement
    size_bytes: int
    state: VoiceState = VoiceState.WAITING
    #: human-readable reason for a failure, or a warning
    why: str | None = None
    #: number of failed attempts to load it since it was last loaded
    failures: int = 0
    #: whether it should be loaded, or loaded again after a failure
    wanted: bool = True
    #: earliest time for another attempt after a failure (monotonic)
    retry_at: float = 0.0
    #: time at which loading started (monotonic), or inf before that
    loading_since: float = inf

    def fail(self, why: str, now: float) -> None:
        """Record that the voice could not be loaded."""
        self.failures += 1
        self.retry_at = now + min(LAST_VOICE_RETRY_S, FIRST_VOICE_RETRY_S * 2 ** (self.failures - 1))
        self.state, self.why = VoiceState.FAILED, why


@frozen
class VoiceLoadOrder:
    """Effect: the engine drops some voices to make room, and then loads a voice."""

    voice: str
    dropped: tuple[str, ...] = ()


@frozen
class VoiceDropOrder:
    """Effect: the engine drops a voice because the loaded voices use more memory than allowed."""

    voice: str


@frozen
class VoiceWarning:
    """Effect: log a problem with a voice."""

    message: str


class VoiceScheduler:
    """Decides which neural voices the engine loads and drops."""

    def __init__(self, limit_bytes: int = 0, file_size: Callable[[str], int] = lambda _: 0) -> None:
        """Start without any voice.

        Args:
            limit_bytes: memory limit for all loaded voices. A single voice may use more.
            file_size: function that returns the size of a voice's file in bytes, an estimate of its memory use.
        """
        self._limit_bytes = limit_bytes
        self._file_size = file_size
        #: by id, in the order of the latest requests
        self._voices: dict[str, NeuralVoice] = {}
        #: memory that each voice used when it was last loaded
        self._measured_bytes: dict[str, int] = {}
        #: memory that all voices have added to the engine process, according to its latest report
        self._reported_bytes = 0
        #: the reported memory without the voices that were dropped after the report
        self._used_bytes = 0
        #: whether the engine process has imported the libraries, which it does when it loads its first voice
        self.has_libraries = False
        #: the voice that the engine is loading
        self._loading: str | None = None

    # -- requests from goals

    def request(self, voice: str, now: float) -> None:
        """Plan to load a voice, because a goal asks for it. A failed voice is tried again only after its delay."""
        found = self._voices.pop(voice, None) or self._new(voice)
        self._voices[voice] = found
        if found.state is VoiceState.FAILED and voice != self._loading and now >= found.retry_at:
            found.wanted = True

    def forget_failure(self, voice: str) -> None:
        """Allow the next request to load a failed voice without delay."""
        found = self._voices.get(voice)
        if found and found.state is VoiceState.FAILED and voice != self._loading:
            del self._voices[voice]

    def start_time(self, record: Record, default_voice: str | None) -> float:
        """Return the earliest time at which the next goal may start (monotonic), or 0 if it needn't wait for its voice.

        Urgent goals don't wait. Other goals stop waiting before they expire. A `voice_only` goal waits until its voice
        is loaded or has failed.

        Args:
            record: the next goal.
            default_voice: the voice of goals that don't name one.
        """
        found = self._voices.get(without_speaker(record.say.voice or default_voice)) if self._voices else None
        if found is None or found.state not in {VoiceState.WAITING, VoiceState.LOADING}:
            return 0.0
        if record.say.voice_only:
            return inf
        if record.preempt or record.priority > 0:
            return 0.0
        start = (found.loading_since if found.loading_since < inf else record.next_since) + VOICE_PATIENCE_S
        return start if record.expires_at is None else min(start, record.expires_at - EXPIRY_MARGIN_S)

    def failure(self, voice: str) -> str | None:
        """Return the human-readable reason why a voice could not be loaded, or None if it has not failed."""
        found = self._voices.get(voice)
        return found.why if found and found.state is VoiceState.FAILED else None

    def to_json(self) -> JsonObject:
        """Return the state of each voice, as `status` shows it."""
        return {voice: {"state": each.state.value, "why": each.why} for voice, each in self._voices.items()}

    # -- orders for the engine

    @property
    def can_load(self) -> bool:
        """Whether a voice should be loaded and no other voice is being loaded."""
        return self._loading is None and any(each.wanted for each in self._voices.values())

    def load_next(self, needed: Sequence[str], default_voice: str, now: float) -> VoiceLoadOrder | None:
        """Start loading the next voice. Return the order for the engine, or None if no voice can be loaded now.

        Only one voice is loaded at a time. If a goal needs a loaded voice sooner than the next one, the loaded voice is
        not dropped, because it would have to be loaded again.

        Args:
            needed: the voices that waiting goals need, in the order of the goals.
            default_voice: the voice of goals that don't name one. Unless a goal needs it, no voice is dropped for it.
            now: the time (monotonic).
        """
        if not self.can_load:
            return None
        before: dict[str, int] = {}
        for voice in (*needed, default_voice):
            found = self._voices.get(voice)
            if found and found.state is VoiceState.LOADED:
                before[voice] = found.size_bytes
            elif found and found.wanted:
                drop = self._make_room(sum(before.values()) + found.size_bytes, before)
                if drop is None or (drop and voice not in needed):
                    return None
                self._loading, found.wanted = voice, False
                if found.state is VoiceState.WAITING:
                    found.state, found.loading_since = VoiceState.LOADING, now
                for each in drop:
                    self.unloaded(each, needed)
                return VoiceLoadOrder(voice, drop)
        self._forget_unneeded((*needed, default_voice))
        return None

    def drop_excess(self, first: str, needed: Sequence[str]) -> list[VoiceDropOrder | VoiceWarning]:
        """Drop voices until the others fit into the memory limit. Return the orders for the engine.

        This is necessary if the voices use more memory than was estimated.

        Args:
            first: the voice that speaks now or next. It is never dropped.
            needed: the voices that waiting goals need, in the order of the goals. They are dropped last.
        """
        loaded = self._loaded()
        order = [each for each in loaded if each not in needed]
        order += [each for each in reversed(needed) if each in loaded]
        dropped: list[str] = []
        total = self._unattributed_bytes() + sum(loaded.values())
        for each in order:
            if total > self._limit_bytes and each != first and len(dropped) < len(loaded) - 1:
                total -= loaded[each]
                dropped.append(each)
        for each in dropped:
            self.unloaded(each, needed)
        return [*map(VoiceDropOrder, dropped), *self._warn_too_large()]

    # -- reports from the engine

    def load_ended(self, voice: str, error: str | None, now: float) -> None:
        """Record that a voice was loaded, or with `error`, that it could not be loaded."""
        if voice == self._loading:  # the engine also loads voices on its own, for `voice_only` goals
            self._loading = None
        found = self._voices.setdefault(voice, self._new(voice))
        found.wanted = False
        if error is None:
            found.state, found.why, found.failures = VoiceState.LOADED, None, 0
        else:
            found.fail(error, now)

    def measured(self, voice: str, memory_bytes: int) -> None:
        """Record the memory that all voices have added to the engine process.

        Args:
            voice: the voice that was just loaded or has just spoken, or "" if a voice was dropped.
            memory_bytes: the memory of all voices together.
        """
        found, growth = self._voices.get(voice), memory_bytes - self._reported_bytes
        self._reported_bytes = self._used_bytes = memory_bytes
        if found:
            found.size_bytes = max(0, found.size_bytes + growth if found.state is VoiceState.LOADED else growth)
            self._measured_bytes[voice] = found.size_bytes

    def unloaded(self, voice: str, needed: Collection[str]) -> None:
        """Record that a voice is no longer loaded. If a goal needs the voice, plan to load it again."""
        found = self._voices.pop(voice, None)
        if found and found.state is VoiceState.LOADED:
            self._used_bytes = max(0, self._used_bytes - found.size_bytes)  # an estimate until the next measurement
        if found and voice in needed:
            self._voices[voice] = NeuralVoice(found.size_bytes)

    def engine_lost(self, now: float) -> list[VoiceWarning]:
        """Record that the engine process and all loaded voices are gone. Return a warning if a voice seems faulty."""
        suspect, self._loading, self.has_libraries = self._loading, None, False
        self._reported_bytes = self._used_bytes = 0
        for voice, found in list(self._voices.items()):
            if voice == suspect and found.failures + 1 >= MAX_ENGINE_DEATHS:
                found.fail("the engine process ended while it was being loaded", now)
            elif voice == suspect:
                self._voices[voice] = NeuralVoice(found.size_bytes, failures=found.failures + 1)
            elif found.state is not VoiceState.FAILED:
                del self._voices[voice]
        why = self.failure(suspect) if suspect else None
        return [VoiceWarning(f"voice {suspect} is left alone: {why}")] if why else []

    def is_loaded(self, voice: str) -> bool:
        """Return whether a voice is loaded."""
        return voice in self._loaded()

    # -- memory

    def _loaded(self) -> dict[str, int]:
        """Return the memory use of each loaded voice."""
        return {voice: each.size_bytes for voice, each in self._voices.items() if each.state is VoiceState.LOADED}

    def _unattributed_bytes(self) -> int:
        """Return the memory that the engine process has gained and no loaded voice accounts for."""
        return max(0, self._used_bytes - sum(self._loaded().values()))

    def _make_room(self, size_bytes: int, keep: Collection[str]) -> tuple[str, ...] | None:
        """Return the voices to drop for a new one, least recently used first, or None if the new voice can't fit.

        Args:
            size_bytes: the memory use of the new voice and of the voices to keep.
            keep: the loaded voices that must stay. If there are none, the new voice always fits.
        """
        others = {voice: size for voice, size in self._loaded().items() if voice not in keep}
        total = size_bytes + self._unattributed_bytes() + sum(others.values())
        dropped = []
        for voice, size in others.items():
            if total > self._limit_bytes:
                total -= size
                dropped.append(voice)
        return None if keep and total > self._limit_bytes else tuple(dropped)

    def _warn_too_large(self) -> list[VoiceWarning]:
        """Return a warning if the only loaded voice exceeds the memory limit, unless there was a warning before."""
        loaded = self._loaded()
        voice = next(iter(loaded), "")
        taken = self._unattributed_bytes() + sum(loaded.values())
        if self._loading or len(loaded) != 1 or not 0 < self._limit_bytes < taken or self._voices[voice].why:
            return []
        why = f"it takes {taken / 1e6:.0f} MB, more than --voice-memory {self._limit_bytes / 1e6:.0f}"
        self._voices[voice].why = why
        return [VoiceWarning(f"voice {voice}: {why}")]

    def _forget_unneeded(self, needed: Collection[str]) -> None:
        """Cancel the plans to load voices that no goal needs any more."""
        for voice, found in list(self._voices.items()):
            if found.wanted and voice not in needed:
                found.wanted = False
                if found.state is VoiceState.WAITING:
                    del self._voices[voice]

    def _new(self, voice: str) -> NeuralVoice:
        """Return a new entry for a voice that is not loaded."""
        return NeuralVoice(self._measured_bytes.get(voice) or self._file_size(voice))
