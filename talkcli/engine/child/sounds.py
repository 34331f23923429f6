"""Code that plays sounds. Their samples are written to a `Playback`, like those of a synthesizer.

All work is done in small pieces, so that a sound can be stopped and paused, and a long file needs little memory.
"""

from __future__ import annotations

import math
import os
from array import array
from itertools import chain

from talkcli.engine.child.players.base import CannotSpeak
from talkcli.engine.players import DEFAULT_RATE_HZ, SAMPLE_BYTES
from talkcli.engine.sounds import BUILT_IN, SoundError
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.reasons import Reason

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from talkcli.engine.child.playback import Playback
    from talkcli.engine.protocol import Speak
    from talkcli.engine.sounds import SoundFile, SoundLibrary

#: Seconds of sound in a piece.
_PIECE_S = 0.05
#: Silence after a sound, as after a sentence. It is longer than `EARLY_END_LIMIT_S`, so a player that ends too early
#: can't cut off anything audible.
_PAUSE_S = 0.26
#: Level of the built-in sounds, which are about as loud as speech.
_TONE_LEVEL = 11_000
#: Volume of the octave that is mixed into a tone, to make the tone audible on small loudspeakers.
_OCTAVE_LEVEL = 0.3
#: How long a tone takes to become loud. Without this, a click would be heard.
_ATTACK_S = 0.008


def play_sound(library: SoundLibrary, command: Speak, playback: Playback, required_rate: int | None) -> float:
    """Play a sound, except for its end, which `Playback.finish` plays. Return the sound's length in seconds.

    Args:
        library: the sounds.
        command: the command with the name and the volume of the sound.
        playback: plays the samples.
        required_rate: the sample rate that the player needs, or None if the player can play any rate.

    Raises:
        CannotSpeak: the sound is unknown, or its file can't be read. The playback's exceptions pass through.
    """
    try:
        file = library.open(command.text)
    except SoundError as error:
        raise CannotSpeak(*error.args) from error
    try:
        rate, pieces = (file.rate, _read_samples(file)) if file else (DEFAULT_RATE_HZ, _make_tones(command.text))
        # At a rate below that of speech, a program's pipe would hold too much sound, and pauses would be inexact.
        player_rate = required_rate or rate * math.ceil(DEFAULT_RATE_HZ / rate)
        playback.begin_sound(player_rate)
        skipped, count = command.start, 0  # samples that were heard before an interruption are skipped
        for piece in pieces if player_rate == rate else resample(pieces, rate, player_rate):
            rest = piece[skipped:]
            skipped -= len(piece) - len(rest)
            count += len(rest)
            samples = rest if command.volume == 1 else array("h", [int(each * command.volume) for each in rest])
            playback.write(samples.tobytes())
        playback.write(bytes(int(_PAUSE_S * player_rate) * SAMPLE_BYTES))
    finally:
        if file:
            os.close(file.descriptor)
    return count / player_rate


def _read_samples(file: SoundFile) -> Iterator[array[int]]:
    """Yield the samples of a file as 16-bit mono.

    Raises:
        CannotSpeak: the file can't be read, or has become shorter.
    """
    frame_bytes = file.channels * file.sample_bytes
    position, end = file.begin, file.begin + file.frames * frame_bytes
    piece_bytes = int(_PIECE_S * file.rate) * frame_bytes
    while position < end:
        try:
            data = os.pread(file.descriptor, min(piece_bytes, end - position), position)
        except OSError as error:
            raise CannotSpeak(Reason.BAD_SOUND, f"{file.path} can't be read: {error.strerror}") from error
        if not data or len(data) % frame_bytes:
            raise CannotSpeak(Reason.BAD_SOUND, f"{file.path} became shorter while it was played")
        position += len(data)
        samples = _decode(data, file)
        if file.channels == 2:
            samples = array("h", [(left + right) >> 1 for left, right in zip(samples[::2], samples[1::2], strict=True)])
        yield samples


def _decode(data: bytes, file: SoundFile) -> array[int]:
    """Convert samples from a file to 16 bits. NaN becomes 0."""
    if file.is_float:
        limited = (max(-1.0, min(1.0, each)) if each == each else 0.0 for each in array("f", data))
        return array("h", [int(each * 32767) for each in limited])
    width = file.sample_bytes
    high_bytes = data[width - 1 :: width]
    if width == 1:
        high_bytes = bytes(each ^ 0x80 for each in high_bytes)  # Only 8-bit samples are unsigned.
    words = bytearray(len(high_bytes) * 2)
    words[1::2] = high_bytes
    if width > 1:
        words[::2] = data[width - 2 :: width]
    return array("h", bytes(words))


def resample(pieces: Iterable[array[int]], rate: int, new_rate: int) -> Iterator[array[int]]:
    """Convert samples to another sample rate, and yield them in pieces.

    If the new rate is much lower, the averages of several samples are used. They don't contain frequencies that the new
    rate can't represent. The remaining difference is made up by linear interpolation.
    """
    averaged = max(1, rate // new_rate)
    step = rate / averaged / new_rate
    #: samples that are not averaged yet, unused averages, and the position among them of the next sample to yield
    rest, kept, position = array("h"), array("h"), 0.0
    for piece in chain(pieces, [array("h", [0] * averaged)]):  # the last sample is followed by silence
        rest += piece
        end = len(rest) // averaged * averaged
        columns = [rest[each:end:averaged] for each in range(averaged)]
        kept.extend([sum(each) // averaged for each in zip(*columns, strict=True)])
        del rest[:end]
        # Rounding errors must not produce a position after the last pair of averages.
        count = max(0, math.ceil((len(kept) - 1 - position) / step - 1e-6))
        places = [position + number * step for number in range(count)]
        pairs = [(kept[int(each)], kept[int(each) + 1], each % 1) for each in places]
        yield array("h", [round(before + (after - before) * part) for before, after, part in pairs])
        position += count * step
        del kept[: int(position)]
        position -= int(position)


def _make_tones(name: str) -> Iterator[array[int]]:
    """Yield the samples of a built-in sound, one tone at a time.

    A tone begins softly and fades away.
    """
    for begin, end, seconds in BUILT_IN[name]:
        count, phase, tone = int(seconds * DEFAULT_RATE_HZ), 0.0, array("h")
        for number in range(count):
            done = number / count
            phase += 2 * math.pi * (begin + (end - begin) * done) / DEFAULT_RATE_HZ
            level = _TONE_LEVEL * min(1.0, number / DEFAULT_RATE_HZ / _ATTACK_S) * (1 - done) ** 0.7
            tone.append(int(level * (math.sin(phase) + _OCTAVE_LEVEL * math.sin(2 * phase))))
        yield tone
