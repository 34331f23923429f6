"""The README's picture shows what a terminal shows today."""

from __future__ import annotations

import re
import subprocess
import sys
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

import pytest

from tests.support.documents import ROOT

if TYPE_CHECKING:
    from pathlib import Path

PLACE = ROOT / ".github" / "picture"
_SVG = "{http://www.w3.org/2000/svg}"


def shown(picture: Path) -> list[str]:
    """Return the last screen of a picture without ids, numbers and places, which differ from run to run."""
    description = ET.parse(picture).find(f"{_SVG}desc")
    assert description is not None
    text = re.sub(r"\b[a-z0-9]{4}-(\d+)\b", r"BOOT-\1", description.text or "")
    text = re.sub(r"/\S*robot-\w+", "PLACE", text)
    text = re.sub(r"eSpeak NG [^,\n]+", "eSpeak NG", text)
    text = re.sub(r'"[^"\n]*…"', "TEXT", text)
    return [" ".join(re.sub(r"(?<!BOOT-)\b\d[\d.:]*", "N", each).split()) for each in text.splitlines()]


@pytest.mark.slow
def test_picture_shows_what_a_terminal_shows(tmp_path: Path) -> None:
    """To update it: `python .github/picture/picture.py`."""
    made = tmp_path / "talk.svg"
    command = [sys.executable, str(PLACE / "picture.py"), "--fast", str(made)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert shown(made) == shown(PLACE / "talk.svg")
