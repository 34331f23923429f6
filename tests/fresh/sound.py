"""A loudspeaker for machines that have none, and checks of the sound that it has played.

ALSA's file plugin, which every machine with `aplay` has, writes the sound to a FIFO. `listen` reads it at the speed of
a sound card, so a player ends when its sound is over. Nothing is written between sounds, so sentences are recorded
without a pause between them.

    python3 tests/fresh/sound.py listen FIFO FILE     # until SIGTERM, then print the times of the first and last sound
    python3 tests/fresh/sound.py compare FILE WAV     # FILE must begin with exactly the samples of WAV
    python3 tests/fresh/sound.py length FILE WAV      # FILE must be about as long as WAV (for neural voices)
"""

from __future__ import annotations

import array
import fcntl
import os
import signal
import sys
import time
import wave

#: Samples per second, 16 bit, one channel, as libespeak-ng renders them.
RATE = 22050
#: Size of the FIFO, the smallest that Linux allows: 93 ms of sound, so a player ends 93 ms too early.
FIFO_BYTES = 4096
#: Time between two reads. A late read catches up, but at most by the length of a sound card's buffer.
INTERVAL_S, BUFFER_S = 0.01, 0.1
#: Samples above this level are sound.
LOUD = 50
#: Relative difference in length allowed between two renderings by a neural voice. Up to 0.07 was measured.
LENGTH_TOLERANCE = 0.15


def listen(fifo: str, path: str) -> str:
    """Copy samples from the FIFO to the file until SIGTERM. Return the Unix times of the first and the last sound."""
    ended: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _frame: ended.append(number))
    # Also open for writing, so that there is no end of file when a player ends.
    source = os.open(fifo, os.O_RDWR | os.O_NONBLOCK)
    fcntl.fcntl(source, fcntl.F_SETPIPE_SZ, FIFO_BYTES)
    first = last = 0.0
    due = time.monotonic()
    with open(path, "wb", buffering=0) as file:
        while not ended:
            time.sleep(INTERVAL_S)
            due = max(due, time.monotonic() - BUFFER_S)
            taken = _read(source, int((time.monotonic() - due) * RATE) * 2)
            file.write(taken)
            due += len(taken) / 2 / RATE
            if any(abs(sample) > LOUD for sample in array.array("h", taken)):
                last = time.time()
                first = first or last
        file.write(_read(source, FIFO_BYTES))  # the end of the last player's sound
    return f"{first:.2f} {last:.2f}"


def _read(source: int, most: int) -> bytes:
    try:
        return os.read(source, most)
    except BlockingIOError:
        return b""


def compare(path: str, reference: str) -> str:
    """Check that the file begins with exactly the reference's samples, or exit. Return a readable result."""
    heard, wanted = _samples(path, reference)
    seconds = len(wanted) / RATE
    for place, sample in enumerate(wanted):
        if place == len(heard) or heard[place] != sample:
            sys.exit(f"FAILED: only the first {place / RATE:.2f} of {seconds:.2f} s of sound were correct")
    return f"{seconds:.2f} s of sound, all {len(wanted)} samples correct"


def compare_length(path: str, reference: str) -> str:
    """Check that both sounds have about the same length, or exit. Return a readable result."""
    heard, wanted = (_seconds_of_sound(samples) for samples in _samples(path, reference))
    if abs(heard - wanted) > LENGTH_TOLERANCE * wanted:
        sys.exit(f"FAILED: {heard:.2f} s of sound were heard; the sentence has {wanted:.2f} s")
    return f"{heard:.2f} s of sound, {wanted:.2f} s in another rendering; the samples were not compared"


def _samples(path: str, reference: str) -> tuple[array.array[int], array.array[int]]:
    """Return the samples of both files from their first sound on, or exit if one is silent."""
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
