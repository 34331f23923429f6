"""What all commands share: the options that say how, lines on standard output, notes on standard error, and their end.

Whatever a command raises becomes words on standard error and an exit code. What a goal's end means is not known here.
"""

from __future__ import annotations

import errno
import os
import stat
import sys
import time

from talkcli import __version__, paths
from talkcli.errors import EXIT_ERROR, EXIT_SIGINT, EXIT_SIGPIPE, ServerUnavailable, TalkError, TimedOut, limits
from talkcli.frozen import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from collections.abc import Set as AbstractSet
    from typing import Any, TextIO

    from talkcli.client.client import Client
    from talkcli.client.connect import Begun
    from talkcli.client.connection import Connection
    from talkcli.fleet.broker import Broker
    from talkcli.fleet.desk.crowd import Crowd
    from talkcli.goals.goal import Goal, JsonObject
    from talkcli.protocol.events import Event
    from talkcli.terminal.text import Screen

#: Standard output's descriptor.
OUTPUT = 1
#: What writing says where there is no room, or the disk is broken.
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EIO)
#: Whether there was no room for what was to be shown: a command that went on without ends as one that failed.
_failed = False
#: Columns of a terminal that doesn't say how many it has.
USUAL_WIDTH = 80
#: Stands for a blank at which no line ends.
_NO_BREAK = "\0"


class Common:
    """What every command is given: the options that all have, and what was done before it is carried out."""

    socket: str | None = None
    robot: str | None = None
    insecure = False
    json = False
    quiet = False
    connect_timeout: float | None = None
    #: how far its connection has come already, maybe with its request sent: see `plain`
    begun: Begun | None = None
    #: signals that wait for somebody to take them
    held: Iterable[int] = ()
    #: the options that stand on the command line
    typed: AbstractSet[str] = frozenset()
    #: whether the command finds a place where the server is full
    urgent = False

    def __init__(self, **given: Any) -> None:
        #: when the command began, by the monotonic clock
        self.began = time.monotonic()
        vars(self).update(given)

    def connect(self, timeout: float | None = None, **options: Any) -> Client:
        """Return a client connected to the server; see `SocketConnection` for the options.

        `timeout`: seconds that all may take, and so the longest that an answer is waited for. The command's first
        connection is tried again for `connect_timeout` seconds; TimeoutError if `timeout` is over before that.
        """
        from talkcli.client.client import Client
        from talkcli.client.connect import ANSWER_LIMIT

        began, end = time.monotonic(), None if timeout is None else self.began + timeout
        options = {"patience": min(ANSWER_LIMIT, timeout or ANSWER_LIMIT), "end": end, **options}
        connect_timeout, self.connect_timeout = self.connect_timeout, None
        if connect_timeout is None:
            return Client.over(self._connection(**options))
        waits = connect_timeout if end is None else min(connect_timeout, max(0.0, end - began))
        try:
            return Client.over(self._connection(keep_trying=waits, **options))
        except ServerUnavailable as error:
            now = time.monotonic()
            if now < began + waits:  # it can't be expected to come
                raise
            words = f"waited for {round(waits, 1):g} s: {error.message}"
            if end is not None and now >= end:
                raise TimeoutError(words) from None
            raise ServerUnavailable(words) from None

    def crowd(self, timeout: float | None = None, **options: Any) -> Crowd:
        """Return the robots of a fleet that were named, connected to their broker; the options are `Crowd`'s.

        `timeout`: seconds that all may take, and so the longest that an answer is waited for.
        """
        from talkcli.client.connect import ANSWER_LIMIT
        from talkcli.fleet.desk.selection import Selection

        broker = self.broker()
        from talkcli.fleet.desk.crowd import Crowd

        to = Selection(paths.named_robot(self.robot, self.socket) or "")
        return Crowd(broker, to, patience=min(ANSWER_LIMIT, timeout or ANSWER_LIMIT), **options)

    def broker(self) -> Broker:
        """Return the broker of the fleet; UsageError where that, or what it needs, is not there."""
        from talkcli.fleet.broker import from_environment, need_client

        need_client()
        return from_environment(os.environ, insecure=self.insecure)

    def _connection(self, **options: Any) -> Connection:
        """Return a connection to the server of this machine, or to a robot of a fleet."""
        robot = paths.named_robot(self.robot, self.socket)
        if not robot:
            from talkcli.client.connection import SocketConnection

            return SocketConnection(self.socket, begun=self.begun, **{"urgent": self.urgent, **options})
        broker = self.broker()
        from talkcli.fleet.desk.robot import reach

        options.pop("urgent", None)  # a broker keeps no places for that
        return reach(robot, broker, **options)


def ended(command: Callable[[], object], options: Common) -> int:
    """Run a command, and return its exit code: what it returns, if that is a number, else 0; or that of its error."""
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
        note(f"there is not enough memory for talk: {limits()}")
        return EXIT_ERROR
    except Exception as error:
        given_up = give_up_failed(error)
        if given_up is not None:
            return given_up
        if os.environ.get("TALK_DEBUG"):
            raise
        note(f"a bug in talk {__version__}: {type(error).__name__}: {error} (TALK_DEBUG=1 shows where)")
        return EXIT_ERROR
    return (code if isinstance(code, int) else 0) or (EXIT_ERROR if _failed else 0)


def give_up_output() -> None:
    """Write nothing more to standard output, which takes nothing; not even at the interpreter's end."""
    _discard(OUTPUT)
    if sys.stdout is None:
        sys.stdout = open(OUTPUT, "w", closefd=False, encoding="utf-8")  # noqa: SIM115 - open as long as the process


def _discard(descriptor: int) -> None:
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, descriptor)
    os.close(nowhere)


def reader_is_gone(error: OSError) -> bool:
    """Whether this error is from a standard output that nobody reads any more: a pipe, a terminal that is gone."""
    if error.errno == errno.EIO:  # which a broken disk gives, too
        return stat.S_ISCHR(os.fstat(OUTPUT).st_mode)
    return isinstance(error, BrokenPipeError)


def give_up_failed(error: Exception) -> int | None:
    """Write nothing more to standard output, if this error is from there, and return the exit code for that, or None.

    Where there is no room for what is written, that is told, and the command ends as one that failed.
    """
    global _failed  # noqa: PLW0603 - as standard output is the process's
    if not isinstance(error, OSError):
        return None
    if reader_is_gone(error) or _is_for_reading(error):
        give_up_output()
        return EXIT_SIGPIPE
    if error.errno not in _FULL:
        return None
    _failed = True
    give_up_output()
    note(f"standard output can't be written: {error.strerror}")
    return EXIT_ERROR


def _is_for_reading(error: OSError) -> bool:
    """Whether this error is from a standard output that is open for reading alone."""
    if error.errno != errno.EBADF:
        return False
    import fcntl

    return fcntl.fcntl(OUTPUT, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY


def standard_output() -> TextIO:
    """Return standard output; BrokenPipeError where it is closed."""
    if sys.stdout is None:
        raise BrokenPipeError("standard output is closed")
    return sys.stdout


def show(line: str) -> None:
    """Write a line of data to standard output, at once; BrokenPipeError where that is closed."""
    stream = standard_output()
    stream.write(f"{line}\n")
    stream.flush()


def show_json(message: JsonObject) -> None:
    """Write an object as a line of JSON, in UTF-8 whatever the locale is; BrokenPipeError as `show`.

    On a terminal what isn't plainly visible is escaped, as it is in all that is shown there.
    """
    _write_json(standard_output(), message)


def show_found(options: Common, found: Iterable[JsonObject], lines: Callable[[], Iterable[str]]) -> None:
    """Show what was found: as it is, for programs, or in lines for people."""
    if options.json:
        for each in found:
            show_json(each)
    else:
        for line in lines():
            show(line)


def _write_json(stream: TextIO, message: JsonObject) -> None:
    from talkcli.protocol.lines import encode  # help and completion have nothing to do with JSON

    line = encode(message)
    if stream.isatty():
        from talkcli.terminal.text import printable_json

        line = printable_json(line.decode()[:-1]).encode() + b"\n"
    stream.flush()
    stream.buffer.write(line)
    stream.buffer.flush()


def note(words: str) -> None:
    """Write something for people to standard error, if they are there; a terminal's lines end between two words."""
    lines = f"talk: {words}"
    if sys.stderr is not None and sys.stderr.isatty():
        lines = _folded(lines)
    end_line(lines)


def end_line(words: str = "") -> None:
    """End a line on standard error, with these words; one may have been begun by somebody else, a terminal for one."""
    if sys.stderr is not None:
        # Whoever read it may have gone, and have taken standard output along: what is to be done is done all the same.
        try:
            sys.stderr.write(f"{words}\n")
            sys.stderr.flush()
        except OSError:
            _discard(2)


def columns(stream: TextIO) -> int:
    """Return how many columns a terminal has; 0 where it doesn't say, and of what is none."""
    try:
        return os.get_terminal_size(stream.fileno()).columns
    except OSError:
        return 0


def _folded(text: str) -> str:
    """Return the text in lines that a terminal needs not break."""
    width = columns(sys.stderr) or USUAL_WIDTH
    if all(len(line) <= width for line in text.split("\n")):
        return text
    import re
    import textwrap

    from talkcli.terminal.text import NARROWEST

    fold = textwrap.TextWrapper(
        max(width, NARROWEST), subsequent_indent="      ", break_long_words=False, break_on_hyphens=False
    )
    # A command is not broken: it would be another one where it is copied from the terminal.
    kept = re.sub(r"'[^'\n]*'|: (?:talk|sudo) .*", lambda found: found[0].replace(" ", _NO_BREAK), text)
    return "\n".join(map(fold.fill, kept.split("\n"))).replace(_NO_BREAK, " ")


def show_error(error: TalkError, *, json: bool) -> None:
    """Write an error to standard error."""
    if not json:
        note(error.message)
    elif sys.stderr is not None:
        fields: JsonObject = {"code": error.code, "exit": error.exit_code, "message": error.message}
        try:
            _write_json(sys.stderr, {"error": fields})
        except OSError:
            _discard(2)  # as in `end_line`


class Feedback:
    """Shows what happens to goals: nothing, where that was not asked for. What shows something is in `feedback`."""

    #: whether each event is shown, and so neither ids nor how a goal ended have to be
    shows = False

    def begin(self, goals: Sequence[Goal]) -> None:
        """Show how these goals stand, before their first event."""

    def show(self, goal: Goal, event: Event) -> None:
        """Show an event of this goal's."""

    def aside(self, words: str) -> None:
        """Write a note to standard error."""
        note(words)

    def close(self) -> None:
        """Leave standard output so that something else can be written."""


def colourful() -> bool:
    """Whether standard output takes colour."""
    return sys.stdout.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"


def screen() -> Screen:
    """Return what standard output is at this moment: how wide, if it is a terminal, and whether it takes colour."""
    from talkcli.terminal.text import Screen

    if sys.stdout is None or not sys.stdout.isatty():
        return Screen()
    # The terminal first: a COLUMNS that a shell once exported knows nothing of a window that was resized.
    width = columns(sys.stdout)
    if not width:
        told = os.environ.get("COLUMNS", "")
        width = int(told) if told.isascii() and told.isdecimal() else 0
    return Screen(width or USUAL_WIDTH, colourful())
