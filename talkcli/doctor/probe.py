"""An engine process of the doctor's own: does it start, has it voices, does it play a sentence?

What libespeak-ng or a player does to it ends that process and is a fact here; this one never loads the library.
"""

from __future__ import annotations

import os
import select
import time
from typing import TYPE_CHECKING

from talkcli.client.dial import Interrupted, ready
from talkcli.doctor.sentence import Played
from talkcli.doctor.voice import Engine
from talkcli.frozen import frozen

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from talkcli.engine import protocol

_ID = "doctor"
_ENGINE_FAILED = "engine_failed"
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


class _Broken(Exception):
    """The engine process failed: `reason` is for programs."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


def look(setting: Setting) -> Engine:
    """Start an engine process, and return what it says of itself."""
    from talkcli.engine import protocol

    found = Engine()
    try:
        with _Talked(setting) as talked:
            for event in talked.events():
                if isinstance(event, protocol.Ready):
                    found = Engine(event.driver, event.version)
                elif isinstance(event, protocol.Voices):
                    return Engine(found.driver, found.synthesizer, len(event.voices))
    except _Broken as error:
        if found.driver is None or error.reason == "engine_crashed":
            return Engine(reason=error.reason, words=str(error))
    return found  # it is ready; that it lists no voices is for who judges


def speak(text: str, setting: Setting, volume: float, limit: float) -> Played:
    """Play a sentence by an engine process, in at most `limit` seconds, and return how that went."""
    from talkcli.engine import protocol
    from talkcli.goals.states import State

    try:
        with _Talked(setting, limit) as talked:
            player = setting.player
            for event in talked.events():
                if isinstance(event, protocol.Ready):
                    player = event.player
                    rate = _RATE if volume else _SILENT_RATE
                    talked.process.send(protocol.Say(_ID, text, rate, volume, setting.voice, 50))
                elif isinstance(event, protocol.Ended):
                    if event.outcome == protocol.COMPLETED:
                        return Played(State.SUCCEEDED, duration=event.duration, player=player)
                    return Played(State.ABORTED, event.reason, event.message or event.outcome, player=player)
    except _Broken as error:
        return Played(State.ABORTED, error.reason, str(error))
    except TimeoutError:
        pass
    return Played(State.ABORTED, "engine_hung", f"it was not over after {limit:g} s")


class _Talked:
    """The conversation with one engine process; it is gone at the end of the `with`, and its player."""

    def __init__(self, setting: Setting, limit: float | None = None) -> None:
        self._setting = setting
        self._end = None if limit is None else time.monotonic() + limit

    def __enter__(self) -> _Talked:
        from talkcli.engine import protocol
        from talkcli.engine.process import EngineProcess

        one = self._setting
        configure = protocol.Configure(os.getpid(), one.driver, one.player, one.device, one.voice, list_voices=True)
        try:
            self.process = EngineProcess(configure, env=one.env)
        except OSError as error:
            raise _Broken(_ENGINE_FAILED, f"the engine process cannot be started: {error}") from error
        return self

    def __exit__(self, *_: object) -> None:
        from talkcli.engine.protocol import SILENCE_LIMIT

        self.process.kill()
        if ready({self.process.liveness: select.POLLIN}, SILENCE_LIMIT):
            self.process.silent()
        self.process.close()

    def events(self) -> Iterator[protocol.Event]:
        """Give what the process says; _Broken where it fails, TimeoutError past the limit, Interrupted."""
        from talkcli.engine import protocol
        from talkcli.engine.protocol import HANG_AFTER, START_LIMIT

        process, heard = self.process, time.monotonic()
        up = False
        watched = {process.socket.fileno(): select.POLLIN, process.stderr: select.POLLIN}
        if self._setting.interrupt is not None:
            watched[self._setting.interrupt] = select.POLLIN
        while True:
            limit = HANG_AFTER if up else START_LIMIT
            rest = min(heard + limit, self._end or heard + limit) - time.monotonic()
            found = ready(watched, rest)
            if self._setting.interrupt in found:
                raise Interrupted
            if process.stderr in found and not process.read_stderr():
                del watched[process.stderr]
            if process.socket.fileno() in found:
                heard = time.monotonic()
                for event in self._received():
                    up = up or isinstance(event, protocol.Ready)
                    yield event
            elif rest <= 0:
                if self._end is not None and time.monotonic() >= self._end:
                    raise TimeoutError
                raise _Broken("engine_hung", f"the engine process said nothing for {limit:g} s")

    def _received(self) -> Iterator[protocol.Event]:
        from talkcli.engine import protocol

        for event in self.process.receive():
            if event is None:
                raise _Broken("engine_crashed", self.process.last_words())
            if isinstance(event, protocol.StartFailed):
                raise _Broken(event.reason, event.message)
            yield event
