"""The options of a goal and the settings of a server: each is one row, and everything else is made from the rows.

Made from them: the fields of `say` and `set` on the wire and their checks, what the library refuses, the options of the
commands and how they are read, what a server's settings are called, the documents' tables. `Say` and `Client.say` name
them again, for type checkers and readers; tests hold both to the rows, which say what each means, and its unit. How two
options go together is `bad_option`.

Rules for this file: a client imports it before it sends anything, so it imports nothing heavy. A row may be added,
never renamed or given another meaning. The first sentence of a request's docstring is its meaning in the wire's table.
"""

from __future__ import annotations

from talkcli.frozen import TYPE_CHECKING, fields, frozen
from talkcli.goals.option import (
    DATA,
    FLAG,
    ID,
    IDS,
    INTEGER,
    MAX_DATA,
    MAX_ID,
    MAX_IDS,
    NUMBER,
    SECONDS,
    TEXT,
    WORD,
    Option,
    Setting,
    figure,
    is_clients_id,
)

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Any, ClassVar

    from talkcli.goals.goal import JsonObject

#: Characters of one text: some minutes of speech. More is a document, not a sentence, and could not be stopped halfway
#: by anybody who waits for its end.
MAX_CHARACTERS = 10_000
#: Bytes of one text in UTF-8: 10,000 characters of four bytes fit, and so does its request line.
MAX_BYTES = 40_000
#: Far more than anybody needs, and a number that every language's JSON reader holds exactly.
MAX_PRIORITY = 1_000_000
#: A key is a label, shown on one line.
MAX_KEY = 64
#: Milliseconds of silence before a sentence: no output needs longer to wake.
MAX_LEAD_IN = 5000
#: What stands for the driver's own voice, where a voice is named.
DEFAULT_VOICE = "default"
#: What stands between the id of a neural voice and its speaker, where it has several: "piper/NAME#3".
SPEAKER = "#"


def model_of(voice: str | None) -> str:
    """Return what has to be loaded for a neural voice, by its id: that without the speaker; "" for no voice."""
    return (voice or "").partition(SPEAKER)[0]


def _bad_priority(value: int) -> str | None:
    if -MAX_PRIORITY <= value <= MAX_PRIORITY:
        return None
    return f"the priority {value} is not within {-MAX_PRIORITY} to {MAX_PRIORITY}"


def bad_key(value: str) -> str | None:
    """Return why no goal can have this key, for people, or None."""
    if 0 < len(value) <= MAX_KEY:
        return None
    return f"a key has 1 to {MAX_KEY} characters, this one has {len(value)}"


def _foreign_id(value: str) -> str | None:
    if is_clients_id(value):
        return None
    return (
        f"the id {value[:MAX_ID]!a} is not one that a sender may choose: 1 to {MAX_ID} of A-Z a-z 0-9 . _ : / -, "
        "no '-' in front, not digits alone, and not of the form of a server's own, 4k7f-12"
    )


def _unknown_format(value: str) -> str | None:
    return None if value == "text" else f"the format {value[:MAX_ID]!r} is not known, only 'text'"


def _empty_voice(value: str) -> str | None:
    return None if value else "the voice is empty"


_RECALLED = "A goal that has not begun after SEC seconds is recalled; "

#: The options of a goal, in their order on the wire and in help.
OPTIONS = (
    Option(
        "text",
        TEXT,
        "the sentence",
        default="",
        form=f"to {MAX_CHARACTERS:,} characters and {MAX_BYTES:,} bytes",
        absent="needed",
    ),
    Option(
        "wait",
        FLAG,
        "send this connection the goal's states, and its result",
        default=False,
        flags="-w, --wait",
        help="Wait until it has ended; the exit code tells how.",
    ),
    Option(
        "feedback",
        FLAG,
        "… and each word as it is heard; implies `wait`",
        default=False,
        flags="-f, --feedback",
        help="Show each word as it is heard; implies --wait.",
    ),
    Option(
        "patient",
        FLAG,
        "where the queue is full, answer when there is room, instead of REJECTED, `queue_full`; `ttl` counts meanwhile",
        default=False,
    ),
    Option(
        "preempt",
        FLAG,
        "stop what is being spoken, if its priority is not higher, and go first",
        absent="the server's",
        flags="--preempt/--queue",
        help="Stop what is spoken and go first, or wait in the queue. [default: as 'talk serve' was told]",
        setting=Setting(
            False,
            meaning="whether a goal preempts that says nothing else",
            to_set="Every goal stops the one before it, or goals queue; one that says --queue stops none.",
            at_start="Every goal stops the one before it, unless it says --queue.",
            flags="--preempt/--no-preempt",
            told="goals preempt",
            told_none="goals queue",
        ),
    ),
    Option(
        "flush",
        FLAG,
        "as `preempt`, and recall all that is pending of the same or a lower priority",
        default=False,
        flags="--flush",
        help="As --preempt, and drop what is in the queue.",
    ),
    Option(
        "priority",
        INTEGER,
        "higher goes first; first in first out among equals",
        default=0,
        # As limits, help would show them, and nobody needs to know.
        refuses=_bad_priority,
        form=f"{-MAX_PRIORITY:,} to {MAX_PRIORITY:,}",
        flags="--priority",
        help="Higher goes first; what has a higher one is neither stopped nor dropped.",
        shown=True,
    ),
    Option(
        "ttl",
        SECONDS,
        "seconds from now in which it must begin, else RECALLED; 0 for no limit",
        limits=(0, None),
        absent="the server's",
        flags="--ttl",
        help="Drop it if it has not begun within SEC seconds; 0: no limit.",
        setting=Setting(
            0,
            none=0,
            meaning="for goals that have none of their own; 0 for no limit",
            to_set=_RECALLED + "0: no limit.",
            at_start=_RECALLED + "it may bring its own --ttl; 0: no limit.",
            told="ttl {} s",
            told_none="no ttl",
        ),
        shown=True,
    ),
    Option(
        "key",
        WORD,
        "replaces the pending goal that has the same key",
        refuses=bad_key,
        form=f"1 to {MAX_KEY} characters",
        flags="--key",
        metavar="KEY",
        help=f"A label of up to {MAX_KEY} characters; replaces what waits under the same one.",
        offers="keys",
        shown=True,
    ),
    Option(
        "throttle",
        SECONDS,
        "REJECTED where a goal of this key, or else of this text, is being spoken or began less than so many seconds "
        "ago",
        limits=(0, None),
        flags="--throttle",
        help="Don't say the same again within SEC seconds; what is the same, --key says, or else the text.",
    ),
    Option(
        "id",
        WORD,
        "the sender's own id, see below",
        refuses=_foreign_id,
        form=f"1 to {MAX_ID} of `A-Z a-z 0-9 . _ : / -`",
        absent="the server's",
        flags="--id",
        metavar="ID",
        help="An id of your own: sent twice, it is spoken once.",
    ),
    Option(
        "rate",
        INTEGER,
        "words per minute",
        # What libespeak-ng takes.
        limits=(80, 450),
        unit=" words per minute",
        absent="the server's",
        flags="--rate",
        help="Words per minute.",
        env="TALK_RATE",
        setting=Setting(200, told="rate {}"),
        engine=True,
    ),
    Option(
        "volume",
        NUMBER,
        "loudness",
        limits=(0.0, 1.0),
        absent="the server's",
        flags="--volume",
        help="Loudness.",
        env="TALK_VOLUME",
        setting=Setting(1.0, told="volume {}"),
        engine=True,
    ),
    Option(
        "voice",
        WORD,
        f"id, name or language; `{DEFAULT_VOICE}` for the driver's own",
        refuses=_empty_voice,
        absent="the server's",
        flags="--voice",
        metavar="VOICE",
        help="Voice by id, name or language: see 'talk voices'.",
        env="TALK_VOICE",
        offers="voices",
        setting=Setting(
            None,
            none=DEFAULT_VOICE,
            to_set="Voice by id, name or language: see 'talk voices'; 'default' is the engine's own.",
            told="voice {}",
            told_none="voice the driver's own",
        ),
        engine=True,
    ),
    Option(
        "voice_only",
        FLAG,
        "whether it waits for its voice while that is loaded, and is ABORTED, `voice_failed`, where it can't be had; "
        "else espeak speaks then",
        default=False,
        flags="--voice-only",
        help="Insist on the voice: wait until it is loaded, or be aborted.",
        engine=True,
    ),
    Option(
        "pitch",
        INTEGER,
        "50 is the voice's own; a neural voice has no other",
        limits=(0, 100),
        absent="the server's",
        flags="--pitch",
        help="Pitch of the voice; 50 is its own, and a neural voice has no other.",
        setting=Setting(50, told="pitch {}"),
        engine=True,
    ),
    Option(
        "lead_in",
        INTEGER,
        "milliseconds of silence before it, also where the output was not idle; 0 for none",
        limits=(0, MAX_LEAD_IN),
        unit=" milliseconds",
        absent="the server's",
        flags="--lead-in",
        metavar="MS",
        help="Milliseconds of silence before it; also where the output was not idle; 0: none. [default: as 'talk "
        "serve' was told]",
        engine=True,
    ),
    Option(
        "audible",
        FLAG,
        "whether it is ABORTED, `muted`, where its output is muted; where that can't be known it is spoken",
        absent="the server's",
        flags="--audible",
        help="Abort it where its output is muted. [default: as 'talk serve' was told]",
        engine=True,
    ),
    Option(
        "data",
        DATA,
        "travels with the goal, untouched",
        form=f"to {MAX_DATA:,} bytes of JSON in ASCII (`é` is `\\u00e9`)",
        shown=True,
    ),
    Option("format", TEXT, "anything else is REJECTED", "text", refuses=_unknown_format, shown=True),
)

#: What the engine is told of a goal, and what everybody is.
FOR_ENGINE = tuple(each.name for each in OPTIONS if each.engine)
#: How it sounds, in a file, too: of these a server has a value of its own.
SOUND = tuple(each for each in OPTIONS if each.engine and each.setting)
SHOWN = tuple(each.name for each in OPTIONS if each.shown)
#: The options of which a server has a value of its own: first what the engine is told, then what decides who is spoken.
SETTINGS = tuple(sorted((each for each in OPTIONS if each.setting), key=lambda each: not each.engine))
_NONES = {each.name: each.setting.none for each in SETTINGS if each.setting}


@frozen
class Say:
    """A goal: speak this. Values out of their range make it REJECTED, bad_option."""

    kind: ClassVar[str] = "say"
    options: ClassVar[tuple[Option, ...]] = OPTIONS
    text: str
    wait: bool = False
    feedback: bool = False
    patient: bool = False
    preempt: bool | None = None
    flush: bool = False
    priority: int = 0
    ttl: float | None = None
    key: str | None = None
    throttle: float | None = None
    id: str | None = None
    rate: int | None = None
    volume: float | None = None
    voice: str | None = None
    voice_only: bool = False
    pitch: int | None = None
    lead_in: int | None = None
    audible: bool | None = None
    data: JsonObject | None = None
    format: str = "text"


@frozen
class Set:
    """Change the running server's settings, for goals that have not begun; those not given stay."""

    kind: ClassVar[str] = "set"
    options: ClassVar[tuple[Option, ...]] = SETTINGS
    rate: int | None = None  # words per minute
    volume: float | None = None  # 0 to 1
    voice: str | None = None  # id, name or language; "default" for the driver's own
    pitch: int | None = None  # 0 to 100
    preempt: bool | None = None
    ttl: float | None = None  # seconds, 0 for no limit


#: The settings of a server that was told nothing else.
INITIAL = Set(**{each.name: each.setting.initial for each in SETTINGS if each.setting})


@frozen
class Cancel:
    """End what these fields select, goals that wait for room (`patient`) too; they add up; without any: everything."""

    kind: ClassVar[str] = "cancel"
    options: ClassVar[tuple[Option, ...]] = (
        Option("ids", IDS, "these goals; an empty list selects none", form=f"of to {MAX_IDS:,} ids"),
        Option(
            "current",
            FLAG,
            "the goal being spoken",
            default=False,
            flags="--current",
            help="The goal that is being spoken.",
        ),
        Option(
            "before",
            ID,
            "this goal, and all accepted before it",
            flags="--before",
            help="This goal, and all that were accepted before it.",
            offers="goal_ids",
        ),
        Option(
            "key",
            WORD,
            "the goals with this key, spoken or pending",
            flags="--key",
            metavar="KEY",
            help="The goals with this key, spoken or waiting.",
            offers="unfinished_keys",
        ),
    )
    ids: tuple[str, ...] | None = None
    current: bool = False
    before: str | None = None
    key: str | None = None

    @property
    def everything(self) -> bool:
        return self.ids is None and not self.current and self.before is None and self.key is None

    def of_waiting(self, goals: Sequence[Say]) -> list[int]:
        """Return which of these goals it selects, which wait for being accepted: their places in their order.

        `before` selects them only where it names one of them, by its sender's id.
        """
        ids = set(self.ids or ())
        last = max((place for place, say in enumerate(goals) if say.id == self.before is not None), default=-1)
        return [
            place
            for place, say in enumerate(goals)
            if self.everything or say.id in ids or place <= last or say.key == self.key is not None
        ]


#: The options whose values may be refused: a scheduler asks of each goal.
_REFUSING = {
    each: tuple(option for option in each.options if option.refuses or option.limits != (None, None))
    for each in (Say, Set)
}


def bad_option(asked: Say | Set) -> str | None:
    """Return what is wrong with the values of a goal's options, or of settings, for people, or None."""
    if isinstance(asked, Say) and asked.flush and asked.preempt is False:
        return "flush preempts: it can't be had together with preempt false"
    for option in _REFUSING[type(asked)]:
        value = getattr(asked, option.name)
        if value is not None and value != option.default and (words := option.refusal(value)):
            return words
    return None


def given(asked: Say | Set) -> dict[str, Any]:
    """Return those options, or settings, that are given, by their names."""
    return {name: value for name, value in fields(asked).items() if value is not None}


def for_engine(say: Say, settings: Set) -> dict[str, Any]:
    """Return what the engine is told of a goal, by the options' names: its own value, or the server's."""
    found = {}
    for name in FOR_ENGINE:
        own = getattr(say, name)
        found[name] = getattr(settings, name, None) if own is None else own
    return _without_none(found)


def as_shown(settings: Set) -> JsonObject:
    """Return settings as everybody is told of them: None where there is none."""
    return _without_none(fields(settings))


def _without_none(values: dict[str, Any]) -> dict[str, Any]:
    """Return values by the options' names, with None for what stands for none: the default voice, a ttl of 0."""
    return {name: None if value == _NONES.get(name) else value for name, value in values.items()}


def told(settings: JsonObject) -> list[str]:
    """Return each of a server's settings, as it shows them, in a few words for people."""
    found = []
    for each in SETTINGS:
        setting, value = each.setting, settings.get(each.name)
        if setting:
            found.append(setting.told_none if setting.told_none and not value else setting.told.format(figure(value)))
    return found
