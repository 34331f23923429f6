"""The help, and messages for new users about wrong command lines and missing devices."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from typing import TYPE_CHECKING

import click
import pytest

from talkcli import errors
from talkcli.cli import commands, show
from talkcli.cli.click_app import ClickCommand, talk
from talkcli.cli.command import ALL_EXIT_CODES
from talkcli.engine import players
from talkcli.goals import states
from tests.conformance.bareserve import TALK, alone, environment, run
from tests.golden import surface
from tests.support.screen import Terminal
from tests.support.surroundings import short_directory

if TYPE_CHECKING:
    import pathlib

    from tests.conftest import MakeTalk
    from tests.support.processes import Talk
    from tests.support.sink import Sink

FAST = ("--rate", "450")

#: Commands whose help lists exit codes, because scripts often check them.
WITH_EXIT_CODES = ("say", "wait", "doctor")
#: Commands whose help fits on 24 lines.
SHORT = ("cancel", "status", "log", "set", "pause", "resume", "voices", "wait", "completion")


def command(name: str) -> ClickCommand:
    result = talk.get_command(click.Context(talk), name)
    assert isinstance(result, ClickCommand), name
    return result


def too_wide(text: str, columns: int = 80) -> list[str]:
    return [line for line in text.splitlines() if len(line) > columns]


def golden_help(name: str) -> str:
    """Return the help of a command from the golden files. `tests/golden` checks that they are current."""
    return (surface.HERE / f"help-{name}.txt").read_text("utf-8")


# Help


def test_talk_without_arguments_shows_every_command_on_one_screen() -> None:
    done = alone(COLUMNS="80")
    out = done.out
    assert (done.code, done.err, too_wide(out)) == (0, "", [])
    assert len(out.splitlines()) < 24  # one line is for the prompt
    assert re.findall(r"(?m)^  ([a-z]+)  +[A-Z]", out) == [*commands.COMMANDS]
    for text in ("talk serve &", "talk say ", "talk doctor", "talk --help", "talk COMMAND --help"):
        assert text in out


def test_the_help_of_talk_lists_all_exit_codes() -> None:
    out = golden_help("talk")
    classes = [cls for cls in vars(errors).values() if isinstance(cls, type) and issubclass(cls, errors.TalkError)]
    used = {cls.exit_code for cls in classes} | set(states.EXIT_CODES.values())
    used |= {errors.EXIT_OK, errors.EXIT_ERROR, errors.EXIT_USAGE, errors.EXIT_DIFFER, errors.EXIT_TIMEOUT}
    shown = re.findall(r"(?m)^  (\S+) +\S", out.partition("\nExit codes:\n")[2])
    assert shown == [*map(str, sorted(used)), f"{errors.EXIT_SIGNAL}+n"]
    assert "TALK_SOCKET" in out
    assert "TALK_DEBUG" in out


@pytest.mark.parametrize("arguments", [["-h"], ["say", "-h"]])
def test_h_shows_the_help_in_the_width_of_the_terminal(arguments: list[str]) -> None:
    assert alone(*arguments, COLUMNS="80").out == golden_help(arguments[0] if arguments[1:] else "talk")
    done = alone(*arguments, COLUMNS="120")
    assert (done.code, done.err, too_wide(done.out, 120)) == (0, "", [])
    assert too_wide(done.out)


@pytest.mark.parametrize("name", commands.COMMANDS)
def test_the_help_of_a_command_has_a_purpose_examples_and_options(name: str) -> None:
    out = golden_help(name)
    assert too_wide(out) == []
    assert out.endswith("\n\nCommon options and exit codes: talk --help\n")
    assert len(out.splitlines()) <= 24 or name not in SHORT
    headings = re.findall(r"(?m)^([A-Z][a-z ]+:)$", out)
    own = any(isinstance(parameter, click.Option) and parameter.expose_value for parameter in command(name).params)
    assert headings == ["Examples:", *["Options:"] * own, *["Exit codes:"] * (name in WITH_EXIT_CODES)]
    purpose = (command(name).help or "").partition("\n\n")[0]
    assert purpose.endswith((".", ":", ","))
    assert len(purpose) > 30
    shared = golden_help("talk").partition("Common options, before or after the command:")[2]
    for option in ("--socket PATH", "--json ", "-q, --quiet ", "-h, --help "):
        assert (f"\n  {option}" in shared, f"\n  {option}" in out) == (True, False)
    if name in WITH_EXIT_CODES:
        codes = [*(command(name).exit_codes or {})]
        assert {*map(str, codes)} <= {*map(str, ALL_EXIT_CODES), "4-7"}
        assert re.findall(r"(?m)^  (\d\S*) +\S", out.partition("\nExit codes:\n")[2]) == [*map(str, codes)]
        assert [code for code in codes if isinstance(code, int)] == sorted(
            code for code in codes if isinstance(code, int)
        )


@pytest.mark.parametrize("name", commands.COMMANDS)
def test_every_option_is_explained(name: str) -> None:
    for option in command(name).params:
        if isinstance(option, click.Option):
            assert option.help, option.name
            assert option.help[0].isupper(), option.name
            assert option.help.endswith((".", "]")), option.name
            default = option.type.get_metavar(option, click.Context(command(name)))
            assert option.metavar or option.is_flag or default in {"-", "N", "X"}, f"{option.name} shows {default}"


@pytest.mark.parametrize("name", commands.COMMANDS)
def test_the_examples_are_valid_command_lines(name: str) -> None:
    """The arguments of each `talk` are parsed like a command line, but not executed."""
    seen = []
    for line in command(name).row.examples.strip().splitlines():
        for part in re.findall(r"\btalk ((?:\"[^\"]*\"|[^|;&)\"])*)", re.split(r"(?<=\S)   +", line.strip())[0]):
            arguments = [argument for argument in shlex.split(part.partition("'")[0]) if argument != "--json"]
            seen.append(arguments[0])
            with command(arguments[0]).make_context(arguments[0], arguments[1:], parent=click.Context(talk)) as context:
                assert context.params is not None
    assert name in seen


# Wrong command lines, missing players and devices


@pytest.mark.parametrize(("columns", "lines"), [(60, 4), (80, 3), (200, 2)])
def test_messages_wrap_between_words_on_a_terminal(columns: int, lines: int) -> None:
    arguments = ["say", "--wiat", "hello"]
    with short_directory() as home:
        with Terminal([*TALK, *arguments], environment(home), columns) as shown:
            assert shown.finish() == 2
            assert max(map(len, shown.lines)) <= columns
            assert shown.screen.wraps == 0
        whole = run([*TALK, *arguments], environment(home)).err
    assert " ".join(" ".join(shown.lines).split()) == " ".join(whole.split())
    assert len(shown.lines) == lines


def test_a_command_in_a_message_is_not_wrapped() -> None:
    command = "sudo python3 -m venv /opt/talk && sudo /opt/talk/bin/pip install ."
    for message in (f"one {'two ' * 20}'{command}' three {'four ' * 20}", f"{'one ' * 30}start one with: {command}"):
        lines = show._wrap(message).splitlines()
        assert len(lines) > 2
        assert sum(command in line for line in lines) == 1
        assert " ".join(line.strip() for line in lines) == message.strip()


def test_a_missing_player_is_reported_at_the_start(make_talk: MakeTalk) -> None:
    first = make_talk("--player", "aply").log.splitlines()[0]
    assert first == "talk: player \"aply\" not found; nothing can be heard; did you mean 'aplay'?"


def test_a_missing_sound_device_is_reported_and_used_once_it_appears(make_talk: MakeTalk, sink: Sink) -> None:
    talk = make_talk(*FAST, env={"PULSE_SERVER": ""}, forked=False)
    first = talk.log.splitlines()[0]
    assert first.startswith("talk: no sound device or sound server found, ") == players.has_no_output(talk.env)
    if players.has_no_output(talk.env):
        assert "talk doctor" in first
        assert "--player file:PATH.wav" in first
        done = talk.run("say", "--wait", "hello")
        assert done.code == 4
        assert re.fullmatch(r"talk: \S+: speech failed: aplay: .*; find out why with: talk doctor\n", done.err)
    shutil.copy(f"{sink.directory}/.asoundrc", talk.directory)  # like a loudspeaker that is plugged in
    assert talk.run("say", "--wait", "hello").code == 0


@pytest.mark.parametrize(
    ("options", "server"),
    [("--player null", ""), ("--player file:said.wav", ""), ("--player cat", ""), ("-q", ""), ("", "unix:/there")],
)
def test_a_sound_device_that_is_not_needed_may_be_missing(make_talk: MakeTalk, options: str, server: str) -> None:
    talk = make_talk(*options.split(), env={"PULSE_SERVER": server}, watched=False)
    assert "no sound device" not in talk.log


def test_unused_player_options_are_reported_if_the_driver_plays_sound(make_talk: MakeTalk) -> None:
    for options, note in (("--player aply --lead-in 100", "; --player and --lead-in have no effect"), ("", "")):
        talk = make_talk(*options.split(), env={"PULSE_SERVER": ""}, driver="dummy")
        assert talk.run("say", "--wait", "hello").code == 0
        assert f"driver dummy, no player needed{note}\n" in talk.log
        assert "not found" not in talk.log
        assert "no sound device" not in talk.log


def test_without_a_player_the_log_names_packages_to_install(make_talk: MakeTalk, tmp_path: pathlib.Path) -> None:
    talk = make_talk(env={"PATH": str(tmp_path)}, watched=False)
    talk.run("voices")  # the engine is ready before it lists them
    note = "no player found; install alsa-utils (aplay), pulseaudio-utils (pacat) or pipewire-bin (pw-cat)\n"
    assert next(line for line in talk.log.splitlines(True) if "engine ready" in line).endswith(f", {note}")


def test_an_output_file_of_another_format_is_refused(tmp_path: pathlib.Path) -> None:
    done = alone("say", "-o", str(tmp_path / "hello.MP3"), "hello")
    assert (done.code, "--output can only write WAV files; name the file .wav" in done.err) == (2, True)
    assert not list(tmp_path.iterdir())


def test_a_mistyped_key_is_reported_only_on_a_terminal(scripted: Talk) -> None:
    scripted.run("say", "--key", "battery", "never-ends")
    assert scripted.run("cancel", "--key", "batery").err == ""  # for scripts, a key without goals is normal
    hint = "talk: no goal has the key 'batery'; did you mean 'battery'?\n"
    for arguments, expected in (("batery", hint), ("door", ""), ("batery -q", ""), ("battery", r"\w{4}-\d+\n")):
        with Terminal([*TALK, "cancel", "--key", *arguments.split()], scripted.env) as shown:
            assert shown.finish() == 0
            assert re.fullmatch(expected.replace("?", r"\?"), shown.text)


def test_a_language_may_be_given_by_its_name(make_talk: MakeTalk) -> None:
    talk = make_talk("--player", "null")
    assert talk.run("voices", "--language", "German").out == talk.run("voices", "--language", "de_DE").out != ""
    done = talk.run("voices", "--language", "Englsh")
    assert (done.code, done.out, done.err) == (1, "", "talk: no voice speaks 'Englsh'; did you mean 'en'?\n")
    quiet = talk.run("--json", "-q", "voices", "--language", "1234")
    assert (quiet.code, quiet.out) == (1, "")
    assert "list all voices with: talk voices" in json.loads(quiet.err)["error"]["message"]
