"""Speaks mutated texts with all voices through the engine process, as `say -o` does, and counts how often it dies.

By hand: `python -m tests.faults.fuzz_texts --count 20000 --seed 1` (or `--seed today`), with `--seconds`, `--no-guard`,
`--jobs`. It prints the texts that killed a process, in a form that Python reads, and ends with 1 where a goal had not
exactly one end, or a process left a traceback, or a death was of a kind that the guard knows.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import os
import select
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from talkcli.engine import process, protocol
from tests.faults.fuzz_texts_generator import Case, cases, dated

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

#: Words per minute: the fewest samples for a text.
_RATE = 450
#: Seconds in which a process must be ready, and in which one text must be rendered: far more than the longest takes.
_START, _LONGEST = 20.0, 60.0
#: What a process says last that wrote past the end of a buffer, which is what the guard knows.
OVERFLOW = "SIGABRT"
#: Puts the texts before the library as they are.
_UNGUARDED = "from talkcli.engine.synthesizers import guard; guard.guarded = lambda text, voice: text; "


@dataclass(frozen=True, slots=True)
class Death:
    """A text that an engine process did not survive."""

    case: Case
    words: str  # how it ended

    def __str__(self) -> str:
        return f"{self.words}: {self.case.voice} {self.case.text!a}"


@dataclass(slots=True)
class Tally:
    """What became of the texts."""

    texts: int = 0
    outcomes: dict[str, int] = field(default_factory=dict)  # by reason; of those that ended
    deaths: list[Death] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)  # what must not be at all

    def __str__(self) -> str:
        ended = ", ".join(f"{count} {name}" for name, count in sorted(self.outcomes.items()))
        return f"{self.texts} texts: {ended}; {len(self.deaths)} deaths of the engine process"

    @property
    def overflows(self) -> list[Death]:
        """Deaths of the kind that the guard knows."""
        return [each for each in self.deaths if OVERFLOW in each.words]


def engine_command(guarded: bool) -> list[str]:
    """Return the command line of an engine process, with or without the guard before the library."""
    *program, code = process.engine_command()
    return [*program, code if guarded else code.replace("from talkcli", f"{_UNGUARDED}from talkcli", 1)]


class Speaker:
    """One engine process after the other, each until it dies."""

    def __init__(self, directory: str, *, guarded: bool, tally: Tally) -> None:
        self._file = os.path.join(directory, f"{id(self)}.wav")
        self._command = engine_command(guarded)
        self._tally = tally
        self._process: process.EngineProcess | None = None
        self._events: list[protocol.Event | None] = []
        self._said = 0
        self.voices: list[str] = []

    def __enter__(self) -> Speaker:
        self._start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def speak(self, case: Case) -> None:
        """Render one text, and count what became of it."""
        if self._process is None:
            self._start()
        assert self._process is not None
        self._said += 1
        goal = f"f{self._said}"
        self._tally.texts += 1
        assert self._process.send(protocol.Say(goal, case.text, _RATE, 1.0, case.voice, 50))
        ended = self._until(protocol.Ended, time.monotonic() + _LONGEST)
        if isinstance(ended, protocol.Ended):
            name = ended.reason or ended.outcome
            self._tally.outcomes[name] = self._tally.outcomes.get(name, 0) + 1
            if ended.id != goal or name == "engine_failed":
                self._tally.faults.append(f"{ended}: {case.voice} {case.text!a}")
            with contextlib.suppress(FileNotFoundError):  # nothing to say, nothing written
                os.unlink(self._file)
        else:
            self._died(case, hung=ended is None)

    def _died(self, case: Case, hung: bool) -> None:
        assert self._process is not None
        words = "it hung" if hung else self._process.last_words()
        self._tally.deaths.append(Death(case, words))
        if hung or "Traceback" in words or "exited" in words:
            self._tally.faults.append(str(self._tally.deaths[-1]))
        self._end()

    def _start(self) -> None:
        first = not self.voices
        configure = protocol.Configure(os.getpid(), None, f"file:{self._file}", None, None, list_voices=first)
        self._process = process.EngineProcess(configure, command=self._command)
        limit = time.monotonic() + _START
        assert isinstance(self._until(protocol.Ready, limit), protocol.Ready)
        if first:
            listed = self._until(protocol.Voices, limit)
            assert isinstance(listed, protocol.Voices)
            self.voices = [each.id for each in listed.voices if not each.id.startswith("+")]

    def _until(self, kind: type[protocol.Event], limit: float) -> protocol.Event | bool | None:
        """Return the next event of this kind, False if the process is gone, None if it is late."""
        assert self._process is not None
        watched = select.poll()
        watched.register(self._process.socket, select.POLLIN)
        watched.register(self._process.stderr, select.POLLIN)
        while True:
            while self._events:
                event = self._events.pop(0)
                if event is None:
                    return False
                if isinstance(event, kind):
                    return event
                if isinstance(event, protocol.Ended):  # a second end of what was before
                    self._tally.faults.append(f"one end too many: {event}")
            if time.monotonic() >= limit:
                return None
            ready = {descriptor for descriptor, _ in watched.poll(max(0.0, limit - time.monotonic()) * 1000)}
            if self._process.stderr in ready and not self._process.read_stderr():
                watched.unregister(self._process.stderr)
            if self._process.socket.fileno() in ready:
                self._events += self._process.receive()

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()
            select.select([self._process.liveness], [], [], _LONGEST)  # it is gone: a busy machine takes its time
            self._process.close()
        self._process = None
        self._events.clear()


def speak_all(texts: Iterable[Case], *, guarded: bool, seconds: float | None = None) -> Tally:
    """Speak the texts, one after the other, for so many seconds at most."""
    tally = Tally()
    end = None if seconds is None else time.monotonic() + seconds
    with _directory() as directory, Speaker(directory, guarded=guarded, tally=tally) as speaker:
        for case in texts:
            if end is not None and time.monotonic() >= end:
                break
            speaker.speak(case)
    return tally


def fuzz(
    seed: int, *, count: int | None = None, seconds: float | None = None, guarded: bool = True, jobs: int = 1
) -> Tally:
    """Speak the texts of a seed with all voices; the count or the seconds end it. The jobs share the texts."""
    voices = list_voices()
    tallies: list[Tally] = []

    def work(number: int) -> None:
        mine: Iterator[Case] = itertools.islice(cases(seed, voices), number, count, jobs)
        tallies.append(speak_all(mine, guarded=guarded, seconds=seconds))

    workers = [threading.Thread(target=work, args=(number,)) for number in range(jobs)]
    for each in workers:
        each.start()
    for each in workers:
        each.join()
    assert len(tallies) == jobs, "a job failed, see above"
    return _together(tallies)


def list_voices() -> list[str]:
    """Return the ids of all voices."""
    with _directory() as directory, Speaker(directory, guarded=True, tally=Tally()) as speaker:
        return speaker.voices


def _directory() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="talk-")


def _together(tallies: Iterable[Tally]) -> Tally:
    result = Tally()
    for each in tallies:
        result.texts += each.texts
        result.deaths += each.deaths
        result.faults += each.faults
        for name, count in each.outcomes.items():
            result.outcomes[name] = result.outcomes.get(name, 0) + count
    return result


def main() -> int:
    """Run the fuzzer by hand."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=20_000)
    parser.add_argument("--seconds", type=float)
    parser.add_argument("--seed", default="1", help='a number, or "today"')
    parser.add_argument("--no-guard", action="store_true")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    asked = parser.parse_args()
    seed = dated() if asked.seed == "today" else int(asked.seed)
    began = time.monotonic()
    open_before = len(os.listdir("/proc/self/fd"))
    tally = fuzz(seed, count=asked.count, seconds=asked.seconds, guarded=not asked.no_guard, jobs=asked.jobs)
    for each in tally.deaths:
        print(each)
    for fault in tally.faults:
        print(f"fault: {fault}")
    guard = "without" if asked.no_guard else "with"
    print(
        f"seed {seed}, {guard} the guard, {time.monotonic() - began:.0f} s: {tally}, {len(tally.overflows)} overflows"
    )
    left = len(os.listdir("/proc/self/fd")) - open_before
    print(f"descriptors left open: {left}")
    return 1 if tally.faults or left or (tally.overflows and not asked.no_guard) else 0


if __name__ == "__main__":
    sys.exit(main())
