"""Writes WAV files of many formats, for tests of sounds."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from pathlib import Path

PCM, FLOAT, EXTENSIBLE = 1, 3, 0xFFFE
_GUID_END = bytes.fromhex("000000001000800000aa00389b71")
Floats = npt.NDArray[np.float64]


def tone(seconds: float, rate: int) -> Floats:
    """Return the samples of a cosine of 1,000 Hz, which begins and ends loud."""
    return np.cos(2 * np.pi * 1_000 * np.arange(int(seconds * rate)) / rate) / 2


def pitch(samples: npt.NDArray[np.int16], rate: int) -> float:
    """Return the strongest frequency in hertz."""
    padded = np.zeros(max(rate, len(samples)))
    padded[: len(samples)] = samples * np.hanning(len(samples))
    return float(np.argmax(np.abs(np.fft.rfft(padded)))) * rate / len(padded)


def wav(
    samples: Floats,
    rate: int,
    *,
    bits: int = 16,
    channels: int = 1,
    number: int = PCM,
    extensible: bool = False,
    length: int | None = None,
) -> bytes:
    """Return a WAV file with samples from -1 to 1. With two channels, the second one is silent.

    `number` is the number of the format, and `length` is the length of the samples in the header.
    """
    size = (bits + 7) // 8
    if number == FLOAT:
        encoded = samples.astype(f"<f{size}").view(np.uint8).reshape(-1, size)
    else:
        whole = (samples * (2 ** (bits - 1) - 1)).astype(np.int64) + (128 if size == 1 else 0)
        encoded = (whole << (size * 8 - bits)).astype("<i8").view(np.uint8).reshape(-1, 8)[:, :size]
    frames = np.zeros((len(samples), channels, size), np.uint8)
    if size == 1:
        frames[:] = 128
    frames[:, 0] = encoded
    data = frames.tobytes()
    form = struct.pack("<HHIIHH", number, channels, rate, rate * channels * size, channels * size, bits)
    if extensible:
        form = struct.pack("<H", EXTENSIBLE) + form[2:] + struct.pack("<HHIH", 22, bits, 0, number) + _GUID_END
    listed = b"LIST" + struct.pack("<I", 3) + b"abc\0"  # a chunk of an odd length, which other programs may write
    header = struct.pack("<4sI", b"data", len(data) if length is None else length)
    body = b"WAVEfmt " + struct.pack("<I", len(form)) + form + listed + header + data
    return b"RIFF" + struct.pack("<I", len(body)) + body


def write_tone(path: Path, seconds: float, rate: int, **form: int) -> None:
    """Write a WAV file with a tone of 1,000 Hz. `form` contains arguments of `wav`."""
    path.write_bytes(wav(tone(seconds, rate), rate, **form))  # type: ignore[arg-type]
