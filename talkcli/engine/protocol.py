"""What the server's engine thread and the engine process say to each other: one JSON object a line, over a socket pair.

The server's half of the pair is the thread's, the other half is the process's standard input (file descriptor 0, both
directions). This module holds only the form of the messages: it opens, reads and starts nothing, so that a scripted
engine process can be written against it.

Order, as the process must keep it: `Configure` comes in once, first. Then `Ready` goes out, or `StartFailed` and the
process ends. After that each `Say` gets one `Started`, any number of `Word`, `Alive`, `Output`, `Speaks` and `Paused`,
and exactly one `Ended`; each `Load` gets a `Loaded`, at any time. Where the server's half is closed, the sentence being
spoken is stopped and the process ends.
"""

from __future__ import annotations

import json

from talkcli.frozen import TYPE_CHECKING, fields, frozen

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import TypeVar

    _M = TypeVar("_M")

    from talkcli.goals.goal import JsonObject

#: Seconds between two messages of an engine process that has a goal in hand, or loads a voice. Far below `HANG_AFTER`,
#: so that one late message is not taken for a hang; nothing is sent while idle, so that an idle robot is not woken.
ALIVE_EVERY = 0.5

#: Names, in the environment, the descriptor that the player must inherit: by its end the server sees that process and
#: player are gone.
LIVENESS_VARIABLE = "TALK_LIVENESS_FD"

# How long an engine process may take for what it has to do, whoever watches it: server, `say -o`, `talk doctor`.

#: Seconds until a process that was started must be ready: a cold start from an SD card takes two or three.
START_LIMIT = 10.0
#: Seconds without a sign of life from a process that has a goal in hand, or loads a voice; it sends one each
#: `ALIVE_EVERY`.
HANG_AFTER = 3.0
#: Seconds after which a neural voice is given up that is being loaded: it takes three on a small machine.
LOAD_LIMIT = 60.0
#: Seconds after which a stop that isn't confirmed becomes a kill.
STOP_LIMIT = 0.15
#: Seconds after a kill in which process and player must be gone.
SILENCE_LIMIT = 2.0
#: Seconds after which a pause that isn't confirmed becomes a kill, twice what a client waits for it: a driver that is
#: not ours may finish its word first, or more.
PAUSE_LIMIT = 4.0

# How a `Say` ended.
COMPLETED = "completed"  # every sample was played and the player ended well
STOPPED = "stopped"  # ended by a `Stop`, and silent now
FAILED = "failed"  # ended by an error: `reason` and `message` say which


@frozen
class Configure:
    """What an engine process is told at its start."""

    #: process id of the server: a process whose parent is another one has been orphaned already, and ends.
    server: int
    #: name of a pyttsx3 driver, or None for the one that fits this system (`talk`'s own on Linux).
    driver: str | None
    #: "aplay", "pacat", "pw-cat", "null", "file:PATH", a command line, or None to take what is there and works.
    player: str | None
    #: device by the player's own name for it, or None for its default.
    device: str | None
    #: voice to check at the start, by id, name or language; None for the driver's default.
    voice: str | None
    #: milliseconds of silence before a sentence when the device has been idle.
    lead_in: int = 0
    #: whether the server doesn't know the voices yet: `Voices` then comes right after `Ready`, else never.
    list_voices: bool = True
    #: a descriptor that the process inherits: it gets a WAV file of all sentences, and nothing is played.
    output: int | None = None
    #: whether a sentence fails whose output is muted, where it doesn't say so itself.
    audible: bool = False
    #: the program that is tried first where no player is named; None for the usual order.
    worked: str | None = None


@frozen
class Say:
    """Speak `text`. Settings are absolute; None leaves the driver's default."""

    id: str
    text: str
    rate: int  # words per minute, 80 to 450
    volume: float  # 0.0 to 1.0
    voice: str | None  # id, name or language
    pitch: int  # 0 to 100, 50 is the voice's own
    followed: bool = False  # whether another goal waits behind it
    by_neural: bool = False  # whether that one asks for a neural voice
    lead_in: int | None = None  # milliseconds of silence before it, whatever the output did; None for `Configure`'s
    audible: bool | None = None  # whether it fails where its output is muted; None for `Configure`'s
    voice_only: bool = False  # whether it waits for a neural voice that is not loaded, and fails without it


@frozen
class Stop:
    """Be silent now. A stop for a goal that is not being spoken is ignored: it ended before the stop arrived."""

    id: str


@frozen
class Pause:
    """Hold the sentence where it is; `Paused` comes when it is silent. Ignored where the goal isn't being spoken."""

    id: str
    number: int  # of the pause in the goal, from 1


@frozen
class Resume:
    """Go on where the sentence was held. Ignored where it is not held."""

    id: str


@frozen
class Followed:
    """Another goal waits behind the one that is being spoken, or no longer does."""

    id: str
    followed: bool
    by_neural: bool = False  # whether that one asks for a neural voice


@frozen
class Load:
    """Load a neural voice beside what is spoken; `Loaded` comes once for each."""

    voice: str  # its id, without a speaker


@frozen
class Drop:
    """Keep a neural voice no longer; one that speaks is kept until it has spoken. `Grown` comes if that is known."""

    voice: str  # its id, without a speaker


@frozen
class Voice:
    """One voice of the driver's."""

    id: str
    language: str | None
    name: str
    quality: str | None = None  # of a neural one, as its maker calls it: "medium"
    #: of a neural one that has several, what each is called, by its number; the engine process, which speaks by
    #: pyttsx3's own list, doesn't tell them
    speakers: tuple[str, ...] | None = None


@frozen
class Ready:
    """The engine is initialised and takes a `Say`."""

    driver: str
    version: str | None  # of the synthesiser, for people: "eSpeak NG 1.51 (system)"
    player: str | None  # what will be tried first, for people
    voice: str | None = None  # id of the neural voice that `Configure.voice` names; None for any other voice


@frozen
class StartFailed:
    """The engine cannot start; the process ends after this."""

    reason: str  # "engine_failed" or "unknown_voice"
    message: str  # names what is missing and what to install
    lasting: bool = True  # whether the next start will fail for it, too, if nobody changes something
    usage: bool = False  # whether it was asked for by an option, and can't be had


@frozen
class Voices:
    """All voices of the driver; sent once, right after `Ready`, where `Configure` asks for it."""

    voices: tuple[Voice, ...]


@frozen
class Loaded:
    """A neural voice can be spoken with from now on, or can't."""

    voice: str  # its id, without a speaker
    seconds: float  # that it took
    error: str | None = None  # why it can't, for people


@frozen
class Unloaded:
    """A neural voice is not loaded any more: its files are others than they were."""

    voice: str  # its id, without a speaker


@frozen
class Grown:
    """The process has another size than was told; before `Loaded`, and after sentences and `Drop`."""

    voice: str  # what it is due to: the voice that was loaded or has spoken, by its id without a speaker; "" for `Drop`
    memory: int  # bytes by which the process has grown since before its first neural voice


@frozen
class Started:
    """The `Say` was taken in hand."""

    id: str


@frozen
class Alive:
    """A sign of life from a process that has a goal in hand, or loads a voice.

    At most `ALIVE_EVERY` seconds after the last message.
    """

    id: str  # of the goal; "" if there is none


@frozen
class Word:
    """A word begins to be heard, now, by the playback clock."""

    id: str
    start: int  # character offset in the text
    end: int  # offset after the word's last character
    number: int  # of the word in the sentence, from 1
    time: float  # seconds into the sentence's audio


@frozen
class Output:
    """Where the sentence goes, and how loud; as soon as that is known, and whenever it changes."""

    id: str
    output: JsonObject | None  # as a goal has it; None where another player goes on that can't tell


@frozen
class Speaks:
    """The sentence is heard by this voice; once more where that changes before it begins."""

    id: str
    voice: str  # its id
    why: str | None = None  # why it is another than was asked for, for people


@frozen
class Paused:
    """The sentence is held and silent, until `Resume` or `Stop`."""

    id: str
    number: int  # of the pause that it answers


@frozen
class Ended:
    """The `Say` is over, and it is silent: the player is reaped, or its stream is closed."""

    id: str
    outcome: str  # COMPLETED, STOPPED or FAILED
    reason: str | None = None  # of FAILED: audio_device, audio_lost, audio_stalled, no_player, nothing_to_say, …
    message: str | None = None  # of FAILED: the player's or engine's own words
    duration: float | None = None  # seconds of audio, where all of it was synthesised
    gaps: int = 0  # times that it was silent in its midst, as its sound was not made in time
    gap_seconds: float = 0.0  # for so long in all
    player: str | None = None  # what took the sound, where no player is named


Command = Configure | Say | Stop | Pause | Resume | Followed | Load | Drop
Event = (
    Ready | StartFailed | Voices | Loaded | Unloaded | Grown | Started | Alive | Word | Output | Speaks | Paused | Ended
)
#: The events that belong to a goal, by its `id`.
OF_A_GOAL = (Started, Alive, Word, Output, Speaks, Paused, Ended)

#: What goes in and what comes out; in a line a message is called as its class is.
COMMANDS: dict[str, type[Command]] = {each.__name__: each for each in Command.__args__}
EVENTS: dict[str, type[Event]] = {each.__name__: each for each in Event.__args__}

# Made once: `json.dumps` makes another for each line that isn't written in its own way, and `json.loads` guesses at the
# encoding of each; together that is a third of what the two ends of this socket do for a line.
_ENCODER = json.JSONEncoder(default=fields)
_DECODER = json.JSONDecoder()


def encode(message: Command | Event) -> bytes:
    """Return the message as a line."""
    return _ENCODER.encode({"kind": type(message).__name__, **fields(message)}).encode() + b"\n"


def decode(line: bytes, kinds: Mapping[str, type[_M]]) -> _M:
    """Return the message in a line, one of `COMMANDS` or `EVENTS`; ValueError, TypeError or KeyError if it has none."""
    fields = _DECODER.decode(line.decode())
    if not isinstance(fields, dict):
        raise TypeError("a message is a JSON object")
    kind = kinds[fields.pop("kind")]
    if kind is Voices:
        fields["voices"] = tuple(Voice(**each) for each in fields["voices"])
    return kind(**fields)
