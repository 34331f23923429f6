"""The sounds of a server: the built-in ones, and the WAV files in its directory.

The server uses this module to check a sound when its goal arrives. The engine process uses it again to play the sound.
Anybody may have put a file into the directory. Therefore, this module only opens regular files, reads no more than
their headers, and never waits for another program.
"""

from __future__ import annotations

import os
import shlex
import stat
import struct

from talkcli.engine.players import RATES_HZ
from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.goals.reasons import Reason

if TYPE_CHECKING:
    from typing import NoReturn

    from talkcli.goals.reasons import Refusal

#: Maximum size of a sound as 16-bit mono. At 44.1 kHz, this is enough for 12 minutes.
MAX_DECODED_BYTES = 64_000_000
#: Maximum number of chunks in a file before its samples. Usual files have fewer than ten.
_MAX_CHUNKS = 64
#: Maximum length of a name in an error message, and maximum number of names in the message.
_SHOWN_NAME_CHARS, _SHOWN_NAMES = 60, 10

#: The built-in sounds as tones. A tone has a frequency in Hz at its start and at its end, and a length in seconds.
#: Frequency 0 is silence.
BUILT_IN: dict[str, tuple[tuple[float, float, float], ...]] = {
    "chirp": ((1_000, 2_000, 0.14),),
    "warning": ((880, 880, 0.16), (0, 0, 0.07), (880, 880, 0.16)),
    "error": ((523, 523, 0.17), (349, 349, 0.32)),
}

_PCM, _FLOAT, _EXTENSIBLE = 1, 3, 0xFFFE
#: The end of the GUID that follows the format's number in an extensible header.
_GUID_END = bytes.fromhex("000000001000800000aa00389b71")
#: The length field of a WAV stream whose length was unknown when its header was written.
_UNKNOWN_BYTES = 0xFFFFFFFF
#: Names of WAV formats, by format number.
_WAV_FORMATS = {_PCM: "integer", 2: "ADPCM", _FLOAT: "floating-point", 6: "A-law", 7: "µ-law", 17: "ADPCM", 85: "MP3"}
#: The first bytes of other kinds of files. A length of 4 bytes may come before these bytes.
_OTHER_FILES = {
    "MP3": (b"ID3", b"\xff\xfb", b"\xff\xf3", b"\xff\xf2"),
    "AAC": (b"\xff\xf1", b"\xff\xf9"),
    "MP4": (b"ftyp",),
    "Ogg": (b"OggS",),
    "FLAC": (b"fLaC",),
    "AIFF": (b"FORM",),
    "WebM or Matroska": (b"\x1aE\xdf\xa3",),
}


class SoundError(Exception):
    """Raised with a reason and a message if a sound doesn't exist or can't be played.

    The message says what to do.
    """


@frozen
class SoundFile:
    """An open WAV file, and the format of its samples."""

    descriptor: int
    path: str
    rate: int  # samples per second
    channels: int  # 1 or 2
    sample_bytes: int  # size of a sample of one channel, 1 to 4
    is_float: bool
    begin: int  # offset of the first sample in the file
    frames: int  # number of samples of each channel


class SoundLibrary:
    """The sounds that a server can play, by name."""

    def __init__(self, directory: str | None) -> None:
        """Create a library of the built-in sounds and, optionally, the files in a directory."""
        self._directory = directory or ""

    def names(self) -> list[str]:
        """Return the sorted names of all sounds. Read the directory each time."""
        files = self._files().items()
        return sorted(BUILT_IN.keys() | {name for name, file in files if _is_wav(file) and name.isprintable()})

    def refusal(self, name: str) -> Refusal | None:
        """Return the reason why a sound can't be played, or None if it can be played."""
        try:
            file = self.open(name)
        except SoundError as error:
            return error.args
        if file:
            os.close(file.descriptor)
        return None

    def open(self, name: str) -> SoundFile | None:
        """Open the file of a sound. Return None if the sound is built in.

        Raises:
            SoundError: the sound is unknown, or its file can't be played.
        """
        file_name = self._files().get(name)
        if name in BUILT_IN and not (file_name and _is_wav(file_name)):
            return None
        if file_name is None:
            raise SoundError(Reason.UNKNOWN_SOUND, self._unknown_message(name))
        return self._open_file(file_name)

    def _files(self) -> dict[str, str]:
        """Return the directory's files by sound name. The result is empty if the directory can't be read.

        NAME.wav is preferred. Other files are listed, too, so that an error message can say what they are.
        """
        try:
            found = os.listdir(self._directory) if self._directory else []
        except OSError:
            found = []
        return {os.path.splitext(each)[0]: each for each in sorted(found, key=lambda each: (_is_wav(each), each))}

    def _open_file(self, file_name: str) -> SoundFile:
        """Open a file in the directory. Raise SoundError if it can't be played."""
        directory, path = self._directory, os.path.join(self._directory, file_name)
        try:
            target = os.path.realpath(path)
            if not target.startswith(os.path.join(os.path.realpath(directory), "")):
                _refuse(path, f"is a link to a file outside of {directory}; copy the file into the directory")
            mode = os.lstat(target).st_mode
            # Opening a pipe would wait for its writer, and opening a device may have side effects.
            if not stat.S_ISREG(mode):
                _refuse(path, f"is {'a directory' if stat.S_ISDIR(mode) else 'not a regular file'}; use a WAV file")
            descriptor = os.open(target, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                return _read_header(descriptor, path)
            except BaseException:
                os.close(descriptor)
                raise
        except OSError as error:
            raise SoundError(Reason.BAD_SOUND, f"{path} can't be read: {error.strerror}") from error

    def _unknown_message(self, name: str) -> str:
        """Return the error message for an unknown sound. For a path, the message says how to play the file."""
        shown, names = repr(name[:_SHOWN_NAME_CHARS]), self.names()
        base = os.path.splitext(os.path.basename(name))[0]
        if base and base != name:
            where = self._directory or "a directory DIR, start the server with: talk serve --sounds DIR"
            command = f"talk play {shlex.quote(base[:_SHOWN_NAME_CHARS])}"
            return f"{shown} is not the name of a sound; put the file into {where}, and run: {command}"
        more = f" and {len(names) - _SHOWN_NAMES} more" if len(names) > _SHOWN_NAMES else ""
        return f"unknown sound {shown}; the sounds are {', '.join(names[:_SHOWN_NAMES])}{more}"


def _is_wav(file_name: str) -> bool:
    """Return whether a file has the extension of a WAV file."""
    return file_name.lower().endswith(".wav")


def _refuse(path: str, words: str) -> NoReturn:
    """Raise SoundError for a file that can't be played."""
    raise SoundError(Reason.BAD_SOUND, f"{path} {words}")


def _refuse_format(path: str, words: str) -> NoReturn:
    """Raise SoundError for a file in another format. The message names a command that converts the file."""
    source, target = shlex.quote(path), shlex.quote(f"{os.path.splitext(path)[0]}.wav")
    command = f"ffmpeg -i {source} -ac 1 -ar 44100 "
    command += f"new.wav && mv new.wav {target}" if source == target else target
    _refuse(path, f"{words}; convert it with: {command}")


def _read_header(descriptor: int, path: str) -> SoundFile:
    """Return the SoundFile that a WAV header describes. Raise SoundError if it can't be played."""
    size, head = os.fstat(descriptor).st_size, os.pread(descriptor, 12, 0)
    if not size:
        _refuse(path, "is empty; copy it again")
    if head[:4] != b"RIFF" or head[8:] != b"WAVE":
        kinds = [kind for kind, start in _OTHER_FILES.items() if head.startswith(start) or head[4:].startswith(start)]
        _refuse_format(path, f"is not a WAV file{f', but {kinds[0]}' if kinds else ''}")
    position, form = len(head), None
    for _ in range(_MAX_CHUNKS):
        name, length = struct.unpack("<4sI", os.pread(descriptor, 8, position).ljust(8, b"\0"))
        position += 8
        if name == b"fmt ":
            form = _read_format(os.pread(descriptor, min(length, 40), position).ljust(40, b"\0"), path)
        elif name == b"data" and form:
            rate, channels, sample_bytes, is_float = form
            length = size - position if length == _UNKNOWN_BYTES else length
            if position + length > size:
                words = f"has {size - position:,} bytes of sound, but its header says {length:,}"
                _refuse(path, f"is incomplete: it {words}; copy it again")
            frames = length // (channels * sample_bytes)
            if not frames:
                _refuse(path, "contains no sound; use another file")
            if frames * 2 > MAX_DECODED_BYTES:
                longest = f"{MAX_DECODED_BYTES // 2 // rate:,} s at {rate:,} samples per second"
                _refuse(path, f"is too long: {frames // rate:,} s (at most {longest}); shorten it")
            return SoundFile(descriptor, path, rate, channels, sample_bytes, is_float, position, frames)
        position += length + length % 2
    _refuse(path, "is incomplete: it has the header of a WAV file, but no samples; copy it again")


def _read_format(chunk: bytes, path: str) -> tuple[int, int, int, bool]:
    """Read the format chunk of a WAV file. Raise SoundError if the format can't be played.

    Returns:
        The rate, the number of channels, the size of a sample in bytes, and whether the samples are floating-point
        numbers.
    """
    number, channels, rate, _, frame_bytes, bits = struct.unpack("<HHIIHH", chunk[:16])
    if number == _EXTENSIBLE and chunk[26:] == _GUID_END:
        number = int.from_bytes(chunk[24:26], "little")
    if number not in (_PCM, _FLOAT) or not (8 <= bits <= 32 if number == _PCM else bits == 32):
        name = _WAV_FORMATS.get(number, f"unknown ({number})")
        _refuse_format(path, f"is a WAV file with {bits}-bit {name} samples")
    if channels not in (1, 2):
        _refuse_format(path, f"has {channels} channels instead of 1 or 2")
    if rate not in RATES_HZ:
        _refuse_format(path, f"has {rate:,} samples per second instead of {RATES_HZ[0]:,} to {RATES_HZ[-1]:,}")
    sample_bytes = (bits + 7) // 8
    if frame_bytes != channels * sample_bytes:
        _refuse_format(path, f"has {frame_bytes} bytes for {channels} samples of {bits} bits")
    return rate, channels, sample_bytes, number == _FLOAT
