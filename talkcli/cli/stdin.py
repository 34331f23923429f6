"""`talk say` from standard input, as one text or line by line.

A text is read up to the length of the longest text allowed. With --lines each line becomes a goal, and all goals are
sent over one connection. One thread reads lines into a `LineBuffer`, sends them while few of its goals are pending, and
follows these goals. The input may never end, so a goal is forgotten once it has been reported.
"""

from __future__ import annotations

import os
import select
import signal
import time
from collections import deque
from functools import partial
from itertools import islice

from talkcli.cli.command import replace_bad_bytes
from talkcli.cli.interrupts import Interrupts
from talkcli.cli.show import note, retry_without_output, show_error, show_if_possible, write_error_line
from talkcli.cli.wait import CANCEL_TIMEOUT_S, GoalReporter, seconds_left, timeout_error
from talkcli.errors import EXIT_OK, ServerUnavailable, TalkError, TimedOut, UnknownGoal, UsageError
from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.goals.goal import Goal
from talkcli.goals.options import MAX_TEXT_BYTES, MAX_TEXT_CHARS, Say, format_number
from talkcli.goals.states import State
from talkcli.polling import Interrupted, wait_ready
from talkcli.protocol.events import Canceled, Result, unfinished
from talkcli.protocol.lines import LineSplitter, TruncatedLine

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from typing import Any, TypeVar

    from talkcli.cli.show import CommonOptions
    from talkcli.client.client import Client, GoalHandle
    from talkcli.client.core import Exchange

    _T = TypeVar("_T")

#: The size of one read: the capacity of a pipe.
_STDIN_READ_BYTES = 65_536
#: The size of the longest text and its line ending.
_MAX_STDIN_TEXT_BYTES = MAX_TEXT_BYTES + len("\r\n")
#: How much input with a ttl is read before it can be sent.
_MAX_BUFFERED_BYTES = 1_000_000
#: How many goals may be pending without --ahead.
_DEFAULT_PENDING_GOALS = 10
#: How many goals that are no longer pending are kept until they have been reported.
_MAX_UNREPORTED_GOALS = 1_000
#: How many late lines are dropped before signals and the server are looked at again.
_MAX_DROPPED_LINES = 1_000
#: Stands for the end of an unlimited time.
_NO_LIMIT = float("inf")
#: The shortest ttl that is sent, because 0 would mean no limit.
_MIN_TTL_S = 0.01


class InputTooLong(Exception):
    """Standard input is longer than the longest text allowed."""


def read_text(end: float | None, *, wait: bool = False, whole: bool = False) -> str | int:
    """Read standard input as one text. If a signal or a missing reader ends the reading, return the exit code instead.

    Args:
        end: the monotonic time by which the whole text must have been read.
        wait: end the reading, too, if the reader of standard output goes away.
        whole: read a text of any length.

    Raises:
        TimedOut: `end` has come.
        InputTooLong: the text is too long. The rest isn't read.
    """
    data = bytearray()
    with Interrupts(output=wait) as interrupts:
        while whole or len(data) <= _MAX_STDIN_TEXT_BYTES:
            if not wait_ready({0: select.POLLIN}, seconds_left(end), interrupts.watched):
                raise TimedOut("standard input has not ended within the time: nothing was sent")
            more = _read_available(_STDIN_READ_BYTES if whole else _MAX_STDIN_TEXT_BYTES + 1 - len(data))
            if more == b"":
                return _decode(bytes(data))
            data += more or b""
        raise InputTooLong(
            f"standard input has more than {MAX_TEXT_BYTES:,} bytes, and a text at most {MAX_TEXT_CHARS:,} characters: "
            "'talk say --lines' speaks it line by line"
        )
    if interrupts.signal_number == signal.SIGINT:
        write_error_line()  # the terminal has shown ^C on the current line
    return interrupts.exit_code


def rejected_goal(words: str) -> Goal:
    """Return the goal that a server would have made of a text that is too long to be sent."""
    return Goal("", State.REJECTED, reason="text_too_long", message=f"Talk rejected: {words}")


@frozen
class InputLine:
    """A line of standard input."""

    number: int
    #: without the end of the line; only the beginning of a line that is too long
    text: str
    #: the size in bytes of a line that is too long to be spoken; 0 for any other line
    oversize_bytes: int = 0
    #: the monotonic time at which its ttl ends
    end: float = _NO_LIMIT


class LineBuffer:
    """Lines that were read and have not been sent. The caller passes the time."""

    def __init__(self, ttl: float | None = None) -> None:
        """`ttl`: seconds from when a line was read; None for no limit."""
        self._ttl = ttl
        # One more byte than the longest text, because a line may end in CRLF.
        self._splitter = LineSplitter(MAX_TEXT_BYTES + 1)
        #: chunks that are not split yet, with the time at which each was read; many short lines would take more memory
        self._chunks: deque[tuple[float, bytes]] = deque()
        self._lines: deque[InputLine] = deque()
        self._number = 0
        #: the number of bytes that have not been split into lines
        self.size = 0
        self.ended = False

    def feed(self, data: bytes, now: float) -> None:
        """Add a chunk of input. An empty chunk is the end of the input, and ends the last line."""
        self.ended = not data
        self.size += len(data)
        self._chunks.append((now, data))

    @property
    def first(self) -> InputLine | None:
        """The oldest line that is not blank."""
        while not self._lines and self._chunks:
            now, data = self._chunks.popleft()
            self.size -= len(data)
            end = now + (self._ttl or _NO_LIMIT)
            for line in self._splitter.feed(data) if data else [self._splitter.take_rest()]:
                self._number += 1
                text, oversize_bytes = _decode(line), line.size if isinstance(line, TruncatedLine) else 0
                if oversize_bytes or text.strip():
                    self._lines.append(InputLine(self._number, text, oversize_bytes, end))
        return self._lines[0] if self._lines else None

    def take(self) -> InputLine:
        """Remove the first line."""
        return self._lines.popleft()

    def take_late(self, now: float) -> Iterator[InputLine]:
        """Remove the lines whose ttl is over."""
        while (line := self.first) and line.end <= now:
            yield self.take()


def _read_available(count: int) -> bytes | None:
    """Return up to `count` bytes of standard input; b"" at its end, None if there are none at the moment."""
    try:
        return os.read(0, count)
    except BlockingIOError:  # another program has made it non-blocking
        return None
    except OSError as error:
        raise UsageError(f"standard input cannot be read: {error.strerror}") from error


def _decode(data: bytes) -> str:
    # Bytes that aren't UTF-8 stay recognisable, as in arguments. See `replace_bad_bytes`.
    return data.decode(errors="surrogateescape").rstrip("\r\n")


class LineSpeaker:
    """One run of `say --lines`, which sends the lines of standard input as goals and follows these goals."""

    def __init__(
        self,
        options: CommonOptions,
        name: str | None,
        goal_options: dict[str, Any],
        wait: bool,
        feedback: bool,
        timeout: float | None,
        ahead: int | None,
    ) -> None:
        """Prepare the run.

        Args:
            options: the options of every command.
            name: the sender's name.
            goal_options: the options of each goal.
            wait: whether to wait until the goals have ended.
            feedback: whether to show each word as it is heard.
            timeout: seconds for the whole command; None for no limit.
            ahead: how many goals may be pending at once; None for the default.
        """
        self._options = options
        self._name = name
        self._goal_options = goal_options
        self._wait = wait
        self._reporter = GoalReporter(options, feedback=feedback)
        self._feedback = self._reporter.feedback
        self._timeout, self._end = timeout, options.deadline(timeout) or _NO_LIMIT
        self._max_pending = ahead or _DEFAULT_PENDING_GOALS
        self._ttl: float | None = goal_options["ttl"] or None
        self._buffer = LineBuffer(self._ttl)
        self._interrupts = Interrupts(output=wait)
        #: the number of the line that is being sent, until it is accepted or refused
        self._sending: int | None = None
        #: the goal that was sent and has not been answered yet, with its request
        self._unanswered: tuple[GoalHandle, Exchange] | None = None
        #: the goals that have not ended, with their line numbers, in the order of the lines; with --wait also the ended
        #: goals that have not been reported
        self._goals: deque[tuple[int, GoalHandle]] = deque()
        #: whether a note has already said that speech is paused
        self._pause_known = False
        #: the error after which nothing more is read or sent
        self._error: TalkError | None = None
        #: the number and the exit code of the first line that did not succeed
        self._failure: tuple[int, int] | None = None

    def run(self) -> int:
        """Send all lines, and return the exit code. With --wait, also wait until the goals have ended."""
        interrupts = self._interrupts
        try:
            with (
                interrupts,
                self._options.connect(self._timeout, name=self._name, interrupt=interrupts.watched) as client,
            ):
                self._client, self._connection = client, client._connection
                return self._speak()
        except ServerUnavailable:
            if time.monotonic() >= self._end:
                raise timeout_error(self._timeout) from None
            raise
        finally:
            retry_without_output(self._feedback.close)
        return interrupts.exit_code

    def _speak(self) -> int:
        try:
            while not self._done:
                try:
                    self._step()
                except TalkError as error:
                    if self._error is not None:
                        raise
                    self._error = error
        except (Interrupted, OSError) as error:
            interrupts = self._interrupts
            interrupts.record(error)
            self._stop()
            if interrupts.signal_number is None and not interrupts.reader_gone:
                raise timeout_error(self._timeout) from None
            return interrupts.exit_code
        code = self._failure[1] if self._failure else EXIT_OK
        if self._error is not None:
            self._feedback.close()
            show_error(self._error, json=self._options.json)
            self._report_unsent()
            return code or self._error.exit_code
        return code

    @property
    def _done(self) -> bool:
        """Whether nothing is left to send or, with --wait, to wait for."""
        if self._wait and self._goals:
            return False
        return self._error is not None or not (self._unanswered or self._has_lines)

    @property
    def _has_lines(self) -> bool:
        """Whether there are lines to send, or there may be later."""
        return self._buffer.first is not None or not self._buffer.ended

    @property
    def _full(self) -> bool:
        """Whether enough goals are pending, so that no line may be sent."""
        pending = sum(each.state is State.PENDING for _, each in self._goals)
        # A line with a key replaces the pending line of that key, so their number stays the same.
        enough = pending >= self._max_pending and self._goal_options["key"] is None
        return enough or len(self._goals) - pending >= _MAX_UNREPORTED_GOALS

    @property
    def _wants_input(self) -> bool:
        """Whether to read more input. Without a ttl, input stays in the pipe until its first line can be sent."""
        if self._buffer.ended or self._error is not None:
            return False
        if self._ttl:
            return self._buffer.size < _MAX_BUFFERED_BYTES
        return not (self._buffer.first or self._unanswered or self._full)

    def _step(self) -> None:
        """Send and drop lines as far as possible, then wait for more; TimeoutError if the timeout is over."""
        if self._error is None:
            for line in islice(self._buffer.take_late(time.monotonic()), _MAX_DROPPED_LINES):
                self._report_expired(line)
            while self._buffer.first and not (self._unanswered or self._full):
                self._send(self._buffer.take())
            if self._done:
                return
        if time.monotonic() >= self._end:
            raise TimeoutError
        self._wait_for_news()
        self._take_answer()
        self._report_goals()
        if self._connection.ended is not None and self._error is None and self._has_lines:
            path = self._connection.path
            raise ServerUnavailable(f"nothing more can be sent to the server at {path}: {self._connection.ended}")

    # -- sending

    def _send(self, line: InputLine) -> None:
        if line.oversize_bytes:
            words = f"the line has {line.oversize_bytes:,} bytes, the longest text allowed has {MAX_TEXT_BYTES:,}"
            self._report_refused(line.number, rejected_goal(words))
            return
        self._sending = line.number
        text, problem = replace_bad_bytes(line.text, line.number)
        if problem and not self._options.quiet:
            self._feedback.note(problem)
        goal_options = self._goal_options
        if self._ttl:
            goal_options = {**goal_options, "ttl": max(_MIN_TTL_S, round(line.end - time.monotonic(), 2))}
        # The goal is followed even without --wait, because its state shows when it is no longer pending.
        request = Say(text, wait=True, feedback=self._feedback.shows_events, patient=True, **goal_options)
        handle, accepted = self._client._handle(request)
        if handle.state is State.REJECTED:
            self._report_refused(line.number, handle.goal)
            return
        self._unanswered = handle, self._connection.begin(request, accepted)

    def _take_answer(self) -> None:
        """Handle the server's answer to the last line if it has come or the connection has ended."""
        if self._unanswered is None or not (self._unanswered[1].over or self._connection.ended):
            return
        (handle, exchange), number = self._unanswered, self._sending or 0
        self._unanswered = None
        self._connection.forget(exchange)
        reply, _ = self._connection.answer(exchange)
        if handle.state is State.REJECTED:
            self._report_refused(number, handle.goal)
            return
        self._sending = None
        self._show(self._reporter.show_accepted, handle, self._pause_known)
        self._pause_known = handle.speech_paused
        if not self._wait:  # the goal in the handle may have ended since the reply
            self._show(self._reporter.report, Goal.from_json(reply.get("goal")))
        elif not self._goals:
            self._feedback.begin([handle.goal])
        self._goals.append((number, handle))

    def _report_refused(self, number: int, goal: Goal) -> None:
        """Report a line that was rejected."""
        self._sending = None
        self._count_failure(number, self._show(self._reporter.report_refused, goal, f"line {number}: "))

    def _report_expired(self, line: InputLine) -> None:
        """Report a line that was not sent within its ttl."""
        words = f"line {line.number} was not sent: its ttl of {format_number(self._ttl)} s is over"
        goal = Goal("", State.RECALLED, text=line.text, reason="expired", message=words)
        code = self._show(self._reporter.report_refused, goal)
        if self._wait:
            self._count_failure(line.number, code)

    def _count_failure(self, number: int, code: int) -> None:
        """Keep the exit code of the first line that did not succeed."""
        if code and (self._failure is None or number < self._failure[0]):
            self._failure = number, code

    def _show(self, act: Callable[..., _T], *given: object) -> _T:
        """Call a function that shows something. Without --wait, go on if the reader of the output is gone."""
        return act(*given) if self._wait else retry_without_output(act, *given)

    # -- waiting

    def _wait_for_news(self) -> None:
        """Wait for input, an answer, an event of a goal, or the end of a line's ttl or of the timeout."""
        watched = self._interrupts.watched
        first = self._buffer.first
        end = min(first.end, self._end) if first and self._error is None else self._end
        was_full = self._full

        def has_news() -> bool:
            if self._unanswered and self._unanswered[1].over:
                return True
            if not self._wait and any(each.state.terminal for _, each in self._goals):
                return True  # without a goal, the server sends no signs of life
            return self._full != was_full or (self._wait and bool(self._goals) and self._goals[0][1]._has_event())

        # While it has goals, the server sends signs of life. Without goals, its silence counts from the request.
        since = self._unanswered[1].heard_at if self._unanswered and not self._goals else 0.0
        wait = partial(self._connection.wait_until, has_news, since=since)
        if self._wants_input:
            watched[0] = select.POLLIN
        try:
            if self._unanswered or self._goals:
                wait(end)
            else:
                wait_ready({}, seconds_left(end), watched)
        except Interrupted:
            if watched.pop(0, None) is None:
                raise
            wait_ready({}, 0, watched)  # raises Interrupted again if there was more than input
            data = _read_available(_STDIN_READ_BYTES)
            if data is not None:
                self._buffer.feed(data, time.monotonic())
            if self._unanswered or self._goals:  # the server must be read even if the input never pauses
                wait(time.monotonic(), interruptible=False)
        finally:
            watched.pop(0, None)

    def _report_goals(self) -> None:
        """Report the goals' events in the order of the lines, and forget the goals that have ended."""
        if not self._wait:
            self._goals = deque(each for each in self._goals if not each[1].state.terminal)
            return
        while self._goals:
            number, handle = self._goals[0]
            while event := handle.poll():
                show_if_possible(self._feedback.show, handle.goal, event)
            if not handle.state.terminal:
                return
            self._count_failure(number, self._reporter.report(handle.goal))
            self._goals.popleft()
            if self._goals:
                self._feedback.begin([self._goals[0][1].goal])

    # -- stopping before the end of the input

    def _stop(self) -> None:
        """Stop before the end of the input. With --wait, cancel all goals."""
        if self._wait:
            # Closing the connection also takes back a line that waits for room in the queue. Otherwise it would be
            # accepted when the goals are cancelled.
            self._client.close()
            self._interrupts.reset()
            self._cancel([each.id for _, each in self._goals if not each.state.terminal])
        self._report_unsent()

    def _cancel(self, ids: list[str]) -> None:
        """Cancel these goals, and report how they ended."""
        self._options.urgent = True
        try:
            with self._options.connect(CANCEL_TIMEOUT_S, interrupt=self._interrupts.watched) as client:
                # The server may have accepted one more goal just before the connection was closed.
                ended = _cancel_goals(client, list(dict.fromkeys([*ids, *_own_goals(client)])))
        except (TalkError, Interrupted) as error:
            self._feedback.note(f"cancelled, but it is not known whether it is silent: {str(error) or 'interrupted'}")
            return
        for goal in ended:
            if self._feedback.shows_events:
                retry_without_output(self._feedback.show, goal, Result(goal))
            elif self._options.json or goal.state is not State.RECALLED:
                retry_without_output(self._reporter.report, goal)
        recalled = sum(each.state is State.RECALLED for each in ended)
        if recalled and not (self._feedback.shows_events or self._options.json or self._options.quiet):
            note(f"{recalled} that waited: recalled")

    def _report_unsent(self) -> None:
        """Write a note about the first line that was not accepted, if there is one."""
        if self._options.quiet:
            return
        if self._sending is not None:
            self._feedback.note(f"line {self._sending} may not have been accepted; what follows it was not sent")
        elif self._buffer.first:
            self._feedback.note(f"line {self._buffer.first.number} was not sent, and what follows it was not either")


def _own_goals(client: Client) -> list[str]:
    """Return the ids of all unfinished goals of this process; none if the server is on another machine."""
    if client._connection.listener is None:
        return []  # process ids of another machine mean nothing here
    goals = unfinished(client.status())
    return [each.id for each in goals if each.client is not None and each.client.pid == os.getpid()]


def _cancel_goals(client: Client, ids: list[str]) -> list[Goal]:
    """Cancel these goals, and return them as they ended, in the order of their ids."""
    try:
        done = client.cancel(ids)
    except UnknownGoal as error:
        done = Canceled.from_items(error.items)
    return sorted((*done.ended, *done.canceled), key=lambda each: ids.index(each.id))
