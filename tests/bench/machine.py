"""The head of the table: on what it was measured, and against which versions."""

from __future__ import annotations

import os
import platform
import re
import subprocess
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tests.bench.installed import Installed

_PROGRAMS = ("espeak-ng", "speech-dispatcher", "aplay", "pulseaudio")
_INSTALLED = (
    "import importlib.metadata as m, platform; "
    "print(platform.python_version(), *(m.version(each) for each in ('talkcli', 'click', 'pyttsx3')))"
)


def head(installed: Installed | None, *, peers: bool) -> dict[str, str]:
    """Return what the table was measured on."""
    found = {
        "processor": _processor(),
        "cores": str(len(os.sched_getaffinity(0))),
        "system": f"{platform.system()} {platform.machine()}",
        "load average": load(),
    }
    if installed:
        python, talk, click, pyttsx3 = _said([installed.python, "-c", _INSTALLED]).split()
        other = ", another than this checkout" if installed.differs else ""
        found |= {"Python": python, "talk": f"{talk}{other}", "click": click, "pyttsx3": pyttsx3}
    for name in _PROGRAMS:
        if peers or name in ("aplay", "pulseaudio"):
            found[name] = _version(_said([name, "--version"]))
    return found


def load() -> str:
    """Return the load average of the last 1, 5 and 15 minutes."""
    return " ".join(f"{each:.1f}" for each in os.getloadavg())


def _processor() -> str:
    with open("/proc/cpuinfo", encoding="utf-8") as file:
        names = [line.partition(":")[2].strip() for line in file if line.lower().startswith(("model name", "hardware"))]
    return names[0] if names else platform.processor() or "unknown"


def _version(told: str) -> str:
    """Return the first number with a dot in what a program says of itself."""
    found = re.search(r"\d+(\.\d+)+", told)
    return found.group() if found else told.splitlines()[0]


def _said(command: list[str]) -> str:
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    except FileNotFoundError:
        return "not installed"
    return done.stdout.strip() or done.stderr.strip() or "unknown"
