"""Renders one text into a WAV file, in an engine process of its own: what `say -o` does, with or without a server.

It is no goal: nothing is queued, nobody else sees it, and the text may have any length. FILE appears whole or not at
all: the engine writes beside it, under a hidden name, and only what it says it has completed is renamed. It must leave
neither that hidden file nor a process behind, whatever interrupts it; one that is killed outright leaves the hidden
file at most. Standard output, a named pipe, a device get the sound as it is made.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import stat
import time
from typing import TYPE_CHECKING

from talkcli.engine import protocol
from talkcli.engine.child.players.builtin import WavStreamPlayer
from talkcli.engine.parent.process import Conversation, EngineFailed
from talkcli.errors import EXIT_ERROR, TalkError, UsageError
from talkcli.goals import text as texts
from talkcli.goals.options import MAX_CHARACTERS
from talkcli.polling import wait_ready

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

#: The exit codes of a goal that is REJECTED or ABORTED, for the same reasons here.
_EXIT_REJECTED, _EXIT_ABORTED = 5, 4
_REJECTED = frozenset({"invalid_text", "unknown_voice", "bad_option"})
#: Reasons that come from the player; the only one here is the file.
_FROM_FILE = frozenset({"audio_device", "audio_lost"})
#: What stands for standard output, which is written to as it is: the shell has opened it.
STANDARD_OUTPUT = frozenset({"-", "/dev/stdout", "/dev/fd/1", "/proc/self/fd/1"})
#: Seconds between two looks whether somebody has opened a named pipe to read it: nothing tells of that.
_READER_LOOK = 0.05
#: Characters of a piece, as many as a goal may have: the engine says nothing while it prepares them.
LONGEST_PIECE = MAX_CHARACTERS
#: Where a text may be cut and sounds as if it were whole: behind the end of a sentence, or of a line.
_SENTENCE_END = re.compile(r"""[.!?…]["')\]»”’]*\s+|[。！？।]|\n\s*""")
_BLANK = re.compile(r"\s+")


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
    interrupt: Mapping[int, int] | None = None,
) -> float:
    """Render the text into the file at `path` and return the seconds of audio; "-" is standard output.

    The settings are those of a goal. `timeout`: seconds in which it must be done, else TimeoutError; `interrupt`: what
    ends it with Interrupted, as in `connect.ready`. RenderFailed; BrokenPipeError where whoever reads standard output
    is gone; UsageError for a driver that writes no file, or for a terminal.
    """
    deadline = time.monotonic() + (float("inf") if timeout is None else timeout)
    fault = texts.fault(text, None)
    if fault is not None:
        raise RenderFailed(*fault)
    # A file has time, and another voice in it would be no use.
    asked = (each for each in enumerate(pieces(text), 1))
    says = (protocol.Say(f"{n}", each, rate, volume, voice, pitch, voice_only=True) for n, each in asked)
    if path not in STANDARD_OUTPUT and not _is_stream(path):
        with _replacing(path) as hidden:
            configure = protocol.Configure(os.getpid(), driver, f"file:{hidden}", None, None, list_voices=False)
            return _speak_into(Conversation(configure, deadline=deadline, interrupt=interrupt), hidden, path, says)
    with _stream(path, deadline, interrupt) as output:
        configure = protocol.Configure(os.getpid(), driver, None, None, None, list_voices=False, output=output)
        try:
            conversation = Conversation(configure, deadline=deadline, interrupt=interrupt)
            return _speak_into(conversation, WavStreamPlayer.name, _named(path), says)
        except CannotWrite as error:
            if path in STANDARD_OUTPUT and wait_ready({output: 0}, 0.0):
                raise BrokenPipeError(errno.EPIPE, "the reader of standard output is gone") from error
            raise


def pieces(text: str) -> Iterator[str]:
    """Cut a text into pieces that are not too long, and that are the text when they are joined."""
    start = 0
    while len(text) - start > LONGEST_PIECE:
        end = start + LONGEST_PIECE
        for where in (_SENTENCE_END, _BLANK):
            ends = [each.end() for each in where.finditer(text, start, end)]
            if ends:
                end = ends[-1]
                break
        yield text[start:end]
        start = end
    yield text[start:]


def _named(path: str) -> str:
    return "standard output" if path in STANDARD_OUTPUT else path


def _is_stream(path: str) -> bool:
    """Whether the path is that of a named pipe or of a device that takes characters, which nothing is renamed over."""
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        return False
    return stat.S_ISFIFO(mode) or stat.S_ISCHR(mode)


@contextlib.contextmanager
def _stream(path: str, deadline: float, interrupt: Mapping[int, int] | None) -> Iterator[int]:
    """Give a descriptor of standard output, a named pipe or a device, open for writing."""
    output = os.dup(1) if path in STANDARD_OUTPUT else _open_stream(path, deadline, interrupt)
    try:
        if os.isatty(output):
            raise UsageError(
                f"{_named(path)} is a terminal, and sound is no text: name a file, or a program that reads it, as in: "
                "talk say -o - TEXT | aplay"
            )
        yield output
    finally:
        os.close(output)


def _open_stream(path: str, deadline: float, interrupt: Mapping[int, int] | None) -> int:
    """Open a device, or a named pipe once somebody reads it."""
    while True:
        try:
            return os.open(path, os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
        except OSError as error:
            if error.errno != errno.ENXIO or not stat.S_ISFIFO(os.stat(path).st_mode):
                raise _unwritable(path, error) from error
        left = min(_READER_LOOK, deadline - time.monotonic())
        if left <= 0:
            raise TimeoutError(f"nobody has opened {path} to read it within the time")
        wait_ready({}, left, interrupt)


def _target(path: str) -> str:
    """Return the file to rename over, which is what a link points to; CannotWrite if it can't be one."""
    if not path or path.endswith(os.sep) or "\0" in path:
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
    # What is open without a name any more has a link, in /proc, but no place.
    placed = os.path.exists(target) and os.path.samefile(path, target)
    if not stat.S_ISREG(found.st_mode) or not placed or _is_our_output(found):
        raise CannotWrite(path, "is no file that can be replaced: name another, as in speech.wav")
    if not os.access(target, os.W_OK):
        raise CannotWrite(path, "cannot be written: it is write-protected")
    return target


def _is_our_output(found: os.stat_result) -> bool:
    """Tell whether the shell has it open for our output, under its own name: then it can be replaced by nobody."""
    for descriptor in (1, 2):
        with contextlib.suppress(OSError):  # it is closed
            if os.path.samestat(found, os.fstat(descriptor)):
                return True
    return False


@contextlib.contextmanager
def _replacing(path: str) -> Iterator[str]:
    """Give a new file, hidden, in the directory of the one to rename over; at a good end it is that one, else gone."""
    target = _target(path)
    # Its length doesn't depend on the target's, whose name may be as long as a name can be.
    hidden = os.path.join(os.path.dirname(target), f".talk-{os.urandom(8).hex()}.wav")
    try:
        try:  # with the mode that the umask makes of it, and nobody else's file is written to
            open(hidden, "xb").close()
        except OSError as error:
            directory = os.path.dirname(hidden)
            if not os.path.isdir(directory):
                raise CannotWrite(path, f"cannot be written: there is no directory {directory}") from error
            raise _unwritable(path, error) from error
        yield hidden
        try:
            with open(hidden, "rb") as file:
                os.fsync(file)  # a power cut must not empty it; and some file systems tell only here of a full disk
            os.replace(hidden, target)
        except OSError as error:
            raise _unwritable(path, error) from error
    finally:
        # Renamed by now, or never made; where it cannot be removed, why is in the error that brought us here.
        with contextlib.suppress(OSError):
            os.unlink(hidden)


def _unwritable(path: str, error: OSError) -> CannotWrite:
    return CannotWrite(path, f"cannot be written: {error.strerror}")


def _speak_into(conversation: Conversation, name: str, path: str, says: Iterator[protocol.Say]) -> float:
    """Speak all pieces, and return the seconds of audio. What the engine calls `name` is `path` to the user."""
    seconds = 0.0
    silent = None
    by = ""
    try:
        with conversation as engine:
            began = engine.until(protocol.Ready)
            if began.player is None:
                raise UsageError(f'the driver "{began.driver}" cannot write a file: leave --driver out, on Linux')
            for say in says:
                by = "" if say.voice is None else f' while it spoke with the voice "{say.voice}"'
                engine.say(say)
                ended = engine.until(protocol.Ended)
                if ended.outcome == protocol.COMPLETED and ended.duration is not None:
                    seconds += ended.duration
                elif ended.reason == "nothing_to_say":  # a piece of a long text may be rows of dots
                    silent = ended
                else:
                    raise _failure(ended, name, path)
    except EngineFailed as error:
        crashed = error.reason == "engine_crashed"
        raise RenderFailed(error.reason, f"the engine crashed{by}: {error}" if crashed else f"{error}{by}") from error
    except TimeoutError:
        raise TimeoutError("the text was not rendered in time") from None
    if silent and not seconds:
        raise _failure(silent, name, path)
    return seconds


def _failure(ended: protocol.Ended, name: str, path: str) -> RenderFailed:
    reason = ended.reason or "engine_failed"
    message = (ended.message or "the engine did not complete the text").replace(name, path)
    if reason in _FROM_FILE:
        why = message.removeprefix(path)
        return CannotWrite(path, f"cannot be written{why}" if why.startswith(": ") else why.strip())
    return RenderFailed(reason, message)
