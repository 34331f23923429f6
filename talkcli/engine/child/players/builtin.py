"""Players that need neither a program nor a sound server."""

from __future__ import annotations

import contextlib
import os
import select
import stat
import struct
import time

from talkcli.engine.child.players.base import CannotSpeak, Player
from talkcli.engine.players import FILE_PREFIX, RATES_HZ, SAMPLE_BYTES
from talkcli.engine.protocol import OUTPUT_STREAM_NAME
from talkcli.goals.reasons import Reason
from talkcli.polling import NEVER, wait_ready

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from talkcli.engine.child.players.base import Interest

#: Seconds of sound that the null player accepts in advance. This is as much as a real player buffers, plus 1 ms for
#: rounding.
NULL_AHEAD_S = 0.061

_WAV_HEADER = struct.Struct("<4sI4s4sIHHIIHH4sI")
#: The number of header bytes that are included in the length after "RIFF".
_RIFF_HEADER_BYTES = _WAV_HEADER.size - 8
#: The value of both 32-bit length fields in the header of a stream.
_UNKNOWN_BYTES = 0xFFFFFFFF
#: The offset of the sample rate in the header.
_RATE_OFFSET = 24
_MAX_WAV_BYTES = _UNKNOWN_BYTES - _WAV_HEADER.size


class BuiltInPlayer(Player):
    """Base class of players that need neither a program nor a sound server."""

    proven = True

    def __init__(self) -> None:
        self._taken = 0
        self._closed = False

    def consumed(self) -> int:
        """Return the number of bytes accepted so far."""
        return self._taken

    def close(self) -> None:
        """Accept no more samples, and let the accepted ones play to the end."""
        self._closed = True

    def ended(self) -> bool:
        """Return whether `close` or `kill` was called."""
        return self._closed

    def interests(self) -> Sequence[Interest]:
        """Return no descriptors, because this player never makes the caller wait."""
        return ()

    def wake_at(self) -> float:
        """Return 0, because this player can be called again at once."""
        return 0.0

    def kill(self) -> None:
        """Accept no more samples."""
        self._closed = True

    def gone(self) -> bool:
        """Return True, because there is nothing to release."""
        return True


class NullPlayer(BuiltInPlayer):
    """A player that consumes samples in real time but makes no sound.

    This player is for simulated robots and for CI, where scripts have to keep their timing.
    """

    name = "null"
    real_time = True

    _clock = staticmethod(time.monotonic)

    def __init__(self, rate: int, _device: str | None = None, _audible: bool = False) -> None:
        super().__init__()
        self._bytes_per_second = rate * SAMPLE_BYTES
        #: the time at which the last accepted sample would have been heard
        self._end_time = 0.0

    def offer(self, data: memoryview) -> int:
        """Accept all samples if the simulated buffer has room for all of them, and otherwise none.

        Return the number of bytes accepted.
        """
        now = self._clock()
        end = max(now, self._end_time) + len(data) / self._bytes_per_second
        if end > now + NULL_AHEAD_S:
            return 0
        self._end_time = end
        self._taken += len(data)
        return len(data)

    def ended(self) -> bool:
        """Return whether the player was closed and its simulated buffer is empty."""
        return self._closed and self._clock() >= self._end_time

    def wake_at(self) -> float:
        """Return when to check the simulated buffer again.

        This is when it has room or, after `close`, when it is empty.
        """
        # At this time, a third of the buffer is free, so this player wakes up no more often than a real one.
        return self._end_time if self._closed else self._end_time - NULL_AHEAD_S * 2 / 3


class WavPlayer(BuiltInPlayer):
    """Appends the sound of one sentence to a WAV file.

    The file is valid after every sentence, even if the sentence was stopped. The player only appends to files with the
    plain 44-byte header that it writes itself. It removes samples beyond the length in the header, which a crash may
    have left.
    """

    real_time = False

    def __init__(self, path: str, rate: int) -> None:
        """Open or create the file.

        Raises:
            CannotSpeak: This sentence can't be written to the file (`audio_device`).
        """
        super().__init__()
        self.name = f"{FILE_PREFIX}{path}"
        self._path = path
        self._rate = rate
        with _convert_os_errors(Reason.AUDIO_DEVICE, f"{path} cannot be written"), contextlib.ExitStack() as opened:
            self._file = _open_regular_file(path)
            opened.callback(os.close, self._file)
            self._start = _sample_byte_count(self._file, path, rate)
            os.ftruncate(self._file, _WAV_HEADER.size + self._start)
            self._write_header()
            opened.pop_all()

    def offer(self, data: memoryview) -> int:
        """Write the samples to the file. Return the number of bytes written."""
        if self._closed:
            return 0
        end = self._start + self._taken
        if end + len(data) > _MAX_WAV_BYTES:
            raise CannotSpeak(Reason.AUDIO_LOST, f"{self._path} is full; a WAV file holds at most 4 GiB")
        with _convert_os_errors(Reason.AUDIO_LOST, self._path):
            taken = os.pwrite(self._file, data, _WAV_HEADER.size + end)
        self._taken += taken
        return taken

    def close(self) -> None:
        """Write the final header, and close the file."""
        if self._closed:
            return
        self._closed = True
        with _convert_os_errors(Reason.AUDIO_LOST, self._path):
            try:
                self._write_header()
            finally:
                os.close(self._file)  # some network file systems report a full disk or an exceeded quota only here

    def kill(self) -> None:
        """Close the file, and keep the samples written so far."""
        with contextlib.suppress(CannotSpeak):  # the sentence was stopped, or has already failed with another error
            self.close()

    def _write_header(self) -> None:
        """Write a WAV header for all samples that the file contains so far."""
        os.pwrite(self._file, _WAV_HEADER.pack(*_header_fields(self._rate, self._start + self._taken)), 0)


class WavStreamPlayer(BuiltInPlayer):
    """Writes the sound of a sentence to a WAV stream: a pipe, a device, or a file opened by the shell.

    The stream contains all sentences. Its header has no valid lengths, because it can't be rewritten later. The program
    that reads the stream sets the pace. Other programs share the descriptor, so this player doesn't make it
    non-blocking. It polls the descriptor before each write instead.
    """

    real_time = False
    name = OUTPUT_STREAM_NAME

    def __init__(self, output: int, rate: int, *, first: bool) -> None:
        """Open the player for a descriptor.

        If this is the `first` sentence, write a header before it.
        """
        super().__init__()
        self._output = output
        self._header = _WAV_HEADER.pack(*_header_fields(rate, _UNKNOWN_BYTES)) if first else b""

    def offer(self, data: memoryview) -> int:
        """Write the samples if the output has room. Return the number of bytes written."""
        # A writable pipe has room for at least a header and a piece of samples.
        if not wait_ready({self._output: select.POLLOUT}, 0.0):
            return 0
        with _convert_os_errors(Reason.AUDIO_LOST, self.name):
            written = os.write(self._output, self._header + data)
        header = min(written, len(self._header))
        self._header = self._header[header:]
        self._taken += written - header
        return written - header

    def interests(self) -> list[Interest]:
        """Return the output's descriptor, to wait until it accepts data."""
        return [(self._output, select.POLLOUT)]

    def wake_at(self) -> float:
        """Return NEVER, because the output's descriptor reports when there is room."""
        return NEVER


@contextlib.contextmanager
def _convert_os_errors(reason: Reason, subject: str) -> Iterator[None]:
    """Raise CannotSpeak instead of any OSError in a `with` block."""
    try:
        yield
    except OSError as error:
        raise CannotSpeak(reason, f"{subject}: {error.strerror}") from error


def _open_regular_file(path: str) -> int:
    """Open or create a regular file for reading and writing. Return its descriptor.

    Raises:
        CannotSpeak: The path is empty, or isn't that of a regular file.
        OSError: The file can't be opened.
    """
    if not path:
        raise CannotSpeak(Reason.AUDIO_DEVICE, 'the player "file:" needs a path, such as file:speech.wav')
    file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NONBLOCK, 0o666)
    if not stat.S_ISREG(os.fstat(file).st_mode):
        os.close(file)
        raise CannotSpeak(Reason.AUDIO_DEVICE, f"{path} is not a regular file")
    return file


def saved_rate(path: str) -> int | None:
    """Return the sample rate of a WAV file, or None if it has none. Create the file if it is missing."""
    try:
        file = _open_regular_file(path)
    except (CannotSpeak, OSError):
        return None  # `WavPlayer` will raise the same error
    rate = int.from_bytes(os.pread(file, 4, _RATE_OFFSET), "little")
    os.close(file)
    return rate if rate in RATES_HZ else None


def _header_fields(rate: int, sample_bytes: int) -> tuple[bytes | int, ...]:
    """Return the fields of a WAV header for this sample rate and number of sample bytes."""
    audio_format = (1, 1, rate, rate * SAMPLE_BYTES, SAMPLE_BYTES, 8 * SAMPLE_BYTES)  # PCM, one channel
    riff_bytes = min(_UNKNOWN_BYTES, _RIFF_HEADER_BYTES + sample_bytes)
    return b"RIFF", riff_bytes, b"WAVE", b"fmt ", 16, *audio_format, b"data", sample_bytes


def _sample_byte_count(file: int, path: str, rate: int) -> int:
    """Check the WAV header of a file. Return the number of sample bytes that the header states.

    Raises:
        CannotSpeak: The file wasn't written by a `WavPlayer` with this sample rate.
    """
    size = os.fstat(file).st_size
    if size == 0:
        return 0
    header = os.pread(file, _WAV_HEADER.size, 0)
    found = _WAV_HEADER.unpack(header.ljust(_WAV_HEADER.size, b"\0"))
    found_rate, length = int(found[7]), int(found[12])
    if found != _header_fields(found_rate, length):
        fault = "is not a WAV file written by talk (16 bit, one channel)"
    elif found_rate != rate:
        fault = f"has {found_rate} samples per second, but this voice has {rate}"
    elif size < _WAV_HEADER.size + length:
        fault = "is shorter than its header says"
    else:
        return length
    raise CannotSpeak(Reason.AUDIO_DEVICE, f"{path} {fault}; use another file")
