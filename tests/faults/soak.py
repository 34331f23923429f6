"""A soak: random goals from many clients and a fault every few seconds, for as long as one likes.

    python -m tests.faults.soak --seconds 1800 [--seed N] [--every SECONDS | --kills] [--player aplay|pacat]

Every goal has exactly one end, what SUCCEEDED was heard, and the server has nothing more at the end than at the
beginning. With `--kills` the faults are deaths of the engine alone, two a second at times, and none costs more than one
goal. What it takes is counted from outside; every random choice comes from the seed.
"""

from __future__ import annotations

import argparse
import os
import random
import sys
import time
from collections import Counter
from dataclasses import dataclass, field

from tests.faults.soak_clients import Narrator, Senders
from tests.faults.soak_faults import Faults
from tests.faults.soak_witness import Witness
from tests.support import census
from tests.support.processes import Talk
from tests.support.sink import Sink
from tests.support.surroundings import short_directory

#: Clients that send goals all the time.
CLIENTS = 8
#: Goals before the first count: most of the history is full then, and everything was used once.
WARM_UP = 1_200
#: kB that the server and its engine process may have grown by.
GROWN = 8 * 1024
#: Why a goal ends that was lost with its engine.
_LOST_WITH_IT = frozenset({"engine_crashed", "engine_hung", "engine_failed", "not_silent"})
#: Lines of the log that a fault may bring beside those of the goals that it ended.
LINES_A_FAULT = 6


@dataclass(slots=True)
class Report:
    """What a soak did and found."""

    seed: int
    seconds: float
    goals: int = 0
    ends: Counter[tuple[str, str | None]] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    narrated: Counter[str] = field(default_factory=Counter)
    heard_whole: int = 0
    before: census.Census | None = None
    after: census.Census | None = None
    #: entries of the server's home and temporary directory
    files: tuple[int, int] = (0, 0)
    #: engine processes that were killed, where nothing else was done
    deaths: int | None = None
    log_lines: int = 0
    failures: list[str] = field(default_factory=list)

    @property
    def lost(self) -> int:
        """Goals that the engine's deaths have cost."""
        return sum(
            count for (state, reason), count in self.ends.items() if state == "ABORTED" and reason in _LOST_WITH_IT
        )

    def __str__(self) -> str:
        ends = ", ".join(
            f"{count} {state} {reason or ''}".strip() for (state, reason), count in self.ends.most_common()
        )
        return "\n".join(
            (
                f"seed {self.seed}, {self.seconds:.0f} s, {self.goals} goals: {ends}",
                f"{self.faults.total()} faults: {_told(self.faults)}",
                f"{self.heard_whole} sentences heard whole at the sink; the narrator's goals: {_told(self.narrated)}",
                f"before: {self.before}, {self.files[0]} files",
                f"after:  {self.after}, {self.files[1]} files, {self.log_lines} lines in the log",
                *([] if self.deaths is None else [f"{self.deaths} deaths of the engine cost {self.lost} goals"]),
                *(f"FAILED: {each}" for each in self.failures),
            )
        )


def soak(seconds: float, seed: int, every: float | None = 5.0, player: str = "aplay", least: int = 0) -> Report:
    """Run a soak and return what it found; `failures` is empty if all was well.

    `every`: seconds between two faults; None for kills of the engine alone. It takes longer than `seconds` where there
    were not `least` faults by then: some take ten seconds each.
    """
    report = Report(seed, seconds)
    with Sink() as sink, short_directory() as temporary:
        talk = Talk(("--player", player, "--max-queue", "20"), sink=sink, env={"TMPDIR": temporary}, watched=False)
        try:
            _run(talk, sink, report, every, temporary, least)
            talk.stop()
        except AssertionError as error:
            report.failures.append(str(error))
        finally:
            report.log_lines = talk.log.count("\n")
            talk.close()
    return report


def _run(talk: Talk, sink: Sink, report: Report, every: float | None, temporary: str, least: int) -> None:
    witness = Witness(talk.socket)
    try:
        _warm_up(talk, witness, report)
        report.before = census.count(talk.pid)
        files = _count_files(talk.directory, temporary)
        known = witness.ended
        _disturb(talk, sink, report, every, least)
        report.goals, report.ends = witness.ended - known, witness.ends
        if report.deaths is not None and report.lost > report.deaths:
            report.failures.append("a death cost more than one goal")
        _settle(talk, witness, report)
        report.after = census.assert_as_before(talk.pid, report.before, memory=GROWN)
        report.files = files, _count_files(talk.directory, temporary)
        assert report.files[1] <= files, f"files are left: {os.listdir(talk.directory)}, {os.listdir(temporary)}"
        lines, ended = talk.log.count("\n"), witness.ended
        expected = ended + LINES_A_FAULT * report.faults.total() + 10
        assert lines <= expected, f"{lines} lines in the log, of {ended} goals and {report.faults.total()} faults"
        assert "a bug" not in talk.log, "a bug, says the log"
    finally:
        report.failures += witness.faults
        if witness.closed:
            report.failures.append(f"the server let its watcher go; the end of its log: {talk.log[-2000:]}")
        witness.close()


def _warm_up(talk: Talk, witness: Witness, report: Report) -> None:
    senders = Senders(talk, CLIENTS, lambda number: random.Random(f"{report.seed} warm-up {number}"))
    enough = witness.wait_for(WARM_UP, timeout=300)
    senders.stop()
    report.failures += senders.failures
    assert enough, f"only {witness.ended} goals have ended in the warm-up"
    _settle(talk, witness, report)


def _disturb(talk: Talk, sink: Sink, report: Report, every: float | None, least: int) -> None:
    chance = random.Random(f"{report.seed} faults")
    faults = Faults(talk, sink, chance, every or 0)
    narrator = Narrator(talk, sink, faults.calm_since, lambda: faults.last)
    senders = Senders(talk, CLIENTS, lambda number: random.Random(f"{report.seed} {number}"))

    def enough() -> bool:
        return bool(narrator.failures or senders.failures) or not talk.running

    try:
        if every is None:
            faults.kill_engines(report.seconds, enough)
            report.deaths = faults.deaths
        else:
            faults.run(report.seconds, least, enough)
    finally:
        for each in (narrator, senders):
            each.stop()
            report.failures += each.failures
    report.faults, report.narrated, report.heard_whole = faults.done, narrator.ends, narrator.heard_whole


def _settle(talk: Talk, witness: Witness, report: Report) -> None:
    """Wait until nothing is left to be spoken, and speak once more."""
    assert talk.request("cancel")["ok"]
    left = witness.wait_until_all_have_ended()
    assert not left, f"goals without an end: {left}"
    with talk.connect() as wire:
        assert wire.request("say", text="all is well", rate=450, wait=True)["ok"]
        last = wire.receive_event("result", timeout=30)["goal"]
    if last["state"] != "SUCCEEDED":
        report.failures.append(f"the last sentence: {last['state']}, {last['message']}")


def _count_files(*directories: str) -> int:
    return sum(len(files) + len(below) for each in directories for _, below, files in os.walk(each))


def _told(counts: Counter[str]) -> str:
    return ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in counts.most_common())


def main() -> None:
    """Run a soak as the command line says, and print what it found."""
    parser = argparse.ArgumentParser(description="Random goals from many clients, and a fault every few seconds.")
    parser.add_argument("--seconds", type=float, default=1800)
    parser.add_argument("--seed", type=int, default=int(time.time()))
    parser.add_argument("--every", type=float, default=5.0, help="seconds between two faults, on average")
    parser.add_argument("--kills", action="store_true", help="kill the engine again and again, and nothing else")
    parser.add_argument("--player", choices=("aplay", "pacat"), default="aplay")
    options = parser.parse_args()
    report = soak(options.seconds, options.seed, None if options.kills else options.every, options.player)
    print(report)
    sys.exit(bool(report.failures))


if __name__ == "__main__":
    main()
