"""Soak test of a server: many clients send goals of all kinds, and there is a fault every few seconds.

    python -m tests.tools.soak --seconds 1800 [--seed N] [--every SECONDS | --kills]

Each goal must have exactly one end, each goal that SUCCEEDED must have been heard, and the server must not use more
resources at the end than at the beginning. With `--kills`, the only fault is a killed engine, up to twice per second,
and each kill may cost at most one goal. An error raises an exception.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import time
from collections import Counter
from dataclasses import dataclass, field
from functools import partial

from tests.support import usage
from tests.support.processes import Talk
from tests.support.sink import Sink
from tests.support.surroundings import short_directory
from tests.tools.goal_monitor import GoalMonitor
from tests.tools.soak_clients import Narrator, Workers, send_goals
from tests.tools.soak_faults import RobotFaults
from tests.tools.soak_growing import send_growing_texts
from tests.tools.soak_interjecting import interject, read_stories, tell_stories

#: Clients that send usual goals, and that send growing texts, and pairs of clients of which one interrupts the other.
_CLIENTS, _GROWING_CLIENTS, _INTERJECTING_CLIENTS = 8, 3, 2
_PLAYER = "aplay"
#: Goals before the first count of resources. By then, the history is almost full, and all code has run once.
_WARM_UP_GOALS = 1_200
_WARM_UP_LIMIT_S = 300.0
_GROWTH_LIMIT_KB = 8 * 1024
#: Reasons of goals that failed because of their engine.
_ENGINE_REASONS = frozenset({"engine_crashed", "engine_hung", "engine_failed", "not_silent"})
#: Log lines allowed per fault, in addition to one line per goal.
_LOG_LINES_PER_FAULT = 6


@dataclass(slots=True)
class Report:
    ends: Counter[tuple[str, str | None]]  # by state and reason
    faults: Counter[str]
    heard_whole: int = 0  # sentences
    #: interrupted texts by state, and whether they were interrupted
    stories: Counter[tuple[str, bool]] = field(default_factory=Counter)


class Soak:
    """A server with a sink, clients and a monitor."""

    def __init__(self, seed: int, stack: contextlib.ExitStack) -> None:
        self._seed = seed
        self._sink = stack.enter_context(Sink())
        self._temporary = stack.enter_context(short_directory())
        options = ("--player", _PLAYER, "--max-queue", "20")
        self._talk = Talk(options, sink=self._sink, env={"TMPDIR": self._temporary}, watched=False)
        stack.callback(self._talk.close)
        with self._talk.connect() as wire:
            self._stories = read_stories(wire)
        self._monitor = stack.enter_context(contextlib.closing(GoalMonitor(self._talk.socket)))

    def run(self, seconds: float, every: float | None, min_faults: int, warm_up: int) -> Report:
        """Warm up, inject faults, and check their effects."""
        talk, monitor = self._talk, self._monitor
        senders = self._start_senders("warm-up")
        assert monitor.wait_for(warm_up, _WARM_UP_LIMIT_S), f"only {monitor.ended} goals in the warm-up"
        senders.stop()
        self._settle()
        before, files, known = usage.count(talk.pid), self._files(), Counter(monitor.ends)
        report = self._disturb(seconds, every, min_faults)
        report.ends = monitor.ends - known
        lost = sum(
            count for (state, reason), count in report.ends.items() if state == "ABORTED" and reason in _ENGINE_REASONS
        )
        assert every is not None or lost <= report.faults.total(), f"{report.faults} cost {lost} goals"
        self._settle()
        usage.assert_not_grown(talk.pid, before, memory=_GROWTH_LIMIT_KB)
        now = self._files()
        assert len(now) <= len(files), f"files were left behind: {now - files}"
        lines, limit = talk.log.count("\n"), monitor.ended + _LOG_LINES_PER_FAULT * report.faults.total() + 10
        assert lines <= limit, f"{lines} lines in the log for {monitor.ended} goals"
        assert not monitor.closed, f"the server closed the monitor's connection: {talk.log[-2000:]}"
        talk.stop()
        assert_no_bug(talk.log)
        return report

    def _disturb(self, seconds: float, every: float | None, min_faults: int) -> Report:
        faults = RobotFaults(self._talk, self._sink, _PLAYER, random.Random(f"{self._seed} faults"))
        clients = self._start_senders("")
        narrator = Narrator(self._talk, self._sink, faults.calm_since)
        clients.start("narrator", narrator.run)
        told: Counter[tuple[str, bool]] = Counter()
        # They have a high priority, so they would delay the warm-up.
        for number in range(_INTERJECTING_CLIENTS):
            rng = random.Random(f"{self._seed} stories {number}")
            clients.start(f"stories {number}", partial(tell_stories, self._talk, self._stories, told, rng))
            rng = random.Random(f"{self._seed} interjections {number}")
            clients.start(f"interjections {number}", partial(interject, self._talk, rng))
        end = time.monotonic() + seconds

        def over() -> bool:
            done = time.monotonic() >= end and faults.done.total() >= min_faults
            return done or bool(clients.failures) or not self._talk.running

        try:
            if every is None:
                faults.kill_engines(over)
            else:
                faults.run(every, over)
        finally:
            clients.stop(f"after {faults.done}; last fault: {faults.last}")
        return Report(Counter(), faults.done, narrator.heard_whole, told)

    def _start_senders(self, phase: str) -> Workers:
        workers = Workers()
        for number in range(_CLIENTS + _GROWING_CLIENTS):
            rng = random.Random(f"{self._seed} {phase} {number}")
            send = send_goals if number < _CLIENTS else send_growing_texts
            workers.start(f"client {number}", partial(send, self._talk, rng))
        return workers

    def _settle(self) -> None:
        """Cancel all goals, wait until they have ended, and speak once more."""
        assert self._talk.request("cancel")["ok"]
        unfinished = self._monitor.wait_until_all_have_ended()
        assert not unfinished, f"goals without an end: {unfinished}"
        with self._talk.connect() as wire:
            assert wire.request("say", text="all is well", rate=450, wait=True)["ok"]
            last = wire.receive_event("result", timeout=30)["goal"]
        assert last["state"] == "SUCCEEDED", last
        assert not self._monitor.faults, self._monitor.faults

    def _files(self) -> set[str]:
        directories = (self._talk.directory, self._temporary)
        return {
            f"{path}/{name}" for top in directories for path, folders, files in os.walk(top) for name in folders + files
        }


def soak(
    seconds: float,
    seed: int,
    every: float | None = 5.0,
    min_faults: int = 0,
    warm_up: int = _WARM_UP_GOALS,
) -> Report:
    """Run a soak test until the time is over and there were enough faults.

    If `every` is None, the only fault is a killed engine. `warm_up` is the number of goals that end before.
    """
    print(f"seed {seed}", flush=True)
    with contextlib.ExitStack() as stack:
        return Soak(seed, stack).run(seconds, every, min_faults, warm_up)


def assert_no_bug(*logs: str) -> None:
    for log in logs:
        assert "a bug" not in log, log[-2000:]


def parser(every: float) -> argparse.ArgumentParser:
    """Return a parser with the options of all soak tests."""
    result = argparse.ArgumentParser()
    result.add_argument("--seconds", type=float, default=1800)
    result.add_argument("--seed", type=int, default=int(time.time()))
    result.add_argument("--every", type=float, default=every, help="seconds between two faults, on average")
    return result


def main() -> None:
    arguments = parser(every=5.0)
    arguments.add_argument("--kills", action="store_true", help="only kill the engine, up to twice per second")
    options = arguments.parse_args()
    print(soak(options.seconds, options.seed, None if options.kills else options.every))


if __name__ == "__main__":
    main()
