"""A Piper voice of a few hundred bytes: a VITS model in ONNX that hums instead of speaking, and its JSON config.

It has the names and shapes that talk needs, and is loaded in a few milliseconds. Tests can also make broken and hostile
models. This module encodes them with the field numbers of `onnx.proto`, so it doesn't need the `onnx` package.
"""

from __future__ import annotations

import json
import struct
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

FLOAT, INT64 = 1, 7
#: The voice's phonemes. The index of each is its id. All Piper voices have the first three.
SOUNDS = "_^$ !'(),-.:;?abcdefhijklmnopqrstuvwxyzæçðøħŋœɐɑɒɔəɚɛɜɡɪɹɾʃʊʌʒʔˈˌːθβχ\u0303\u0329ᵻ"
#: Frames of each phoneme, and of the blank between phonemes, at the voice's normal rate.
SOUND_FRAMES, BLANK_FRAMES = 6.5, 0.5


def varint(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def field(number: int, value: bytes | str | int) -> bytes:
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    value = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | 2) + varint(len(value)) + value


def node(operator: str, inputs: Sequence[str], output: str, *attributes: bytes, domain: str = "") -> bytes:
    parts = [*(field(1, name) for name in inputs), field(2, output), field(4, operator)]
    parts += [field(5, attribute) for attribute in attributes]
    return field(1, b"".join(parts) + (field(7, domain) if domain else b""))


def number(name: str, value: int) -> bytes:
    """Return an integer attribute."""
    return field(1, name) + field(3, value) + field(20, 2)


def numbers(name: str, *values: int) -> bytes:
    """Return an attribute with a list of integers."""
    return field(1, name) + b"".join(field(8, value) for value in values) + field(20, 7)


def tensor(name: str, values: Sequence[float], *shape: int, kind: int = FLOAT, more: bytes = b"") -> bytes:
    raw = struct.pack(f"<{len(values)}{'f' if kind == FLOAT else 'q'}", *values)
    return b"".join(field(1, size) for size in shape) + field(2, kind) + field(8, name) + field(9, raw) + more


def weight(name: str, values: Sequence[float], *shape: int, kind: int = FLOAT, more: bytes = b"") -> bytes:
    return field(5, tensor(name, values, *shape, kind=kind, more=more))


def value(name: str, kind: int, *shape: str | int) -> bytes:
    sizes = b"".join(field(1, field(2 if isinstance(size, str) else 1, size)) for size in shape)
    return field(1, name) + field(2, field(1, field(1, kind) + field(2, sizes)))


def model(
    *,
    hop: int = 256,
    period: int = 100,
    amplitude: float = 0.5,
    sound_frames: float = SOUND_FRAMES,
    speakers: int = 1,
    sounds: int = len(SOUNDS),
    nodes: bytes = b"",
    weights: bytes = b"",
    fields: bytes = b"",
    cut: str = "dec.conv_pre.weight",
) -> bytes:
    """Return a model that plays a square wave.

    A frame has `hop` samples, a period of the wave has `period` samples, and each of the `sounds` phonemes has
    `sound_frames` frames. Each further speaker is a little louder. `nodes`, `weights` and `fields` are added to the
    model, and `cut` is the name of the weight at which talk splits it.
    """
    frames = [BLANK_FRAMES, *([sound_frames] * (sounds - 1))]
    wave = [amplitude if place % period < period / 2 else -amplitude for place in range(hop)]
    several = speakers > 1
    graph = [
        # the encoder: the duration of each phoneme, and its frames
        node("Gather", ["frames_of", "input"], "lasting"),
        node("Gather", ["scales", "one"], "pace"),
        node("Mul", ["lasting", "pace"], "exactly"),
        node("Ceil", ["exactly"], "durations"),
        node("ReduceSum", ["durations"], "many", number("keepdims", 0)),
        node("Cast", ["many"], "count", number("to", INT64)),
        node("Range", ["zero", "count", "one_more"], "places"),
        node("Cast", ["places"], "floats", number("to", FLOAT)),
        node("Reshape", ["floats", "as_frames"], "moving"),
        node("Sin", ["moving"], "frames"),
        # the decoder, which also uses the frame before and the frame after
        node("Conv", ["frames", cut, "bias"], "pre", numbers("pads", 1, 1)),
    ]
    if several:
        graph += [
            node("Cast", ["sid"], "number", number("to", FLOAT)),
            node("Reshape", ["number", "as_one"], "speaker"),
            node("Mul", ["speaker", "louder"], "its"),
            node("Add", ["pre", "its"], "voiced"),
        ]
    graph += [
        node("Identity", ["wave"], "shared"),
        node("ConvTranspose", ["voiced" if several else "pre", "shared"], "output", numbers("strides", hop)),
    ]
    ends = [field(11, value("input", INT64, "batch", "sounds")), field(11, value("input_lengths", INT64, "batch"))]
    ends += [field(11, value("scales", FLOAT, 3)), *([field(11, value("sid", INT64, "batch"))] if several else [])]
    ends += [field(12, value("output", FLOAT, "batch", 1, "samples"))]
    kept = [
        weight("frames_of", frames, sounds),
        weight("one", [1], kind=INT64),
        weight("zero", [0], kind=INT64),
        weight("one_more", [1], kind=INT64),
        weight("as_frames", [1, 1, -1], 3, kind=INT64),
        weight("as_one", [-1, 1, 1], 3, kind=INT64),
        weight("louder", [0.1], 1),
        weight(cut, [0.03, 0.04, 0.03], 1, 1, 3),
        weight("bias", [1.0], 1),
        weight("wave", wave, 1, 1, hop),
    ]
    inner = b"".join([*graph, nodes, field(2, "tiny"), *kept, weights, *ends])
    return field(1, 8) + field(8, field(1, "") + field(2, 13)) + field(7, inner) + fields


def description(
    *, rate: int = 22050, voice: str = "en-us", speakers: int = 1, language: str = "en_US", **more: object
) -> dict[str, object]:
    """Return the JSON config of a model. Its noise is 0, so it renders a text the same each time."""
    return {
        "audio": {"sample_rate": rate, "quality": "low"},
        "espeak": {"voice": voice},
        "language": {"code": language, "name_english": "English"},
        "dataset": "tiny",
        "inference": {"noise_scale": 0, "length_scale": 1, "noise_w": 0},
        "num_symbols": len(SOUNDS),
        "num_speakers": speakers,
        "speaker_id_map": {f"p{speaker}": speaker for speaker in range(speakers)} if speakers > 1 else {},
        "phoneme_id_map": {sound: [index] for index, sound in enumerate(SOUNDS)},
        **more,
    }


def put(directory: Path, name: str, content: bytes | None = None, config: dict[str, object] | None = None) -> Path:
    """Put a voice into a directory, and return the path of its model. `content` is the model."""
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / f"{name}.onnx"
    path.write_bytes(model() if content is None else content)
    config_path = directory / f"{name}.onnx.json"
    config_path.write_text(json.dumps(description() if config is None else config))
    directory.chmod(0o755)  # other users must not be able to write, with any umask
    for file in (path, config_path):
        file.chmod(0o644)
    return path
