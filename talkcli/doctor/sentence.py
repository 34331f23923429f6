"""The proof: a sentence that is sent all the way, through the server or by an engine process, and what its end means.

As any client's goal it waits its turn and can be cancelled.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from talkcli.doctor.report import SENTENCE, Finding, failed, ok
from talkcli.doctor.sound import is_custom
from talkcli.doctor.voice import INSTALL_LIBRARY, conversation, fault
from talkcli.engine import protocol
from talkcli.engine.parent.process import EngineFailed
from talkcli.errors import TalkError
from talkcli.frozen import frozen, replace
from talkcli.goals.states import State
from talkcli.polling import Interrupted

if TYPE_CHECKING:
    from collections.abc import Sequence

    from talkcli.client.client import Client
    from talkcli.client.goal import GoalHandle
    from talkcli.doctor.voice import Setting
    from talkcli.goals.goal import Goal

#: What is said; short, and worth hearing.
TEXT = "If you hear this, talk works."
#: What is played beside a server where nobody hears it: short, as a device that takes one player has no place for the
#: server's meanwhile, and long enough to see that a player doesn't just swallow it.
SHORT = "talk works well"
#: Words per minute, of what is heard and of what nobody hears: that holds the device no longer than it must.
_RATE, _SILENT_RATE = 200, 450
#: What to do about a reason. What isn't here is told by `reason` and message alone.
REMEDIES = {
    "no_player": "sudo apt-get install -y alsa-utils",
    "audio_device": "plug in and switch on the loudspeaker, close what else plays, and try: aplay -l",
    "audio_lost": "look whether the loudspeaker was unplugged, and try another: talk serve --device NAME",
    "audio_stalled": "wake the device (pactl suspend-sink @DEFAULT_SINK@ 0), or restart the sound server",
    "muted": "undo it: pactl set-sink-mute @DEFAULT_SINK@ 0; pactl set-sink-volume @DEFAULT_SINK@ 70%",
    "voice_failed": "do what the message says, or choose another voice: talk set --voice en",
    "engine_failed": "install what the message names, into the Python that serves",
    "engine_crashed": "run talk doctor again; if it comes back, try another voice: talk set --voice en",
    "engine_hung": "run talk doctor again on a machine that is less busy",
    "not_silent": "start the server again: one of its players could not be killed",
    "unknown_voice": "choose one that 'talk voices' lists: talk set --voice NAME",
    "nothing_to_say": "send words of the voice's language, or choose a voice for the text's: talk set --voice NAME",
    "queue_full": "empty the queue: talk cancel",
    "shutdown": "start the server again: talk serve",
    "lost": "start the server again: talk serve",
    "late": "see what is in the way with 'talk status', or end it with 'talk cancel'",
    "paused": "talk resume",
}
#: What is to be said where a server's player is out of reach for a process of this command's own.
ELSEWHERE = failed(
    SENTENCE,
    "not played: the server runs on another machine or in a container, and so does its player",
    "run talk doctor --silent there; or here without --silent, so that the server plays",
)
#: What to do where a server's player failed by another user than the server's.
AS_OWNER = "play as the server's own user, who may have another sound: sudo -u '#{}' talk doctor --silent"
_BUSY = "another program holds the device: close it, or play through a sound server (PipeWire, PulseAudio)"
_OF_PLAYER = {"audio_device", "audio_lost", "audio_stalled"}
_OF_START = {"engine_failed", "engine_hung"}
#: Checks of what lies behind the engine, the nearest cause of a sentence's end first.
_BEHIND = ("player", "device", "sound server", "group", "cards", "session")


@frozen
class Played:
    """How a sentence ended."""

    state: State
    #: as a goal has it; besides these "late": it was still waiting at the limit and was taken back
    reason: str | None = None
    words: str | None = None
    #: seconds of audio
    duration: float | None = None
    player: str | None = None
    #: whether by a server, and whether one spoke meanwhile, with the same device
    served: bool = False
    beside_speech: bool = False
    #: sinks that took no data when it had ended
    suspended: tuple[str, ...] = ()


def by_server(client: Client, text: str, limit: float) -> Played:
    """Send a sentence that waits its turn, and return how it ended; after `limit` seconds it is taken back."""
    try:
        goal = client.say(text, preempt=False, ttl=0)
        try:
            if goal.speech_paused:
                return Played(goal.cancel().state, "paused", "speech is paused")
            played = _played(goal.wait(limit))
            with contextlib.suppress(TalkError):  # the sentence was heard, even if the server goes away now
                played = replace(played, player=client.status().server.get("player"))
            return played
        except TimeoutError:
            return _taken_back(client, goal, limit)
        except Interrupted:
            goal.request_cancel()
            raise
    except TalkError as error:
        return Played(State.LOST, "lost", error.message)


def _taken_back(client: Client, goal: GoalHandle, limit: float) -> Played:
    """Cancel a goal that has not ended in time, and say what was in its way."""
    before = client.status()
    ended = goal.cancel()
    if ended.state in {State.SUCCEEDED, State.ABORTED}:  # in this moment
        return _played(ended)
    ahead = next((number for number, each in enumerate(before.pending) if each.id == goal.id), None)
    if before.server.get("paused") is True:
        return Played(ended.state, "paused", "speech is paused")
    if ahead is None:
        return Played(ended.state, "late", f"it was begun and not over after {limit:g} s, and was cancelled")
    goals = "1 goal" if ahead + bool(before.active) == 1 else f"{ahead + bool(before.active)} goals"
    return Played(ended.state, "late", f"it still waited behind {goals} after {limit:g} s, and was taken back")


def _played(goal: Goal) -> Played:
    return Played(goal.state, goal.reason, goal.message, goal.duration)


def beside(client: Client, setting: Setting, limit: float) -> Played:
    """Play without a sound beside a server, as it would, and return how that went, and whether it spoke meanwhile."""
    try:
        before = client.status()
        played = by_engine(SHORT, setting, 0.0, limit)
        after = client.status()
    except TalkError as error:
        return Played(State.LOST, "lost", error.message)
    spoken = {each.id for each in after.recent if each.state in {State.SUCCEEDED, State.PREEMPTED}}
    spoke = before.active or after.active or spoken - {each.id for each in before.recent}
    return replace(played, beside_speech=bool(spoke))


def by_engine(text: str, setting: Setting, volume: float, limit: float) -> Played:
    """Play a sentence by an engine process, in at most `limit` seconds, and return how that went."""
    try:
        with conversation(setting, limit) as engine:
            player = engine.wait_for(protocol.Ready).player
            rate = _RATE if volume else _SILENT_RATE
            engine.speak(protocol.Speak("doctor", text, rate, volume, setting.voice, 50))
            ended = engine.wait_for(protocol.Ended)
            if ended.outcome == protocol.OUTCOME_COMPLETED:
                return Played(State.SUCCEEDED, duration=ended.duration, player=ended.player or player)
            return Played(State.ABORTED, ended.reason, ended.message or ended.outcome, player=player)
    except EngineFailed as error:
        return Played(State.ABORTED, *fault(error))
    except TimeoutError:
        return Played(State.ABORTED, "engine_hung", f"it was not over after {limit:g} s")


def behind(findings: Sequence[Finding], *, custom: bool = False) -> str | None:
    """Return the next step for what lies behind the engine, where something there is not as it should be.

    `custom`: whether the player is a command of the user's own, of which nobody here knows what it needs.
    """
    steps = {each.check: each.next for each in findings}
    return next((steps[check] for check in _BEHIND[: 1 if custom else None] if steps.get(check) is not None), None)


def remedy(
    reason: str | None,
    words: str | None = None,
    player: object = None,
    device: object = None,
    text: str | None = None,
) -> str:
    """Return what to do about a goal that ended for this reason; `player`, `device`: what has played it, if known."""
    said = (words or "").lower()
    if reason == "nothing_to_say" and text is not None and not any(map(str.isalnum, text)):
        return "send a text with words: this one has no letters and no digits"
    if reason == "audio_device" and "busy" in said:
        return _BUSY
    if reason == "audio_device" and ("denied" in said or "not permitted" in said):
        return "sudo usermod -aG audio USER for the user who serves, log in again, and start the server again"
    if reason == "engine_failed" and "libespeak-ng is missing" in (words or ""):
        return INSTALL_LIBRARY
    if reason in _OF_PLAYER and isinstance(player, str) and is_custom(player):
        command = player.replace("{rate}", "22050").replace("{device}", str(device or "default"))
        return f"try the player by hand, with a second of silence: head -c 44100 /dev/zero | {command}"
    return REMEDIES.get(reason or "", "somebody else ended it: run talk doctor again")


def judge(
    played: Played, *, silent: bool, behind: str | None = None, hangs: bool = False, device: object = None
) -> Finding:
    """Judge the sentence; `silent`: whether it made no sound; `behind`: what is to be done about player and device.

    `hangs`: whether the sound server does, for which engines wait at their start; `device`: the one that was named for
    the player.
    """
    how = "through the server" if played.served else "by an engine of this command's own"
    if played.state is State.SUCCEEDED:
        seconds = "" if played.duration is None else f", {played.duration:.1f} s"
        player = f", {played.player}" if played.player else ""
        said = "played to its end without sound" if silent else f'"{TEXT}" was played to its end'
        return ok(SENTENCE, f"{said} {how}{player}{seconds}")
    if played.reason in {"late", "paused"}:
        return failed(SENTENCE, f"not spoken: {played.words}", remedy(played.reason))
    words = (played.words or "it ended without a reason").removeprefix(f"Talk {played.state.name.lower()}: ")
    step = remedy(played.reason, words, played.player, device)
    if played.beside_speech and step == _BUSY:
        return ok(SENTENCE, f"the device is busy with what the server speaks at this moment ({words})")
    label = f"{played.state.name}, {played.reason}" if played.reason else played.state.name
    if played.reason == "audio_stalled" and played.suspended:
        words = f"{words}; suspended: {', '.join(played.suspended)}"
        return failed(SENTENCE, f"{label}: {words}", f"pactl suspend-sink {played.suspended[0]} 0")
    # Player and device have been looked at from nearer before, unless the player itself names the cause.
    causes = {*_OF_PLAYER, "no_player", *(_OF_START if hangs else ())}
    if played.reason in causes and behind is not None and step != _BUSY:
        step = behind
    return failed(SENTENCE, f"{label}: {words}", step)
