"""Unused extras cost nothing, and the package of a missing extra is reported.

Imports dominate the start-up time of a process. A module that is not imported takes no memory and starts no thread.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING

import pytest

from talkcli import install
from talkcli.install import NEURAL_PACKAGES
from tests.conformance.bareserve import TALK, environment, run, serving
from tests.support import tiny_voice, usage
from tests.support.import_recorder import imported, record_imports
from tests.support.processes import children
from tests.support.surroundings import needs_packages, short_directory

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

# A fleet


COMMANDS = (["status"], ["say", "--wait", "hello"], ["--json", "log"], ["doctor", "--help"], ["bridge", "--help"])


@pytest.mark.usefixtures("nobody_serves")
def test_servers_and_clients_import_no_fleet_modules(tmp_path: Path) -> None:
    with short_directory() as home:
        os.mkdir(f"{home}/run", 0o700)
        env = record_imports(tmp_path, environment(home, XDG_RUNTIME_DIR=f"{home}/run"))  # and no TALK_SOCKET
        with serving(env):
            for command in COMMANDS:
                done = run([*TALK, *command], env)
                assert done.code == 0, done
    modules = imported(tmp_path)
    assert len(modules) > len(COMMANDS)
    for names in modules.values():
        assert "talkcli" in names
        assert not {name for name in names if f"{name}.".startswith(("paho.", "talkcli.fleet."))}


@pytest.mark.parametrize(
    "arguments",
    [["--robot", "anna", "status"], ["say", "--robot", "anna", "hello"], ["--robot", "anna", "doctor"], ["watch"]],
)
def test_without_the_extra_fleet_commands_name_the_missing_package(arguments: list[str], tmp_path: Path) -> None:
    env = record_imports(
        tmp_path, environment(str(tmp_path), TALK_ROBOT="anna", TALK_BROKER="mqtt://127.0.0.1"), ["paho"]
    )
    done = run([*TALK, *arguments], env)
    assert (done.code, done.out) == (2, "")
    assert done.err == f"talk: a fleet needs paho-mqtt; install it with: {install.command('paho-mqtt')}\n"


# Neural voices


#: Modules that an engine process doesn't need if no neural voice speaks.
NEURAL_MODULES = [
    *NEURAL_PACKAGES,
    *("difflib", "hashlib", "queue"),
    *(f"talkcli.engine.child.synthesizers.{name}" for name in ("inference", "loader", "phonemes", "piper", "vits")),
]
#: Modules that only neural voices use. A server needs the other `NEURAL_MODULES` anyway.
NEURAL_ONLY = {*NEURAL_PACKAGES, *(name for name in NEURAL_MODULES if name.startswith("talkcli."))}
#: How much the memory of two starts may differ.
SLACK_KB = 400
CLIENT_COMMANDS = (["voices"], ["status"], ["say", "--wait", "hello"])


@dataclass(frozen=True)
class Cost:
    """The imports, memory and threads of a server, its engine process and some clients."""

    server: frozenset[str]
    engine: frozenset[str]
    clients: frozenset[str]
    counted: usage.Usage
    threads: int  # of the engine process


def measure(directory: Path, *options: str, without: Sequence[str] = ()) -> Cost:
    """Run a server with these options and some clients, while the packages `without` can't be imported."""
    tiny_voice.put(directory / "voices", "tiny")
    with short_directory() as home:
        env = environment(home, TALK_SOCKET=f"{home}/s", TALK_VOICES=str(directory / "voices"))
        env = record_imports(directory, env, without)
        with serving(env, *options) as server:
            for command in CLIENT_COMMANDS:
                done = run([*TALK, *command], env)
                assert done.code == 0, done
                assert command != ["voices"] or "piper/tiny" in done.out
            pid = server.process.pid
            (engine,) = children(pid)
            counted = usage.wait_until(pid, lambda now: now.processes == 2)
            threads = len(os.listdir(f"/proc/{engine}/task"))
    modules = imported(directory)
    clients = frozenset().union(*(names for process, names in modules.items() if process not in {pid, engine}))
    return Cost(modules[pid], modules[engine], clients, counted, threads)


def test_unused_neural_packages_cost_no_imports_threads_or_memory(tmp_path: Path) -> None:
    needs_packages(*NEURAL_PACKAGES)
    installed, missing = measure(tmp_path / "with"), measure(tmp_path / "without", without=NEURAL_PACKAGES)
    assert all("talkcli" in modules for modules in (installed.server, installed.engine, installed.clients))
    assert (installed.server | installed.engine | installed.clients) & NEURAL_ONLY == set()
    assert installed.engine & {*NEURAL_MODULES} == set()
    for field in ("server", "engine", "clients", "threads"):
        assert getattr(installed, field) == getattr(missing, field)
    for field in ("processes", "threads"):
        assert getattr(installed.counted, field) == getattr(missing.counted, field)
    assert installed.counted.memory == pytest.approx(missing.counted.memory, abs=SLACK_KB)


def test_only_the_engine_imports_modules_for_a_neural_voice(tmp_path: Path) -> None:
    needs_packages(*NEURAL_PACKAGES)
    cost = measure(tmp_path, "--voice", "piper/tiny")
    assert {*NEURAL_PACKAGES} <= cost.engine
    assert (cost.server | cost.clients) & NEURAL_ONLY == set()
