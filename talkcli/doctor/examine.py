"""All checks of this machine, in order from the voice to the loudspeaker.

Findings are reported as soon as they are known. The examination never hangs, because every wait has a time limit. It
changes nothing, and speaks only one sentence.
"""

from __future__ import annotations

import contextlib
import os
import sys
import time
from typing import TYPE_CHECKING

from talkcli.doctor import sentence, server, sound, voice
from talkcli.doctor.report import SENTENCE_QUESTION
from talkcli.doctor.voice import SENTENCE_TEXT
from talkcli.engine import models
from talkcli.engine.players import PLAYERS, is_silent
from talkcli.engine.voices import find_voice, is_own_driver
from talkcli.errors import TalkError
from talkcli.frozen import replace
from talkcli.goals.options import is_neural
from talkcli.goals.reasons import Reason
from talkcli.goals.states import State

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from talkcli.client.client import Client
    from talkcli.doctor.report import Finding
    from talkcli.goals.goal import JsonObject

#: Time limit for the sentence, including the time in the queue.
SENTENCE_LIMIT_S = 20.0


class LocalExamination:
    """Examines this machine and its server for `talk doctor`."""

    question = SENTENCE_QUESTION

    def __init__(self, socket: str | None, *, silent: bool, interrupt: Mapping[int, int] | None = None) -> None:
        """Prepare an examination.

        Args:
            socket: the value of --socket.
            silent: whether to play the sentence without sound.
            interrupt: descriptors that interrupt any wait, as in `wait_ready`.
        """
        self._socket = socket
        self._silent = silent
        self._interrupt = interrupt
        self._client: Client | None = None
        #: the server's description of itself, or an empty object if there is no server
        self._server: JsonObject = {}
        #: the server's process id, if the server runs on this machine
        self._server_pid: int | None = None
        self._engine = voice.EngineReport()
        #: session and environment in which the player runs
        self._session = sound.UserSession(0, "")
        self._env: Mapping[str, str] = os.environ
        #: whether the sound server accepts connections but doesn't answer
        self._hangs = False
        self._findings: list[Finding] = []

    def findings(self) -> Iterator[Finding]:
        """Run all checks. Yield each finding as soon as it is known."""
        client, socket = server.connect(self._socket, self._interrupt)
        with client or contextlib.nullcontext():
            for each in self._run_checks(client, socket):
                finding = sound.with_pactl_hint(each, self._env)
                self._findings.append(finding)
                yield finding

    def _run_checks(self, client: Client | None, socket_finding: Finding) -> Iterator[Finding]:
        """Run all checks, with a client if the server is running. Yield the findings.

        The arguments are the results of `server.connect`.
        """
        of_server: list[Finding] = []
        if client is not None:
            try:
                self._server, log = server.request_status_and_log(client)
                of_server = server.judge_server(self._server, log, time.time())
            except TalkError as error:
                client, of_server = None, [server.judge_unresponsive_server(error.message)]
        self._client = client
        self._server_pid = None if client is None else server.local_pid(client)
        voice_here = None if client else self._setting("voice", "TALK_VOICE")
        self._engine = voice.probe_engine(voice.EngineOptions(voice=voice_here, interrupt=self._interrupt))
        yield voice.judge_python()
        pyttsx3 = voice.installed_version("pyttsx3")
        yield from voice.judge_engine(pyttsx3, self._engine, server_engine=self._setting("engine"))
        self._session, self._env = sound.find_session(self._server_pid)
        yield from self._check_neural()
        if client is not None and self._server_pid is None:
            yield sound.SESSION_ELSEWHERE
            if is_silent(self._player):
                yield sound.judge_silent_player(self._player, set_by_server=True)
        elif sys.platform.startswith("linux"):
            yield sound.judge_session(self._session)
            yield from self._check_sound()
        yield socket_finding
        yield from of_server
        yield self._speak_sentence()

    def _setting(self, name: str, variable: str = "") -> str | None:
        """Return a setting of the server. Without a server, return an environment variable.

        Return None if it isn't set.
        """
        value = self._server.get(name) if self._server else os.environ.get(variable)
        return str(value) if value else None

    @property
    def _player(self) -> str | None:
        """The configured player. It is None if the engine chooses one."""
        return self._setting("player", "TALK_PLAYER")

    def _check_neural(self) -> Iterator[Finding]:
        """Yield findings about neural voices, if one is installed or in use."""
        used, engine, env = self._setting("voice", "TALK_VOICE"), self._engine, self._env
        reported = self._server.get("neural_voices")
        server_voices = reported if isinstance(reported, dict) else {}
        if used and not is_neural(used):
            if engine.ready is not None:
                used = engine.ready.voice
            elif not find_voice(used, models.undescribed_voices(env)):  # the voice in use may be the cause
                used = None
        needed = used or server_voices or any(map(is_neural, engine.voices or ())) or env.get("TALK_VOICES")
        if not needed or not is_own_driver(self._setting("driver")):
            return
        if self._client and self._session.server_pid is None:  # the server may have other voices
            yield from voice.judge_server_voices(server_voices)
            return
        options = voice.EngineOptions(env=env, interrupt=self._interrupt)
        yield from voice.check_neural(used, options, SENTENCE_LIMIT_S, server_voices if self._client else None)

    def _check_sound(self) -> Iterator[Finding]:
        """Check the player, its device, the sound cards and the volume. Yield the findings.

        Record whether the sound server hangs.
        """
        env, session, device, by_server = self._env, self._session, self._setting("device"), self._client is not None
        if not is_own_driver(self._setting("driver")):
            return  # pyttsx3's other drivers play the sound themselves
        sound_server = sound.find_sound_server(env, session)
        self._hangs = sound_server.hangs
        if is_silent(self._player):
            yield sound.judge_silent_player(self._player, set_by_server=by_server)
            return
        cards = sound.find_cards()
        program = next(iter(sound.installed_players(env)), None)
        used = "pulse" if sound_server.name and sound_server.accepts_pulse else program
        if self._engine.ready is not None and not by_server:
            used = self._engine.ready.player or used
        used = self._player or used
        yield sound.check_player(env, self._player, used, used_by_server=by_server)
        if used in sound.DEVICE_LISTS and (used != "pulse" or sound_server.name is not None):
            yield sound.check_device(env, used, device)
        yield sound.check_cards(cards, sound_server, session)
        yield sound.check_access(sound_server, session)
        yield sound.judge_sound_server(sound_server, cards, session, used)
        yield from sound.check_levels(env, sound_server, cards, in_use=device is None and used in PLAYERS)

    def _speak_sentence(self) -> Finding:
        """Speak the doctor's test sentence. Return the finding."""
        client, engine, player = self._client, self._engine, self._player
        if client is not None and self._silent:
            if self._server_pid is None:
                return sentence.SENTENCE_ELSEWHERE
            result = sentence.speak_beside_server(client, self._copy_server_options(self._server_pid), SENTENCE_LIMIT_S)
        elif client is not None:
            result = sentence.speak_by_server(client, SENTENCE_TEXT, SENTENCE_LIMIT_S)
        elif engine.reason is not None:
            result = sentence.SentenceResult(State.ABORTED, engine.reason, engine.message)
        else:
            used = self._setting("voice", "TALK_VOICE")
            options = voice.EngineOptions(player, voice=used, interrupt=self._interrupt)
            result = sentence.speak_by_engine(SENTENCE_TEXT, options, 0.0 if self._silent else 1.0, SENTENCE_LIMIT_S)
        custom = sound.is_custom_command(player)
        step = sentence.find_playback_step(self._findings, custom_player=custom)
        if self._silent and self._server_pid is not None and self._session.server_pid is None:
            # The server belongs to another user, so its environment can't be read. If /proc is mounted with the option
            # hidepid, the server's owner is unknown too.
            owner = sound.file_owner(f"/proc/{self._server_pid}")
            step = step if owner is None else sentence.RUN_AS_OWNER.format(owner)
        if result.reason == Reason.AUDIO_STALLED and not (self._hangs or custom):
            result = replace(result, suspended=sound.suspended_sinks(self._env))
        silent, device = self._silent or is_silent(player), self._setting("device")
        return sentence.judge_sentence(
            result, silent=silent, device=device, playback_step=step, sound_hangs=self._hangs
        )

    def _copy_server_options(self, server_pid: int) -> voice.EngineOptions:
        """Return engine options with the server's player, device and voice."""
        player, first = self._player, None
        if is_silent(player):
            player = "null"  # don't write to the server's output file
        elif player in PLAYERS and not sound.server_names_player(server_pid, self._env):
            player, first = None, player  # the server chose this player automatically
        device, used, driver = map(self._setting, ("device", "voice", "driver"))
        return voice.EngineOptions(player, device, used, driver, first, self._env, self._interrupt)
