"""Code for `talk say --stream`, which speaks standard input while it arrives.

One thread reads the input, sends it, and follows the goal. While the server holds back its reply, because much of the
text has not been heard, no input is read, so that the program that writes it waits, too.
"""

from __future__ import annotations

import codecs
import select
import time

from talkcli.cli.command import replace_bad_bytes
from talkcli.cli.interrupts import Interrupts
from talkcli.cli.show import retry_without_output, show_if_possible
from talkcli.cli.stdin import read_available
from talkcli.cli.wait import GoalReporter, seconds_left, timeout_error, wait_for_goal
from talkcli.errors import EXIT_OK, Lost, ServerUnavailable, TalkError
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.options import Say
from talkcli.goals.states import State
from talkcli.polling import Interrupted, wait_ready

if TYPE_CHECKING:
    from typing import Any

    from talkcli.cli.show import CommonOptions
    from talkcli.client.client import Client, GoalHandle
    from talkcli.client.core import Exchange

#: Line breaks at the end of the input are not part of the text. This is how many of them are held back until more
#: text arrives.
_MAX_HELD_LINE_BREAKS = 100


class InputDecoder:
    """Decodes standard input piece by piece into the same text as `talk say -`."""

    def __init__(self) -> None:
        self._decoder = codecs.getincrementaldecoder("utf-8")("surrogateescape")
        #: the text so far, without the line breaks that are held back
        self._text = ""
        self._line_breaks = ""
        #: the message about the first invalid bytes, or None if there were none
        self.problem: str | None = None

    def decode(self, data: bytes) -> str:
        """Return the text that follows from the next bytes. Empty bytes mark the end of the input."""
        text = self._text + self._line_breaks + self._decoder.decode(data, final=not data)
        added = text[len(self._text) :]
        try:
            added.encode()
        except UnicodeEncodeError:
            text, problem = replace_bad_bytes(text)
            self.problem = self.problem or problem
        end = len(text.rstrip("\r\n"))
        if data and len(text) - end > _MAX_HELD_LINE_BREAKS:
            end = len(text)
        added, self._line_breaks = text[len(self._text) : end], text[end:]
        self._text += added
        return added


class StreamSpeaker:
    """Speaks standard input as one goal, whose text grows."""

    def __init__(
        self,
        options: CommonOptions,
        name: str | None,
        goal_options: dict[str, Any],
        wait: bool,
        feedback: bool,
        timeout: float | None,
        stall: float,
    ) -> None:
        """Initialise the speaker without connecting to the server.

        Args:
            options: the options of every command.
            name: the sender's name.
            goal_options: the options of the goal.
            wait: whether to wait until the goal has ended.
            feedback: whether to show each word as it is heard.
            timeout: seconds for the whole command; None for no limit.
            stall: seconds for which the goal waits for more text after all of it was spoken.
        """
        self._options, self._name, self._goal_options = options, name, {**goal_options, "stall": stall}
        self._wait, self._timeout, self._end = wait, timeout, options.deadline(timeout)
        self._reporter = GoalReporter(options, feedback=feedback)
        self._interrupts = Interrupts(output=wait)
        self._decoder = InputDecoder()
        self._input_ended = False
        #: the request that has not been answered, or None
        self._exchange: Exchange | None = None

    def run(self) -> int:
        """Connect, send the input and, with --wait, wait until the goal has ended. Return the exit code."""
        interrupts = self._interrupts
        try:
            with (
                interrupts,
                self._options.connect(self._timeout, name=self._name, interrupt=interrupts.watched) as client,
            ):
                return self._run_connected(client)
        except (Lost, ServerUnavailable) as error:
            if seconds_left(self._end) == 0:
                raise timeout_error(self._timeout, error.message) from error
            raise
        finally:
            retry_without_output(self._reporter.feedback.close)
        return interrupts.exit_code

    def _run_connected(self, client: Client) -> int:
        """Wait for the first text, send the goal and the rest of the input, and return the exit code."""
        interrupts, reporter = self._interrupts, self._reporter
        self._connection = client._connection
        self._speech = client.stream(feedback=reporter.feedback.shows_events, **self._goal_options)
        while not (request := self._speech._text.next_request()):
            if not wait_ready({0: select.POLLIN}, seconds_left(self._end), interrupts.watched):
                raise timeout_error(self._timeout, "nothing was sent")
            self._read_input()
        assert isinstance(request, Say)
        self._speech._begin_goal(request)
        goal = self._speech.goal
        assert goal
        if goal.state is State.REJECTED:
            return retry_without_output(reporter.report_refused, goal.goal)
        if self._wait:
            return wait_for_goal(goal, interrupts, self._timeout, self._options, reporter, self._follow)
        retry_without_output(reporter.show_accepted, goal)
        self._follow(goal)
        code = retry_without_output(reporter.report, goal.goal)
        return code if goal.state.terminal else EXIT_OK

    def _follow(self, goal: GoalHandle) -> None:
        """Send the input as it arrives until it ends. With --wait, also show the goal's events until the goal ends.

        Raises:
            TimeoutError: the goal has not ended in time.
            RequestRefused: the server refused a part of the text.
            Interrupted: a signal or closed output ends the wait.
        """
        self._reporter.feedback.begin([goal.goal])
        while not goal.state.terminal and (self._wait or not self._speech._text.finished):
            if self._end is not None and time.monotonic() >= self._end:
                raise TimeoutError
            if self._exchange is None and not self._speech._stopped:
                request = self._speech._text.next_request()
                self._exchange = self._connection.begin(request, self._speech._add_text) if request else None
            self._wait_for_news(goal)
            self._process_answer(goal)
            self._show_events(goal)
        self._show_events(goal)

    def _wait_for_news(self, goal: GoalHandle) -> None:
        """Wait for input, an answer or an event, until the time is up."""
        watched = self._interrupts.watched
        if not (self._exchange or self._input_ended or self._speech._stopped):
            watched[0] = select.POLLIN
        try:
            self._connection.wait_until(
                lambda: goal._has_event() or (self._exchange is not None and self._exchange.over), self._end
            )
        except Interrupted:
            if watched.pop(0, None) is None:
                raise
            wait_ready({}, 0, watched)  # raises Interrupted again if there was also a signal or closed output
            self._read_input()
        finally:
            watched.pop(0, None)

    def _read_input(self) -> None:
        """Read the input that has arrived, and add it to the text."""
        data = read_available()
        if data is None:
            return
        known_problem = self._decoder.problem
        self._speech._text.write(self._decoder.decode(data))
        if self._decoder.problem and not (known_problem or self._options.quiet):
            self._reporter.feedback.note(self._decoder.problem)
        if not data:
            self._input_ended = True
            self._speech._text.end()

    def _process_answer(self, goal: GoalHandle) -> None:
        """Process the answer to the last request, if it has arrived. The goal is LOST if the connection has ended."""
        exchange = self._exchange
        if exchange is not None and exchange.over:
            self._exchange = None
            try:
                self._connection.answer(exchange)
                self._reporter.feedback.text_added(goal.goal)
            except TalkError as error:
                self._speech._process_error(error)
        goal._lose_if_disconnected()

    def _show_events(self, goal: GoalHandle) -> None:
        """Show the goal's new events with --wait, and forget them otherwise."""
        while (event := goal.poll()) is not None:
            if self._wait:
                show_if_possible(self._reporter.feedback.show, goal.goal, event)
