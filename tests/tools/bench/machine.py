"""The machine under the benchmark: its versions, and the memory and processor time that processes take."""

from __future__ import annotations

import contextlib
import os
import platform
import re
import subprocess
import time
from dataclasses import dataclass
from importlib.metadata import version
from typing import TYPE_CHECKING

from tests.support.surroundings import find_program

if TYPE_CHECKING:
    from collections.abc import Iterable

#: The programs whose versions are shown, and the option that each tells it for.
_PROGRAMS = {
    **dict.fromkeys(("espeak-ng", "speech-dispatcher", "aplay", "pulseaudio"), "--version"),
    "mosquitto": "-h",
}
_PACKAGES = ("talkcli", "click", "pyttsx3", "paho-mqtt")
#: Seconds without a context switch after which a server is idle, and seconds to wait for that.
_STILL_S, _PATIENCE_S = 1.0, 15.0


def head() -> dict[str, str]:
    """Return the names and versions that belong above a table."""
    found = {
        "processor": _processor(),
        "cores": str(len(os.sched_getaffinity(0))),
        "system": f"{platform.system()} {platform.machine()}",
        "load average": load(),
        "Python": platform.python_version(),
    }
    return found | {each: version(each) for each in _PACKAGES} | {each: _program(each) for each in _PROGRAMS}


def load() -> str:
    """Return the load average of the last 1, 5 and 15 minutes."""
    return " ".join(f"{each:.1f}" for each in os.getloadavg())


@dataclass(frozen=True, slots=True)
class Taken:
    """The context switches and the seconds of processor time of some processes, with all their threads."""

    switches: int
    processor: float

    def since(self, before: Taken) -> Taken:
        """Return the difference to an earlier count."""
        return Taken(self.switches - before.switches, self.processor - before.processor)


def taken(pids: Iterable[int]) -> Taken:
    """Count the context switches, voluntary or not, and the processor time of these processes so far."""
    switches, processor = 0, 0.0
    for pid in pids:
        for thread in os.listdir(f"/proc/{pid}/task"):
            with open(f"/proc/{pid}/task/{thread}/status", encoding="utf-8") as status:
                switches += sum(int(line.split()[1]) for line in status if "ctxt_switches:" in line)
            processor += _seconds(f"/proc/{pid}/task/{thread}")
    return Taken(switches, processor)


def taken_in(pids: Iterable[int], seconds: float) -> Taken:
    """Return what these processes take in so many seconds, after they have become idle."""
    pids = list(pids)
    settle(pids)
    before = taken(pids)
    time.sleep(seconds)
    return taken(pids).since(before)


def settle(pids: Iterable[int]) -> None:
    """Wait until these processes are idle: a server still has work for a while after its last client."""
    pids = list(pids)
    end = time.monotonic() + _PATIENCE_S
    while time.monotonic() < end:
        before = taken(pids)
        time.sleep(_STILL_S)
        if taken(pids).since(before).switches == 0:
            return


def megabytes(pid: int, kind: str) -> float:
    """Return the memory of a process: "Rss" is all of it, "Pss" divides shared memory among its users."""
    with open(f"/proc/{pid}/smaps_rollup", encoding="utf-8") as file:
        return next(int(each.split()[1]) for each in file if each.startswith(f"{kind}:")) / 1024


def _seconds(task: str) -> float:
    with contextlib.suppress(OSError), open(f"{task}/schedstat", encoding="ascii") as file:
        return int(file.read().split()[0]) / 1e9
    with open(f"{task}/stat", encoding="utf-8") as file:  # to a hundredth of a second, if the kernel counts no finer
        fields = file.read().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _processor() -> str:
    with open("/proc/cpuinfo", encoding="utf-8") as file:
        names = [line.partition(":")[2].strip() for line in file if line.lower().startswith(("model name", "hardware"))]
    return names[0] if names else platform.processor() or "unknown"


def _program(name: str) -> str:
    path = find_program(name)
    if path is None:
        return "not installed"
    done = subprocess.run([path, _PROGRAMS[name]], capture_output=True, text=True, timeout=20, check=False)
    found = re.search(r"\d+(\.\d+)+", done.stdout + done.stderr)
    return found.group() if found else "unknown"
