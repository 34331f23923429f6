"""A program that renders sentences with libespeak-ng, without talk. `reference` runs it in a new process.

It reads a JSON list of `{"text", "rate", "volume", "voice", "pitch"}` from standard input. For each sentence, it
writes a line of JSON, `{"samples": NUMBER, "words": [[START, END, SECONDS], …]}`, and then the samples (s16le).

It calls the library in the same order as `espeak-ng -w`, so the first sentence has exactly the same samples. It only
uses the standard library, so it starts fast.
"""

from __future__ import annotations

import ctypes
import json
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable

    #: Start and end of a word in the text, and the time of its sound in seconds.
    Word = tuple[int, int, float]

RATE = 22050
_SYNCHRONOUS = 2
_DONT_EXIT = 0x8000
_UTF8_AND_END_PAUSE = 0x1001
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
    """Return the library and the path of its data (None for the system's), from the system or else from the wheel."""
    try:
        return ctypes.CDLL("libespeak-ng.so.1"), None
    except OSError:
        import espeakng_loader

        return ctypes.CDLL(espeakng_loader.get_library_path()), espeakng_loader.get_data_path().encode()


class Library:
    """The library. It calls `take` with each block of sound and its words, and stops if `take` returns True."""

    def __init__(self, take: Callable[[bytes, list[Word]], bool]) -> None:
        self._library, data = load()
        if self._library.espeak_Initialize(_SYNCHRONOUS, 0, data, _DONT_EXIT) <= 0:
            sys.exit("libespeak-ng can't be initialised: its data is missing")

        def receive(wav: ctypes._Pointer[ctypes.c_short], count: int, events: ctypes._Pointer[_Event]) -> int:
            words: list[Word] = []
            for event in iter(events):
                if event.type == 0:
                    break
                if event.type == _EVENT_WORD:
                    start = event.text_position - 1
                    words.append((start, start + event.length, event.audio_position / 1000))
            return int(take(ctypes.string_at(wav, count * 2) if wav and count > 0 else b"", words))

        self._callback = _Callback(receive)  # must live as long as the library may call it
        self._library.espeak_SetSynthCallback(self._callback)

    def speak(self, text: str, *, rate: int, volume: float = 1.0, voice: str = "en", pitch: int = 50) -> None:
        if self._library.espeak_SetVoiceByName(voice.encode()) != 0:
            sys.exit(f"libespeak-ng has no voice {voice!r}")
        self._library.espeak_SetParameter(_PARAMETER_RATE, rate, 0)
        self._library.espeak_SetParameter(_PARAMETER_VOLUME, round(volume * 100), 0)
        self._library.espeak_SetParameter(_PARAMETER_PITCH, pitch, 0)
        data = text.encode()
        size = ctypes.c_size_t(len(data) + 1)
        if self._library.espeak_Synth(data, size, 0, 0, 0, _UTF8_AND_END_PAUSE, None, None) != 0:
            sys.exit(f"libespeak-ng can't render {text!r}")


def main() -> None:
    samples = bytearray()
    words: list[Word] = []

    def take(sound: bytes, new_words: list[Word]) -> bool:
        samples.extend(sound)
        words.extend(new_words)
        return False

    library = Library(take)
    for sentence in json.load(sys.stdin.buffer):
        library.speak(**sentence)
        head = json.dumps({"samples": len(samples) // 2, "words": words})
        sys.stdout.buffer.write(head.encode() + b"\n" + samples)
        samples.clear()
        words.clear()


if __name__ == "__main__":
    main()
