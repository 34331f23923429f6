"""The loading of neural voices in the background, one at a time.

The server decides which voices are loaded and dropped. Loading takes seconds and runs in a thread. All other calls come
from a single other thread. The result of each load is reported to the server once, as an event. Voices are identified
by their ids without a speaker.
"""

from __future__ import annotations

import math
import os
import threading
import time
import traceback
from collections import deque
from typing import Generic, TypeVar

from talkcli.engine import models
from talkcli.engine.child.synthesizers.inference import Model, ModelCache, load_libraries
from talkcli.engine.models import VoiceFileError
from talkcli.engine.protocol import LOAD_LIMIT_S, VoiceLoaded, VoiceMemory, VoiceUnloaded
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.options import NEURAL_PREFIX
from talkcli.paths import cache_directory

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    #: the inode, the size and the time of the last change of each file
    _Fingerprints = tuple[tuple[int, int, int], ...]

#: The growth of the process in bytes that triggers a new measurement and the return of freed memory to the system.
#: Smaller amounts aren't returned, because the next sentence would need them again.
GROWTH_BYTES = 16_000_000

_T = TypeVar("_T")


class BackgroundIterator(threading.Thread, Generic[_T]):
    """A thread that runs an iterator some items ahead of its consumer."""

    def __init__(self, items: Iterator[_T], max_ahead: int) -> None:
        """Start the thread; it pauses while `max_ahead` items have not been taken."""
        # A daemon thread could still be inside a C library when the process exits, which would abort the process.
        super().__init__(daemon=False)
        self._items = items
        self._room = threading.Semaphore(max_ahead)
        #: the items that were not taken yet, as pairs (item, None). The last pair is (None, error), or (None, None) if
        #: the iterator ended without an error.
        self._made: deque[tuple[_T | None, BaseException | None]] = deque()
        #: held while the thread writes to its descriptor, so that `close` can't free the descriptor's number meanwhile
        self._lock = threading.Lock()
        self._closed = False
        #: readable if an item can be taken or the iterator has ended
        self.descriptor, self._write_end = os.pipe()
        self.start()

    def run(self) -> None:
        """Run the iterator until it ends or raises an exception."""
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
        """Whether `take` returns at once."""
        return bool(self._made)

    def take(self, wait: Callable[[int], None] | None = None) -> _T | None:
        """Return the next item, or None at the end.

        Args:
            wait: A function that waits for the descriptor. It may return early. If it raises an exception, the
                exception passes through and no item is lost. It isn't needed if `ready` is True.

        Raises:
            BaseException: The iterator raised this exception.
        """
        while not self._made:
            assert wait is not None
            wait(self.descriptor)
        item, error = self._made[0]
        if error is not None:
            raise error
        if item is not None:
            self._made.popleft()
            os.read(self.descriptor, 1)
            self._room.release()
        return item

    def close(self) -> None:
        """Make the thread end after its current item, which is discarded, and return at once."""
        with self._lock:
            if not self._closed:
                self._closed = True
                os.close(self.descriptor)
                os.close(self._write_end)
        self._room.release()

    def _put(self, item: _T | None, error: BaseException | None = None) -> None:
        self._made.append((item, error))
        with self._lock:
            if not self._closed:
                os.write(self._write_end, b"\0")


class ModelLoader:
    """Keeps the loaded models, and loads queued voices one after the other."""

    def __init__(self) -> None:
        #: the models by their voices, with the fingerprints of their files from before the load
        self._models: dict[str, tuple[Model, _Fingerprints]] = {}
        self._waiting: deque[str] = deque()
        self._load: BackgroundIterator[tuple[Model, _Fingerprints]] | None = None
        #: the voice that is being loaded, and the monotonic time when its load started
        self._voice = ""
        self._started_at = 0.0
        #: the loaded voices that failed to speak
        self._suspect: set[str] = set()
        #: the error message of each voice's last load, if the load failed
        self._errors: dict[str, str] = {}
        self._events: list[VoiceLoaded | VoiceUnloaded | VoiceMemory] = []
        #: the private memory of the process before the first load, and the growth in the last report
        self._initial_bytes: int | None = None
        self._reported_growth = 0
        #: the voice that spoke since the last measurement, "" if a voice was dropped, or None if neither happened
        self._unmeasured: str | None = None

    @property
    def descriptor(self) -> int | None:
        """A descriptor that is readable after the load has finished, or None if no voice is being loaded."""
        return self._load.descriptor if self._load else None

    @property
    def deadline(self) -> float:
        """The monotonic time at which the current load fails."""
        return self._started_at + LOAD_LIMIT_S

    def drop(self, voice: str) -> None:
        """Release the model of a voice; a sentence that is being spoken keeps using it."""
        if self._models.pop(voice, None):
            self._unmeasured = ""
        self._suspect.discard(voice)

    def start(self, voice: str) -> None:
        """Load a voice in the background unless it is loaded or queued, and discard its earlier error."""
        if voice in self._models:
            self._events.append(VoiceLoaded(voice, 0.0))
        elif voice not in self._waiting and not (self._load and voice == self._voice):
            self._errors.pop(voice, None)
            self._waiting.append(voice)
            self._start_next()

    def model(self, voice: str) -> Model | None:
        """Return the model of a voice, or None if it isn't loaded."""
        self._check_load()
        model, fingerprints = self._models.get(voice, (None, ()))
        if model and voice in self._suspect and fingerprints != _fingerprints(model.path):
            self.drop(voice)
            self._events.append(VoiceUnloaded(voice))
            return None
        return model

    def error(self, voice: str) -> str | None:
        """Return the error message of a voice's last load, or None if the load didn't fail."""
        return self._errors.get(voice)

    def mark_suspect(self, voice: str) -> None:
        """Record that a loaded voice failed to speak. It is dropped after its files have changed."""
        self._suspect.add(voice)

    def mark_spoken(self, voice: str) -> None:
        """Record that a voice has spoken, because its first sentences allocate memory that is kept."""
        if voice not in self._models:
            self._unmeasured = ""  # the voice was dropped during the sentence, so its memory is only released now
        elif self._unmeasured is None:
            self._unmeasured = voice

    def events(self) -> list[VoiceLoaded | VoiceUnloaded | VoiceMemory]:
        """Return the events since the last call."""
        self._check_load()
        if self._unmeasured is not None:
            self._measure(self._unmeasured, min_growth=GROWTH_BYTES)
        events, self._events = self._events, []
        return events

    def _check_load(self) -> None:
        """Store the model if the load has finished, or record a failure if it takes too long."""
        load, voice = self._load, self._voice
        if load is None:
            return
        try:
            if not load.ready:
                if time.monotonic() < self.deadline:
                    return
                # The thread may hang forever, for example reading a file from a dead server.
                raise VoiceFileError(f"{voice} was not loaded within {LOAD_LIMIT_S:g} s: are its files on a slow disk?")
            loaded = load.take()
            assert loaded is not None
        except VoiceFileError as error:
            self._record_failure(str(error))
        except Exception as error:  # noqa: BLE001 - a faulty voice must not cost the engine process
            traceback.print_exception(error)
            self._record_failure(f"{voice} cannot be loaded: {type(error).__name__}: {error}")
        else:
            self._models[voice] = loaded
            self._measure(voice)
            self._events.append(VoiceLoaded(voice, self._elapsed()))
        load.close()
        self._load = None
        self._start_next()

    def _measure(self, voice: str, min_growth: float = -math.inf) -> None:
        """Report the growth of the process's memory, unless a voice that spoke added less than `min_growth` bytes."""
        self._unmeasured = None
        before, now = self._initial_bytes, _private_bytes()
        if before is None or now is None or (voice and now - before - self._reported_growth < min_growth):
            return
        _trim_heap()
        self._reported_growth = max(0, (_private_bytes() or now) - before)
        self._events.append(VoiceMemory(voice, self._reported_growth))

    def _elapsed(self) -> float:
        return round(time.monotonic() - self._started_at, 3)

    def _record_failure(self, why: str) -> None:
        self._errors[self._voice] = why
        self._events.append(VoiceLoaded(self._voice, self._elapsed(), why))

    def _start_next(self) -> None:
        """Start the next load. Only one runs at a time because it needs a processor and twice the model's memory."""
        while self._load is None and self._waiting:
            self._voice, self._started_at = self._waiting.popleft(), time.monotonic()
            try:
                path = _model_path(self._voice)
            except VoiceFileError as error:
                self._record_failure(str(error))
                continue
            if self._initial_bytes is None:
                self._initial_bytes = _private_bytes()
            self._load = BackgroundIterator(_load(path), max_ahead=1)


def _model_path(voice: str) -> str:
    """Return the path of a voice's model.

    Raises:
        VoiceFileError: A package or the model file is missing.
    """
    missing = models.missing_package()
    if missing is not None:
        raise VoiceFileError(missing)
    path = models.find_models().get(voice.removeprefix(NEURAL_PREFIX))
    if path is None:
        raise VoiceFileError(f"{voice}: its file is not there any more")
    return path


def _fingerprints(path: str) -> _Fingerprints:
    """Return values that change whenever a voice's files change, or () if a file can't be examined."""
    try:
        found = [os.stat(each) for each in (path, path + models.JSON_SUFFIX)]
    except OSError:
        return ()
    return tuple((each.st_ino, each.st_size, each.st_mtime_ns) for each in found)


def _load(path: str) -> Iterator[tuple[Model, _Fingerprints]]:
    """Yield the model at a path.

    Raises:
        VoiceFileError: The model can't be loaded.
    """
    try:
        load_libraries(path)  # comes first, so that the libraries are certainly imported if a load hangs later
        fingerprints = _fingerprints(path)
        yield Model(path, models.read_description(path), _open_cache()), fingerprints
    except OSError as error:
        raise VoiceFileError(f"{path} cannot be read: {error.strerror}") from error
    except MemoryError as error:
        raise VoiceFileError(f"{path} cannot be loaded: there is no memory for it; end another program") from error


def _open_cache() -> ModelCache | None:
    """Return the cache, or None if it can't be used. The reason is logged."""
    try:
        return ModelCache(cache_directory())
    except OSError:
        traceback.print_exc()
        return None


def _private_bytes() -> int | None:
    """Return this process's private memory, including swapped pages, or None if it is unknown (in a sandbox)."""
    try:
        with open("/proc/self/status", "rb") as file:
            fields = dict(line.split(b":", 1) for line in file)
        return sum(int(fields[each].split()[0]) for each in (b"RssAnon", b"VmSwap")) * 1024
    except (OSError, KeyError, ValueError):
        return None


def _trim_heap() -> None:
    """Return freed memory to the system, because glibc would keep most of a dropped model; takes 1 to 13 ms."""
    import ctypes

    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
