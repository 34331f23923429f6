"""Loads libespeak-ng and pyttsx3's binding of it: the system's library where there is one, else the wheel's.

Linux only; elsewhere pyttsx3's own drivers find their libraries themselves. It must run before anything imports
`pyttsx3.drivers._espeak`, which loads the library when it is imported.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os

from talkcli.engine.synthesizers.base import NotInstalled
from talkcli.frozen import frozen

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import Any

_LIBRARY = "libespeak-ng.so.1"

#: Milliseconds of sound that the library hands over at once. It rounds up to 49 at 22,050 Hz; more would only delay
#: the first sound.
_BUFFER_MS = 20

#: Without this option the library calls exit() where its data is missing.
_DONT_EXIT = 0x8000


@frozen
class Library:
    """libespeak-ng, loaded and initialised."""

    #: pyttsx3's ctypes binding, the module.
    espeak: Any
    #: for people: "eSpeak NG 1.51 (system)".
    version: str
    #: samples per second until a voice says otherwise.
    rate: int


def load() -> Library:
    """Load and initialise the library, once a process; NotInstalled, or OSError where it may be loaded later."""
    origin, data = _preload()
    from pyttsx3.drivers import _espeak

    with _no_sound_server():
        rate = _espeak.Initialize(_espeak.AUDIO_OUTPUT_SYNCHRONOUS, _BUFFER_MS, data, _DONT_EXIT)
    if rate <= 0:
        raise NotInstalled("there is no espeak-ng data: install espeak-ng-data, or pip install espeakng-loader")
    version = (_espeak.Info(None) or b"").decode("utf-8", "replace").split(" ")[0]
    return Library(_espeak, f"eSpeak NG {version} ({origin})", rate)


@contextlib.contextmanager
def _no_sound_server() -> Iterator[None]:
    """Let no PulseAudio be found meanwhile.

    The library connects to one whenever it is initialised, though it is never to play: 7 ms where one answers, and 30 s
    where one hangs, in which the engine would be given up.
    """
    before = os.environ.get("PULSE_SERVER")
    os.environ["PULSE_SERVER"] = "unix:/dev/null"
    try:
        yield
    finally:
        if before is None:
            del os.environ["PULSE_SERVER"]
        else:
            os.environ["PULSE_SERVER"] = before


def _preload() -> tuple[str, bytes | None]:
    """Have the library in the process, so that the binding finds it; return its origin and its data's directory."""
    try:
        ctypes.CDLL(_LIBRARY)
    except OSError as missing:
        if _passes(missing):
            raise
        return _preload_wheel(missing)
    return "system", None


def _preload_wheel(missing: OSError) -> tuple[str, bytes]:
    try:
        import espeakng_loader

        # Global, as the binding asks for the name that the system's library would have, and gets the one that is there.
        ctypes.CDLL(espeakng_loader.get_library_path(), mode=ctypes.RTLD_GLOBAL)
    except (ImportError, OSError) as error:
        if _passes(error):
            raise
        text = "libespeak-ng is missing: install libespeak-ng1, or pip install espeakng-loader"
        raise NotInstalled(f"{text} ({missing})") from error
    return "espeakng-loader", str(espeakng_loader.get_data_path()).encode()


def _passes(error: Exception) -> bool:
    """Tell whether a library that is there could not be loaded for want of memory or descriptors.

    The loader has but words for it, which end in the system's.
    """
    return str(error).endswith(tuple(map(os.strerror, (errno.EMFILE, errno.ENFILE, errno.ENOMEM))))
