"""Times of what is heard: from the start of something to its first sound, from a stop to silence, between two sounds.

Every time is of one clock (monotonic): that of the process that starts a command or sends a line, and that of the
blocks in which the sink's monitor arrives. A null sink renders a block ahead of the time, so what is heard counts as
heard up to a block too early: blocks are 2 ms here. What the recorder adds or hides is the same for talk and its peers;
the rows of `recorder` show how much it is.
"""

from __future__ import annotations

import contextlib
import subprocess
import time
from typing import TYPE_CHECKING

from tests.bench.arithmetic import last_sound, silences
from tests.bench.failure import FailedError
from tests.support.espeak import RATE
from tests.support.surroundings import clean_environment, dying_with_parent

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from tests.support.recording import Recording
    from tests.support.sink import Sink

    #: Starts something, and returns what waits for its end.
    Action = Callable[[], Callable[[], object]]

#: Voiced from its first sample on, with no quiet stretch within.
SHORT = "ready"
#: Voiced all along for more than two seconds: whenever it is stopped, its last sample is none that is silent anyway.
VOICED = "we are all in a long lonely line along many a warm lower river"
#: Milliseconds of sound that the null sink renders at a time.
_BLOCK = 2
#: Seconds of quiet after which a sentence is over; espeak-ng's own pause at its end is quiet, too.
_QUIET = 0.3
#: Seconds within which something must be heard.
_PATIENCE = 10.0
#: Seconds of a sound that are heard before it is stopped.
_BEFORE_STOP = 0.2
#: A stop that is heard longer after it than this did not stop anything.
_STOP_LIMIT = 1.0
#: Seconds of digital silence that separate one player's sound from the next one's: 0.4 ms were seen. Within a voiced
#: word a sample or two are zero in a row, as the wave crosses it.
_BETWEEN_PLAYERS = 0.0002


@contextlib.contextmanager
def fine_blocks(sink: Sink) -> Iterator[None]:
    """Have the sink render in small blocks until the end of the block: as small as the most hasty listener asks for."""
    command = ["parec", "-d", "null.monitor", "--raw", "--format=s16le", f"--rate={RATE}", "--channels=1"]
    env = clean_environment(sink.directory, sink.env)
    process = subprocess.Popen(
        dying_with_parent([*command, f"--latency-msec={_BLOCK}"]),
        env=env,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        with sink.record() as recording:
            try:
                recording.wait_until_quiet(2.5)  # what was rendered in large blocks is over then
            except TimeoutError:
                raise FailedError("the null sink does not render steadily") from None
        yield
    finally:
        process.kill()
        process.wait()


class Command:
    """A program that was started to be timed, and is waited for when that is over."""

    def __init__(self, command: Sequence[str], env: Mapping[str, str]) -> None:
        self._command = command
        self._process = subprocess.Popen(
            command, env=dict(env), stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
        )

    def finish(self, *allowed: int) -> None:
        """Wait until it has ended; FailedError with its own words if it did not end well."""
        try:
            _, error = self._process.communicate(timeout=_PATIENCE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.communicate()
            raise FailedError(f"{self._command[0]} does not end") from None
        if self._process.returncode not in (0, *allowed):
            told = error.decode(errors="replace").strip()
            raise FailedError(f"{' '.join(self._command)}: exit code {self._process.returncode}: {told}")

    def kill(self) -> None:
        """Kill it outright."""
        self._process.kill()


def until_sound(sink: Sink, begin: Action, after: float = 0.0) -> float:
    """Return the seconds from `begin` to the first sound; what it returns is called when that was heard.

    It begins `after` so many seconds of silence.
    """
    time.sleep(after)
    with sink.record() as recording:
        began = time.monotonic()
        end = begin()
        _await_sound(recording)
        end()
        _await_quiet(recording)
        first = recording.first_sound()
    assert first is not None
    return first - began


def until_silence(sink: Sink, begin: Action, stop: Action, after: float = 0.0) -> float:
    """Return the seconds from `stop`, in the middle of what `begin` starts, to the last sample that is not zero.

    What both return is called when it is silent.
    """
    with sink.record() as recording:
        end = begin()
        _await_sound(recording)
        time.sleep(_BEFORE_STOP + after)
        _await_more(recording)  # a neural voice that is too slow is silent now and then
        stopped = time.monotonic()
        stop_ends = stop()
        _await_quiet(recording)
        stop_ends()
        end()
        last = last_sound(recording.samples, 0)
        assert last is not None
        silent = recording.time_of(last)
    if not -0.05 < silent - stopped < _STOP_LIMIT:
        raise FailedError(f"the stop and the end of the sound are {silent - stopped:.3f} s apart: nothing was stopped")
    return silent - stopped


def from_old_to_new(sink: Sink, begin: Action, preempt: Action, after: float) -> float:
    """Return the seconds of digital silence between what `begin` started and what `preempt` puts in its place."""
    with sink.record() as recording:
        end = begin()
        _await_sound(recording)
        time.sleep(_BEFORE_STOP + after)
        began = time.monotonic()
        preempt_ends = preempt()
        preempt_ends()
        _await_quiet(recording)
        end()
        start = recording.sample_at(began - 0.02)
        heard = recording.samples[start : start + int(0.5 * RATE)]
    between = silences(heard, int(_BETWEEN_PLAYERS * RATE), 0)
    if not between:
        raise FailedError("there is no silence between the old sentence and the new one")
    # An old sentence may hold a moment of silence itself, before it is stopped; the new one begins with a voiced word.
    quiet_from, sound_from = between[-1]
    return (sound_from - quiet_from) / RATE


def _await_sound(recording: Recording) -> None:
    if recording.first_sound() is None:
        _await_more(recording)


def _await_more(recording: Recording) -> None:
    try:
        recording.wait_for_sound(_PATIENCE)
    except TimeoutError as error:
        raise FailedError(f"it was not heard: {error}") from None


def _await_quiet(recording: Recording) -> None:
    try:
        recording.wait_until_quiet(_QUIET)
    except TimeoutError as error:
        raise FailedError(f"it did not become quiet: {error}") from None
