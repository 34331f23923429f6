"""Bindings for libpulse, and a main loop that never blocks.

An iteration of libpulse's main loop consists of prepare, poll and dispatch. A program can replace the poll function.
Ours stores the descriptors and the timeout that libpulse wants to wait for, and polls without waiting. The loop is
iterated until it has no more work. Then the engine waits for the stored descriptors together with its own ones. This
needs neither a thread nor a blocking call.

libpulse finds the server on its own (PULSE_SERVER, client.conf, the runtime directories of the user and the system),
and sends the cookie.
"""

from __future__ import annotations

import ctypes
import time
from ctypes import CFUNCTYPE, POINTER, Structure, c_char_p, c_int, c_size_t, c_uint32, c_uint64, c_void_p
from functools import cache
from types import SimpleNamespace

from talkcli.polling import NEVER

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from talkcli.engine.child.players.base import Interest

_LIBPULSE = "libpulse.so.0"

#: An invalid index, or a size that the server should choose. This is -1 as a uint32_t.
NO_INDEX = 0xFFFFFFFF
#: The value for a volume of 100 %.
NORMAL_VOLUME = 0x10000

# Constants from pulse/def.h and pulse/sample.h, which are part of libpulse's ABI.
NO_AUTOSPAWN = 1
S16LE = 3
CONTEXT_READY, CONTEXT_FAILED, CONTEXT_TERMINATED = 4, 5, 6
STREAM_READY, STREAM_FAILED, STREAM_TERMINATED = 2, 3, 4
AUTO_TIMING_UPDATE, ADJUST_LATENCY = 0x8, 0x2000
FLAT_VOLUME = 0x40
MASK_SINK, MASK_SINK_INPUT = 0x1, 0x4
NO_ENTITY, CONNECTION_REFUSED, INVALID_SERVER = 5, 6, 13
#: The value that a function returns instead of a size if it fails. This is -1 as a size_t.
SIZE_ERROR = c_size_t(-1).value


class PollDescriptor(Structure):
    """The C structure `pollfd`: a descriptor and its poll events."""

    _fields_ = [("fd", c_int), ("events", ctypes.c_short), ("revents", ctypes.c_short)]


class SampleSpec(Structure):
    """The C structure `pa_sample_spec`: the format, rate and channels of samples."""

    _fields_ = [("format", c_int), ("rate", c_uint32), ("channels", ctypes.c_uint8)]


class ChannelMap(Structure):
    """The C structure `pa_channel_map`: the speaker position of each channel."""

    _fields_ = [("channels", ctypes.c_uint8), ("map", c_int * 32)]


class Volume(Structure):
    """The C structure `pa_cvolume`: the volume of each channel."""

    _fields_ = [("channels", ctypes.c_uint8), ("values", c_uint32 * 32)]


class BufferSizes(Structure):
    """The C structure `pa_buffer_attr`: the sizes of a stream's buffers in bytes."""

    _fields_ = [(name, c_uint32) for name in ("maxlength", "tlength", "prebuf", "minreq", "fragsize")]


class SinkInfo(Structure):
    """The first fields of the C structure `pa_sink_info`, which describes a sink.

    Later versions of libpulse only append fields.
    """

    _fields_ = [
        ("name", c_char_p),
        ("index", c_uint32),
        ("description", c_char_p),
        ("sample_spec", SampleSpec),
        ("channel_map", ChannelMap),
        ("owner_module", c_uint32),
        ("volume", Volume),
        ("mute", c_int),
        ("monitor_source", c_uint32),
        ("monitor_source_name", c_char_p),
        ("latency", c_uint64),
        ("driver", c_char_p),
        ("flags", c_int),
    ]


class SinkInputInfo(Structure):
    """The first fields of the C structure `pa_sink_input_info`, which describes a stream."""

    _fields_ = [
        ("index", c_uint32),
        ("name", c_char_p),
        ("owner_module", c_uint32),
        ("client", c_uint32),
        ("sink", c_uint32),
        ("sample_spec", SampleSpec),
        ("channel_map", ChannelMap),
        ("volume", Volume),
        ("buffer_usec", c_uint64),
        ("sink_usec", c_uint64),
        ("resample_method", c_char_p),
        ("driver", c_char_p),
        ("mute", c_int),
    ]


# Types of callbacks. A callback must not raise an exception, because ctypes would print it and return garbage.
PollCallback = CFUNCTYPE(c_int, POINTER(PollDescriptor), ctypes.c_ulong, c_int, c_void_p)
StreamCallback = CFUNCTYPE(None, c_void_p, c_void_p)
#: A callback that receives a stream or context, whether an operation succeeded, and user data.
SuccessCallback = CFUNCTYPE(None, c_void_p, c_int, c_void_p)
#: A callback that receives a context, the kind of a change, the index of the changed object, and user data.
ChangeCallback = CFUNCTYPE(None, c_void_p, c_int, c_uint32, c_void_p)
SinkCallback = CFUNCTYPE(None, c_void_p, POINTER(SinkInfo), c_int, c_void_p)
SinkInputCallback = CFUNCTYPE(None, c_void_p, POINTER(SinkInputInfo), c_int, c_void_p)

#: The types of results and arguments of libpulse's functions, by function name without the prefix "pa_".
_SIGNATURES: tuple[tuple[str, Any, list[Any]], ...] = (
    ("mainloop_new", c_void_p, []),
    ("mainloop_free context_disconnect context_unref operation_unref stream_unref", None, [c_void_p]),
    ("mainloop_get_api", c_void_p, [c_void_p]),
    ("mainloop_set_poll_func", None, [c_void_p, PollCallback, c_void_p]),
    ("mainloop_iterate", c_int, [c_void_p, c_int, c_void_p]),
    ("context_get_state context_errno", c_int, [c_void_p]),
    ("context_new", c_void_p, [c_void_p, c_char_p]),
    ("context_connect", c_int, [c_void_p, c_char_p, c_int, c_void_p]),
    ("context_set_subscribe_callback", None, [c_void_p, ChangeCallback, c_void_p]),
    ("context_subscribe", c_void_p, [c_void_p, c_int, c_void_p, c_void_p]),
    ("context_get_sink_info_by_index", c_void_p, [c_void_p, c_uint32, SinkCallback, c_void_p]),
    ("context_get_sink_input_info", c_void_p, [c_void_p, c_uint32, SinkInputCallback, c_void_p]),
    ("strerror", c_char_p, [c_int]),
    ("stream_new", c_void_p, [c_void_p, c_char_p, POINTER(SampleSpec), c_void_p]),
    ("stream_connect_playback", c_int, [c_void_p, c_char_p, POINTER(BufferSizes), c_int, c_void_p, c_void_p]),
    ("stream_get_state stream_is_suspended", c_int, [c_void_p]),
    ("stream_get_index stream_get_device_index", c_uint32, [c_void_p]),
    ("stream_get_device_name", c_char_p, [c_void_p]),
    ("stream_writable_size", c_size_t, [c_void_p]),
    ("stream_write", c_int, [c_void_p, c_char_p, c_size_t, c_void_p, ctypes.c_int64, c_int]),
    ("stream_drain", c_void_p, [c_void_p, SuccessCallback, c_void_p]),
    ("stream_get_time", c_int, [c_void_p, POINTER(c_uint64)]),
    ("stream_set_started_callback stream_set_underflow_callback", None, [c_void_p, StreamCallback, c_void_p]),
    ("stream_set_latency_update_callback", None, [c_void_p, StreamCallback, c_void_p]),
    ("stream_update_timing_info", c_void_p, [c_void_p, c_void_p, c_void_p]),
)


@cache
def load() -> Any:
    """Load libpulse, and return an object with its functions.

    Raises:
        OSError: libpulse can't be loaded.
        AttributeError: libpulse lacks a function.
    """
    library, poll = ctypes.CDLL(_LIBPULSE), ctypes.CDLL(None).poll
    poll.argtypes = [POINTER(PollDescriptor), ctypes.c_ulong, c_int]
    functions = {"poll": poll}
    for names, result, arguments in _SIGNATURES:
        for name in names.split():
            function = getattr(library, f"pa_{name}")
            function.restype, function.argtypes = result, arguments
            functions[name] = function
    return SimpleNamespace(**functions)


class MainLoop:
    """A libpulse main loop that never blocks."""

    def __init__(self, library: Any) -> None:
        self._library = library
        self._pointer = library.mainloop_new()
        self._callback = PollCallback(self._poll)
        library.mainloop_set_poll_func(self._pointer, self._callback, None)
        #: the pointer to pass to `pa_context_new`
        self.api: int = library.mainloop_get_api(self._pointer)
        #: the descriptors that libpulse wants to wait for, and the monotonic time of its next timer
        self.interests: list[Interest] = []
        self.wake_at = NEVER
        self.freed = False

    def iterate(self) -> bool:
        """Run one iteration without waiting. Return whether it did any work."""
        # If the second argument is 1, libpulse tells `_poll` how long to wait for the next timer.
        return not self.freed and bool(self._library.mainloop_iterate(self._pointer, 1, None) > 0)

    def free(self) -> None:
        """Free the loop. Its contexts must be released first."""
        self._library.mainloop_free(self._pointer)
        self.freed, self.interests, self.wake_at = True, [], NEVER

    def _poll(self, wanted: Any, count: int, timeout: int, _: object) -> int:
        """Return how many descriptors are ready now. Store the descriptors and the time of the next timer."""
        self.interests = [(wanted[number].fd, wanted[number].events) for number in range(count)]
        self.wake_at = NEVER if timeout < 0 else time.monotonic() + timeout / 1000
        return max(0, int(self._library.poll(wanted, count, 0)))  # libpulse would abort the process after an error


def loudest(volume: Volume) -> float:
    """Return the volume of the loudest channel, where 1.0 is 100 %."""
    return float(max(volume.values[: volume.channels], default=0) / NORMAL_VOLUME)
