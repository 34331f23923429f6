"""Renders sentences with libespeak-ng itself and nothing of talk's: a program that `reference` runs in a fresh process.

Reads a JSON list of `{"text", "rate", "volume", "voice", "pitch"}` on standard input; writes for each a line of JSON,
`{"samples": NUMBER, "words": [[START, END, SECONDS], …]}`, then the samples, 16 bit little endian.

The calls and their order are those of the program `espeak-ng -w`, so that the first sentence is the same bit for bit.
It must stay free of anything but the standard library: what it renders would not change, but its start would be slow.
"""

from __future__ import annotations

import ctypes
import json
import sys

RATE = 22050
_SYNCHRONOUS = 2
_DONT_EXIT = 0x8000
_CHARS_UTF8 = 1
_ENDPAUSE = 0x1000
_EVENT_WORD = 1
_PARAMETER_RATE, _PARAMETER_VOLUME, _PARAMETER_PITCH = 1, 2, 3


class _Event(ctypes.Structure):
    _fields_ = (
        ("type", ctypes.c_int),
        ("unique_identifier", ctypes.c_uint),
        ("text_position", ctypes.c_int),  # of the first character, from 1
        ("length", ctypes.c_int),  # characters
        ("audio_position", ctypes.c_int),  # milliseconds
        ("sample", ctypes.c_int),
        ("user_data", ctypes.c_void_p),
        ("id", ctypes.c_char * 8),
    )


_Callback = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.POINTER(ctypes.c_short), ctypes.c_int, ctypes.POINTER(_Event))


def load() -> tuple[ctypes.CDLL, bytes | None]:
    """Return the library and where its data is: the system's, else the wheel's."""
    try:
        return ctypes.CDLL("libespeak-ng.so.1"), None
    except OSError:
        import espeakng_loader

        return ctypes.CDLL(espeakng_loader.get_library_path()), espeakng_loader.get_data_path().encode()


def main() -> None:
    """Render what standard input asks for."""
    library, data = load()
    if library.espeak_Initialize(_SYNCHRONOUS, 0, data, _DONT_EXIT) <= 0:
        sys.exit("libespeak-ng cannot be initialised: its data is missing")
    samples = bytearray()
    words: list[tuple[int, int, float]] = []

    def take(wav: ctypes._Pointer[ctypes.c_short], count: int, events: ctypes._Pointer[_Event]) -> int:
        if wav and count > 0:
            samples.extend(ctypes.string_at(wav, count * 2))
        for event in iter(events):
            if event.type == 0:
                break
            if event.type == _EVENT_WORD:
                start = event.text_position - 1
                words.append((start, start + event.length, event.audio_position / 1000))
        return 0

    callback = _Callback(take)  # kept for as long as the library may call it
    library.espeak_SetSynthCallback(callback)
    for sentence in json.load(sys.stdin.buffer):
        if library.espeak_SetVoiceByName(sentence["voice"].encode()) != 0:
            sys.exit(f"libespeak-ng has no voice {sentence['voice']!r}")
        library.espeak_SetParameter(_PARAMETER_RATE, sentence["rate"], 0)
        library.espeak_SetParameter(_PARAMETER_VOLUME, round(sentence["volume"] * 100), 0)
        library.espeak_SetParameter(_PARAMETER_PITCH, sentence["pitch"], 0)
        text = sentence["text"].encode()
        size = ctypes.c_size_t(len(text) + 1)
        if library.espeak_Synth(text, size, 0, 0, 0, _CHARS_UTF8 | _ENDPAUSE, None, None) != 0:
            sys.exit(f"libespeak-ng cannot render {sentence['text']!r}")
        head = json.dumps({"samples": len(samples) // 2, "words": words})
        sys.stdout.buffer.write(head.encode() + b"\n" + samples)
        samples.clear()
        words.clear()


if __name__ == "__main__":
    main()
