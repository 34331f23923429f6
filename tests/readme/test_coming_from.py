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
from tests.readme.shell import wait_until
from tests.support.documents import COMMAND_LINE, tables, words

if TYPE_CHECKING:
    from tests.readme.shell import Shell
    from tests.support.processes import Talk


def rows() -> list[tuple[str, str, str]]:
    """Return the rows: from where, what was typed, what is typed now."""
    found, where = [], ""
    for first, before, now in tables(COMMAND_LINE.section("Coming from something else"))[0][1:]:
        where = first or where
        found.append((where, before, now))
    return found


NOW = [each for _, _, now in rows() for each in words(now)]
COMMANDS = [each for each in NOW if re.match("talk [a-z]", each)]
SCRIPTS = [each for each in NOW if re.search("[;|] ", each)]
PYTHON = [each for each in NOW if each not in COMMANDS + SCRIPTS]


def test_all_is_either_a_command_or_python() -> None:
    assert len(COMMANDS) > 25
    assert len(SCRIPTS) == 2
    assert len(PYTHON) > 8
    assert {where for where, _, _ in rows()} == {"espeak-ng", "spd-say", "sound_play", "pyttsx3"}


def test_commands_of_now_work(speaking: Talk, shell: Shell) -> None:
    (shell.directory / "notes.txt").write_text("first\nsecond\n", encoding="utf-8")
    for each in dict.fromkeys(COMMANDS):
        if not each.startswith("talk serve"):  # the tour starts some; here they are read
            done = shell.run(each)
            assert done.returncode == 0, done
    assert (shell.directory / "notes.wav").stat().st_size > 1000
    texts = [speaking.goal(each)["text"] for each in speaking.watcher.goals()]
    assert {"first\nsecond", "Guten Tag", "obstacle", "moving on", "mail", "ten percent", "battery low"} <= set(texts)
    assert speaking.request("status")["server"]["paused"] is False
    by_text = {each: speaking.goal(goal) for each, goal in zip(texts, speaking.watcher.goals(), strict=True)}
    assert (by_text["obstacle"]["priority"], by_text["moving on"]["client"]["name"]) == (10, "patrol")


def test_each_line_of_a_pipe_is_spoken_and_goes_on(scripted: Talk, scripted_shell: Shell) -> None:
    scripted_shell.stand_in("make", "printf 'one\\ntwo\\n'")
    (pipe,) = (each for each in SCRIPTS if each.startswith("make"))
    done = scripted_shell.run(pipe)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "one\ntwo\n")
    goals = [scripted.goal(each) for each in scripted.watcher.goals()]
    assert [(each["text"], each["priority"]) for each in goals] == [("one", 5), ("two", 5)]


def test_what_is_repeated_ends_with_a_cancel(scripted: Talk, scripted_shell: Shell) -> None:
    (loop,) = (each for each in SCRIPTS if each.startswith("while"))
    repeating = scripted_shell.start(loop.replace("battery low", "length=0.02"))
    wait_until(lambda: len(scripted.watcher.goals()) > 2)
    while repeating.poll() is None:  # it may come between two of them
        scripted.run("cancel")
    out, err = repeating.communicate(timeout=20)
    assert (repeating.returncode, len(out.splitlines())) == (0, len(scripted.watcher.goals())), err


#: What speech-dispatcher 0.11.4 did with the one being spoken and a new one of another program, for each two of its
#: priorities, new ones from left to right: Cut the first, Wait, Drop the new one. Small letters: it has no equal here.
DISPATCHED = {
    "important": "wWWWD",
    "message": "CWWWD",
    "text": "CcCWD",
    "progress": "CcCWD",
    "notification": "CcCcC",
}


def spd_say(priority: str) -> list[str]:
    """Return what is typed now for a priority of speech-dispatcher's, without the text."""
    before = 'spd-say "' if priority == "text" else f"spd-say -P {priority} "
    (now,) = (words(now)[0] for _, each, now in rows() if words(each)[0].startswith(before))
    return shlex.split(now)[1:-1]


#: What becomes of the first and of the new one here.
BECOMES = {
    **dict.fromkeys("Cw", ("PREEMPTED", "ACTIVE")),
    **dict.fromkeys("Wc", ("ACTIVE", "PENDING")),
    "D": ("ACTIVE", "RECALLED"),
}


@pytest.mark.parametrize("old", DISPATCHED)
def test_priorities_of_speech_dispatcher(scripted: Talk, old: str) -> None:
    for new, does in zip(DISPATCHED, DISPATCHED[old], strict=True):
        first = scripted.run(*spd_say(old), "never-ends").id
        scripted.watcher.wait_for_word(first)
        second = scripted.run(*spd_say(new), f"never-ends {new}").id
        scripted.watcher.wait_for(second, BECOMES[does][1])
        assert (scripted.goal(first)["state"], scripted.goal(second)["state"]) == BECOMES[does], new
        scripted.run("cancel")


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
