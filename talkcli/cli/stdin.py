"""`say` from standard input: read as one text, or spoken line by line, each line a goal, over one connection.

One text is read up to the length of the longest text allowed. Lines are handled by one thread: it reads them into a
`LineBuffer`, sends them while few enough of its goals are pending, and sees how its goals end. The input may have no
end, so a goal is forgotten once it was reported.
"""

from __future__ import annotations

import os
import select
import signal
import time
from collections import deque
from functools import partial
from itertools import islice

from talkcli.cli.command import readable
from talkcli.cli.interrupts import Interrupts
from talkcli.cli.show import Feedback, end_line, give_up_output, note, reader_is_gone, show_error
from talkcli.cli.wait import (
    SILENCE,
    feedback_for,
    introduce,
    refuse,
    regardless,
    report,
    rest,
    show_if_possible,
    timed_out,
)
from talkcli.client.connection import BaseConnection
from talkcli.errors import EXIT_OK, ServerUnavailable, TalkError, TimedOut, UnknownGoal, UsageError
from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.goals.goal import Goal
from talkcli.goals.option import figure
from talkcli.goals.options import MAX_BYTES, MAX_CHARACTERS, Say
from talkcli.goals.states import State
from talkcli.polling import Interrupted, wait_ready
from talkcli.protocol.events import Canceled, Result, unfinished
from talkcli.protocol.lines import Cut, LineSplitter

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from typing import Any, TypeVar

    from talkcli.cli.show import Common
    from talkcli.client.client import Client, GoalHandle
    from talkcli.client.connection import Exchange
    from talkcli.goals.goal import JsonObject

    _T = TypeVar("_T")

#: Bytes that are read at once: what a pipe holds.
_CHUNK_BYTES = 65_536
#: Bytes that are read of one text: the longest one, and the end of its line.
_TEXT_BYTES = MAX_BYTES + len("\r\n")
#: Bytes of lines with a ttl that are read before they can be sent.
_AHEAD_BYTES = 1_000_000
#: Goals that may be pending if --ahead says nothing else.
_AHEAD = 10
#: Goals, beside the pending ones, that are kept until they have been reported.
_MAX_UNREPORTED_GOALS = 1_000
#: Lines that are dropped before signals and the server are looked at again.
_DROPPED_AT_ONCE = 1_000
#: The least ttl that is sent: 0 would be no limit.
_LEAST_TTL_S = 0.01


class InputTooLong(Exception):
    """There is more on standard input than one text may have."""


def read_text(end: float | None, *, wait: bool = False, whole: bool = False) -> str | int:
    """Read standard input as one text. If something ends the reading, return the exit code instead.

    Args:
        end: the monotonic time by which the whole text must have been read.
        wait: end the reading, too, if the reader of standard output goes away.
        whole: read a text of any length.

    Raises:
        TimedOut: `end` has come.
        InputTooLong: there is more than the longest text. The rest isn't read.
    """
    with Interrupts(output=wait) as interrupts:
        return _read_text(interrupts.watched, end, whole=whole)
    if interrupts.number == signal.SIGINT:
        end_line()  # the terminal has shown ^C
    return interrupts.exit_code


def _read_text(interrupt: Mapping[int, int], end: float | None, *, whole: bool) -> str:
    data = bytearray()
    while whole or len(data) <= _TEXT_BYTES:
        more = _read(_CHUNK_BYTES if whole else _TEXT_BYTES + 1 - len(data), interrupt, end)
        if not more:
            return _decoded(bytes(data))
        data += more
    raise InputTooLong(
        f"standard input has more than {MAX_BYTES:,} bytes, and a text at most {MAX_CHARACTERS:,} characters: "
        "'talk say --lines' speaks it line by line"
    )


def rejected(words: str) -> Goal:
    """Return the goal that a server would have made of a text that is too long to be sent."""
    return Goal("", State.REJECTED, reason="text_too_long", message=f"Talk rejected: {words}")


@frozen
class Line:
    """A line of standard input."""

    number: int
    #: without the end of the line; the beginning, if the line is too long
    text: str
    #: bytes of a line that is too long to be spoken, else 0
    excess: int = 0
    #: the monotonic time at which its ttl ends; None without a ttl
    end: float | None = None


class LineBuffer:
    """Lines that were read and have not been sent. It has no clock: the time comes in as an argument."""

    def __init__(self, ttl: float | None = None) -> None:
        """`ttl`: seconds from when a line was read; None for no limit."""
        self._ttl = ttl
        # One byte above the longest text: the CR of a line that ends in CRLF.
        self._splitter = LineSplitter(MAX_BYTES + 1)
        #: chunks with the time at which each was read; they are cut late, so that many short lines stay within 1 MB
        self._chunks: deque[tuple[float, bytes]] = deque()
        self._lines: deque[Line] = deque()
        self._number = 0
        #: bytes that have not been cut into lines
        self.size = 0
        self.ended = False

    def feed(self, data: bytes, now: float) -> None:
        """Add a chunk that was read. An empty chunk is the end of the input, and ends the last line."""
        self.ended = not data
        self.size += len(data)
        self._chunks.append((now, data))

    @property
    def first(self) -> Line | None:
        """The oldest line that is not blank."""
        while not self._lines and self._chunks:
            now, data = self._chunks.popleft()
            self.size -= len(data)
            end = now + self._ttl if self._ttl else None
            for line in self._splitter.feed(data) if data else [self._splitter.end()]:
                self._number += 1
                text = _decoded(line)
                if isinstance(line, Cut):
                    self._lines.append(Line(self._number, text, line.size, end))
                elif text.strip():
                    self._lines.append(Line(self._number, text, 0, end))
        return self._lines[0] if self._lines else None

    def take(self) -> Line:
        """Take the first line away."""
        return self._lines.popleft()

    def take_late(self, now: float) -> Iterator[Line]:
        """Take away the lines whose time is over."""
        while (line := self.first) and line.end is not None and line.end <= now:
            yield self.take()


def _read(count: int, interrupt: Mapping[int, int], end: float | None = None) -> bytes:
    """Return what there is of standard input once there is something, at most so many bytes; b"" at its end."""
    while True:
        if not wait_ready({0: select.POLLIN}, rest(end), interrupt):
            raise TimedOut("standard input has not ended within the time: nothing was sent")
        data = _read_now(count)
        if data is not None:
            return data


def _read_now(count: int) -> bytes | None:
    """Return what there is of standard input, at most so many bytes; b"" at its end, None if there is nothing."""
    try:
        return os.read(0, count)
    except BlockingIOError:  # another program has made it so
        return None
    except OSError as error:
        raise UsageError(f"standard input cannot be read: {error.strerror}") from error


def _decoded(data: bytes) -> str:
    # What is not UTF-8 stays recognisable, as in arguments: see `readable`.
    return data.decode(errors="surrogateescape").rstrip("\r\n")


def say_lines(
    options: Common,
    name: str | None,
    chosen: dict[str, Any],
    wait: bool,
    feedback: bool,
    timeout: float | None,
    ahead: int | None,
) -> int:
    """Speak standard input line by line, and return the exit code.

    Args:
        options: the options of every command.
        name: the sender's name.
        chosen: the options of each goal.
        wait: whether to wait until the goals have ended.
        feedback: whether to show each word as it is heard.
        timeout: seconds for all of it; None for no limit.
        ahead: goals that may be pending at once; None for the default.
    """
    shown = feedback_for(options, asked=feedback)
    try:
        with (
            Interrupts(timeout, output=wait) as interrupts,
            options.connect(timeout, name=name, interrupt=interrupts.watched) as client,
        ):
            return _Lines(client, interrupts, options, chosen, wait, shown, ahead or _AHEAD).run()
    finally:
        regardless(shown.close)
    if interrupts.late and interrupts.number is None and not interrupts.gone:
        raise timed_out(timeout)
    return interrupts.exit_code


class _Lines:
    """One run of the command."""

    def __init__(
        self,
        client: Client,
        interrupts: Interrupts,
        options: Common,
        chosen: dict[str, Any],
        wait: bool,
        shown: Feedback,
        ahead: int,
    ) -> None:
        assert isinstance(client._connection, BaseConnection)
        self._client, self._connection = client, client._connection
        self._interrupts = interrupts
        self._options = options
        self._chosen = chosen
        self._wait = wait
        self._shown = shown
        self._ahead = ahead
        self._ttl: float | None = chosen["ttl"] or None
        self._buffer = LineBuffer(self._ttl)
        #: the number of the line that is being sent, until it is accepted or refused
        self._sending: int | None = None
        #: the goal that was sent and has not been answered, with its request
        self._sent: tuple[GoalHandle, Exchange] | None = None
        #: the last goal that was answered, as the server took it
        self._accepted = Goal("", State.PENDING)
        #: goals that have not ended, in the order of their lines; with --wait, until they were told of
        self._goals: deque[tuple[int, GoalHandle]] = deque()
        #: since when there is something to hear from the server (monotonic)
        self._since = 0.0
        self._told_of_pause = False
        #: the error after which nothing more is read or sent
        self._error: TalkError | None = None
        #: the first line that did not succeed, and its exit code
        self._failure: tuple[int, int] | None = None

    def run(self) -> int:
        """Send all lines; with --wait, see them end."""
        try:
            while not self._done:
                try:
                    self._step()
                except TalkError as error:
                    if self._error is not None:
                        raise
                    self._error = error
        except Interrupted:
            self._give_up()
            raise
        except OSError as error:
            if not (self._wait and reader_is_gone(error)):
                raise
            self._interrupts.gone = True
            self._give_up()
            raise Interrupted from None
        code = self._failure[1] if self._failure else EXIT_OK
        if self._error is not None:
            self._shown.close()
            show_error(self._error, json=self._options.json)
            self._tell_of_the_rest()
            return code or self._error.exit_code
        return code

    @property
    def _done(self) -> bool:
        if self._wait and self._goals:
            return False
        return self._error is not None or not (self._sent or self._lines_to_come)

    @property
    def _lines_to_come(self) -> bool:
        return self._buffer.first is not None or not self._buffer.ended

    @property
    def _full(self) -> bool:
        """Whether no line may be sent, because enough goals are pending."""
        pending = sum(each.state is State.PENDING for _, each in self._goals)
        # A line with a key replaces the pending line of that key, so the number stays.
        enough = pending >= self._ahead and self._chosen["key"] is None
        return enough or len(self._goals) - pending >= _MAX_UNREPORTED_GOALS

    @property
    def _reads(self) -> bool:
        """Whether more is read: without a ttl only what can be sent, as a pipe holds the rest as well."""
        if self._buffer.ended or self._error is not None:
            return False
        if self._ttl:
            return self._buffer.size < _AHEAD_BYTES
        return not (self._buffer.first or self._sent or self._full)

    def _step(self) -> None:
        """Send and drop the lines that can be, then wait for more."""
        if self._error is None:
            for line in islice(self._buffer.take_late(time.monotonic()), _DROPPED_AT_ONCE):
                self._drop(line)
            while self._buffer.first and not (self._sent or self._full):
                self._send(self._buffer.take())
            if self._done:
                return
        self._hear()
        self._take_answer()
        self._see_ends()
        if self._connection.ended is not None and self._error is None and self._lines_to_come:
            path = self._connection.path
            raise ServerUnavailable(f"nothing more can be sent to the server at {path}: {self._connection.ended}")

    # -- sending

    def _send(self, line: Line) -> None:
        if line.excess:
            words = f"the line has {line.excess:,} bytes, the longest text allowed has {MAX_BYTES:,}"
            self._refuse(line.number, rejected(words))
            return
        self._sending = line.number
        text, unreadable = readable(line.text, line.number)
        if unreadable and not self._options.quiet:
            self._shown.aside(unreadable)
        chosen = self._chosen
        if line.end is not None:
            chosen = {**chosen, "ttl": max(_LEAST_TTL_S, round(line.end - time.monotonic(), 2))}
        # It is followed without --wait, too: how many goals are pending is known by their states.
        request = Say(text, wait=True, feedback=self._shown.shows, patient=True, **chosen)
        handle, accepted = self._client._handle(request)
        if handle.state is State.REJECTED:
            self._refuse(line.number, handle.goal)
            return
        if not self._goals:
            self._since = time.monotonic()

        def on_reply(reply: JsonObject, items: list[JsonObject]) -> None:
            accepted(reply, items)
            self._accepted = handle.goal  # the handle may hear of the goal's end before this is told

        self._sent = handle, self._connection.begin(request, on_reply)

    def _take_answer(self) -> None:
        """Handle the server's answer to the line that was sent, if it has come or the connection has ended."""
        if self._sent is None or not (self._sent[1].over or self._connection.ended):
            return
        (handle, exchange), number = self._sent, self._sending or 0
        self._sent = None
        self._connection.forget(exchange)
        self._connection.answer(exchange)
        if handle.state is State.REJECTED:
            self._refuse(number, handle.goal)
            return
        self._sending = None
        self._tell(introduce, handle, pause_is_known=self._told_of_pause)
        self._told_of_pause = handle.speech_paused
        if not self._wait:
            self._tell(report, self._accepted)
        elif not self._goals:
            self._shown.begin([handle.goal])
        self._goals.append((number, handle))

    def _refuse(self, number: int, goal: Goal) -> None:
        """Tell of a line that is no goal, and go on."""
        self._sending = None
        self._count(number, self._tell(refuse, goal, where=f"line {number}: "))

    def _drop(self, line: Line) -> None:
        """Tell of a line that can't be sent in time, and go on."""
        words = f"line {line.number} was not sent: its ttl of {figure(self._ttl)} s is over"
        goal = Goal("", State.RECALLED, text=line.text, reason="expired", message=words)
        code = self._tell(refuse, goal)
        if self._wait:
            self._count(line.number, code)

    def _count(self, number: int, code: int) -> None:
        """Count a line's exit code: that of the first line that did not succeed is the command's."""
        if code and (self._failure is None or number < self._failure[0]):
            self._failure = number, code

    def _tell(self, act: Callable[..., _T], goal: Goal | GoalHandle, **how: object) -> _T:
        """Tell of a goal; where its reader is gone, who waits ends as by a signal, and who doesn't goes on without."""
        tell = partial(act, goal, self._options, self._shown, **how)
        return tell() if self._wait else regardless(tell)

    # -- waiting

    def _hear(self) -> None:
        """Wait for more input, an answer, an event of a goal, or the end of a line's ttl."""
        watched = self._interrupts.watched
        first = self._buffer.first
        end = first.end if first and self._error is None else None
        was_full = self._full

        def something() -> bool:
            if self._sent and self._sent[1].over:
                return True
            if not self._wait and any(each.state.terminal for _, each in self._goals):
                return True  # without a goal, the server owes no sign of life
            return self._full != was_full or (self._wait and bool(self._goals) and self._goals[0][1]._has_next())

        hear = partial(self._connection.wait_until, something, since=self._since)
        if self._reads:
            watched[0] = select.POLLIN
        try:
            if self._sent or self._goals:
                hear(end)
            else:
                wait_ready({}, rest(end), watched)
        except Interrupted:
            if watched.pop(0, None) is None:
                raise
            wait_ready({}, 0, watched)  # raises Interrupted again, unless it was the input alone
            data = _read_now(_CHUNK_BYTES)
            if data is not None:
                self._buffer.feed(data, time.monotonic())
            if self._sent or self._goals:  # an input that always has more must not keep the server from being heard
                hear(time.monotonic(), interruptible=False)
        finally:
            watched.pop(0, None)

    def _see_ends(self) -> None:
        """Report the events of the goals in their order, and forget the goals that have ended."""
        if not self._wait:
            self._goals = deque(each for each in self._goals if not each[1].state.terminal)
            return
        while self._goals:
            number, handle = self._goals[0]
            while event := handle.poll():
                show_if_possible(self._shown.show, handle.goal, event)
            if not handle.state.terminal:
                return
            self._count(number, report(handle.goal, self._options, self._shown))
            self._goals.popleft()
            if self._goals:
                self._shown.begin([self._goals[0][1].goal])

    # -- the end before the input's

    def _give_up(self) -> None:
        """End before the input does: by a signal, by the timeout, or because its output has no reader any more."""
        self._interrupts.look()
        if self._interrupts.gone:
            give_up_output()
        if self._wait:
            # Who hangs up takes back the line that waits for room: else it would get that of the goals that end now.
            self._client.close()
            self._interrupts.clear()
            self._cancel([each.id for _, each in self._goals if not each.state.terminal])
        self._tell_of_the_rest()

    def _cancel(self, ids: list[str]) -> None:
        """Cancel what was sent and has not ended, and tell how it ended."""
        try:
            with self._options.connect(SILENCE, interrupt=self._interrupts.watched, urgent=True) as client:
                # With the one that was accepted in the moment in which this command hung up, if there was one.
                ids = list(dict.fromkeys([*ids, *_own(client)]))
                if not ids:
                    return
                ended = _cancelled(client, ids)
        except (TalkError, Interrupted) as error:
            self._shown.aside(f"cancelled, but it is not known whether it is silent: {str(error) or 'interrupted'}")
            return
        for goal in ended:
            if self._shown.shows:
                regardless(self._shown.show, goal, Result(goal))
            elif self._options.json or goal.state is not State.RECALLED:
                regardless(report, goal, self._options, self._shown)
        recalled = sum(each.state is State.RECALLED for each in ended)
        if recalled and not (self._shown.shows or self._options.json or self._options.quiet):
            note(f"{recalled} that waited: recalled")

    def _tell_of_the_rest(self) -> None:
        """Say from which line on nothing was accepted, as far as that is known."""
        if self._options.quiet:
            return
        if self._sending is not None:
            self._shown.aside(f"line {self._sending} may not have been accepted; what follows it was not sent")
        elif self._buffer.first:
            self._shown.aside(f"line {self._buffer.first.number} was not sent, and what follows it was not either")


def _own(client: Client) -> list[str]:
    """Return the ids of all goals of this process that have not ended; none where the server is on another machine."""
    if client._connection.listener is None:
        return []  # what has this number there is another
    going = unfinished(client.status())
    return [each.id for each in going if each.client is not None and each.client.pid == os.getpid()]


def _cancelled(client: Client, ids: list[str]) -> list[Goal]:
    """Cancel these goals, and return them, in this order, as they ended."""
    try:
        done = client.cancel(ids)
    except UnknownGoal as error:
        done = Canceled.from_items(error.items)
    return sorted((*done.ended, *done.canceled), key=lambda each: ids.index(each.id) if each.id in ids else len(ids))
