"""The player "pulse" at a real sound server, with a relay before it: answers between any two calls, in pieces, errors.

What happens to the device (unplugged, suspended, muted, moved) is done to a real one in `tests/faults`.
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
#: Seconds of sound: more than the server holds, so that it has to ask for some of it.
SECONDS = 0.2
SOUND = b"".join((number % 3000).to_bytes(2, "little") for number in range(int(SECONDS * RATE)))
#: Seconds after which nothing more is awaited: there is always something that is due sooner.
PATIENCE = 5.0
#: The server's own numbers: access denied, no such entity, connection killed, and one that nobody knows.
ERRORS = [1, 5, 12, 4711]


class Rig:
    """A player behind a relay; `wait` knows the player's interests and no more, like the playback."""

    def __init__(self, relay: Relay | None = None) -> None:
        self.relay: Any = relay
        #: seconds after which a wait counts as the playback's limit; None if nothing may take so long
        self.limit: float | None = None

    def wait(self, player: PulsePlayer) -> None:
        told = player._clock_report
        until, end = player.wake_at(), time.monotonic() + (self.limit or PATIENCE)
        assert player._clock_report is told or until == 0, "it was told the time, and nobody looks at it"
        while time.monotonic() < end:
            now = time.monotonic()
            if now >= until:
                return
            own = select.poll()
            for descriptor, events in player.interests():
                own.register(descriptor, events)
            if own.poll(0):
                return
            self.pass_on(player, min(until, end) - now)
        if self.limit is not None:
            raise CannotSpeak(Reason.ENGINE_HUNG, "nothing came any more")
        raise AssertionError(f"nothing has woken it in {PATIENCE:g} s")

    def pass_on(self, player: PulsePlayer, seconds: float) -> None:
        """Wait for so long at most, until there is something for the player or the relay, and pass it on."""
        poll = select.poll()
        for descriptor, events in player.interests():
            poll.register(descriptor, events)
        if self.relay is None:
            poll.poll(max(0.0, seconds) * 1000)
            return
        self.relay.register(poll)
        # a piece that is left is handed on at once
        poll.poll(0 if self.relay.waiting and self.limit is None else max(0.0, seconds) * 1000)
        self.relay.pump()

    def end(self) -> CannotSpeak | None:
        """Play the sound by a player of its own and return how that failed; None if it has ended well."""
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
def rig(sink: Sink, monkeypatch: pytest.MonkeyPatch) -> MakeRig:
    """Puts a fresh relay before the sound server."""
    for name, value in sink.env.items():
        monkeypatch.setenv(name, value)

    @contextmanager
    def make() -> Iterator[Rig]:
        with short_directory("relay-") as folder, Relay(f"{folder}/s", sink.socket) as relay:
            monkeypatch.setenv("PULSE_SERVER", f"unix:{folder}/s")
            yield Rig(relay)

    return make


@contextmanager
def answered_between_calls(monkeypatch: pytest.MonkeyPatch, answer: Callable[[], None]) -> Iterator[None]:
    """Have something happen before every single call of libpulse."""
    library = libpulse.load()

    class Interposed:
        def __getattr__(self, name: str) -> Any:
            function = getattr(library, name)

            def call(*arguments: Any) -> Any:
                answer()
                return function(*arguments)

            return call

    with monkeypatch.context() as patch:
        patch.setattr(libpulse, "load", Interposed)
        yield


@pytest.mark.parametrize("seed", range(6))
def test_no_wakeup_is_lost_whenever_the_server_answers(
    rig: MakeRig, monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    chance = random.Random(seed)
    with rig() as behind:
        behind.relay.piece = chance.choice([7, 19, 64, 65536])

        def answer() -> None:
            if chance.random() < 0.5:
                behind.relay.pump()

        with answered_between_calls(monkeypatch, answer):
            player = PulsePlayer(RATE)
            began = time.monotonic()
            behind.play(player)
            took = time.monotonic() - began
            assert player.consumed() == len(SOUND)
            player.kill()
    assert SECONDS <= took < SECONDS + 1


@pytest.mark.parametrize("number", ERRORS)
def test_an_error_at_any_step_is_the_end_in_words(rig: MakeRig, number: int) -> None:
    ends = []
    for step in range(8):
        with rig() as behind:
            behind.relay.error = (step, number)
            ends.append(behind.end())
    # hello and auth, the client's name, the stream; other requests do not matter
    assert [end is None for end in ends[:3]] == [False] * 3, ends
    assert {end.reason for end in ends if end is not None} <= {"audio_device", "audio_lost"}


@pytest.mark.parametrize("hush", [False, True], ids=["cut", "silent"])
def test_a_connection_that_ends_anywhere_is_the_end_in_words(rig: MakeRig, hush: bool) -> None:
    with rig() as behind:
        assert behind.end() is None
        whole = behind.relay.forwarded
    for at in range(0, whole // 2, 61):  # how often it tells the time is by chance; in the half of it nothing has ended
        with rig() as behind:
            if hush:
                behind.relay.silent_at = at
                behind.limit = 0.05
            else:
                behind.relay.cut_at = at
            end = behind.end()
            assert end is not None, f"it ended well with {at} of {whole} bytes"
            assert end.reason in {"audio_device", "audio_lost", "engine_hung"}


def test_a_move_told_together_with_the_end_is_seen(rig: MakeRig, sink: Sink) -> None:
    """To a dummy, at which nobody has heard it."""
    with rig() as behind, dummy_of(sink):
        player = PulsePlayer(RATE)
        try:
            behind.feed(player)
            behind.relay.silent_at = behind.relay.forwarded
            player.close()
            behind.relay.pump()
            # the newest: that of a test before this one may not be gone yet
            streams = [int(each.split("\t")[0]) for each in sink.pactl("list", "short", "sink-inputs").splitlines()]
            sink.pactl("move-sink-input", str(max(streams)), DUMMY_SINK)
            over = time.monotonic() + 2 * SECONDS
            while (rest := over - time.monotonic()) > 0:
                waiting = select.poll()
                behind.relay.register(waiting)
                waiting.poll(rest * 1000)
                behind.relay.pump()
            behind.relay.silent_at = None
            with pytest.raises(CannotSpeak, match="only a dummy output left") as error:
                behind.await_end(player)
            assert (error.value.reason, error.value.final) == ("audio_lost", True)
        finally:
            player.kill()


@contextmanager
def dummy_of(sink: Sink) -> Iterator[None]:
    """Have a dummy beside the sink, which stays the default."""
    module = sink.pactl("load-module", "module-null-sink", f"sink_name={DUMMY_SINK}").strip()
    try:
        yield
    finally:
        sink.pactl("unload-module", module)


def test_samples_that_wait_after_a_gap_are_not_heard_before_they_are_played(rig: MakeRig) -> None:
    """It goes on once it has as much as it began with, and its clock with it."""
    with rig() as behind:
        player = PulsePlayer(RATE)
        try:
            behind.feed(player)
            assert _heard_in(behind, player, 3 * SECONDS) == len(SOUND)
            assert player.offer(memoryview(SOUND)[:_PIECE]) == _PIECE
            assert _heard_in(behind, player, SECONDS) == len(SOUND)
            behind.play(player)
            assert player.consumed() == 2 * len(SOUND) + _PIECE
        finally:
            player.kill()


def _heard_in(behind: Rig, player: PulsePlayer, seconds: float) -> int:
    """Return the bytes that were heard when these seconds are over; nothing is offered meanwhile."""
    end = time.monotonic() + seconds
    while (rest := end - time.monotonic()) > 0:
        behind.pass_on(player, min(rest, 0.01))
        player.consumed()
        player.wake_at()
    return player.consumed()


def test_a_time_that_is_told_before_it_has_begun_is_none() -> None:
    """PipeWire answers while no device runs, with the time that the answer took."""
    with PipeWire() as server, pytest.MonkeyPatch.context() as patch:
        for name, value in server.env.items():
            patch.setenv(name, value)
        server.load("card")
        behind = Rig()
        for _ in range(5):
            player = PulsePlayer(RATE)
            try:
                while player.device is None:
                    behind.wait(player)
                server.freeze("pipewire")
                player.offer(memoryview(SOUND)[:_PIECE])
                assert _heard_in(behind, player, 0.1) == 0
                assert not player.proven
            finally:
                server.thaw("pipewire")
                player.kill()


@pytest.mark.parametrize("cookie", ["none is asked for", "the right one", "another"])
def test_a_server_is_reached_over_the_network_by_its_cookie(
    sink: Sink, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, cookie: str
) -> None:
    """As by pacat: PULSE_SERVER and PULSE_COOKIE are libpulse's own."""
    for name in ("wanted", "other"):
        (tmp_path / name).write_bytes(name[:1].encode() * 256)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    asked = "auth-anonymous=1" if cookie == "none is asked for" else f"auth-cookie={tmp_path / 'wanted'}"
    module = sink.pactl("load-module", "module-native-protocol-tcp", "listen=127.0.0.1", f"port={port}", asked)
    try:
        for name, value in sink.env.items():
            monkeypatch.setenv(name, value)
        monkeypatch.setenv("PULSE_SERVER", f"tcp:127.0.0.1:{port}")
        monkeypatch.setenv("PULSE_COOKIE", str(tmp_path / ("other" if cookie == "another" else "wanted")))
        end = Rig().end()
        if cookie == "another":
            assert end is not None
            assert (end.reason, str(end)) == ("audio_device", "the sound server rejected the connection: Access denied")
        else:
            assert end is None
    finally:
        sink.pactl("unload-module", module.strip())
