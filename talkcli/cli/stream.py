"""The command `talk say --stream`, which speaks standard input as it arrives.

One thread reads the input, sends it, and follows the goal. While much of the text has not been heard, the server holds
back its reply. In this time, no input is read, so the program that writes the input has to wait, too.
"""

from __future__ import annotations

import codecs
from functools import partial

from talkcli.cli.command import replace_bad_bytes
from talkcli.cli.show import retry_without_output
from talkcli.cli.stdin import InputSpeaker
from talkcli.cli.wait import seconds_left, timeout_error
from talkcli.errors import TalkError
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.options import Say
from talkcli.goals.states import State
from talkcli.polling import run_blocking, wait_ready

if TYPE_CHECKING:
    from talkcli.client.client import GoalHandle
    from talkcli.client.core import Exchange

#: The maximum number of line breaks to hold back until more text arrives. Line breaks at the end of the input are not
#: part of the text.
_MAX_HELD_LINE_BREAKS = 100


class InputDecoder:
    """An incremental decoder for standard input. Its result is the same text as for `talk say -`."""

    def __init__(self) -> None:
        self._decoder = codecs.getincrementaldecoder("utf-8")("surrogateescape")
        #: the text so far, without the line breaks that are held back
        self._text = ""
        self._line_breaks = ""
        #: the message about the first invalid bytes, or None if there were none
        self.problem: str | None = None

    def decode(self, data: bytes) -> str:
        """Decode the next bytes. Return the text that can be sent now.

        Empty bytes mark the end of the input.
        """
        added = self._decoder.decode(data, final=not data)
        replaced, problem = replace_bad_bytes(added)
        if problem and self.problem is None:
            self.problem = replace_bad_bytes(self._text + self._line_breaks + added)[1]
        found = self._line_breaks + replaced
        end = len(found.rstrip("\r\n"))
        if data and len(found) - end > _MAX_HELD_LINE_BREAKS:
            end = len(found)
        added, self._line_breaks = found[:end], found[end:]
        self._text += added
        return added


class StreamSpeaker(InputSpeaker):
    """The implementation of `say --stream`, which speaks standard input as one growing text."""

    def _run_connected(self) -> int:
        """Wait for the first text. Then send the goal and the rest of the input.

        Return the exit code.
        """
        reporter, self._decoder = self._reporter, InputDecoder()
        self._speech = self._client.stream(feedback=self._feedback.shows_events, **self._goal_options)
        self._text = self._speech._text
        while not (request := self._text.request_to_send()):
            pause = partial(wait_ready, {}, seconds_left(self._end), self._interrupts.watched)
            self._add_input(self._wait_unless_input(pause, wants_input=True))
            if seconds_left(self._end) == 0:
                raise timeout_error(self._timeout, "nothing was sent")
        assert isinstance(request, Say)
        run_blocking(self._speech._begin_goal(request))
        goal = self._speech.goal
        assert goal
        if goal.state is State.REJECTED:
            return retry_without_output(reporter.report_refused, goal.goal)
        if self._wait:
            return reporter.wait_for(goal, self._interrupts, self._timeout, self._follow)
        retry_without_output(reporter.show_accepted, goal)
        self._follow(goal)
        return retry_without_output(reporter.report, goal.goal)

    def _follow(self, goal: GoalHandle) -> None:
        """Send the input as it arrives. With --wait, show the goal's events until the goal ends.

        Raises:
            TimeoutError: the goal has not ended in time.
            Interrupted: a signal or closed output ends the wait.
        """
        exchange: Exchange | None = None  # the request that has not been answered
        self._feedback.begin([goal.goal])
        while not goal.state.terminal and (self._wait or not self._text.finished):
            if seconds_left(self._end) == 0:
                raise TimeoutError
            can_write = exchange is None and not self._speech._stopped
            if can_write and (request := self._text.request_to_send()):
                exchange = self._connection.begin(request, self._speech._add_text)
            pause = partial(self._connection.wait_until, partial(_has_news, goal, exchange), self._end)
            wants_input = can_write and exchange is None and not self._text.ended
            self._add_input(self._wait_unless_input(pause, wants_input=wants_input))
            if exchange and exchange.over:
                self._process_answer(exchange)
                exchange = None
            self._show_events(goal)
        self._show_events(goal)

    def _add_input(self, data: bytes | None) -> None:
        """Add input to the goal's text, or end the text if `data` is empty.

        `data` is None if no input has arrived.
        """
        if data is None:
            return
        known_problem = self._decoder.problem
        self._text.write(self._decoder.decode(data))
        if self._decoder.problem and not (known_problem or self._options.quiet):
            self._feedback.note(self._decoder.problem)
        self._text.ended = not data

    def _process_answer(self, exchange: Exchange) -> None:
        """Read the server's answer to added text. After a refusal, print the error and stop the goal.

        If the goal has already ended or the connection is lost, only record this.
        """
        try:
            self._connection.answer(exchange)
        except TalkError as error:
            if self._speech._process_error(error):
                self._feedback.note(error.message)
                run_blocking(self._speech._break_off())


def _has_news(goal: GoalHandle, exchange: Exchange | None) -> bool:
    """Return whether the goal has a new event or the request was answered."""
    return goal._has_event() or (exchange is not None and exchange.over)
