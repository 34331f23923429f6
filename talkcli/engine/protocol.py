"""Messages between the server's engine thread and the engine process.

Each message is one line with a JSON object. The messages travel over a socket pair. One end belongs to the engine
thread. The other end is the standard input of the engine process, which both reads and writes it. This module only
defines the messages and opens nothing, so tests can use it to script an engine process.

The engine process follows this sequence:

1. It receives one `Configure`.
2. It sends `Ready`, or it sends `StartFailed` and exits.
3. For each `Speak`, it sends one `Started`, then any number of `Word`, `Alive`, `TextMissing`, `OutputChanged`,
   `VoiceChosen` and `Held` messages, and finally exactly one `Ended`.

It answers each `LoadVoice` with one `VoiceLoaded`, which may be sent at any time. If the server closes its end of the
socket, the engine process stops speaking and exits.
"""

from __future__ import annotations

import json

from talkcli.frozen import TYPE_CHECKING, fields, frozen
from talkcli.goals.reasons import Reason

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import TypeVar

    from talkcli.goals.goal import JsonObject

    _M = TypeVar("_M")

#: Maximum time between two messages from an engine process that is speaking or loading a voice. This is far below
#: `HANG_LIMIT_S`, so that a late message isn't mistaken for a hang. An idle process sends nothing, which lets the robot
#: sleep.
ALIVE_INTERVAL_S = 0.5

#: Environment variable that holds the descriptor number of the liveness pipe's write end. The player must inherit this
#: descriptor. The pipe closes only after both the process and the player have exited, so the server knows when they are
#: gone.
LIVENESS_VARIABLE = "TALK_LIVENESS_FD"

#: Name of the player that writes to `Configure.output_fd`, for error messages.
OUTPUT_STREAM_NAME = "the output"

# Time limits for the engine process, shared by the server, `say -o` and `talk doctor`.

#: Time allowed for a new process to become ready. A cold start from an SD card takes two to three seconds.
START_LIMIT_S = 10.0
#: A process that is speaking or loading a voice counts as hung if it sends no message for this long.
HANG_LIMIT_S = 3.0
#: Time allowed for loading a neural voice. A small machine needs three seconds.
LOAD_LIMIT_S = 60.0
#: Time allowed for confirming a stop. After that, the process is killed.
STOP_LIMIT_S = 0.15
#: Time allowed for a killed process and its player to exit.
KILL_LIMIT_S = 2.0
#: Time allowed for confirming a pause. After that, the process is killed. This is twice as long as a client waits for a
#: pause, because a third-party driver may finish some words first.
HOLD_LIMIT_S = 4.0

# Outcomes of a `Speak`.
OUTCOME_COMPLETED = "completed"  # the player played every sample
OUTCOME_STOPPED = "stopped"  # a `Stop` ended the goal
OUTCOME_INTERRUPTED = "interrupted"  # an `Interrupt` ended the goal at the end of a word; see `Ended.rest`
OUTCOME_FAILED = "failed"  # an error ended the goal; see `Ended.reason` and `Ended.message`


@frozen
class Configure:
    """The settings for a new engine process."""

    #: process ID of the server; the engine process exits if its parent is another process
    server_pid: int
    #: name of a pyttsx3 driver; None for the default, which is `talk`'s own driver on Linux
    driver: str | None
    #: "aplay", "pacat", "pw-cat", "null", "file:PATH" or a command line; None to try the installed players
    player: str | None
    #: output device, named the way the player expects; None for the player's default
    device: str | None
    #: ID, name or language of a voice to check at startup; None for the driver's default
    voice: str | None
    #: milliseconds of silence to play before a sentence if the device was idle
    lead_in: int = 0
    #: whether to send a `VoiceList` right after `Ready`
    list_voices: bool = True
    #: inherited descriptor that receives all sentences as a WAV stream; None to play them
    output_fd: int | None = None
    #: whether a sentence fails if the output is muted; `Speak.audible` takes precedence
    audible: bool = False
    #: the player to try first if `player` is None. None stands for the default order
    last_player: str | None = None
    #: the directory of sounds; None for the built-in sounds only
    sounds: str | None = None


@frozen
class Speak:
    """The command that makes the engine speak a text.

    Rate, volume and pitch are absolute values, not relative changes.
    """

    id: str
    text: str
    rate: int  # words per minute, 80 to 450
    volume: float  # 0.0 to 1.0
    voice: str | None  # ID, name or language; None for the driver's default
    pitch: int  # 0 to 100; 50 is the voice's natural pitch
    next_waits: bool = False  # whether another goal is waiting in the queue
    next_is_neural: bool = False  # whether the next goal in the queue uses a neural voice
    lead_in: int | None = None  # milliseconds of silence to play before the text; None to use `Configure.lead_in`
    audible: bool | None = None  # whether to fail if the output is muted; None to use `Configure.audible`
    voice_only: bool = False  # whether to wait for the neural voice to load, and fail if it can't be loaded
    format: str = "text"  # "text", "markdown", or "sound" if the text is the name of a sound
    more: bool = False  # whether text will be added with `Append`
    broken: bool = False  # whether the text broke off; an incomplete sentence at its end is not spoken
    pronunciations: dict[str, str] | None = None  # terms of the text with their replacements
    # If the goal was interrupted, the next fields describe the part that was heard.
    start: int = 0  # offset in the text at which the speech begins, or the number of samples of a sound to skip
    heard_end: int = 0  # offset of the end of the last word that was reported
    heard_words: int = 0  # number of words that were reported
    heard: float = 0.0  # seconds of audio that were heard


@frozen
class Append:
    """The command to add text to a goal that is still growing.

    It is ignored if the goal has ended.
    """

    id: str
    text: str
    end: bool  # whether the text is now complete
    broken: bool = False  # whether the text broke off; an incomplete sentence at its end is not spoken


@frozen
class Stop:
    """The command to stop speaking a goal at once.

    The process ignores it if the goal has already ended.
    """

    id: str


@frozen
class Interrupt:
    """The command to end a goal at the end of the current word, so that another `Speak` can continue it.

    The process ignores it if the goal has already ended. If no word follows, the goal ends as usual.
    """

    id: str


@frozen
class Hold:
    """The command to pause a goal.

    The process sends `Held` once the goal is silent, or nothing if it has ended.
    """

    id: str
    number: int  # number of this pause within the goal, starting at 1


@frozen
class Continue:
    """The command to resume a goal. The process ignores it if the goal is not paused."""

    id: str


@frozen
class NextGoal:
    """The command that reports whether another goal waits, and whether its voice is neural.

    It replaces `next_waits` and `next_is_neural` of the current goal.
    """

    id: str  # ID of the current goal
    next_waits: bool  # whether another goal is waiting in the queue
    next_is_neural: bool = False  # whether the next goal in the queue uses a neural voice


@frozen
class LoadVoice:
    """The command to load a neural voice in the background.

    The reply is one `VoiceLoaded`.
    """

    voice: str  # ID of the voice, without a speaker


@frozen
class DropVoice:
    """The command to unload a neural voice once no sentence uses it.

    If it was loaded, the reply is `VoiceMemory`.
    """

    voice: str  # ID of the voice, without a speaker


@frozen
class Voice:
    """A voice that the driver offers."""

    id: str
    language: str | None
    name: str
    quality: str | None = None  # quality level of a neural voice, such as "medium"
    #: speakers of a neural voice, sorted by number. In messages, this is None, because pyttsx3's list of voices has no
    #: field for speakers.
    speakers: tuple[str, ...] | None = None


@frozen
class Ready:
    """The engine is initialized and accepts `Speak` messages."""

    driver: str
    version: str | None  # human-readable version of the synthesizer, such as "eSpeak NG 1.51 (system)"
    player: str | None  # display name of the player that is tried first
    voice: str | None = None  # ID of the voice in `Configure.voice` if it is neural, otherwise None


@frozen
class StartFailed:
    """The engine can't start. The process exits after sending this message."""

    reason: Reason  # ENGINE_FAILED or UNKNOWN_VOICE
    message: str  # human-readable error, which says what to install
    permanent: bool = True  # whether the engine can't start until the user has fixed something
    usage_error: bool = False  # whether a command-line option names something that doesn't exist


@frozen
class VoiceList:
    """All voices that the driver offers.

    The process sends this once, right after `Ready`, if `Configure.list_voices` is true.
    """

    voices: tuple[Voice, ...]


@frozen
class VoiceLoaded:
    """A neural voice was loaded, or loading failed."""

    voice: str  # ID of the voice, without a speaker
    seconds: float  # number of seconds that loading took
    error: str | None = None  # human-readable error; None if the voice was loaded


@frozen
class VoiceUnloaded:
    """A neural voice was unloaded because its files have changed."""

    voice: str  # ID of the voice, without a speaker


@frozen
class VoiceMemory:
    """The memory used by neural voices.

    The process sends this before `VoiceLoaded`, and after a sentence or a `DropVoice`.
    """

    voice: str  # ID of the voice that was loaded or used, without a speaker; empty after `DropVoice`
    memory: int  # memory growth in bytes since before the first neural voice was loaded


@frozen
class Started:
    """The engine process has begun working on the goal."""

    id: str


@frozen
class Alive:
    """A heartbeat from a busy process that has sent nothing else for `ALIVE_INTERVAL_S`."""

    id: str  # ID of the current goal; empty if only a voice is loading


@frozen
class Word:
    """The position of a word in the text and in the sound, sent when the word is heard."""

    id: str
    start: int  # offset of the word's first character in the text
    end: int  # offset after the word's last character
    number: int  # number of the word in the sentence, starting at 1
    time: float  # position in the sentence's audio, in seconds


@frozen
class TextMissing:
    """The goal has fallen silent because the next text hasn't arrived, or it is speaking again.

    While the goal is silent, the event is repeated after long additions that can't be spoken yet.
    """

    id: str
    missing: bool
    length: int  # number of characters of the text that the process has received


@frozen
class OutputChanged:
    """The device, volume and mute state of the current output.

    The process sends this when they become known or change.
    """

    id: str
    output: JsonObject | None  # the goal's `output` field as JSON; None if the player can't determine it


@frozen
class VoiceChosen:
    """The voice that speaks the goal.

    The process sends this again if a fallback voice replaces it before the first word.
    """

    id: str
    voice: str  # voice ID
    fallback_reason: str | None = None  # human-readable reason for a fallback voice; None if the requested voice speaks


@frozen
class Held:
    """The goal is paused, and stays silent until `Continue` or `Stop`."""

    id: str
    number: int  # number of the `Hold` that this message confirms


@frozen
class Ended:
    """The goal has ended, and nothing more of it will be heard."""

    id: str
    outcome: str  # one of the constants such as OUTCOME_COMPLETED
    reason: Reason | None = None  # reason for the failure, if the goal failed
    message: str | None = None  # error message of the player or the engine, if the goal failed
    duration: float | None = None  # length of the audio in seconds; None unless the goal was completed
    gaps: int = 0  # number of silent gaps caused by audio that was synthesized too late
    gap_seconds: float = 0.0  # total length of the silent gaps, in seconds
    player: str | None = None  # the player that worked last, if it was chosen automatically
    heard: float | None = None  # seconds of the audio that were heard; None if unknown
    rest: int | None = None  # the `start` of the `Speak` that continues the goal; None unless it was interrupted


#: The command that starts a goal.
GoalCommand = Speak
#: Commands for the current goal, which they name by its `id`.
ActiveGoalCommand = Append | Stop | Interrupt | Hold | Continue | NextGoal
Command = Configure | GoalCommand | ActiveGoalCommand | LoadVoice | DropVoice
#: Events about the goal with the given `id`.
GoalEvent = Started | Alive | Word | TextMissing | OutputChanged | VoiceChosen | Held | Ended
VoiceEvent = VoiceList | VoiceLoaded | VoiceUnloaded | VoiceMemory
Event = Ready | StartFailed | VoiceEvent | GoalEvent

#: Message classes for each direction, by class name. Each message contains its class name as "kind".
COMMAND_CLASSES: dict[str, type[Command]] = {each.__name__: each for each in Command.__args__}
EVENT_CLASSES: dict[str, type[Event]] = {each.__name__: each for each in Event.__args__}


def encode(message: Command | Event) -> bytes:
    """Return a message as a line of JSON."""
    return json.dumps({"kind": type(message).__name__, **fields(message)}, default=fields).encode() + b"\n"


def decode(line: bytes, classes: Mapping[str, type[_M]]) -> _M:
    """Parse a line of JSON. Return a message of one of the given classes.

    Args:
        line: the line of JSON.
        classes: `COMMAND_CLASSES` or `EVENT_CLASSES`.

    Raises:
        ValueError, TypeError, KeyError: the line is not a valid message.
    """
    content = json.loads(line.decode())
    if not isinstance(content, dict):
        raise TypeError("a message must be a JSON object")
    message_class = classes[content.pop("kind")]
    if content.get("reason") is not None:
        content["reason"] = Reason(content["reason"])
    if message_class is VoiceList:
        content["voices"] = tuple(Voice(**each) for each in content["voices"])
    return message_class(**content)
