"""The programs that all rows share, and measurements of the time from an action to sound or silence.

All times are monotonic. A null sink renders one block ahead, so a sound may seem to be one block (2 ms) too early. The
recorder adds less than 1 ms.
"""

from __future__ import annotations

import contextlib
import random
import subprocess
import sys
import time
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING

from talkcli import Client
from tests.support.compare import compare, extent
from tests.support.espeak import RATE
from tests.support.processes import Talk
from tests.support.reference import render
from tests.support.sink import Sink
from tests.support.surroundings import clean_environment, dying_with_parent
from tests.tools.bench import peers

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from tests.support.recording import Recording

    #: Performs an action, and returns a function that waits for its end.
    Action = Callable[[], Callable[[], object]]

PYTHON, TALK = sys.executable, f"{sys.prefix}/bin/talk"
#: A text that is voiced from its first sample, without a pause.
SHORT = "ready"
#: A text that is voiced for more than two seconds, so that its sound is loud whenever it is stopped.
VOICED = "we are all in a long lonely line along many a warm lower river"
_BLOCK_MS = 2
#: Silence after which a sentence is over, and time limit for a sound or an end.
_QUIET_S, _LIMIT_S = 0.3, 10.0
#: Time from the first sound to the stop, and time limit for a stop.
_BEFORE_STOP_S, _STOP_LIMIT_S = 0.2, 1.0
#: Random delay of an action, so that it isn't synchronous with the sink's blocks.
_JITTER_S = 0.02
#: Correlation of the right sentence if the synthesizer has spoken before (0.84 or more). Others have at most 0.4.
_MIN_CORRELATION = 0.7


@dataclass(frozen=True, slots=True)
class Options:
    """The number of rounds per row, and the seconds for idle processes."""

    rounds: int = 15
    idle: float = 60.0


class Harness(contextlib.ExitStack):
    """The programs that all rows share. Each starts when a row needs it, and ends with the block."""

    def __init__(self, options: Options) -> None:
        super().__init__()
        self.options = options
        self.has_peers = peers.installed()
        self._rng = random.Random(5)

    @cached_property
    def sink(self) -> Sink:
        sink = self.enter_context(Sink())
        self.enter_context(fine_blocks(sink))
        return sink

    @cached_property
    def talk(self) -> Talk:
        """A server that plays to the sink, with default options."""
        return self.enter_context(serving(sink=self.sink))

    @cached_property
    def client(self) -> Client:
        return self.enter_context(Client(self.talk.socket, name="bench"))

    @cached_property
    def env(self) -> dict[str, str]:
        """The environment in which commands find this server, the sink and speech-dispatcher."""
        return self.talk.env | (self.enter_context(peers.dispatcher(self.sink)) if self.has_peers else {})

    def jitter(self) -> None:
        """Sleep for a random time of up to two blocks."""
        time.sleep(self._rng.random() * _JITTER_S)

    def in_turn(self, subjects: Mapping[str, Callable[[], float]], rounds: int = 0) -> dict[str, list[float]]:
        """Measure the subjects in turn, in a random order in each round. Return the milliseconds of each subject.

        A subject is a function that returns seconds. The first round only warms up.
        """
        times: dict[str, list[float]] = {name: [] for name in subjects}
        for number in range((rounds or self.options.rounds) + 1):
            for name in self._rng.sample([*subjects], len(subjects)):
                self.jitter()
                seconds = subjects[name]()
                if number:
                    times[name].append(seconds * 1000)
        return times

    def start(self, command: Sequence[str], env: Mapping[str, str] | None = None) -> subprocess.Popen[bytes]:
        """Start a command. `finish` waits for it."""
        # The benchmark uses the installed talk, so PYTHONPATH isn't needed.
        env = {name: value for name, value in (env or self.env).items() if name != "PYTHONPATH"}
        return subprocess.Popen(
            command, env=env, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
        )

    def command(self, *arguments: str) -> Action:
        return lambda: partial(finish, self.start(arguments))

    def until_end(self, command: Sequence[str], env: Mapping[str, str] | None = None) -> float:
        """Run a command, and return the seconds until its end."""
        started_at = time.monotonic()
        finish(self.start(command, env))
        return time.monotonic() - started_at

    def until_sound(self, action: Action) -> float:
        """Return the seconds from an action to the first sound."""
        with self.sink.record() as recording:
            started_at = time.monotonic()
            wait = action()
            if recording.first_sound() is None:
                recording.wait_for_sound(_LIMIT_S)
            wait()
            recording.wait_until_quiet(_QUIET_S)
            first = recording.first_sound()
        assert first is not None
        return first - started_at

    def until_silence(self, action: Action, stop: Action) -> float:
        """Return the seconds from a stop in the middle of a sound to the last sample that isn't zero."""
        with self.sink.record() as recording:
            wait_for_action = action()
            self._wait_before_stop(recording)
            stopped_at = time.monotonic()
            wait_for_stop = stop()
            recording.wait_until_quiet(_QUIET_S)
            wait_for_stop()
            wait_for_action()
            found = extent(recording.samples, 0)
            assert found is not None
            seconds = recording.time_of(found[1] - 1) - stopped_at
        assert -0.05 < seconds < _STOP_LIMIT_S, f"not stopped: the sound ended {seconds:.3f} s after the stop"
        return seconds

    def until_preempted(self) -> float:
        """Return the seconds from the request of a preempting goal to the first sound of its sentence."""
        with self.sink.record() as recording:
            self.client.say(VOICED)
            self._wait_before_stop(recording)
            sent_at = time.monotonic()
            self.client.say(SHORT, preempt=True).wait(_LIMIT_S)
            recording.wait_until_quiet(_QUIET_S)
        start = recording.sample_at(sent_at)
        found = compare(recording.samples[start:], render([SHORT])[0])
        assert found.correlation > _MIN_CORRELATION, f"the new sentence was not heard: {found}"
        return recording.time_of(start + found.offset) - sent_at

    def _wait_before_stop(self, recording: Recording) -> None:
        recording.wait_for_sound(_LIMIT_S)
        time.sleep(_BEFORE_STOP_S)
        self.jitter()


@contextlib.contextmanager
def serving(*options: str, sink: Sink | None = None, scripted: bool = False) -> Iterator[Talk]:
    """Run a server during the block. Yield it when its engine is ready."""
    talk = Talk(options, sink=sink, scripted=scripted, watched=False, forked=False)
    try:
        assert talk.request("voices", timeout=20)["ok"]
        yield talk
        talk.stop()
    finally:
        talk.close()


@contextlib.contextmanager
def fine_blocks(sink: Sink) -> Iterator[None]:
    """Make a sink render in small blocks during the `with` block, by recording it with a low latency."""
    command = ["parec", "-d", "null.monitor", "--raw", "--format=s16le", f"--rate={RATE}", "--channels=1"]
    process = subprocess.Popen(
        dying_with_parent([*command, f"--latency-msec={_BLOCK_MS}"]),
        env=clean_environment(sink.directory, sink.env),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        with sink.record() as recording:
            recording.wait_until_quiet(2.5)  # until all large blocks are over
        yield
    finally:
        process.kill()
        process.wait()


def finish(process: subprocess.Popen[bytes], *allowed: int) -> None:
    """Wait for a command, and check that its exit code is 0 or an allowed one."""
    try:
        _, error = process.communicate(timeout=_LIMIT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        raise
    assert process.returncode in (0, *allowed), f"{process.args!r}: exit code {process.returncode}: {error!r}"
