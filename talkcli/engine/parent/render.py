"""Code that renders text to a WAV file, for `say -o`.

A rendering uses its own engine process and needs no server. It is not a goal: it isn't queued, other clients don't see
it, and the text may have any length.

A regular file appears only when it is complete. Until then, the engine writes to a hidden file in the same directory,
which is finally renamed. Unless a SIGKILL ends the rendering, neither the hidden file nor a process is left behind.
Standard output, a named pipe or a device receives the sound while it is being synthesized.
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
from talkcli.engine.parent.process import EngineFailed, PrivateEngine
from talkcli.errors import EXIT_ERROR, TalkError, UsageError
from talkcli.goals.options import DEFAULTS, MAX_TEXT_CHARS, SOUND_OPTIONS, bad_text
from talkcli.goals.reasons import Reason
from talkcli.goals.states import EXIT_CODES, State
from talkcli.polling import wait_ready

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from typing import Any

#: A failure for one of these reasons exits with the code of a rejected goal. Any other failure exits with the code of
#: an aborted goal.
_REJECTED_REASONS = frozenset({Reason.INVALID_TEXT, Reason.UNKNOWN_VOICE, Reason.BAD_OPTION})
#: Failures of the player. When a text is rendered, the player writes the file, so these failures mean that the file
#: can't be written.
_FILE_REASONS = frozenset({Reason.AUDIO_DEVICE, Reason.AUDIO_LOST})
#: Paths that refer to standard output. They don't need to be opened, because the shell has already opened standard
#: output.
STANDARD_OUTPUT = frozenset({"-", "/dev/stdout", "/dev/fd/1", "/proc/self/fd/1"})
#: How often to check whether a named pipe has a reader. No event reports a new reader.
_READER_CHECK_INTERVAL_S = 0.05
#: Maximum length of the text in one `Speak`, the same as for a goal. The engine sends no messages while it prepares a
#: text, so a longer text could be mistaken for a hang.
MAX_PIECE_CHARS = MAX_TEXT_CHARS
#: The end of a sentence or a line. Cutting a text there doesn't change how it sounds.
_SENTENCE_END = re.compile(r"""[.!?…]["')\]»”’]*\s+|[。！？।]|\n\s*""")
_BLANK = re.compile(r"\s+")


class RenderFailed(TalkError):
    """Raised if the text was not rendered. No file was created.

    `code` is a goal's reason or "cannot_write".
    """

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code
        self.exit_code = EXIT_CODES[State.REJECTED if code in _REJECTED_REASONS else State.ABORTED]


class CannotWrite(RenderFailed):
    """Raised if the file can't be written. An existing file is unchanged."""

    def __init__(self, path: str, problem: str) -> None:
        super().__init__("cannot_write", f"{path} {problem}")
        self.exit_code = EXIT_ERROR


def render(
    text: str,
    path: str,
    *,
    driver: str | None = None,
    markdown: bool = False,
    pronunciations: dict[str, str] | None = None,
    timeout: float | None = None,
    interrupt: Mapping[int, int] | None = None,
    **sound: Any,
) -> float:
    """Render a text to a WAV file. Return the length of the audio in seconds.

    Args:
        text: the text, of any length.
        path: the file to write, or "-" for standard output.
        driver: name of a pyttsx3 driver, or None for the default.
        markdown: whether the text is written in Markdown, whose marks are not spoken.
        pronunciations: terms of the text with their replacements.
        timeout: time limit in seconds, or None for no limit.
        interrupt: descriptors that interrupt the rendering, as in `polling.wait_ready`.
        sound: rate, volume, voice and pitch, if they differ from the defaults.

    Raises:
        RenderFailed: the text can't be spoken or the file can't be written.
        UsageError: the driver can't write files, or standard output is a terminal.
        TimeoutError: the time limit was exceeded.
        Interrupted: one of the descriptors in `interrupt` became ready.
        BrokenPipeError: the reader of standard output has closed it.
    """
    deadline = time.monotonic() + (float("inf") if timeout is None else timeout)
    fault = bad_text(text, None)
    if fault is not None:
        raise RenderFailed(*fault)
    sound = {each.name: getattr(DEFAULTS, each.name) for each in SOUND_OPTIONS} | sound
    if markdown:
        from talkcli.engine.markdown import blank_markdown  # this import is slow and rarely needed

        text = blank_markdown(text)  # marks can't be recognized once the text is cut into pieces
    # A rendering can wait for its voice to load. A file with a different voice would be useless.
    numbered = enumerate(split_into_pieces(text), 1)
    more = {**sound, "voice_only": True, "pronunciations": pronunciations}
    commands = (protocol.Speak(f"{number}", piece, **more) for number, piece in numbered)
    with contextlib.ExitStack() as stack:
        player: str | None = None
        output_fd: int | None = None
        engine_path = protocol.OUTPUT_STREAM_NAME
        if _is_stream(path):
            output_fd = stack.enter_context(_open_output(path, deadline, interrupt))
        else:
            engine_path = stack.enter_context(_hidden_file(path))
            player = f"file:{engine_path}"
        configure = protocol.Configure(os.getpid(), driver, player, None, None, list_voices=False, output_fd=output_fd)
        try:
            with PrivateEngine(configure, deadline=deadline, interrupt=interrupt) as engine:
                return _render_all(engine, commands, engine_path, _display_name(path))
        except EngineFailed as error:
            raise _convert_engine_error(error, None) from error
        except TimeoutError:
            raise TimeoutError("the text was not rendered in time") from None
        except CannotWrite as error:
            if output_fd is not None and path in STANDARD_OUTPUT and wait_ready({output_fd: 0}, 0.0):
                raise BrokenPipeError(errno.EPIPE, "the program that reads standard output has closed it") from error
            raise


def split_into_pieces(text: str) -> Iterator[str]:
    """Split a text into pieces of limited length, preferably between sentences or words."""
    start = 0
    while len(text) - start > MAX_PIECE_CHARS:
        limit = start + MAX_PIECE_CHARS
        sentences, words = (list(each.finditer(text, start, limit)) for each in (_SENTENCE_END, _BLANK))
        ends = sentences or words
        end = ends[-1].end() if ends else limit
        yield text[start:end]
        start = end
    yield text[start:]


def _render_all(engine: PrivateEngine, commands: Iterator[protocol.Speak], engine_path: str, shown_path: str) -> float:
    """Render all pieces of the text. Return the length of the audio in seconds.

    Args:
        engine: the engine process.
        commands: a `Speak` for each piece.
        engine_path: name of the file in the engine's error messages.
        shown_path: name of the file in the errors raised here.
    """
    ready = engine.wait_for(protocol.Ready)
    if ready.player is None:
        raise UsageError(f'the driver "{ready.driver}" cannot write files; leave out --driver (on Linux)')
    seconds, silent_end = 0.0, None
    for command in commands:
        try:
            engine.speak(command)
            ended = engine.wait_for(protocol.Ended)
        except EngineFailed as error:
            raise _convert_engine_error(error, command.voice) from error
        if ended.outcome == protocol.OUTCOME_COMPLETED and ended.duration is not None:
            seconds += ended.duration
        elif ended.reason == Reason.NOTHING_TO_SAY:  # a piece of a long text may contain nothing but dots
            silent_end = ended
        else:
            raise _convert_goal_error(ended, engine_path, shown_path)
    if silent_end and not seconds:
        raise _convert_goal_error(silent_end, engine_path, shown_path)
    return seconds


def _convert_engine_error(error: EngineFailed, speaking_voice: str | None) -> RenderFailed:
    """Convert an EngineFailed to a RenderFailed. Name the voice that was speaking."""
    while_speaking = "" if speaking_voice is None else f' while it spoke with the voice "{speaking_voice}"'
    if error.reason == Reason.ENGINE_CRASHED:
        return RenderFailed(error.reason, f"the engine crashed{while_speaking}: {error}")
    return RenderFailed(error.reason, f"{error}{while_speaking}")


def _convert_goal_error(ended: protocol.Ended, engine_path: str, shown_path: str) -> RenderFailed:
    """Convert an `Ended` to an exception whose message names the file as the user knows it."""
    reason = ended.reason or Reason.ENGINE_FAILED
    message = (ended.message or "the engine stopped before the end of the text").replace(engine_path, shown_path)
    if reason in _FILE_REASONS:
        problem = message.removeprefix(shown_path)
        return CannotWrite(shown_path, f"cannot be written{problem}" if problem.startswith(": ") else problem.strip())
    return RenderFailed(reason, message)


def _convert_os_error(path: str, error: OSError) -> CannotWrite:
    """Convert an OSError to a CannotWrite."""
    return CannotWrite(path, f"cannot be written: {error.strerror}")


def _display_name(path: str) -> str:
    """Return the name that messages use for the output."""
    return "standard output" if path in STANDARD_OUTPUT else path


# -- output to a stream


def _is_stream(path: str) -> bool:
    """Return whether the path is standard output, a named pipe or a character device."""
    if path in STANDARD_OUTPUT:
        return True
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        return False
    return stat.S_ISFIFO(mode) or stat.S_ISCHR(mode)


@contextlib.contextmanager
def _open_output(path: str, deadline: float, interrupt: Mapping[int, int] | None) -> Iterator[int]:
    """Provide a descriptor of standard output, a pipe or a device in a `with` block. Refuse terminals."""
    output_fd = os.dup(1) if path in STANDARD_OUTPUT else _open_pipe_or_device(path, deadline, interrupt)
    try:
        if os.isatty(output_fd):
            raise UsageError(
                f"{_display_name(path)} is a terminal; write the sound to a file, or pipe it to a program: "
                "talk say -o - TEXT | aplay"
            )
        yield output_fd
    finally:
        os.close(output_fd)


def _open_pipe_or_device(path: str, deadline: float, interrupt: Mapping[int, int] | None) -> int:
    """Open a device, or a named pipe once it has a reader. Return the descriptor."""
    while True:
        try:
            return os.open(path, os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
        except OSError as error:
            if error.errno != errno.ENXIO or not stat.S_ISFIFO(os.stat(path).st_mode):
                raise _convert_os_error(path, error) from error
        left = min(_READER_CHECK_INTERVAL_S, deadline - time.monotonic())
        if left <= 0:
            raise TimeoutError(f"no program opened {path} for reading in time")
        wait_ready({}, left, interrupt)


# -- output to a regular file


@contextlib.contextmanager
def _hidden_file(path: str) -> Iterator[str]:
    """Create a hidden file, and provide its path. After the `with` block, the file replaces `path`.

    After an error, remove it.
    """
    target = _resolve_target(path)
    # The hidden name isn't derived from the target's name, because a longer name may exceed the file system's limit.
    hidden = os.path.join(os.path.dirname(target), f".talk-{os.urandom(8).hex()}.wav")
    try:
        try:
            open(hidden, "xb").close()  # the umask determines the file's mode
        except OSError as error:
            directory = os.path.dirname(hidden)
            if not os.path.isdir(directory):
                raise CannotWrite(path, f"cannot be written: the directory {directory} does not exist") from error
            raise _convert_os_error(path, error) from error
        yield hidden
        try:
            with open(hidden, "rb") as file:
                os.fsync(file)  # protects the file against power cuts, and makes some file systems report a full disk
            os.replace(hidden, target)
        except OSError as error:
            raise _convert_os_error(path, error) from error
    finally:
        # The hidden file may have been renamed or never created. If it can't be removed, the original error is more
        # useful.
        with contextlib.suppress(OSError):
            os.unlink(hidden)


def _resolve_target(path: str) -> str:
    """Return the path of the file to replace, with links resolved.

    Raises:
        CannotWrite: the path can't be replaced with a file.
    """
    if not path or path.endswith(os.sep) or "\0" in path:
        raise CannotWrite(repr(path), "is not a file name; use one such as speech.wav")
    target = os.path.realpath(path)
    try:
        found = os.stat(path)
    except FileNotFoundError:
        return target
    except OSError as error:
        raise _convert_os_error(path, error) from error
    if stat.S_ISDIR(found.st_mode):
        raise CannotWrite(path, "is a directory; name a file in it")
    # A link in /proc/*/fd may point to a deleted file, which can't be replaced.
    placed = os.path.exists(target) and os.path.samefile(path, target)
    if not stat.S_ISREG(found.st_mode) or not placed or _is_own_output(found):
        raise CannotWrite(path, "is not a file that can be replaced; name another file, such as speech.wav")
    if not os.access(target, os.W_OK):
        raise CannotWrite(path, "cannot be written: it is write-protected")
    return target


def _is_own_output(file_stat: os.stat_result) -> bool:
    """Return whether the file is this process's own standard output or standard error."""
    for descriptor in (1, 2):
        with contextlib.suppress(OSError):  # the descriptor is closed
            if os.path.samestat(file_stat, os.fstat(descriptor)):
                return True
    return False
