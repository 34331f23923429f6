"""Simple command lines are parsed without click, but with the same result, and sent before most imports."""

from __future__ import annotations

import contextlib
import os
from typing import TYPE_CHECKING, Any

import pytest
from click.core import ParameterSource
from hypothesis import given, settings
from hypothesis import strategies as st

from talkcli.cli import plain
from talkcli.cli.click_app import talk
from talkcli.cli.command import COMMON_OPTIONS
from talkcli.cli.commands import COMMANDS
from talkcli.cli.show import CommonOptions
from talkcli.client.calls import check, too_long
from talkcli.client.connect import GREETING_START
from talkcli.goals.options import FLAG, Cancel, Pause, Say
from talkcli.protocol import events
from talkcli.protocol.lines import encode, request_to_json
from talkcli.protocol.requests import Hello, Resume, Status

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from talkcli.goals.goal import JsonObject
    from talkcli.protocol.requests import Request

PLAIN = [*COMMANDS]
#: The options that become fields of a goal.
GOAL_OPTIONS = [option.name for option in Say.options if option.flags and option.name not in {"wait", "feedback"}]
TYPED = ParameterSource.COMMANDLINE
ROWS = [*COMMON_OPTIONS, *(option for command in COMMANDS.values() for option in command.options)]
SPELLINGS = {form: row for row in ROWS for part in row.flags.split("/") for form in part.split(", ")}
OPTIONS = sorted(SPELLINGS)
VALUES = [
    *("0", "1", "7", "0.5", "1.0", "80", "451", "-3", "+5", "1_0", " 5", "1e3", ".5", "5.", "nan", "inf", "", "٣"),
    *("9" * 30, "500ms", "2m", "0.5ms", "nans"),
]
WORDS = [
    *(*OPTIONS, *OPTIONS, *PLAIN, *VALUES),
    *(f"{option}={value}" for option in OPTIONS for value in ("", "5", "a b", "-x")),
    *("-wq", "-wf", "-t5", "-qt", "--", "-", "--wai", "--help", "-h", "--version", "--lines", "-o", "x.wav", "serve"),
    *("4k7f-12", "12", "Grüße", "back\\slash", "-x", "battery low", 'a "quoted" word', "two\nlines", "\udc80"),
    "\x1b[1m",
]
FLAGS = [form for form, row in SPELLINGS.items() if row.kind is FLAG]
VALUED = st.tuples(st.sampled_from(OPTIONS), st.sampled_from(["1", "0.5", "90", "k"]))
#: Parts of command lines: flags, options with a usually valid value, words, and sometimes arbitrary parts.
PIECES = st.one_of(
    st.sampled_from(FLAGS).map(lambda argument: [argument]),
    VALUED.map(list),
    VALUED.map("=".join).map(lambda argument: [argument]),
    st.sampled_from([["battery low"], ["12"], ["4k7f-12"], ["Grüße"], ["--", "-3 degrees"]]),
    st.sampled_from(WORDS).map(lambda argument: [argument]),
)
LINES = st.builds(
    lambda before, command, after: [*before, *command, *(word for piece in after for word in piece)],
    st.sampled_from([[], [], ["--json"], ["-q", "--socket", "/run/x"], ["--socket=/run/y"], ["--version"]]),
    st.sampled_from([[name] for name in PLAIN] * 4 + [[], ["watch"], ["sya"]]),
    st.lists(PIECES, max_size=4),
)
ENVIRONMENTS = st.sampled_from([{}, {"TALK_NAME": "patrol"}, {"TALK_NAME": ""}])


def by_click(arguments: list[str]) -> tuple[str, dict[str, Any], CommonOptions]:
    """Return the command, its options and arguments, and the common options, as click parses them."""
    options = CommonOptions()
    with talk.make_context("talk", list(arguments), obj=options) as group:
        name, command, rest = talk.resolve_command(group, [*group._protected_args, *group.args])
        assert name
        assert command
        with command.make_context(name, rest, parent=group) as context:
            options.typed = frozenset(name for name in context.params if context.get_parameter_source(name) is TYPED)
            return name, context.params, options


@contextlib.contextmanager
def sender_name(environment: Mapping[str, str]) -> Iterator[None]:
    """Set or delete the variable TALK_NAME."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("TALK_NAME", raising=False)
        for name, value in environment.items():
            patch.setenv(name, value)
        yield


def assert_parsed_like_click(arguments: list[str]) -> None:
    parsed = plain.read(arguments, os.environ)
    if not parsed:
        return
    command, params, options = by_click(arguments)
    assert (parsed.command.name, parsed.given) == (command, params)
    assert {*parsed.typed} == {option.name for option in parsed.command.options if option.name in options.typed}
    assert parsed.common.get("socket") == options.socket
    assert parsed.common.get("connect_timeout") == options.connect_timeout
    assert (parsed.common.get("json", False), parsed.common.get("quiet", False)) == (options.json, options.quiet)


def assert_sent_like_the_library(arguments: list[str]) -> None:
    parsed = plain.read(arguments, os.environ)
    sent = parsed and sent_early(parsed)
    if not parsed or not sent:
        return
    request = library_requests(parsed)[1]
    assert sent == library_messages(parsed)
    if isinstance(request, Say):
        check(request)
        assert too_long(request) is None


@settings(max_examples=300, deadline=None)
@given(LINES, ENVIRONMENTS)
def test_simple_lines_are_parsed_like_click_and_sent_like_the_library(
    arguments: list[str], environment: Mapping[str, str]
) -> None:
    with sender_name(environment):
        assert_parsed_like_click(arguments)
        assert_sent_like_the_library(arguments)


@pytest.mark.parametrize(
    "line",
    [
        *("say low", "say battery low --wait", "--json say -w -t 2.5 --preempt -- -3 degrees", "cancel"),
        "say --queue --priority -1 --key=battery --throttle 60 --rate 150 x",
        "say --id a-1 --voice de --volume 0.5 --pitch 99 --as me Grüße",
        *("say --stream -w", "say --stream --stall 9 -", "play -w chirp", "play --list"),
        *("cancel --current 12 13", "status -q", "--socket /run/x status 12 --json", "wait 12 -t 10 -f"),
    ],
)
def test_typical_script_lines_are_parsed_without_click(line: str) -> None:
    assert plain.read(line.split(), {})


@pytest.mark.parametrize(
    "line",
    [
        *(
            [],
            ["serve", "--print-unit", "x"],
            ["sya", "hello"],
            ["--version"],
            ["say", "-h"],
            ["say"],
            ["say", "--lines", "x"],
        ),
        *(["say", "--wiat", "x"], ["say", "-x"], ["say", "x", "--rate", "79"], ["say", "x", "--rate"]),
        *(["say", "-w5", "x"], ["say", "x", "--flush", "--queue"], ["say", "x", "-t", "5"], ["say", "-wt", "0", "x"]),
        *(["status", "1", "2"], ["say", "x", "--ttl", "nan"], ["say", "x", "--key", ""], ["say", "x", "--wait=1"]),
        *(["say", "x", "--key", "k" * 65], ["say", "x", "--priority", "1000001"], ["say", "-o", "x.wav", "x"]),
        *(["say", "--stream", "x"], ["say", "--stall", "5", "x"], ["say", "--stream", "--stall", "0"]),
        *(["play"], ["play", "a", "b"], ["play", ""], ["play", "--list", "a"], ["play", "--list", "-w"]),
        *(["play", "a", "--rate", "90"], ["play", "a", "-f"], ["play", "a", "-t", "5"], ["play", "a", "--markdown"]),
    ],
)
def test_other_lines_are_parsed_by_click(line: list[str]) -> None:
    assert plain.read(line, {}) is None


def sent_early(parsed: plain.PlainCommand) -> tuple[JsonObject, JsonObject] | None:
    """Return the requests that are sent early for a command; None if nothing is sent early."""
    return plain.early_messages(parsed) if plain.may_send_early(parsed) else None


def library_requests(parsed: plain.PlainCommand) -> tuple[Hello, Request]:
    """Return the requests that the client library sends for a command."""
    name, command = parsed.given.get("name") or os.environ.get("TALK_NAME") or None, parsed.command.name
    hello = Hello(name, urgent=command in {"cancel", "status"})
    if command == "say":
        text, options = " ".join(parsed.given["text"]), {name: parsed.given[name] for name in GOAL_OPTIONS}
        feedback = parsed.given["feedback"]
        return hello, Say(text, wait=parsed.given["wait"] or feedback, feedback=feedback, **options)
    if command == "play":
        options = {name: parsed.given[name] for name in GOAL_OPTIONS if name in parsed.given}
        return hello, Say(parsed.given["sound"], wait=parsed.given["wait"], **{**options, "format": "sound"})
    if command == "cancel":
        given = parsed.given
        return hello, Cancel(given["ids"] or None, given["current"], given["before"], given["key"])
    if command == "pause":
        return hello, Pause(parsed.given["seconds"])
    return hello, Status(parsed.given.get("goal_id")) if command == "status" else Resume()


def library_messages(parsed: plain.PlainCommand) -> tuple[JsonObject, JsonObject]:
    """Return the requests that the client library sends for a command, in JSON."""
    hello, request = library_requests(parsed)
    return request_to_json(hello), request_to_json(request)


@settings(max_examples=50)
@given(st.text(max_size=40))
def test_any_text_is_sent_early_unchanged(text: str) -> None:
    parsed = plain.read(["say", "--", text], {})
    assert not parsed or text == "-" or sent_early(parsed) == (request_to_json(Hello()), request_to_json(Say(text)))


@pytest.mark.parametrize(
    "line",
    [
        *(["say", 'a "quoted" word'], ["say", "two\nlines"], ["say", "x", "--id", "a"], ["say", "x" * 10_000]),
        *(["play", "chirp"], ["play", "-w", "--volume", "0.5", "--key", "k", "no such sound"]),
        *(["cancel", "4k7f-12"], ["cancel", "--before", "x"], ["cancel", "--key", "k"], ["status", "4k7f-12"]),
    ],
)
def test_a_request_that_only_the_server_checks_is_sent_early(line: list[str]) -> None:
    parsed = plain.read(line, {})
    assert parsed
    assert sent_early(parsed) == library_messages(parsed)


@pytest.mark.parametrize(
    "line",
    [
        *(["say", "x" * 10_001], ["say", "x", "--voice", "v" * 10_000], ["say", "x", "--as", "n" * 65]),
        *(["play", "--list"], ["say", "-"], ["say", "--lines"], ["say", "Gr\udcc3\udcbc"], ["wait"], ["log"]),
        *(["cancel", "12"], ["cancel", "a", "a"], ["cancel", "i" * 65], ["cancel", ""], ["cancel", "--before", "12"]),
        *(["status", "12"], ["status", "i" * 65], ["cancel", "--key", "k" * 65], ["pause", "--for", "2m"]),
        ["pause", "--while", "--", "-x"],
    ],
)
def test_a_request_that_the_library_may_change_or_refuse_is_not_sent_early(line: list[str]) -> None:
    parsed = plain.read(line, {})
    assert parsed
    assert sent_early(parsed) is None


def test_the_expected_greeting_matches_the_servers() -> None:
    assert encode(events.greeting("0.1.0", 1, "4k7f")).startswith(GREETING_START)
    assert not encode(events.busy_greeting()).startswith(GREETING_START)
