"""The command `talk wait`, and code that it shares with `talk say`.

Goals are handled in the same way whether or not standard output can be written. This module must not import click,
because simple command lines are run without it.
"""

from __future__ import annotations

import time

from talkcli.cli.interrupts import Interrupts, discard_unread_output
from talkcli.cli.show import Feedback, retry_without_output, show, show_if_possible, show_json
from talkcli.errors import EXIT_OK, ServerUnavailable, TimedOut
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.options import format_number
from talkcli.goals.states import State
from talkcli.polling import Interrupted
from talkcli.protocol.events import GoalInterrupted, Result

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from talkcli.cli.show import CommonOptions
    from talkcli.client.client import GoalHandle
    from talkcli.goals.goal import Goal

    Follow = Callable[[GoalHandle], None]

#: How long to wait for silence after cancelling a goal.
CANCEL_TIMEOUT_S = 1.0


def seconds_left(deadline: float | None) -> float | None:
    """Return the number of seconds left until a deadline, if there is one."""
    return None if deadline is None else max(0.0, deadline - time.monotonic())


def timeout_error(timeout: float | None, details: str = "") -> TimedOut:
    """Return the error to raise when --timeout has expired.

    `details` is added to its message.
    """
    return TimedOut(f"timed out after {format_number(timeout or 0)} s{details and f': {details}'}")


class GoalReporter:
    """A reporter that prints the ids and events of a command's goals, and why they failed."""

    def __init__(self, options: CommonOptions, *, feedback: bool) -> None:
        """Initialise the reporter. If `feedback` is true, the reporter shows each event."""
        self._options = options
        self.feedback = Feedback()
        if feedback:
            from talkcli.cli.feedback import make_feedback

            self.feedback = make_feedback(options)

    def show_accepted(self, goal: GoalHandle, pause_known: bool = False) -> None:
        """Print the id of an accepted goal. If speech is paused, say so.

        `pause_known` means that the user has already been told.
        """
        if self._options.quiet:
            return
        if not self._options.json and not self.feedback.shows_events:
            show_if_possible(show, goal.id)
        if goal.speech_paused and not (pause_known or goal.state.terminal):
            from talkcli.terminal.goals import describe_pause

            self.feedback.note(f"{describe_pause(goal.pause)}; to continue, run: talk resume")

    def follow(self, goals: Sequence[GoalHandle], timeout: float | None) -> None:
        """Show the events of goals until the goals have ended.

        Raises:
            TimeoutError: the goals haven't ended in time.
            Interrupted: the wait was interrupted.
        """
        from talkcli.client.goal import merged

        self.feedback.begin([each.goal for each in goals])
        for goal, event in merged(goals, timeout):
            show_if_possible(self.feedback.show, goal.goal, event)
            if isinstance(event, GoalInterrupted) and not (self._options.quiet or self.feedback.shows_events):
                words = f"goal {goal.id} was interrupted by goal {event.by.goal}, and continues afterwards"
                self.feedback.note(words)

    def report_refused(self, goal: Goal, prefix: str = "") -> int:
        """Report a goal that wasn't accepted. Return its exit code.

        `prefix` is put in front of any message.
        """
        if self._options.json:
            show_if_possible(self.feedback.show, goal, Result(goal))
        return self.report(goal, prefix)

    def report(self, goal: Goal, prefix: str = "", cancelled_here: bool = False) -> int:
        """Print why a goal failed, if it did. With --json, also print the goal. Return its exit code.

        The exit code of an unfinished goal is 0. `prefix` is put in front of any message. If this command has cancelled
        the goal (`cancelled_here`), the message doesn't name it.
        """
        if self._options.json and not self.feedback.shows_events:
            show_if_possible(show_json, goal.to_json())
        muted = goal.output is not None and goal.output.muted
        if goal.state.terminal and (muted or goal.state is not State.SUCCEEDED) and not self._options.quiet:
            from talkcli.terminal.goals import describe_end

            words = describe_end(goal, name_client=not cancelled_here)
            # The doctor can't explain why a text is unsuitable or incomplete.
            if goal.state is State.ABORTED and goal.reason not in {"nothing_to_say", "text_stalled", "broken_off"}:
                words += "; find out why with: talk doctor"
            self.feedback.note(f"{prefix}{words}")
        return goal.exit_code or EXIT_OK

    def cancel(self, goal: GoalHandle, interrupts: Interrupts) -> None:
        """Cancel a goal, wait briefly for its end, and report how it ended.

        Output may fail, because Ctrl-C may also have ended the program that reads it, and SIGHUP means that the
        terminal is gone.
        """
        interrupts.prepare_cleanup()
        problem = "could not be cancelled"
        try:
            goal.request_cancel()
            problem = "was cancelled, but may still be spoken"
            retry_without_output(self.follow, [goal], CANCEL_TIMEOUT_S)
            problem = ""
        except TimeoutError:
            problem = f"was cancelled, but the server did not confirm silence within {CANCEL_TIMEOUT_S:g} s"
        except (Interrupted, ServerUnavailable) as error:
            problem += f": {error or 'interrupted'}"
        if problem:
            retry_without_output(self.feedback.note, f"goal {goal.id} {problem}")
        retry_without_output(self.report, goal.goal, "", True)

    def wait_for(self, goal: GoalHandle, interrupts: Interrupts, timeout: float | None, follow: Follow) -> int:
        """Wait until a goal has ended. Cancel it on an interrupt or a timeout. Return the exit code.

        If an earlier command has already sent a goal with the same id, that goal isn't cancelled.

        Args:
            goal: the goal.
            interrupts: the signals that interrupt the wait.
            timeout: the time limit of the command in seconds, for the error message.
            follow: waits for the goal, and shows its events.

        Raises:
            TimedOut: the goal hasn't succeeded in time.
        """
        try:
            self.show_accepted(goal)
            follow(goal)
        except (Interrupted, OSError) as error:
            interrupts.handle_error(error)
            timed_out = interrupts.signal_number is None and not interrupts.reader_gone
            if not goal.attached:
                self.cancel(goal, interrupts)
            if not timed_out:
                return interrupts.exit_code
            if goal.state is State.SUCCEEDED:
                return EXIT_OK
            raise timeout_error(timeout, f"{goal.id} was sent earlier and continues" if goal.attached else "") from None
        finally:
            retry_without_output(self.feedback.close)
        return self.report(goal.goal)


def wait(options: CommonOptions, ids: tuple[str, ...], timeout: float | None, feedback: bool) -> int:
    """Wait until the given goals, or all unfinished goals, have ended.

    Report failures, and return the exit code.
    """
    end = options.deadline(timeout)
    discard_unread_output()
    with Interrupts(output=True) as interrupts, options.connect(timeout, interrupt=interrupts.watched) as client:
        goals = client.follow(ids or None, feedback=feedback)
        reporter = GoalReporter(options, feedback=feedback)
        try:
            if feedback:
                try:
                    reporter.follow(goals, seconds_left(end))
                finally:
                    retry_without_output(reporter.feedback.close)
            first_failure = EXIT_OK
            for goal in goals:
                ended = goal.wait(seconds_left(end))
                # If no ids were given, only a lost connection to the server counts as a failure.
                may_fail = bool(ids) or ended.state is State.LOST
                code = reporter.report(ended) if may_fail or options.json else EXIT_OK
                if may_fail:
                    first_failure = first_failure or code
            return first_failure
        except TimeoutError:
            late = next(each.id for each in goals if not each.state.terminal)
            raise timeout_error(timeout, f"goal {late} has not ended") from None
    return interrupts.exit_code
