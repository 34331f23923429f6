"""`talk say`."""

from __future__ import annotations

import os
import select
import time
from typing import TYPE_CHECKING

import click

from talkcli import output
from talkcli.cli.common import Common, common, common_options, note, show, show_error, show_json, timeout_option
from talkcli.cli.interrupts import Interrupts
from talkcli.dial import ANSWER_LIMIT, Interrupted, ready
from talkcli.errors import EXIT_OK, EXIT_TIMEOUT, Lost, ServerUnavailable, TalkError
from talkcli.states import EXIT_CODES, State

if TYPE_CHECKING:
    from talkcli.client import GoalHandle
    from talkcli.messages import Goal

#: Seconds for which a goal that was given up is awaited to be silent.
_SILENCE = 1.0
#: Bytes that are read of standard input: one more than the longest text, so that the server sees that it is too long.
_MAX_INPUT = 40_001


class _SayCommand(click.Command):
    """Says how to speak a text that looks like an option."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        try:
            return super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            words = f"{error.format_message()} To speak a text that starts with '-', write: talk say -- TEXT"
            raise click.UsageError(words, ctx) from error


@click.command("say", cls=_SayCommand)
@click.argument("text", nargs=-1, required=True)
@click.option("-w", "--wait", is_flag=True, help="Wait until it has ended; the exit code tells how.")
@timeout_option("With --wait: cancel it after SEC seconds, time in the queue included; exit code 124.")
@click.option(
    "--preempt/--queue",
    default=None,
    help="Stop what is being spoken and go first, or wait in the queue. [default: as 'talk serve' was told]",
)
@click.option(
    "--as", "name", metavar="NAME", envvar="TALK_NAME", show_envvar=True, help="What the sender calls itself."
)
@common_options
@click.pass_context
def command(
    context: click.Context,
    text: tuple[str, ...],
    wait: bool,
    timeout: float | None,
    preempt: bool | None,
    name: str | None,
) -> int:
    """Speak TEXT: its words, joined by blanks; or standard input, as one sentence, where TEXT is '-'.

    Prints the goal's id. Without --wait it returns as soon as the goal is accepted. With --wait it owns the goal:
    Ctrl-C and SIGTERM cancel it.

    \b
      talk say "battery low"
      talk say --wait -- "$text" || echo "nobody heard it"
      fortune | talk say -

    Exit codes: 0 accepted, or succeeded; 3 no server; 4 aborted; 5 rejected; 6 recalled; 7 preempted; 12 the server
    went away; 124 timed out.
    """
    began = time.monotonic()
    if timeout is not None and not wait:
        raise click.UsageError("--timeout needs --wait: without it, nothing is waited for", context)
    end = None if timeout is None else began + timeout
    sentence = _read_input(end) if text == ("-",) else " ".join(text)
    options = common(context)
    with Interrupts() as interrupts:
        try:
            patience = ANSWER_LIMIT if timeout is None else min(ANSWER_LIMIT, timeout)
            with options.connect(name=name, interrupt=interrupts.descriptor, patience=patience) as client:
                if interrupts.number is not None:
                    raise Interrupted
                goal = client.say(sentence, preempt=preempt, follow=wait)
                return _tell(goal, options) if not wait else _own(goal, interrupts, end, options)
        except Interrupted:
            return interrupts.exit_code
        except Lost as error:
            if interrupts.number is None and (end is None or time.monotonic() < end):
                raise
            show_error(error, json=options.json)
            return EXIT_TIMEOUT if interrupts.number is None else interrupts.exit_code


def _tell(goal: GoalHandle, options: Common) -> int:
    """Print the id of a goal that was accepted."""
    if goal.state is State.REJECTED:
        return report(goal.goal, options)
    if options.json:
        show_json(goal.goal.to_json())
    elif not options.quiet:
        show(goal.id)
    return EXIT_OK


def _own(goal: GoalHandle, interrupts: Interrupts, end: float | None, options: Common) -> int:
    """Wait for a goal that this command owns: where it can't wait any longer, the goal ends too."""
    if goal.state is State.REJECTED:
        return report(goal.goal, options)
    if not options.json and not options.quiet:
        show(goal.id)
    try:
        goal.wait(None if end is None else max(0.0, end - time.monotonic()))
    except (Interrupted, TimeoutError):
        timed_out = interrupts.number is None
        _end(goal, interrupts)
        code = report(goal.goal, options)
        if interrupts.number is not None and not timed_out:
            return interrupts.exit_code
        return code if goal.state is State.SUCCEEDED else EXIT_TIMEOUT
    return report(goal.goal, options)


def _end(goal: GoalHandle, interrupts: Interrupts) -> None:
    """Cancel a goal, and wait a moment for its silence."""
    interrupts.clear()
    try:
        goal.request_cancel()
        goal.wait(_SILENCE)
    except TimeoutError:
        note(f"{goal.id}: cancelled, but the server did not confirm within {_SILENCE:g} s that it is silent")
    except (Interrupted, ServerUnavailable) as error:
        note(f"{goal.id}: cancelled, but it is not known whether it is silent: {error or 'interrupted'}")


def report(goal: Goal, options: Common) -> int:
    """Tell how a goal ended, or how it stands, and return the exit code for it."""
    if options.json:
        show_json(goal.to_json())
    if goal.state is not State.SUCCEEDED and goal.state.terminal and not options.quiet:
        note(output.ending(goal))
    if goal.reason == "throttled":
        return EXIT_OK  # not speaking was what the sender asked for
    return EXIT_CODES.get(goal.state, EXIT_TIMEOUT)


def _read_input(end: float | None) -> str:
    """Return standard input as one sentence: no more of it than the longest text, so that it can be refused."""
    data = b""
    while len(data) < _MAX_INPUT:
        if not ready({0: select.POLLIN}, None if end is None else max(0.0, end - time.monotonic())):
            raise InputLate("standard input has not ended within the time: nothing was sent")
        more = os.read(0, _MAX_INPUT - len(data))
        if not more:
            break
        data += more
    return data.decode(errors="surrogateescape").rstrip("\r\n")


class InputLate(TalkError):
    """What should be spoken was not there in time."""

    code = "timeout"
    exit_code = EXIT_TIMEOUT
