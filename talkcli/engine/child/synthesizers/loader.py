"""Neural voices' models: loaded one at a time beside the speech, and kept in memory until they are to be dropped.

A load is a thread's, as it takes seconds; all else is done by the one thread that calls. What becomes of a load is
told once, as an event for the server, which decides what is loaded and what is dropped for it. A voice is named here
by its id without a speaker.
"""

from __future__ import annotations

import os
import time
import traceback
from collections import deque

from talkcli import install
from talkcli.engine import models
from talkcli.engine.child.synthesizers import memory
from talkcli.engine.child.synthesizers.cache import Cache
from talkcli.engine.child.synthesizers.inference import Model, load_libraries
from talkcli.engine.child.synthesizers.work import Work
from talkcli.engine.models import BadFile
from talkcli.engine.protocol import LOAD_LIMIT_S, VoiceLoaded, VoiceMemory, VoiceUnloaded
from talkcli.engine.voices import NEURAL
from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.paths import cache_directory

if TYPE_CHECKING:
    from collections.abc import Iterator

#: Bytes of growth after which freed memory is given back, and the process is measured. Less is left alone, because the
#: next sentence needs it again.
GROWTH_BYTES = 16_000_000


@frozen
class Kept:
    """A model that is loaded."""

    model: Model
    stamps: tuple[tuple[int, int, int], ...]  # of its files when it was loaded


class Loader:
    """The models that are in memory, and those that are to come."""

    def __init__(self) -> None:
        #: by voice
        self._models: dict[str, Kept] = {}
        #: to be loaded after the one that is being loaded
        self._waiting: deque[str] = deque()
        self._work: Work[Kept] | None = None
        self._voice = ""
        self._began = 0.0
        #: those of them that could not be spoken with
        self._suspect: set[str] = set()
        #: why the last attempt to load a voice failed
        self._errors: dict[str, str] = {}
        self._news: list[VoiceLoaded | VoiceUnloaded | VoiceMemory] = []
        #: the process's own bytes before the first load, and by how many it had grown when that was told last
        self._at_first: int | None = None
        self._grown = 0
        #: the voice that has spoken since the process was measured, "" for one that was dropped; None for none
        self._unmeasured: str | None = None

    @property
    def descriptor(self) -> int | None:
        """What is readable when something has been loaded; None where nothing is being loaded."""
        return self._work.descriptor if self._work else None

    @property
    def deadline(self) -> float:
        """The monotonic time at which what is being loaded is given up."""
        return self._began + LOAD_LIMIT_S

    def drop(self, voice: str) -> None:
        """Keep a voice no longer; one that speaks is there until it has spoken."""
        if self._models.pop(voice, None):
            self._unmeasured = ""
        self._suspect.discard(voice)

    def start(self, voice: str) -> None:
        """Have a voice loaded, unless it is, or is about to be; what was wrong with it is forgotten."""
        if voice in self._models:
            self._news.append(VoiceLoaded(voice, 0.0))
        elif voice not in self._waiting and not (self._work and voice == self._voice):
            self._errors.pop(voice, None)
            self._waiting.append(voice)
            self._go_on()

    def model(self, voice: str) -> Model | None:
        """Return the model of a voice, if it is there."""
        self._look()
        found = self._models.get(voice)
        if found and voice in self._suspect and found.stamps != _stamps(found.model.path):
            self.drop(voice)
            self._news.append(VoiceUnloaded(voice))
            return None
        return found.model if found else None

    def error(self, voice: str) -> str | None:
        """Return why a voice can't be had, by the last attempt to load it."""
        return self._errors.get(voice)

    def suspect(self, voice: str) -> None:
        """Take note that a voice that is loaded could not be spoken with: it is dropped once its files are others."""
        self._suspect.add(voice)

    def spoken(self, voice: str) -> None:
        """Take note that a voice has spoken: the first sentences need memory that is kept."""
        if voice not in self._models:
            self._unmeasured = ""  # it was dropped meanwhile, and is freed only now
        elif self._unmeasured is None:
            self._unmeasured = voice

    def events(self) -> list[VoiceLoaded | VoiceUnloaded | VoiceMemory]:
        """Return what became of voices since this was asked last."""
        self._look()
        if self._unmeasured is not None:
            self._measure(self._unmeasured, least=GROWTH_BYTES)
        news, self._news = self._news, []
        return news

    def _look(self) -> None:
        """Take what has been loaded, or has failed to be; never waits."""
        work, voice = self._work, self._voice
        if work is None:
            return
        try:
            if not work.ready:
                if time.monotonic() < self.deadline:
                    return
                # Whatever its thread hangs in, a file of a server that is gone, may hang for ever.
                raise BadFile(f"{voice} was not loaded within {LOAD_LIMIT_S:g} s: are its files on a slow disk?")
            made = work.take()
            assert made is not None
        except BadFile as error:
            self._end(voice, self._took(), str(error))
        except Exception as error:  # noqa: BLE001 - of whatever kind: a voice costs no engine
            traceback.print_exception(error)
            self._end(voice, self._took(), f"{voice} cannot be loaded: {type(error).__name__}: {error}")
        else:
            self._models[voice] = made
            self._measure(voice)
            self._news.append(VoiceLoaded(voice, self._took()))
        work.close()
        self._work = None
        self._go_on()

    def _measure(self, voice: str, least: int = 0) -> None:
        """Tell by how much the process has grown; for a voice that has spoken only from so many bytes more on."""
        self._unmeasured = None
        before, now = self._at_first, memory.own_bytes()
        if before is None or now is None or (voice and least and now - before - self._grown < least):
            return
        memory.give_back()
        self._grown = max(0, (memory.own_bytes() or now) - before)
        self._news.append(VoiceMemory(voice, self._grown))

    def _took(self) -> float:
        return round(time.monotonic() - self._began, 3)

    def _end(self, voice: str, seconds: float, why: str) -> None:
        self._errors[voice] = why
        self._news.append(VoiceLoaded(voice, seconds, why))

    def _go_on(self) -> None:
        """Load the next, one at a time: each takes twice its memory, and a processor, meanwhile."""
        if self._work or not self._waiting:
            return
        self._voice, self._began = self._waiting.popleft(), time.monotonic()
        try:
            path = _path(self._voice)
        except BadFile as error:
            self._end(self._voice, 0.0, str(error))
            self._go_on()
            return
        if self._at_first is None:
            self._at_first = memory.own_bytes()
        self._work = Work(_load(path), room=1)


def _path(voice: str) -> str:
    """Return the path of a voice's model; BadFile."""
    lacking = models.missing()
    if lacking is not None:
        raise BadFile(lacking)
    path = models.found().get(voice.removeprefix(NEURAL))
    if path is None:
        raise BadFile(f"{voice}: its file is not there any more")
    return path


def _stamps(path: str) -> tuple[tuple[int, int, int], ...]:
    """Return what tells that the files of a voice are others: none where they can't be looked at."""
    try:
        found = [os.stat(each) for each in (path, path + models.JSON)]
    except OSError:
        return ()
    return tuple((each.st_ino, each.st_size, each.st_mtime_ns) for each in found)


def _load(path: str) -> Iterator[Kept]:
    try:
        load_libraries(path)  # first, so that it is known of any load that took time
        stamps = _stamps(path)
        yield Kept(Model(path, models.describe(path), _cache()), stamps)
    except OSError as error:
        raise BadFile(f"{path} cannot be read: {error.strerror}") from error
    except ImportError as error:
        raise BadFile(f"{path} cannot be loaded ({error}): {install.neural()}") from error
    except MemoryError as error:
        raise BadFile(f"{path} cannot be loaded: there is no memory for it; end another program") from error


def _cache() -> Cache | None:
    """Return where halves are kept; None where that can't be had, which the log tells."""
    try:
        return Cache(cache_directory())
    except OSError:
        traceback.print_exc()
        return None
