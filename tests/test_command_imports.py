"""The imports of short commands, which spend most of their time on imports."""

from __future__ import annotations

import re
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

from tests.tools.bench.processes import OTHERS

if TYPE_CHECKING:
    from tests.support.processes import Talk

#: Modules that no client uses: slow ones of the standard library, and the server's modules.
HEAVY = [
    *("asyncio", "concurrent", "multiprocessing", "subprocess", "ssl", "tempfile", "logging", "dataclasses", "pathlib"),
    *("pyttsx3", "espeakng_loader", "platformdirs"),
    *(
        "talkcli.goals.scheduler",
        "talkcli.goals.memory",
        "talkcli.engine",
        "talkcli.server.run",
        "talkcli.server.speech",
    ),
]
#: Modules that only commands with a server need.
CLIENT = ["socket", "select", "talkcli.client.client", "talkcli.client.connection"]
WITHOUT_SERVER = {"serve --print-unit user", "--version", "--help"}


def imported(env: dict[str, str], *command: str) -> set[str]:
    """Return the modules that Python imports for a command."""
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


@pytest.mark.parametrize("command", OTHERS, ids=" ".join)
def test_a_command_imports_no_unused_modules(scripted: Talk, command: tuple[str, ...]) -> None:
    modules = imported(scripted.env, "-m", "talkcli", *command)
    assert "talkcli" in modules
    useless = {*HEAVY, *(CLIENT if " ".join(command) in WITHOUT_SERVER else [])}
    # A command can't avoid the imports of click: platform and subprocess with Python 3.10.
    assert useless & (modules - imported(scripted.env, "-c", "import click")) == set()
