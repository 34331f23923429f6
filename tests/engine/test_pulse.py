"""Tests for the player "pulse", connected to a real sound server through a relay.

The relay delays, splits and cuts the server's messages, and replaces them with errors. `tests/faults` tests a device
that is unplugged, suspended, muted or moved.
"""

from __future__ import annotations

import random
import select
import socket
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import pytest

from talkcli.engine.child.players import libpulse
from talkcli.engine.child.players.base import CannotSpeak
from talkcli.engine.child.players.pulse import PulsePlayer
from talkcli.engine.players import DUMMY_SINK, PIECE_S, SAMPLE_BYTES
from talkcli.goals.reasons import Reason
from tests.support.pipewire import PipeWire
from tests.support.relay import Relay
from tests.support.surroundings import short_directory

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from contextlib import AbstractContextManager
    from pathlib import Path

    from tests.support.sink import Sink

    MakeRig = Callable[[], AbstractContextManager["Rig"]]

RATE = 22050
_PIECE = int(PIECE_S * RATE) * SAMPLE_BYTES
#: Seconds of sound: more than the server's buffer holds, so that it must request the rest.
SECONDS = 0.2
SOUND = b"".join((number % 3000).to_bytes(2, "little") for number in range(int(SECONDS * RATE)))
#: Seconds after which a wait fails, because the next event is always due sooner.
PATIENCE = 5.0
#: Error codes of the server: no such entity, and an unknown one.
ERRORS = [5, 4711]


class Rig:
    """Plays a sound through a relay. `wait` uses only the player's interests, as the playback does."""

    def __init__(self, relay: Relay | None = None) -> None:
        self.relay: Any = relay
        #: seconds after which a wait reaches the playback's time limit; None if no wait may take so long
        self.limit: float | None = None

    def wait(self, player: PulsePlayer) -> None:
        report = player._clock_report
        until, end = player.wake_at(), time.monotonic() + (self.limit or PATIENCE)
        assert player._clock_report is report or until == 0, "a reported time was ignored"
        while time.monotonic() < end:
            now = time.monotonic()
            if now >= until:
                return
            poll = select.poll()
            for descriptor, events in player.interests():
                poll.register(descriptor, events)
            if poll.poll(0):
                return
            self.pass_on(player, min(until, end) - now)
        if self.limit is not None:
            raise CannotSpeak(Reason.ENGINE_HUNG, "no further event came")
        raise AssertionError(f"no event ended the wait within {PATIENCE:g} s")

    def pass_on(self, player: PulsePlayer, seconds: float) -> None:
        """Wait for an event of the player or the relay, and pass on the relay's data. `seconds` limits the wait."""
        poll = select.poll()
        for descriptor, events in player.interests():
            poll.register(descriptor, events)
        if self.relay is None:
            poll.poll(max(0.0, seconds) * 1000)
            return
        self.relay.register(poll)
        # pass on a remaining piece at once
        poll.poll(0 if self.relay.waiting and self.limit is None else max(0.0, seconds) * 1000)
        self.relay.pump()

    def try_to_play(self) -> CannotSpeak | None:
        """Play the sound with a new player, and return its error, or None if it succeeded."""
        player = None
        try:
            player = PulsePlayer(RATE)
            self.play(player)
        except CannotSpeak as error:
            return error
        finally:
            if player is not None:
                player.kill()
                assert player.gone()
        return None

    def play(self, player: PulsePlayer) -> None:
        self.feed(player)
        player.close()
        self.await_end(player)

    def feed(self, player: PulsePlayer) -> None:
        sent = 0
        while sent < len(SOUND):
            taken = player.offer(memoryview(SOUND)[sent : sent + _PIECE])
            sent += taken
            player.consumed()
            if not taken:
                self.wait(player)

    def await_end(self, player: PulsePlayer) -> None:
        while not player.ended():
            self.wait(player)


@pytest.fixture
def make_rig(sink: Sink, monkeypatch: pytest.MonkeyPatch) -> MakeRig:
    """Return a function that starts a new relay for the sound server."""
    for name, value in sink.env.items():
        monkeypatch.setenv(name, value)

    @contextmanager
    def make() -> Iterator[Rig]:
        with short_directory("relay-") as folder, Relay(f"{folder}/s", sink.socket) as relay:
            monkeypatch.setenv("PULSE_SERVER", f"unix:{folder}/s")
            yield Rig(relay)

    return make


@contextmanager
def before_each_call(monkeypatch: pytest.MonkeyPatch, action: Callable[[], None]) -> Iterator[None]:
    """Run an action before each call of libpulse."""
    library = libpulse.load()

    class Interposed:
        def __getattr__(self, name: str) -> Any:
            function = getattr(library, name)

            def call(*arguments: Any) -> Any:
                action()
                return function(*arguments)

            return call

    with monkeypatch.context() as patch:
        patch.setattr(libpulse, "load", Interposed)
        yield


@pytest.mark.parametrize("seed", range(4))
def test_no_wakeup_is_lost_whatever_the_timing(make_rig: MakeRig, monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    chance = random.Random(seed)
    with make_rig() as rig:
        rig.relay.piece = chance.choice([7, 19, 64, 65536])

        def pump_sometimes() -> None:
            if chance.random() < 0.5:
                rig.relay.pump()

        with before_each_call(monkeypatch, pump_sometimes):
            player = PulsePlayer(RATE)
            started_at = time.monotonic()
            rig.play(player)
            took = time.monotonic() - started_at
            assert player.consumed() == len(SOUND)
            player.kill()
    assert SECONDS <= took < SECONDS + 1


def test_a_server_error_at_any_step_ends_playback_with_a_reason(make_rig: MakeRig) -> None:
    errors = []
    for step in range(8):
        with make_rig() as rig:
            rig.relay.error = (step, ERRORS[step % 2])
            errors.append(rig.try_to_play())
    # the first steps are the authentication, the client's name and the stream; errors of later ones may be ignored
    assert None not in errors[:3], errors
    assert {error.reason for error in errors if error is not None} <= {"audio_device", "audio_lost"}


@pytest.mark.parametrize("hush", [False, True], ids=["cut", "silent"])
def test_a_connection_lost_at_any_byte_ends_playback_with_a_reason(make_rig: MakeRig, hush: bool) -> None:
    with make_rig() as rig:
        assert rig.try_to_play() is None
        whole = rig.relay.forwarded
    for at in range(0, whole // 2, 191):  # the number of time reports varies, but half the bytes are never enough
        with make_rig() as rig:
            if hush:
                rig.relay.silent_at = at
                rig.limit = 0.05
            else:
                rig.relay.cut_at = at
            error = rig.try_to_play()
            assert error is not None, f"the sound was played with {at} of {whole} bytes"
            assert error.reason in {"audio_device", "audio_lost", "engine_hung"}


def test_a_move_to_a_dummy_reported_with_the_end_fails_the_sentence(make_rig: MakeRig, sink: Sink) -> None:
    with make_rig() as rig, dummy_of(sink):
        player = PulsePlayer(RATE)
        try:
            while player.device is None:
                rig.wait(player)
            # move the newest stream, because one of the previous test may still exist
            streams = [int(line.split("\t")[0]) for line in sink.pactl("list", "short", "sink-inputs").splitlines()]
            rig.feed(player)
            rig.relay.silent_at = rig.relay.forwarded
            sink.pactl("move-sink-input", str(max(streams)), DUMMY_SINK)
            player.close()
            end = time.monotonic() + 2 * SECONDS
            while (rest := end - time.monotonic()) > 0:
                poll = select.poll()
                rig.relay.register(poll)
                poll.poll(rest * 1000)
                rig.relay.pump()
            rig.relay.silent_at = None
            with pytest.raises(CannotSpeak, match="only a dummy output left") as error:
                rig.await_end(player)
            assert (error.value.reason, error.value.final) == ("audio_lost", True)
        finally:
            player.kill()


@contextmanager
def dummy_of(sink: Sink) -> Iterator[None]:
    """Add a dummy output. The sink remains the default."""
    module = sink.pactl("load-module", "module-null-sink", f"sink_name={DUMMY_SINK}").strip()
    try:
        yield
    finally:
        sink.pactl("unload-module", module)


def test_samples_waiting_after_a_gap_do_not_count_as_heard(make_rig: MakeRig) -> None:
    """After a gap, the server and its clock continue once the buffer is as full as at the start."""
    with make_rig() as rig:
        player = PulsePlayer(RATE)
        try:
            rig.feed(player)
            assert _heard_in(rig, player, 3 * SECONDS) == len(SOUND)
            assert player.offer(memoryview(SOUND)[:_PIECE]) == _PIECE
            assert _heard_in(rig, player, SECONDS) == len(SOUND)
            rig.play(player)
            assert player.consumed() == 2 * len(SOUND) + _PIECE
        finally:
            player.kill()


def _heard_in(rig: Rig, player: PulsePlayer, seconds: float) -> int:
    """Return the number of bytes that have been heard after this time. No samples are offered during it."""
    end = time.monotonic() + seconds
    while (rest := end - time.monotonic()) > 0:
        rig.pass_on(player, min(rest, 0.01))
        player.consumed()
        player.wake_at()
    return player.consumed()


def test_a_time_reported_before_playback_starts_is_ignored() -> None:
    """While no device runs, PipeWire reports the time that its reply took."""
    with PipeWire() as server, pytest.MonkeyPatch.context() as patch:
        for name, value in server.env.items():
            patch.setenv(name, value)
        server.load("card")
        rig = Rig()
        for _ in range(3):
            player = PulsePlayer(RATE)
            try:
                while player.device is None:
                    rig.wait(player)
                server.freeze("pipewire")
                player.offer(memoryview(SOUND)[:_PIECE])
                assert _heard_in(rig, player, 0.1) == 0
                assert not player.proven
            finally:
                server.thaw("pipewire")
                player.kill()


def test_a_network_server_refuses_a_wrong_cookie(sink: Sink, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("right", "wrong"):
        (tmp_path / name).write_bytes(name[:1].encode() * 256)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = ("listen=127.0.0.1", f"port={port}", f"auth-cookie={tmp_path / 'right'}")
    module = sink.pactl("load-module", "module-native-protocol-tcp", *address)
    try:
        monkeypatch.setenv("PULSE_SERVER", f"tcp:127.0.0.1:{port}")
        monkeypatch.setenv("PULSE_COOKIE", str(tmp_path / "wrong"))
        error = Rig().try_to_play()
        assert error is not None
        message = "the sound server rejected the connection: Access denied"
        assert (error.reason, str(error)) == ("audio_device", message)
    finally:
        sink.pactl("unload-module", module.strip())
