"""The options of a goal: their limits, the form of ids, and the other places that must agree with them."""

from __future__ import annotations

import ast
import datetime as dt
import importlib
import inspect
import math
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import given as given_any
from hypothesis import strategies as st

import talkcli
from talkcli import Client, Goal
from talkcli.cli.command import FILE_MODE, TIME_LIMIT, read_value
from talkcli.cli.commands import COMMANDS
from talkcli.engine import protocol
from talkcli.frozen import fields, replace
from talkcli.goals.options import (
    DEFAULT_VOICE,
    DEFAULTS,
    ENGINE_OPTIONS,
    INTEGER,
    MAX_KEY_CHARS,
    MAX_PRIORITY,
    MOMENT,
    NUMBER,
    OPTIONS,
    SECONDS,
    SETTINGS,
    SHOWN_OPTIONS,
    SOUND_OPTIONS,
    SPEECH_OPTIONS,
    Append,
    Option,
    Say,
    Set,
    bad_option,
    describe_settings,
    engine_options,
    is_clients_id,
    require_fields,
    shown_settings,
)
from talkcli.protocol.requests import REQUEST_TYPES
from talkcli.server import run

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

ROWS = {option.name: option for option in OPTIONS}
INVALID_SECONDS: list[object] = [-1, -0.001, math.nan, math.inf, -math.inf, 10**400, -(10**400)]
GOOD: list[tuple[str, list[object]]] = [
    ("rate", [80, 200, 450]),
    ("volume", [0, 0.0, 0.5, 1, 1.0]),
    ("pitch", [0, 50, 100]),
    ("lead_in", [0, 1, 5_000]),
    ("format", ["text", "markdown", "sound"]),
    ("voice", ["en", "default", "French (France)"]),
    ("ttl", [0, 0.0, 0.001, 5, 86_400.0]),
    ("throttle", [0, 0.0, 0.5, 60]),
    ("priority", [0, -1, 1, MAX_PRIORITY, -MAX_PRIORITY]),
    ("key", ["b", "a" * MAX_KEY_CHARS, "battery low!", "é日"]),
]
BAD: list[tuple[str, list[object]]] = [
    ("rate", [79, 451, 0, -200, 10**400]),
    ("volume", [-0.001, 1.001, 2, -1, math.nan, math.inf, 10**400]),
    ("pitch", [-1, 101, 10**400]),
    ("lead_in", [-1, 5_001, 10**400]),
    ("voice", [""]),
    ("ttl", INVALID_SECONDS),
    ("throttle", INVALID_SECONDS),
    ("priority", [MAX_PRIORITY + 1, -MAX_PRIORITY - 1, 10**400]),
    ("key", ["", "a" * (MAX_KEY_CHARS + 1)]),
    ("format", ["ssml", "", "TEXT", "a" * 5_000]),
]
OWN_IDS = [
    *("a", "A", ".", "_", ":", "/", "a" * 64, "1.", "1-1", "_-_", "a/b", "/patrol/goal-1", "/arm-1-1712.5"),
    *("arm-1", "goal-1", "task-2", "move-10", "wp01-3", "2024-12", "k3fz-12"),  # four characters and a number
    *("4K7F-1", "4k7f-", "4k7f-x", "4k7f", "4k7-1", "4k7ff-1", "4k7f-1-1", "a4k7f-1", "44k7-1", "4k77-1", "4kf7-1"),
]
OTHER_IDS = [
    *("", "1", "007", "4k7f-1", "0a0a-0", "9z9z-00012", "-", "-a", "-1", "a" * 65),
    *("a b", "a\n", "4k7f-1\n", "é", "a\0", "１", "٣", "ａ", "a,b", "a\\b", "\ud800"),
]


def short(value: object) -> str:
    return ascii(value)[:24]


def options(table: list[tuple[str, list[object]]]) -> list[tuple[str, object]]:
    return [(name, value) for name, values in table for value in values]


@pytest.mark.parametrize(("name", "value"), [*options(GOOD), *[("id", goal_id) for goal_id in OWN_IDS]], ids=short)
def test_an_option_within_its_limits_is_accepted(name: str, value: object) -> None:
    assert bad_option(Say("hi", **{name: value})) is None  # type: ignore[arg-type]
    if name in annotated(Set):
        assert bad_option(Set(**{name: value})) is None  # type: ignore[arg-type]


@pytest.mark.parametrize(("name", "value"), [*options(BAD), *[("id", goal_id) for goal_id in OTHER_IDS]], ids=short)
def test_an_option_outside_its_limits_is_refused_by_name(name: str, value: object) -> None:
    for preempt in (None, True):
        message = bad_option(Say("hi", preempt=preempt, **{name: value}))  # type: ignore[arg-type]
        assert message is not None
        assert name in message
        assert len(message) < 600
    if name in annotated(Set):
        assert name in str(bad_option(Set(**{name: value})))  # type: ignore[arg-type]


def test_a_sound_has_no_options_of_speech() -> None:
    values = {"rate": 200, "voice": "en", "voice_only": True, "pitch": 50, "more": True, "stall": 9, "dry_run": True}
    for name, value in values.items():
        message = f"a sound can't have the option {name}; leave it out"
        assert bad_option(Say("chirp", format="sound", **{name: value})) == message  # type: ignore[arg-type]
    assert values.keys() == SPEECH_OPTIONS
    others = {"volume": 0.5, "lead_in": 100, "audible": True, "key": "a", "throttle": 9, "ttl": 9, "feedback": True}
    assert bad_option(Say("chirp", format="sound", **others)) is None  # type: ignore[arg-type]


def test_flush_with_preempt_turned_off_is_refused() -> None:
    assert bad_option(Say("hi")) is bad_option(Set()) is bad_option(Say("hi", flush=True)) is None
    assert bad_option(Say("hi", flush=True, preempt=True)) is None
    assert "flush" in str(bad_option(Say("hi", flush=True, preempt=False)))


@given_any(
    st.text(alphabet=st.sampled_from("aZ09._:/-") | st.characters(), max_size=70)
    | st.from_regex(r"[0-9a-z]{4}-[0-9]{1,3}", fullmatch=True)
)
def test_an_id_is_the_servers_or_a_clients_but_never_both(goal_id: str) -> None:
    plain = re.fullmatch(r"[A-Za-z0-9._:/-]{1,64}", goal_id) is not None and not goal_id.startswith("-")
    servers = re.fullmatch(r"[0-9][a-z][0-9][a-z]-[0-9]+|[0-9]+", goal_id) is not None
    assert is_clients_id(goal_id) == (plain and not servers)


def test_a_servers_id_is_not_a_clients_id() -> None:
    assert not [boot for boot in (run._random_boot_id() for _ in range(1_000)) if is_clients_id(f"{boot}-1")]


# The classes and signatures that repeat the rows must agree with them


def declared(function: Callable[..., object]) -> dict[str, tuple[str, object]]:
    """Return the annotations and defaults of a function's parameters, except the first."""
    parameters = list(inspect.signature(function).parameters.values())[1:]
    return {parameter.name: (str(parameter.annotation), parameter.default) for parameter in parameters}


def annotated(message: type[object]) -> dict[str, str]:
    return {name: kind for name, kind in message.__annotations__.items() if not kind.startswith("ClassVar")}


#: The annotation for each kind.
TYPES = {
    "boolean": "bool",
    "string": "str",
    "integer": "int",
    "number": "float",
    "object": "JsonObject",
    "id": "str",
    "list": "tuple[str, ...]",
}


@pytest.mark.parametrize("kind", REQUEST_TYPES)
def test_the_fields_of_a_request_agree_with_its_rows(kind: str) -> None:
    request = REQUEST_TYPES[kind]
    empty = Say("") if issubclass(request, Say) else Append("") if issubclass(request, Append) else request()
    own = annotated(request)
    assert list(own) == [option.name for option in request.options]
    for option in request.options:
        nothing = " | None" if option.default is None else ""
        assert own[option.name] == TYPES[option.kind.name] + nothing, option.name
        assert getattr(empty, option.name) == option.default, option.name
        if option.default_words != "required":
            assert option.type_error(option.default) is None, option.name
        assert option.meaning, option.name


def test_the_librarys_parameters_agree_with_the_rows() -> None:
    parameters = declared(Client.say)
    # `wait` is called `follow` in the library and has another default.
    assert parameters.pop("follow") == ("bool", True)
    assert parameters.pop("block") == ("bool", True)
    assert parameters.pop("text") == ("str", inspect.Parameter.empty)
    own = annotated(Say)
    rows = [option for option in OPTIONS if option.name not in {"text", "wait", "more", "stall", "dry_run"}]
    assert parameters == {option.name: (own[option.name], option.default) for option in rows}
    typed = [option.name for option in rows if option.flags and option.name != "feedback"]
    assert [name for name in parameters if name in typed] == typed
    streamed = declared(Client.stream)
    only_said = {"text", "follow", "block"}
    assert streamed.pop("stall") == (own["stall"], ROWS["stall"].default)
    assert streamed == {name: kind for name, kind in declared(Client.say).items() if name not in only_said}
    assert list(declared(Client.set).items()) == [(row.name, (annotated(Set)[row.name], None)) for row in SETTINGS]


def test_the_fields_of_a_goal_and_of_speak_agree_with_the_rows() -> None:
    goal, say, engine = annotated(Goal), annotated(Say), annotated(protocol.Speak)
    assert {name: goal[name] for name in SHOWN_OPTIONS} == {name: say[name] for name in SHOWN_OPTIONS}
    own = {"id", "text", "next_waits", "next_is_neural", "more", "broken", "pronunciations"}
    own |= {"start", "heard_end", "heard_words", "heard"}
    sent = {name: kind for name, kind in engine.items() if name not in own}
    assert set(sent) == set(ENGINE_OPTIONS)
    assert {name: kind.removesuffix(" | None") for name, kind in sent.items()} == {
        name: say[name].removesuffix(" | None") for name in ENGINE_OPTIONS
    }


#: Options that are only stored with the goal, so no code reads them.
CARRIED = {"data"}


@pytest.mark.parametrize(
    ("for_engine", "places", "owners"),
    [(False, ["goals", "server"], {"say", "request"}), (True, ["engine/child"], {"command", "say", "settings"})],
)
def test_every_option_is_used_by_the_code(for_engine: bool, places: list[str], owners: set[str]) -> None:
    """The scheduler and the server read options from a `Say`, and the engine process reads them from a command."""
    sources = [path for place in places for path in (Path(talkcli.__file__).parent / place).rglob("*.py")]
    read = {
        node.attr
        for path in sources
        if path.name != "options.py"
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.Attribute) and ast.unparse(node.value).rpartition(".")[2] in owners
    }
    assert {row.name for row in OPTIONS if row.for_engine is for_engine} - CARRIED <= read


def test_a_missing_field_for_a_row_is_reported() -> None:
    with pytest.raises(TypeError, match="Say has no field for the option 'loudness'"):
        require_fields(Say, ["text", "loudness"])


def test_settings_are_shown_with_null_for_unset_values() -> None:
    assert list(annotated(Set)) == [option.name for option in SETTINGS]
    assert [option.name for option in SOUND_OPTIONS] == ["rate", "volume", "voice", "pitch"]
    shown = shown_settings(DEFAULTS)
    assert shown == {"rate": 200, "volume": 1.0, "voice": None, "pitch": 50, "preempt": False, "ttl": None}
    assert shown_settings(replace(DEFAULTS, voice=DEFAULT_VOICE, ttl=0.0)) == shown
    assert describe_settings({**shown, "volume": 0.1 + 0.2, "ttl": 1e6})[1::4] == ["volume 0.3", "ttl 1000000 s"]
    defaults = ["rate 200", "volume 1", "default voice", "pitch 50", "new goals wait", "no ttl"]
    assert describe_settings(shown) == defaults
    changed = shown_settings(replace(DEFAULTS, voice="de", ttl=2.5, preempt=True))
    assert describe_settings(changed)[2:] == ["voice de", "pitch 50", "new goals interrupt", "ttl 2.5 s"]


def test_a_setting_has_its_own_flags_and_help_in_serve_and_set() -> None:
    preempt, rate = ROWS["preempt"], ROWS["rate"]
    assert preempt.setting
    at_start, to_set = preempt.for_serve(), preempt.for_set()
    assert (at_start.flags, at_start.help, at_start.default) == ("--preempt", preempt.setting.serve_help, False)
    assert (to_set.flags, to_set.help, to_set.default) == ("--preempt/--no-preempt", preempt.setting.set_help, None)
    at_start, to_set = rate.for_serve(), rate.for_set()
    assert (at_start.flags, at_start.help, at_start.default, at_start.env) == ("--rate", rate.help, 200, "TALK_RATE")
    assert (to_set.flags, to_set.help, to_set.default, to_set.env) == ("--rate", rate.help, None, "")


def test_the_engine_gets_the_goals_value_or_else_the_servers() -> None:
    settings = replace(DEFAULTS, voice="de", rate=150)
    general = {"rate": 150, "volume": 1.0, "voice": "de", "pitch": 50, "lead_in": None, "audible": None}
    general |= {"voice_only": False, "format": "text"}
    assert engine_options(Say("hi"), settings) == general
    own = Say("hi", rate=80, volume=0.0, voice=DEFAULT_VOICE, pitch=0, lead_in=0, audible=False)
    expected = {"rate": 80, "volume": 0.0, "voice": None, "pitch": 0, "lead_in": 0, "audible": False}
    assert engine_options(own, settings) == {**expected, "voice_only": False, "format": "text"}


def test_the_servers_defaults_agree_with_its_command() -> None:
    rows = {option.name: option for option in COMMANDS["serve"].options}
    server = fields(run.ServerSettings())
    assert server.pop("goals") == Set(**{name: row.default for name, row in rows.items() if row.setting})
    assert server.pop("socket") is None
    assert server == {
        name: read_value(row, row.default) if row.kind is FILE_MODE else row.default
        for name, row in rows.items()
        if not row.setting and name != "print_unit"
    }


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        (Option("x", NUMBER, limits=(0, 1), unit=" m"), 2, "the x must be 0 to 1 m, got 2"),
        (Option("x", INTEGER, limits=(1, None)), 0, "the x must be 1 or more, got 0"),
        (Option("x", NUMBER, limits=(0, None), excludes_minimum=True), 0, "the x must be more than 0, got 0"),
        (Option("x", SECONDS, limits=(0, None)), -1, "the x must be 0 or more, got -1"),
        (Option("x", SECONDS, limits=(0, 9)), 10, "the x must be 0 to 9, got 10"),
        (Option("x", NUMBER), 10, None),
        (ROWS["priority"], 1_000_001, "the priority must be -1,000,000 to 1,000,000, got 1000001"),
        (ROWS["key"], "", "the key must have 1 to 64 characters, got 0"),
        (ROWS["voice"], "", "the voice must not be empty"),
        (ROWS["format"], "x" * 99, f"the format must be one of 'text', 'markdown', 'sound', got '{'x' * 64}'"),
    ],
    ids=lambda value: getattr(value, "name", None) or str(value)[:24],
)
def test_a_refusal_names_the_valid_values(option: Option, value: object, message: str | None) -> None:
    assert option.value_error(value) == message
    assert option.value_error(None) is None
    assert ROWS["key"].range == ""


@pytest.mark.parametrize("command", COMMANDS)
def test_the_function_of_a_command_accepts_the_options_of_its_row(command: str) -> None:
    row = COMMANDS[command]
    module, _, name = (row.function or f"ask:{command}").partition(":")
    function = getattr(importlib.import_module(f"talkcli.cli.{module}"), name)
    names = [option.name for option in row.options] + ([row.argument.name] if row.argument else [])
    bound = inspect.signature(function).bind(None, **dict.fromkeys(names))
    for parameter in bound.signature.parameters.values():
        assert parameter.default is inspect.Parameter.empty, f"{parameter.name} must not have a default"


LIMITED = (
    Option("x", NUMBER, limits=(0, 1), excludes_minimum=True),
    Option("x", INTEGER, limits=(1, None)),
    Option("x", INTEGER),
)


def test_limits_are_the_same_on_the_wire_and_on_the_command_line() -> None:
    accepted: list[list[float]] = [[0.5, 1], [1, 10**400], [-5]]
    refused: list[list[float]] = [[0, -1, 1.5], [0, -5], []]
    for option, good, bad in zip(LIMITED, accepted, refused, strict=True):
        for value in good:
            assert (option.value_error(value), read_value(option, str(value))) == (None, value)
        for value in bad:
            assert f"{value}" in str(option.value_error(value))
            with pytest.raises(ValueError, match=f"got '?{value}'?$"):
                read_value(option, str(value))
    wanted = ["a number", "a whole number", "a whole number"]
    for option, message in zip(LIMITED, wanted, strict=True):
        with pytest.raises(ValueError, match=f"must be {message}, got 'abc'$"):
            read_value(option, "abc")


SINCE = Option("since", MOMENT)
TTL, LEAD_IN, LIMIT = ROWS["ttl"], ROWS["lead_in"], Option("x", TIME_LIMIT, limits=(0, None))


@pytest.mark.parametrize(
    ("option", "values", "malformed"),
    [
        (TTL, {"5": 5, "0.5": 0.5, "500ms": 0.5, "5s": 5, "2m": 120, "1h": 3600, "1.5h": 5400, "0s": 0}, "an inf infs"),
        (LEAD_IN, {"300": 300, "300ms": 300, "0.3s": 300, "1.001s": 1001, "0m": 0}, "0.3 0.5ms infs 10s 1e999s"),
        (LIMIT, {"9": 9, "inf": math.inf, "20s": 20}, "s ms 5x 5sm 5sec 1m30s nans -1s 5d"),
        (ROWS["volume"], {}, "1s 500ms"),
        (ROWS["rate"], {}, "100ms 200s"),
    ],
    ids=["seconds", "milliseconds", "limit", "number", "integer"],
)
def test_a_time_may_have_a_unit(option: Option, values: dict[str, float], malformed: str) -> None:
    for text, value in values.items():
        read = read_value(option, text)
        assert (read, type(read)) == (value, int if option is LEAD_IN else float)
    for text in (*malformed.split(), ""):
        with pytest.raises(ValueError, match="must "):
            read_value(option, text)


@pytest.mark.parametrize(
    ("text", "days_ago", "clock"),
    [
        ("14:00", 0, "14:00:00"),
        ("0:05:59", 0, "00:05:59"),
        ("today", 0, "00:00:00"),
        ("yesterday", 1, "00:00:00"),
        ("yesterday 23:59", 1, "23:59:00"),
    ],
)
def test_a_point_in_time_is_local(text: str, days_ago: int, clock: str) -> None:
    before = dt.date.today()
    read = dt.datetime.fromtimestamp(read_value(SINCE, text))
    assert str(read.time()) == clock
    assert read.date() + dt.timedelta(days_ago) in {before, dt.date.today()}


@pytest.fixture
def berlin() -> Iterator[None]:
    """Use a time zone with daylight saving time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TZ", "Europe/Berlin")
        time.tzset()
        yield
    time.tzset()


@pytest.mark.usefixtures("berlin")
def test_a_point_in_time_may_have_a_date_or_be_before_now() -> None:
    for text in ("2026-11-24 14:00", "2026-3-9 2:07:08", "2026-11-24"):
        day, _, clock = text.partition(" ")
        parts = [*map(int, (*day.split("-"), *filter(None, clock.split(":"))))]
        assert read_value(SINCE, text) == dt.datetime(*parts).timestamp()  # type: ignore[arg-type]
    for text, seconds in {"2h": 7200, "90m": 5400, "500ms": 0.5, "4380h": 4380 * 3600}.items():  # half a year
        before = time.time() - seconds
        assert before - 0.001 <= read_value(SINCE, text) <= time.time() - seconds + 0.001
    for text in (
        *["14", "25:00", "14:60", "2026-02-30", "tomorrow", "5d", "h", "infh"],
        "",
        " ",
        "today 14",
        "14:00 today",
    ):
        with pytest.raises(ValueError, match="must be a time such as 2h, 14:00, yesterday or '2026-11-24 14:00', got"):
            read_value(SINCE, text)


def test_a_plain_command_line_is_parsed_without_compiling_options() -> None:
    """A client creates about a hundred rows when it starts. Compiling their constructor would take longer than that."""
    code = "import talkcli.cli.plain; from talkcli import frozen; from talkcli.goals.options import Option; "
    code += "print(Option.__init__ is frozen._METHODS['__init__'])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "True\n"
