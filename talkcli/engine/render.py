"""Renders one text into a WAV file, in an engine process of its own: what `say -o` does, with or without a server.

It is no goal: nothing is queued, nobody else sees it. FILE appears whole or not at all: the engine writes beside it,
under a hidden name, and only what it says it has completed is renamed. It must leave neither that hidden file nor a
process behind, whatever interrupts it; one that is killed outright leaves the hidden file at most.
"""

from __future__ import annotations

import contextlib
import os
import select
import stat
import time
from typing import TYPE_CHECKING

from talkcli import text as texts
from talkcli.dial import Interrupted, ready
from talkcli.engine import protocol, spawn
from talkcli.engine.limits import HANG_AFTER, SILENCE_LIMIT, START_LIMIT
from talkcli.errors import EXIT_ERROR, TalkError, UsageError

if TYPE_CHECKING:
    from collections.abc import Iterator

#: The exit codes of a goal that is REJECTED or ABORTED, for the same reasons here.
_EXIT_REJECTED, _EXIT_ABORTED = 5, 4
_REJECTED = frozenset({"invalid_text", "text_too_long", "unknown_voice", "bad_option"})
#: Reasons that come from the player; the only one here is the file.
_FROM_FILE = frozenset({"audio_device", "audio_lost"})
#: The name of the one sentence.
_ID = "output"


class RenderFailed(TalkError):
    """There is no file: `code` has the reasons that a goal has, or `cannot_write`."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code
        self.exit_code = _EXIT_REJECTED if code in _REJECTED else _EXIT_ABORTED


class CannotWrite(RenderFailed):
    """The file cannot be written; what was there before is as it was."""

    def __init__(self, path: str, why: str) -> None:
        super().__init__("cannot_write", f"{path} {why}")
        self.exit_code = EXIT_ERROR


def render(
    text: str,
    path: str,
    *,
    rate: int = 200,
    volume: float = 1.0,
    voice: str | None = None,
    pitch: int = 50,
    driver: str | None = None,
    timeout: float | None = None,
    interrupt: int | None = None,
) -> float:
    """Render the text into the file at `path` and return the seconds of audio.

    The settings are those of a goal. `timeout`: seconds in which it must be done, else TimeoutError; `interrupt`: a
    descriptor that ends it with `Interrupted` as soon as it is readable. RenderFailed; UsageError for a driver that
    writes no file.
    """
    deadline = None if timeout is None else time.monotonic() + timeout
    fault = texts.fault(text)
    if fault is not None:
        raise RenderFailed(*fault)
    target = _target(path)
    say = protocol.Say(_ID, text, rate, volume, voice, pitch)
    with _beside(target, path) as hidden:
        seconds = _speak_into(hidden, path, say, driver, deadline, interrupt)
        _put_in_place(hidden, target, path)
    return seconds


def _target(path: str) -> str:
    """Return the file to rename over, which is what a link points to; CannotWrite if it can't be one."""
    if path in {"", "-"} or path.endswith(os.sep) or "\0" in path:
        raise CannotWrite(repr(path), "is no name of a file: a rendering needs one, as in speech.wav")
    target = os.path.realpath(path)
    try:
        found = os.stat(path)
    except FileNotFoundError:
        return target
    except OSError as error:
        raise _unwritable(path, error) from error
    if stat.S_ISDIR(found.st_mode):
        raise CannotWrite(path, "is a directory: name a file in it")
    # What is open without a name any more has a link, /dev/stdout for one, but no place.
    placed = os.path.exists(target) and os.path.samefile(path, target)
    if not stat.S_ISREG(found.st_mode) or not placed or _is_our_output(found):
        raise CannotWrite(path, "is no file that can be replaced: name another, as in speech.wav")
    if not os.access(target, os.W_OK):
        raise CannotWrite(path, "cannot be written: it is write-protected")
    return target


def _is_our_output(found: os.stat_result) -> bool:
    """Tell whether this is /dev/stdout by any name: the shell has it open, so it can be replaced by nobody."""
    for descriptor in (1, 2):
        with contextlib.suppress(OSError):  # it is closed
            if os.path.samestat(found, os.fstat(descriptor)):
                return True
    return False


@contextlib.contextmanager
def _beside(target: str, path: str) -> Iterator[str]:
    """Give a new file, hidden, in the target's directory; it is removed at the end if it is still there."""
    # Its length doesn't depend on the target's, whose name may be as long as a name can be.
    hidden = os.path.join(os.path.dirname(target), f".talk-{os.urandom(8).hex()}.wav")
    try:
        _create(hidden, path)
        yield hidden
    finally:
        # Renamed by now, or never made; where it cannot be removed, why is in the error that brought us here.
        with contextlib.suppress(OSError):
            os.unlink(hidden)


def _create(hidden: str, path: str) -> None:
    """Make the file, so that its mode is what the umask makes of it and nobody else's file is written to."""
    try:
        os.close(os.open(hidden, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666))
    except OSError as error:
        directory = os.path.dirname(hidden)
        if not os.path.isdir(directory):
            raise CannotWrite(path, f"cannot be written: there is no directory {directory}") from error
        raise _unwritable(path, error) from error


def _put_in_place(hidden: str, target: str, path: str) -> None:
    try:
        file = os.open(hidden, os.O_RDONLY | os.O_CLOEXEC)
        try:
            os.fsync(file)  # some file systems tell only here that the disk is full, and a power cut must not empty it
        finally:
            os.close(file)
        os.replace(hidden, target)
    except OSError as error:
        raise _unwritable(path, error) from error


def _unwritable(path: str, error: OSError) -> CannotWrite:
    return CannotWrite(path, f"cannot be written: {error.strerror}")


def _speak_into(
    hidden: str, path: str, say: protocol.Say, driver: str | None, deadline: float | None, interrupt: int | None
) -> float:
    configure = protocol.Configure(os.getpid(), driver, f"file:{hidden}", None, None, list_voices=False)
    try:
        process = spawn.EngineProcess(spawn.engine_command(), configure)
    except OSError as error:
        raise RenderFailed("engine_failed", f"the engine process cannot be started: {error}") from error
    try:
        ended = _Conversation(process, say, deadline, interrupt).run()
    finally:
        _end(process)
    if ended.outcome == protocol.COMPLETED and ended.duration is not None:
        return ended.duration
    reason = ended.reason or "engine_failed"
    message = (ended.message or "the engine did not complete the text").replace(hidden, path)
    if reason in _FROM_FILE:
        why = message.removeprefix(path)
        raise CannotWrite(path, f"cannot be written{why}" if why.startswith(": ") else why.strip())
    raise RenderFailed(reason, message)


def _end(process: spawn.EngineProcess) -> None:
    """Kill the process and see it gone: it could make the hidden file once more."""
    process.kill()
    if ready({process.liveness: select.POLLIN}, SILENCE_LIMIT):
        process.silent()
    process.close()


class _Conversation:
    """What is said to the engine process and heard of it, up to the end of the text; it has the thread's limits."""

    def __init__(
        self, process: spawn.EngineProcess, say: protocol.Say, deadline: float | None, interrupt: int | None
    ) -> None:
        self._process = process
        self._say = say
        self._deadline = deadline
        self._interrupt = interrupt
        self._heard_at = time.monotonic()
        self._ended: protocol.Ended | None = None

    def run(self) -> protocol.Ended:
        """Return how it ended; RenderFailed, TimeoutError, Interrupted, UsageError."""
        watched = {self._process.socket.fileno(): select.POLLIN, self._process.stderr: select.POLLIN}
        if self._interrupt is not None:
            watched[self._interrupt] = select.POLLIN
        while True:
            found = ready(watched, self._wait())
            if self._interrupt in found:
                raise Interrupted
            if self._process.stderr in found and not self._process.read_stderr():
                del watched[self._process.stderr]
            # Before the limits: who was stopped by Ctrl-Z finds all that was said meanwhile, and the limits long past.
            if self._process.socket.fileno() in found:
                self._hear()
            if self._ended is not None:
                return self._ended
            self._keep_limits(heard=self._process.socket.fileno() in found)

    def _limit(self) -> float:
        return HANG_AFTER if self._process.ready else START_LIMIT

    def _wait(self) -> float:
        due = self._heard_at + self._limit()
        return max(0.0, min(due, self._deadline if self._deadline is not None else due) - time.monotonic())

    def _keep_limits(self, heard: bool) -> None:
        now = time.monotonic()
        if self._deadline is not None and now >= self._deadline:
            raise TimeoutError("the text was not rendered in time")
        if heard or now < self._heard_at + self._limit():
            return
        if not self._process.ready:
            raise RenderFailed("engine_failed", f"the engine was not ready after {START_LIMIT:g} s")
        raise RenderFailed("engine_hung", f"the engine gave no sign of life for {HANG_AFTER:g} s")

    def _hear(self) -> None:
        for event in self._process.receive():
            self._heard_at = time.monotonic()
            if event is None:
                raise RenderFailed("engine_crashed", f"the engine crashed: {self._process.last_words()}")
            if isinstance(event, protocol.StartFailed):
                raise RenderFailed(event.reason, event.message)
            if isinstance(event, protocol.Ready):
                self._begin(event)
            elif isinstance(event, protocol.Ended):
                self._ended = event
                return

    def _begin(self, event: protocol.Ready) -> None:
        if event.player is None:
            raise UsageError(f'the driver "{event.driver}" cannot write a file: leave --driver out, on Linux')
        self._process.ready = True
        if not self._process.send(self._say):
            raise RenderFailed("engine_hung", "the engine takes no commands")
