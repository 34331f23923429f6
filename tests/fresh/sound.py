"""A loudspeaker for a machine that has none, and a check of the sound that it played.

ALSA's file plugin, which every machine with `aplay` has, writes what it plays into a FIFO; `listen` takes it from there
as fast as a sound card would, and no faster: so a player ends when its sound is over, as in real life. It hears what is
played and nothing between, so two sentences follow each other without a pause.

    python3 tests/fresh/sound.py listen FIFO FILE     # until SIGTERM; then the times of the first and last sound
    python3 tests/fresh/sound.py compare FILE WAV     # FILE must begin with all samples of WAV, one by one
    python3 tests/fresh/sound.py length FILE WAV      # FILE must be as long as WAV: a neural voice is never the same
"""

from __future__ import annotations

import array
import fcntl
import os
import signal
import sys
import time
import wave

#: Samples a second, 16 bit, one channel: libespeak-ng's own.
RATE = 22050
#: Bytes that the FIFO holds, the least that Linux has: 93 ms, which is what a player ends too early here.
HELD = 4096
#: Seconds between two looks; what a look was late for is made up for, up to as much as a sound card's buffer.
EVERY, BUFFER = 0.01, 0.1
#: Above this a sample is sound.
LOUD = 50
#: Part by which two renderings by a neural voice may differ in length. Those of one sentence differed by up to 0.07.
LENGTH_TOLERANCE = 0.15


def listen(fifo: str, path: str) -> str:
    """Take samples from the FIFO into the file until SIGTERM; return when the first and the last was heard (epoch)."""
    ended: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _frame: ended.append(number))
    # For reading and writing: players come and go, and none of them makes an end of file.
    source = os.open(fifo, os.O_RDWR | os.O_NONBLOCK)
    fcntl.fcntl(source, fcntl.F_SETPIPE_SZ, HELD)
    first = last = 0.0
    due = time.monotonic()
    with open(path, "wb", buffering=0) as file:
        while not ended:
            time.sleep(EVERY)
            due = max(due, time.monotonic() - BUFFER)
            taken = _read(source, int((time.monotonic() - due) * RATE) * 2)
            file.write(taken)
            due += len(taken) / 2 / RATE
            if any(abs(sample) > LOUD for sample in array.array("h", taken)):
                last = time.time()
                first = first or last
        file.write(_read(source, HELD))  # what the player left in the FIFO when it ended
    return f"{first:.2f} {last:.2f}"


def _read(source: int, most: int) -> bytes:
    try:
        return os.read(source, most)
    except BlockingIOError:
        return b""


def compare(path: str, reference: str) -> str:
    """Return what was heard, in words; SystemExit if the file doesn't begin with all the reference's samples."""
    heard, wanted = _samples(path, reference)
    seconds = len(wanted) / RATE
    for place, sample in enumerate(wanted):
        if place == len(heard) or heard[place] != sample:
            sys.exit(f"FAILED: of {seconds:.2f} s of sound the first {place / RATE:.2f} s were heard as they should be")
    return f"{seconds:.2f} s of sound, each of {len(wanted)} samples as it should be"


def compare_length(path: str, reference: str) -> str:
    """Return how long the sound in both files is. SystemExit if the lengths differ by more than the tolerance."""
    heard, wanted = (_seconds_of_sound(each) for each in _samples(path, reference))
    if abs(heard - wanted) > LENGTH_TOLERANCE * wanted:
        sys.exit(f"FAILED: {heard:.2f} s of sound were heard; the sentence has {wanted:.2f} s")
    return f"{heard:.2f} s of sound, {wanted:.2f} s in another rendering; the samples were not compared"


def _samples(path: str, reference: str) -> tuple[array.array[int], array.array[int]]:
    """Return what was heard and what the WAV file has, each from its first sound on. SystemExit if one is silent."""
    heard = array.array("h")
    with open(path, "rb") as file:
        heard.frombytes(file.read())
    wanted = array.array("h")
    with wave.open(reference) as wav:
        wanted.frombytes(wav.readframes(wav.getnframes()))
    heard, wanted = _from_first_sound(heard), _from_first_sound(wanted)
    if not heard:
        sys.exit("FAILED: nothing was heard")
    if not wanted:
        sys.exit(f"FAILED: {reference} is silent")
    return heard, wanted


def _seconds_of_sound(samples: array.array[int]) -> float:
    loud = [place for place, sample in enumerate(samples) if abs(sample) > LOUD]
    return (loud[-1] - loud[0]) / RATE if loud else 0.0


def _from_first_sound(samples: array.array[int]) -> array.array[int]:
    return samples[next((place for place, sample in enumerate(samples) if sample), len(samples)) :]


COMMANDS = {"listen": listen, "compare": compare, "length": compare_length}

if __name__ == "__main__":
    if len(sys.argv) != 4 or sys.argv[1] not in COMMANDS:
        sys.exit(__doc__)
    print(COMMANDS[sys.argv[1]](*sys.argv[2:]))
