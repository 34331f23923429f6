"""Fixtures for the engine's tests: player programs, and engine threads with a scripted process."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

import pytest

from talkcli.engine.parent import supervisor
from tests.engine.programs import Player
from tests.engine.threads import EngineThread
from tests.support import scripted_serve
from tests.support.real_voice import real_voice

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path
    from typing import Any

    from tests.engine.process import Engine, SharedEngine
    from tests.engine.threads import StartThread


@pytest.fixture
def player(tmp_path: Path) -> Player:
    """Return a maker of player programs."""
    return Player(tmp_path)


@pytest.fixture
def engine(shared: SharedEngine, request: pytest.FixtureRequest) -> Engine:
    """Return the idle engine process that the module's tests share."""
    return shared.take(request.session.testsfailed)


@pytest.fixture
def scripted_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use the scripted engine as the engine process."""
    monkeypatch.setattr("talkcli.engine.parent.process.engine_command", scripted_serve.engine_command)


@pytest.fixture
def start(scripted_process: None, monkeypatch: pytest.MonkeyPatch) -> Iterator[StartThread]:  # noqa: ARG001 - for its effect
    """Return a function that starts an engine thread with the scripted engine as its process."""
    with contextlib.ExitStack() as stack:

        def make(script: str = "", **limits: Any) -> EngineThread:
            monkeypatch.setenv("SCRIPTED_START", script)
            for name, value in limits.items():
                monkeypatch.setattr(supervisor, name, value)
            return stack.enter_context(contextlib.closing(EngineThread()))

        yield make


@pytest.fixture(scope="session")
def real_voice_env(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Return the environment for engine processes with a real neural voice. They share a cache."""
    real_voice()
    return {"XDG_CACHE_HOME": str(tmp_path_factory.mktemp("cache"))}
