"""Completion: the checked-in scripts, the offered values, and real shells."""

from __future__ import annotations

import contextlib
import os
import re
import select
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import pytest

from talkcli.cli.commands import COMMANDS
from tests.conformance.bareserve import TALK, environment, run
from tests.conformance.rawsocket import GREETING, FakeServer
from tests.golden import surface
from tests.readme.blocks import block
from tests.support.connection import PATIENCE
from tests.support.screen import Terminal
from tests.support.surroundings import needs, short_directory
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    import pathlib
    from collections.abc import Mapping

    from tests.conftest import MakeTalk
    from tests.support.processes import Talk

CHECKED_IN = os.path.join(os.path.dirname(os.path.dirname(os.path.abspath(__file__))), "completions")
#: A key with characters that are special to shells or to the output formats.
KEY = 'low battery, now: it\'s $5 "x" *\\ a;b|c&'
#: The file of each shell's script.
FILES = {"bash": "talk.bash", "zsh": "_talk", "fish": "talk.fish"}
#: For each shell: commands that let ^G write the command line to the file OUT.
SHELLS = {
    "bash": """bind -x '"\\C-g": printf "%s\\n" "$READLINE_LINE" > OUT'; PS1='rea''dy> '\n""",
    "zsh": "show() { print -r -- $BUFFER > OUT }; zle -N show; bindkey '^G' show; PS1='rea''dy> '\n",
    "fish": "bind \\cg 'commandline > OUT'; function fish_prompt; echo 'rea''dy> '; end\n",
}
#: bash-completion, if it is installed. It has a completion for an older program named `talk`.
BASH_COMPLETION = "/usr/share/bash-completion/bash_completion"


def offered(line: str, env: Mapping[str, str]) -> list[tuple[str, str]]:
    """Return the values that are offered at the end of a line, with their help. Errors must not be printed."""
    request = {"_TALK_COMPLETE": "fish_complete", "COMP_WORDS": line, "COMP_CWORD": ""}
    done = run(TALK, {**env, **request})
    assert (done.code in {0, 1}, done.err) == (True, ""), done
    lines = [line.removeprefix("plain,").partition("\t") for line in done.out.splitlines() if line]
    return [(value, text) for value, _, text in lines]


def values(line: str, talk: Talk) -> list[str]:
    return [value for value, _ in offered(line, talk.env)]


@pytest.fixture
def busy(make_talk: MakeTalk) -> tuple[Talk, list[str]]:
    """Return a server, and the ids of an ended, an active and a pending goal.

    The server's ids don't start with the number of a goal, so that each tested prefix matches only one id.
    """
    scripted = make_talk(scripted=True)
    while scripted.request("status")["server"]["boot"][0] in "123":
        scripted.stop()
        scripted = make_talk(scripted=True)
    ended = scripted.run("say", "--wait", "--key", "over", "length=0").id
    active = scripted.request("say", text="moving, slowly: never-ends\t\x1b[31m", key=KEY, id="/door:open/1")["goal"][
        "id"
    ]
    scripted.watcher.wait_for_word(active)
    pending = scripted.run("say", "--key", "plain", "battery low").id
    return scripted, [ended, active, pending]


# The scripts


@pytest.mark.parametrize(("shell", "name"), FILES.items())
def test_the_command_prints_the_checked_in_script(tmp_path: pathlib.Path, shell: str, name: str) -> None:
    assert sorted(os.listdir(CHECKED_IN)) == sorted(FILES.values())
    done = run([*TALK, "completion", shell], environment(str(tmp_path)))
    assert (done.code, done.err) == (0, "")
    with open(os.path.join(CHECKED_IN, name), encoding="utf-8") as file:
        assert file.read() == done.out


# Offered values


def test_commands_options_and_values_are_offered_without_a_server(tmp_path: pathlib.Path) -> None:
    env = environment(str(tmp_path), TALK_SOCKET=f"{tmp_path}/none")
    for line, expected in (
        ("talk sta", {"status"}),
        ("talk say --pre", {"--preempt"}),
        ("talk serve --vo", {"--volume", "--voice", "--voice-memory"}),
        ("talk serve --player ", {"pulse", "aplay", "pacat", "pw-cat", "null"}),
        ("talk serve --player=p", {"--player=pulse", "--player=pacat", "--player=pw-cat"}),
        *((line, {"file"}) for line in ("talk --socket /etc/pa", "talk say -o x")),
        ("talk completion ", set(FILES)),
        *((line, set()) for line in ("talk say ", "talk nonsense --x", "talk cancel --nonsense", 'talk cancel "')),
    ):
        assert {value for value, _ in offered(line, env)} == expected, line


def test_every_command_and_option_is_offered_with_its_help(tmp_path: pathlib.Path) -> None:
    env = environment(str(tmp_path), TALK_SOCKET=f"{tmp_path}/none")
    assert dict(offered("talk ", env)) == {command.name: command.summary for command in COMMANDS.values()}
    assert {value for value, _ in offered("talk --", env)} >= {"--socket", "--json", "--version"}
    for command in COMMANDS:
        options = dict(offered(f"talk {command} --", env))
        assert {"--socket", "--json", "--quiet", "--help"} <= options.keys()
        # Shells show the help next to the option, and cut it if it is too long.
        assert [text for text in options.values() if len(text) > 60 or not re.fullmatch(r"[A-Z].*[^.]\.", text)] == []
        shown = "".join((surface.HERE / f"help-{name}.txt").read_text("utf-8") for name in (command, "talk"))
        assert not [option for option in options if option not in shown]


def test_goal_ids_are_offered_with_their_texts(busy: tuple[Talk, list[str]]) -> None:
    talk, (ended, active, pending) = busy
    for line in ("talk cancel ", "talk wait ", "talk cancel --before ", f"talk wait {pending} "):
        assert values(line, talk) == [active, pending]
    assert values("talk status ", talk) == [active, pending, ended]
    assert values("talk cancel --before=/do", talk) == ["--before=/door:open/1"]
    helps = dict(offered("talk status ", talk.env))
    assert helps[active] == r"ACTIVE moving, slowly: never-ends\t\x1b[31m"
    assert helps[pending] == "PENDING battery low"
    assert helps[ended] == "SUCCEEDED length=0"
    number = pending.partition("-")[2]
    assert values(f"talk cancel {number}", talk) == [number]
    assert values("talk cancel 999", talk) == []


def test_keys_voices_and_sounds_are_offered(busy: tuple[Talk, list[str]]) -> None:
    talk, _ = busy
    assert values("talk cancel --key ", talk) == [KEY, "plain"]
    assert values("talk say --key ", talk) == [KEY, "plain", "over"]
    assert values("talk say --key pl", talk) == ["plain"]
    for line in ("talk say --voice ", "talk set --voice ", "talk serve --voice ", "talk set --voice e"):
        assert offered(line, talk.env) == [("en", "scripted")]
    assert values("talk set --voice scr", talk) == ["scripted"]
    assert values("talk set --voice=e", talk) == ["--voice=en"]
    assert values("talk play ", talk) == ["chirp", "error", "warning"]
    assert values("talk play -w e", talk) == ["error"]


def test_long_texts_are_shortened_and_untypable_keys_are_omitted(scripted: Talk) -> None:
    scripted.request("say", text=f"never-ends {'x' * 1000}", key="a\x1b[31mb")
    ((_, text),) = offered("talk cancel ", scripted.env)
    assert len(text) < 80
    assert text.endswith("…")
    scripted.request("say", text="waits", key="two\nlines")
    scripted.request("say", text="waits", key="fine")
    assert values("talk cancel --key ", scripted) == ["fine"]


def test_completion_asks_the_server_named_on_the_command_line(busy: tuple[Talk, list[str]]) -> None:
    talk, (_, active, pending) = busy
    env = {**talk.env, "TALK_SOCKET": "/nowhere"}
    assert offered("talk cancel ", env) == offered("talk --socket /nowhere cancel ", talk.env) == []
    for line in (
        f"talk --socket={talk.socket} cancel ",
        f"talk cancel --socket {talk.socket} ",
        f"talk --json --socket '{talk.socket}' cancel -q ",
    ):
        assert [value for value, _ in offered(line, env)] == [active, pending]


def test_completion_prints_no_error_if_its_output_cannot_be_written(tmp_path: pathlib.Path) -> None:
    env = environment(str(tmp_path), _TALK_COMPLETE="bash_complete", COMP_WORDS="talk ", COMP_CWORD="")
    with open("/dev/full", "wb") as full:
        done = subprocess.run(TALK, env=env, stdout=full, stderr=subprocess.PIPE, check=False)
    assert (done.returncode, done.stderr) == (1, b"")


@pytest.mark.parametrize("greeting", [b"", GREETING, b"no server of ours\n", None])
@limits()
def test_completion_is_silent_and_quick_with_any_server(greeting: bytes | None) -> None:
    with short_directory() as home, contextlib.ExitStack() as stack:
        if greeting is not None:
            stack.enter_context(FakeServer(f"{home}/s", [greeting]))
        env = environment(home, TALK_SOCKET=f"{home}/s")

        def seconds(line: str) -> float:
            started_at = time.monotonic()
            assert offered(line, env) == []
            return time.monotonic() - started_at

        lines = ["talk cancel ", "talk status ", "talk cancel --key ", "talk say --voice "]
        with ThreadPoolExecutor(len(lines)) as pool:
            durations = list(pool.map(seconds, lines))
    assert_within(max(durations), 3, "a completion")  # at most two timeouts, and the start of a program


# Real shells


class Shell:
    """An interactive shell in a terminal. The README's start files load the completion of `talk`.

    bash loads bash-completion first, as on most machines.
    """

    def __init__(self, name: str, talk: Talk, stack: contextlib.ExitStack) -> None:
        needs(name)
        if name == "bash" and not os.path.exists(BASH_COMPLETION):
            needs("bash-completion")
        directory = talk.directory
        os.makedirs(f"{directory}/bin")
        with open(f"{directory}/bin/talk", "w", encoding="utf-8") as program:
            program.write(f'#!/bin/sh\nexec "{sys.executable}" -m talkcli "$@"\n')
        os.chmod(program.name, 0o755)
        os.mkfifo(f"{directory}/out")
        self._out = os.open(f"{directory}/out", os.O_RDWR)
        stack.callback(os.close, self._out)
        path = f"{directory}/bin:{os.environ['PATH']}"
        env = {**talk.env, "HOME": directory, "PATH": path, "TERM": "xterm", "HISTFILE": ""}
        start_files = f"mkdir -p ~/.config/fish; echo '. {BASH_COMPLETION}' > ~/.bashrc\n" + block("Completion")
        assert run(["sh", "-c", start_files], env).code == 0
        self.terminal = stack.enter_context(Terminal([name, "-i"], env, 500))
        self.terminal.type(SHELLS[name].replace("OUT", f"{directory}/out").encode())
        self.terminal.wait_for("ready> ", 20)

    def complete(self, line: str) -> str:
        """Type a line and TAB, and return the completed command line. Then clear the line."""
        self.terminal.type(line.encode() + b"\t\x07")
        written = b""
        while not written.endswith(b"\n"):
            assert select.select([self._out], [], [], 4 * PATIENCE)[0], f"{line!r}: {self.terminal.text[-500:]!r}"
            written += os.read(self._out, 4096)
        self.terminal.type(b"\x15")
        return written.decode().removesuffix("\n")


ESCAPED = r"low\ battery,\ now:\ it\'s\ \$5\ \"x\"\ \*\\\ a\;b\|c\&"
IN_DOUBLE = r'"low battery, now: it' + "'" + r's \$5 \"x\" *\\ a;b|c&"'


@pytest.mark.parametrize("name", SHELLS)
def test_shells_complete_and_quote_ids_keys_and_options_and_show_texts(busy: tuple[Talk, list[str]], name: str) -> None:
    talk, (_, _, pending) = busy
    in_single = {"fish": r"'low battery, now: it\'s $5 \"x\" *\\ a;b|c&'".replace('\\"', '"')}.get(
        name, r"""'low battery, now: it'\''s $5 "x" *\ a;b|c&'"""
    )
    number = pending.partition("-")[2]
    expected = {
        "talk st": "talk status ",
        "talk cancel '/door:o": "talk cancel '/door:open/1' ",
        "talk cancel --before=/door:": "talk cancel --before=/door:open/1 ",
        f"talk wait {number}": f"talk wait {number} ",
        "talk cancel --key lo": f"talk cancel --key {ESCAPED} ",
        "talk cancel --key 'low b": f"talk cancel --key {in_single} ",
        'talk cancel --key "low b': f"talk cancel --key {IN_DOUBLE} ",
        r"talk cancel --key low\ b": f"talk cancel --key {ESCAPED} ",
        "talk cancel --key=lo": f"talk cancel --key={ESCAPED} ",
        "talk cancel nothing": "talk cancel nothing",
        f"talk --socket {talk.directory}/bin/t": f"talk --socket {talk.directory}/bin/talk ",
        "~/bin/talk cancel /door": "~/bin/talk cancel /door:open/1 ",
    }
    if name == "bash":  # through bash-completion
        expected["sudo talk cancel --before=/door:"] = "sudo talk cancel --before=/door:open/1 "
    with contextlib.ExitStack() as stack:
        shell = Shell(name, talk, stack)
        completed = {line: shell.complete(line) for line in expected}
        if name != "bash":  # it shows only the values
            shell.terminal.type(b"talk cancel \t")
            shell.terminal.wait_for(r"ACTIVE moving, slowly: never-ends\\t\\x1b", 20)
            shell.terminal.wait_for("PENDING battery low", 20)
    assert completed == expected
    assert "rror" not in shell.terminal.text
