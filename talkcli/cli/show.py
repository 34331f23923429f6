"""Code shared by all commands: common options, connections, output and exit codes.

If an error ends a command, the error is reported on standard error and determines the exit code.
"""

from __future__ import annotations

import errno
import os
import stat
import sys
import time

from talkcli import __version__, paths
from talkcli.errors import EXIT_ERROR, EXIT_SIGINT, EXIT_SIGPIPE, ServerUnavailable, TalkError, TimedOut, memory_hint
from talkcli.frozen import TYPE_CHECKING
from talkcli.polling import run_blocking

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from typing import Any, TextIO, TypeVar

    from talkcli.client.client import Client
    from talkcli.client.connect import ConnectionAttempt
    from talkcli.client.connection import Connection
    from talkcli.fleet.broker import Broker
    from talkcli.goals.goal import Goal, JsonObject
    from talkcli.protocol.events import Event
    from talkcli.terminal.text import Screen

    _T = TypeVar("_T")

#: The file descriptor of standard output.
STDOUT_FD = 1
#: Error numbers for a full or broken disk.
_DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EIO)
#: Whether output was lost because of a disk error. The command continues, but its exit code isn't 0.
_output_lost = False
#: The width to assume if a terminal doesn't report its width.
_DEFAULT_COLUMNS = 80
#: Temporarily replaces a space at which a line must not be broken.
_NO_BREAK_SPACE = "\0"


class CommonOptions:
    """The options that all commands have, with methods that open connections."""

    socket: str | None = None
    robot: str | None = None
    insecure = False
    json = False
    quiet = False
    connect_timeout: float | None = None
    #: the connection, if `plain` has opened one. The request may already have been sent.
    early: ConnectionAttempt | None = None
    #: signals that stay blocked until the command can handle them
    blocked_signals: Iterable[int] = ()
    #: the names of the options that were given on the command line
    typed: frozenset[str] = frozenset()
    #: whether the command may connect even if the server has reached its client limit
    urgent = False

    def __init__(self, **given: Any) -> None:
        #: the monotonic time at which the command was started
        self.started_at = time.monotonic()
        vars(self).update(given)

    def deadline(self, timeout: float | None) -> float | None:
        """Convert a timeout to a deadline, counted from the start of the command.

        None means no limit.
        """
        return None if timeout is None else self.started_at + timeout

    def connect(self, timeout: float | None = None, **options: Any) -> Client:
        """Return a client connected to the server or the robot.

        The first call keeps trying for `connect_timeout` seconds.

        Args:
            timeout: time limit in seconds for the whole command, and for each answer from the server.
            options: further arguments of `SocketConnection.open`.

        Raises:
            TimeoutError: no server was found in time. This is only raised if `connect_timeout` is set.
        """
        from talkcli.client.client import Client
        from talkcli.client.connect import ANSWER_LIMIT_S

        began, end = time.monotonic(), self.deadline(timeout)
        options = {"patience_s": min(ANSWER_LIMIT_S, timeout or ANSWER_LIMIT_S), "end": end, **options}
        connect_timeout, self.connect_timeout = self.connect_timeout, None
        seconds = connect_timeout or 0.0
        if end is not None:
            seconds = min(seconds, max(0.0, end - began))
        try:
            return Client.over(self._open_connection(keep_trying_s=seconds, **options))
        except ServerUnavailable as error:
            now = time.monotonic()
            if connect_timeout is None or now < began + seconds:  # retrying wasn't requested or can't help
                raise
            words = f"waited {round(seconds, 1):g} s: {error.message}"
            if end is not None and now >= end:
                raise TimeoutError(words) from None
            raise ServerUnavailable(words) from None

    def broker(self) -> Broker:
        """Return the broker's address and login from the environment variables.

        Raises:
            UsageError: a setting or paho-mqtt is missing.
        """
        from talkcli.fleet.broker import from_environment, require_paho

        require_paho()
        return from_environment(os.environ, insecure=self.insecure)

    def _open_connection(self, **options: Any) -> Connection:
        """Connect to the selected robot, or to the server on this machine."""
        robot = paths.named_robot(self.robot, self.socket)
        if not robot:
            from talkcli.client.connection import SocketConnection

            options = {"attempt": self.early, "urgent": self.urgent, **options}
            return run_blocking(SocketConnection.open(self.socket, **options))
        broker = self.broker()
        from talkcli.fleet.desk.robot import RobotConnection

        return run_blocking(RobotConnection.open(robot, broker, **options))


def run_command(command: Callable[[], object], options: CommonOptions) -> int:
    """Run a command, and report its errors. Return its exit code.

    If the command returns a number, that is its exit code. Any other value means success.
    """
    try:
        code = command()
        if sys.stdout:
            sys.stdout.flush()
    except (TalkError, TimeoutError) as error:
        if isinstance(error, TimeoutError):
            error = TimedOut(str(error))
        show_error(error, json=options.json)
        return error.exit_code
    except KeyboardInterrupt:
        return EXIT_SIGINT
    except MemoryError:
        note(f"not enough memory for talk: {memory_hint()}")
        return EXIT_ERROR
    except Exception as error:
        output_code = handle_output_error(error)
        if output_code is not None:
            return output_code
        if os.environ.get("TALK_DEBUG"):
            raise
        note(f"this is a bug in talk {__version__}: {type(error).__name__}: {error}; for details, set TALK_DEBUG=1")
        return EXIT_ERROR
    return (code if isinstance(code, int) else 0) or (EXIT_ERROR if _output_lost else 0)


def discard_output() -> None:
    """Redirect standard output to /dev/null."""
    _redirect_to_null(STDOUT_FD)
    if sys.stdout is None:
        # This file stays open as long as the process runs.
        sys.stdout = open(STDOUT_FD, "w", closefd=False, encoding="utf-8")  # noqa: SIM115


def _redirect_to_null(descriptor: int) -> None:
    """Make a file descriptor refer to /dev/null."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, descriptor)
    os.close(null)


def reader_is_gone(error: OSError) -> bool:
    """Return whether this error means that the reader of standard output is gone."""
    if error.errno == errno.EIO:  # EIO means a closed terminal or a broken disk
        return stat.S_ISCHR(os.fstat(STDOUT_FD).st_mode)
    return isinstance(error, BrokenPipeError)


def handle_output_error(error: Exception) -> int | None:
    """Discard the output if an error shows that writing has failed. Return the exit code, or None for other errors.

    A full or broken disk is reported.
    """
    global _output_lost  # noqa: PLW0603 - a process has only one standard output
    if not isinstance(error, OSError):
        return None
    if reader_is_gone(error) or _is_read_only(error):
        discard_output()
        return EXIT_SIGPIPE
    if error.errno not in _DISK_ERRORS:
        return None
    _output_lost = True
    discard_output()
    note(f"can't write to standard output: {error.strerror}")
    return EXIT_ERROR


def _is_read_only(error: OSError) -> bool:
    """Return whether this error means that standard output is read-only."""
    if error.errno != errno.EBADF:
        return False
    import fcntl

    return fcntl.fcntl(STDOUT_FD, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY


def show_if_possible(write: Callable[..., None], *given: object) -> None:
    """Call a function that writes output. Continue if the disk is full or broken.

    A full or broken disk is reported.

    Raises:
        OSError: the reader of the output is gone.
    """
    try:
        write(*given)
    except OSError as error:
        if reader_is_gone(error) or handle_output_error(error) is None:
            raise


def retry_without_output(write: Callable[..., _T], *given: Any) -> _T:
    """Call a function. If nothing reads its output, discard the output and call the function again."""
    try:
        return write(*given)
    except OSError as error:
        if not reader_is_gone(error):
            raise
        discard_output()
        return write(*given)


def standard_output() -> TextIO:
    """Return `sys.stdout`. Raise BrokenPipeError if it is closed."""
    if sys.stdout is None:
        raise BrokenPipeError("standard output is closed")
    return sys.stdout


def show(line: str) -> None:
    """Write a line to standard output, and flush it.

    Raises:
        BrokenPipeError: standard output is closed.
    """
    stream = standard_output()
    stream.write(f"{line}\n")
    stream.flush()


def show_json(message: JsonObject) -> None:
    """Write an object to standard output as one line of JSON.

    The encoding is always UTF-8, regardless of the locale. On a terminal, invisible characters are escaped.

    Raises:
        BrokenPipeError: standard output is closed.
    """
    _write_json(standard_output(), message)


def show_result(options: CommonOptions, items: Iterable[JsonObject], lines: Callable[[], Iterable[str]]) -> None:
    """With --json, print `items` as JSON objects. Otherwise, print the lines that `lines` returns."""
    if options.json:
        for item in items:
            show_json(item)
    else:
        for line in lines():
            show(line)


def _write_json(stream: TextIO, message: JsonObject) -> None:
    """Write an object to a stream as one line of JSON.

    On a terminal, escape invisible characters.
    """
    from talkcli.protocol.lines import encode  # imported late, because help and completion don't need JSON

    line = encode(message)
    if stream.isatty():
        from talkcli.terminal.text import printable_json

        line = printable_json(line.decode()[:-1]).encode() + b"\n"
    stream.flush()
    stream.buffer.write(line)
    stream.buffer.flush()


def note(message: str) -> None:
    """Write a message to standard error, starting with `talk:`.

    On a terminal, wrap long lines.
    """
    lines = f"talk: {message}"
    if sys.stderr is not None and sys.stderr.isatty():
        lines = _wrap(lines)
    write_error_line(lines)


def write_error_line(line: str = "") -> None:
    """Write a line to standard error if it is open.

    If this fails, discard all further messages.
    """
    if sys.stderr is not None:
        # The command must continue even if nothing reads its messages.
        try:
            sys.stderr.write(f"{line}\n")
            sys.stderr.flush()
        except OSError:
            _redirect_to_null(2)


def terminal_columns(stream: TextIO) -> int:
    """Return the width of a terminal in columns, or a default if it is unknown.

    The default is COLUMNS or 80.
    """
    try:
        columns = os.get_terminal_size(stream.fileno()).columns
    except OSError:
        columns = 0
    # COLUMNS is only a fallback, because it may be outdated after the window has been resized.
    named = os.environ.get("COLUMNS", "")
    return columns or (int(named) if named.isascii() and named.isdecimal() else 0) or _DEFAULT_COLUMNS


def _wrap(text: str) -> str:
    """Wrap a message to the width of the terminal, but keep each command on one line."""
    columns = terminal_columns(sys.stderr)
    if all(len(line) <= columns for line in text.split("\n")):
        return text
    import re
    import textwrap

    from talkcli.terminal.text import MIN_COLUMNS

    wrapper = textwrap.TextWrapper(
        max(columns, MIN_COLUMNS), subsequent_indent="      ", break_long_words=False, break_on_hyphens=False
    )
    # Don't break commands, so that they can be copied from the terminal.
    kept = re.sub(r"'[^'\n]*'|: (?:talk|sudo) .*", lambda found: found[0].replace(" ", _NO_BREAK_SPACE), text)
    return "\n".join(map(wrapper.fill, kept.split("\n"))).replace(_NO_BREAK_SPACE, " ")


def show_error(error: TalkError, *, json: bool) -> None:
    """Write an error to standard error, as a JSON object or as a message."""
    if not json:
        note(error.message)
    elif sys.stderr is not None:
        fields: JsonObject = {"code": error.code, "exit": error.exit_code, "message": error.message}
        try:
            _write_json(sys.stderr, {"error": fields})
        except OSError:
            _redirect_to_null(2)  # continue without messages, as in `write_error_line`


class Feedback:
    """A display that shows no events. It is the base class of the displays in `feedback`."""

    #: whether the display shows events; if so, the command itself doesn't print ids and results
    shows_events = False

    def begin(self, goals: Sequence[Goal]) -> None:
        """Show the initial state of these goals. The base class shows nothing."""

    def show(self, goal: Goal, event: Event) -> None:
        """Show an event of this goal. The base class shows nothing."""

    def note(self, message: str) -> None:
        """Write a message to standard error without disturbing the display."""
        note(message)

    def close(self) -> None:
        """Close the display, so that other output can be written.

        In the base class, there is nothing to do.
        """


def has_colour() -> bool:
    """Return whether colours may be used on standard output."""
    return sys.stdout.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"


def screen(*, long: bool = False, boot: str = "") -> Screen:
    """Return a Screen with the width and colours of standard output."""
    from talkcli.terminal.text import Screen

    if sys.stdout is None or not sys.stdout.isatty():
        return Screen(long=long, boot=boot)
    return Screen(terminal_columns(sys.stdout), has_colour(), long, boot)
