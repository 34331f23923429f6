"""Who asks for no neural voice pays nothing for them, whether what they take is installed or not, and voices are there.

What a process imports is what its start costs; what it does not import takes no memory and starts no thread.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING

import pytest

from talkcli.engine.synthesizers.models import NEEDED
from tests.conformance.bareserve import TALK, environment, run, serving
from tests.engine.test_neural import NEURAL_MODULES
from tests.support import census, tiny_voice
from tests.support.processes import children
from tests.support.spied import imported, spied
from tests.support.surroundings import needs_packages, short_directory

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

#: What neural voices alone have a use for, in whatever process; others of `NEURAL_MODULES` a server needs anyway.
OWN = {*NEEDED, *(each for each in NEURAL_MODULES if each.startswith("talkcli."))}
#: kB by which memory differs from one start to the next.
SLACK = 400
COMMANDS = (["voices"], ["status"], ["set", "--rate", "400"], ["say", "--wait", "hello"], ["log"])


@dataclass(frozen=True)
class Cost:
    """What a server, its engine process and some clients have taken."""

    server: frozenset[str]
    engine: frozenset[str]
    clients: frozenset[str]
    counted: census.Census
    threads: int  # of the engine process


def measure(directory: Path, *options: str, without: Sequence[str] = ()) -> Cost:
    """Run a server with these options, and clients one after the other, where these packages are not there."""
    tiny_voice.put(directory / "voices", "tiny")
    with short_directory() as home:
        env = environment(home, TALK_SOCKET=f"{home}/s", TALK_VOICES=str(directory / "voices"))
        env = spied(directory, env, without)
        with serving(env, *options) as server:
            for command in COMMANDS:
                done = run([*TALK, *command], env)
                assert done.code == 0, done
                assert command != ["voices"] or "piper/tiny" in done.out
            pid = server.process.pid
            (engine,) = children(pid)
            counted = census.settled(pid, lambda now: now.processes == 2)
            threads = len(os.listdir(f"/proc/{engine}/task"))
    found = imported(directory)
    clients = frozenset().union(*(names for each, names in found.items() if each not in {pid, engine}))
    return Cost(found[pid], found[engine], clients, counted, threads)


def test_neither_server_nor_engine_nor_clients_import_start_or_keep_anything_of_it(tmp_path: Path) -> None:
    needs_packages(*NEEDED)
    installed, missing = measure(tmp_path / "with"), measure(tmp_path / "without", without=NEEDED)
    for each in (installed, missing):
        assert all("talkcli" in names for names in (each.server, each.engine, each.clients))
        assert (each.server | each.engine | each.clients) & OWN == set()
    assert installed.engine & {*NEURAL_MODULES} == set()
    assert installed.server == missing.server
    assert installed.engine == missing.engine
    assert installed.clients == missing.clients
    assert installed.threads == missing.threads
    assert (installed.counted.processes, installed.counted.threads) == (
        missing.counted.processes,
        missing.counted.threads,
    )
    assert installed.counted.memory == pytest.approx(missing.counted.memory, abs=SLACK)


def test_where_one_is_asked_for_the_engine_alone_imports_what_it_takes(tmp_path: Path) -> None:
    needs_packages(*NEEDED)
    found = measure(tmp_path, "--voice", "piper/tiny")
    assert {*NEEDED} <= found.engine
    assert (found.server | found.clients) & OWN == set()
