"""Servers that have loaded a neural voice, so that goals are spoken with it at once."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from tests.support.connection import Wire

if TYPE_CHECKING:
    from tests.conftest import MakeTalk
    from tests.support.connection import Message
    from tests.support.processes import Talk
    from tests.support.sink import Sink

#: Time to load a voice on a busy machine.
_LOAD_LIMIT_S = 30.0


def serve_with_voice(make_talk: MakeTalk, voice: str, *options: str, sink: Sink | None, env: dict[str, str]) -> Talk:
    """Start a server with this voice, and wait until the voice is loaded."""
    talk = make_talk("--voice", voice, *options, sink=sink, env=env)
    await_voice(talk.socket, voice)
    return talk


def await_voice(socket: str, voice: str) -> None:
    """Wait until a server has loaded this voice, or raise AssertionError if that fails."""
    end = time.monotonic() + _LOAD_LIMIT_S
    with Wire(socket) as wire:
        while (status := _voice_status(wire, voice))["state"] != "loaded":
            assert status["state"] != "failed", f"{voice} was not loaded: {status['why']}"
            assert time.monotonic() < end, f"{voice} is not loaded within {_LOAD_LIMIT_S:g} s"
            time.sleep(0.01)  # the server sends no event for it


def _voice_status(wire: Wire, voice: str) -> Message:
    reply = wire.request("status")
    assert reply["ok"], reply
    status: Message = reply["server"]["neural_voices"].get(voice, {"state": None})
    return status
