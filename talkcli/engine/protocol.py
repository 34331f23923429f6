"""The messages between the server's engine thread and the engine process: one JSON object per line, over a socket pair.

The engine thread has one end of the socket pair. The other end is the standard input of the engine process (file
descriptor 0), which it reads and writes. This module only defines the messages and opens nothing, so tests can use it
to write a scripted engine process.

The engine process must keep this order. It first receives one `Configure`. It then sends `Ready`, or it sends
`StartFailed` and ends. For each `Speak` it sends one `Started`, then any number of `Word`, `Alive`, `OutputChanged`,
`VoiceChosen` and `Held`, then exactly one `Ended`. It answers each `LoadVoice` with a `VoiceLoaded`, at any time. If
the server closes its end, the engine process stops the current sentence and ends.
"""

from __future__ import annotations

import json

from talkcli.frozen import TYPE_CHECKING, fields, frozen
from talkcli.goals.reasons import Reason

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import TypeVar

    _M = TypeVar("_M")

    from talkcli.goals.goal import JsonObject

#: Longest time between two messages of an engine process that is speaking or loading a voice. It is far below
#: `HANG_LIMIT_S`, so one late message doesn't count as a hang. An idle process sends nothing, to let the robot sleep.
ALIVE_INTERVAL_S = 0.5

#: Environment variable with the number of the liveness pipe's writing end, which the player must inherit. When the pipe
#: is closed, the server knows that the process and the player are gone.
LIVENESS_VARIABLE = "TALK_LIVENESS_FD"

#: Name of the player that writes to `Configure.output_fd`, as it appears in the messages of `Ended`.
OUTPUT_STREAM_NAME = "the output"

# Time limits for the engine process. The server, `say -o` and `talk doctor` all use them.

#: Limit for a new process to become ready. A cold start from an SD card takes two or three seconds.
START_LIMIT_S = 10.0
#: Longest silence of a process that is speaking or loading a voice, before it counts as hung.
HANG_LIMIT_S = 3.0
#: Limit for loading a neural voice. It takes three seconds on a small machine.
LOAD_LIMIT_S = 60.0
#: Limit for confirming a stop, after which the process is killed.
STOP_LIMIT_S = 0.15
#: Limit for a killed process and its player to be gone.
KILL_LIMIT_S = 2.0
#: Limit for confirming a hold, after which the process is killed. It is twice as long as a client waits for a pause,
#: because a foreign driver may first finish its word or more.
HOLD_LIMIT_S = 4.0

# Outcomes of a `Speak`.
OUTCOME_COMPLETED = "completed"  # the player took every sample and ended well
OUTCOME_STOPPED = "stopped"  # a `Stop` ended it, and it is silent now
OUTCOME_FAILED = "failed"  # an error ended it; `reason` and `message` describe the error


@frozen
class Configure:
    """The settings of a new engine process."""

    #: process id of the server. If the process has another parent, the server is gone and the process ends.
    server_pid: int
    #: name of a pyttsx3 driver; None for the usual one (`talk`'s own on Linux)
    driver: str | None
    #: "aplay", "pacat", "pw-cat", "null", "file:PATH" or a command line; None to try the installed ones
    player: str | None
    #: device in the player's own notation; None for its default
    device: str | None
    #: voice to check at the start, by id, name or language; None for the driver's default
    voice: str | None
    #: milliseconds of silence before a sentence if the device was idle
    lead_in: int = 0
    #: whether to send a `VoiceList` right after `Ready`
    list_voices: bool = True
    #: inherited descriptor to write a WAV file of all sentences to instead of playing them
    output_fd: int | None = None
    #: whether a sentence fails if the output is muted, unless its `Speak` says otherwise
    audible: bool = False
    #: program that worked last, which is tried first if `player` is None; None for the usual order
    last_player: str | None = None


@frozen
class Speak:
    """Speak a text. Settings are absolute."""

    id: str
    text: str
    rate: int  # words per minute, 80 to 450
    volume: float  # 0.0 to 1.0
    voice: str | None  # id, name or language; None for the driver's default
    pitch: int  # 0 to 100; 50 is the voice's own
    next_waits: bool = False  # whether another goal waits behind this one
    next_is_neural: bool = False  # whether the waiting goal asks for a neural voice
    lead_in: int | None = None  # milliseconds of silence before it, even if the device wasn't idle; None as configured
    audible: bool | None = None  # whether it fails if the output is muted; None as configured
    voice_only: bool = False  # whether it waits for its neural voice to load, and fails without it


@frozen
class Stop:
    """Be silent now. Ignored if this goal is not being spoken, because it may have ended before the stop arrived."""

    id: str


@frozen
class Hold:
    """Hold the sentence where it is and send `Held` once it is silent. Ignored if this goal is not being spoken."""

    id: str
    number: int  # of the hold within the goal, from 1


@frozen
class Continue:
    """Go on where the sentence was held. Ignored if it is not held."""

    id: str


@frozen
class NextGoal:
    """Note whether another goal waits behind the one being spoken."""

    id: str  # of the goal being spoken
    next_waits: bool
    next_is_neural: bool = False  # whether the waiting goal asks for a neural voice


@frozen
class LoadVoice:
    """Load a neural voice while speech goes on. Answered by one `VoiceLoaded`."""

    voice: str  # id without a speaker


@frozen
class DropVoice:
    """Remove a neural voice from memory, after the current sentence if that uses it. Answered by `VoiceMemory`."""

    voice: str  # id without a speaker


@frozen
class Voice:
    """A voice of the driver."""

    id: str
    language: str | None
    name: str
    quality: str | None = None  # of a neural voice, in its maker's word: "medium"
    #: names of a neural voice's speakers, in the order of their numbers; None from the engine process, because
    #: pyttsx3's list has no room for them
    speakers: tuple[str, ...] | None = None


@frozen
class Ready:
    """The engine is initialised and accepts a `Speak`."""

    driver: str
    version: str | None  # of the synthesizer, for people: "eSpeak NG 1.51 (system)"
    player: str | None  # player that is tried first, for people
    voice: str | None = None  # id of the neural voice named by `Configure.voice`; None for any other voice


@frozen
class StartFailed:
    """The engine can't start. The process ends after this message."""

    reason: Reason  # ENGINE_FAILED or UNKNOWN_VOICE
    message: str  # names what is missing and what to install
    permanent: bool = True  # whether the next start will fail too unless somebody changes something
    usage_error: bool = False  # whether an option asked for something that doesn't exist


@frozen
class VoiceList:
    """All voices of the driver. Sent once, right after `Ready`, if `Configure` asks for it."""

    voices: tuple[Voice, ...]


@frozen
class VoiceLoaded:
    """A neural voice is loaded, or can't be loaded."""

    voice: str  # id without a speaker
    seconds: float  # time it took
    error: str | None = None  # reason why it can't be loaded, for people; None if it is loaded


@frozen
class VoiceUnloaded:
    """A neural voice is no longer loaded because its files have changed."""

    voice: str  # id without a speaker


@frozen
class VoiceMemory:
    """Memory taken by neural voices. Sent when it changes: before `VoiceLoaded`, after a sentence or a `DropVoice`."""

    voice: str  # id, without a speaker, of the voice that was loaded or has spoken; "" after `DropVoice`
    memory: int  # bytes by which the process has grown since before its first neural voice


@frozen
class Started:
    """The engine process has begun with the goal."""

    id: str


@frozen
class Alive:
    """A sign of life from a process that is speaking or loading a voice, `ALIVE_INTERVAL_S` after its last message."""

    id: str  # of the goal; "" if there is none


@frozen
class Word:
    """A word is beginning to be heard now, according to the playback clock."""

    id: str
    start: int  # character offset in the text
    end: int  # offset after the word's last character
    number: int  # of the word in the sentence, from 1
    time: float  # seconds into the sentence's audio


@frozen
class OutputChanged:
    """Where the sentence is played and how loud. Sent once that is known and whenever it changes."""

    id: str
    output: JsonObject | None  # in the form that a goal has; None if the player in use can't tell


@frozen
class VoiceChosen:
    """The voice that speaks the sentence. Sent again if another voice takes over before the first word."""

    id: str
    voice: str  # id of the voice
    fallback_reason: str | None = None  # why it isn't the voice that was asked for, for people; None if it is


@frozen
class Held:
    """The sentence is held and silent, until `Continue` or `Stop`."""

    id: str
    number: int  # of the `Hold` that this answers


@frozen
class Ended:
    """The `Speak` is over and silent. Its player is reaped or its stream is closed."""

    id: str
    outcome: str  # OUTCOME_COMPLETED, OUTCOME_STOPPED or OUTCOME_FAILED
    reason: Reason | None = None  # of a failure
    message: str | None = None  # of a failure: the message of the player or the engine
    duration: float | None = None  # seconds of audio; None if part of it wasn't synthesized
    gaps: int = 0  # number of silences within it because its sound was not made in time
    gap_seconds: float = 0.0  # total length of these silences
    player: str | None = None  # player that took the sound, if `Configure` names none


#: Commands that begin a goal: one for each kind of goal.
GoalCommand = Speak
Command = Configure | GoalCommand | Stop | Hold | Continue | NextGoal | LoadVoice | DropVoice
#: Events that belong to the goal given by their `id`.
GoalEvent = Started | Alive | Word | OutputChanged | VoiceChosen | Held | Ended
Event = Ready | StartFailed | VoiceList | VoiceLoaded | VoiceUnloaded | VoiceMemory | GoalEvent

#: Classes of the messages in each direction, by name. A line has the name as its "kind".
COMMAND_CLASSES: dict[str, type[Command]] = {each.__name__: each for each in Command.__args__}
EVENT_CLASSES: dict[str, type[Event]] = {each.__name__: each for each in Event.__args__}

# Created once. `json.dumps` creates an encoder for each line with a `default`, and `json.loads` guesses the encoding of
# each line. Together that is a third of the cost of a line at both ends of the socket.
_JSON_ENCODER = json.JSONEncoder(default=fields)
_JSON_DECODER = json.JSONDecoder()


def encode(message: Command | Event) -> bytes:
    """Return a message as a line."""
    return _JSON_ENCODER.encode({"kind": type(message).__name__, **fields(message)}).encode() + b"\n"


def decode(line: bytes, classes: Mapping[str, type[_M]]) -> _M:
    """Return the message in a line, as one of `COMMAND_CLASSES` or `EVENT_CLASSES`.

    Raises:
        ValueError, TypeError, KeyError: the line is no such message.
    """
    content = _JSON_DECODER.decode(line.decode())
    if not isinstance(content, dict):
        raise TypeError("a message is a JSON object")
    message_class = classes[content.pop("kind")]
    if content.get("reason") is not None:
        content["reason"] = Reason(content["reason"])
    if message_class is VoiceList:
        content["voices"] = tuple(Voice(**each) for each in content["voices"])
    return message_class(**content)
