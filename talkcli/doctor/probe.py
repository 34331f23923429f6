"""An engine process of the doctor's own: does it start, has it voices, does it play a sentence?

What libespeak-ng or a player does to it ends that process and is a fact here; this one never loads the library.
"""

from __future__ import annotations

import os
import select
import time
from typing import TYPE_CHECKING

from talkcli.doctor.sentence import Played
from talkcli.doctor.voice import Engine
from talkcli.frozen import frozen

if TYPE_CHECKING:
    from collections.abc import Mapping

    from talkcli.engine.once import Conversation, EngineFailed

_ID = "doctor"
#: Words per minute, of what is heard and of what nobody hears: that holds the device no longer than it must.
_RATE, _SILENT_RATE = 200, 450


@frozen
class Setting:
    """What the engine process is to speak with."""

    player: str | None = None
    device: str | None = None
    voice: str | None = None
    #: a descriptor that ends any waiting with Interrupted
    interrupt: int | None = None
    driver: str | None = None
    #: the environment in which it is to run; None for this process's
    env: Mapping[str, str] | None = None


def look(setting: Setting) -> Engine:
    """Start an engine process, and return what it says of itself."""
    from talkcli.engine import protocol
    from talkcli.engine.once import EngineFailed

    found = Engine()
    try:
        with _conversation(setting) as engine:
            for event in engine.events():
                if isinstance(event, protocol.Ready):
                    found = Engine(event.driver, event.version)
                elif isinstance(event, protocol.Voices):
                    return Engine(found.driver, found.synthesizer, len(event.voices))
    except EngineFailed as error:
        if found.driver is None or error.reason == "engine_crashed":
            reason, words = _fault(error)
            return Engine(reason=reason, words=words)
    return found  # it is ready; that it lists no voices is for who judges


def speak(text: str, setting: Setting, volume: float, limit: float) -> Played:
    """Play a sentence by an engine process, in at most `limit` seconds, and return how that went."""
    from talkcli.engine import protocol
    from talkcli.engine.once import EngineFailed
    from talkcli.goals.states import State

    try:
        with _conversation(setting, limit) as engine:
            player = setting.player
            for event in engine.events():
                if isinstance(event, protocol.Ready):
                    player = event.player
                    rate = _RATE if volume else _SILENT_RATE
                    engine.say(protocol.Say(_ID, text, rate, volume, setting.voice, 50))
                elif isinstance(event, protocol.Ended):
                    if event.outcome == protocol.COMPLETED:
                        return Played(State.SUCCEEDED, duration=event.duration, player=player)
                    return Played(State.ABORTED, event.reason, event.message or event.outcome, player=player)
    except EngineFailed as error:
        return Played(State.ABORTED, *_fault(error))
    except TimeoutError:
        pass
    return Played(State.ABORTED, "engine_hung", f"it was not over after {limit:g} s")


def _conversation(setting: Setting, limit: float | None = None) -> Conversation:
    """Return what talks to an engine process of these settings, for at most `limit` seconds."""
    from talkcli.engine import protocol
    from talkcli.engine.once import Conversation

    configure = protocol.Configure(
        os.getpid(), setting.driver, setting.player, setting.device, setting.voice, list_voices=True
    )
    interrupt = None if setting.interrupt is None else {setting.interrupt: select.POLLIN}
    deadline = None if limit is None else time.monotonic() + limit
    return Conversation(configure, env=setting.env, deadline=deadline, interrupt=interrupt)


def _fault(error: EngineFailed) -> tuple[str, str]:
    """Return why an engine process failed, for programs and in words; whether it was ready yet makes no difference."""
    from talkcli.engine.once import EngineSilent

    if isinstance(error, EngineSilent):
        return "engine_hung", f"the engine process said nothing for {error.seconds:g} s"
    return error.reason, str(error)
