"""Facts about the benchmark's machine, and the memory and processor time of processes."""

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

#: The programs whose versions are shown, with their options for it.
_PROGRAMS = {
    **dict.fromkeys(("espeak-ng", "speech-dispatcher", "aplay", "pulseaudio"), "--version"),
    "mosquitto": "-h",
}
_PACKAGES = ("talkcli", "click", "pyttsx3", "paho-mqtt")
#: Time without context switches after which a server is idle, and time limit for this.
_IDLE_S, _IDLE_LIMIT_S = 1.0, 15.0


def describe() -> dict[str, str]:
    """Return facts about the machine, with the versions of programs and packages."""
    facts = {
        "processor": _processor(),
        "cores": str(len(os.sched_getaffinity(0))),
        "system": f"{platform.system()} {platform.machine()}",
        "load average": load(),
        "Python": platform.python_version(),
    }
    return facts | {name: version(name) for name in _PACKAGES} | {name: _program_version(name) for name in _PROGRAMS}


def load() -> str:
    """Return the load average of the last 1, 5 and 15 minutes."""
    return " ".join(f"{value:.1f}" for value in os.getloadavg())


@dataclass(frozen=True, slots=True)
class ProcessorUse:
    """Context switches and processor time (in seconds) of processes with all their threads."""

    switches: int
    processor: float

    def since(self, before: ProcessorUse) -> ProcessorUse:
        return ProcessorUse(self.switches - before.switches, self.processor - before.processor)


def processor_use(pids: Iterable[int]) -> ProcessorUse:
    """Return all context switches and the processor time of these processes so far."""
    switches, processor = 0, 0.0
    for pid in pids:
        for thread in os.listdir(f"/proc/{pid}/task"):
            with open(f"/proc/{pid}/task/{thread}/status", encoding="utf-8") as status:
                switches += sum(int(line.split()[1]) for line in status if "ctxt_switches:" in line)
            processor += _seconds(f"/proc/{pid}/task/{thread}")
    return ProcessorUse(switches, processor)


def measure_use(pids: Iterable[int], seconds: float) -> ProcessorUse:
    """Wait until these processes are idle, and return their processor use during some seconds."""
    pids = list(pids)
    settle(pids)
    before = processor_use(pids)
    time.sleep(seconds)
    return processor_use(pids).since(before)


def settle(pids: Iterable[int]) -> None:
    """Wait until these processes are idle, because a server still works for a while after its last client."""
    pids = list(pids)
    end = time.monotonic() + _IDLE_LIMIT_S
    while time.monotonic() < end:
        before = processor_use(pids)
        time.sleep(_IDLE_S)
        if processor_use(pids).since(before).switches == 0:
            return


def megabytes(pid: int) -> float:
    """Return the memory of a process, with its share of shared memory (Pss)."""
    with open(f"/proc/{pid}/smaps_rollup", encoding="utf-8") as file:
        return next(int(line.split()[1]) for line in file if line.startswith("Pss:")) / 1024


def _seconds(task: str) -> float:
    with contextlib.suppress(OSError), open(f"{task}/schedstat", encoding="ascii") as file:
        return int(file.read().split()[0]) / 1e9
    with open(f"{task}/stat", encoding="utf-8") as file:  # only precise to 10 ms
        fields = file.read().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _processor() -> str:
    with open("/proc/cpuinfo", encoding="utf-8") as file:
        names = [line.partition(":")[2].strip() for line in file if line.lower().startswith(("model name", "hardware"))]
    return names[0] if names else platform.processor() or "unknown"


def _program_version(name: str) -> str:
    path = find_program(name)
    if path is None:
        return "not installed"
    done = subprocess.run([path, _PROGRAMS[name]], capture_output=True, text=True, timeout=20, check=False)
    match = re.search(r"\d+(\.\d+)+", done.stdout + done.stderr)
    return match.group() if match else "unknown"
