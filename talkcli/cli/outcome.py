"""What `say` and `wait` have in common: waiting for a goal, telling how it ended, giving one up that is one's own."""

from __future__ import annotations

import errno
import time

from talkcli.cli.show import give_up_output, note, show_json
from talkcli.dial import Interrupted
from talkcli.errors import EXIT_OK, EXIT_TIMEOUT, ServerUnavailable
from talkcli.states import EXIT_CODES, State
from talkcli.values import TYPE_CHECKING

if TYPE_CHECKING:
    from talkcli.cli.feedback import Feedback
    from talkcli.cli.interrupts import Interrupts
    from talkcli.cli.show import Common
    from talkcli.client import GoalHandle
    from talkcli.messages import Goal

#: Seconds for which a goal that was given up is awaited to be silent.
SILENCE = 1.0
#: What the sender of a goal is told that nobody hears yet.
SPEECH_IS_PAUSED = "speech is paused: talk resume"


def rest(end: float | None) -> float | None:
    """Return the seconds that are left until a monotonic time."""
    return None if end is None else max(0.0, end - time.monotonic())


def reader_is_gone(error: OSError) -> bool:
    """Whether that is why something couldn't be shown: a pipe that nobody reads, a terminal that is gone."""
    return error.errno in (errno.EPIPE, errno.EIO)


def until_ended(goal: GoalHandle, timeout: float | None, shown: Feedback | None) -> None:
    """Wait until a goal has ended, and show what happens meanwhile; TimeoutError, Interrupted."""
    if shown is None:
        goal.wait(timeout)
        return
    for event in goal.events(timeout):
        shown.show(goal.goal, event)


def give_up(goal: GoalHandle, interrupts: Interrupts, shown: Feedback | None) -> None:
    """Cancel a goal, and wait a moment for its silence."""
    interrupts.clear()
    tell = shown.aside if shown else note
    try:
        goal.request_cancel()
        try:
            until_ended(goal, SILENCE, shown)
        except BrokenPipeError:  # Ctrl-C has ended the reader, too
            give_up_output()
            until_ended(goal, SILENCE, shown)
    except TimeoutError:
        tell(f"{goal.id}: cancelled, but the server did not confirm within {SILENCE:g} s that it is silent")
    except (Interrupted, ServerUnavailable) as error:
        tell(f"{goal.id}: cancelled, but it is not known whether it is silent: {error or 'interrupted'}")


def report(goal: Goal, options: Common, shown: Feedback | None = None) -> int:
    """Tell how a goal ended, or how it stands, and return the exit code for it.

    `shown`: what has shown it already on standard output.
    """
    if options.json and shown is None:
        show_json(goal.to_json())
    if goal.state is not State.SUCCEEDED and goal.state.terminal and not options.quiet:
        from talkcli import output

        tell = shown.aside if shown else note
        words = output.ending(goal)
        if goal.state is State.ABORTED and goal.reason != "nothing_to_say":
            words += "; see 'talk doctor'"
        tell(words)
    return exit_code(goal)


def exit_code(goal: Goal) -> int:
    """Return the exit code for how a goal ended."""
    if goal.reason == "throttled":
        return EXIT_OK  # not speaking was what the sender asked for
    return EXIT_CODES.get(goal.state, EXIT_TIMEOUT)
