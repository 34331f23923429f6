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
from talkcli.doctor.report import HEARD
from talkcli.engine import models
from talkcli.engine.players import PLAYERS, is_silent
from talkcli.engine.voices import find_voice, is_neural, is_own_driver
from talkcli.errors import TalkError
from talkcli.frozen import replace
from talkcli.goals.states import State

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from talkcli.client.client import Client
    from talkcli.doctor.report import Finding
    from talkcli.goals.goal import JsonObject

#: Seconds that the sentence may take, its time in the queue included: long enough for one that is being spoken.
LIMIT = 20.0


class Examination:
    """One run of the doctor."""

    question = HEARD

    def __init__(self, socket: str | None, *, silent: bool, interrupt: Mapping[int, int] | None = None) -> None:
        """`socket`: --socket; `silent`: play the sentence without sound; `interrupt`: what ends it, as in `ready`."""
        self._option = socket
        self._silent = silent
        self._interrupt = interrupt
        #: what the server says of itself; empty without one
        self._server: JsonObject = {}
        self._found: list[Finding] = []
        #: the server's process, where it runs here
        self._process: int | None = None
        #: whether the sound server hangs: whoever asks it again waits again
        self._hangs = False
        #: the environment of what plays
        self._env: Mapping[str, str] = os.environ

    def findings(self) -> Iterator[Finding]:
        """Give each finding as soon as it is known; Interrupted."""
        client, found = server.connect(self._option, self._interrupt)
        with client or contextlib.nullcontext():
            for each in self._all(client, found):
                told = sound.installing(each, self._env)
                self._found.append(told)
                yield told

    def _all(self, client: Client | None, found: server.Places) -> Iterator[Finding]:
        itself: list[Finding] = []
        if client is not None:
            try:
                self._server, log = server.described(client)
                itself = server.judge(self._server, log, time.time())
            except TalkError as error:
                client, itself = None, [server.gone(error.message)]
        named = None if client else os.environ.get("TALK_VOICE") or None
        engine = voice.look(voice.Setting(voice=named, interrupt=self._interrupt))
        yield voice.python()
        yield from voice.judge(voice.pyttsx3(), engine, server=self._told("engine"))
        process = self._process = server.process_here(client) if client else None
        here, env = machine.surroundings(process)
        self._env = env
        used = self._told("voice") if self._server else named
        yield from self._neural(used, engine, here, env, running=client is not None)
        if client is not None and process is None:
            yield machine.ELSEWHERE
            yield from sound.judge_silent(self._player(), running=True)
        elif sys.platform.startswith("linux"):
            yield machine.judge_session(here)
            yield from self._sound(engine, here, env, running=client is not None)
        yield server.judge_places(found)
        yield from itself
        yield self._sentence(client, engine, here, env)

    def _neural(
        self, used: str | None, engine: voice.Engine, here: machine.Session, env: Mapping[str, str], *, running: bool
    ) -> Iterator[Finding]:
        """Look at neural voices, where something asks for one, or any is there."""
        told = self._server.get("neural_voices")
        if used and not is_neural(used):  # the engine knows what a short name means, unless it failed because of that
            used = used if engine.reason and find_voice(used, models.undescribed(env)) else engine.voice
        if not is_own_driver(self._told("driver")) or not (used or told or engine.neural or env.get("TALK_VOICES")):
            return
        from talkcli.doctor import neural

        if running and here.server is None:  # its files and its Python are another machine's or another user's
            yield from neural.judge_told(told)
            return
        yield from neural.judge(neural.look(used, env, LIMIT, self._interrupt), server=running, told=told)

    def _player(self) -> str | None:
        """Return the player that is set, by the server or for this process."""
        return self._told("player") if self._server else os.environ.get("TALK_PLAYER") or None

    def _told(self, setting: str) -> str | None:
        """Return a setting of the server's; None where it has none, or there is no server."""
        value = self._server.get(setting)
        return str(value) if value else None

    def _sound(
        self, engine: voice.Engine, here: machine.Session, env: Mapping[str, str], *, running: bool
    ) -> Iterator[Finding]:
        if not is_own_driver(self._told("driver")):
            return  # it plays by itself
        wanted, device = self._player(), self._told("device")
        players = sound.players(env, wanted, None if running else engine.player)
        cards, found = machine.cards(here), sound.sound_server(env, here)
        used = wanted or players.first or ("pulse" if found.name and found.pulse else next(iter(players.found), None))
        devices = None if used == "pulse" and found.hangs else sound.devices(env, used, device)
        self._hangs = found.hangs
        yield from sound.judge(players, devices, cards, found, here, running=running)
        if not is_silent(wanted):
            default = device is None and used in PLAYERS
            yield from sound.judge_levels(sound.levels(env, found, cards), default=default)

    def _sentence(
        self, client: Client | None, engine: voice.Engine, here: machine.Session, env: Mapping[str, str]
    ) -> Finding:
        wanted = self._player()
        if client is not None and self._silent:
            if self._process is None:
                return sentence.ELSEWHERE
            played = sentence.beside(client, self._setting_of_server(self._process, env), LIMIT)
        elif client is not None:
            played = replace(sentence.by_server(client, sentence.TEXT, LIMIT), served=True)
        elif engine.reason is not None:
            played = sentence.Played(State.ABORTED, engine.reason, engine.words)
        else:
            setting = voice.Setting(wanted, None, os.environ.get("TALK_VOICE") or None, self._interrupt)
            played = sentence.by_engine(sentence.TEXT, setting, 0.0 if self._silent else 1.0, LIMIT)
        custom = sound.is_custom(wanted)
        behind = sentence.behind(self._found, custom=custom)
        if self._silent and self._process is not None and here.server is None:
            # Another user's, from whose surroundings nothing can be played; whose, a /proc with hidepid doesn't tell.
            owner = machine.owner(f"/proc/{self._process}")
            behind = behind if owner is None else sentence.AS_OWNER.format(owner)
        if played.reason == "audio_stalled" and not (self._hangs or custom):
            played = replace(played, suspended=sound.suspended(env))
        silent = self._silent or is_silent(wanted)
        return sentence.judge(played, silent=silent, behind=behind, hangs=self._hangs, device=self._told("device"))

    def _setting_of_server(self, process: int, env: Mapping[str, str]) -> voice.Setting:
        """Return what the server speaks with, for a process that does as it does, without a sound."""
        player, worked = self._told("player"), None
        if is_silent(player):
            player = "null"  # a file would get a sentence more, perhaps in the middle of one of the server's
        elif player in PLAYERS and not machine.names_a_player(process, env):
            player, worked = None, player  # the server tries that one first, and then the others
        return voice.Setting(
            player, self._told("device"), self._told("voice"), self._interrupt, self._told("driver"), worked, env
        )
