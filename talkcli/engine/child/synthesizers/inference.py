"""A Piper voice's model in onnxruntime, in two halves: from sounds to frames, and from some of these to samples.

It runs in whatever thread calls it, and that alone: onnxruntime is told to start none, so that one processor of the
machine is taken and no other, and none where nobody speaks. Whoever holds the `Run` ends it from another thread within
milliseconds. onnxruntime and numpy are imported here alone, when a model is loaded. What goes wrong in a model is
BadFile, with words that name its file.
"""

from __future__ import annotations

import errno
import hashlib
import os

from talkcli.engine.child.synthesizers.cache import AT_ONCE
from talkcli.engine.child.synthesizers.vits import NotCut, halves
from talkcli.engine.models import BEGIN, END, NO_TELEMETRY, PAD, BadFile, open_checked
from talkcli.frozen import TYPE_CHECKING, frozen

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Any

    from talkcli.engine.child.synthesizers.cache import Cache
    from talkcli.engine.child.synthesizers.vits import Buffer
    from talkcli.engine.models import Description

os.environ.update(NO_TELEMETRY)  # before onnxruntime is imported

#: Frames on either side of some that their samples depend on. Reckoned for the largest of Piper's decoders ("high"),
#: 13.4; of a "medium" one the samples with 10 are those of the whole to a part in 400,000.
AROUND = 14
#: Bytes of a model: Piper's have 15 to 120 million.
_LARGEST = 1 << 28
#: Frames that a sound may last on the average, the blanks between them counted as sounds, and the samples of one: of
#: en_US-joe-medium's they are 4 at most at its own pace, 35 a single one, and each of Piper's has 256 samples. More
#: would be minutes of one sentence, and gigabytes.
_MOST_FRAMES, _MOST_SAMPLES = 40, 4096
#: What onnxruntime says, in the midst of much else, where it got no memory, and what is said of libraries.
_NO_MEMORY = ("bad_alloc", "bad allocation", "Failed to allocate memory", os.strerror(errno.ENOMEM))
_NO_MEMORY_FOR_LIBRARIES = "failed to map segment from shared object"
#: Characters of what onnxruntime says that are handed on.
_SHOWN = 200
#: The number of the way in which `vits` cuts: to be raised with it, so that what was kept is made anew.
_CUT = 1
#: Names of the model's inputs; the last only where there are several speakers.
_INPUTS, _SPEAKER = ("input", "input_lengths", "scales"), "sid"


@frozen
class Frames:
    """What the encoder makes of some sounds."""

    values: tuple[Any, ...]
    #: where among the frames each sound ends
    ends: tuple[int, ...]

    @property
    def count(self) -> int:
        return self.ends[-1]


class Run:
    """What runs a model for one sentence, until it is ended."""

    def __init__(self) -> None:
        import onnxruntime

        self.options = onnxruntime.RunOptions()
        self.options.log_severity_level = 4  # fatal; what else there is to say is raised

    def end(self) -> None:
        """Have what runs now, or later, raise; from any thread."""
        self.options.terminate = True


class Model:
    """A model that is loaded."""

    def __init__(self, path: str, description: Description, cache: Cache | None = None) -> None:
        """Load it, in 0.3 to 3 s; BadFile. What takes the most of it is kept in the cache."""
        self.path = path
        self.description = description
        with open_checked(path) as file:
            size = os.fstat(file.fileno()).st_size
            if size > _LARGEST:
                raise BadFile(f"{path} is larger than any of Piper's models: get the voice anew")
            content: bytes = file.read(size)
        key = f"{hashlib.sha256(content).hexdigest()}-{_CUT}-{_version()}"
        kept = cache.find(key) if cache is not None else None
        if cache is not None and kept is not None:
            try:
                self._take(*_kept(*kept))
                return
            except Exception as error:
                if _lacks_memory(error):
                    raise _no_memory(path) from error
                cache.forget(key)  # cut short by a full disk, or whatever: it is made anew, and tells then
        self._take(*_cut(path, content, cache, key))

    def _take(self, encoder: Any, decoder: Any) -> None:
        """Take both halves, if they are what they should be and speak; BadFile."""
        path, description = self.path, self.description
        self._encoder, self._decoder = encoder, decoder
        self._several = _SPEAKER in {each.name for each in self._encoder.get_inputs()}
        names = {each.name for each in self._encoder.get_inputs()}
        if names - {_SPEAKER} != {*_INPUTS}:
            takes = ", ".join(sorted(names))[:_SHOWN]
            raise BadFile(f"{path} is none of Piper's models (it takes {takes}): get the voice anew")
        if [each.type for each in decoder.get_outputs()] != ["tensor(float)"]:
            raise BadFile(f"{path} is none of Piper's models (it makes no samples): get the voice anew")
        if self._several != (description.speakers > 1):
            raise self._foreign("one has several speakers, the other has one")
        self._frames = [each.name for each in self._decoder.get_inputs()]
        self._hop = self._try_out()

    def encode(self, numbers: Sequence[int], speaker: int, pace: float, run: Run) -> Frames:
        """Return the frames of these sounds, by the model's numbers for them.

        `pace` is what durations are multiplied with, beside the voice's own.
        """
        import numpy as np

        about = self.description
        feed = {
            "input": np.array([numbers], np.int64),
            "input_lengths": np.array([len(numbers)], np.int64),
            "scales": np.array([about.noise, about.pace * pace, about.noise_of_durations], np.float32),
        }
        if self._several:
            feed[_SPEAKER] = np.array([speaker], np.int64)
        *values, durations = self._outputs(self._encoder, feed, run)
        durations = durations.reshape(-1)
        if len(durations) != len(numbers) or not np.isfinite(durations).all() or (durations < 0).any():
            raise BadFile(f"{self.path} does not tell how long each sound lasts: get the voice anew")
        most = _MOST_FRAMES * len(numbers) * max(1.0, about.pace * pace)
        if durations.sum() > most:
            raise BadFile(f"{self.path} makes more than {most:.0f} frames of {len(numbers)} sounds: get the voice anew")
        return Frames(tuple(values), tuple(int(each) for each in np.cumsum(durations)))

    def decode(self, frames: Frames, begin: int, end: int, run: Run) -> Any:
        """Return the samples of the frames from `begin` to before `end`, as floats, 1.0 for full scale."""
        import numpy as np

        low, high = max(0, begin - AROUND), min(frames.count, end + AROUND)
        # What goes for the whole, as who speaks, has no frames.
        parts = {
            name: each[..., low:high] if each.shape[-1:] == (frames.count,) else each
            for name, each in zip(self._frames, frames.values, strict=True)
        }
        samples = self._outputs(self._decoder, parts, run)[0].reshape(-1)
        hop, rest = divmod(len(samples), high - low)
        if rest or not 0 < hop <= _MOST_SAMPLES:
            made = f"it makes {len(samples)} samples of {high - low} frames"
            raise BadFile(f"{self.path} is none of Piper's models ({made}): get the voice anew")
        part = samples[(begin - low) * hop : (end - low) * hop]
        if not np.isfinite(part).all():
            raise BadFile(f"{self.path} makes no sound, but what is no number: get the voice anew")
        return part

    def seconds(self, frames: int) -> float:
        """Return how long so many frames are heard."""
        return frames * self._hop / self.description.rate

    def _outputs(self, half: Any, feed: dict[str, Any], run: Run) -> list[Any]:
        try:
            found: list[Any] = half.run(None, feed, run.options)
        except Exception as error:
            raise _told(self.path, "cannot be run", error) from error
        return found

    def _try_out(self) -> int:
        """Return the samples of a frame; BadFile if the model doesn't speak, or doesn't know the JSON's sounds."""
        sounds = self.description.sounds
        highest = max(each for every in sounds.values() for each in every)
        numbers = [*sounds[BEGIN], *sounds[PAD], highest, *sounds[PAD], *sounds[END]]
        run = Run()
        try:
            frames = self.encode(numbers, 0, 1.0, run)
        except BadFile as error:
            if _lacks_memory(error.__cause__):
                raise
            raise self._foreign(str(error.__cause__ or error)) from error
        if not frames.count:
            raise BadFile(f"{self.path} speaks nothing: get the voice anew")
        return len(self.decode(frames, 0, frames.count, run)) // frames.count

    def _foreign(self, why: str) -> BadFile:
        beside = f"{os.path.basename(self.path)}.json"
        return BadFile(
            f"{self.path} and {beside} do not belong together ({why[:_SHOWN]}): get both from the same place"
        )


def _version() -> str:
    import onnxruntime

    return str(onnxruntime.__version__)


def _kept(encoder: str, decoder: str) -> tuple[Any, Any]:
    """Return both halves' sessions from the files of the cache; the first is optimised already."""
    import onnxruntime

    return _session(encoder, onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL), _session(decoder)


def _cut(path: str, content: bytes, cache: Cache | None, key: str) -> tuple[Any, Any]:
    """Return both halves' sessions by cutting the model, and keep the halves in the cache; BadFile."""
    try:
        cut = halves(content)
    except NotCut as error:
        raise BadFile(f"{path} {error}: get the voice anew, from a source that you trust") from error
    try:
        decoder = _session_of(cut.decoder)
        if cache is None:
            return _session_of(cut.encoder), decoder
        return cache.keep(key, lambda place: _session_of(cut.encoder, place), cut.decoder), decoder
    except Exception as error:
        raise _told(path, "cannot be loaded", error) from error


def _session_of(half: Sequence[Buffer], kept: str | None = None) -> Any:
    """Return what runs a half.

    It is read from a file in memory, which is gone then: bytes would first be joined, and kept and copied by
    onnxruntime, 30 to 110 ms each for joe's, in which no other thread of the process runs.
    """
    try:
        with open(os.memfd_create("half"), "wb", AT_ONCE) as file:
            file.writelines(half)
            file.flush()
            return _session(f"/proc/self/fd/{file.fileno()}", kept=kept)
    except (OSError, AttributeError):  # a file may not be as long, or this Python knows of none in memory
        return _session(b"".join(half), kept=kept)


def _session(model: str | bytes, level: Any = None, kept: str | None = None) -> Any:
    """Return what runs a model, a file's or this; `kept`: the file into which it is written as it was optimised."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    # It would keep the most that it ever needed, and is no faster with it.
    options.enable_cpu_mem_arena = options.enable_mem_pattern = False
    # No more than this: the levels above take 0.15 s longer, make nothing faster, and fit one kind of processor only.
    options.graph_optimization_level = level or onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC
    if kept is not None:
        options.optimized_model_filepath = kept
    return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])


def load_libraries(path: str) -> None:
    """Import what runs a model, the one at `path`; BadFile where there is no memory, ImportError.

    It takes a quarter of a second, for a tenth of which no other thread of the process runs.
    """
    try:
        import numpy as np  # noqa: F401 - before onnxruntime, which doesn't say why it fails
        import onnxruntime  # noqa: F401
    except Exception as error:
        if _lacks_memory(error):
            raise _no_memory(path) from error
        raise ImportError(_first_line(error)) from error


def _told(path: str, what: str, error: Exception) -> BadFile:
    """Return what is said of a model that onnxruntime does not take."""
    if _lacks_memory(error):
        return _no_memory(path)
    return BadFile(f"{path} {what} ({_first_line(error)}): get the voice anew")


def _no_memory(path: str) -> BadFile:
    return BadFile(f"{path} cannot be spoken with: there is no memory for it; end another program")


def _lacks_memory(error: BaseException | None) -> bool:
    return isinstance(error, MemoryError) or any(each in str(error) for each in (*_NO_MEMORY, _NO_MEMORY_FOR_LIBRARIES))


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0][:_SHOWN]
