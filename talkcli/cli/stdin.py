"""Code that reads standard input for `talk say`, as one text or line by line.

If the input is a single text, it is read up to the maximum length of a text. With --lines, each line becomes a goal,
and all goals are sent over one connection. A single thread reads lines into a `LineBuffer`, sends them until the limit
of pending goals is reached, and follows these goals. The input may never end, so a goal is forgotten once it has been
reported.
"""

from __future__ import annotations

import os
import select
import signal
import time
from collections import deque
from functools import partial

from talkcli.cli.command import replace_bad_bytes
from talkcli.cli.interrupts import Interrupts
from talkcli.cli.show import note, retry_without_output, show_error, show_if_possible, write_error_line
from talkcli.cli.wait import CANCEL_TIMEOUT_S, GoalReporter, seconds_left, timeout_error
from talkcli.client.core import MIN_TTL_S
from talkcli.client.goal import GoalHandle
from talkcli.errors import EXIT_OK, Lost, ServerUnavailable, TalkError, TimedOut, UsageError
from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.goals.goal import Goal
from talkcli.goals.options import MAX_TEXT_BYTES, MAX_TEXT_CHARS, Say, format_number
from talkcli.goals.states import State
from talkcli.polling import Interrupted, wait_ready
from talkcli.protocol.events import Result, unfinished
from talkcli.protocol.lines import LineSplitter, TruncatedLine

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from typing import Any, TypeVar

    from talkcli.cli.show import CommonOptions
    from talkcli.client.client import Client
    from talkcli.client.core import Exchange

    _T = TypeVar("_T")

#: The maximum size of one read, which is the capacity of a pipe.
_STDIN_READ_BYTES = 65_536
#: The maximum size of buffered input if a ttl is set.
_MAX_BUFFERED_BYTES = 1_000_000
#: The default for --ahead, which limits the number of pending goals.
_DEFAULT_PENDING_GOALS = 10
#: The maximum number of started or ended goals that haven't been reported yet.
_MAX_UNREPORTED_GOALS = 1_000
#: The maximum number of expired lines to drop before signals and the server are checked again.
_MAX_EXPIRED_LINES = 1_000
#: The deadline that is used if there is no time limit.
_NO_LIMIT = float("inf")


class InputTooLong(UsageError):
    """Raised if the text on standard input is too long."""


def read_text(deadline: float | None, *, stop_without_reader: bool = False, any_length: bool = False) -> str | int:
    """Read all of standard input as one text. Return the text, or an exit code if interrupted.

    Args:
        deadline: the monotonic time by which the input must have ended, or None for no limit.
        stop_without_reader: whether to stop if the reader of standard output goes away.
        any_length: whether to read a text of any length.

    Returns:
        The text, or the exit code if a signal or a missing reader has ended the reading.

    Raises:
        TimedOut: the input hasn't ended in time.
        InputTooLong: the text is too long. The rest of the input may not have been read.
    """
    data = bytearray()
    with Interrupts(output=stop_without_reader) as interrupts:
        while any_length or len(data) <= MAX_TEXT_BYTES + len("\r\n"):
            if not wait_ready({0: select.POLLIN}, seconds_left(deadline), interrupts.watched):
                raise TimedOut("standard input did not end in time; nothing was sent")
            more = _read_available()
            if more == b"":
                return _decode_text(bytes(data))
            data += more or b""
        raise InputTooLong(
            f"standard input is too long (more than {MAX_TEXT_BYTES:,} bytes; a text has at most {MAX_TEXT_CHARS:,} "
            "characters); to speak it line by line, use: talk say --lines"
        )
    if interrupts.signal_number == signal.SIGINT:
        write_error_line()  # start a new line after the ^C that the terminal has shown
    return interrupts.exit_code


def rejected_goal(problem: str) -> Goal:
    """Return a goal in the state REJECTED for a text that is too long to be sent."""
    return Goal("", State.REJECTED, reason="text_too_long", message=f"not spoken: {problem}")


@frozen
class InputLine:
    """A line of standard input."""

    number: int
    #: the line without its line ending, cut off if it is too long
    text: str
    #: the size of the line in bytes if it is too long to be spoken, otherwise 0
    oversize_bytes: int = 0
    #: the monotonic time at which the line expires
    expires_at: float = _NO_LIMIT


class LineBuffer:
    """A buffer for lines that have been read but not sent."""

    def __init__(self, ttl: float | None = None) -> None:
        """Create an empty buffer.

        Args:
            ttl: seconds after which a line expires, or None for no limit.
        """
        self._ttl = ttl
        # Allow one more byte than the longest text has, because a line may end in CRLF.
        self._splitter = LineSplitter(MAX_TEXT_BYTES + 1)
        #: chunks of input with the times at which they were read; to save memory, they are split into lines late
        self._chunks: deque[tuple[float, bytes]] = deque()
        self._lines: deque[InputLine] = deque()
        self._number = 0
        #: the number of bytes that haven't been split into lines yet
        self.size = 0
        self.ended = False

    def feed(self, data: bytes, now: float) -> None:
        """Add a chunk of input. An empty chunk marks the end of the input."""
        self.ended = not data
        self.size += len(data)
        self._chunks.append((now, data))

    @property
    def first(self) -> InputLine | None:
        """The oldest line that isn't blank, or None."""
        while not self._lines and self._chunks:
            now, data = self._chunks.popleft()
            self.size -= len(data)
            end = now + (self._ttl or _NO_LIMIT)
            for line in self._splitter.feed(data) if data else [self._splitter.take_rest()]:
                self._number += 1
                text, oversize_bytes = _decode_text(line), line.size if isinstance(line, TruncatedLine) else 0
                if oversize_bytes or text.strip():
                    self._lines.append(InputLine(self._number, text, oversize_bytes, end))
        return self._lines[0] if self._lines else None

    def take(self) -> InputLine:
        """Remove and return the first line."""
        return self._lines.popleft()

    def take_expired(self, now: float) -> Iterator[InputLine]:
        """Remove and yield up to 1,000 expired lines.

        The limit lets the caller check for signals.
        """
        for _ in range(_MAX_EXPIRED_LINES):
            if not self.first or self.first.expires_at > now:
                break
            yield self.take()


def _read_available() -> bytes | None:
    """Read available data from standard input. Return b"" at the end of the input.

    Return None if there is no data yet.
    """
    try:
        return os.read(0, _STDIN_READ_BYTES)
    except BlockingIOError:  # another program has made standard input non-blocking
        return None
    except OSError as error:
        raise UsageError(f"can't read standard input: {error.strerror}") from error


def _decode_text(data: bytes) -> str:
    """Decode UTF-8, and remove line breaks at the end."""
    # Invalid bytes are decoded to surrogates, which `replace_bad_bytes` replaces later.
    return data.decode(errors="surrogateescape").rstrip("\r\n")


class InputSpeaker:
    """Base class for commands that speak standard input as it arrives."""

    def __init__(
        self,
        options: CommonOptions,
        name: str | None,
        goal_options: dict[str, Any],
        wait: bool,
        feedback: bool,
        timeout: float | None,
    ) -> None:
        """Initialise the speaker without connecting to the server.

        Args:
            options: the options of every command.
            name: the sender's name.
            goal_options: the options of each goal.
            wait: whether to wait until the goals have ended.
            feedback: whether to show each word as it is heard.
            timeout: seconds for the whole command; None for no limit.
        """
        self._options, self._name, self._goal_options, self._wait = options, name, goal_options, wait
        self._reporter = GoalReporter(options, feedback=feedback)
        self._feedback = self._reporter.feedback
        self._timeout, self._end = timeout, options.deadline(timeout) or _NO_LIMIT
        self._interrupts = Interrupts(output=wait)

    def run(self) -> int:
        """Connect, send the input, and wait for the goals if requested.

        Return the exit code.
        """
        options, interrupts = self._options, self._interrupts
        try:
            with interrupts, options.connect(self._timeout, name=self._name, interrupt=interrupts.watched) as client:
                self._client, self._connection = client, client._connection
                return self._run_connected()
        except (Lost, ServerUnavailable):
            if time.monotonic() >= self._end:
                raise timeout_error(self._timeout) from None
            raise
        finally:
            retry_without_output(self._feedback.close)
        return interrupts.exit_code

    def _run_connected(self) -> int:
        """Send the input over the open connection, and follow its goals.

        Return the exit code.
        """
        raise NotImplementedError

    def _wait_unless_input(self, function: Callable[[], object], *, wants_input: bool) -> bytes | None:
        """Call a function that blocks, and interrupt it if input arrives. Return the input, or None.

        Args:
            function: the function, which waits with `_interrupts.watched`.
            wants_input: whether input interrupts the function.

        Returns:
            the input, which is b"" at its end. None if there was none.

        Raises:
            Interrupted: a signal or closed output has interrupted the function.
        """
        watched = self._interrupts.watched
        if wants_input:
            watched[0] = select.POLLIN
        try:
            function()
        except Interrupted:
            if watched.pop(0, None) is None:
                raise
            wait_ready({}, 0, watched)  # raises Interrupted after a signal, or if output is closed
            return _read_available()
        finally:
            watched.pop(0, None)
        return None

    def _show_events(self, goal: GoalHandle) -> None:
        """Show the goal's new events if --wait is given. Otherwise, discard them."""
        while event := goal.poll():
            if self._wait:
                show_if_possible(self._feedback.show, goal.goal, event)


class LineSpeaker(InputSpeaker):
    """The implementation of `say --lines`, which speaks each line of standard input as a goal."""

    def __init__(self, *given: Any, ahead: int | None) -> None:
        """Initialise the speaker without connecting to the server.

        Args:
            given: the arguments of `InputSpeaker`.
            ahead: how many goals may be pending at once; None for the default.
        """
        super().__init__(*given)
        self._max_pending = ahead or _DEFAULT_PENDING_GOALS
        self._ttl: float | None = self._goal_options["ttl"] or None
        self._buffer = LineBuffer(self._ttl)
        #: the number of the line that is waiting for the server's answer, or None
        self._sending: int | None = None
        #: the goal and its unanswered request, or None
        self._unanswered: tuple[GoalHandle, Exchange] | None = None
        #: goals that haven't ended (or, with --wait, haven't been reported), with their line numbers
        self._goals: deque[tuple[int, GoalHandle]] = deque()
        #: whether the user has been told that speech is paused
        self._pause_known = False
        #: the error that has stopped reading and sending, or None
        self._error: TalkError | None = None
        #: the line number and the exit code of the first failure, or None
        self._failure: tuple[int, int] | None = None

    def _run_connected(self) -> int:
        """Send all lines, and follow their goals. Report errors, and return the exit code."""
        try:
            while not self._done:
                try:
                    self._step()
                except TalkError as error:
                    # A robot's connection has the same time limit, and raises Lost when the limit is reached.
                    if time.monotonic() >= self._end:
                        raise TimeoutError from error
                    if self._error is not None:
                        raise
                    self._error = error
        except (Interrupted, OSError) as error:
            interrupts = self._interrupts
            interrupts.handle_error(error)
            self._stop_early()
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
        """Whether there are no more lines to send and, with --wait, no more goals to follow."""
        if self._wait and self._goals:
            return False
        return self._error is not None or not (self._unanswered or self._has_lines)

    @property
    def _has_lines(self) -> bool:
        """Whether there may be more lines to send."""
        return self._buffer.first is not None or not self._buffer.ended

    @property
    def _full(self) -> bool:
        """Whether the limit of pending or unreported goals has been reached."""
        pending = sum(each.state is State.PENDING for _, each in self._goals)
        # A goal with a key replaces the pending goal with the same key, so the number of pending goals doesn't grow.
        enough = pending >= self._max_pending and self._goal_options["key"] is None
        return enough or len(self._goals) - pending >= _MAX_UNREPORTED_GOALS

    @property
    def _wants_input(self) -> bool:
        """Whether to read more input.

        Without a ttl, input is only read when the next line can be sent.
        """
        if self._buffer.ended or self._error is not None:
            return False
        if self._ttl:
            return self._buffer.size < _MAX_BUFFERED_BYTES
        return not (self._buffer.first or self._unanswered or self._full)

    def _step(self) -> None:
        """Send as many lines as possible. Then wait for input or a message, and process it.

        Raises:
            TimeoutError: the time limit of the command is over.
        """
        if self._error is None:
            now = time.monotonic()
            for line in self._buffer.take_expired(now):
                self._report_expired(line)
            while self._buffer.first and self._buffer.first.expires_at > now and not (self._unanswered or self._full):
                self._send_line(self._buffer.take())
            if self._done:
                return
        if time.monotonic() >= self._end:
            raise TimeoutError
        self._wait_for_news()
        self._process_answer()
        self._report_and_forget_goals()
        if self._connection.ended is not None and self._error is None and self._has_lines:
            path = self._connection.path
            raise ServerUnavailable(f"lost the connection to the server at {path}: {self._connection.ended}")

    # Sending lines

    def _send_line(self, line: InputLine) -> None:
        """Send a line as a goal, without waiting for the answer.

        Report a line that is too long as rejected.
        """
        if line.oversize_bytes:
            words = f"the line has {line.oversize_bytes:,} bytes, but at most {MAX_TEXT_BYTES:,} are allowed"
            self._report_rejected(line.number, rejected_goal(words))
            return
        self._sending = line.number
        text, problem = replace_bad_bytes(line.text, line.number)
        if problem and not self._options.quiet:
            self._feedback.note(problem)
        goal_options = self._goal_options
        if self._ttl:
            goal_options = {**goal_options, "ttl": max(MIN_TTL_S, round(line.expires_at - time.monotonic(), 2))}
        # Follow the goal even without --wait, to find out when it is no longer pending.
        request = Say(text, wait=True, feedback=self._feedback.shows_events, patient=True, **goal_options)
        handle, accepted = self._client._calls._create_handle(GoalHandle, request)
        if handle.state is State.REJECTED:
            self._report_rejected(line.number, handle.goal)
            return
        self._unanswered = handle, self._connection.begin(request, accepted)

    def _process_answer(self) -> None:
        """If the server has answered, report whether it accepted the last sent line.

        Follow an accepted goal.
        """
        if self._unanswered is None or not self._unanswered[1].over:
            return
        (handle, exchange), number = self._unanswered, self._sending or 0
        self._unanswered = None
        reply, _ = self._connection.answer(exchange)
        if handle.state is State.REJECTED:
            self._report_rejected(number, handle.goal)
            return
        self._sending = None
        self._call_writer(self._reporter.show_accepted, handle, self._pause_known)
        self._pause_known = handle.speech_paused
        if not self._wait:  # report the state from the reply, because the goal may have ended in the meantime
            self._call_writer(self._reporter.report, Goal.from_json(reply.get("goal")))
        elif not self._goals:
            self._feedback.begin([handle.goal])
        self._goals.append((number, handle))

    def _report_rejected(self, number: int, goal: Goal) -> None:
        """Report a rejected line, and record the failure."""
        self._sending = None
        self._record_failure(number, self._call_writer(self._reporter.report_refused, goal, f"line {number}: "))

    def _report_expired(self, line: InputLine) -> None:
        """Report a line that expired before it was sent.

        With --wait, also record this as a failure.
        """
        words = f"line {line.number} was not sent: its ttl of {format_number(self._ttl)} s is over"
        goal = Goal("", State.RECALLED, text=line.text, reason="expired", message=words)
        code = self._call_writer(self._reporter.report_refused, goal)
        if self._wait:
            self._record_failure(line.number, code)

    def _record_failure(self, line_number: int, exit_code: int) -> None:
        """Record a failed line's exit code, unless an earlier line has already failed."""
        if exit_code and (self._failure is None or line_number < self._failure[0]):
            self._failure = line_number, exit_code

    def _call_writer(self, write: Callable[..., _T], *given: object) -> _T:
        """Call a function that writes output. Without --wait, ignore a missing reader."""
        return write(*given) if self._wait else retry_without_output(write, *given)

    # Waiting for input and for the server

    def _wait_for_news(self) -> None:
        """Wait for a message from the server or for input, and add the input to the buffer."""
        first = self._buffer.first
        end = min(first.expires_at, self._end) if first and self._error is None else self._end
        was_full = self._full

        def has_news() -> bool:
            if self._unanswered and self._unanswered[1].over:
                return True
            if not self._wait and any(each.state.terminal for _, each in self._goals):
                return True  # if no goals are left, the server sends no more keep-alive messages
            return self._full != was_full or (self._wait and bool(self._goals) and self._goals[0][1]._has_event())

        # The server only sends keep-alive messages if it has goals. Otherwise, measure its silence from the last
        # request.
        since = self._unanswered[1].heard_at if self._unanswered and not self._goals else 0.0
        wait = partial(self._connection.wait_until, has_news, since=since)
        idle = not (self._unanswered or self._goals)
        pause = partial(wait_ready, {}, seconds_left(end), self._interrupts.watched) if idle else partial(wait, end)
        data = self._wait_unless_input(pause, wants_input=self._wants_input)
        if data is not None:
            self._buffer.feed(data, time.monotonic())
            if not idle:  # Even if the input never pauses, the server's messages must be read.
                wait(time.monotonic(), interruptible=False)

    def _report_and_forget_goals(self) -> None:
        """With --wait, report the events and results of the goals. Forget goals that have ended.

        Events are reported in the order of the lines.
        """
        if not self._wait:
            self._goals = deque(each for each in self._goals if not each[1].state.terminal)
            return
        while self._goals:
            number, handle = self._goals[0]
            self._show_events(handle)
            if not handle.state.terminal:
                return
            self._record_failure(number, self._reporter.report(handle.goal))
            self._goals.popleft()
            if self._goals:
                self._feedback.begin([self._goals[0][1].goal])

    # Stopping before the end of the input

    def _stop_early(self) -> None:
        """Report the first unsent line. With --wait, close the connection and cancel the goals first."""
        if self._wait:
            # Close the connection first. Otherwise, a line that is waiting for room in the queue would be accepted when
            # the other goals are cancelled.
            self._client.close()
            self._interrupts.prepare_cleanup()
            self._cancel_goals([each.id for _, each in self._goals if not each.state.terminal])
        self._report_unsent()

    def _cancel_goals(self, ids: list[str]) -> None:
        """Cancel the given goals and this process's other goals. Report how they ended."""
        self._options.urgent = True
        try:
            with self._options.connect(CANCEL_TIMEOUT_S, interrupt=self._interrupts.watched, end=None) as client:
                # The server may have accepted one more goal just before the connection was closed.
                ids = list(dict.fromkeys([*ids, *_own_goal_ids(client)]))
                done = client.cancel(ids)
        except (TalkError, Interrupted) as error:
            self._feedback.note(f"the goals were cancelled, but may still be spoken: {str(error) or 'interrupted'}")
            return
        ended = sorted((*done.ended, *done.canceled), key=lambda each: ids.index(each.id))
        for goal in ended:
            if self._feedback.shows_events:
                retry_without_output(self._feedback.show, goal, Result(goal))
            elif self._options.json or goal.state is not State.RECALLED:
                retry_without_output(self._reporter.report, goal, "", True)
        recalled = sum(each.state is State.RECALLED for each in ended)
        if recalled and not (self._feedback.shows_events or self._options.json or self._options.quiet):
            note(f"removed {recalled} waiting line{'s' * (recalled > 1)} from the queue")

    def _report_unsent(self) -> None:
        """Report the first line that wasn't sent or accepted, if any."""
        if self._options.quiet:
            return
        if self._sending is not None:
            self._feedback.note(
                f"line {self._sending} may not have been accepted, and the lines after it were not sent"
            )
        elif self._buffer.first:
            self._feedback.note(f"line {self._buffer.first.number} and the lines after it were not sent")


def _own_goal_ids(client: Client) -> list[str]:
    """Return the ids of this process's unfinished goals.

    The list is empty if the server is on another machine.
    """
    if client._connection.listener_pid is None:
        return []  # process ids can't be compared with those of another machine
    goals = unfinished(client.status())
    return [each.id for each in goals if each.client is not None and each.client.pid == os.getpid()]
