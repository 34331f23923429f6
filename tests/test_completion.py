"""The completion scripts: those that are checked in are what the commands make of them, and shells take them."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest

from talkcli import completion
from talkcli.cli import COMMANDS
from tests.conformance.bareserve import TALK, environment, run
from tests.support.surroundings import needs

if TYPE_CHECKING:
    import pathlib

CHECKED_IN = os.path.join(os.path.dirname(os.path.dirname(os.path.abspath(__file__))), "completions")


def test_scripts_that_are_checked_in_are_those_of_this_version(tmp_path: pathlib.Path) -> None:
    completion.main(str(tmp_path))
    assert sorted(os.listdir(CHECKED_IN)) == sorted(os.listdir(tmp_path)) == sorted(completion.FILES)
    for name in completion.FILES:
        with open(os.path.join(CHECKED_IN, name), encoding="utf-8") as file:
            assert file.read() == (tmp_path / name).read_text("utf-8"), f"python -m talkcli.completion {CHECKED_IN}"


@pytest.mark.parametrize(("shell", "name"), [("bash", "talk.bash"), ("zsh", "_talk"), ("fish", "talk.fish")])
def test_scripts_have_no_syntax_error(shell: str, name: str) -> None:
    needs(shell)
    done = run([shell, "-n", os.path.join(CHECKED_IN, name)], dict(os.environ))
    assert (done.code, done.err) == (0, "")


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("talk ", set(COMMANDS)),
        ("talk sta", {"status"}),
        ("talk say --pre", {"--preempt"}),
        ("talk serve --vo", {"--volume", "--voice"}),
    ],
)
def test_bash_completes_commands_and_options(tmp_path: pathlib.Path, line: str, expected: set[str]) -> None:
    words = line.split(" ")
    env = environment(str(tmp_path), _TALK_COMPLETE="bash_complete", COMP_WORDS=line, COMP_CWORD=str(len(words) - 1))
    done = run(TALK, env)
    assert {each.partition(",")[2] for each in done.out.splitlines()} == expected
