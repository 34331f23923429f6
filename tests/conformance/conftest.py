"""The voices that what is heard is tested with."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.conformance.voices import ESPEAK, Joe
from tests.support.real_voice import real_voice, silence_noise

if TYPE_CHECKING:
    from tests.conformance.voices import Voice


@pytest.fixture(scope="session")
def joe(tmp_path_factory: pytest.TempPathFactory) -> Joe:
    """A real neural voice, without noise; the test is skipped where it is not installed."""
    place = tmp_path_factory.mktemp("voices")
    place.chmod(0o755)
    silence_noise(real_voice(), place)
    return Joe(str(place), str(tmp_path_factory.mktemp("cache")))


#: Most of what is heard is tested with a neural voice by the slow tests alone, as each of its servers loads the voice,
#: for a second: four minutes of tests. Each kind of thing, spoken, stopped, preempted, queued, held, has one each time.
@pytest.fixture(params=["espeak", pytest.param("joe", marks=pytest.mark.slow)])
def voice(request: pytest.FixtureRequest) -> Voice:
    """The voice of a test's servers; those that have `with_both` are tested with both of them each time."""
    if request.param == "espeak":
        return ESPEAK
    found: Joe = request.getfixturevalue("joe")
    return found
