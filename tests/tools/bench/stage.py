"""The programs that the rows share, and the times from an action to the sound or the silence that follows it.

All times are of the monotonic clock: that of the process that starts a command or sends a request, and that of the
blocks in which the sink's monitor arrives. A null sink renders a block ahead of the time, so a sound may seem to be a
block of 2 ms too early. The recorder adds the same to talk and its peers; its own row shows how much.
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

    #: Starts something, and returns a function that waits for its end.
    Action = Callable[[], Callable[[], object]]

PYTHON, TALK = sys.executable, f"{sys.prefix}/bin/talk"
#: Voiced from its first sample on, without a pause.
SHORT = "ready"
#: Voiced for more than two seconds, so that its last sample is loud whenever it is stopped.
VOICED = "we are all in a long lonely line along many a warm lower river"
_BLOCK_MS = 2
#: Seconds of silence after which a sentence is over, and seconds to wait for a sound or an end.
_QUIET_S, _PATIENCE_S = 0.3, 10.0
#: Seconds that are heard of a sentence before it is stopped, and seconds in which a stop must work.
_BEFORE_STOP_S, _STOP_LIMIT_S = 0.2, 1.0
#: Two blocks of the sink: the actions spread over these seconds, so that they meet a block at any of its moments.
_JITTER_S = 0.02
#: A sentence resembles its reference by 0.84 or more if the synthesiser has spoken before, another one by 0.4 at most.
_RESEMBLES = 0.7


@dataclass(frozen=True, slots=True)
class Options:
    """The number of rounds of each row, the seconds of an idle process, and the sentences of the marathon."""

    rounds: int = 15
    idle: float = 60.0
    sentences: int = 10_000


class Stage(contextlib.ExitStack):
    """The programs that rows share. Each starts when the first row needs it, and ends with the block."""

    def __init__(self, options: Options) -> None:
        super().__init__()
        self.options = options
        self.has_peers = peers.installed()
        self._chance = random.Random(5)

    @cached_property
    def sink(self) -> Sink:
        """A sound server with a null sink that is recorded."""
        sink = self.enter_context(Sink())
        self.enter_context(fine_blocks(sink))
        return sink

    @cached_property
    def talk(self) -> Talk:
        """A server that plays into the sink, with default options."""
        return self.enter_context(serving(sink=self.sink))

    @cached_property
    def client(self) -> Client:
        """A connection to this server."""
        return self.enter_context(Client(self.talk.socket, name="bench"))

    @cached_property
    def env(self) -> dict[str, str]:
        """The environment of commands: they find this server, the sink and speech-dispatcher."""
        return self.talk.env | (self.enter_context(peers.dispatcher(self.sink)) if self.has_peers else {})

    def jitter(self) -> None:
        """Sleep for a random part of two blocks."""
        time.sleep(self._chance.random() * _JITTER_S)

    def in_turn(self, subjects: Mapping[str, Callable[[], float]], rounds: int = 0) -> dict[str, list[float]]:
        """Measure the subjects in turn, in a random order each round; return the milliseconds of each.

        Each subject returns seconds. A first round that is not counted warms all of them up.
        """
        times: dict[str, list[float]] = {name: [] for name in subjects}
        for number in range((rounds or self.options.rounds) + 1):
            for name in self._chance.sample([*subjects], len(subjects)):
                self.jitter()
                seconds = subjects[name]()
                if number:
                    times[name].append(seconds * 1000)
        return times

    def start(self, words: Sequence[str], env: Mapping[str, str] | None = None) -> subprocess.Popen[bytes]:
        """Start a command; `finish` waits for it."""
        # An installed talk needs no path to be found.
        env = {name: value for name, value in (env or self.env).items() if name != "PYTHONPATH"}
        return subprocess.Popen(
            words, env=env, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
        )

    def command(self, *words: str) -> Action:
        """Return the action that starts a command."""
        return lambda: partial(finish, self.start(words))

    def until_end(self, words: Sequence[str], env: Mapping[str, str] | None = None) -> float:
        """Run a command, and return its seconds."""
        began = time.monotonic()
        finish(self.start(words, env))
        return time.monotonic() - began

    def until_sound(self, begin: Action) -> float:
        """Return the seconds from an action to the first sound."""
        with self.sink.record() as recording:
            began = time.monotonic()
            end = begin()
            if recording.first_sound() is None:
                recording.wait_for_sound(_PATIENCE_S)
            end()
            recording.wait_until_quiet(_QUIET_S)
            first = recording.first_sound()
        assert first is not None
        return first - began

    def until_silence(self, begin: Action, stop: Action) -> float:
        """Return the seconds from a stop, in the middle of a sound, to the last sample that is not zero."""
        with self.sink.record() as recording:
            ends = [begin()]
            self._hear(recording)
            stopped = time.monotonic()
            ends.append(stop())
            recording.wait_until_quiet(_QUIET_S)
            for end in reversed(ends):
                end()
            found = extent(recording.samples, 0)
            assert found is not None
            seconds = recording.time_of(found[1] - 1) - stopped
        assert -0.05 < seconds < _STOP_LIMIT_S, f"nothing was stopped: the sound ended {seconds:.3f} s after the stop"
        return seconds

    def until_preempted(self) -> float:
        """Return the seconds from the request of a goal that preempts to the first sound of its sentence."""
        with self.sink.record() as recording:
            self.client.say(VOICED)
            self._hear(recording)
            asked = time.monotonic()
            self.client.say(SHORT, preempt=True).wait(_PATIENCE_S)
            recording.wait_until_quiet(_QUIET_S)
        start = recording.sample_at(asked)
        found = compare(recording.samples[start:], render([SHORT])[0])
        assert found.correlation > _RESEMBLES, f"the new sentence was not heard: {found}"
        return recording.time_of(start + found.offset) - asked

    def _hear(self, recording: Recording) -> None:
        recording.wait_for_sound(_PATIENCE_S)
        time.sleep(_BEFORE_STOP_S)
        self.jitter()


@contextlib.contextmanager
def serving(
    *options: str, sink: Sink | None = None, scripted: bool = False, program: str | None = None
) -> Iterator[Talk]:
    """Run a server until the end of the block; yield it when its engine is ready."""
    talk = Talk(options, sink=sink, scripted=scripted, program=program, watched=False, forked=False)
    try:
        assert talk.request("voices", timeout=20)["ok"]
        yield talk
        talk.stop()
    finally:
        talk.close()


@contextlib.contextmanager
def fine_blocks(sink: Sink) -> Iterator[None]:
    """Have a sink render in small blocks until the end of the block, by a listener that asks for them."""
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
            recording.wait_until_quiet(2.5)  # all large blocks are over then
        yield
    finally:
        process.kill()
        process.wait()


def finish(process: subprocess.Popen[bytes], *allowed: int) -> None:
    """Wait for a command to end with exit code 0, or one that is allowed."""
    try:
        _, error = process.communicate(timeout=_PATIENCE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        raise
    assert process.returncode in (0, *allowed), f"{process.args!r}: exit code {process.returncode}: {error!r}"
