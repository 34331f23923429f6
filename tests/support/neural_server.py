"""Waits until a server has a neural voice loaded: a goal that is sent then is spoken at once, and with that voice."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from tests.support.connection import Wire

if TYPE_CHECKING:
    from tests.conftest import MakeTalk
    from tests.support.connection import Message
    from tests.support.processes import Talk
    from tests.support.sink import Sink

#: Seconds in which a voice is loaded on a busy machine.
_PATIENCE = 30.0


def serve_with_voice(make_talk: MakeTalk, voice: str, *options: str, sink: Sink | None, env: dict[str, str]) -> Talk:
    """Start a server that speaks with this voice, and return it when the voice is loaded."""
    talk = make_talk("--voice", voice, *options, sink=sink, env=env)
    await_voice(talk.socket, voice)
    return talk


def await_voice(socket: str, voice: str) -> None:
    """Wait until a server has loaded its voice; AssertionError if it fails."""
    end = time.monotonic() + _PATIENCE
    with Wire(socket) as wire:
        while (told := _told(wire, voice))["state"] != "loaded":
            assert told["state"] != "failed", f"{voice} was not loaded: {told['why']}"
            assert time.monotonic() < end, f"{voice} is not loaded within {_PATIENCE:g} s"
            time.sleep(0.01)  # no event on the wire tells that it is loaded


def _told(wire: Wire, voice: str) -> Message:
    reply = wire.request("status")
    assert reply["ok"], reply
    told: Message = reply["server"]["neural_voices"].get(voice, {"state": None})
    return told
