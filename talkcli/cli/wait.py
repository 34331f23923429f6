"""`talk wait`: waits for goals, whoever sent them. It knows no click: plain command lines come here without it."""

from __future__ import annotations

from talkcli.cli.interrupts import Interrupts, give_up_unread
from talkcli.cli.outcome import regardless, report, rest, show_if_possible
from talkcli.cli.show import note
from talkcli.client.connect import ANSWER_LIMIT, Interrupted
from talkcli.errors import EXIT_OK, EXIT_TIMEOUT
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.states import State

if TYPE_CHECKING:
    from talkcli.cli.feedback import Feedback
    from talkcli.cli.show import Common
    from talkcli.client.client import GoalHandle


def wait(options: Common, ids: tuple[str, ...], timeout: float | None, feedback: bool) -> int:
    """Wait until these goals have ended, or all that have not, and return the exit code; `timeout` in seconds."""
    end = None if timeout is None else options.began + timeout
    patience = ANSWER_LIMIT if timeout is None else min(ANSWER_LIMIT, timeout)
    give_up_unread()
    with Interrupts() as interrupts:
        interrupts.watch_output()
        try:
            with options.connect(interrupt=interrupts.watched, patience=patience) as client:
                goals = client.follow(ids or None, feedback=feedback)
                shown = _show(goals, end, interrupts, options) if feedback else None
                return _wait(goals, end, options, shown, named=bool(ids))
        except Interrupted:
            interrupts.look()
            return interrupts.exit_code
        except TimeoutError as error:
            note(str(error))
            return EXIT_TIMEOUT


def _show(goals: list[GoalHandle], end: float | None, interrupts: Interrupts, options: Common) -> Feedback:
    """Show what happens to the goals until all have ended."""
    from talkcli.cli.feedback import feedback
    from talkcli.client.following import merged

    shown = feedback(options)
    try:
        shown.begin([each.goal for each in goals])
        for goal, event in merged(goals, rest(end)):
            show_if_possible(shown.show, goal.goal, event)
    except Interrupted:
        interrupts.look()  # while standard output is what it was
        raise
    finally:
        regardless(shown.close)
    return shown


def _wait(goals: list[GoalHandle], end: float | None, options: Common, shown: Feedback | None, *, named: bool) -> int:
    """Wait for the goals in their order; how those ended that were not named is nobody's failure."""
    first_failure = EXIT_OK
    for goal in goals:
        ended = goal.wait(rest(end))
        counts = named or ended.state is State.LOST
        code = report(ended, options, shown) if counts or options.json else EXIT_OK
        if counts:
            first_failure = first_failure or code
    return first_failure
