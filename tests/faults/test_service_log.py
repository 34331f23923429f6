"""What may happen many times a second is said once a minute, with how often it happened."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from talkcli.daemon import log

if TYPE_CHECKING:
    import pytest


def test_storm_of_the_same_is_a_line_and_a_number(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 1000.0
    monkeypatch.setattr(log, "_seldom", {})
    monkeypatch.setattr("talkcli.daemon.log.time.monotonic", lambda: now)
    with open(2, "w", encoding="utf-8", closefd=False) as stderr:
        monkeypatch.setattr(sys, "stderr", stderr)
        for second in range(600):  # ten minutes of it, ten times a second
            now = 1000.0 + second
            for number in range(10):
                log.seldom("descriptors", f"no descriptor {number}")
        log.seldom("another", "of another kind")
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == 11
    assert lines[0] == "talk: no descriptor 0"
    assert lines[1] == "talk: no descriptor 0 (599 more of these were not logged)"
    assert lines[-1] == "talk: of another kind"
