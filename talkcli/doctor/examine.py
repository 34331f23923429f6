"""All checks, in the order of the way that a sentence takes; what each needs is gathered just before it is judged.

It must never hang: whatever is asked has a limit of time. And it changes nothing: its own goal is all that it sends.
"""

from __future__ import annotations

import contextlib
import os
import sys
import time
from typing import TYPE_CHECKING

from talkcli.doctor import machine, sentence, server, sound, voice
from talkcli.doctor.sentence import Played
from talkcli.doctor.voice import Setting
from talkcli.engine.players.programs import PACKAGES
from talkcli.errors import TalkError
from talkcli.goals.states import State

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from talkcli.client.client import Client
    from talkcli.doctor.machine import Session
    from talkcli.doctor.report import Finding
    from talkcli.doctor.server import Places
    from talkcli.doctor.voice import Engine
    from talkcli.goals.goal import Goal, JsonObject

#: Seconds that the sentence may take, its time in the queue included: long enough for one that is being spoken.
LIMIT = 20.0
#: Goals of the log that are looked at for failures.
_LOG = 100
#: Seconds in which an engine should be ready, and between two looks whether it is.
_STARTING, _PAUSE = 1.0, 0.05
#: The driver that plays through programs; any other has a way of its own.
_OWN_DRIVER = "espeak"


class Examination:
    """One run of the doctor."""

    def __init__(self, socket: str | None, *, silent: bool, interrupt: int | None = None) -> None:
        """`socket`: --socket; `silent`: play the sentence without sound; `interrupt`: a descriptor that ends it."""
        self._option = socket
        self._silent = silent
        self._interrupt = interrupt
        self._server: JsonObject = {}
        self._log: list[Goal] = []
        self._found: list[Finding] = []
        #: the server's process, where it runs here
        self._process: int | None = None
        #: its user, where that is another, from whose surroundings nothing can be played
        self._owner: int | None = None
        #: why a server that was there said nothing of itself
        self._gone: str | None = None
        #: whether the sound server hangs: whoever asks it again waits again
        self._hangs = False

    def findings(self) -> Iterator[Finding]:
        """Give each finding as soon as it is known; Interrupted."""
        client, found = server.connect(self._option, self._interrupt)
        with contextlib.ExitStack() as stack:
            if client is not None:
                stack.enter_context(client)
                client = self._asked(client)
            for each in self._all(client, found):
                self._found.append(each)
                yield each

    def _asked(self, client: Client) -> Client | None:
        """Return the client once the server has described itself; None where it went away."""
        try:
            end = time.monotonic() + _STARTING
            self._server, self._log = client.status().server, client.log(_LOG)
            # A server that has just been started doesn't know its player yet, and tells nobody when it does.
            while self._server.get("engine") == "starting" and time.monotonic() < end:
                time.sleep(_PAUSE)
                self._server = client.status().server
        except TalkError as error:
            self._gone = error.message
            return None
        return client

    def _all(self, client: Client | None, found: Places) -> Iterator[Finding]:
        named = None if client else os.environ.get("TALK_VOICE") or None
        engine = voice.look(Setting(voice=named, interrupt=self._interrupt))
        yield from voice.judge(voice.python(), engine, server=client is not None)
        process = self._process = server.process_here(client) if client else None
        here, env = machine.surroundings(process)
        if process is not None and here.server is None:
            self._owner = machine.owner(process)
        if client is not None and process is None:
            yield machine.elsewhere()
            yield from sound.judge_setting(*self._player())
        elif sys.platform.startswith("linux"):
            yield from machine.judge_session(here)
            yield from self._sound(here, env, running=client is not None)
        yield server.judge_places(found)
        if self._gone is not None:
            yield server.gone(self._gone)
        if client is not None:
            yield from server.judge(self._server, self._log, time.time())
        yield self._sentence(client, engine, env)

    def _player(self) -> tuple[str | None, str | None]:
        """Return the player that is set, and by whom."""
        if self._server:
            player = self._server.get("player")
            return (str(player), "the server's") if player else (None, None)
        player = os.environ.get("TALK_PLAYER") or None
        return (player, "TALK_PLAYER") if player else (None, None)

    def _sound(self, here: Session, env: Mapping[str, str], *, running: bool) -> Iterator[Finding]:
        if self._server.get("driver") not in {None, _OWN_DRIVER}:
            return
        wanted, by = self._player()
        device = self._server.get("device")
        players = sound.players(env, wanted, by)
        used = wanted or next(iter(players.found), None)
        devices = sound.devices(env, used, None if device is None else str(device))
        cards, found = machine.cards(here), sound.sound_server(env, here)
        self._hangs = found.hangs
        yield from sound.judge(players, devices, cards, found, here, running=running)
        if not sound.is_silent(wanted):
            default = device is None and used in players.packages
            yield from sound.judge_levels(sound.levels(env, found, cards), default=default)

    def _sentence(self, client: Client | None, engine: Engine, env: Mapping[str, str]) -> Finding:
        wanted, _ = self._player()
        by_server, speaking = client is not None and not self._silent, False
        if client is not None and self._silent:
            if self._process is None:
                return sentence.elsewhere()
            setting = self._setting_of_server(self._process, env)
            played, speaking = sentence.beside(client, lambda: sentence.by_engine(sentence.SHORT, setting, 0.0, LIMIT))
        elif client is not None:
            played = sentence.by_server(client, sentence.TEXT, LIMIT)
            played = sentence.with_player(played, self._server.get("player"))
        elif engine.reason is not None:
            played = Played(State.ABORTED, engine.reason, engine.words)
        else:
            setting = Setting(wanted, None, os.environ.get("TALK_VOICE") or None, self._interrupt)
            played = sentence.by_engine(sentence.TEXT, setting, 0.0 if self._silent else 1.0, LIMIT)
        custom = sound.is_custom(wanted)
        behind = sentence.behind(self._found, custom=custom)
        if self._silent and self._owner is not None:
            behind = sentence.as_owner(self._owner)
        stalled = played.reason == "audio_stalled" and not (self._hangs or custom)
        return sentence.judge(
            played,
            silent=self._silent or sound.is_silent(wanted),
            server=by_server,
            suspended=sound.suspended(env) if stalled else (),
            behind=behind,
            hangs=self._hangs,
            speaking=speaking,
            device=self._server.get("device"),
        )

    def _setting_of_server(self, process: int, env: Mapping[str, str]) -> Setting:
        """Return what the server speaks with, for a process that does as it does, without a sound."""
        told = {
            name: str(self._server[name]) for name in ("player", "device", "voice", "driver") if self._server.get(name)
        }
        player = told.get("player")
        if sound.is_silent(player):
            player = sound.SILENT  # a file would get a sentence more, perhaps in the middle of one of the server's
        elif player in PACKAGES and not machine.names_a_player(process, env):
            player = None  # that one is the first that the server tries, and not the only one
        return Setting(player, told.get("device"), told.get("voice"), self._interrupt, told.get("driver"), env)
