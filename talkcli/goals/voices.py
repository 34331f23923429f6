"""The neural voices that goals ask for: which one is loaded next, which ones are dropped, and how long a goal waits.

Pure: it decides from what the engine reports, and the scheduler passes its orders on. Whether a voice exists is for the
server to know. A neural voice is named by its id without a speaker. Every other voice is always ready and never kept
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

#: How long a goal waits for a voice that is being loaded. On a small machine, loading takes three seconds.
VOICE_PATIENCE_S = 10.0
#: A goal stops waiting for its voice this long before it expires, so that it can still begin.
EXPIRY_MARGIN_S = 0.5
#: When a goal may have a failed voice loaded again. The delay doubles with each failure, because an attempt that fails
#: costs a second of processor time, and one that kills the engine costs a sentence.
FIRST_VOICE_RETRY_S, LAST_VOICE_RETRY_S = 5.0, 3600.0
#: A voice is blamed if the engine dies this many times in a row while it loads the voice.
MAX_ENGINE_DEATHS = 2


class VoiceState(Enum):
    """The state of a neural voice that a goal has asked for."""

    WAITING = "waiting"  # to be loaded
    LOADING = "loading"
    LOADED = "loaded"
    FAILED = "failed"  # another voice speaks instead


@dataclass(slots=True)
class NeuralVoice:
    """A neural voice that a goal has asked for."""

    #: memory that it takes, as the engine measured it; the size of its file before that
    size_bytes: int
    state: VoiceState = VoiceState.WAITING
    #: why it can't be loaded, or a warning about it, for people
    why: str | None = None
    #: how often in a row loading has failed
    failures: int = 0
    #: whether it is to be loaded, or loaded again after a failure
    wanted: bool = True
    #: when it may be loaded again after a failure (monotonic seconds)
    retry_at: float = 0.0
    #: when loading began (monotonic seconds); inf before that
    loading_since: float = inf

    def fail(self, why: str, now: float) -> None:
        """Note that it could not be loaded."""
        self.failures += 1
        self.retry_at = now + min(LAST_VOICE_RETRY_S, FIRST_VOICE_RETRY_S * 2 ** (self.failures - 1))
        self.state, self.why = VoiceState.FAILED, why


@frozen
class VoiceLoadOrder:
    """Order for the engine: drop some voices to make room, then load a voice."""

    voice: str
    dropped: tuple[str, ...] = ()


@frozen
class VoiceDropOrder:
    """Order for the engine: drop a voice, because the voices take more memory than allowed."""

    voice: str


@frozen
class VoiceWarning:
    """A problem with a voice, for the log."""

    message: str


class VoiceScheduler:
    """Decides which neural voices the engine loads and drops, and remembers how that went."""

    def __init__(self, limit_bytes: int = 0, file_size: Callable[[str], int] = lambda _: 0) -> None:
        """Start without any voice.

        Args:
            limit_bytes: memory that the loaded voices may take. One voice alone may take more.
            file_size: returns the size of a voice's file in bytes, an estimate of its memory.
        """
        self._limit_bytes = limit_bytes
        self._file_size = file_size
        #: by id; the voice that was asked for last comes last
        self._voices: dict[str, NeuralVoice] = {}
        #: memory that each voice took when it was last loaded
        self._measured_bytes: dict[str, int] = {}
        #: memory that all voices together have added to the engine process: as it reported last, and without the voices
        #: that were dropped since
        self._reported_bytes = self._used_bytes = 0
        #: whether the engine process has imported the libraries, which the first load does
        self.has_libraries = False
        #: the voice that the engine is loading
        self._loading: str | None = None

    # -- what goals ask for

    def request(self, voice: str, now: float) -> None:
        """Have a voice loaded as soon as possible, because a goal asks for it."""
        found = self._voices.pop(voice, None) or self._new(voice)
        self._voices[voice] = found
        if found.state is VoiceState.FAILED and voice != self._loading and now >= found.retry_at:
            found.wanted = True

    def forget_failure(self, voice: str) -> None:
        """Let the next request load a voice that has failed before."""
        found = self._voices.get(voice)
        if found and found.state is VoiceState.FAILED and voice != self._loading:
            del self._voices[voice]

    def start_time(self, record: Record, default_voice: str | None) -> float:
        """Return the earliest time at which the next goal may start (monotonic); 0 if it needn't wait for its voice.

        An urgent goal doesn't wait, nor does a goal that would expire meanwhile. A `voice_only` goal waits until its
        voice is loaded or has failed.

        Args:
            record: the next goal.
            default_voice: the voice of goals that name none.
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
        """Return why a voice can't be loaded, for people; None if it can or if that is not known."""
        found = self._voices.get(voice)
        return found.why if found and found.state is VoiceState.FAILED else None

    def to_json(self) -> JsonObject:
        """Return the state of each voice, as `status` shows it."""
        return {voice: {"state": each.state.value, "why": each.why} for voice, each in self._voices.items()}

    # -- what the engine is to do

    @property
    def can_load(self) -> bool:
        """Whether a voice is wanted and none is being loaded."""
        return self._loading is None and any(each.wanted for each in self._voices.values())

    def load_next(self, needed: Sequence[str], default_voice: str, now: float) -> VoiceLoadOrder | None:
        """Return the order to load the next voice, and note that it has begun; None if nothing is to be loaded.

        Only one voice is loaded at a time. No voice is dropped that a goal needs sooner, because it would have to be
        loaded again.

        Args:
            needed: the voices that waiting goals need, in the order of the goals.
            default_voice: the voice of goals that name none. Nothing is dropped for it while no goal needs it.
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
        """Return orders to drop voices until the others fit into memory, because they took more than was expected.

        Args:
            first: the voice that speaks next, or speaks now. It is kept.
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

    # -- what the engine reports

    def load_ended(self, voice: str, error: str | None, now: float) -> None:
        """Note that a voice was loaded, or why it could not be."""
        if voice == self._loading:  # the engine itself loads a voice that a `voice_only` goal needs
            self._loading = None
        found = self._voices.setdefault(voice, self._new(voice))
        found.wanted = False
        if error is None:
            found.state, found.why, found.failures = VoiceState.LOADED, None, 0
        else:
            found.fail(error, now)

    def measured(self, voice: str, memory_bytes: int) -> None:
        """Note the memory that all voices have added to the engine process.

        Args:
            voice: the voice that was just loaded or has just spoken; "" if one was dropped.
            memory_bytes: the memory of all voices.
        """
        found, growth = self._voices.get(voice), memory_bytes - self._reported_bytes
        self._reported_bytes = self._used_bytes = memory_bytes
        if found:
            found.size_bytes = max(0, found.size_bytes + growth if found.state is VoiceState.LOADED else growth)
            self._measured_bytes[voice] = found.size_bytes

    def unloaded(self, voice: str, needed: Collection[str]) -> None:
        """Note that a voice is no longer loaded, and have it loaded again if a goal needs it."""
        found = self._voices.pop(voice, None)
        if found and found.state is VoiceState.LOADED:
            self._used_bytes = max(0, self._used_bytes - found.size_bytes)  # until the engine measures again
        if found and voice in needed:
            self._voices[voice] = NeuralVoice(found.size_bytes)

    def engine_lost(self, now: float) -> list[VoiceWarning]:
        """Note that no voice is loaded any more. Return a warning if a voice is blamed for it."""
        blamed, self._loading, self.has_libraries = self._loading, None, False
        self._reported_bytes = self._used_bytes = 0
        for voice, found in list(self._voices.items()):
            if voice == blamed and found.failures + 1 >= MAX_ENGINE_DEATHS:
                found.fail("the engine process ended while it was being loaded", now)
            elif voice == blamed:
                self._voices[voice] = NeuralVoice(found.size_bytes, failures=found.failures + 1)
            elif found.state is not VoiceState.FAILED:
                del self._voices[voice]
        why = self.failure(blamed) if blamed else None
        return [VoiceWarning(f"voice {blamed} is left alone: {why}")] if why else []

    def is_loaded(self, voice: str) -> bool:
        """Return whether a voice is loaded."""
        return voice in self._loaded()

    # -- memory

    def _loaded(self) -> dict[str, int]:
        return {voice: each.size_bytes for voice, each in self._voices.items() if each.state is VoiceState.LOADED}

    def _unattributed_bytes(self) -> int:
        """Return the memory that the engine has gained beyond the sizes of its voices."""
        return max(0, self._used_bytes - sum(self._loaded().values()))

    def _make_room(self, size_bytes: int, keep: Collection[str]) -> tuple[str, ...] | None:
        """Return the voices to drop for this many bytes, the least recently used first; None if that isn't enough."""
        others = {voice: size for voice, size in self._loaded().items() if voice not in keep}
        total = size_bytes + self._unattributed_bytes() + sum(others.values())
        dropped = []
        for voice, size in others.items():
            if total > self._limit_bytes:
                total -= size
                dropped.append(voice)
        return None if keep and total > self._limit_bytes else tuple(dropped)

    def _warn_too_large(self) -> list[VoiceWarning]:
        """Return a warning if the only loaded voice exceeds the limit and this is new."""
        loaded = self._loaded()
        voice = next(iter(loaded), "")
        taken = self._unattributed_bytes() + sum(loaded.values())
        if self._loading or len(loaded) != 1 or not 0 < self._limit_bytes < taken or self._voices[voice].why:
            return []
        why = f"it takes {taken / 1e6:.0f} MB, more than --voice-memory {self._limit_bytes / 1e6:.0f}"
        self._voices[voice].why = why
        return [VoiceWarning(f"voice {voice}: {why}")]

    def _forget_unneeded(self, needed: Collection[str]) -> None:
        for voice, found in list(self._voices.items()):
            if found.wanted and voice not in needed:
                found.wanted = False
                if found.state is VoiceState.WAITING:
                    del self._voices[voice]

    def _new(self, voice: str) -> NeuralVoice:
        return NeuralVoice(self._measured_bytes.get(voice) or self._file_size(voice))
