"""Classes that load neural voices in the background.

The server decides which voices to load and unload. Loading a voice takes seconds and runs in its own thread. All calls
must come from one other thread. The result of each load is reported to the server once, as an event. Voices are
identified by their ids without a speaker.
"""

from __future__ import annotations

import contextlib
import math
import os
import threading
import time
import traceback
from collections import deque
from typing import Generic, TypeVar

from talkcli.engine import models
from talkcli.engine.child.synthesizers.inference import Model, ModelCache, load_libraries, no_memory_error
from talkcli.engine.models import VoiceFileError
from talkcli.engine.protocol import LOAD_LIMIT_S, VoiceLoaded, VoiceMemory, VoiceUnloaded
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.options import NEURAL_PREFIX
from talkcli.paths import cache_directory

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    #: for each file, its inode, its size and the time of its last change
    _Fingerprints = tuple[tuple[int, int, int], ...]

#: After a sentence, freed memory is returned to the system only if the process has grown by at least this number of
#: bytes. Smaller amounts would be needed again for the next sentence.
GROWTH_BYTES = 16_000_000

_T = TypeVar("_T")


class BackgroundIterator(threading.Thread, Generic[_T]):
    """A thread that reads items from an iterator before they are needed."""

    def __init__(self, items: Iterator[_T], max_ahead: int) -> None:
        """Start the thread. It pauses while `max_ahead` items are waiting to be taken."""
        # A daemon thread could still be running C code when the process exits, which would crash the process.
        super().__init__(daemon=False)
        self._items = items
        self._room = threading.Semaphore(max_ahead)
        #: the waiting items, as pairs (item, None). The last pair is (None, error) if the iterator raised an error, and
        #: otherwise (None, None).
        self._made: deque[tuple[_T | None, BaseException | None]] = deque()
        #: a lock that prevents `close` from closing the pipe while the thread writes to it
        self._lock = threading.Lock()
        self._closed = False
        #: a file descriptor that becomes readable when an item is ready or the iterator has ended
        self.descriptor, self._write_end = os.pipe()
        self.start()

    def run(self) -> None:
        """Read items until the iterator ends or raises an exception."""
        try:
            for item in self._items:
                self._room.acquire()
                if self._closed:
                    return
                self._put(item)
            self._put(None)
        except BaseException as error:  # noqa: BLE001 - raised again by `take`
            self._put(None, error)

    @property
    def ready(self) -> bool:
        """Whether `take` would return without waiting."""
        return bool(self._made)

    def take(self, wait_readable: Callable[[int], None] | None = None) -> _T | None:
        """Wait for the next item. Return the item, or None at the end.

        Args:
            wait_readable: A function that waits until the descriptor is readable, or for a shorter time. If it raises
                an exception, no item is lost. It isn't needed if `ready` is True.

        Raises:
            BaseException: The iterator raised this exception.
        """
        while not self._made:
            assert wait_readable is not None
            wait_readable(self.descriptor)
        item, error = self._made[0]
        if error is not None:
            raise error
        if item is not None:
            self._made.popleft()
            os.read(self.descriptor, 1)
            self._room.release()
        return item

    def close(self) -> None:
        """Tell the thread to end, without waiting for it.

        Call this only once.
        """
        with self._lock:
            self._closed = True
            os.close(self.descriptor)
            os.close(self._write_end)
        self._room.release()

    def _put(self, item: _T | None, error: BaseException | None = None) -> None:
        """Add an item, an error or the end mark, and make the descriptor readable."""
        self._made.append((item, error))
        with self._lock:
            if not self._closed:
                os.write(self._write_end, b"\0")


class ModelLoader:
    """Loads neural voices one after another, and stores their models."""

    def __init__(self) -> None:
        #: the loaded models by voice, with the fingerprints of their files before loading
        self._models: dict[str, tuple[Model, _Fingerprints]] = {}
        self._waiting: deque[str] = deque()
        self._load: BackgroundIterator[tuple[Model, _Fingerprints]] | None = None
        #: the voice that is being loaded, and when its load started (monotonic time)
        self._voice = ""
        self._started_at = 0.0
        #: error messages by voice, for voices that failed to load or to speak
        self.errors: dict[str, str] = {}
        self._events: list[VoiceLoaded | VoiceUnloaded | VoiceMemory] = []
        #: the private memory of the process before the first load, and how much it had grown at the last report
        self._initial_bytes: int | None = None
        self._reported_growth = 0
        #: why memory must be measured again: the id of a voice that has spoken, or "" if a voice was unloaded
        self._unmeasured: str | None = None

    @property
    def descriptor(self) -> int | None:
        """The descriptor that becomes readable when the current load ends, or None if nothing is loading."""
        return self._load.descriptor if self._load else None

    @property
    def deadline(self) -> float:
        """The monotonic time at which the current load times out."""
        return self._started_at + LOAD_LIMIT_S

    def unload(self, voice: str) -> None:
        """Unload a voice, and forget its last error.

        If the voice is speaking, its memory is freed after the sentence.
        """
        if self._models.pop(voice, None):
            self._unmeasured = ""
        self.errors.pop(voice, None)

    def queue(self, voice: str) -> None:
        """Queue a voice for loading. If it is already loaded, only add a VoiceLoaded event.

        When the load begins, any earlier error of the voice is forgotten.
        """
        if voice in self._models:
            self._events.append(VoiceLoaded(voice, 0.0))
        elif voice not in self._waiting and not (self._load and voice == self._voice):
            self.errors.pop(voice, None)
            self._waiting.append(voice)
            self._start_next_load()

    def get_model(self, voice: str) -> Model | None:
        """Return the model of a voice, or None if it isn't loaded. First, store the result of a finished load.

        If the voice has failed and its files have changed since then, unload it.
        """
        self._finish_load()
        model, fingerprints = self._models.get(voice, (None, ()))
        if model and voice in self.errors and fingerprints != _fingerprints(model.path):
            self.unload(voice)
            self._events.append(VoiceUnloaded(voice))
            return None
        return model

    def mark_spoken(self, voice: str) -> None:
        """After a voice has spoken, schedule a memory measurement.

        The first sentences with a voice need memory that is never freed.
        """
        if voice not in self._models:
            self._unmeasured = ""  # The voice was unloaded during the sentence, and its memory has just been freed.
        elif self._unmeasured is None:
            self._unmeasured = voice

    def take_events(self) -> list[VoiceLoaded | VoiceUnloaded | VoiceMemory]:
        """Store the result of a finished load, and measure memory if due. Return and clear the new events."""
        self._finish_load()
        if self._unmeasured is not None:
            self._measure_memory(self._unmeasured, min_growth=GROWTH_BYTES)
        events, self._events = self._events, []
        return events

    def _finish_load(self) -> None:
        """Store the result of a complete or overdue load, and start the next one."""
        load, voice = self._load, self._voice
        if load is None:
            return
        error: str | None = None
        try:
            if not load.ready:
                if time.monotonic() < self.deadline:
                    return
                # The thread may hang forever, for example while it reads a file from a dead network drive.
                raise VoiceFileError(f"{voice} was not loaded within {LOAD_LIMIT_S:g} s; use a faster disk")
            loaded = load.take()
            assert loaded is not None
            self._models[voice] = loaded
            self._measure_memory(voice)
        except VoiceFileError as caught:
            error = self.errors[voice] = str(caught)
        except Exception as caught:  # noqa: BLE001 - a faulty voice must not stop the engine process
            traceback.print_exception(caught)
            error = self.errors[voice] = f"{voice} could not be loaded: {type(caught).__name__}: {caught}"
        self._events.append(VoiceLoaded(voice, round(time.monotonic() - self._started_at, 3), error))
        load.close()
        self._load = None
        self._start_next_load()

    def _measure_memory(self, voice: str, min_growth: float = -math.inf) -> None:
        """Measure the memory used by all voices. If it has grown enough, trim the heap and add an event.

        `voice` was just loaded or used. It is empty if a voice was unloaded. In that case, or if the memory has grown
        by at least `min_growth` bytes since the last event, free unused memory and add an event.
        """
        self._unmeasured = None
        before, now = self._initial_bytes, _read_private_bytes()
        if before is None or now is None or (voice and now - before - self._reported_growth < min_growth):
            return
        _trim_heap()
        self._reported_growth = max(0, (_read_private_bytes() or now) - before)
        self._events.append(VoiceMemory(voice, self._reported_growth))

    def _start_next_load(self) -> None:
        """Start loading the next voice if no other voice is being loaded.

        A load keeps one processor busy, and temporarily needs twice the memory of the model.
        """
        if self._load is None and self._waiting:
            self._voice, self._started_at = self._waiting.popleft(), time.monotonic()
            if self._initial_bytes is None:
                self._initial_bytes = _read_private_bytes()
            self._load = BackgroundIterator(_load_model(self._voice), max_ahead=1)


def _fingerprints(path: str) -> _Fingerprints:
    """Return the fingerprints of a voice's files, or () if a file is missing."""
    try:
        found = [os.stat(each) for each in (path, path + models.JSON_SUFFIX)]
    except OSError:
        return ()
    return tuple((each.st_ino, each.st_size, each.st_mtime_ns) for each in found)


def _load_model(voice: str) -> Iterator[tuple[Model, _Fingerprints]]:
    """Load a voice for a BackgroundIterator. Yield its model and the fingerprints of its files once.

    Raises:
        VoiceFileError: The voice can't be loaded.
    """
    path = models.find_models().get(voice.removeprefix(NEURAL_PREFIX))
    if path is None:
        raise VoiceFileError(f"{voice}: its file no longer exists")
    try:
        load_libraries(path)  # Import the libraries first, because reading the files may hang.
        fingerprints = _fingerprints(path)
        yield Model(path, models.read_description(path), _open_cache()), fingerprints
    except OSError as error:
        raise VoiceFileError(f"{path} cannot be read: {error.strerror}") from error
    except MemoryError as error:
        raise no_memory_error(path) from error


def _open_cache() -> ModelCache | None:
    """Open the cache. If it can't be used, log the reason and return None."""
    try:
        return ModelCache(cache_directory())
    except OSError:
        traceback.print_exc()
        return None


def _read_private_bytes() -> int | None:
    """Return how much private memory this process uses, including swap.

    Return None if a sandbox hides it.
    """
    try:
        with open("/proc/self/status", "rb") as file:
            fields = dict(line.split(b":", 1) for line in file)
        return sum(int(fields[each].split()[0]) for each in (b"RssAnon", b"VmSwap")) * 1024
    except (OSError, KeyError, ValueError):
        return None


def _trim_heap() -> None:
    """Give freed memory back to the system. This takes 1 to 13 ms.

    Otherwise, glibc would keep most of the memory of an unloaded model.
    """
    import ctypes

    with contextlib.suppress(AttributeError):  # Some C libraries don't have this function.
        ctypes.CDLL(None).malloc_trim(0)
