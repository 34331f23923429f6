"""Each row of the benchmark of neural voices measures something: a short run of all, whatever the figures are."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.bench import voices_engine, voices_words
from tests.bench.test_bench_rows import assert_measured
from tests.bench.voices import GROUPS, measure
from tests.bench.voices_stage import VoiceOptions, VoiceStage
from tests.support.listener import PACKAGE
from tests.support.real_voice import real_voice
from tests.support.surroundings import needs_packages

if TYPE_CHECKING:
    from collections.abc import Iterator

#: How many rows a group has.
ROWS = {"onset": 2, "between": 4, "words": 4, "killed": 2, "idle": 2, "memory": 5}


@pytest.fixture(scope="module")
def stage() -> Iterator[VoiceStage]:
    real_voice()
    needs_packages(PACKAGE)
    with VoiceStage(VoiceOptions(rounds=1, kills=1, texts=2, idle=1)) as found:
        yield found


@pytest.mark.slow
@pytest.mark.parametrize("group", GROUPS)
def test_a_row_measures_something(stage: VoiceStage, group: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for module, name, less in (
        (voices_engine, "LONG_TEXT", voices_engine.LONG_TEXT[:500]),
        (voices_words, "APART", voices_words.APART[1:]),
        (voices_words, "RUNNING", voices_words.RUNNING[:1]),
    ):
        monkeypatch.setattr(module, name, less)
    rows = measure(group, stage)
    assert_measured(rows, ROWS.get(group, 1))
    for row in rows:
        assert row.goal or "sign" in row.name
