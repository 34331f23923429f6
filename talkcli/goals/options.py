"""The options of goals and the settings of servers, defined in a table.

Each row defines a field of the `say` or `set` request, a command-line option, the checks of its values, and an entry in
the documents. `Say` and `Client.say` repeat the rows for type checkers and readers, and tests compare them with the
rows. Rows may be added, but a row never changes its name or meaning.

There are two kinds of invalid values. A request with a value of the wrong type is an error and has no effect
(`Option.type_error`). A goal with a value that is not allowed is REJECTED (`Option.value_error`).

Clients import this module before they send anything, so it imports nothing that is slow to load.
"""

from __future__ import annotations

from talkcli.frozen import TYPE_CHECKING, fields, frozen, replace

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from typing import Any, ClassVar

    from talkcli.goals.goal import JsonObject
    from talkcli.goals.reasons import Refusal

MAX_ID_CHARS = 64
#: Maximum number of ids in a request. More ids would not fit into the request's line.
MAX_IDS = 4096
#: Maximum length of a client's name, which is shown on one line of a terminal.
MAX_SENDER_NAME_CHARS = 64
#: Maximum size of a goal's `data` as JSON. The data is meant for labels, not for storage.
MAX_DATA_BYTES = 1024
#: Maximum number of goals in a reply to `log`. The server keeps the same number of ended goals in memory.
MAX_LOG_GOALS = 2_200
#: Names of the final states of a goal. They are repeated here, because `State` is slow to import.
END_STATES = ("SUCCEEDED", "ABORTED", "REJECTED", "RECALLED", "PREEMPTED")
#: Maximum length of a text, which is enough for several minutes of speech. A longer text should be split, so that other
#: goals can be spoken in between.
MAX_TEXT_CHARS = 10_000
#: Maximum size of a text. 10,000 characters of four bytes each still fit into a request.
MAX_TEXT_BYTES = 40_000
#: A growing text may be this many times as long as other texts. Clients can interrupt a growing text, and its sender
#: sees how much of it was spoken.
GROWTH_FACTOR = 5
#: How long a goal waits for more text after the text so far was spoken: the default, the minimum and the maximum.
STALL_S, MIN_STALL_S, MAX_STALL_S = 5, 1, 60
#: The time limit of a pause that ends with its connection: the default, the minimum and the maximum. The limit ends the
#: pause of a program that hangs.
PAUSE_S, MIN_PAUSE_S, MAX_PAUSE_S = 600, 0.1, 86_400
#: How long a pause may last before the doctor and the log warn about it.
LONG_PAUSE_S = 600
#: Highest priority. Every JSON parser can represent this number exactly.
MAX_PRIORITY = 1_000_000
#: Maximum length of a key, which is shown on one line.
MAX_KEY_CHARS = 64
#: Maximum silence before a sentence. No audio device takes longer to wake up.
MAX_LEAD_IN_MS = 5000
#: Values of `talk serve --history` for a history in the state directory, with and without texts.
TEXT_HISTORY, NO_TEXT_HISTORY = "text", "no-text"
#: Name that selects the speech driver's default voice.
DEFAULT_VOICE = "default"
#: Value of the option `format` for texts in Markdown.
MARKDOWN = "markdown"
#: Value of the option `format` for the name of a sound instead of a text.
SOUND = "sound"
#: Prefix of neural voice ids, as in "piper/NAME".
NEURAL_PREFIX = "piper/"
#: Separator between a neural voice and its speaker, as in "piper/NAME#3".
SPEAKER_MARK = "#"
#: Unicode categories of characters that are never spoken: separators, control and format characters such as the
#: zero-width space, and unassigned or private code points.
_SILENT_CATEGORIES = frozenset({"Zs", "Zl", "Zp", "Cc", "Cf", "Cn", "Co"})
#: Maximum distance of a point in time from 1970, about 30 million years.
_MAX_MOMENT_S = 1e15
_DIGITS = frozenset("0123456789")
_LETTERS = frozenset("abcdefghijklmnopqrstuvwxyz")
_ID_CHARACTERS = _DIGITS | _LETTERS | frozenset("ABCDEFGHIJKLMNOPQRSTUVWXYZ._:/-")
#: Same as sys.float_info.max. Larger integers can't be converted to a float.
_MAX_FLOAT = 1.7976931348623157e308


def without_speaker(voice: str | None) -> str:
    """Return a voice's id without the speaker.

    Return an empty string for None.
    """
    return (voice or "").partition(SPEAKER_MARK)[0]


def is_neural(voice: str) -> bool:
    """Return whether a name looks like the id of a neural voice. The voice need not exist."""
    return voice.casefold().startswith(NEURAL_PREFIX)


@frozen
class Kind:
    """The type of an option's values, such as a duration in seconds."""

    #: name of the type in the protocol's document
    name: str
    types: tuple[type, ...]
    #: error message for a value of another type
    wrong_type: str
    #: placeholder for the value in help texts, or an empty string to use the option's name
    metavar: str = ""
    #: function for additional checks. It returns an error message or None
    check: Callable[[Any], str | None] | None = None
    #: if the value is a duration, its unit: "s" or "ms". The command line also accepts other units, such as 2m.
    time_unit: str = ""


def is_clients_id(goal_id: str) -> bool:
    """Return whether a client may choose this id.

    Ids that look like the server's own are reserved.
    """
    if not (0 < len(goal_id) <= MAX_ID_CHARS and _ID_CHARACTERS.issuperset(goal_id)) or goal_id[0] == "-":
        return False
    boot, dash, number = goal_id.partition("-")
    if not dash:
        return not _DIGITS.issuperset(goal_id)
    # Ids that servers generate look like 4k7f-12. Clients can still choose names such as `goal-1` or `2024-12`.
    servers = len(boot) == 4 and _DIGITS.issuperset(boot[::2]) and _LETTERS.issuperset(boot[1::2])
    return not (servers and number and _DIGITS.issuperset(number))


def _id_error(value: str) -> str | None:
    """Return an error message if an id is empty or too long."""
    return None if 0 < len(value) <= MAX_ID_CHARS else f"must have 1 to {MAX_ID_CHARS} characters"


def _offset_error(value: int) -> str | None:
    """Return an error message if an offset in a text is negative."""
    return None if value >= 0 else "must be 0 or more"


def _ids_error(value: list[object]) -> str | None:
    """Return an error message if a list of ids is too long or contains an invalid id."""
    if len(value) > MAX_IDS:
        return IDS.wrong_type
    errors = (_id_error(each) if isinstance(each, str) else ID.wrong_type for each in value)
    return next(filter(None, errors), None)


def _data_error(value: JsonObject) -> str | None:
    """Return an error message if a goal's `data` is too large or nested too deeply."""
    import json

    try:
        return None if len(json.dumps(value)) <= MAX_DATA_BYTES else DATA.wrong_type
    except RecursionError:
        return DATA.wrong_type


def _sender_name_error(value: str) -> str | None:
    """Return an error message if a client's name is empty or too long."""
    return None if 0 < len(value) <= MAX_SENDER_NAME_CHARS else f"must have 1 to {MAX_SENDER_NAME_CHARS} characters"


def _log_count_error(value: int) -> str | None:
    """Return an error message if the `count` of a `log` request is out of range."""
    return None if 0 < value <= MAX_LOG_GOALS else f"must be 1 to {MAX_LOG_GOALS:,}"


def _moment_error(value: float) -> str | None:
    """Return an error message if a number is NaN or too large for a point in time."""
    return None if abs(value) <= _MAX_MOMENT_S else "must be a time in seconds since 1970"


def _end_state_error(value: str) -> str | None:
    """Return an error message if a goal can't end in the state with this name."""
    return None if value in END_STATES else f"must be one of {', '.join(END_STATES)}"


def format_number(value: object) -> str:
    """Format a value for display, with at most four decimal places."""
    return f"{round(value, 4):.12g}" if isinstance(value, float) else str(value)


FLAG = Kind("boolean", (bool,), "must be true or false")
TEXT = Kind("string", (str,), "must be a string", "TEXT")
#: A name. On the command line, it must be valid UTF-8 and must not be empty.
WORD = Kind("string", (str,), "must be a string")
#: A file or socket path. On the command line, it may contain any bytes but must not be empty.
PATH = Kind("string", (str,), "must be a string", "PATH")
INTEGER = Kind("integer", (int,), "must be an integer", "N")
_OFFSET = Kind("integer", (int,), "must be an integer", check=_offset_error)
NUMBER = Kind("number", (int, float), "must be a number", "X")
#: A duration in seconds, which can't be negative.
SECONDS = Kind("number", (int, float), "must be a number", "TIME", time_unit="s")
MILLISECONDS = Kind("integer", (int,), "must be an integer", "TIME", time_unit="ms")
#: A point in time in seconds since 1970 UTC. On the command line, it is written as in "yesterday 14:00".
MOMENT = Kind("number", (int, float), "must be a number", "TIME", check=_moment_error)
#: The name of a state in which a goal has ended.
_END_STATE = Kind("string", (str,), "must be a string", "STATE", check=_end_state_error)
_LOG_COUNT = Kind("integer", (int,), "must be an integer", "N", check=_log_count_error)
#: The name of a client, which the client chose itself.
SENDER_NAME = Kind("string", (str,), "must be a string", "NAME", check=_sender_name_error)
DATA = Kind("object", (dict,), f"must be an object of at most {MAX_DATA_BYTES} bytes", check=_data_error)
ID = Kind("id", (str,), "must be a string", "ID", _id_error)
IDS = Kind("list", (list, tuple), f"must be a list of at most {MAX_IDS} ids", "[ID]...", _ids_error)


@frozen
class Setting:
    """A server setting: the default value of a goal option."""

    initial: Any
    #: value that means "none" and is shown as null
    none_value: Any = None
    #: description in the `set` request, if it differs from `say`
    meaning: str = ""
    #: help text in `talk set`, if it differs from `talk say`
    set_help: str = ""
    #: help text in `talk serve`, if it differs from `talk say`
    serve_help: str = ""
    #: flags of `talk set` and `talk serve`, if they differ from `talk say`
    flags: str = ""
    #: format string for showing the value in a sentence
    words: str = ""
    #: text to show if there is no value
    none_words: str = ""


@frozen
class Option:
    """An option of a goal or a command: its allowed values, its flags and its documentation."""

    name: str
    kind: Kind
    #: description in the protocol's document
    meaning: str = ""
    #: default value; if it is None, a request may also contain null
    default: Any = None
    #: minimum and maximum of a number, or None for no limit
    limits: tuple[float | None, float | None] = (None, None)
    #: whether values must be greater than the minimum
    excludes_minimum: bool = False
    #: unit of a number, with a leading space
    unit: str = ""
    #: allowed values, if there is a fixed set of them
    choices: tuple[str, ...] = ()
    #: function for additional checks. It returns an error message or None
    check: Callable[[Any], str | None] | None = None
    #: description of the allowed values in the protocol's document
    form: str = ""
    #: description of the default in the protocol's document, unless it is the server's default
    default_words: str = ""
    #: command-line flags other than `--name`: "-w, --wait", or "--preempt/--queue" for yes and no
    special_flags: str = ""
    metavar: str = ""
    help: str = ""
    #: environment variable that is used if the option isn't given
    env: str = ""
    #: value that the flag sets, if the flag takes no argument and the option isn't boolean
    flag_value: Any = None
    #: value if the flag is given without its optional argument
    bare_value: str | None = None
    #: name of the function in `cli.completion` that completes values
    completion: str = ""
    #: the server setting that provides the default, if there is one
    setting: Setting | None = None
    #: whether the value is sent to the engine
    for_engine: bool = False
    #: whether a goal's JSON includes the value
    in_goal: bool = False

    @property
    def flags(self) -> str:
        """The command-line flags, or an empty string if there are none."""
        return self.special_flags or (f"--{self.name.replace('_', '-')}" if self.help else "")

    @property
    def takes_argument(self) -> bool:
        """Whether a value follows the option's flag on the command line."""
        return self.kind is not FLAG and self.flag_value is None

    def type_error(self, value: Any) -> str | None:
        """Return an error message if a value has the wrong type or format."""
        if value is None and self.default is None:
            return None
        kind = self.kind
        if not isinstance(value, kind.types) or (isinstance(value, bool) and kind is not FLAG):
            return kind.wrong_type
        return kind.check(value) if kind.check else None

    def value_error(self, value: Any) -> str | None:
        """Return an error message if a value of the right type is not allowed."""
        if value is None:
            return None
        if self.limits != (None, None) and self.is_out_of_range(value):
            return f"the {self.name} must be {self.range}{self.unit}, got {value}"
        if self.choices and value not in self.choices:
            return f"the {self.name} must be one of {', '.join(map(repr, self.choices))}, got {value[:MAX_ID_CHARS]!r}"
        return self.check(value) if self.check else None

    def is_out_of_range(self, value: float) -> bool:
        """Return whether a number is outside the limits."""
        low, high = self.limits
        if self.kind is SECONDS and high is None:
            high = _MAX_FLOAT
        # NaN is out of range, because every comparison with NaN is false.
        above = low is None or (value > low if self.excludes_minimum else value >= low)
        return not (above and (high is None or value <= high))

    @property
    def range(self) -> str:
        """A description of the limits, or an empty string if there are none."""
        low, high = self.limits
        if low is None:
            return ""
        if high is not None:
            return f"{low:g} to {high:g}"
        return f"more than {low:g}" if self.excludes_minimum else f"{low:g} or more"

    def for_set(self) -> Option:
        """Return a copy of the option for `talk set`, with that command's flags and help."""
        setting = self.setting
        assert setting
        return replace(self, env="", special_flags=setting.flags or self.flags, help=setting.set_help or self.help)

    def for_serve(self) -> Option:
        """Return a copy of the option for `talk serve`, with that command's flags, help and default."""
        setting = self.setting
        assert setting
        flags = (setting.flags or self.flags).split("/")[0]
        return replace(self, default=setting.initial, special_flags=flags, help=setting.serve_help or self.help)


def _priority_error(value: int) -> str | None:
    """Return an error message if a priority is out of range."""
    if -MAX_PRIORITY <= value <= MAX_PRIORITY:
        return None
    return f"the priority must be {-MAX_PRIORITY:,} to {MAX_PRIORITY:,}, got {value}"


def key_error(value: str) -> str | None:
    """Return an error message if a string is not a valid key."""
    if 0 < len(value) <= MAX_KEY_CHARS:
        return None
    return f"the key must have 1 to {MAX_KEY_CHARS} characters, got {len(value)}"


def _own_id_error(value: str) -> str | None:
    """Return an error message if a client may not choose this id."""
    if is_clients_id(value):
        return None
    return (
        f"the id {value[:MAX_ID_CHARS]!a} is not allowed: use 1 to {MAX_ID_CHARS} characters from A-Z a-z 0-9 . _ : "
        "/ -; an id can't be a number, begin with '-', or look like one of the server's own ids, such as 4k7f-12"
    )


def _voice_error(value: str) -> str | None:
    """Return an error message if the name of a voice is empty."""
    return None if value else "the voice must not be empty"


_EXPIRY_HELP = "Drop sentences that can't start within TIME, such as 5s; 0 means no limit."

#: All options of a goal, in the order of the help text and the protocol's document.
OPTIONS = (
    Option(
        "text",
        TEXT,
        "the sentence",
        default="",
        form=f"up to {MAX_TEXT_CHARS:,} characters and {MAX_TEXT_BYTES:,} bytes",
        default_words="required",
    ),
    Option(
        "wait",
        FLAG,
        "send the goal's states and its result to this connection",
        default=False,
        special_flags="-w, --wait",
        help="Wait until the goal has ended. The exit code shows the result.",
    ),
    Option(
        "feedback",
        FLAG,
        "also send each word when it is heard; implies `wait`",
        default=False,
        special_flags="-f, --feedback",
        help="Show each word when it is heard. Implies --wait.",
    ),
    Option(
        "patient",
        FLAG,
        "if the queue is full, wait for room (at most for the `ttl`) instead of rejecting the goal (`queue_full`)",
        default=False,
    ),
    Option(
        "preempt",
        FLAG,
        "interrupt the current goal unless it has a higher priority, and go before waiting goals with equal priority",
        special_flags="--preempt/--queue",
        help="Interrupt the current sentence, or wait in the queue. [default: the server's setting]",
        setting=Setting(
            False,
            meaning="whether goals that were sent without `preempt` interrupt the current goal",
            set_help="Choose whether new sentences interrupt the current one. With 'talk say --queue', they wait.",
            serve_help="Let new sentences interrupt the current sentence. With 'talk say --queue', they wait.",
            flags="--preempt/--no-preempt",
            words="new goals interrupt",
            none_words="new goals wait",
        ),
    ),
    Option(
        "flush",
        FLAG,
        "like `preempt`, and recall all waiting goals with the same or a lower priority",
        default=False,
        help="Interrupt the current sentence, and empty the queue.",
    ),
    Option(
        "interject",
        FLAG,
        "interrupt the current goal at the end of a word, unless it has a higher priority. Afterwards, that goal "
        "continues with its next word",
        default=False,
        help="Interrupt the current sentence at the end of a word. Afterwards, the interrupted sentence continues.",
    ),
    Option(
        "priority",
        INTEGER,
        "goals with a higher priority are spoken first, and goals with the same priority in the order of arrival",
        default=0,
        # The range is not in `limits`, because the help text would show it.
        check=_priority_error,
        form=f"{-MAX_PRIORITY:,} to {MAX_PRIORITY:,}",
        help="Set the priority. Sentences with a higher priority are spoken first. "
        "This sentence never interrupts or flushes them.",
        in_goal=True,
    ),
    Option(
        "ttl",
        SECONDS,
        "the goal is RECALLED if it has not started after this many seconds; 0 means no limit",
        limits=(0, None),
        help="Drop the sentence if it can't start within TIME, such as 5s; 0 means no limit.",
        setting=Setting(
            0,
            none_value=0,
            meaning="the `ttl` of goals that were sent without `ttl`; 0 means no limit",
            set_help=_EXPIRY_HELP,
            serve_help=_EXPIRY_HELP + " 'talk say --ttl' overrides this limit.",
            words="ttl {} s",
            none_words="no ttl",
        ),
        in_goal=True,
    ),
    Option(
        "key",
        WORD,
        "replace the waiting goal that has the same key",
        check=key_error,
        form=f"1 to {MAX_KEY_CHARS} characters",
        help=f"Replace the waiting sentence with the same KEY. A key has up to {MAX_KEY_CHARS} characters.",
        completion="keys",
        in_goal=True,
    ),
    Option(
        "throttle",
        SECONDS,
        "reject the goal if the same text is waiting, is being spoken, or started less than this many seconds ago. For "
        "a goal with a key, keys are compared instead of texts, and waiting goals are ignored",
        limits=(0, None),
        help="Skip the sentence if it was spoken in the last TIME. With --key, compare keys instead of texts.",
    ),
    Option(
        "id",
        WORD,
        "an id chosen by the sender; see *Ids* below",
        check=_own_id_error,
        form=f"1 to {MAX_ID_CHARS} characters from `A-Z a-z 0-9 . _ : / -`",
        default_words="set by the server",
        help="Choose the goal's id. A sentence with the same id is spoken only once until the server restarts.",
    ),
    Option(
        "rate",
        INTEGER,
        "words per minute",
        # libespeak-ng accepts no other rates.
        limits=(80, 450),
        unit=" words per minute",
        help="Speak N words per minute.",
        env="TALK_RATE",
        setting=Setting(200, words="rate {}"),
        for_engine=True,
    ),
    Option(
        "volume",
        NUMBER,
        "volume; 1 is the loudest",
        limits=(0.0, 1.0),
        help="Set the volume; 1 is the loudest.",
        env="TALK_VOLUME",
        setting=Setting(1.0, words="volume {}"),
        for_engine=True,
    ),
    Option(
        "voice",
        WORD,
        f"id, name or language of the voice; `{DEFAULT_VOICE}` for the driver's default voice",
        check=_voice_error,
        help="Use this voice: an id, name or language from 'talk voices'.",
        env="TALK_VOICE",
        completion="voices",
        setting=Setting(
            None,
            none_value=DEFAULT_VOICE,
            set_help="Use this voice: an id, name or language from 'talk voices'. 'default' is the engine's own.",
            words="voice {}",
            none_words="default voice",
        ),
        for_engine=True,
    ),
    Option(
        "voice_only",
        FLAG,
        "wait until the voice is loaded, and abort the goal (`voice_failed`) if the voice can't be used, instead of "
        "speaking with espeak",
        default=False,
        help="Wait until the voice is loaded. If it can't be used, fail instead of using another voice.",
        for_engine=True,
    ),
    Option(
        "pitch",
        INTEGER,
        "50 is the voice's normal pitch; neural voices don't support other values",
        limits=(0, 100),
        help="Set the pitch; 50 is normal. Neural voices don't support this option.",
        setting=Setting(50, words="pitch {}"),
        for_engine=True,
    ),
    Option(
        "lead_in",
        MILLISECONDS,
        "milliseconds of silence before the sentence, even if another sentence has just ended; 0 means none",
        limits=(0, MAX_LEAD_IN_MS),
        unit=" milliseconds",
        help="Play silence for TIME, such as 300ms, before the sentence. 0 means none. [default: the server's setting]",
        for_engine=True,
    ),
    Option(
        "audible",
        FLAG,
        "abort the goal (`muted`) if the output is known to be muted",
        help="Fail if the output is muted. [default: the server's setting]",
        for_engine=True,
    ),
    Option(
        "data",
        DATA,
        "the sender's own data, returned unchanged with the goal",
        form=f"up to {MAX_DATA_BYTES:,} bytes of JSON in ASCII (`é` is `\\u00e9`)",
        in_goal=True,
    ),
    Option(
        "more",
        FLAG,
        "whether text will be added with `append` while the goal waits or is spoken. `text` is then the beginning",
        default=False,
    ),
    Option(
        "stall",
        SECONDS,
        "seconds for which a growing text waits for more text after all of it was spoken. After that, the goal is "
        "aborted (`text_stalled`)",
        default=STALL_S,
        limits=(MIN_STALL_S, MAX_STALL_S),
        unit=" seconds",
        help="With --stream, stop if no text arrives for TIME. The time starts after all earlier text was spoken.",
    ),
    Option(
        "format",
        TEXT,
        "how the text is written. The marks of Markdown are not spoken, see [Markdown](../cli/README.md#markdown). "
        f"With `{SOUND}`, the text is the name of a [sound](../cli/README.md#sounds)",
        default="text",
        choices=("text", MARKDOWN, SOUND),
        form=f"`text`, `{MARKDOWN}` or `{SOUND}`",
        special_flags="--markdown",
        flag_value=MARKDOWN,
        help="Read TEXT as Markdown. Markup, code blocks, link addresses and emoji are not spoken.",
        for_engine=True,
        in_goal=True,
    ),
    Option(
        "dry_run",
        FLAG,
        "only check the goal. It is never spoken, and its id is empty. `said` shows how it would be said",
        default=False,
        help="Print how TEXT would be said, but don't speak it.",
    ),
)

#: Names of the options that are sent to the engine.
ENGINE_OPTIONS = tuple(each.name for each in OPTIONS if each.for_engine)
#: Options that affect how speech sounds, even if it is written to a file. Each one has a default on the server.
SOUND_OPTIONS = tuple(each for each in OPTIONS if each.for_engine and each.setting)
#: Names of the options that a sound can't have.
SPEECH_OPTIONS = {"rate", "voice", "voice_only", "pitch", "more", "stall", "dry_run"}
#: Names of the options that a goal's JSON includes.
SHOWN_OPTIONS = tuple(each.name for each in OPTIONS if each.in_goal)
#: Options that have a default on the server. Options that are sent to the engine come first.
SETTINGS = tuple(sorted((each for each in OPTIONS if each.setting), key=lambda each: not each.for_engine))
_NONE_VALUES = {each.name: each.setting.none_value for each in SETTINGS if each.setting}


@frozen
class Say:
    """A request to speak a text. If a value is out of range, the goal is rejected."""

    kind: ClassVar[str] = "say"
    meaning: ClassVar[str] = "Speak a sentence"
    options: ClassVar[tuple[Option, ...]] = OPTIONS
    text: str
    wait: bool = False
    feedback: bool = False
    patient: bool = False
    preempt: bool | None = None
    flush: bool = False
    interject: bool = False
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
    more: bool = False
    stall: float = STALL_S
    format: str = "text"
    dry_run: bool = False

    @property
    def is_sound(self) -> bool:
        """Whether the text is the name of a sound."""
        return self.format == SOUND

    @property
    def content(self) -> str:
        """The text, or the marked name of a sound. The mark distinguishes the name from a text."""
        return f"\0{self.text}" if self.is_sound else self.text


@frozen
class Append:
    """A request to add text to a goal that was sent with `more`."""

    kind: ClassVar[str] = "append"
    meaning: ClassVar[str] = (
        "Add text to a goal that was sent with `more`. The reply comes when little of the text is still unheard"
    )
    options: ClassVar[tuple[Option, ...]] = (
        Option("id", ID, "the goal", default="", default_words="required"),
        Option("text", TEXT, "the text to add", default=""),
        Option("at", _OFFSET, "the length of the text so far. With `at`, the same addition can be sent twice"),
        Option("end", FLAG, "whether the text is complete", default=False),
        Option("broken", FLAG, "whether the sender gives up, so that the goal is stopped at once", default=False),
    )
    id: str
    text: str = ""
    at: int | None = None
    end: bool = False
    broken: bool = False


@frozen
class Set:
    """A request to change the server's settings for goals that haven't started.

    None leaves a setting unchanged.
    """

    kind: ClassVar[str] = "set"
    meaning: ClassVar[str] = "Change the server's settings for goals that haven't started. Omit a setting to keep it"
    options: ClassVar[tuple[Option, ...]] = SETTINGS
    rate: int | None = None
    volume: float | None = None
    voice: str | None = None
    pitch: int | None = None
    preempt: bool | None = None
    ttl: float | None = None


@frozen
class Pause:
    """A request to pause all speech.

    The reply comes when the speech has stopped. Without fields, the pause ends only when a client resumes speech.
    """

    kind: ClassVar[str] = "pause"
    meaning: ClassVar[str] = "Pause all speech. Without fields, the pause lasts until a `resume`"
    options: ClassVar[tuple[Option, ...]] = (
        Option(
            "seconds",
            SECONDS,
            "end the pause after this many seconds",
            limits=(MIN_PAUSE_S, MAX_PAUSE_S),
            unit=" s",
            default_words=f"no limit; {PAUSE_S} with `while_connected`",
            special_flags="--for",
            help="End the pause after TIME, such as 20s.",
        ),
        Option(
            "while_connected",
            FLAG,
            "end the pause when this connection ends",
            default=False,
            special_flags="--while",
            help="Run COMMAND, and end the pause when COMMAND ends.",
        ),
    )
    seconds: float | None = None
    while_connected: bool = False


@frozen
class Cancel:
    """A request to cancel all goals, or only those that match at least one field.

    Goals that wait for room in the queue (`patient`) are cancelled, too.
    """

    kind: ClassVar[str] = "cancel"
    meaning: ClassVar[str] = (
        "Cancel the goals that match any of the fields, including `patient` goals that are waiting for room. "
        "Without fields, cancel all goals"
    )
    options: ClassVar[tuple[Option, ...]] = (
        Option(
            "ids", IDS, "the goals with these ids; an empty list selects no goals", form=f"of up to {MAX_IDS:,} ids"
        ),
        Option(
            "current",
            FLAG,
            "the goal that is being spoken",
            default=False,
            help="Cancel only the current sentence. The next one follows.",
        ),
        Option(
            "before",
            ID,
            "the goal with this id, and all goals that were accepted before it",
            help="Cancel this goal and all goals accepted before it.",
            completion="goal_ids",
        ),
        Option(
            "key",
            WORD,
            "the current and the waiting goals with this key",
            help="Cancel the current and waiting sentences with this key.",
            completion="unfinished_keys",
        ),
    )
    ids: tuple[str, ...] | None = None
    current: bool = False
    before: str | None = None
    key: str | None = None

    @property
    def selects_all(self) -> bool:
        """Whether the request cancels all goals."""
        return self.ids is None and not self.current and self.before is None and self.key is None

    def select_waiting(self, goals: Sequence[Say]) -> list[int]:
        """Return the indexes of the goals to cancel. All given goals are waiting for room in the queue.

        Such a goal has an id only if its sender chose one. Therefore, `before` must name an id of this kind to select
        any.
        """
        ids = set(self.ids or ())
        last = max((index for index, say in enumerate(goals) if say.id == self.before is not None), default=-1)
        return [
            index
            for index, say in enumerate(goals)
            if self.selects_all or say.id in ids or index <= last or say.key == self.key is not None
        ]


@frozen
class Log:
    """A request for the most recently ended goals, oldest first.

    A filter that is None matches every goal.
    """

    kind: ClassVar[str] = "log"
    meaning: ClassVar[str] = (
        "List the most recently ended goals, including REJECTED goals, oldest first. Goals must match all given fields"
    )
    options: ClassVar[tuple[Option, ...]] = (
        Option("count", _LOG_COUNT, "the maximum number of goals", 20, form=f"1 to {MAX_LOG_GOALS:,}"),
        Option(
            "since",
            MOMENT,
            "goals that ended at this time (seconds since 1970) or later",
            help="Show goals since TIME.",
        ),
        Option("until", MOMENT, "goals that ended before this time", help="Show goals that ended before TIME."),
        Option("state", _END_STATE, "goals with this end state", choices=END_STATES, help="Show goals in this state."),
        Option("name", SENDER_NAME, "goals sent under this name", special_flags="--as", help="Show goals from NAME."),
        Option("key", WORD, "goals with this key", help="Show goals with this key."),
        Option(
            "grep", TEXT, "goals whose text contains this", help="Show goals whose text contains TEXT (case-sensitive)."
        ),
        Option("history", FLAG, "also goals in the server's history; see *The history* below", default=False),
    )
    count: int = 20
    since: float | None = None
    until: float | None = None
    state: str | None = None
    name: str | None = None
    key: str | None = None
    grep: str | None = None
    history: bool = False


def require_fields(data_class: type, options: Iterable[str]) -> None:
    """Raise TypeError if a class lacks a field for one of these options.

    Called when a module is imported.
    """
    for name in options:
        if name not in data_class.__annotations__:
            raise TypeError(f"{data_class.__name__} has no field for the option {name!r}")


for _request in (Say, Append, Set, Pause, Cancel, Log):
    require_fields(_request, (each.name for each in _request.options))

#: Settings of a server that was started without options.
DEFAULTS = Set(**{each.name: each.setting.initial for each in SETTINGS if each.setting})


def bad_option(request: Say | Set | Pause | Log) -> str | None:
    """Return an error message if a value or a combination of values in a request is not allowed."""
    if isinstance(request, Say) and request.flush and request.preempt is False:
        return "flush can't be combined with preempt false, because it always interrupts"
    if isinstance(request, Say) and request.interject and (request.flush or request.preempt):
        return f"interject can't be combined with {'flush' if request.flush else 'preempt'}, which ends other goals"
    if isinstance(request, Say) and request.more and request.throttle is not None and request.key is None:
        return "a growing text can only be throttled by its key, because its whole text isn't known yet"
    is_sound = isinstance(request, Say) and request.is_sound
    for option in request.options:
        value = getattr(request, option.name)
        if value != option.default:
            if is_sound and option.name in SPEECH_OPTIONS:
                return f"a sound can't have the option {option.name}; leave it out"
            if words := option.value_error(value):
                return words
    return None


def bad_text(text: str, max_chars: int | None = MAX_TEXT_CHARS) -> Refusal | None:
    """Return a reason and a message if a text is too long, is malformed or has no visible characters.

    Args:
        text: the text.
        max_chars: the maximum length, or None for no limit.

    Returns:
        None if the text seems to be speakable.
    """
    from talkcli.goals.reasons import Reason

    if refused := bad_characters(text, max_chars):
        return refused
    if not is_visible(text):
        return Reason.INVALID_TEXT, "the text is empty" if not text.strip() else "the text has no visible characters"
    return None


def is_visible(text: str) -> bool:
    """Return whether a text contains a visible character."""
    import unicodedata

    return any(unicodedata.category(each) not in _SILENT_CATEGORIES for each in text)


def bad_characters(text: str, max_chars: int | None, text_offset: int = 0) -> Refusal | None:
    """Return a reason and a message if a text is too long or has forbidden characters.

    Args:
        text: the text.
        max_chars: the maximum number of characters, or None for no limit.
        text_offset: the length of the earlier parts of a growing text, which counts, too.

    Returns:
        None if the characters are allowed.
    """
    from talkcli.goals.reasons import Reason

    count = text_offset + len(text)
    if max_chars is not None and count > max_chars:
        return Reason.TEXT_TOO_LONG, f"the text is too long: {count:,} characters (at most {max_chars:,})"
    try:
        size = len(text.encode())
    except UnicodeEncodeError as error:
        words = f"the text is not valid Unicode: character {text_offset + error.start + 1} is half of a surrogate pair"
        return Reason.INVALID_TEXT, words
    if max_chars is not None and size > MAX_TEXT_BYTES:
        return Reason.TEXT_TOO_LONG, f"the text is too long: {size:,} bytes (at most {MAX_TEXT_BYTES:,})"
    if "\0" in text:
        place = text_offset + text.index("\0") + 1
        return Reason.INVALID_TEXT, f"the text contains a NUL character (character {place:,})"
    return None


def engine_options(say: Say, settings: Set) -> dict[str, Any]:
    """Return a goal's options for the engine, with the server's settings as defaults."""
    found = {}
    for name in ENGINE_OPTIONS:
        own = getattr(say, name)
        found[name] = getattr(settings, name, None) if own is None else own
    return _replace_placeholders(found)


def shown_settings(settings: Set) -> JsonObject:
    """Return the settings as a JSON object in which None means the default voice or no time limit."""
    return _replace_placeholders(fields(settings))


def _replace_placeholders(values: dict[str, Any]) -> dict[str, Any]:
    """Return a copy of settings in which placeholders, such as a `ttl` of 0, are replaced with None."""
    return {name: None if value == _NONE_VALUES.get(name) else value for name, value in values.items()}


def describe_settings(settings: JsonObject) -> list[str]:
    """Return a short description of each setting, such as "rate 200"."""
    found = []
    for each in SETTINGS:
        value = settings.get(each.name)
        if each.setting:
            words = each.setting.words.format(format_number(value))
            found.append(words if value else each.setting.none_words or words)
    return found
