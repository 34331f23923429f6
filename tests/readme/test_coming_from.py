"""The commands and the Python code in the table for users of other programs."""

from __future__ import annotations

import contextlib
import re
from typing import TYPE_CHECKING, Any

from talkcli import Client
from tests.readme.shell import wait_until
from tests.support.documents import COMMAND_LINE, code_spans, tables

if TYPE_CHECKING:
    from tests.readme.shell import Shell
    from tests.support.processes import Talk

TABLE = tables(COMMAND_LINE.section("Coming from something else"))[0]
REPLACEMENTS = [span for row in TABLE[1:] for span in code_spans(row[2])]
COMMANDS = [span for span in REPLACEMENTS if re.match("talk [a-z]", span)]
(PIPE, LOOP) = sorted(span for span in REPLACEMENTS if re.search("[;|] ", span))
PYTHON = [span for span in REPLACEMENTS if span not in {*COMMANDS, PIPE, LOOP}]


def test_recommended_commands_and_python_work(speaking: Talk, shell: Shell) -> None:
    (shell.directory / "notes.txt").write_text("first\nsecond\n", encoding="utf-8")
    for command in dict.fromkeys(COMMANDS):
        if not command.startswith("talk serve"):  # tests of the tour start servers
            done = shell.run(command)
            assert done.returncode == 0, done
    assert (shell.directory / "notes.wav").stat().st_size > 1000
    goals = {goal["text"]: goal for goal in map(speaking.goal, speaking.watcher.goals())}
    assert {"first\nsecond", "Guten Tag", "obstacle", "moving on", "mail", "ten percent", "battery low"} <= set(goals)
    assert (goals["obstacle"]["priority"], goals["moving on"]["client"]["name"]) == (10, "patrol")
    assert speaking.request("status")["server"]["paused"] is False
    with contextlib.ExitStack() as opened:
        names: dict[str, Any] = {"Client": lambda: opened.enter_context(Client(speaking.socket))}
        for line in PYTHON:
            exec(line, names)
    assert speaking.request("set")["settings"]["rate"] == 150


def test_the_recommended_pipe_speaks_each_line_and_passes_it_on(scripted: Talk, scripted_shell: Shell) -> None:
    scripted_shell.stand_in("make", "printf 'one\\ntwo\\n'")
    done = scripted_shell.run(PIPE)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "one\ntwo\n")
    goals = [scripted.goal(goal_id) for goal_id in scripted.watcher.goals()]
    assert [(goal["text"], goal["priority"]) for goal in goals] == [("one", 5), ("two", 5)]


def test_the_recommended_loop_ends_with_a_cancel(scripted: Talk, scripted_shell: Shell) -> None:
    repeating = scripted_shell.start(LOOP.replace("battery low", "length=0.02"))
    wait_until(lambda: len(scripted.watcher.goals()) > 2)
    while repeating.poll() is None:  # a cancel may come between two goals
        scripted.run("cancel")
    out, err = repeating.communicate(timeout=20)
    assert (repeating.returncode, len(out.splitlines())) == (0, len(scripted.watcher.goals())), err
