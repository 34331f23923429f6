"""The README's picture: it is there, and what it shows is what a terminal shows today."""

from __future__ import annotations

import re
import subprocess
import sys
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

import pytest

from tests.support.documents import README, ROOT

if TYPE_CHECKING:
    from pathlib import Path

PLACE = ROOT / ".github" / "picture"
_SVG = "{http://www.w3.org/2000/svg}"


def shown(picture: Path) -> list[str]:
    """Return the last screen of a picture, without what differs from run to run: ids, numbers, where, how wide."""
    description = ET.parse(picture).find(f"{_SVG}desc")
    assert description is not None
    text = re.sub(r"\b[a-z0-9]{4}-(\d+)\b", r"BOOT-\1", description.text or "")
    text = re.sub(r"/\S*robot-\w+", "PLACE", text)
    text = re.sub(r"eSpeak NG [^,\n]+", "eSpeak NG", text)
    text = re.sub(r'"[^"\n]*…"', "TEXT", text)
    return [" ".join(re.sub(r"(?<!BOOT-)\b\d[\d.:]*", "N", each).split()) for each in text.splitlines()]


def test_picture_is_at_the_top_of_the_readme() -> None:
    (path,) = re.findall(r"^!\[[^\]]{20,}\]\((.+)\)$", README.text.partition("\n## ")[0], re.MULTILINE)
    assert ROOT / path == PLACE / "talk.svg"


def test_picture_moves_only_where_it_may() -> None:
    text = (PLACE / "talk.svg").read_text(encoding="utf-8")
    before, _, after = text.partition("@media (prefers-reduced-motion: no-preference)")
    assert "@keyframes" in after
    assert "animation" not in before
    rows = [each for each in ET.fromstring(text).iter(f"{_SVG}g") if each.get("class") != "past"]
    assert len(rows) == len(shown(PLACE / "talk.svg"))  # what is there where nothing moves: the last screen


@pytest.mark.slow
def test_picture_shows_what_a_terminal_shows(tmp_path: Path) -> None:
    """If not: `python .github/picture/picture.py`."""
    made = tmp_path / "talk.svg"
    command = [sys.executable, str(PLACE / "picture.py"), "--fast", str(made)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert shown(made) == shown(PLACE / "talk.svg")
