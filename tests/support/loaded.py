"""Waits until a server has a neural voice loaded: a goal that is sent then is spoken at once, and with that voice."""

from __future__ import annotations

import os
import time
from typing import TYPE_CHECKING

from tests.support.census import descendants
from tests.support.connection import Wire

if TYPE_CHECKING:
    from tests.conftest import MakeTalk
    from tests.support.processes import Talk
    from tests.support.sink import Sink

#: Seconds in which a voice is loaded on a busy machine.
_PATIENCE = 30.0


def serve_with(make_talk: MakeTalk, voice: str, *options: str, sink: Sink | None, env: dict[str, str]) -> Talk:
    """Start a server that speaks with this voice, and return it when that is loaded."""
    talk = make_talk("--voice", voice, *options, sink=sink, env=env)
    await_loaded(talk.socket, voice)
    return talk


def await_loaded(socket: str, voice: str) -> None:
    """Wait until a server, which was told to speak with this voice, has it loaded; AssertionError if it fails."""
    end = time.monotonic() + _PATIENCE
    with Wire(socket) as wire:
        while (state := _state(wire, voice)) != "loaded":
            assert state != "failed", f"{voice} was not loaded"
            assert time.monotonic() < end, f"{voice} is not loaded within {_PATIENCE:g} s"
            time.sleep(0.01)  # that it is loaded is no event on the wire


def _state(wire: Wire, voice: str) -> str | None:
    reply = wire.request("status")
    assert reply["ok"], reply
    server = reply["server"]
    if "voices" in server:
        state: str | None = server["voices"].get(voice, {}).get("state")
        return state
    return "loaded" if all(_has_loaded(each) for each in descendants(server["pid"])) else None


def _has_loaded(engine: int) -> bool:
    """Whether an engine process has mapped the library that runs models, and stands still."""
    with open(f"/proc/{engine}/maps", encoding="utf-8") as maps:
        if "onnxruntime" not in maps.read():
            return False
    before = _processor(engine)
    time.sleep(0.2)
    return _processor(engine) == before


def _processor(pid: int) -> int:
    """Return the processor time that a process has taken, in nanoseconds."""
    found = 0
    for each in os.listdir(f"/proc/{pid}/task"):
        with open(f"/proc/{pid}/task/{each}/schedstat", encoding="ascii") as file:
            found += int(file.read().split()[0])
    return found
