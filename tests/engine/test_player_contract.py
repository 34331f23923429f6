"""Tests that every player behaves as `players.base.Player` promises.

To test a new player, add it to `PLAYERS`.
"""

from __future__ import annotations

import os
import select
import socket
import subprocess
import threading
import time
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pytest

from talkcli.engine.child.players.base import CannotSpeak
from talkcli.engine.child.players.builtin import NullPlayer, WavPlayer, WavStreamPlayer
from talkcli.engine.child.players.program import ProgramPlayer
from talkcli.engine.child.players.pulse import PulsePlayer
from talkcli.engine.players import PIECE_S, SAMPLE_BYTES, PlayerCommand
from talkcli.polling import NEVER
from tests.engine.process import PATIENCE
from tests.support.processes import children
from tests.support.surroundings import short_directory
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    import numpy.typing as npt

    from talkcli.engine.child.players.base import Player
    from tests.support.sink import Sink

RATE = 22050
_PIECE = int(PIECE_S * RATE) * SAMPLE_BYTES
#: A quarter of a second of sound, in which every sample differs.
SOUND = b"".join(number.to_bytes(2, "little") for number in range(RATE // 4))
#: If a tape ends with this number of silent samples (0.1 s), everything has been played.
SETTLED = RATE // 10
#: Seconds within which any call returns, because no call blocks.
AT_ONCE = 0.05
#: The most waits during a sound, or for its end: a few per piece.
MOST_WAITS = 4 * len(SOUND) // _PIECE


@dataclass(frozen=True)
class Case:
    """Functions that open a player in various states. They get a folder for the player's files."""

    #: opens a player that plays
    opens: Callable[[Path], Player]
    #: returns the samples played so far; None if they can't be read
    played: Callable[[Path], bytes] | None = None
    #: opens a player that loses its device in mid-sentence; None if that can't happen
    lost: Callable[[Path], Player] | None = None
    #: opens a player whose device doesn't exist; None if that can't happen
    refused: Callable[[Path], Player] | None = None
    #: opens a player that accepts no more samples after a while; None if that can't happen
    stuck: Callable[[Path], Player] | None = None


def _program(*argv: str) -> ProgramPlayer:
    return ProgramPlayer(PlayerCommand("tape", argv, read_ahead=0))


def _stream(folder: Path) -> WavStreamPlayer:
    """Return a player that writes to an open file, as if a shell had opened it."""
    output = os.open(folder / "stream.wav", os.O_WRONLY | os.O_CREAT)
    _opened.callback(os.close, output)
    return WavStreamPlayer(output, RATE, first=True)


def _pipe(*, reader: bool) -> WavStreamPlayer:
    reading, writing = os.pipe()
    _opened.callback(os.close, writing)
    if reader:
        _opened.callback(os.close, reading)
    else:
        os.close(reading)
    return WavStreamPlayer(writing, RATE, first=True)


def _full_disk(folder: Path) -> WavPlayer:
    """Return a player whose open file has been replaced by a full device."""
    player = WavPlayer(str(folder / "speech.wav"), RATE)
    full = os.open("/dev/full", os.O_RDWR)
    assert player._file is not None
    os.dup2(full, player._file)
    os.close(full)
    return player


def _not_wav(folder: Path) -> WavPlayer:
    """Try to open a player for a file that isn't a WAV file."""
    (folder / "speech.wav").write_text("dear diary")
    return WavPlayer(str(folder / "speech.wav"), RATE)


def _after_the_header(path: Path) -> bytes:
    return path.read_bytes()[44:] if path.exists() else b""


def _pulse(folder: Path) -> PulsePlayer:
    """Return a player at a sink that plays into a pipe. The samples are recorded on a tape."""
    pipe = folder / "pipe"
    os.mkfifo(pipe)
    options = [f"file={pipe}", f"rate={RATE}", "channels=1", "format=s16le", "use_system_clock_for_timing=yes"]
    module = _sinks[0].pactl("load-module", "module-pipe-sink", "sink_name=pipe", *options).strip()
    _opened.callback(_sinks[0].pactl, "unload-module", module)
    with open(folder / "tape", "wb") as tape:
        reader = subprocess.Popen(["cat", pipe], stdout=tape)
    _opened.callback(reader.wait)
    _opened.callback(reader.kill)
    return PulsePlayer(RATE, "pipe")


def _taped(folder: Path) -> bytes:
    """Return the samples that the sink has played, without silence.

    The sink continues with zeros, so the sound is complete once the tape ends with zeros.
    """
    end = time.monotonic() + PATIENCE
    while not len(samples := _read_tape(folder / "tape")) or np.any(samples[-SETTLED:]):
        assert time.monotonic() < end, "the sink doesn't continue with zeros"
        time.sleep(0.005)  # no event reports new samples
    played = samples[samples != 0].tobytes()  # only the first sample of the sound is zero
    return SOUND[:2] + played if played else b""


def _read_tape(tape: Path) -> npt.NDArray[np.int16]:
    return np.frombuffer(tape.read_bytes()[: tape.stat().st_size // SAMPLE_BYTES * SAMPLE_BYTES], "<i2")


def _listen() -> socket.socket:
    """Return a listening socket, which is the sound server of the next player."""
    folder = _opened.enter_context(short_directory())
    listening = _opened.enter_context(socket.socket(socket.AF_UNIX))
    listening.bind(f"{folder}/s")
    listening.listen()
    os.environ["PULSE_SERVER"] = f"unix:{folder}/s"
    return listening


def _cut_off(_: Path) -> PulsePlayer:
    """Return a player whose connection to the sound server breaks once it has a stream."""
    listening = _listen()
    player = PulsePlayer(RATE)
    with listening.accept()[0] as connection:
        accepted = f"FD:{connection.fileno()}"
        relay = subprocess.Popen(
            ["socat", accepted, f"UNIX-CONNECT:{_sinks[0].socket}"], pass_fds=[connection.fileno()]
        )
    try:
        while player.device is None:
            _await(player)
    finally:
        relay.kill()
        relay.wait()
    return player


def _without_server(folder: Path) -> PulsePlayer:
    os.environ["PULSE_SERVER"] = f"unix:{folder}/none"
    return PulsePlayer(RATE)


def _with_silent_server(_: Path) -> PulsePlayer:
    """Return a player whose server accepts connections, but never replies."""
    _listen()
    return PulsePlayer(RATE)


class StoppedClock(NullPlayer):
    """A silent player whose clock doesn't advance."""

    _clock = staticmethod(lambda: 100.0)


PLAYERS = {
    "the sound server": Case(_pulse, played=_taped, lost=_cut_off, refused=_without_server, stuck=_with_silent_server),
    "null": Case(lambda _: NullPlayer(RATE), stuck=lambda _: StoppedClock(RATE)),
    "a program": Case(
        lambda folder: _program("tee", str(folder / "tape")),
        played=lambda folder: (folder / "tape").read_bytes() if (folder / "tape").exists() else b"",
        lost=lambda _: _program("sh", "-c", "exec <&-; sleep 100"),  # closes its input without reading it
        refused=lambda _: _program("no-such-player-anywhere"),
        stuck=lambda _: _program("sleep", "100"),
    ),
    "a WAV file": Case(
        lambda folder: WavPlayer(str(folder / "speech.wav"), RATE),
        played=lambda folder: _after_the_header(folder / "speech.wav"),
        lost=_full_disk,
        refused=_not_wav,
    ),
    "a WAV stream": Case(
        _stream,
        played=lambda folder: _after_the_header(folder / "stream.wav"),
        lost=lambda _: _pipe(reader=False),
        stuck=lambda _: _pipe(reader=True),
    ),
}
#: Closes everything that the current test has opened itself.
_opened = ExitStack()
#: The sound server of the current test.
_sinks: list[Sink] = []

every_player = pytest.mark.parametrize("case", PLAYERS.values(), ids=PLAYERS)


def every_player_with(condition: str) -> pytest.MarkDecorator:
    """Run the test for all players that have a function for this condition."""
    cases = {name: case for name, case in PLAYERS.items() if getattr(case, condition) is not None}
    return pytest.mark.parametrize("case", cases.values(), ids=cases)


@pytest.fixture(autouse=True)
def no_leaks(sink: Sink, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Assert after each test that its players have left no descriptor, process or thread."""
    for name, value in sink.env.items():
        monkeypatch.setenv(name, value)
    _sinks[:] = [sink]
    before = _resources()
    with _opened:
        yield
    assert _resources() == before


def _resources() -> tuple[list[str], list[int], int]:
    return os.listdir("/proc/self/fd"), children(os.getpid()), threading.active_count()


@contextmanager
def _quick(call: str) -> Iterator[None]:
    started_at = time.monotonic()
    yield
    assert_within(time.monotonic() - started_at, AT_ONCE, call)


def _await(player: Player) -> None:
    """Wait only for the player's interests, as the playback does."""
    poll = select.poll()
    for descriptor, events in player.interests():
        poll.register(descriptor, events)
    until = player.wake_at()
    assert until != NEVER or player.interests(), "the wait would never end"
    end = time.monotonic() + PATIENCE
    seconds = min(PATIENCE, until - time.monotonic())
    poll.poll(max(0.0, seconds) * 1000)
    assert time.monotonic() < end, "nothing has ended the wait"


def _offer(player: Player, sound: bytes | bytearray) -> None:
    """Offer all pieces of a sound, and wait for room if necessary."""
    sent = waits = 0
    while sent < len(sound):
        with memoryview(sound)[sent : sent + _PIECE] as piece:
            taken = player.offer(piece)
            assert 0 <= taken <= len(piece)
        sent += taken
        player.consumed()
        if not taken:
            _await(player)
            waits += 1
            assert waits < MOST_WAITS, "waits end without a reason"


def _finish(player: Player) -> None:
    """Close the player, and wait until it has ended."""
    player.close()
    waits = 0
    while not player.ended():
        _await(player)
        waits += 1
        assert waits < MOST_WAITS, "waits end without a reason, or the player doesn't end"


def _fill(player: Player) -> int:
    """Offer pieces until no more are accepted, and return the number of accepted bytes."""
    sent = 0
    while taken := player.offer(memoryview(bytes(_PIECE))):
        sent += taken
        assert sent < 10 * RATE * SAMPLE_BYTES, "the player is never full"
    return sent


def _kill(player: Player) -> None:
    player.kill()
    end = time.monotonic() + PATIENCE
    while not player.gone():
        assert time.monotonic() < end, "the player has not ended"
        time.sleep(0.001)  # the playback also calls `gone` repeatedly
    player.kill()
    assert player.gone()


def _play_forever(player: Player) -> None:
    waits = 0
    while not player.ended():
        if not player.offer(memoryview(bytes(_PIECE))):
            _await(player)
            waits += 1
            assert waits < MOST_WAITS, "waits end without a reason"
        player.consumed()


# -- opening


@every_player_with("refused")
def test_opening_an_unavailable_player_raises_an_error_with_a_reason(case: Case, tmp_path: Path) -> None:
    assert case.refused is not None
    with pytest.raises(CannotSpeak) as caught:
        case.refused(tmp_path)
    assert caught.value.reason in {"no_player", "audio_device"}
    assert str(caught.value)


# -- playing


@every_player
def test_a_sound_is_played_completely_in_order_and_once(case: Case, tmp_path: Path) -> None:
    """The name stays the same, offered buffers may be overwritten, and `consumed` grows to the length of the sound."""
    player = case.opens(tmp_path)
    before = (player.name, player.real_time)
    assert isinstance(player.name, str)
    assert player.name
    assert isinstance(player.real_time, bool)
    assert not player.ended()
    progress = [(player.consumed(), player.proven)]
    for start in range(0, len(SOUND), _PIECE):
        piece = bytearray(SOUND[start : start + _PIECE])
        _offer(player, piece)
        progress.append((player.consumed(), player.proven))
        assert progress[-1][0] <= start + len(piece)
        piece[:] = b"\xff" * len(piece)
        piece.clear()  # raises BufferError if the player still has a view of it
    assert not player.ended()
    _finish(player)
    assert player.ended()
    progress.append((player.consumed(), player.proven))
    assert progress == sorted(progress)
    assert progress[-1] == (len(SOUND), True)
    assert before == (player.name, player.real_time)
    if case.played is not None:
        assert case.played(tmp_path) == SOUND
    _kill(player)
    if case.played is not None:
        assert case.played(tmp_path) == SOUND


@every_player
def test_a_player_without_samples_ends_without_an_error(case: Case, tmp_path: Path) -> None:
    player = case.opens(tmp_path)
    _finish(player)
    assert player.consumed() == 0
    _kill(player)


def test_the_null_player_takes_as_long_as_its_sound() -> None:
    """Other players take as long as the device. `conformance/test_heard_speaking.py` tests this at a sink."""
    player = NullPlayer(RATE)
    started_at = time.monotonic()
    _offer(player, SOUND[: len(SOUND) // 2])
    while player.consumed() / SAMPLE_BYTES / RATE > time.monotonic() - started_at:
        time.sleep(0.005)  # no event reports that the player has no samples left
    time.sleep(0.1)
    _offer(player, SOUND[len(SOUND) // 2 :])
    _finish(player)
    assert time.monotonic() - started_at >= len(SOUND) / SAMPLE_BYTES / RATE + 0.1
    _kill(player)


# -- waiting


@every_player
@limits()
def test_no_call_blocks_and_a_stuck_player_never_ends(case: Case, tmp_path: Path) -> None:
    with _quick("the constructor"):
        player = (case.stuck or case.opens)(tmp_path)
    sent = _fill(player) if case.stuck is not None else 0
    with _quick("offer"):
        sent += player.offer(memoryview(bytes(_PIECE)))
    assert player.consumed() <= sent
    assert not player.ended()
    for method in (player.consumed, player.interests, player.wake_at, player.ended, player.close, player.ended):
        with _quick(method.__name__):
            method()
    with _quick("kill"):
        player.kill()
    with _quick("gone"):
        player.gone()
    _kill(player)


@every_player
def test_a_player_waits_only_for_open_descriptors_and_for_room(case: Case, tmp_path: Path) -> None:
    player = case.opens(tmp_path)
    _offer(player, SOUND[:_PIECE])
    interests = player.interests()
    player.close()
    for _, events in (*interests, *player.interests()):
        assert events == select.POLLOUT or not events & select.POLLOUT
    for descriptor, _ in player.interests():
        os.fstat(descriptor)
    _kill(player)


# -- ending


@pytest.mark.parametrize("when", ["unused", "in the middle", "after close", "after its end"])
@every_player
def test_a_player_can_be_killed_at_any_point_and_plays_only_what_it_took(case: Case, tmp_path: Path, when: str) -> None:
    player = case.opens(tmp_path)
    sound = b"" if when == "unused" else SOUND[: 3 * _PIECE]
    _offer(player, sound)
    if when == "after close":
        player.close()
    if when == "after its end":
        _finish(player)
    _kill(player)
    if case.played is not None:
        assert sound.startswith(case.played(tmp_path))


# -- failing


@every_player_with("lost")
def test_a_player_that_lost_its_device_raises_an_error_each_time(case: Case, tmp_path: Path) -> None:
    assert case.lost is not None
    player = case.lost(tmp_path)
    for _ in range(2):
        with pytest.raises(CannotSpeak) as caught:
            _play_forever(player)
        assert caught.value.reason in {"audio_device", "audio_lost"}
        assert str(caught.value)
    _kill(player)
