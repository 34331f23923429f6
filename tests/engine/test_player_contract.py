"""The contract of players: each sentence of `players.base.Player`, for each player.

A new player is put through it by a row of `PLAYERS`.
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
from tests.engine.spawned import PATIENCE
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
#: A quarter of a second, of which no two pieces are alike.
SOUND = b"".join(number.to_bytes(2, "little") for number in range(RATE // 4))
#: Samples of silence before which a tape has all that was played: 0.1 s.
SETTLED = RATE // 10
#: Seconds within which any call returns: nothing waits in them.
AT_ONCE = 0.05
#: Waits in a sound, or for its end, at most: a few per piece.
MOST_WAITS = 4 * len(SOUND) // _PIECE


@dataclass(frozen=True)
class Case:
    """A player, and how to bring about parts of the contract; `at`: a folder for its files."""

    #: opens one that plays
    opens: Callable[[Path], Player]
    #: what it has played so far; None if nobody can know
    played: Callable[[Path], bytes] | None = None
    #: opens one whose device is lost in mid-sentence, and one whose device isn't there; None if nothing can fail
    lost: Callable[[Path], Player] | None = None
    refused: Callable[[Path], Player] | None = None
    #: opens one that takes no more after a while; None if it takes all
    stuck: Callable[[Path], Player] | None = None


def _program(*argv: str) -> ProgramPlayer:
    return ProgramPlayer(PlayerCommand("tape", argv, read_ahead=0))


def _stream(at: Path) -> WavStreamPlayer:
    """Return a player that writes to a file that a shell would have opened."""
    output = os.open(at / "stream.wav", os.O_WRONLY | os.O_CREAT)
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


def _full_disk(at: Path) -> WavPlayer:
    """Return one whose file has become a full device meanwhile."""
    player = WavPlayer(str(at / "speech.wav"), RATE)
    full = os.open("/dev/full", os.O_RDWR)
    assert player._file is not None
    os.dup2(full, player._file)
    os.close(full)
    return player


def _no_wav(at: Path) -> WavPlayer:
    """Return one for a file that is there, and is something else."""
    (at / "speech.wav").write_text("dear diary")
    return WavPlayer(str(at / "speech.wav"), RATE)


def _behind_a_header(path: Path) -> bytes:
    return path.read_bytes()[44:] if path.exists() else b""


def _pulse(at: Path) -> PulsePlayer:
    """Return a player at a sink that plays into a pipe, whose samples are written to a tape."""
    os.mkfifo(at / "pipe")
    options = [f"file={at / 'pipe'}", f"rate={RATE}", "channels=1", "format=s16le", "use_system_clock_for_timing=yes"]
    module = _sinks[0].pactl("load-module", "module-pipe-sink", "sink_name=pipe", *options).strip()
    _opened.callback(_sinks[0].pactl, "unload-module", module)
    with open(at / "tape", "wb") as tape:
        reader = subprocess.Popen(["cat", at / "pipe"], stdout=tape)
    _opened.callback(reader.wait)
    _opened.callback(reader.kill)
    return PulsePlayer(RATE, "pipe")


def _taped(at: Path) -> bytes:
    """Return the samples that such a sink has played, without silence.

    The sink goes on with zeros: what stands before them on the tape is all there is.
    """
    end = time.monotonic() + PATIENCE
    while not len(samples := _on(at / "tape")) or np.any(samples[-SETTLED:]):
        assert time.monotonic() < end, "the sink stands still"
        time.sleep(0.005)  # what another process writes is no event
    found = samples[samples != 0].tobytes()  # of the sound only the first sample is zero
    return SOUND[:2] + found if found else b""


def _on(tape: Path) -> npt.NDArray[np.int16]:
    return np.frombuffer(tape.read_bytes()[: tape.stat().st_size // SAMPLE_BYTES * SAMPLE_BYTES], "<i2")


def _cut_off(_: Path) -> PulsePlayer:
    """Return one whose connection to the sound server breaks as soon as its stream is there."""
    folder = _opened.enter_context(short_directory())
    relay = subprocess.Popen(["socat", f"UNIX-LISTEN:{folder}/s", f"UNIX-CONNECT:{_sinks[0].socket}"])
    try:
        while not os.path.exists(f"{folder}/s"):
            time.sleep(0.005)  # it says nowhere when it begins to listen
        os.environ["PULSE_SERVER"] = f"unix:{folder}/s"
        player = PulsePlayer(RATE)
        while player.device is None:
            _await(player)
    finally:
        relay.kill()
        relay.wait()
    return player


def _without_server(at: Path) -> PulsePlayer:
    os.environ["PULSE_SERVER"] = f"unix:{at}/none"
    return PulsePlayer(RATE)


def _with_silent_server(_: Path) -> PulsePlayer:
    """Return one whose server takes clients, and says nothing."""
    folder = _opened.enter_context(short_directory())
    listening = _opened.enter_context(socket.socket(socket.AF_UNIX))
    listening.bind(f"{folder}/s")
    listening.listen()
    os.environ["PULSE_SERVER"] = f"unix:{folder}/s"
    return PulsePlayer(RATE)


class StoppedClock(NullPlayer):
    """A silent player whose time stands still."""

    _clock = staticmethod(lambda: 100.0)


PLAYERS = {
    "the sound server": Case(_pulse, played=_taped, lost=_cut_off, refused=_without_server, stuck=_with_silent_server),
    "null": Case(lambda _: NullPlayer(RATE), stuck=lambda _: StoppedClock(RATE)),
    "a program": Case(
        lambda at: _program("tee", str(at / "tape")),
        played=lambda at: (at / "tape").read_bytes() if (at / "tape").exists() else b"",
        lost=lambda _: _program("sh", "-c", "exec <&-; sleep 100"),  # what waits for it then is never read
        refused=lambda _: _program("no-such-player-anywhere"),
        stuck=lambda _: _program("sleep", "100"),
    ),
    "a WAV file": Case(
        lambda at: WavPlayer(str(at / "speech.wav"), RATE),
        played=lambda at: _behind_a_header(at / "speech.wav"),
        lost=_full_disk,
        refused=_no_wav,
    ),
    "a WAV stream": Case(
        _stream,
        played=lambda at: _behind_a_header(at / "stream.wav"),
        lost=lambda _: _pipe(reader=False),
        stuck=lambda _: _pipe(reader=True),
    ),
}
#: The things that a test has opened itself, closed after it.
_opened = ExitStack()
#: The sound server of the test that runs.
_sinks: list[Sink] = []

every = pytest.mark.parametrize("case", PLAYERS.values(), ids=PLAYERS)


def those(what: str) -> pytest.MarkDecorator:
    """Have the test done with those players that have this."""
    found = {name: case for name, case in PLAYERS.items() if getattr(case, what) is not None}
    return pytest.mark.parametrize("case", found.values(), ids=found)


@pytest.fixture(autouse=True)
def nothing_left(sink: Sink, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Assert after each test that its players have left nothing open, and nothing that runs."""
    for name, value in sink.env.items():
        monkeypatch.setenv(name, value)
    _sinks[:] = [sink]
    before = _left()
    with _opened:
        yield
    assert _left() == before


def _left() -> tuple[list[str], list[int], int]:
    return os.listdir("/proc/self/fd"), children(os.getpid()), threading.active_count()


@contextmanager
def _quick(what: str) -> Iterator[None]:
    began = time.monotonic()
    yield
    assert_within(time.monotonic() - began, AT_ONCE, what)


def _await(player: Player) -> None:
    """Wait as the playback does: for the player's interests and nothing else."""
    poll = select.poll()
    for descriptor, events in player.interests():
        poll.register(descriptor, events)
    until = player.wake_at()
    assert until != NEVER or player.interests(), "nothing would ever wake it"
    end = time.monotonic() + PATIENCE
    seconds = min(PATIENCE, until - time.monotonic())
    poll.poll(max(0.0, seconds) * 1000)
    assert time.monotonic() < end, "nothing has woken it"


def _offer(player: Player, sound: bytes | bytearray) -> None:
    """Offer all pieces of a sound, waiting for room."""
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
            assert waits < MOST_WAITS, "it is woken for nothing"


def _finish(player: Player) -> None:
    """Play to the end."""
    player.close()
    waits = 0
    while not player.ended():
        _await(player)
        waits += 1
        assert waits < MOST_WAITS, "it is woken for nothing, or does not end"


def _fill(player: Player) -> int:
    """Offer pieces until none is taken any more; return the bytes taken."""
    sent = 0
    while taken := player.offer(memoryview(bytes(_PIECE))):
        sent += taken
        assert sent < 10 * RATE * SAMPLE_BYTES, "it is never full"
    return sent


def _end(player: Player) -> None:
    player.kill()
    end = time.monotonic() + PATIENCE
    while not player.gone():
        assert time.monotonic() < end, "it has not ended"
        time.sleep(0.001)  # as the playback asks again and again
    player.kill()
    assert player.gone()


def _play_for_ever(player: Player) -> None:
    waits = 0
    while not player.ended():
        if not player.offer(memoryview(bytes(_PIECE))):
            _await(player)
            waits += 1
            assert waits < MOST_WAITS, "it is woken for nothing"
        player.consumed()


# -- opening


@those("refused")
def test_a_player_that_cannot_be_opened_says_so(case: Case, tmp_path: Path) -> None:
    assert case.refused is not None
    with pytest.raises(CannotSpeak) as caught:
        case.refused(tmp_path)
    assert caught.value.reason in {"no_player", "audio_device"}
    assert str(caught.value)


# -- playing


@every
def test_a_sound_is_played_whole_in_order_and_once(case: Case, tmp_path: Path) -> None:
    """Its name stays, the samples may be overwritten, the consumed bytes grow to all of them, and then it has ended."""
    player = case.opens(tmp_path)
    before = (player.name, player.real_time)
    assert isinstance(player.name, str)
    assert player.name
    assert isinstance(player.real_time, bool)
    assert not player.ended()
    seen = [(player.consumed(), player.proven)]
    for start in range(0, len(SOUND), _PIECE):
        piece = bytearray(SOUND[start : start + _PIECE])
        _offer(player, piece)
        seen.append((player.consumed(), player.proven))
        assert seen[-1][0] <= start + len(piece)
        piece[:] = b"\xff" * len(piece)
        piece.clear()  # BufferError if it keeps a view of it
    assert not player.ended()
    _finish(player)
    assert player.ended()
    seen.append((player.consumed(), player.proven))
    assert seen == sorted(seen)
    assert seen[-1] == (len(SOUND), True)
    assert before == (player.name, player.real_time)
    if case.played is not None:
        assert case.played(tmp_path) == SOUND
    _end(player)
    if case.played is not None:
        assert case.played(tmp_path) == SOUND


@every
def test_no_sample_at_all_ends_well(case: Case, tmp_path: Path) -> None:
    player = case.opens(tmp_path)
    _finish(player)
    assert player.consumed() == 0
    _end(player)


def test_the_null_player_takes_the_time_that_its_sound_would() -> None:
    """Of the others it is the device that does: at a sink, `conformance/test_heard_sound.py`."""
    player = NullPlayer(RATE)
    began = time.monotonic()
    _offer(player, SOUND[: len(SOUND) // 2])
    while player.consumed() / SAMPLE_BYTES / RATE > time.monotonic() - began:
        time.sleep(0.005)  # that it runs dry is no event
    time.sleep(0.1)
    _offer(player, SOUND[len(SOUND) // 2 :])
    _finish(player)
    assert time.monotonic() - began >= len(SOUND) / SAMPLE_BYTES / RATE + 0.1
    _end(player)


# -- waiting


@every
@limits()
def test_no_call_waits_and_a_stuck_player_never_ends(case: Case, tmp_path: Path) -> None:
    with _quick("to open it"):
        player = (case.stuck or case.opens)(tmp_path)
    sent = _fill(player) if case.stuck is not None else 0
    with _quick("an offer"):
        sent += player.offer(memoryview(bytes(_PIECE)))
    assert player.consumed() <= sent
    assert not player.ended()
    for what in (player.consumed, player.interests, player.wake_at, player.ended, player.close, player.ended):
        with _quick(what.__name__):
            what()
    with _quick("kill"):
        player.kill()
    with _quick("gone"):
        player.gone()
    _end(player)


@every
def test_a_player_waits_for_open_descriptors_and_for_room_alone(case: Case, tmp_path: Path) -> None:
    player = case.opens(tmp_path)
    _offer(player, SOUND[:_PIECE])
    found = player.interests()
    player.close()
    for _, events in (*found, *player.interests()):
        assert events == select.POLLOUT or not events & select.POLLOUT
    for descriptor, _ in player.interests():
        os.fstat(descriptor)
    _end(player)


# -- ending


@pytest.mark.parametrize("when", ["unused", "in the middle", "after its input", "after its end"])
@every
def test_a_player_is_ended_at_any_point_and_plays_no_more_than_it_took(case: Case, tmp_path: Path, when: str) -> None:
    player = case.opens(tmp_path)
    sound = b"" if when == "unused" else SOUND[: 3 * _PIECE]
    _offer(player, sound)
    if when == "after its input":
        player.close()
    if when == "after its end":
        _finish(player)
    _end(player)
    if case.played is not None:
        assert sound.startswith(case.played(tmp_path))


# -- failing


@those("lost")
def test_a_lost_player_says_so_each_time_it_is_asked(case: Case, tmp_path: Path) -> None:
    assert case.lost is not None
    player = case.lost(tmp_path)
    for _ in range(2):
        with pytest.raises(CannotSpeak) as caught:
            _play_for_ever(player)
        assert caught.value.reason in {"audio_device", "audio_lost"}
        assert str(caught.value)
    _end(player)
