"""What each command that ends by itself imports: its whole time is mostly that, on a small machine above all."""

from __future__ import annotations

import re
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

from tests.bench.whole_process import OTHERS

if TYPE_CHECKING:
    from tests.support.processes import Talk

#: What no client has a use for: long imports of the standard library, and the server's part of the package.
HEAVY = [
    *("asyncio", "concurrent", "multiprocessing", "subprocess", "ssl", "tempfile", "logging", "dataclasses", "pathlib"),
    *("pyttsx3", "espeakng_loader", "platformdirs"),
    *(
        "talkcli.goals.scheduler",
        "talkcli.goals.history",
        "talkcli.engine",
        "talkcli.server.run",
        "talkcli.server.speech",
    ),
]
#: What only a command that talks to a server needs.
CLIENT = ["socket", "select", "talkcli.client.client", "talkcli.client.connection"]
ALONE = {"serve --print-unit user", "--version", "--help"}


def imported(env: dict[str, str], *command: str) -> set[str]:
    """Return the modules that Python imports for this."""
    done = subprocess.run(
        [sys.executable, "-X", "importtime", *command],
        env=env,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return set(re.findall(r"^import time:.*\| +(\S+)$", done.stderr, re.MULTILINE))


@pytest.mark.parametrize("words", OTHERS, ids=" ".join)
def test_a_command_imports_nothing_that_it_has_no_use_for(scripted: Talk, words: tuple[str, ...]) -> None:
    found = imported(scripted.env, "-m", "talkcli", *words)
    assert "talkcli" in found
    useless = {*HEAVY, *(CLIENT if " ".join(words) in ALONE else [])}
    # What click brings with it is nothing that these could leave out: platform and subprocess with Python 3.10.
    assert useless & (found - imported(scripted.env, "-c", "import click")) == set()
