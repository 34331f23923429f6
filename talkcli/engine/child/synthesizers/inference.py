"""Functions to run Piper's models with onnxruntime.

Each model is split into two halves, which are cached as files. The encoder turns phoneme ids into frames, and the
decoder turns any range of frames into samples. A model runs in the thread that calls it, and onnxruntime starts no
other threads. A voice therefore uses one processor while it speaks, and none between sentences. Another thread can end
a run within milliseconds. This is the only module that imports onnxruntime.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import re
import shutil
import stat
import tempfile
import time

from talkcli import install
from talkcli.engine.child.synthesizers.vits import NotSplit, split_model
from talkcli.engine.models import BEGIN_SYMBOL, END_SYMBOL, PACKAGE_VARIABLES, PAD_SYMBOL, VoiceFileError, open_checked
from talkcli.frozen import TYPE_CHECKING, frozen

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from typing import Any

    from talkcli.engine.child.synthesizers.vits import Buffer
    from talkcli.engine.models import VoiceDescription

os.environ.update(PACKAGE_VARIABLES)  # these variables must be set before the packages are imported

#: How many extra frames to decode before and after a part, because they affect the part's samples. The calculated value
#: for Piper's largest decoder ("high") is 13.4. With 10 frames, the samples of a "medium" decoder differ by 1 in
#: 400,000.
CONTEXT_FRAMES = 14
#: The maximum size of a model. The size of Piper's models is 15 to 120 MB.
_MAX_MODEL_BYTES = 1 << 28
#: The maximum average number of frames per phoneme (including padding), and the maximum number of samples per frame. A
#: model that exceeds these limits could make minutes of sound from one sentence and use gigabytes of memory. At its
#: natural pace, en_US-joe-medium has 4 frames per phoneme on average, and 35 at most. Piper's frames have 256 samples.
_MAX_MEAN_FRAMES, _MAX_FRAME_SAMPLES = 40, 4096
#: If an error message contains one of these texts, onnxruntime or the dynamic linker has run out of memory.
_NO_MEMORY = (
    *("bad_alloc", "bad allocation", "Failed to allocate memory", os.strerror(errno.ENOMEM)),
    "failed to map segment from shared object",
)
#: Messages from onnxruntime are cut off at this length.
_MAX_ERROR_CHARS = 200
#: The version of `vits.split_model`. Increase it whenever that function returns different halves, so that old cached
#: halves are no longer used.
_SPLIT_VERSION = 1
#: The names of the inputs that every model has, and of the extra input for the speaker.
_INPUTS, _SPEAKER_INPUT = ("input", "input_lengths", "scales"), "sid"

#: The maximum size of the cache, which has room for about eight voices. If the cache gets larger, the oldest files are
#: removed.
MAX_CACHE_BYTES = 500_000_000
#: How many bytes of a model to write at a time. All other threads wait while these bytes are copied.
_WRITE_BYTES = 1 << 20
_ENCODER_SUFFIX, _DECODER_SUFFIX = ".encoder.onnx", ".decoder.onnx"
#: The suffix of a temporary directory in the cache, and the age at which it is removed. Writing takes only seconds, so
#: the process that created an older directory must have died.
_UNFINISHED_SUFFIX, _UNFINISHED_LIMIT_S = ".new", 3600.0
#: Matches the names of cached files and temporary directories. Nothing else is ever removed.
_CACHED_NAME = re.compile(r"[0-9a-f]{64}-.*(\.encoder\.onnx|\.decoder\.onnx|\.new)")


class ModelCache:
    """A directory that caches the two halves of each model. Other users have no access.

    The encoder is stored after onnxruntime has optimized it. If a file is damaged or can't be written, the halves are
    made again, so voices work without the cache. A key consists of 64 hexadecimal digits, a hyphen and anything else.
    """

    def __init__(self, directory: str) -> None:
        """Open or create the cache.

        Raises:
            OSError: The directory can't be used.
        """
        os.makedirs(directory, 0o700, exist_ok=True)
        status = os.lstat(directory)
        if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.geteuid() or status.st_mode & 0o077:
            raise PermissionError(f"other users can access {directory}; set its mode to 0700, or remove it")
        self._directory = directory

    def find(self, key: str) -> tuple[str, str]:
        """Mark a cached encoder and decoder as used, and return their paths. Raise OSError if one is missing."""
        paths = self._cached_path(key, _ENCODER_SUFFIX), self._cached_path(key, _DECODER_SUFFIX)
        for each in paths:
            os.utime(each)
        return paths

    def store(self, key: str, make_encoder: Callable[[str | None], Any], decoder_content: Iterable[Buffer]) -> Any:
        """Create and return the encoder of a model. Cache both halves if possible.

        Args:
            key: The key of the model.
            make_encoder: A function that creates the encoder and writes it to a path. If anything fails, it is called
                again with None, and then writes nothing.
            decoder_content: The content of the decoder's file, in parts.

        Returns:
            The result of `make_encoder`.
        """
        try:
            # Use a temporary directory, because another process may be storing the same model.
            with tempfile.TemporaryDirectory(_UNFINISHED_SUFFIX, key, self._directory) as folder:
                unfinished = os.path.join(folder, "half")
                with open(unfinished, "wb", _WRITE_BYTES) as file:
                    file.writelines(decoder_content)
                os.replace(unfinished, self._cached_path(key, _DECODER_SUFFIX))
                made = make_encoder(unfinished)
                os.replace(unfinished, self._cached_path(key, _ENCODER_SUFFIX))
        except Exception:  # noqa: BLE001 - if the encoder is at fault, the next line raises the error again
            made = make_encoder(None)
        self._shrink()
        return made

    def _cached_path(self, key: str, suffix: str) -> str:
        """Return the cache path for one half of a model."""
        return os.path.join(self._directory, key + suffix)

    def _shrink(self) -> None:
        """Remove leftover temporary directories, and old files if the cache is too large."""
        size = 0
        with contextlib.suppress(OSError):  # Another process may be removing the same files.
            cached = [each for each in os.scandir(self._directory) if _CACHED_NAME.fullmatch(each.name)]
            for each in sorted(cached, key=lambda each: each.stat().st_mtime, reverse=True):
                if not each.name.endswith(_UNFINISHED_SUFFIX):
                    size += each.stat().st_size
                    if size > MAX_CACHE_BYTES:
                        os.unlink(each)
                elif time.time() - each.stat().st_mtime > _UNFINISHED_LIMIT_S:
                    shutil.rmtree(each, ignore_errors=True)


@frozen
class Frames:
    """The encoder's output for a sequence of phoneme ids."""

    values: tuple[Any, ...]
    #: for each phoneme id, the number of the frame at which it ends
    ends: tuple[int, ...]

    @property
    def count(self) -> int:
        """The total number of frames."""
        return self.ends[-1]


class ModelRun:
    """A handle to stop a model that is speaking a sentence."""

    def __init__(self) -> None:
        import onnxruntime

        self.options = onnxruntime.RunOptions()
        self.options.log_severity_level = 4  # Log only fatal errors. Other errors raise exceptions.

    def end(self) -> None:
        """Stop the model. All runs with this handle raise VoiceFileError from now on.

        Any thread may call this.
        """
        self.options.terminate = True


class Model:
    """The loaded model of a Piper voice."""

    def __init__(self, path: str, description: VoiceDescription, cache: ModelCache | None = None) -> None:
        """Load a model. This takes 0.3 to 3 s, or much less if its halves are cached.

        Raises:
            VoiceFileError: The model can't be loaded.
        """
        import onnxruntime

        self.path = path
        self.description = description
        with open_checked(path) as file:
            size = os.fstat(file.fileno()).st_size
            if size > _MAX_MODEL_BYTES:
                raise VoiceFileError(f"{path} is larger than any Piper model; download the voice again")
            content: bytes = file.read(size)
        key = f"{hashlib.sha256(content).hexdigest()}-{_SPLIT_VERSION}-{onnxruntime.__version__}"
        if cache is not None:
            try:
                self._set_halves(*map(_create_session, cache.find(key)))
                return
            except Exception as error:  # The halves aren't cached, or a full disk has truncated them.
                if _is_out_of_memory(error):
                    raise no_memory_error(path) from error
        self._set_halves(*_split_and_cache(path, content, cache, key))

    def encode(self, ids: Sequence[int], speaker: int, duration_factor: float, run: ModelRun) -> Frames:
        """Encode a sequence of phoneme ids as frames.

        Args:
            ids: The model's ids of the phonemes.
            speaker: The number of the speaker. It is ignored if the model has only one.
            duration_factor: A factor by which all durations are multiplied, in addition to the voice's own factor.
            run: The handle that can end the run.

        Raises:
            VoiceFileError: The model is faulty, or the run was ended.
        """
        import numpy as np

        duration_scale = self.description.duration_scale * duration_factor
        scales = [self.description.noise, duration_scale, self.description.duration_noise]
        feed = {
            "input": np.array([ids], np.int64),
            "input_lengths": np.array([len(ids)], np.int64),
            "scales": np.array(scales, np.float32),
        }
        if self._has_speakers:
            feed[_SPEAKER_INPUT] = np.array([speaker], np.int64)
        *values, durations = self._run_half(self._encoder, feed, run)
        durations = durations.reshape(-1)
        if len(durations) != len(ids) or not np.isfinite(durations).all() or (durations < 0).any():
            raise VoiceFileError(f"{self.path} does not report the duration of each phoneme; download the voice again")
        limit = _MAX_MEAN_FRAMES * len(ids) * max(1.0, duration_scale)
        if durations.sum() > limit:
            words = f"makes more than {limit:.0f} frames for {len(ids)} phonemes"
            raise VoiceFileError(f"{self.path} {words}; download the voice again")
        return Frames(tuple(values), tuple(int(each) for each in np.cumsum(durations)))

    def decode(self, frames: Frames, begin: int, end: int, run: ModelRun) -> Any:
        """Decode a range of frames. Return their samples as floats.

        Raises:
            VoiceFileError: The model is faulty, or the run was ended.
        """
        import numpy as np

        low, high = max(0, begin - CONTEXT_FRAMES), min(frames.count, end + CONTEXT_FRAMES)
        # Values without one item per frame, such as the speaker, apply to the whole sentence.
        parts = {
            name: each[..., low:high] if each.shape[-1:] == (frames.count,) else each
            for name, each in zip(self._frame_inputs, frames.values, strict=True)
        }
        samples = self._run_half(self._decoder, parts, run)[0].reshape(-1)
        hop, rest = divmod(len(samples), high - low)
        if rest or not 0 < hop <= _MAX_FRAME_SAMPLES:
            raise self._not_piper_error(f"it makes {len(samples)} samples for {high - low} frames")
        part = samples[(begin - low) * hop : (end - low) * hop]
        if not np.isfinite(part).all():
            raise VoiceFileError(f"{self.path} produces invalid samples; download the voice again")
        return part

    def seconds(self, frame_count: int) -> float:
        """Return the duration of this many frames in seconds."""
        return frame_count * self._samples_per_frame / self.description.rate

    def _set_halves(self, encoder: Any, decoder: Any) -> None:
        """Store both halves of the model, and test them.

        Raises:
            VoiceFileError: The halves are faulty, or don't match the description.
        """
        self._encoder, self._decoder = encoder, decoder
        names = {each.name for each in encoder.get_inputs()}
        self._has_speakers = _SPEAKER_INPUT in names
        if names - {_SPEAKER_INPUT} != {*_INPUTS}:
            raise self._not_piper_error(f"its inputs are {', '.join(sorted(names))[:_MAX_ERROR_CHARS]}")
        if [each.type for each in decoder.get_outputs()] != ["tensor(float)"]:
            raise self._not_piper_error("it outputs no samples")
        if self._has_speakers != (self.description.speakers > 1):
            raise self._mismatch_error("only one of them has several speakers")
        self._frame_inputs = [each.name for each in decoder.get_inputs()]
        self._samples_per_frame = self._test_model()

    def _run_half(self, half: Any, inputs: dict[str, Any], run: ModelRun) -> list[Any]:
        """Run the encoder or the decoder. Return its outputs."""
        try:
            found: list[Any] = half.run(None, inputs, run.options)
        except Exception as error:
            raise _model_error(self.path, "cannot be run", error) from error
        return found

    def _test_model(self) -> int:
        """Test the model with one phoneme. Return the number of samples per frame."""
        ids = self.description.phoneme_ids
        highest = max(each for every in ids.values() for each in every)
        phonemes = [*ids[BEGIN_SYMBOL], *ids[PAD_SYMBOL], highest, *ids[PAD_SYMBOL], *ids[END_SYMBOL]]
        run = ModelRun()
        try:
            frames = self.encode(phonemes, 0, 1.0, run)
        except VoiceFileError as error:
            if _is_out_of_memory(error.__cause__):
                raise
            raise self._mismatch_error(str(error.__cause__ or error)) from error
        if not frames.count:
            raise VoiceFileError(f"{self.path} produces no sound; download the voice again")
        return len(self.decode(frames, 0, frames.count, run)) // frames.count

    def _not_piper_error(self, why: str) -> VoiceFileError:
        """Return the error for a file that isn't a Piper model."""
        return VoiceFileError(f"{self.path} is not a Piper model ({why}); download the voice again")

    def _mismatch_error(self, why: str) -> VoiceFileError:
        """Return the error for a model that doesn't match its JSON file."""
        both = f"{self.path} and {os.path.basename(self.path)}.json"
        return VoiceFileError(f"{both} do not belong together ({why[:_MAX_ERROR_CHARS]}); download both again")


def load_libraries(model_path: str) -> None:
    """Import numpy and onnxruntime. If this fails, raise an error that names the model.

    This takes 0.25 s, and blocks all other threads for a tenth of that time.

    Raises:
        VoiceFileError: The packages can't be imported, or there is not enough memory.
    """
    try:
        import numpy as np  # noqa: F401 - onnxruntime would hide the reason if numpy can't be imported
        import onnxruntime  # noqa: F401
    except Exception as error:
        raise _model_error(model_path, "could not be loaded", error, f"run: {install.neural_command()}") from error


def _split_and_cache(path: str, content: bytes, cache: ModelCache | None, key: str) -> tuple[Any, Any]:
    """Split a model and cache its halves. Return a session for each half.

    Raises:
        VoiceFileError: The model can't be split or loaded.
    """
    try:
        encoder_file, decoder_file = split_model(content)
    except NotSplit as error:
        raise VoiceFileError(f"{path} {error}; download the voice again, from a source that you trust") from error
    try:
        decoder = _create_half_session(decoder_file)
        if cache is None:
            return _create_half_session(encoder_file), decoder
        return cache.store(key, lambda place: _create_half_session(encoder_file, place), decoder_file), decoder
    except Exception as error:
        raise _model_error(path, "could not be loaded", error) from error


def _create_half_session(half: Sequence[Buffer], save_optimized_to: str | None = None) -> Any:
    """Create an onnxruntime session from the content of one half of a model.

    onnxruntime reads the half from a temporary file in memory. To pass bytes instead, the parts would have to be
    joined, and onnxruntime would keep a copy of them. For the voice joe, each of these steps takes 30 to 110 ms, during
    which all other threads wait.
    """
    try:
        with open(os.memfd_create("half"), "wb", _WRITE_BYTES) as file:
            file.writelines(half)
            file.flush()
            return _create_session(f"/proc/self/fd/{file.fileno()}", save_optimized_to)
    except (OSError, AttributeError):  # The system doesn't support files in memory, or limits their size.
        return _create_session(b"".join(half), save_optimized_to)


def _create_session(model: str | bytes, save_optimized_to: str | None = None) -> Any:
    """Create an onnxruntime session from the path or the content of a model.

    If `save_optimized_to` is given, also write the optimized model to this path.
    """
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    # Turn off onnxruntime's memory arena, which never shrinks and doesn't make a model faster.
    options.enable_cpu_mem_arena = options.enable_mem_pattern = False
    # A higher optimization level takes 0.15 s longer and doesn't make the model faster. Its result can only be used on
    # one type of processor.
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC
    if save_optimized_to is not None:
        options.optimized_model_filepath = save_optimized_to
    return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])


def _model_error(path: str, problem: str, error: Exception, advice: str = "download the voice again") -> VoiceFileError:
    """Convert an onnxruntime error to a VoiceFileError.

    `advice` tells the user what to do next.
    """
    if _is_out_of_memory(error):
        return no_memory_error(path)
    first_line = (str(error).strip() or type(error).__name__).splitlines()[0]
    return VoiceFileError(f"{path} {problem} ({first_line[:_MAX_ERROR_CHARS]}); {advice}")


def no_memory_error(path: str) -> VoiceFileError:
    """Return the error for a model that doesn't fit into memory."""
    return VoiceFileError(f"{path} cannot be used: there is not enough memory; end another program")


def _is_out_of_memory(error: BaseException | None) -> bool:
    """Return whether an exception was caused by a lack of memory."""
    return isinstance(error, MemoryError) or any(each in str(error) for each in _NO_MEMORY)
