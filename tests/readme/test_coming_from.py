"""The table for those who come from something else: what they type now works, and what they typed was right."""

from __future__ import annotations

import contextlib
import re
import shlex
import shutil
import subprocess
from typing import TYPE_CHECKING, Any

import pytest
from pyttsx3 import engine

from talkcli import Client
from tests.wire.readme import section, tables, words

if TYPE_CHECKING:
    from tests.readme.shell import Shell
    from tests.support.processes import Talk


def rows() -> list[tuple[str, str, str]]:
    """Return the rows: from where, what was typed, what is typed now."""
    found, where = [], ""
    for first, before, now in tables(section("Coming from something else"))[0][1:]:
        where = first or where
        found.append((where, before, now))
    return found


NOW = [each for _, _, now in rows() for each in words(now)]
COMMANDS = [each for each in NOW if re.match("talk [a-z]", each)]
PYTHON = [each for each in NOW if each not in COMMANDS]


def test_all_is_either_a_command_or_python() -> None:
    assert len(COMMANDS) > 15
    assert len(PYTHON) > 6
    assert {where for where, _, _ in rows()} == {"espeak-ng", "spd-say", "sound_play", "pyttsx3"}


def test_commands_of_now_work(speaking: Talk, shell: Shell) -> None:
    (shell.directory / "notes.txt").write_text("first\nsecond\n", encoding="utf-8")
    for each in dict.fromkeys(COMMANDS):
        if not each.startswith("talk serve"):  # the tour starts some; here they are read
            done = shell.run(each)
            assert done.returncode == 0, done
    assert (shell.directory / "notes.wav").stat().st_size > 1000
    texts = [speaking.goal(each)["text"] for each in speaking.watcher.goals()]
    assert {"first\nsecond", "Guten Tag", "obstacle", "moving on", "battery low"} <= set(texts)
    by_text = {each: speaking.goal(goal) for each, goal in zip(texts, speaking.watcher.goals(), strict=True)}
    assert (by_text["obstacle"]["priority"], by_text["moving on"]["client"]["name"]) == (10, "patrol")


def test_python_of_now_works(speaking: Talk) -> None:
    with contextlib.ExitStack() as opened:
        names: dict[str, Any] = {"Client": lambda: opened.enter_context(Client(speaking.socket))}
        for line in PYTHON:
            exec(line, names)
    assert speaking.request("set")["settings"]["rate"] == 150


def test_pyttsx3_of_before_is_its_own() -> None:
    used = {
        each for where, before, _ in rows() if where == "pyttsx3" for each in re.findall(r"engine\.(\w+)\(", before)
    }
    assert used >= {"say", "runAndWait", "connect"}
    assert [each for each in used if not hasattr(engine.Engine, each)] == []


@pytest.mark.parametrize("program", ["espeak-ng", "spd-say"])
def test_options_of_before_are_the_program_s_own(program: str) -> None:
    if shutil.which(program) is None:
        pytest.skip(f"{program} is not installed, and no test needs it")
    asked = subprocess.run([program, "--help"], capture_output=True, text=True, timeout=20, check=False).stdout
    for where, before, _ in rows():
        if where == program:
            for option in (each for each in shlex.split(words(before)[0]) if re.match(r"--?[a-zA-Z]", each)):
                assert re.search(rf"(?<![\w-]){re.escape(option.partition('=')[0])}\b", asked), option
