"""The commands `talk say`, which speaks a text, and `talk play`, which plays a sound.

The modules `stdin` and `stream` read standard input. This module must not import click, because simple command lines
are run without it. Only `-o` imports the engine, because it works without a server.
"""

from __future__ import annotations

import os

from talkcli.cli.command import read_value, replace_bad_bytes
from talkcli.cli.interrupts import Interrupts, discard_unread_output
from talkcli.cli.show import note, retry_without_output, show_error, show_if_possible, show_result, standard_output
from talkcli.cli.wait import GoalReporter, seconds_left, timeout_error
from talkcli.errors import EXIT_OK, Lost, UsageError
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.goal import Goal
from talkcli.goals.options import MARKDOWN, SOUND, SOUND_OPTIONS, STALL_S
from talkcli.goals.states import State
from talkcli.polling import Interrupted
from talkcli.terminal.text import printable

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import Any

    from talkcli.cli.show import CommonOptions
    from talkcli.client.client import GoalHandle


def say(
    options: CommonOptions,
    text: tuple[str, ...],
    wait: bool,
    feedback: bool,
    timeout: float | None,
    name: str | None,
    lines: bool,
    ahead: int | None,
    stream: bool,
    stall: float,
    output: str | None,
    pronounce: str | None,
    dry_run: bool,
    **goal_options: Any,
) -> int:
    """Speak a text or standard input, or write the speech to a file.

    Return the exit code.

    Args:
        options: the options of every command.
        text: the words of the text, or "-" for standard input.
        wait: whether to wait until the goal has ended.
        feedback: whether to show each word as it is heard. This implies `wait`.
        timeout: seconds for the whole command, or None for no limit.
        name: the sender's name.
        lines: whether to speak each line of standard input.
        ahead: with `lines`, how many goals may be pending at once. None stands for the default.
        stream: whether to speak standard input as one goal while it arrives.
        stall: with `stream`, how long the goal waits for more text.
        output: the file to write, or None to speak.
        pronounce: with `output`, the file of pronunciations, or None.
        dry_run: whether to print the text as it would be said, instead of speaking it.
        goal_options: the options of the goal.
    """
    wait = wait or feedback
    if output is None:
        discard_unread_output()
    if lines or stream:
        from talkcli.cli.stdin import LineSpeaker
        from talkcli.cli.stream import StreamSpeaker

        given = (options, name, {**goal_options, "stall": stall}, wait, feedback, timeout)
        return (StreamSpeaker(*given) if stream else LineSpeaker(*given, ahead=ahead)).run()
    is_input = text == ("-",) and goal_options["format"] != SOUND
    found = _read_input(options, timeout, wait, feedback, output) if is_input else " ".join(text)
    if isinstance(found, int):
        return found  # nothing can be spoken
    sentence = replace_and_report_bad_bytes(found, options)
    if output is not None or dry_run:
        goal_options |= {"pronounce": pronounce, "dry_run": dry_run}
        return _run_without_goal(output, sentence, goal_options, timeout, options)
    with Interrupts(blocked=options.blocked_signals, output=wait) as interrupts:
        try:
            with options.connect(timeout, name=name, interrupt=interrupts.watched) as client:
                if interrupts.signal_number is not None and not (options.early and options.early.request_sent):
                    raise Interrupted  # a goal that was sent early is cancelled below, once its id is known
                goal = client.say(sentence, follow=wait, feedback=feedback, **goal_options)
                reporter = GoalReporter(options, feedback=feedback)
                if wait and goal.state is not State.REJECTED:
                    end = options.deadline(timeout)
                    return reporter.wait_for(
                        goal, interrupts, timeout, lambda goal: reporter.follow([goal], seconds_left(end))
                    )
                return retry_without_output(_report_sent, goal, options, reporter)
        except Lost as error:
            if interrupts.signal_number is None:
                if seconds_left(options.deadline(timeout)) == 0:
                    raise timeout_error(timeout, error.message) from error
                raise
            show_error(error, json=options.json)
    return interrupts.exit_code


def play(options: CommonOptions, sound: str, list: bool, **given: Any) -> int:  # noqa: A002 - the option's name
    """Play a sound, or print the names of all sounds. Return the exit code.

    `given` contains the other options, which are explained in `say`.
    """
    if list:
        with options.connect() as client:
            names = client.sounds()
        show_result(options, [{"name": each} for each in names], lambda: map(printable, names))
        return EXIT_OK
    given |= dict.fromkeys(("feedback", "lines", "stream", "dry_run"), False) | {"stall": STALL_S, "ahead": None}
    return say(options, (sound,), format=SOUND, output=None, pronounce=None, **given)


def _read_input(
    options: CommonOptions, timeout: float | None, wait: bool, feedback: bool, output: str | None
) -> str | int:
    """Read all of standard input. Return the text, or an exit code if the input is interrupted or too long.

    Closed output also interrupts the reading. A text that is too long is reported.
    """
    from talkcli.cli.stdin import InputTooLong, read_text, rejected_goal

    try:
        return read_text(options.deadline(timeout), stop_without_reader=wait, any_length=output is not None)
    except InputTooLong as error:
        reporter = GoalReporter(options, feedback=feedback)
        return retry_without_output(reporter.report_refused, rejected_goal(str(error)))


def replace_and_report_bad_bytes(text: str, options: CommonOptions) -> str:
    """Return a text with its invalid UTF-8 replaced. Print a message about it unless --quiet is given."""
    text, problem = replace_bad_bytes(text)
    if problem and not options.quiet:
        note(problem)
    return text


def _report_sent(goal: GoalHandle, options: CommonOptions, reporter: GoalReporter) -> int:
    """Report whether a goal was accepted or rejected. Return the exit code."""
    if goal.state is State.REJECTED:
        code = reporter.report_refused(goal.goal)
        if goal.goal.reason == "text_too_long" and not options.quiet:
            note("to speak a long text line by line, pipe it into: talk say --lines")
        return code
    reporter.show_accepted(goal)
    return reporter.report(goal.goal)


def _run_without_goal(
    path: str | None, text: str, values: dict[str, Any], timeout: float | None, options: CommonOptions
) -> int:
    """Write the speech for a text to a file, or print the text as it would be said. Return the exit code.

    A dry run with a file renders the text, but writes nothing. A dry run without one asks the server.
    """
    pronounce, dry_run = values.pop("pronounce"), values.pop("dry_run")
    if path is None:
        with options.connect(timeout) as client:
            goal = client.dry_run(text, **values)
        if goal.state is State.REJECTED:
            return GoalReporter(options, feedback=False).report_refused(goal)
    else:
        from talkcli.engine.pronunciation import PronunciationFile, Pronunciations

        file = PronunciationFile(pronounce, lambda words: None if options.quiet else note(words)) if pronounce else None
        table = file.refresh() if file else Pronunciations({})
        values["pronunciations"] = table.terms
        code = _write_wav_file(None if dry_run else path, text, values, timeout, options)
        if code or not dry_run:
            return code
        goal = Goal("", State.PENDING, text, format=values["format"], said=table.spoken_form(text, values["format"]))
    said = str(goal.text if goal.said is None else goal.said)
    show_result(options, [goal.to_json()], lambda: map(printable, said.splitlines()))
    return EXIT_OK


def _write_wav_file(
    path: str | None, text: str, values: Mapping[str, Any], timeout: float | None, options: CommonOptions
) -> int:
    """Write the speech for a text to a WAV file, or to standard output if the path is "-". Return the exit code.

    If there is no path, render the text, but write nothing.
    """
    from talkcli.engine.parent.render import STANDARD_OUTPUT, render

    settings, seconds_at_most = _sound_settings(values), seconds_left(options.deadline(timeout))
    more = {"markdown": values["format"] == MARKDOWN, "pronunciations": values["pronunciations"], **settings}
    if path in STANDARD_OUTPUT:
        if options.json:
            raise UsageError("--json and -o - both write to standard output; leave out one of them")
        standard_output()
    target = os.devnull if path is None else path
    with Interrupts() as interrupts:
        try:
            seconds = render(text, target, timeout=seconds_at_most, interrupt=interrupts.watched, **more)
        except Interrupted:
            return interrupts.exit_code
    if path is not None:
        result = {"output": path, "seconds": seconds, "text": text, **settings}
        # Printing may fail, but the file has been written.
        retry_without_output(show_if_possible, show_result, options, [result], tuple)
    return EXIT_OK


def _sound_settings(goal_options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the voice, the rate and other sound settings from options or environment variables."""
    found = {}
    for option in SOUND_OPTIONS:
        value, text = goal_options[option.name], os.environ.get(option.env) if option.env else None
        if value is None and text:
            import click

            try:
                value = read_value(option, text)
            except ValueError as error:
                words = f"the environment variable {option.env} {error}"
                raise click.UsageError(words, click.get_current_context()) from error
        if value is not None:
            found[option.name] = value
    return found
