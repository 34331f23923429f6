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

from talkcli.engine.child.players.base import BuiltIn, CannotSpeak
from talkcli.engine.players import SAMPLE_BYTES

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterator

    from talkcli.engine.child.players.base import Interest

_HEADER = struct.Struct("<4sI4s4sIHHIIHH4sI")
#: The bytes of the header that its first length counts, besides the samples.
_REST = _HEADER.size - 8
#: The header's two lengths are 32 bits wide.
_UNKNOWN = 0xFFFFFFFF
_LONGEST = _UNKNOWN - _HEADER.size


class WavPlayer(BuiltIn):
    """The WAV file, open for one sentence."""

    real_time = False

    def __init__(self, path: str, rate: int) -> None:
        """Open or create the file; CannotSpeak (audio_device) if it cannot take this sentence."""
        super().__init__()
        self.name = f"file:{path}"
        self._path = path
        self._rate = rate
        with _failing("audio_device", f"{path} cannot be written"), contextlib.ExitStack() as opened:
            self._file = _open(path)
            opened.callback(os.close, self._file)
            self._start = _data_length(self._file, path, rate)
            os.ftruncate(self._file, _HEADER.size + self._start)
            self._write_header()
            opened.pop_all()

    def offer(self, data: memoryview) -> int:
        """Append the samples."""
        if self._closed:
            return 0
        end = self._start + self._taken
        if end + len(data) > _LONGEST:
            raise CannotSpeak("audio_lost", f"{self._path} is full: a WAV file holds 4 GiB")
        with _failing("audio_lost", self._path):
            taken = os.pwrite(self._file, data, _HEADER.size + end)
        self._taken += taken
        return taken

    def close(self) -> None:
        """Write the new length into the header."""
        if self._closed:
            return
        self._closed = True
        with _failing("audio_lost", self._path):
            try:
                self._write_header()
            finally:
                os.close(self._file)  # where a quota or a file system of another machine tells that it is full

    def kill(self) -> None:
        """Keep what was written so far as a valid file."""
        # The sentence has ended by a stop or by an error of its own, which is the one to report.
        with contextlib.suppress(CannotSpeak):
            self.close()

    def _write_header(self) -> None:
        length = self._start + self._taken
        os.pwrite(self._file, _HEADER.pack(*_fields(self._rate, _REST + length, length)), 0)


class WavStreamPlayer(BuiltIn):
    """A stream into a pipe, a device, or a file that the shell has opened, for one of the sentences that follow in it.

    Nobody can go back in it, so its header says of its lengths that they are unknown. Whoever reads it decides how long
    it takes. The descriptor is shared with other programs, so whether it blocks is not ours to change: it is given what
    fits.
    """

    real_time = False
    name = "the output"

    def __init__(self, output: int, rate: int, *, first: bool) -> None:
        """`output`: an open descriptor; `first`: whether this sentence begins the stream."""
        super().__init__()
        self._output = output
        self._header = _HEADER.pack(*_fields(rate, _UNKNOWN, _UNKNOWN)) if first else b""
        self._poll = select.poll()
        self._poll.register(output, select.POLLOUT)

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

    def interests(self) -> list[Interest]:
        """Return the output, for when it takes more or its reader is gone."""
        return [(self._output, select.POLLOUT)]

    def wake_at(self) -> float | None:
        """Return None: poll will tell."""
        return None


@contextlib.contextmanager
def _failing(reason: str, what: str) -> Iterator[None]:
    """Have an error of the system end the sentence."""
    try:
        yield
    except OSError as error:
        raise CannotSpeak(reason, f"{what}: {error.strerror}") from error


def _open(path: str) -> int:
    if not path:
        raise CannotSpeak("audio_device", "the player file: needs a path, as in file:speech.wav")
    file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NONBLOCK, 0o666)
    if not stat.S_ISREG(os.fstat(file).st_mode):
        os.close(file)
        raise CannotSpeak("audio_device", f"{path} is no regular file")
    return file


def _fields(rate: int, rest: int, length: int) -> tuple[bytes | int, ...]:
    """Return what is in a header; `rest`: the bytes behind where that is told, `length`: those of the samples."""
    return (
        b"RIFF",
        rest,
        b"WAVE",
        b"fmt ",
        16,
        1,
        1,
        rate,
        rate * SAMPLE_BYTES,
        SAMPLE_BYTES,
        8 * SAMPLE_BYTES,
        b"data",
        length,
    )


def _data_length(file: int, path: str, rate: int) -> int:
    """Return the length of the samples in the file, 0 for an empty one; CannotSpeak if the file is not ours."""
    size = os.fstat(file).st_size
    if size == 0:
        return 0
    header = os.pread(file, _HEADER.size, 0)
    found = _HEADER.unpack(header.ljust(_HEADER.size, b"\0"))
    found_rate, length = int(found[7]), int(found[12])
    if found != _fields(found_rate, _REST + length, length):
        wrong = "is no WAV file of talk's (16 bit, one channel)"
    elif found_rate != rate:
        wrong = f"has {found_rate} samples a second, this voice {rate}"
    elif size < _HEADER.size + length:
        wrong = "is shorter than its header says"
    else:
        return length
    raise CannotSpeak("audio_device", f"{path} {wrong}: use another file")
