"""Reasons why a goal is rejected or doesn't succeed.

To add a reason, add a member here. The table of reasons in the protocol's document is generated from the members.
"""

from __future__ import annotations

from enum import Enum

from talkcli.goals.states import State

_RECALLED, _PREEMPTED = State.RECALLED, State.PREEMPTED
_REJECTED, _ABORTED, _LOST = State.REJECTED, State.ABORTED, State.LOST


class Reason(str, Enum):
    """Machine-readable reason why a goal was rejected or didn't succeed. Its meaning never changes.

    `Goal.reason` is a plain string because a newer server may send a reason that this client doesn't know.
    """

    #: goal states in which this reason can occur
    states: tuple[State, ...]
    #: description in Markdown, for the protocol's document
    meaning: str

    def __new__(cls, code: str, states: tuple[State, ...] = (), meaning: str = "") -> Reason:
        reason = str.__new__(cls, code)
        reason._value_, reason.states, reason.meaning = code, states, meaning
        return reason

    CANCELED = "canceled", (_RECALLED, _PREEMPTED), "`cancel`"
    PREEMPTED = "preempted", (_RECALLED, _PREEMPTED), "a goal with `preempt` or `flush`"
    REPLACED = "replaced", (_RECALLED,), "a newer goal with its key"
    EXPIRED = (
        "expired",
        (_RECALLED,),
        "it had not begun when its `ttl` was over; PREEMPTED where an engine had died over it before it began",
    )
    DISPLACED = (
        "displaced",
        (_RECALLED,),
        "the queue was full, and a goal of a higher priority came, or a goal of the same priority with `preempt`. "
        "The newest goal of the lowest priority is displaced",
    )
    SHUTDOWN = "shutdown", (_RECALLED, _PREEMPTED, _REJECTED), "the server is ending"
    THROTTLED = "throttled", (_REJECTED,), "the same was said, or is waiting: `throttle`"
    QUEUE_FULL = "queue_full", (_REJECTED,), "the queue was full, and the goal could displace none"
    INVALID_TEXT = "invalid_text", (_REJECTED,), "empty, no valid Unicode, or nothing in it that can be seen"
    TEXT_TOO_LONG = "text_too_long", (_REJECTED,), "more than 10,000 characters (`--max-text`) or 40,000 bytes"
    BAD_OPTION = "bad_option", (_REJECTED, _ABORTED), "an option out of its range, or one that the driver refuses"
    UNKNOWN_VOICE = (
        "unknown_voice",
        (_REJECTED, _ABORTED),
        "the engine has no such voice, or lacks what it takes: the message says what to install",
    )
    ID_CONFLICT = "id_conflict", (_REJECTED,), "another text has this id already"
    NO_PLAYER = "no_player", (_ABORTED,), "no program to play with, and no sound server that answers"
    AUDIO_DEVICE = (
        "audio_device",
        (_ABORTED,),
        "the player could not begin, or the sound server has only a dummy output",
    )
    AUDIO_LOST = "audio_lost", (_ABORTED,), "the player ended before the sound did, or only a dummy output was left"
    AUDIO_STALLED = "audio_stalled", (_ABORTED,), "the player took no sound any more, or its device was suspended"
    MUTED = "muted", (_ABORTED,), "its output is muted, and it was to be `audible`"
    VOICE_FAILED = (
        "voice_failed",
        (_ABORTED,),
        "a neural voice's files are not as they should be: the message names the file, and what to do",
    )
    ENGINE_FAILED = "engine_failed", (_ABORTED,), "the engine cannot start, or the synthesiser reported an error"
    ENGINE_CRASHED = "engine_crashed", (_ABORTED,), "the engine process died"
    ENGINE_HUNG = "engine_hung", (_ABORTED,), "the engine process said nothing any more"
    NOTHING_TO_SAY = "nothing_to_say", (_ABORTED,), "nothing in the text can be spoken"
    NOT_SILENT = "not_silent", (_ABORTED,), "it was stopped, and silence was not confirmed within 2 s"
    # The next two reasons are set only by clients.
    NOT_SENT = "not_sent", (_REJECTED,), "the client could not send it: it never reached a server"
    LOST = "lost", (_LOST,), "the connection ended first"

    # Print members as plain strings in every Python version.
    __str__ = str.__str__
    __repr__ = str.__repr__


#: A machine-readable reason for a refusal, and a message with the details.
Refusal = tuple[Reason, str]
