"""Fixtures for the examples: shells and their servers."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

import pytest

from tests.readme.shell import Shell

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from tests.conftest import MakeTalk
    from tests.support.processes import Talk


@pytest.fixture
def speaking(make_talk: MakeTalk, tmp_path_factory: pytest.TempPathFactory) -> Talk:
    """A server with the real engine that writes its sound to a file, which takes no time."""
    return make_talk("--player", f"file:{tmp_path_factory.mktemp('said')}/said.wav", "--rate", "450")


@pytest.fixture
def shell(speaking: Talk, tmp_path: Path) -> Iterator[Shell]:
    """A shell that uses a server with the real engine."""
    with contextlib.closing(Shell(tmp_path, speaking.env)) as result:
        yield result


@pytest.fixture
def scripted_shell(scripted: Talk, tmp_path: Path) -> Iterator[Shell]:
    """A shell that uses a server with the scripted engine."""
    with contextlib.closing(Shell(tmp_path, scripted.env)) as result:
        yield result
