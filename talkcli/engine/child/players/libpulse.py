"""libpulse by ctypes: the functions that a player needs, and its main loop, driven by the engine's own wait.

libpulse brings its loop in three parts, prepare, poll and dispatch, and lets the function that polls be replaced. Ours
notes what libpulse would wait for, and looks without waiting. So the loop is turned until it has nothing left to do,
and what was noted last is what the engine waits for: no thread, and no call that blocks.

Nothing here knows what a sentence is; which server is asked is libpulse's to find (PULSE_SERVER, client.conf, the
user's runtime directory, the system's), with its cookie, over any kind of socket.
"""

from __future__ import annotations

import ctypes
import time
from ctypes import CFUNCTYPE, POINTER, Structure, c_char_p, c_int, c_short, c_void_p
from ctypes import c_int64 as i64
from ctypes import c_size_t as size
from ctypes import c_uint8 as u8
from ctypes import c_uint32 as u32
from ctypes import c_uint64 as u64
from functools import cache

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from talkcli.engine.child.players.base import Interest

_NAME = "libpulse.so.0"

#: No index, and "as the server likes it": (uint32_t) -1.
NONE = 0xFFFFFFFF
#: What is said of volumes: 100 %.
NORMAL_VOLUME = 0x10000

# From pulse/def.h and pulse/sample.h; the numbers are part of libpulse's ABI.
NO_AUTOSPAWN = 1
S16LE = 3
CONTEXT_READY, CONTEXT_FAILED, CONTEXT_TERMINATED = 4, 5, 6
STREAM_READY, STREAM_FAILED, STREAM_TERMINATED = 2, 3, 4
AUTO_TIMING_UPDATE, ADJUST_LATENCY = 0x8, 0x2000
FLAT_VOLUME = 0x40
ABOUT_SINKS, ABOUT_SINK_INPUTS = 0x1, 0x4
FACILITY, OF_SINK, OF_SINK_INPUT = 0xF, 0, 2
NO_ENTITY, CONNECTION_REFUSED, INVALID_SERVER = 5, 6, 13
#: What a size is where there is none: (size_t) -1.
FAILED = ctypes.c_size_t(-1).value


class PollDescriptor(Structure):
    """`struct pollfd`."""

    _fields_ = [("fd", c_int), ("events", c_short), ("revents", c_short)]


class SampleSpec(Structure):
    """`pa_sample_spec`."""

    _fields_ = [("format", c_int), ("rate", u32), ("channels", u8)]


class ChannelMap(Structure):
    """`pa_channel_map`."""

    _fields_ = [("channels", u8), ("map", c_int * 32)]


class Volume(Structure):
    """`pa_cvolume`: one volume for each channel."""

    _fields_ = [("channels", u8), ("values", u32 * 32)]


class BufferSizes(Structure):
    """`pa_buffer_attr`, in bytes."""

    _fields_ = [(name, u32) for name in ("maxlength", "tlength", "prebuf", "minreq", "fragsize")]


class SinkInfo(Structure):
    """The beginning of `pa_sink_info`; later versions only add at its end."""

    _fields_ = [
        ("name", c_char_p),
        ("index", u32),
        ("description", c_char_p),
        ("sample_spec", SampleSpec),
        ("channel_map", ChannelMap),
        ("owner_module", u32),
        ("volume", Volume),
        ("mute", c_int),
        ("monitor_source", u32),
        ("monitor_source_name", c_char_p),
        ("latency", u64),
        ("driver", c_char_p),
        ("flags", c_int),
    ]


class SinkInputInfo(Structure):
    """The beginning of `pa_sink_input_info`."""

    _fields_ = [
        ("index", u32),
        ("name", c_char_p),
        ("owner_module", u32),
        ("client", u32),
        ("sink", u32),
        ("sample_spec", SampleSpec),
        ("channel_map", ChannelMap),
        ("volume", Volume),
        ("buffer_usec", u64),
        ("sink_usec", u64),
        ("resample_method", c_char_p),
        ("driver", c_char_p),
        ("mute", c_int),
    ]


# What libpulse calls. Nothing may be raised through it: ctypes would print it and return what it likes.
Poll = CFUNCTYPE(c_int, POINTER(PollDescriptor), ctypes.c_ulong, c_int, c_void_p)
#: of a stream
Notice = CFUNCTYPE(None, c_void_p, c_void_p)
#: of a stream or a context: whether it went well
Success = CFUNCTYPE(None, c_void_p, c_int, c_void_p)
#: of a context: what has changed, as facility and type, and the index of it
Changed = CFUNCTYPE(None, c_void_p, c_int, u32, c_void_p)
SinkTold = CFUNCTYPE(None, c_void_p, POINTER(SinkInfo), c_int, c_void_p)
SinkInputTold = CFUNCTYPE(None, c_void_p, POINTER(SinkInputInfo), c_int, c_void_p)

#: Every function that is used: what it returns, and what it takes.
_FUNCTIONS: dict[str, tuple[Any, list[Any]]] = {
    "pa_mainloop_new": (c_void_p, []),
    "pa_mainloop_free": (None, [c_void_p]),
    "pa_mainloop_get_api": (c_void_p, [c_void_p]),
    "pa_mainloop_set_poll_func": (None, [c_void_p, Poll, c_void_p]),
    "pa_mainloop_prepare": (c_int, [c_void_p, c_int]),
    "pa_mainloop_poll": (c_int, [c_void_p]),
    "pa_mainloop_dispatch": (c_int, [c_void_p]),
    "pa_context_new": (c_void_p, [c_void_p, c_char_p]),
    "pa_context_connect": (c_int, [c_void_p, c_char_p, c_int, c_void_p]),
    "pa_context_disconnect": (None, [c_void_p]),
    "pa_context_unref": (None, [c_void_p]),
    "pa_context_get_state": (c_int, [c_void_p]),
    "pa_context_errno": (c_int, [c_void_p]),
    "pa_context_set_subscribe_callback": (None, [c_void_p, Changed, c_void_p]),
    "pa_context_subscribe": (c_void_p, [c_void_p, c_int, c_void_p, c_void_p]),
    "pa_context_get_sink_info_by_index": (c_void_p, [c_void_p, u32, SinkTold, c_void_p]),
    "pa_context_get_sink_input_info": (c_void_p, [c_void_p, u32, SinkInputTold, c_void_p]),
    "pa_strerror": (c_char_p, [c_int]),
    "pa_operation_unref": (None, [c_void_p]),
    "pa_stream_new": (c_void_p, [c_void_p, c_char_p, POINTER(SampleSpec), c_void_p]),
    "pa_stream_connect_playback": (c_int, [c_void_p, c_char_p, POINTER(BufferSizes), c_int, c_void_p, c_void_p]),
    "pa_stream_unref": (None, [c_void_p]),
    "pa_stream_get_state": (c_int, [c_void_p]),
    "pa_stream_get_index": (u32, [c_void_p]),
    "pa_stream_get_device_index": (u32, [c_void_p]),
    "pa_stream_get_device_name": (c_char_p, [c_void_p]),
    "pa_stream_is_suspended": (c_int, [c_void_p]),
    "pa_stream_writable_size": (size, [c_void_p]),
    "pa_stream_write": (c_int, [c_void_p, c_char_p, size, c_void_p, i64, c_int]),
    "pa_stream_drain": (c_void_p, [c_void_p, Success, c_void_p]),
    "pa_stream_get_time": (c_int, [c_void_p, POINTER(u64)]),
    "pa_stream_set_started_callback": (None, [c_void_p, Notice, c_void_p]),
    "pa_stream_set_underflow_callback": (None, [c_void_p, Notice, c_void_p]),
    "pa_stream_set_latency_update_callback": (None, [c_void_p, Notice, c_void_p]),
    "pa_stream_update_timing_info": (c_void_p, [c_void_p, c_void_p, c_void_p]),
}


class Library:
    """The functions, each by its name without the "pa_"; OSError or AttributeError where libpulse isn't what it was."""

    def __init__(self) -> None:
        library = ctypes.CDLL(_NAME)
        for name, (result, arguments) in _FUNCTIONS.items():
            function = getattr(library, name)
            function.restype, function.argtypes = result, arguments
            setattr(self, name.removeprefix("pa_"), function)
        self.poll = ctypes.CDLL(None).poll
        self.poll.argtypes = [POINTER(PollDescriptor), ctypes.c_ulong, c_int]

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...


@cache
def load() -> Library:
    """Load libpulse, once a process; OSError, in words, where it isn't there or isn't one of those that we know."""
    try:
        return Library()
    except AttributeError as error:
        raise OSError(str(error)) from error


class Loop:
    """A main loop of libpulse's, which waits for nothing by itself."""

    def __init__(self, library: Library) -> None:
        self._library = library
        self._pointer = library.mainloop_new()
        self._callback = Poll(self._look)
        library.mainloop_set_poll_func(self._pointer, self._callback, None)
        self._failed: BaseException | None = None
        #: what it waits for, and until when
        self.interests: list[Interest] = []
        self.due: float | None = None

    @property
    def api(self) -> int:
        """What a context is made with."""
        return self._library.mainloop_get_api(self._pointer)  # type: ignore[no-any-return]

    def turn(self) -> bool:
        """Do what can be done now, once; return whether anything was done, after which there may be more."""
        if self._library.mainloop_prepare(self._pointer, -1) < 0:
            return False
        self._library.mainloop_poll(self._pointer)  # dispatch without it would abort the process
        done = self._library.mainloop_dispatch(self._pointer)
        if self._failed is not None:
            raise self._failed
        return bool(done > 0)

    def free(self) -> None:
        """End it, after all contexts that were made with it."""
        self._library.mainloop_free(self._pointer)
        self.interests, self.due = [], None

    def _look(self, wanted: Any, count: int, timeout: int, _: object) -> int:
        try:
            self.interests = [(wanted[number].fd, wanted[number].events) for number in range(count)]
            self.due = None if timeout < 0 else time.monotonic() + timeout / 1000
            return int(self._library.poll(wanted, count, 0))
        except BaseException as error:  # noqa: BLE001 - it is raised by `turn`: nothing can be through C
            self._failed = error
            return 0


def loudness(volume: Volume) -> float:
    """Return the volume of the loudest channel, 1 for 100 %."""
    return float(max(volume.values[: volume.channels], default=0) / NORMAL_VOLUME)
