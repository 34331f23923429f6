"""The check that speaks a sentence through the server or the doctor's own engine.

The server treats the sentence like any other goal. After it was played, another sentence at volume 0 is cancelled at
its first word, to measure how long a stop takes.
"""

from __future__ import annotations

import contextlib
import time
from typing import TYPE_CHECKING

from talkcli.doctor.report import Finding, failure, ok
from talkcli.doctor.sound import START_SOUND_SERVER, is_custom_command
from talkcli.doctor.voice import INSTALL_LIBRARY, SENTENCE_RATE_WPM, SENTENCE_TEXT, explain_failure, start_engine
from talkcli.engine import protocol
from talkcli.engine.parent.process import EngineFailed
from talkcli.engine.players import is_silent
from talkcli.errors import TalkError
from talkcli.frozen import frozen, replace
from talkcli.goals.goal import message_details
from talkcli.goals.reasons import Reason
from talkcli.goals.states import State
from talkcli.polling import Interrupted
from talkcli.terminal.goals import describe_pause

if TYPE_CHECKING:
    from collections.abc import Sequence

    from talkcli.client.client import Client
    from talkcli.client.goal import GoalHandle
    from talkcli.doctor.voice import EngineOptions
    from talkcli.engine.parent.process import PrivateEngine
    from talkcli.goals.goal import Goal

_SENTENCE_CHECK = "sentence"
#: The sentence to play silently beside a running server. It is short, because some devices accept only one player at a
#: time, but long enough to show whether the player works.
SILENT_TEXT, _SILENT_RATE_WPM = "talk works well", 450
#: The silent sentence that is cancelled at its first word. Its text is in the log of goals. If its first word isn't
#: spoken within this many seconds, the stop is not measured.
STOP_TEXT, _STOP_LIMIT_S = "talk doctor cancels this silent sentence", 2.0
#: Advice for each reason why a goal can end. The reasons "late" and "paused" are only used by the doctor. A test checks
#: that each reason for aborting a goal has advice.
ADVICE: dict[str, str] = {
    Reason.NO_PLAYER: "sudo apt-get install -y alsa-utils",
    Reason.AUDIO_DEVICE: "connect the loudspeaker, close other programs that play sound, and list the cards: aplay -l",
    Reason.AUDIO_LOST: "check whether the loudspeaker was unplugged, or use another one: talk serve --device NAME",
    Reason.AUDIO_STALLED: "wake the device (pactl suspend-sink @DEFAULT_SINK@ 0), or restart the sound server",
    Reason.MUTED: "unmute the output: pactl set-sink-mute @DEFAULT_SINK@ 0; pactl set-sink-volume @DEFAULT_SINK@ 70%",
    Reason.VOICE_FAILED: "follow the message's advice, or choose another voice: talk set --voice en",
    Reason.ENGINE_FAILED: "install the missing part that the message names, in the server's Python environment",
    Reason.ENGINE_CRASHED: "run talk doctor again; if it fails again, try another voice: talk set --voice en",
    Reason.ENGINE_HUNG: "run talk doctor again when this machine is less busy",
    Reason.NOT_SILENT: "restart the server, because one of its players could not be killed",
    Reason.BAD_OPTION: "leave out the option that the message names",
    Reason.UNKNOWN_VOICE: "choose a voice that 'talk voices' lists: talk set --voice NAME",
    Reason.UNKNOWN_SOUND: "choose a sound that 'talk play --list' lists",
    Reason.BAD_SOUND: "follow the message's advice, or choose another sound: talk play --list",
    Reason.NOTHING_TO_SAY: "send a text in the voice's language, or choose a voice for the text: talk set --voice NAME",
    Reason.TEXT_STALLED: "make the program that writes the text faster, or wait longer: talk say --stream --stall 60",
    Reason.BROKEN_OFF: "find out why the program that sent the text ended early",
    Reason.QUEUE_FULL: "empty the queue: talk cancel",
    Reason.SHUTDOWN: "start the server again: talk serve",
    Reason.LOST: "start the server again: talk serve",
    "late": "see what is being spoken with 'talk status', or cancel it with 'talk cancel'",
    "paused": "talk resume",
}
#: The finding if the server's player can't be tested, because it runs elsewhere.
SENTENCE_ELSEWHERE = failure(
    _SENTENCE_CHECK,
    "not played: the server and its player run on another machine or in a container",
    "run 'talk doctor --silent' there, or run 'talk doctor' here, so that the server plays a sentence",
)
#: Advice if the player of another user's server failed. The doctor can't use that server's environment.
RUN_AS_OWNER = (
    "run talk doctor as the server's user, whose sound settings may differ: sudo -u '#{}' talk doctor --silent"
)
_BUSY_STEP = "another program uses the device: close it, or play through a sound server (PipeWire, PulseAudio)"
_PLAYER_REASONS = {Reason.AUDIO_DEVICE, Reason.AUDIO_LOST, Reason.AUDIO_STALLED}
_START_REASONS = {Reason.ENGINE_FAILED, Reason.ENGINE_HUNG}
#: The checks that can explain why a player failed, with the most likely cause first.
_PLAYBACK_CHECKS = ("player", "device", "sound server", "group", "cards", "session")


@frozen
class SentenceResult:
    """How the doctor's test sentence ended."""

    state: State
    #: machine-readable reason why the goal ended, or "late" or "paused" if the doctor cancelled it
    reason: str | None = None
    message: str | None = None
    #: length of the sound in seconds
    duration: float | None = None
    player: str | None = None
    #: whether the server spoke the sentence
    by_server: bool = False
    #: whether the server spoke at the same time as the doctor's own engine
    beside_speech: bool = False
    #: the sinks that were suspended after the sentence
    suspended: tuple[str, ...] = ()
    #: the device that played the sentence while it was muted, or None
    muted_device: str | None = None
    #: seconds from the request to the first sound, or None if unknown
    onset_s: float | None = None
    #: seconds from a cancel to silence, or None if unknown
    stop_s: float | None = None


def speak_by_server(client: Client, text: str, limit: float) -> SentenceResult:
    """Speak a sentence through the server, and measure its start. Then measure the stop of a silent one.

    Return how the sentence ended. Cancel it after `limit` seconds.
    """
    try:
        asked_at = time.monotonic()
        goal = client.say(text, preempt=False, ttl=0, feedback=True)
        try:
            if goal.speech_paused:
                return SentenceResult(goal.cancel().state, "paused", f"not spoken: {describe_pause(goal.pause)}")
            # The time of a word is measured from the first sound.
            onsets = [time.monotonic() - word.time - asked_at for word in goal.feedback(limit)]
            result = _convert_ended_goal(goal.wait(limit))
            with contextlib.suppress(TalkError):  # the result is valid even if the server ends now
                result = replace(result, player=client.status().server.get("player"))
                if result.state is State.SUCCEEDED and onsets and not is_silent(result.player):
                    result = replace(result, onset_s=onsets[0], stop_s=_time_server_stop(client))
            return result
        except TimeoutError:
            return _cancel_late_goal(client, goal, limit)
        except Interrupted:
            goal.request_cancel()
            raise
    except TalkError as error:
        return SentenceResult(State.LOST, Reason.LOST, error.message)


def _time_server_stop(client: Client) -> float | None:
    """Cancel a silent sentence at its first word. Return how many seconds the server needed to stop it.

    Return None if the sentence was not spoken.
    """
    saying = client.saying(STOP_TEXT, preempt=False, ttl=_STOP_LIMIT_S, volume=0.0, audible=False, feedback=True)
    canceled_at = None
    with contextlib.suppress(TimeoutError), saying as goal:
        if next(goal.feedback(_STOP_LIMIT_S), None) is not None:
            canceled_at = time.monotonic()
    return time.monotonic() - canceled_at if canceled_at and goal.state is State.PREEMPTED else None


def _cancel_late_goal(client: Client, goal: GoalHandle, limit: float) -> SentenceResult:
    """Cancel a goal that took too long. Return a result that explains the delay."""
    before = client.status()
    ended = goal.cancel()
    if ended.state in {State.SUCCEEDED, State.ABORTED}:  # the goal ended before it could be cancelled
        return _convert_ended_goal(ended)
    pending = [each.id for each in before.pending]
    if before.server.get("paused") is True:
        return SentenceResult(ended.state, "paused", f"not spoken: {describe_pause(before.server)}")
    if goal.id not in pending:
        return SentenceResult(
            ended.state, "late", f"the sentence was cancelled, because it had not ended after {limit:g} s"
        )
    ahead = pending.index(goal.id) + bool(before.active) + len(before.interrupted)
    goals = "1 goal" if ahead == 1 else f"{ahead} goals"
    return SentenceResult(ended.state, "late", f"not spoken: it was still waiting behind {goals} after {limit:g} s")


def _convert_ended_goal(goal: Goal) -> SentenceResult:
    """Convert an ended goal to a SentenceResult."""
    muted = goal.output.device if goal.output and goal.output.muted else None
    return SentenceResult(goal.state, goal.reason, goal.message, goal.duration, by_server=True, muted_device=muted)


def speak_beside_server(client: Client, options: EngineOptions, limit: float) -> SentenceResult:
    """Speak a silent sentence with the doctor's own engine, beside the server. Return how it ended.

    The result also shows whether the server spoke at the same time.
    """
    try:
        before = client.status()
        result = speak_by_engine(SILENT_TEXT, options, 0.0, limit)
        after = client.status()
    except TalkError as error:
        return SentenceResult(State.LOST, Reason.LOST, error.message)
    spoken = {each.id for each in after.recent if each.state in {State.SUCCEEDED, State.PREEMPTED}}
    spoke = before.active or after.active or spoken - {each.id for each in before.recent}
    return replace(result, beside_speech=bool(spoke))


def speak_by_engine(text: str, options: EngineOptions, volume: float, limit: float) -> SentenceResult:
    """Speak a sentence with the doctor's own engine. Return how it ended.

    Give up after `limit` seconds. Times are measured unless the volume is 0.
    """
    try:
        with start_engine(options, limit) as engine:
            player = engine.wait_for(protocol.Ready).player
            rate = SENTENCE_RATE_WPM if volume else _SILENT_RATE_WPM
            asked_at = time.monotonic()
            engine.speak(protocol.Speak("doctor", text, rate, volume, options.voice, 50))
            first = _await_word(engine)
            onset = time.monotonic() - first.time - asked_at if isinstance(first, protocol.Word) else None
            ended = engine.wait_for(protocol.Ended) if isinstance(first, protocol.Word) else first
            if ended.outcome == protocol.OUTCOME_COMPLETED:
                player = ended.player or player
                result = SentenceResult(State.SUCCEEDED, duration=ended.duration, player=player)
                if volume and onset is not None and not is_silent(player):
                    result = replace(result, onset_s=onset, stop_s=_time_engine_stop(engine, options))
                return result
            return SentenceResult(State.ABORTED, ended.reason, ended.message or ended.outcome, player=player)
    except EngineFailed as error:
        return SentenceResult(State.ABORTED, *explain_failure(error))
    except TimeoutError:
        return SentenceResult(State.ABORTED, Reason.ENGINE_HUNG, f"the sentence did not end within {limit:g} s")


def _await_word(engine: PrivateEngine) -> protocol.Word | protocol.Ended:
    """Wait for the next word of the engine's sentence, or for the sentence's end. Return the event."""
    return next(each for each in engine.events if isinstance(each, protocol.Word | protocol.Ended))


def _time_engine_stop(engine: PrivateEngine, options: EngineOptions) -> float | None:
    """Stop a silent sentence at its first word. Return how many seconds the engine needed to stop it.

    Return None if the sentence was not spoken.
    """
    with contextlib.suppress(EngineFailed, TimeoutError):
        engine.speak(protocol.Speak("stop", STOP_TEXT, SENTENCE_RATE_WPM, 0.0, options.voice, 50))
        if isinstance(_await_word(engine), protocol.Word):
            stopped_at = time.monotonic()
            engine.stop("stop")
            if engine.wait_for(protocol.Ended).outcome == protocol.OUTCOME_STOPPED:
                return time.monotonic() - stopped_at
    return None


def find_playback_step(findings: Sequence[Finding], *, custom_player: bool = False) -> str | None:
    """Return advice for the most likely cause of a playback fault, or None.

    Args:
        findings: the findings of all checks before the sentence.
        custom_player: whether the player is the user's own command. In that case, only the check of the player counts.
    """
    steps = {each.check: each.next for each in findings}
    checks = _PLAYBACK_CHECKS[:1] if custom_player else _PLAYBACK_CHECKS
    return next((steps[each] for each in checks if steps.get(each) is not None), None)


def advise(
    reason: str | None, message: str | None, player: object = None, device: object = None, text: str | None = None
) -> str:
    """Return advice on a failed goal, based on the goal's reason and message.

    Args:
        reason: the goal's reason.
        message: the goal's message.
        player: the player that was used, if known.
        device: the device that was configured, if known.
        text: the goal's text, if known.
    """
    message = message or ""
    said = message.lower()
    if reason == Reason.NOTHING_TO_SAY and text is not None and not any(map(str.isalnum, text)):
        return "send a text with words: this one has no letters or digits"
    if reason == Reason.AUDIO_DEVICE and "busy" in said:
        return _BUSY_STEP
    if reason == Reason.AUDIO_DEVICE and ("denied" in said or "not permitted" in said):
        return "give the server's user access: sudo usermod -aG audio USER; then log in again, and restart the server"
    if reason == Reason.NO_PLAYER and player == "pulse":
        return START_SOUND_SERVER
    if reason == Reason.ENGINE_FAILED and "libespeak-ng is missing" in message:
        return INSTALL_LIBRARY
    if reason in _PLAYER_REASONS and isinstance(player, str) and is_custom_command(player):
        command = player.replace("{rate}", "22050").replace("{device}", str(device or "default"))
        return f"test the player with a second of silence: head -c 44100 /dev/zero | {command}"
    return ADVICE.get(reason or "", "another client ended the sentence: run talk doctor again")


def judge_sentence(
    result: SentenceResult, *, silent: bool, device: object, playback_step: str | None = None, sound_hangs: bool = False
) -> Finding:
    """Check how the doctor's test sentence ended. Return the finding.

    Args:
        result: how the sentence ended.
        silent: whether it was played without sound.
        device: the device that was configured for the player, or None.
        playback_step: the result of `find_playback_step`.
        sound_hangs: whether the sound server hangs, which also blocks engines when they start.
    """
    if result.state is State.SUCCEEDED and result.muted_device:
        step = ADVICE[Reason.MUTED].replace("@DEFAULT_SINK@", result.muted_device)
        return failure(
            _SENTENCE_CHECK, f"the sentence was played, but the output {result.muted_device} was muted", step
        )
    if result.state is State.SUCCEEDED:
        how = "through the server" if result.by_server else "by talk doctor's own engine"
        seconds = "" if result.duration is None else f", {result.duration:.1f} s"
        player = f", {result.player}" if result.player else ""
        said = "a sentence was played without sound" if silent else f'"{SENTENCE_TEXT}" was played to the end'
        onset, stop = (None if each is None else round(1000 * each) for each in (result.onset_s, result.stop_s))
        times = "" if onset is None else f"; the sound began {onset} ms after the request"
        times += "" if stop is None else f", and stops {stop} ms after a cancel"
        return ok(_SENTENCE_CHECK, f"{said} {how}{player}{seconds}{times}", {"onset_ms": onset, "stop_ms": stop})
    if result.reason in {"late", "paused"}:
        return failure(_SENTENCE_CHECK, result.message or "", ADVICE[result.reason])
    message = message_details(result.message) or "no reason was given"
    step = advise(result.reason, message, result.player, device)
    if result.beside_speech and step == _BUSY_STEP:
        return ok(_SENTENCE_CHECK, f"the device is busy, because the server is speaking ({message})")
    if result.reason == Reason.AUDIO_STALLED and result.suspended:
        message = f"{message}; suspended: {', '.join(result.suspended)}"
        step = f"pactl suspend-sink {result.suspended[0]} 0"
    # The other checks give better advice, unless the player itself reported that its device is busy.
    elif playback_step is not None and step != _BUSY_STEP:
        causes = {*_PLAYER_REASONS, Reason.NO_PLAYER, *(_START_REASONS if sound_hangs else ())}
        step = playback_step if result.reason in causes else step
    label = f"{result.state.name}, {result.reason}" if result.reason else result.state.name
    return failure(_SENTENCE_CHECK, f"{label}: {message}", step)
