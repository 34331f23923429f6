"""The player "pulse": a stream at the sound server, PulseAudio's or PipeWire's, from this very process.

A connection and a stream for each sentence, and none between two: that takes 1 ms, where a program's start takes 9. The
server tells what no exit status can: when the stream began, that it was moved, suspended or killed, how much of it is
heard, and whether anybody can hear it: how loud sink and stream are. It never starts a server.
"""

from __future__ import annotations

import time
from ctypes import byref, c_uint64

from talkcli.engine.child.players import libpulse
from talkcli.engine.child.players.base import CannotSpeak, Player
from talkcli.engine.players import DUMMY_SINK, SAMPLE_BYTES
from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.goals.goal import Output
from talkcli.goals.reasons import Reason

if TYPE_CHECKING:
    from typing import Any

    from talkcli.engine.child.players.base import Interest

#: Milliseconds of sound that the server holds, as much as a program is asked to: what it holds is said again, or late,
#: when something stops it, and bridges what a busy machine delays. It begins with as much: with the first piece alone
#: it would run dry behind that and go back for the second, which not every sink can.
BUFFER_MS = 60
#: Milliseconds of room for which it wakes us.
REQUEST_MS = 15

#: Seconds after which a stream that has no volume is taken to be turned down: PipeWire makes each so, and gives it the
#: volume that it is to have a millisecond later.
SETTLED_AFTER = 0.1

#: Seconds within which the server must have made the stream: it takes 1 to 20 ms. One that hangs is not waited for:
#: nothing was given to it, and another player may be heard.
READY_WITHIN = 2.0

#: Seconds for which the sink may be suspended under a stream: one that slept is awake again before the stream begins.
SUSPENDED_FOR = 0.5

#: Seconds from an answer to the next question for the time, as long as nothing is heard: a word begins when that ends.
#: It does after 1 to 10 ms at a near sink, after 200 by Bluetooth.
ASK_EVERY = 0.002


@frozen
class Loudness:
    """How loud a sink or a stream is."""

    volume: float  # of its loudest channel; 1 is 100 %, and more is possible
    muted: bool
    #: of a sink: whether the volumes of its streams are those that are heard, and its own only the loudest of them
    flat: bool = False


class PulsePlayer(Player):
    """The stream of one sentence, over a connection of its own."""

    name = "pulse"
    real_time = True

    def __init__(self, rate: int, device: str | None = None, audible: bool = False) -> None:
        """Connect; CannotSpeak (no_player) where no server answers.

        `device`: a sink's name, None for the server's choice. `audible`: it fails (muted) where it is muted.
        """
        self.proven = False
        #: the sink's name; None until the stream is there
        self.device: str | None = None
        self._rate = rate
        self._wanted = device
        self._audible = audible
        self._written = self._heard = 0
        #: the seconds of the stream that were heard, as the server told last, and when; None before there are any
        self._told: tuple[float, float] | None = None
        #: what was written when the server ran dry; None while it plays
        self._dry_at: int | None = None
        #: when it is asked for the time, as long as it hasn't told any; None while a question is not answered
        self._ask_at: float | None = 0.0
        self._closed = self._draining = self._drained = False
        self._failed: CannotSpeak | None = None
        self._stream: int | None = None
        self._index = libpulse.NONE
        #: until when a volume of 0 means nothing
        self._settled_at = 0.0
        self._ready_by = time.monotonic() + READY_WITHIN
        self._suspended_at: float | None = None
        #: questions about the stream that are not answered
        self._asked = 0
        self._of_sink: Loudness | None = None
        self._of_stream: Loudness | None = None
        #: whether it was muted at any time, and whether the server won't say how loud it is
        self._muted = self._untold = False
        try:
            self._lib = libpulse.load()
        except OSError as error:
            raise CannotSpeak(Reason.NO_PLAYER, f"libpulse cannot be loaded: {error}") from error
        self._on_started = libpulse.Notice(self._started)
        self._on_dry = libpulse.Notice(self._ran_dry)
        self._on_time = libpulse.Notice(self._time_told)
        self._on_drained = libpulse.Success(self._drain_over)
        self._on_change = libpulse.Changed(self._changed)
        self._on_sink = libpulse.SinkTold(self._sink_told)
        self._on_stream = libpulse.SinkInputTold(self._stream_told)
        self._loop: libpulse.Loop | None = libpulse.Loop(self._lib)
        self._context = self._lib.context_new(self._loop.api, b"talk")
        if self._context is None:
            self._loop.free()
            raise CannotSpeak(Reason.NO_PLAYER, "libpulse makes no connection: is there enough memory?")
        self._lib.context_connect(self._context, None, libpulse.NO_AUTOSPAWN, None)  # its state tells how that went
        self._go_on()
        if self._failed is not None:
            self.kill()
            raise self._failed

    # -- as every player

    def offer(self, data: memoryview) -> int:
        """Write what the server has room for."""
        self._check()
        length = min(len(data), self._room())
        if length == 0:
            return 0
        if self._lib.stream_write(self._stream, bytes(data[:length]), length, None, 0, 0) < 0:
            self._fail(Reason.AUDIO_LOST)
            self._check()
        self._written += length
        self._go_on()
        return length

    def consumed(self) -> int:
        """Return what is heard by the server's own clock."""
        self.heard()
        return self._heard

    def heard(self) -> float | None:
        """Return the seconds of its stream that are heard by now."""
        if self._drained:
            self._heard = self._written
        elif self._told is not None:
            seconds, at = self._told
            heard = int((seconds + time.monotonic() - at) * self._rate) * SAMPLE_BYTES
            self._heard = max(self._heard, min(heard, self._written if self._dry_at is None else self._dry_at))
        return self._heard / (self._rate * SAMPLE_BYTES)

    def close(self) -> None:
        """Have what was written played to its end."""
        self._closed = True
        self._check()

    def ended(self) -> bool:
        """Return True when the server has played all of it."""
        self._check()
        return self._drained

    def interests(self) -> list[Interest]:
        """Return what libpulse waits for."""
        return self._loop.interests if self._loop is not None else []

    def wake_at(self) -> float | None:
        """Return when libpulse has something to do, or a suspended sink is given up.

        At once where there is room, and where the server has told the time in here: words are due by that.
        """
        told = self._told
        self._go_on()
        if self._failed is not None or self._drained or self._told is not told or self._room():
            return 0.0
        moments = [self._loop.due if self._loop is not None else None]
        if self._index == libpulse.NONE:
            moments.append(self._ready_by)
        if self._suspended_at is not None:
            moments.append(self._suspended_at + SUSPENDED_FOR)
        if self._is_settling():
            moments.append(self._settled_at)
        if self.proven and self._told is None:
            moments.append(self._ask_at)
        return min((moment for moment in moments if moment is not None), default=None)

    def kill(self) -> None:
        """Close the connection: the server drops the stream with it, and what it held."""
        if self._loop is None:
            return
        self._lib.context_disconnect(self._context)
        if self._stream is not None:
            self._lib.stream_unref(self._stream)
        self._lib.context_unref(self._context)
        self._loop.free()
        self._loop = self._stream = None
        self._failed = self._failed or CannotSpeak(Reason.AUDIO_LOST, "the stream was ended")

    def gone(self) -> bool:
        """Return True once the connection is closed."""
        return self._loop is None

    # -- what the server says

    @property
    def output(self) -> Output | None:
        """Where the sound goes, and how loud; None until it is known."""
        sink, stream = self._of_sink, self._of_stream
        if self.device is None or sink is None or stream is None or self._is_settling():
            return None
        # Where volumes are flat, the stream's is that of the device already (PulseAudio's flat-volumes).
        volume = stream.volume if sink.flat else sink.volume * stream.volume
        return Output(self.name, self.device, round(min(1.0, volume), 2), self._muted)

    def _check(self) -> None:
        """Take in what the server has said; CannotSpeak if that means the end."""
        self._go_on()
        if self._failed is not None and not self._drained:
            raise self._failed

    def _go_on(self) -> None:
        """Let libpulse do all that it has to do, and what its states ask for."""
        while self._loop is not None and (self._loop.turn() or self._advance()):
            pass

    def _advance(self) -> bool:
        """Take the next step of the stream's life; return whether libpulse may have something to do for it."""
        if self._failed is not None or self._drained:
            return False
        state = self._lib.context_get_state(self._context)
        if state in (libpulse.CONTEXT_FAILED, libpulse.CONTEXT_TERMINATED):
            self._fail(Reason.AUDIO_DEVICE if self._written == 0 else Reason.AUDIO_LOST)
            return False
        if self._index == libpulse.NONE and time.monotonic() >= self._ready_by:
            self._failed = CannotSpeak(
                Reason.AUDIO_DEVICE, f"the sound server does not answer within {READY_WITHIN:g} s"
            )
            return False
        if self._stream is None:
            return state == libpulse.CONTEXT_READY and self._open()
        state = self._lib.stream_get_state(self._stream)
        if state in (libpulse.STREAM_FAILED, libpulse.STREAM_TERMINATED):
            self._fail(Reason.AUDIO_DEVICE if self._written == 0 else Reason.AUDIO_LOST)
        elif state == libpulse.STREAM_READY:
            asked = self._look_at_sink() or self._ask_time()
            return asked or (self._closed and not self._draining and self._failed is None and self._drain())
        return False

    def _open(self) -> bool:
        held, asked = (each * self._rate // 1000 * SAMPLE_BYTES for each in (BUFFER_MS, REQUEST_MS))
        sizes = libpulse.BufferSizes(2 * held, held, held, asked, libpulse.NONE)
        spec = libpulse.SampleSpec(libpulse.S16LE, self._rate, 1)
        self._stream = self._lib.stream_new(self._context, b"talk", byref(spec), None)
        if self._stream is None:
            self._fail(Reason.AUDIO_DEVICE)
            return False
        self._lib.stream_set_started_callback(self._stream, self._on_started, None)
        self._lib.stream_set_underflow_callback(self._stream, self._on_dry, None)
        self._lib.stream_set_latency_update_callback(self._stream, self._on_time, None)
        flags = libpulse.ADJUST_LATENCY | libpulse.AUTO_TIMING_UPDATE
        wanted = None if self._wanted is None else self._wanted.encode()
        if self._lib.stream_connect_playback(self._stream, wanted, byref(sizes), flags, None, None) < 0:
            self._fail(Reason.AUDIO_DEVICE)
        return True

    def _look_at_sink(self) -> bool:
        """See which sink it is by now, and whether that takes sound; return whether the server was asked anything."""
        index = int(self._lib.stream_get_device_index(self._stream))
        asks = index != self._index
        if asks:
            begins, self._index = self._index == libpulse.NONE, index
            self._settled_at = time.monotonic() + SETTLED_AFTER if begins else self._settled_at
            self.device = (self._lib.stream_get_device_name(self._stream) or b"").decode("utf-8", "replace")
            if self.device == DUMMY_SINK != self._wanted:
                self._failed = _dummy(begins)
            self._ask_sink()
            if begins:
                self._lib.context_set_subscribe_callback(self._context, self._on_change, None)
                mask = libpulse.ABOUT_SINKS | libpulse.ABOUT_SINK_INPUTS
                self._begin(self._lib.context_subscribe(self._context, mask, None, None))
                self._ask_stream()
        self._judge()
        if not self._lib.stream_is_suspended(self._stream):
            if self._suspended_at is not None:
                self._suspended_at = None
                self._begin_time()
            return asks
        now = time.monotonic()
        self._suspended_at = self._suspended_at or now
        if now >= self._suspended_at + SUSPENDED_FOR:
            self._failed = CannotSpeak(Reason.AUDIO_STALLED, f"the sound server has suspended {self.device}")
        return asks

    def _ask_time(self) -> bool:
        """Ask whether it is heard by now; return whether it was time for that."""
        if not self.proven or self._told or self._ask_at is None or time.monotonic() < self._ask_at:
            return False
        self._ask_at = None
        self._begin(self._lib.stream_update_timing_info(self._stream, None, None))
        return True

    def _ask_sink(self) -> None:
        self._begin(self._lib.context_get_sink_info_by_index(self._context, self._index, self._on_sink, None))

    def _ask_stream(self) -> None:
        self._asked += 1
        number = self._lib.stream_get_index(self._stream)
        self._begin(self._lib.context_get_sink_input_info(self._context, number, self._on_stream, None))

    def _begin(self, operation: int | None) -> None:
        """Let an operation go on; where it can't begin, the context has failed, and says so."""
        if operation is not None:
            self._lib.operation_unref(operation)

    def _changed(self, _context: int, event: int, index: int, _data: object) -> None:
        """Ask how loud it is where that may have changed."""
        what = event & libpulse.FACILITY
        if what == libpulse.OF_SINK and index == self._index:
            self._ask_sink()
        elif what == libpulse.OF_SINK_INPUT and index == self._lib.stream_get_index(self._stream):
            self._ask_stream()

    def _sink_told(self, _context: int, found: Any, over: int, _data: object) -> None:
        if over == 0 and found[0].index == self._index:  # else it is of a sink that it has left
            flat = bool(found[0].flags & libpulse.FLAT_VOLUME)
            self._of_sink = Loudness(libpulse.loudness(found[0].volume), bool(found[0].mute), flat)
            self._judge()
        elif over < 0:
            self._untold = True

    def _stream_told(self, _context: int, found: Any, over: int, _data: object) -> None:
        self._asked -= over != 0
        if over == 0:
            self._of_stream = Loudness(libpulse.loudness(found[0].volume), bool(found[0].mute))
            self._judge()
        elif over < 0:
            self._untold = True

    def _is_settling(self) -> bool:
        """Whether the stream's volume is still to be set."""
        stream = self._of_stream
        if stream is None or stream.volume > 0 or stream.muted or self._drained:
            return False
        return self._asked > 0 or time.monotonic() < self._settled_at

    def _judge(self) -> None:
        """Take note of whether it is muted now, for good: what was not heard doesn't become so later."""
        told = [each for each in (self._of_sink, self._of_stream) if each is not None]
        if self._drained or self._is_settling() or not any(each.muted or each.volume == 0 for each in told):
            return
        self._muted = True
        if self._audible and self._failed is None:
            self._failed = CannotSpeak(Reason.MUTED, f"the output is muted: {self.device}", final=True)

    def _drain(self) -> bool:
        operation = self._lib.stream_drain(self._stream, self._on_drained, None)
        if operation is None:
            self._fail(Reason.AUDIO_LOST)
            return False
        self._draining = True
        self._lib.operation_unref(operation)
        return True

    def _room(self) -> int:
        """Return how many bytes the server has room for, in whole samples."""
        if self._index == libpulse.NONE or self._closed or self._failed is not None:
            return 0
        if self._audible and not (self._untold or self.output):
            return 0  # for less than 1 ms
        room = self._lib.stream_writable_size(self._stream)
        return 0 if room == libpulse.FAILED else room // SAMPLE_BYTES * SAMPLE_BYTES

    def _started(self, *_: Any) -> None:
        self.proven, self._dry_at = True, None
        self._begin_time()

    def _ran_dry(self, *_: Any) -> None:
        self._dry_at = self._written

    def _begin_time(self) -> None:
        """Ask for the time anew: it stood still, as the stream had not begun, or had run dry, or its sink slept."""
        self._told, self._ask_at = None, 0.0

    def _time_told(self, *_: Any) -> None:
        told, now = c_uint64(), time.monotonic()
        self._ask_at = now + ASK_EVERY
        # Before it has begun, what is told is the time that the answer took.
        if self.proven and self._lib.stream_get_time(self._stream, byref(told)) == 0 and told.value:
            self._told = told.value / 1_000_000, now

    def _drain_over(self, _stream: int, success: int, _data: object) -> None:
        if success:
            self._look_at_sink()  # it may have been moved in the same moment
            self._settled_at = 0.0
            self._judge()
            self._drained = self.proven = self._failed is None
        else:
            self._fail(Reason.AUDIO_LOST)

    def _fail(self, reason: Reason) -> None:
        """Take note that it has failed, for the reason that libpulse knows."""
        if self._failed is not None:
            return
        number = self._lib.context_errno(self._context)
        words = self._lib.strerror(number).decode("utf-8", "replace")
        if self._stream is None and number in (libpulse.CONNECTION_REFUSED, libpulse.INVALID_SERVER):
            self._failed = CannotSpeak(Reason.NO_PLAYER, f"no sound server answers: {words}")
        elif self._stream is None:
            self._failed = CannotSpeak(reason, f"the sound server lets nobody in: {words}")
        elif self._index != libpulse.NONE:  # the number may be of a question about a sink that is gone
            self._failed = CannotSpeak(reason, "the sound server ended the stream")
        elif number == libpulse.NO_ENTITY and self._wanted is not None:
            self._failed = CannotSpeak(
                reason, f'the sound server has no sink "{self._wanted}": see pactl list short sinks'
            )
        elif number == libpulse.NO_ENTITY:
            self._failed = CannotSpeak(reason, "the sound server has no output")
        else:
            self._failed = CannotSpeak(reason, f"the sound server ended the stream: {words}")


def _dummy(begins: bool) -> CannotSpeak:
    """Return what is wrong where nobody can hear the stream (any more), and no other player would be heard."""
    if begins:
        return CannotSpeak(Reason.AUDIO_DEVICE, "the sound server has only a dummy output", final=True)
    return CannotSpeak(Reason.AUDIO_LOST, "the sound server has only a dummy output left", final=True)
