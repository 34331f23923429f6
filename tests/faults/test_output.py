"""What becomes of a sentence whose output is muted, unplugged, moved, suspended, or was never there: the truth.

At a real PulseAudio and a real PipeWire, by the player "pulse". What is done to the sound server itself is beside it in
`test_sound_server`; what is heard, in `conformance`.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import socket
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple, Protocol

import pytest

from talkcli.engine.players.devices import DUMMY
from talkcli.engine.players.pulse import SUSPENDED_FOR
from tests.conformance.hearing import LONG, LOW, assert_aborted, begin, engine_process, send
from tests.support.census import descendants
from tests.support.pipewire import PipeWire
from tests.support.sink import Sink
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from tests.conftest import MakeTalk
    from tests.support.connection import Message
    from tests.support.processes import Talk

#: Seconds in which something that a sound server tells ends a sentence.
TOLD = 0.5
#: Clients that either server takes at once, at most: MAX_CONNECTIONS of PulseAudio's, MAX_CLIENTS of PipeWire's.
CLIENTS = 64
#: A sink that counts as a device beside the one of the test.
OTHER = "other"
#: A session manager remembers how loud a device was by its name: each has one of its own.
_NAMES = (f"card{number}" for number in itertools.count())


class Server(Protocol):
    """A sound server: PulseAudio's or PipeWire's."""

    socket: str

    @property
    def env(self) -> Mapping[str, str]: ...
    def pactl(self, *words: str) -> str: ...


@pytest.fixture(scope="module", params=[Sink, PipeWire], ids=["PulseAudio", "PipeWire"])
def server(request: pytest.FixtureRequest) -> Iterator[Server]:
    with request.param() as found:
        yield found


class Card(NamedTuple):
    """A device, and the sound server's module that it is."""

    name: str
    module: str


@pytest.fixture
def card(server: Server) -> Iterator[Card]:
    """A device of its own, which is the default while the test runs."""
    name = next(_NAMES)
    with _loaded(server, name) as module:
        server.pactl("set-default-sink", name)
        _await_default(server, name)
        yield Card(name, module)


@pytest.fixture
def talk(make_talk: MakeTalk, server: Server) -> Talk:
    return make_talk("--rate", "450", env=server.env)


@contextlib.contextmanager
def _loaded(server: Server, name: str) -> Iterator[str]:
    """Have another sink."""
    module = server.pactl("load-module", "module-null-sink", f"sink_name={name}", "rate=22050", "channels=1").strip()
    try:
        yield module
    finally:
        if module in {each.split("\t")[0] for each in server.pactl("list", "short", "modules").splitlines()}:
            server.pactl("unload-module", module)


def _await_default(server: Server, name: str) -> None:
    end = time.monotonic() + 10
    while f"Default Sink: {name}\n" not in server.pactl("info"):
        assert time.monotonic() < end, server.pactl("info")
        time.sleep(0.01)  # a session manager decides it, and tells nobody


def _move(server: Server, name: str) -> None:
    """Have the one stream there is play to this sink. A session manager takes its time, and a busy one may miss it."""
    sinks = [each.split("\t")[:2] for each in server.pactl("list", "short", "sinks").splitlines()]
    (wanted,) = [number for number, each in sinks if each == name]
    asked = 0.0
    while True:
        (stream,) = server.pactl("list", "short", "sink-inputs").splitlines()
        number, sink, *_ = stream.split("\t")
        if sink == wanted:
            return
        if time.monotonic() - asked > 0.5:
            server.pactl("move-sink-input", number, name)
            asked = time.monotonic()


def _ended(talk: Talk, goal_id: str) -> Message:
    talk.watcher.wait_for_terminal(goal_id)
    return talk.goal(goal_id)


def _stream(server: Server) -> str:
    """Return the number of the stream that is being played."""
    (line,) = server.pactl("list", "short", "sink-inputs").splitlines()
    return line.split("\t")[0]


# -- where it goes


def test_a_goal_says_where_it_goes_and_how_loud_that_is(talk: Talk, server: Server, card: Card) -> None:
    server.pactl("set-sink-volume", card.name, "40%")
    goal = begin(talk, LONG)
    wanted = {"player": "pulse", "device": card.name, "volume": 0.4, "muted": False}
    assert talk.goal(goal)["output"] == wanted  # while it is being spoken, too
    stream = _stream(server)
    server.pactl("set-sink-input-volume", stream, "50%")
    ended = _ended(talk, goal)
    assert (ended["state"], ended["output"]) == ("SUCCEEDED", {**wanted, "volume": 0.2})


def test_where_nobody_can_know_it_there_is_none(make_talk: MakeTalk, server: Server) -> None:
    talk = make_talk("--player", "null", env=server.env)
    done = talk.run("say", "--wait", "--", LOW)
    assert (done.code, talk.goal(done.id)["output"]) == (0, None)


@pytest.mark.usefixtures("card")
def test_a_stream_that_is_moved_to_another_device_goes_on_there(talk: Talk, server: Server) -> None:
    with _loaded(server, OTHER):
        goal = begin(talk, ", ".join([LONG] * 3))
        _move(server, OTHER)
        ended = _ended(talk, goal)
        assert (ended["state"], ended["output"]["device"]) == ("SUCCEEDED", OTHER)


def test_another_default_device_in_mid_sentence_ends_nothing(talk: Talk, server: Server, card: Card) -> None:
    with _loaded(server, OTHER):
        goal = begin(talk, LONG)
        server.pactl("set-default-sink", OTHER)
        assert _ended(talk, goal)["state"] == "SUCCEEDED"
        server.pactl("set-default-sink", card.name)


# -- nobody can hear it


def test_a_dummy_is_no_output_but_for_who_names_it(make_talk: MakeTalk, server: Server, card: Card) -> None:
    with contextlib.ExitStack() as stack:
        if DUMMY not in server.pactl("list", "short", "sinks"):
            stack.enter_context(_loaded(server, DUMMY))
        server.pactl("set-default-sink", DUMMY)
        _await_default(server, DUMMY)
        done = (talk := make_talk(env=server.env)).run("say", "--wait", "--", LOW)
        goal = talk.goal(done.id)
        assert_aborted(goal, "audio_device", "the sound server has only a dummy output")
        assert (done.code, goal["spoken"]) == (4, "")
        talk = make_talk("--player", "pulse", "--device", DUMMY, env=server.env)
        assert talk.run("say", "--wait", "--", LOW).code == 0
        server.pactl("set-default-sink", card.name)


def test_a_device_that_is_unplugged_ends_the_sentence_and_the_next_is_heard(
    talk: Talk, server: Server, card: Card
) -> None:
    with limits():
        goal = begin(talk, LONG)
        unplugged = time.monotonic()
        server.pactl("unload-module", card.module)
        ended = talk.watcher.wait_for(goal, "ABORTED") if isinstance(server, PipeWire) else None
        if ended:  # PulseAudio has its other sink, to which the stream is moved
            assert_within(talk.watcher.arrived(ended) - unplugged, TOLD, "the end of a goal whose device is gone")
            assert_aborted(talk.goal(goal), "audio_lost", "the sound server has only a dummy output left")
            assert_aborted(_ended(talk, send(talk, LOW)), "audio_device", "only a dummy output")
        else:
            assert _ended(talk, goal)["state"] == "SUCCEEDED"
        with _loaded(server, card.name):
            server.pactl("set-default-sink", card.name)
            _await_default(server, card.name)
            assert talk.run("say", "--wait", "--", LOW).code == 0


@pytest.mark.parametrize("server", [Sink], indirect=True, ids=["PulseAudio"])  # PipeWire suspends nothing that plays
def test_a_suspended_device_ends_the_sentence_within_a_second(talk: Talk, server: Server, card: Card) -> None:
    with limits():
        goal = begin(talk, LONG)
        suspended = time.monotonic()
        server.pactl("suspend-sink", card.name, "1")
        ended = talk.watcher.wait_for(goal, "ABORTED")
        server.pactl("suspend-sink", card.name, "0")
        assert_within(
            talk.watcher.arrived(ended) - suspended, SUSPENDED_FOR + TOLD, "the end of a goal that stands still"
        )
        assert_aborted(talk.goal(goal), "audio_stalled", f"the sound server has suspended {card.name}")
        assert talk.run("say", "--wait", "--", LOW).code == 0


# -- muted


def _mute(server: Server, card: Card) -> None:
    server.pactl("set-sink-mute", card.name, "1")


def _turn_down(server: Server, card: Card) -> None:
    server.pactl("set-sink-volume", card.name, "0")


Mute = Callable[[Server, Card], None]
every_way = pytest.mark.parametrize("mute", [_mute, _turn_down])


@every_way
def test_a_muted_sentence_is_played_and_everybody_is_told(talk: Talk, server: Server, mute: Mute, card: Card) -> None:
    mute(server, card)
    done = talk.run("say", "--wait", "--", LOW)
    goal = talk.goal(done.id)
    words = f"Talk completed successfully, but the output was muted: {card.name}"
    assert (done.code, goal["state"], goal["message"]) == (0, "SUCCEEDED", words)
    assert goal["output"]["muted"] is True
    assert done.err == f"talk: {done.id}: {words}\n"
    assert any(each.endswith(f'"{LOW}"  muted') for each in talk.run("status").out.splitlines())
    assert f"output   {card.name}, by pulse, volume " in talk.run("status", done.id).out


@every_way
def test_one_that_must_be_audible_is_not_begun_where_it_is_muted(
    talk: Talk, server: Server, mute: Mute, card: Card
) -> None:
    mute(server, card)
    done = talk.run("say", "--wait", "--audible", "--", LOW)
    goal = talk.goal(done.id)
    assert_aborted(goal, "muted", f"the output is muted: {card.name}")
    assert (done.code, goal["spoken"], goal["duration"]) == (4, "", None)


def test_one_that_must_be_audible_ends_where_it_becomes_muted(make_talk: MakeTalk, server: Server, card: Card) -> None:
    talk = make_talk("--rate", "450", "--audible", env=server.env)
    with limits():
        goal = begin(talk, LONG)
        muted = time.monotonic()
        _mute(server, card)
        ended = talk.watcher.wait_for(goal, "ABORTED")
        assert_within(talk.watcher.arrived(ended) - muted, TOLD, "the end of a goal that became muted")
        assert_aborted(talk.goal(goal), "muted")
        server.pactl("set-sink-mute", card.name, "0")
        assert talk.run("say", "--wait", "--", LOW).code == 0
        own = talk.request("say", text=LONG, audible=False, wait=True)["goal"]["id"]
        talk.watcher.wait_for(own, "ACTIVE")
        _mute(server, card)
        assert _ended(talk, own)["state"] == "SUCCEEDED"


def test_a_moment_of_it_is_told_as_well(talk: Talk, server: Server, card: Card) -> None:
    goal = begin(talk, LONG)
    _mute(server, card)
    while not talk.goal(goal)["output"]["muted"]:  # it ends by the assertion below if it is never told
        if talk.goal(goal)["state"] != "ACTIVE":
            break
    server.pactl("set-sink-mute", card.name, "0")
    ended = _ended(talk, goal)
    assert (ended["state"], ended["output"]["muted"]) == ("SUCCEEDED", True)


# -- no place for one more


@pytest.mark.usefixtures("card")
def test_a_server_that_takes_no_more_clients_ends_the_sentence_in_words(make_talk: MakeTalk, server: Server) -> None:
    talk = make_talk("--player", "pulse", env=server.env)
    with contextlib.ExitStack() as crowd:
        for _ in range(CLIENTS):
            each = crowd.enter_context(socket.socket(socket.AF_UNIX))
            each.connect(server.socket)
        done = talk.run("say", "--wait", "--", LOW)
        assert_aborted(talk.goal(done.id), "audio_device", "the sound server lets nobody in")
    assert talk.run("say", "--wait", "--", LOW).code == 0


# -- the end


@pytest.mark.usefixtures("card")
def test_nothing_of_a_stream_is_left_behind(talk: Talk, server: Server) -> None:
    """A cancel, and an engine that is killed; there is no player's process that could be."""
    begin(talk, LONG)
    assert descendants(engine_process(talk)) == []
    talk.run("cancel")
    assert server.pactl("list", "short", "sink-inputs") == ""
    begin(talk, LONG)
    os.kill(engine_process(talk), signal.SIGKILL)
    end = time.monotonic() + 1
    while server.pactl("list", "short", "sink-inputs"):
        assert time.monotonic() < end, "the stream goes on without its engine"
        time.sleep(0.01)  # the server's end of a connection is no event here
    assert talk.run("say", "--wait", "--", LOW).code == 0
