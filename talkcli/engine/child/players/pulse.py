"""The player "pulse", which sends its samples directly to the sound server.

Each sentence has a connection and a stream of its own. Opening both takes 1 ms, while starting a program takes 9 ms.
The server reports more than a program could: when the stream started, whether it was moved, suspended or killed, how
much of it has been heard, and how loud the sink and the stream are. The player never starts a sound server.
"""

from __future__ import annotations

import time
from ctypes import byref, c_uint64

from talkcli.engine.child.players import libpulse
from talkcli.engine.child.players.base import CannotSpeak, Player
from talkcli.engine.players import BUFFER_MS, DUMMY_SINK, SAMPLE_BYTES
from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.goals.goal import Output
from talkcli.goals.reasons import Reason
from talkcli.polling import NEVER

if TYPE_CHECKING:
    from typing import Any

    from talkcli.engine.child.players.base import Interest

#: The server wakes the player when the buffer has room for this many milliseconds of sound.
REQUEST_MS = 15

#: Seconds for which a volume of 0 is ignored after a stream is created. PipeWire creates every stream with this volume,
#: and sets the real volume a millisecond later.
VOLUME_SETTLES_S = 0.1

#: Time limit in seconds for creating the stream, which usually takes 1 to 20 ms. If the server hangs, another player
#: can play the sentence, because this player hasn't accepted any samples yet.
READY_LIMIT_S = 2.0

#: Seconds for which the sink may be suspended while a stream plays. A sleeping sink wakes up before the stream starts.
SUSPENDED_LIMIT_S = 0.5

#: Until the first sound is heard, the player asks the server for the playback time this many seconds after each answer.
#: The interval is short because the first word must be reported as soon as it is heard. The first sound takes 1 to 10
#: ms on local devices and 200 ms over Bluetooth.
TIME_REQUEST_S = 0.002


@frozen
class Level:
    """The volume and mute state of a sink or a stream."""

    volume: float  # volume of the loudest channel; 1.0 is 100 %, and higher values are possible
    muted: bool
    #: whether stream volumes are absolute, so that the sink's volume doesn't reduce them further
    flat: bool = False


class PulsePlayer(Player):
    """Plays a sentence through a stream of the sound server."""

    name = "pulse"
    real_time = True

    def __init__(self, rate: int, device: str | None = None, audible: bool = False) -> None:
        """Connect to the sound server.

        Args:
            rate: Samples per second.
            device: The name of a sink, or None for the server's choice.
            audible: Whether the sentence fails if the output is muted (`muted`).

        Raises:
            CannotSpeak: No server answers (`no_player`).
        """
        self.proven = False
        #: the name of the sink, or None until the stream exists
        self.device: str | None = None
        self._rate = rate
        self._wanted_device = device
        self._audible = audible
        self._written = self._heard = 0
        #: the seconds heard and the time, from the server's last report; None until sound is heard
        self._clock_report: tuple[float, float] | None = None
        #: the number of bytes written when the server last ran out of samples, or None while it plays
        self._dry_at: int | None = None
        #: when to send the next request for the playback time
        self._time_request_at = NEVER
        self._closed = self._draining = self._drained = False
        self._error: CannotSpeak | None = None
        self._stream: int | None = None
        self._sink_index = libpulse.NO_INDEX
        #: the time until which a stream volume of 0 is ignored
        self._volume_settled_at = 0.0
        #: the time by which the server must have created the stream
        self._ready_by = time.monotonic() + READY_LIMIT_S
        #: the time by which a suspended sink must be running again
        self._resumed_by = NEVER
        #: the number of pending requests for the stream's volume
        self._pending_levels = 0
        self._sink_level: Level | None = None
        self._stream_level: Level | None = None
        #: whether the output was ever muted during the sentence, and whether the server refused to report a volume
        self._muted = self._level_refused = False
        try:
            self._lib = libpulse.load()
        except (OSError, AttributeError) as error:
            raise CannotSpeak(Reason.NO_PLAYER, f"libpulse could not be loaded: {error}") from error
        self._started_callback = libpulse.StreamCallback(self._on_started)
        self._underflow_callback = libpulse.StreamCallback(self._on_underflow)
        self._time_callback = libpulse.StreamCallback(self._on_time)
        self._drained_callback = libpulse.SuccessCallback(self._on_drained)
        self._change_callback = libpulse.ChangeCallback(self._request_levels)
        self._sink_callback = libpulse.SinkCallback(self._on_sink)
        self._stream_callback = libpulse.SinkInputCallback(self._on_stream)
        self._loop = libpulse.MainLoop(self._lib)
        self._context = self._lib.context_new(self._loop.api, b"talk")
        if self._context is None:
            self._loop.free()
            raise CannotSpeak(Reason.NO_PLAYER, "libpulse could not create a connection; free some memory")
        # an error appears in the state of the context
        self._lib.context_connect(self._context, None, libpulse.NO_AUTOSPAWN, None)
        self._run_libpulse()
        if self._error is not None:
            self.kill()
            raise self._error

    # -- the interface `Player`

    def offer(self, data: memoryview) -> int:
        """Write as many samples as the server has room for. Return the number of bytes written."""
        self._run_and_check()
        length = min(len(data), self._room())
        if length == 0:
            return 0
        if self._lib.stream_write(self._stream, bytes(data[:length]), length, None, 0, 0) < 0:
            self._record_failure()
            self._run_and_check()
        self._written += length
        self._run_libpulse()
        return length

    def consumed(self) -> int:
        """Return how many bytes have been heard, according to the server's clock."""
        self.heard()
        return self._heard

    def heard(self) -> float | None:
        """Return how many seconds have been heard, according to the server's clock."""
        if self._drained:
            self._heard = self._written
        elif self._clock_report is not None:
            seconds, at = self._clock_report
            heard = int((seconds + time.monotonic() - at) * self._rate) * SAMPLE_BYTES
            self._heard = max(self._heard, min(heard, self._written if self._dry_at is None else self._dry_at))
        return self._heard / (self._rate * SAMPLE_BYTES)

    def close(self) -> None:
        """Accept no more samples, and ask the server to play the rest."""
        self._closed = True
        self._run_and_check()

    def ended(self) -> bool:
        """Return whether the server has played the whole stream. Raise CannotSpeak if it has failed."""
        self._run_and_check()
        return self._drained

    def interests(self) -> list[Interest]:
        """Return libpulse's descriptors, each with its poll events."""
        return self._loop.interests

    def wake_at(self) -> float:
        """Run libpulse. Return when it needs to run again.

        The result is 0, which means now, if the server has room for samples. It is also 0 after each report of the
        playback time, because words may be due.
        """
        report = self._clock_report
        self._run_libpulse()
        if self._error is not None or self._drained or self._clock_report is not report or self._room():
            return 0.0
        settled_at = self._volume_settled_at if self._is_volume_pending() else NEVER
        return min(self._loop.wake_at, self._ready_by, self._resumed_by, self._time_request_at, settled_at)

    def kill(self) -> None:
        """Close the connection. The server then drops the stream."""
        if self._loop.freed:
            return
        self._lib.context_disconnect(self._context)
        if self._stream is not None:
            self._lib.stream_unref(self._stream)
        self._lib.context_unref(self._context)
        self._loop.free()
        self._stream = None
        self._error = self._error or CannotSpeak(Reason.AUDIO_LOST, "the stream was ended")

    def gone(self) -> bool:
        """Return whether `kill` has closed the connection to the sound server."""
        return self._loop.freed

    @property
    def output(self) -> Output | None:
        """The sink, its volume and whether it was ever muted, or None until the server reports them."""
        sink, stream = self._sink_level, self._stream_level
        if self.device is None or sink is None or stream is None or self._is_volume_pending():
            return None
        volume = stream.volume if sink.flat else sink.volume * stream.volume
        return Output(self.name, self.device, round(min(1.0, volume), 2), self._muted)

    # -- the states of the stream

    def _run_and_check(self) -> None:
        """Run libpulse, and raise CannotSpeak if the stream has failed.

        Raises:
            CannotSpeak: The stream has failed.
        """
        self._run_libpulse()
        if self._error is not None and not self._drained:
            raise self._error

    def _run_libpulse(self) -> None:
        """Run libpulse and advance the stream until there is no more work."""
        while self._loop.iterate() or self._advance_stream():
            pass

    def _advance_stream(self) -> bool:
        """Open, update or drain the stream if necessary. Return whether to run libpulse again."""
        if self._error is not None or self._drained:
            return False
        state = self._lib.context_get_state(self._context)
        if state in (libpulse.CONTEXT_FAILED, libpulse.CONTEXT_TERMINATED):
            self._record_failure()
            return False
        if time.monotonic() >= self._ready_by:
            message = f"the sound server did not answer within {READY_LIMIT_S:g} s"
            self._error = CannotSpeak(Reason.AUDIO_DEVICE, message)
            return False
        if self._stream is None:
            return state == libpulse.CONTEXT_READY and self._open_stream()
        state = self._lib.stream_get_state(self._stream)
        if state in (libpulse.STREAM_FAILED, libpulse.STREAM_TERMINATED):
            self._record_failure()
        elif state == libpulse.STREAM_READY:
            asked = self._follow_sink() or self._request_time()
            if self._closed and not self._draining and self._error is None:
                self._release(self._lib.stream_drain(self._stream, self._drained_callback, None))
                self._draining = asked = True
            return asked
        return False

    def _open_stream(self) -> bool:
        """Create the stream and connect it to a sink. Return False if the stream can't be created."""
        buffered, request = (each * self._rate // 1000 * SAMPLE_BYTES for each in (BUFFER_MS, REQUEST_MS))
        # The server starts playing once the buffer is full. If it started with the first piece, it would run out of
        # samples before the second, and would have to rewind. Some sinks can't rewind.
        sizes = libpulse.BufferSizes(2 * buffered, buffered, buffered, request, libpulse.NO_INDEX)
        spec = libpulse.SampleSpec(libpulse.S16LE, self._rate, 1)
        self._stream = self._lib.stream_new(self._context, b"talk", byref(spec), None)
        if self._stream is None:
            self._record_failure()
            return False
        self._lib.stream_set_started_callback(self._stream, self._started_callback, None)
        self._lib.stream_set_underflow_callback(self._stream, self._underflow_callback, None)
        self._lib.stream_set_latency_update_callback(self._stream, self._time_callback, None)
        flags = libpulse.ADJUST_LATENCY | libpulse.AUTO_TIMING_UPDATE
        device = None if self._wanted_device is None else self._wanted_device.encode()
        if self._lib.stream_connect_playback(self._stream, device, byref(sizes), flags, None, None) < 0:
            self._record_failure()
        return True

    def _follow_sink(self) -> bool:
        """Record whether the sink was changed, muted or suspended. Return whether requests were sent."""
        index = int(self._lib.stream_get_device_index(self._stream))
        changed = index != self._sink_index
        if changed:
            begins, self._sink_index = self._sink_index == libpulse.NO_INDEX, index
            self.device = (self._lib.stream_get_device_name(self._stream) or b"").decode("utf-8", "replace")
            if self.device == DUMMY_SINK != self._wanted_device:  # no other player would be heard either
                reason, left = (Reason.AUDIO_DEVICE, "") if begins else (Reason.AUDIO_LOST, " left")
                self._error = CannotSpeak(reason, f"the sound server has only a dummy output{left}", final=True)
            if begins:
                self._ready_by, self._volume_settled_at = NEVER, time.monotonic() + VOLUME_SETTLES_S
                self._lib.context_set_subscribe_callback(self._context, self._change_callback, None)
                mask = libpulse.MASK_SINK | libpulse.MASK_SINK_INPUT
                self._release(self._lib.context_subscribe(self._context, mask, None, None))
            self._request_levels()
        self._record_mute()
        if not self._lib.stream_is_suspended(self._stream):
            if self._resumed_by != NEVER:
                self._resumed_by = NEVER
                self._restart_clock()
            return changed
        now = time.monotonic()
        self._resumed_by = min(self._resumed_by, now + SUSPENDED_LIMIT_S)
        if now >= self._resumed_by:
            self._error = CannotSpeak(Reason.AUDIO_STALLED, f"the sound server has suspended {self.device}")
        return changed

    def _request_time(self) -> bool:
        """Request the playback time if a request is due. Return whether a request was sent."""
        if time.monotonic() < self._time_request_at:
            return False
        self._time_request_at = NEVER
        self._release(self._lib.stream_update_timing_info(self._stream, None, None))
        return True

    def _request_levels(self, *_: Any) -> None:
        """Request the volume and mute state of the sink and of the stream."""
        self._pending_levels += 1
        sink, stream = self._sink_index, self._lib.stream_get_index(self._stream)
        self._release(self._lib.context_get_sink_info_by_index(self._context, sink, self._sink_callback, None))
        self._release(self._lib.context_get_sink_input_info(self._context, stream, self._stream_callback, None))

    def _release(self, operation: int | None) -> None:
        """Release the handle of an operation. The operation itself keeps running."""
        if operation is not None:
            self._lib.operation_unref(operation)

    def _room(self) -> int:
        """Return how many bytes the server has room for."""
        if self._sink_index == libpulse.NO_INDEX or self._closed or self._error is not None:
            return 0
        if self._audible and not (self._level_refused or self.output):
            return 0  # wait for the volumes, which the server reports within 1 ms
        room = self._lib.stream_writable_size(self._stream)
        return 0 if room == libpulse.SIZE_ERROR else room // SAMPLE_BYTES * SAMPLE_BYTES

    def _is_volume_pending(self) -> bool:
        """Return whether the stream's final volume is still unknown."""
        level = self._stream_level
        if level is None or level.volume > 0 or level.muted or self._drained:
            return False
        return self._pending_levels > 0 or time.monotonic() < self._volume_settled_at

    def _record_mute(self) -> None:
        """If the output is muted, record the mute state, and fail a sentence that must be audible."""
        levels = [each for each in (self._sink_level, self._stream_level) if each is not None]
        if self._drained or self._is_volume_pending() or not any(each.muted or each.volume == 0 for each in levels):
            return
        self._muted = True
        if self._audible and self._error is None:
            self._error = CannotSpeak(Reason.MUTED, f"the output {self.device} is muted", final=True)

    def _restart_clock(self) -> None:
        """Forget the reported playback time, and schedule a new request."""
        self._clock_report, self._time_request_at = None, 0.0

    def _record_failure(self) -> None:
        """Record why the stream has failed, unless an earlier error is recorded."""
        if self._error is not None:
            return
        reason = Reason.AUDIO_DEVICE if self._written == 0 else Reason.AUDIO_LOST
        number = self._lib.context_errno(self._context)
        words = self._lib.strerror(number).decode("utf-8", "replace")
        message = f"the sound server ended the stream: {words}"
        if self._stream is None and number in (libpulse.CONNECTION_REFUSED, libpulse.INVALID_SERVER):
            reason, message = Reason.NO_PLAYER, f"no sound server is running: {words}"
        elif self._stream is None:
            message = f"the sound server rejected the connection: {words}"
        # Here, the error number may belong to a request for a sink that no longer exists.
        elif self._sink_index != libpulse.NO_INDEX:
            message = "the sound server ended the stream"
        elif number == libpulse.NO_ENTITY and self._wanted_device is not None:
            message = f'the sound server has no sink "{self._wanted_device}"; list them with: pactl list short sinks'
        elif number == libpulse.NO_ENTITY:
            message = "the sound server has no output"
        self._error = CannotSpeak(reason, message)

    # -- callbacks of libpulse

    def _on_started(self, *_: Any) -> None:
        """Record that the server has started to play, and restart the clock."""
        self.proven, self._dry_at = True, None
        self._restart_clock()

    def _on_underflow(self, *_: Any) -> None:
        """Record how much was written when the server ran out of samples."""
        self._dry_at = self._written

    def _on_time(self, *_: Any) -> None:
        """Store the playback time reported by the server, or schedule another request for it."""
        if not self.proven:
            return  # before the stream has started, the reported time is only the delay of the answer
        heard, now = c_uint64(), time.monotonic()
        if self._lib.stream_get_time(self._stream, byref(heard)) == 0 and heard.value:
            self._clock_report, self._time_request_at = (heard.value / 1_000_000, now), NEVER
        elif self._clock_report is None:
            self._time_request_at = now + TIME_REQUEST_S

    def _on_drained(self, _stream: int, success: int, _data: object) -> None:
        """Record that the server has played the whole stream, or has failed to do so."""
        if not success:
            self._record_failure()
            return
        self._follow_sink()  # the stream may have been moved to another sink
        self._volume_settled_at = 0.0
        self._record_mute()
        self._drained = self.proven = self._error is None

    def _on_sink(self, _context: int, found: Any, end: int, _data: object) -> None:
        """Store the sink's volume and mute state, as reported by the server."""
        if end == 0 and found[0].index == self._sink_index:  # ignore a sink that the stream has left
            flat = bool(found[0].flags & libpulse.FLAT_VOLUME)
            self._sink_level = Level(libpulse.loudest(found[0].volume), bool(found[0].mute), flat)
            self._record_mute()
        elif end < 0:
            self._level_refused = True

    def _on_stream(self, _context: int, found: Any, end: int, _data: object) -> None:
        """Store the stream's volume and mute state, as reported by the server."""
        self._pending_levels -= end != 0
        if end == 0:
            self._stream_level = Level(libpulse.loudest(found[0].volume), bool(found[0].mute))
            self._record_mute()
        elif end < 0:
            self._level_refused = True
