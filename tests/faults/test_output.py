"""Outputs that are muted, unplugged, moved, suspended or missing: the result of a goal must tell the truth.

The player "pulse" plays to a real PulseAudio and a real PipeWire. `test_sound_server` breaks the sound server itself.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import signal
import socket
import time
from typing import TYPE_CHECKING, NamedTuple

import pytest

from talkcli.engine.child.players.pulse import SUSPENDED_LIMIT_S
from talkcli.engine.players import DUMMY_SINK
from tests.conformance.hearing import LONG, LOW, assert_aborted, engine_process, send, start_goal
from tests.support.pipewire import PipeWire
from tests.support.processes import Talk
from tests.support.sink import Sink
from tests.support.timing import assert_within, limits
from tests.support.usage import descendants

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from tests.conftest import MakeTalk
    from tests.support.connection import Message

#: Limit in seconds for the end of a sentence if the sound server reports the reason.
REPORT_S = 0.5
#: Number of clients that PulseAudio (MAX_CONNECTIONS) and PipeWire (MAX_CLIENTS) accept.
CLIENTS = 64
#: Name of a second device.
OTHER = "other"
#: A different device name for each test, because a session manager remembers volumes by name.
_NAMES = (f"card{number}" for number in itertools.count())


Server = Sink | PipeWire


@pytest.fixture(scope="module", params=[Sink, PipeWire], ids=["PulseAudio", "PipeWire"])
def server(request: pytest.FixtureRequest) -> Iterator[Server]:
    with request.param() as sound_server:
        yield sound_server


@pytest.fixture(scope="module")
def shared(server: Server) -> Iterator[Talk]:
    """A talk server that all tests with this sound server share."""
    talk = Talk(("--rate", "450"), env=server.env)
    try:
        yield talk
        talk.stop()
    finally:
        talk.close()


@pytest.fixture
def talk(shared: Talk) -> Iterator[Talk]:
    """The shared server. At the end of a test, each of its goals must have one end, and no goal is left."""
    try:
        yield shared
        shared.watcher.check()
    finally:
        shared.request("cancel")


class Card(NamedTuple):
    """A device, and its module in the sound server."""

    name: str
    module: str


@pytest.fixture
def card(server: Server) -> Iterator[Card]:
    """A new device, which is the default device during the test."""
    name = next(_NAMES)
    with _loaded(server, name) as module:
        _make_default(server, name)
        yield Card(name, module)


@contextlib.contextmanager
def _loaded(server: Server, name: str) -> Iterator[str]:
    """Add a sink. Without `norewinds`, one of PulseAudio renders up to 2 s ahead, and its clients wait for that."""
    options = ["rate=22050", "channels=1", *(["norewinds=1"] if isinstance(server, Sink) else [])]
    module = server.pactl("load-module", "module-null-sink", f"sink_name={name}", *options).strip()
    try:
        yield module
    finally:
        if module in {line.split("\t")[0] for line in server.pactl("list", "short", "modules").splitlines()}:
            server.pactl("unload-module", module)


def _make_default(server: Server, name: str) -> None:
    server.pactl("set-default-sink", name)
    end = time.monotonic() + 10
    while f"Default Sink: {name}\n" not in server.pactl("info"):
        assert time.monotonic() < end, server.pactl("info")
        time.sleep(0.01)  # the session manager sends no event


def _move(server: Server, name: str) -> None:
    """Move the only stream to this sink. Repeat the request, because a busy session manager may miss it."""
    sinks = [line.split("\t")[:2] for line in server.pactl("list", "short", "sinks").splitlines()]
    (wanted,) = [number for number, sink_name in sinks if sink_name == name]
    requested_at = 0.0
    while True:
        (stream,) = server.pactl("list", "short", "sink-inputs").splitlines()
        number, sink, *_ = stream.split("\t")
        if sink == wanted:
            return
        if time.monotonic() - requested_at > 0.5:
            server.pactl("move-sink-input", number, name)
            requested_at = time.monotonic()


def _mute(server: Server, name: str, on: str = "1") -> None:
    server.pactl("set-sink-mute", name, on)


def _turn_down(server: Server, name: str) -> None:
    server.pactl("set-sink-volume", name, "0")


def _wait_for_end(talk: Talk, goal_id: str) -> Message:
    talk.watcher.wait_for_terminal(goal_id)
    return talk.goal(goal_id)


def test_a_goal_reports_its_device_and_volume_even_after_a_move(talk: Talk, server: Server, card: Card) -> None:
    """A change of the default device in mid-sentence does not end the goal, either."""
    server.pactl("set-sink-volume", card.name, "40%")
    with _loaded(server, OTHER):
        server.pactl("set-sink-volume", OTHER, "80%")
        goal = start_goal(talk, f"{LONG}, {LONG}")
        wanted = {"player": "pulse", "device": card.name, "volume": 0.4, "muted": False}
        assert talk.goal(goal)["output"] == wanted  # also while it is being spoken
        (stream,) = server.pactl("list", "short", "sink-inputs").splitlines()
        server.pactl("set-sink-input-volume", stream.split("\t")[0], "50%")
        server.pactl("set-default-sink", OTHER)
        _move(server, OTHER)
        server.pactl("set-default-sink", card.name)
        _move(server, OTHER)
        ended = _wait_for_end(talk, goal)
        assert (ended["state"], ended["output"]) == ("SUCCEEDED", {**wanted, "device": OTHER})


def test_a_dummy_output_is_used_only_if_it_is_named(make_talk: MakeTalk, server: Server, card: Card) -> None:
    with contextlib.ExitStack() as stack:
        if DUMMY_SINK not in server.pactl("list", "short", "sinks"):
            stack.enter_context(_loaded(server, DUMMY_SINK))
        _make_default(server, DUMMY_SINK)
        done = (talk := make_talk(env=server.env)).run("say", "--wait", "--", LOW)
        goal = talk.goal(done.id)
        assert_aborted(goal, "audio_device", "the sound server has only a dummy output")
        assert (done.code, goal["spoken"]) == (4, "")
        talk = make_talk("--player", "pulse", "--device", DUMMY_SINK, "--rate", "450", env=server.env)
        assert talk.run("say", "--wait", "--", LOW).code == 0
        server.pactl("set-default-sink", card.name)


def test_speech_works_again_after_the_device_was_unplugged(talk: Talk, server: Server, card: Card) -> None:
    with limits():
        goal = start_goal(talk, LONG)
        unplugged_at = time.monotonic()
        server.pactl("unload-module", card.module)
        if isinstance(server, PipeWire):
            ended = talk.watcher.wait_for(goal, "ABORTED")
            assert_within(talk.watcher.arrived(ended) - unplugged_at, REPORT_S, "the end of a goal after an unplug")
            assert_aborted(talk.goal(goal), "audio_lost", "the sound server has only a dummy output left")
            assert_aborted(_wait_for_end(talk, send(talk, LOW)), "audio_device", "only a dummy output")
        else:  # PulseAudio moves the stream to its other sink
            assert _wait_for_end(talk, goal)["state"] == "SUCCEEDED"
        with _loaded(server, card.name):
            _make_default(server, card.name)
            assert talk.run("say", "--wait", "--", LOW).code == 0


@pytest.mark.parametrize("server", [Sink], indirect=True, ids=["PulseAudio"])  # PipeWire never suspends a device in use
def test_a_suspended_device_aborts_the_sentence_in_time(talk: Talk, server: Server, card: Card) -> None:
    with limits():
        goal = start_goal(talk, LONG)
        suspended_at = time.monotonic()
        server.pactl("suspend-sink", card.name, "1")
        ended = talk.watcher.wait_for(goal, "ABORTED")
        server.pactl("suspend-sink", card.name, "0")
        seconds = talk.watcher.arrived(ended) - suspended_at
        assert_within(seconds, SUSPENDED_LIMIT_S + REPORT_S, "the end of a goal whose device is suspended")
        assert_aborted(talk.goal(goal), "audio_stalled", f"the sound server has suspended {card.name}")
        assert talk.run("say", "--wait", "--", LOW).code == 0


@pytest.mark.parametrize("mute", [_mute, _turn_down])
def test_a_muted_output_is_reported_or_aborts_an_audible_goal(
    talk: Talk, server: Server, mute: Callable[[Server, str], None], card: Card
) -> None:
    mute(server, card.name)
    done = talk.run("say", "--wait", "--", LOW)
    goal = talk.goal(done.id)
    message = f"Talk completed successfully, but the output was muted: {card.name}"
    assert (done.code, goal["state"], goal["message"]) == (0, "SUCCEEDED", message)
    assert goal["output"]["muted"] is True
    assert done.err == f"talk: {done.id}: {message}\n"
    assert any(re.search(rf'"{LOW}" +muted$', line) for line in talk.run("status").out.splitlines())
    assert f"output   {card.name}, by pulse, volume " in talk.run("status", done.id).out
    done = talk.run("say", "--wait", "--audible", "--", LOW)
    goal = talk.goal(done.id)
    assert_aborted(goal, "muted", f"the output {card.name} is muted")
    assert (done.code, goal["spoken"], goal["duration"]) == (4, "", None)


def test_muting_in_mid_sentence_is_reported_or_aborts_an_audible_goal(
    make_talk: MakeTalk, server: Server, card: Card
) -> None:
    talk = make_talk("--rate", "450", "--audible", env=server.env)
    with limits():
        goal = start_goal(talk, LONG)
        muted_at = time.monotonic()
        _mute(server, card.name)
        ended = talk.watcher.wait_for(goal, "ABORTED")
        assert_within(talk.watcher.arrived(ended) - muted_at, REPORT_S, "the end of a goal that became muted")
        assert_aborted(talk.goal(goal), "muted")
        _mute(server, card.name, "0")
        second = start_goal(talk, LONG, audible=False)
        _mute(server, card.name)
        while not talk.goal(second)["output"]["muted"] and talk.goal(second)["state"] == "ACTIVE":
            pass
        _mute(server, card.name, "0")
        result = _wait_for_end(talk, second)
        assert (result["state"], result["output"]["muted"]) == ("SUCCEEDED", True)  # even a short mute is reported


@pytest.mark.usefixtures("card")
def test_a_full_sound_server_aborts_the_goal_with_a_clear_message(make_talk: MakeTalk, server: Server) -> None:
    talk = make_talk("--player", "pulse", "--rate", "450", env=server.env)
    with contextlib.ExitStack() as crowd:
        for _ in range(CLIENTS):
            client = crowd.enter_context(socket.socket(socket.AF_UNIX))
            client.connect(server.socket)
        done = talk.run("say", "--wait", "--", LOW)
        assert_aborted(talk.goal(done.id), "audio_device", "the sound server rejected the connection")
    assert talk.run("say", "--wait", "--", LOW).code == 0


@pytest.mark.usefixtures("card")
def test_no_stream_remains_after_a_cancel_or_a_killed_engine(talk: Talk, server: Server) -> None:
    start_goal(talk, LONG)
    assert descendants(engine_process(talk)) == []  # no player process that could remain
    talk.run("cancel")
    assert server.pactl("list", "short", "sink-inputs") == ""
    start_goal(talk, LONG)
    os.kill(engine_process(talk), signal.SIGKILL)
    end = time.monotonic() + 1
    while server.pactl("list", "short", "sink-inputs"):
        assert time.monotonic() < end, "the stream continues without its engine"
        time.sleep(0.01)  # the sound server sends no event
    assert talk.run("say", "--wait", "--", LOW).code == 0
