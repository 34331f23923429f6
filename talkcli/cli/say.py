"""`talk say`: one sentence is sent, waited for, and how it ended is told; or, with `-o`, written into a file.

Of lines `stdin` takes care. It knows no click: plain command lines come here without it. What a file takes, which is by
an engine of this command's own and knows no server, is imported for that alone.
"""

from __future__ import annotations

import os
import time

from talkcli.cli.command import read_value, readable
from talkcli.cli.interrupts import Interrupts, give_up_unread
from talkcli.cli.show import (
    Feedback,
    give_up_output,
    note,
    reader_is_gone,
    show_error,
    show_json,
    standard_output,
)
from talkcli.cli.wait import (
    feedback_for,
    give_up,
    introduce,
    refuse,
    regardless,
    report,
    rest,
    show_if_possible,
    timed_out,
    until_ended,
)
from talkcli.errors import EXIT_OK, Lost, UsageError
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.options import SOUND
from talkcli.goals.states import State
from talkcli.polling import Interrupted

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import Any

    from talkcli.cli.show import Common
    from talkcli.client.client import GoalHandle


def say(
    options: Common,
    text: tuple[str, ...],
    wait: bool,
    feedback: bool,
    timeout: float | None,
    name: str | None,
    lines: bool,
    ahead: int | None,
    output: str | None,
    **chosen: Any,
) -> int:
    """Speak a text, each line of standard input, or into a file, and return the exit code.

    `text`: words, or "-" for standard input; `timeout`: seconds; `name`: what the sender calls itself; `chosen`: the
    options of the goal, by their names.
    """
    wait = wait or feedback
    end = None if timeout is None else options.began + timeout
    if output is None:
        give_up_unread()
    if lines:
        from talkcli.cli.stdin import say_lines

        return say_lines(options, name, chosen, wait, feedback, timeout, ahead)
    sentence = " ".join(text)
    if text == ("-",):
        from talkcli.cli.stdin import InputTooLong, read_text, rejected

        try:
            read = read_text(end, wait=wait, whole=output is not None)
        except InputTooLong as error:
            return regardless(refuse, rejected(str(error)), options, feedback_for(options, asked=feedback))
        if isinstance(read, int):
            return read  # nothing was sent
        sentence = read
    if output is not None:
        return _render(output, sentence, chosen, rest(end), options)
    return _say(_readable(sentence, options), chosen, name, timeout, options, wait=wait, feedback=feedback)


def _say(
    text: str,
    chosen: dict[str, Any],
    name: str | None,
    timeout: float | None,
    options: Common,
    *,
    wait: bool,
    feedback: bool,
) -> int:
    """Speak one text."""
    end = None if timeout is None else options.began + timeout
    with Interrupts(held=options.held, output=wait) as interrupts:
        try:
            with options.connect(timeout, name=name, interrupt=interrupts.watched) as client:
                if interrupts.number is not None and not (options.begun and options.begun.sent):
                    raise Interrupted  # what has been sent is cancelled, once its id is known
                goal = client.say(text, follow=wait, feedback=feedback, **chosen)
                shown = feedback_for(options, asked=feedback)
                if not wait or goal.state is State.REJECTED:
                    return regardless(_tell, goal, options, shown)
                return _wait(goal, interrupts, timeout, options, shown)
        except Lost as error:
            if interrupts.number is None:
                if end is None or time.monotonic() < end:
                    raise
                raise timed_out(timeout, error.message) from error
            show_error(error, json=options.json)
    return interrupts.exit_code


def _readable(text: str, options: Common) -> str:
    """Return a text without the bytes in it that are no UTF-8, and tell of them."""
    text, unreadable = readable(text)
    if unreadable and not options.quiet:
        note(unreadable)
    return text


def _tell(goal: GoalHandle, options: Common, shown: Feedback) -> int:
    """Tell of a goal that is not waited for: its id, or how it ended, if it has."""
    if goal.state is State.REJECTED:
        code = refuse(goal.goal, options, shown)
        if goal.goal.reason == "text_too_long" and not options.quiet:
            note("'talk say --lines' speaks standard input line by line, each line a goal of its own")
        return code
    introduce(goal, options, shown)
    code = report(goal.goal, options, shown)
    return code if goal.state.terminal else EXIT_OK


def _wait(goal: GoalHandle, interrupts: Interrupts, timeout: float | None, options: Common, shown: Feedback) -> int:
    """Wait for a goal. It is this command's own: where it can't wait any longer, the goal ends too; unless another
    `say` had sent it before, with the same id.
    """
    try:
        introduce(goal, options, shown)
        until_ended([goal], rest(None if timeout is None else options.began + timeout), shown)
    except (Interrupted, OSError) as error:
        if isinstance(error, OSError) and not isinstance(error, TimeoutError):
            if not reader_is_gone(error):
                raise
            interrupts.gone = True
        interrupts.look()
        late = interrupts.number is None and not interrupts.gone
        if interrupts.gone:
            give_up_output()
        if goal.attached:  # it is another's, and goes on
            if late:
                raise timed_out(timeout, f"{goal.id} goes on: it was sent before") from None
            return interrupts.exit_code
        code = give_up(goal, interrupts, options, shown)
        if not late:
            return interrupts.exit_code
        if goal.state is not State.SUCCEEDED:
            raise timed_out(timeout) from None
        return code
    finally:
        regardless(shown.close)
    return report(goal.goal, options, shown)


def _render(path: str, text: str, chosen: Mapping[str, Any], timeout: float | None, options: Common) -> int:
    """Write the text into the file, "-" for standard output, and return the exit code; what goes wrong is raised.

    `chosen`: the options of a goal; those that the engine isn't told of mean nothing here. `timeout`: seconds.
    """
    from talkcli.engine.parent.render import STANDARD_OUTPUT, render

    settings = _settings(chosen)
    if path in STANDARD_OUTPUT:
        if options.json:
            raise UsageError("--json prints to standard output, where the sound goes: leave one of them out")
        standard_output()
    text = _readable(text, options)
    with Interrupts() as interrupts:
        try:
            seconds = render(text, path, timeout=timeout, interrupt=interrupts.watched, **settings)
        except Interrupted:
            return interrupts.exit_code
    if options.json:
        done = {"output": path, "seconds": seconds, "text": text, **settings}
        regardless(show_if_possible, show_json, done)  # the file is there
    return EXIT_OK


def _settings(chosen: Mapping[str, Any]) -> dict[str, Any]:
    """Return what to speak with: the options, else the environment, as a server has its own; none that neither has."""
    found = {}
    for option in SOUND:
        value, text = chosen[option.name], os.environ.get(option.env) if option.env else None
        if value is None and text:
            import click

            try:
                value = read_value(option, text)
            except ValueError as error:
                words = f"{option.env} in the environment: {error}"
                raise click.UsageError(words, click.get_current_context()) from error
        if value is not None:
            found[option.name] = value
    return found
