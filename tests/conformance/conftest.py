"""The voices for the tests of sound."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from tests.conformance.voices import ESPEAK, Joe
from tests.support.real_voice import link_without_noise, real_voice

if TYPE_CHECKING:
    from tests.conformance.voices import Voice


@pytest.fixture(scope="session")
def joe(tmp_path_factory: pytest.TempPathFactory) -> Joe:
    """A real neural voice without noise. Tests are skipped if it is not installed.

    Each sentence starts with at least 36 ms of silence, as after a comma, so that the monitor drops no sound.
    """
    folder = tmp_path_factory.mktemp("voices")
    folder.chmod(0o755)
    path = real_voice()
    link_without_noise(path, folder)
    config_path = folder / f"{path.name}.json"
    config = json.loads(config_path.read_text())
    numbers = config["phoneme_id_map"]
    numbers["^"] += [*numbers["_"], *numbers[","]]
    config_path.write_text(json.dumps(config))
    return Joe(str(folder), str(tmp_path_factory.mktemp("cache")))


@pytest.fixture
def voice(request: pytest.FixtureRequest) -> Voice:
    """The voice of a test's servers: the neural voice only for one test of each kind, which is marked `with_both`."""
    chosen: Voice = request.getfixturevalue("joe") if getattr(request, "param", "") == "joe" else ESPEAK
    return chosen
