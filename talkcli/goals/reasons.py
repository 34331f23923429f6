"""Reasons why a goal is rejected or doesn't succeed.

To add a reason, add a member here. The table of reasons in the protocol's document is generated from the members.
"""

from __future__ import annotations

from enum import Enum

from talkcli.goals.states import State

_RECALLED, _PREEMPTED = State.RECALLED, State.PREEMPTED
_REJECTED, _ABORTED, _LOST = State.REJECTED, State.ABORTED, State.LOST


class Reason(str, Enum):
    """The machine-readable reason why a goal was rejected or didn't succeed.

    Its meaning never changes. `Goal.reason` is a plain string because a newer server may send a reason that this client
    doesn't know.
    """

    #: goal states in which this reason can occur
    states: tuple[State, ...]
    #: description in Markdown, for the protocol's document
    meaning: str

    def __new__(cls, code: str, states: tuple[State, ...] = (), meaning: str = "") -> Reason:
        reason = str.__new__(cls, code)
        reason._value_, reason.states, reason.meaning = code, states, meaning
        return reason

    CANCELED = "canceled", (_RECALLED, _PREEMPTED), "a client cancelled the goal"
    PREEMPTED = (
        "preempted",
        (_RECALLED, _PREEMPTED),
        "a goal with `preempt` or `flush` interrupted or removed this goal",
    )
    REPLACED = "replaced", (_RECALLED,), "a newer goal with the same key replaced this goal"
    EXPIRED = (
        "expired",
        (_RECALLED,),
        "the goal did not start within its `ttl`. If an engine crashed before the first word, the goal is PREEMPTED",
    )
    DISPLACED = (
        "displaced",
        (_RECALLED,),
        "the queue was full, and a goal with a higher priority, or with the same priority and `preempt`, needed room. "
        "The newest goal with the lowest priority is removed first",
    )
    SHUTDOWN = "shutdown", (_RECALLED, _PREEMPTED, _REJECTED), "the server was stopped"
    THROTTLED = "throttled", (_REJECTED,), "the goal repeats another goal too soon (`throttle`)"
    QUEUE_FULL = "queue_full", (_REJECTED,), "the queue was full, and the goal could not displace another one"
    INVALID_TEXT = "invalid_text", (_REJECTED,), "the text is empty or invisible, contains NUL, or is not valid Unicode"
    TEXT_TOO_LONG = "text_too_long", (_REJECTED,), "the text exceeds 10,000 characters (`--max-text`) or 40,000 bytes"
    BAD_OPTION = "bad_option", (_REJECTED, _ABORTED), "an option is out of range, or the driver rejects its value"
    UNKNOWN_VOICE = (
        "unknown_voice",
        (_REJECTED, _ABORTED),
        "the engine doesn't have the voice, or a package is missing; `message` says what to install",
    )
    UNKNOWN_SOUND = "unknown_sound", (_REJECTED, _ABORTED), "there is no sound with this name"
    BAD_SOUND = "bad_sound", (_REJECTED, _ABORTED), "the file of a sound can't be played; `message` says why"
    ID_CONFLICT = "id_conflict", (_REJECTED,), "the id was already used for another text"
    NO_PLAYER = "no_player", (_ABORTED,), "no player is installed, and no sound server responds"
    AUDIO_DEVICE = "audio_device", (_ABORTED,), "the player can't start, or the sound server has only a dummy output"
    AUDIO_LOST = "audio_lost", (_ABORTED,), "the player exited too early, or only a dummy output was left"
    AUDIO_STALLED = "audio_stalled", (_ABORTED,), "the player stopped accepting sound, or its device was suspended"
    MUTED = "muted", (_ABORTED,), "the output is muted, and the goal was sent with `audible`"
    VOICE_FAILED = "voice_failed", (_ABORTED,), "a neural voice can't be loaded; `message` says why, and what to do"
    ENGINE_FAILED = "engine_failed", (_ABORTED,), "the engine can't start, or the synthesizer reported an error"
    ENGINE_CRASHED = "engine_crashed", (_ABORTED,), "the engine process died"
    ENGINE_HUNG = "engine_hung", (_ABORTED,), "the engine process stopped responding"
    NOTHING_TO_SAY = "nothing_to_say", (_ABORTED,), "nothing in the text can be spoken"
    TEXT_STALLED = (
        "text_stalled",
        (_ABORTED,),
        "all of a growing text was spoken, and no more text arrived for `stall` seconds",
    )
    BROKEN_OFF = (
        "broken_off",
        (_RECALLED, _ABORTED),
        "the sender of a growing text left, or gave up, before the text ended",
    )
    NOT_SILENT = "not_silent", (_ABORTED,), "the goal was stopped, but silence was not confirmed within 2 s"
    # Only clients set the next two reasons.
    NOT_SENT = "not_sent", (_REJECTED,), "the client could not send the goal, so it never reached a server"
    LOST = "lost", (_LOST,), "the connection to the server was lost before the goal ended"

    # Print members as plain strings in every Python version.
    __str__ = str.__str__
    __repr__ = str.__repr__


#: A machine-readable reason for a refusal, and a message with the details.
Refusal = tuple[Reason, str]
