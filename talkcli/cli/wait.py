"""Waiting for goals and telling how they ended, as `say` and `wait` do it; and `talk wait` itself, which owns none.

None of this depends on whether standard output can be written. It knows no click: plain command lines come here
without it.
"""

from __future__ import annotations

import time

from talkcli.cli.interrupts import Interrupts, give_up_unread
from talkcli.cli.show import Feedback, give_up_failed, give_up_output, reader_is_gone, show, show_json
from talkcli.errors import EXIT_OK, EXIT_TIMEOUT, ServerUnavailable, TimedOut
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.option import figure
from talkcli.goals.states import State
from talkcli.polling import Interrupted
from talkcli.protocol.events import Result

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from typing import Any, TypeVar

    from talkcli.cli.show import Common
    from talkcli.client.client import GoalHandle
    from talkcli.goals.goal import Goal

    _T = TypeVar("_T")

#: Seconds for which a goal that was given up is awaited to be silent.
SILENCE = 1.0


def rest(end: float | None) -> float | None:
    """Return the seconds that are left until a monotonic time."""
    return None if end is None else max(0.0, end - time.monotonic())


def timed_out(timeout: float | None, words: str = "") -> TimedOut:
    """Return the error of a command that --timeout has ended; `words`: what is told besides."""
    return TimedOut(f"timed out after {figure(timeout or 0)} s{words and f': {words}'}")


def show_if_possible(put: Callable[..., None], *what: object) -> None:
    """Show something, with a function for that; where there is no room for it, all goes on without.

    A reader that is gone is raised: see `reader_is_gone`.
    """
    try:
        put(*what)
    except OSError as error:
        if reader_is_gone(error) or give_up_failed(error) is None:
            raise


def regardless(act: Callable[..., _T], *given: Any) -> _T:
    """Do this; where the reader of standard output is gone, again, and then nothing is shown."""
    try:
        return act(*given)
    except OSError as error:
        if not reader_is_gone(error):
            raise
        give_up_output()
        return act(*given)


def feedback_for(options: Common, *, asked: bool) -> Feedback:
    """Return what shows the events of goals: nothing, unless that was asked for."""
    if not asked:
        return Feedback()
    from talkcli.cli.feedback import feedback

    return feedback(options)


def introduce(goal: GoalHandle, options: Common, shown: Feedback, *, pause_is_known: bool = False) -> None:
    """Print the id of a goal that was accepted, and why it may take long."""
    if options.quiet:
        return
    if not options.json and not shown.shows:
        show_if_possible(show, goal.id)
    if goal.speech_paused and not (pause_is_known or goal.state.terminal):
        shown.aside("speech is paused: talk resume")


def until_ended(goals: Sequence[GoalHandle], timeout: float | None, shown: Feedback) -> None:
    """Wait until these goals have ended, and show what happens meanwhile; TimeoutError, Interrupted."""
    from talkcli.client.goal import merged

    shown.begin([each.goal for each in goals])
    for goal, event in merged(goals, timeout):
        show_if_possible(shown.show, goal.goal, event)


def give_up(goal: GoalHandle, interrupts: Interrupts, options: Common, shown: Feedback) -> int:
    """Cancel a goal, wait a moment for its silence, tell how it ended, and return the exit code for that.

    Ctrl-C may have ended the reader, too, and a terminal is gone soon after SIGHUP.
    """
    interrupts.clear()
    unknown = ""
    try:
        goal.request_cancel()
    except ServerUnavailable as error:
        regardless(shown.aside, f"{goal.id}: could not be cancelled: {error}")
        return regardless(report, goal.goal, options, shown)
    try:
        regardless(until_ended, [goal], SILENCE, shown)
    except TimeoutError:
        unknown = f"the server did not confirm within {SILENCE:g} s that it is silent"
    except (Interrupted, ServerUnavailable) as error:
        unknown = f"it is not known whether it is silent: {error or 'interrupted'}"
    if unknown:
        regardless(shown.aside, f"{goal.id}: cancelled, but {unknown}")
    return regardless(report, goal.goal, options, shown)


def refuse(goal: Goal, options: Common, shown: Feedback, where: str = "") -> int:
    """Tell of a goal that no server took, and return the exit code; `where`: as of `report`."""
    if options.json:
        show_if_possible(shown.show, goal, Result(goal))
    return report(goal, options, shown, where)


def report(goal: Goal, options: Common, shown: Feedback, where: str = "") -> int:
    """Tell how a goal ended, or how it stands, and return the exit code for it; `where`: what a note begins with."""
    if options.json and not shown.shows:
        show_if_possible(show_json, goal.to_json())
    muted = goal.output is not None and goal.output.muted
    if goal.state.terminal and (muted or goal.state is not State.SUCCEEDED) and not options.quiet:
        from talkcli.terminal.goals import ending

        words = ending(goal)
        if goal.state is State.ABORTED and goal.reason != "nothing_to_say":
            words += "; see 'talk doctor'"
        shown.aside(f"{where}{words}")
    return EXIT_TIMEOUT if goal.exit_code is None else goal.exit_code


def wait(options: Common, ids: tuple[str, ...], timeout: float | None, feedback: bool) -> int:
    """Wait until these goals have ended, or all that have not, and return the exit code; `timeout` in seconds."""
    end = None if timeout is None else options.began + timeout
    give_up_unread()
    with Interrupts(output=True) as interrupts, options.connect(timeout, interrupt=interrupts.watched) as client:
        goals = client.follow(ids or None, feedback=feedback)
        shown = feedback_for(options, asked=feedback)
        try:
            if feedback:
                _show(goals, end, interrupts, shown)
            return _wait(goals, end, options, shown, named=bool(ids))
        except TimeoutError:
            late = next(each.id for each in goals if not each.state.terminal)
            raise timed_out(timeout, f"{late} has not ended") from None
    return interrupts.exit_code


def _show(goals: list[GoalHandle], end: float | None, interrupts: Interrupts, shown: Feedback) -> None:
    """Show what happens to the goals until all have ended."""
    try:
        until_ended(goals, rest(end), shown)
    except Interrupted:
        interrupts.look()  # while standard output is what it was
        raise
    finally:
        regardless(shown.close)


def _wait(goals: list[GoalHandle], end: float | None, options: Common, shown: Feedback, *, named: bool) -> int:
    """Wait for the goals in their order; how those ended that were not named is nobody's failure."""
    first_failure = EXIT_OK
    for goal in goals:
        ended = goal.wait(rest(end))
        counts = named or ended.state is State.LOST
        code = report(ended, options, shown) if counts or options.json else EXIT_OK
        if counts:
            first_failure = first_failure or code
    return first_failure
