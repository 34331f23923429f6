"""WAV files: the player "file:PATH", to which every sentence is appended, and one that is written as the sound is made.

The first is a valid WAV file after every sentence and after a stop. It never writes to a file that it might not have
written: only the plain 44-byte header that it writes itself is accepted. What a crash left behind the length in that
header is cut off.
"""

from __future__ import annotations

import contextlib
import os
import select
import stat
import struct

from talkcli.engine.players.base import SAMPLE, CannotSpeak

TYPE_CHECKING = False
if TYPE_CHECKING:
    from talkcli.engine.players.base import Interest

_HEADER = struct.Struct("<4sI4s4sIHHIIHH4sI")
#: The header's two lengths are 32 bits wide.
_UNKNOWN = 0xFFFFFFFF
_LONGEST = _UNKNOWN - _HEADER.size


class WavPlayer:
    """The WAV file, open for one sentence."""

    real_time = False
    proven = True

    def __init__(self, path: str, rate: int) -> None:
        """Open or create the file; CannotSpeak (audio_device) if it cannot take this sentence."""
        self.name = f"file:{path}"
        self._path = path
        self._rate = rate
        self._start = 0
        self._taken = 0
        self._file: int | None = _open(path)
        try:
            self._start = _data_length(self._file, path, rate)
            os.ftruncate(self._file, _HEADER.size + self._start)
            self._write_header()
        except (OSError, CannotSpeak) as error:
            os.close(self._file)
            self._file = None
            raise _refused(path, error) from error

    def offer(self, data: memoryview) -> int:
        """Append the samples."""
        if self._file is None:
            return 0
        if self._start + self._taken + len(data) > _LONGEST:
            raise CannotSpeak("audio_lost", f"{self._path} is full: a WAV file holds 4 GiB")
        try:
            taken = os.pwrite(self._file, data, _HEADER.size + self._start + self._taken)
        except OSError as error:
            raise CannotSpeak("audio_lost", f"{self._path}: {error.strerror}") from error
        self._taken += taken
        return taken

    def consumed(self) -> int:
        """Return what was appended."""
        return self._taken

    def close(self) -> None:
        """Write the new length into the header."""
        if self._file is None:
            return
        file, self._file = self._file, None
        try:
            try:
                self._write_header(file)
            finally:
                os.close(file)  # where a quota or a file system of another machine tells that it is full
        except OSError as error:
            raise CannotSpeak("audio_lost", f"{self._path}: {error.strerror}") from error

    def ended(self) -> bool:
        """Return True once it is closed."""
        return self._file is None

    def interests(self) -> list[Interest]:
        """Return nothing: a file takes everything at once."""
        return []

    def wake_at(self) -> float | None:
        """Return "at once"."""
        return 0.0

    def kill(self) -> None:
        """Keep what was written so far as a valid file."""
        # The sentence has ended by a stop or by an error of its own, which is the one to report.
        with contextlib.suppress(CannotSpeak):
            self.close()

    def gone(self) -> bool:
        """Return True once it is closed."""
        return self._file is None

    def _write_header(self, file: int | None = None) -> None:
        target = self._file if file is None else file
        assert target is not None
        os.pwrite(target, _header(self._rate, self._start + self._taken), 0)


class WavStreamPlayer:
    """A stream into a pipe, a device, or a file that the shell has opened, for one of the sentences that follow in it.

    Nobody can go back in it, so its header says of its lengths that they are unknown. Whoever reads it decides how long
    it takes. The descriptor is shared with other programs, so whether it blocks is not ours to change: it is given what
    fits.
    """

    real_time = False
    proven = True
    name = "the output"

    def __init__(self, output: int, rate: int, *, first: bool) -> None:
        """`output`: an open descriptor; `first`: whether this sentence begins the stream."""
        self._output = output
        self._header = _endless_header(rate) if first else b""
        self._poll = select.poll()
        self._poll.register(output, select.POLLOUT)
        self._taken = 0
        self._closed = False

    def offer(self, data: memoryview) -> int:
        """Write the samples if there is room: a pipe that poll calls writable takes a header and a piece at least."""
        if not self._poll.poll(0):
            return 0
        try:
            written = os.write(self._output, self._header + data if self._header else data)
        except BlockingIOError:
            return 0
        except OSError as error:
            raise CannotSpeak("audio_lost", f"{self.name}: {error.strerror}") from error
        header = min(written, len(self._header))
        self._header = self._header[header:]
        self._taken += written - header
        return written - header

    def consumed(self) -> int:
        """Return what was written."""
        return self._taken

    def close(self) -> None:
        """Take note that the sentence is complete; the next may follow."""
        self._closed = True

    def ended(self) -> bool:
        """Return True once it is closed."""
        return self._closed

    def interests(self) -> list[Interest]:
        """Return the output, for when it takes more or its reader is gone."""
        return [(self._output, select.POLLOUT)]

    def wake_at(self) -> float | None:
        """Return None: poll will tell."""
        return None

    def kill(self) -> None:
        """Write no more."""
        self._closed = True

    def gone(self) -> bool:
        """Return True once it is closed: what was written waits nowhere in here."""
        return self._closed


def _open(path: str) -> int:
    try:
        if not path:
            raise CannotSpeak("audio_device", "the player file: needs a path, as in file:speech.wav")
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NONBLOCK, 0o666)
    except OSError as error:
        raise _refused(path, error) from error
    if not stat.S_ISREG(os.fstat(file).st_mode):
        os.close(file)
        raise CannotSpeak("audio_device", f"{path} is no regular file")
    return file


def _refused(path: str, error: OSError | CannotSpeak) -> CannotSpeak:
    if isinstance(error, CannotSpeak):
        return error
    return CannotSpeak("audio_device", f"{path} cannot be written: {error.strerror}")


def _header(rate: int, length: int) -> bytes:
    size = _HEADER.size - 8 + length
    return _HEADER.pack(
        b"RIFF", size, b"WAVE", b"fmt ", 16, 1, 1, rate, rate * SAMPLE, SAMPLE, 8 * SAMPLE, b"data", length
    )


def _endless_header(rate: int) -> bytes:
    """Return the header of a file whose length nobody knows yet: both of its lengths are the greatest there are."""
    return _HEADER.pack(
        b"RIFF", _UNKNOWN, b"WAVE", b"fmt ", 16, 1, 1, rate, rate * SAMPLE, SAMPLE, 8 * SAMPLE, b"data", _UNKNOWN
    )


def _data_length(file: int, path: str, rate: int) -> int:
    """Return the length of the samples in the file, 0 for an empty one; CannotSpeak if the file is not ours."""
    size = os.fstat(file).st_size
    if size == 0:
        return 0
    header = os.pread(file, _HEADER.size, 0)
    if len(header) < _HEADER.size:
        raise _foreign(path)
    fields = _HEADER.unpack(header)
    found_rate, length = fields[7], fields[12]
    if header != _header(found_rate, length):
        raise _foreign(path)
    if found_rate != rate:
        raise CannotSpeak(
            "audio_device", f"{path} has {found_rate} samples a second, this voice {rate}: use another file"
        )
    if size < _HEADER.size + length:
        raise CannotSpeak("audio_device", f"{path} is shorter than its header says: use another file")
    return int(length)


def _foreign(path: str) -> CannotSpeak:
    return CannotSpeak("audio_device", f"{path} is no WAV file of talk's (16 bit, one channel): use another file")
