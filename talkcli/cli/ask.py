"""The commands that send a request to the server and show its answer.

They are cancel, status, watch, voices, set, pause and resume. `talk doctor` is also here.

This module must not import click, because simple command lines are run without it. Modules that only one command needs
are imported by that command.
"""

from __future__ import annotations

import os
import sys
import time
from functools import partial

from talkcli.cli.command import nearest
from talkcli.cli.show import note, screen, show, show_json, show_result
from talkcli.errors import EXIT_SIGPIPE, TalkError, UnknownGoal
from talkcli.frozen import TYPE_CHECKING, fields
from talkcli.goals.goal import read_seconds
from talkcli.goals.options import PAUSE_S, Pause
from talkcli.paths import named_robot
from talkcli.polling import run_blocking
from talkcli.protocol.events import Canceled, goal_in, unfinished

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from typing import Any

    from talkcli.cli.show import CommonOptions
    from talkcli.client.client import Client
    from talkcli.doctor import broker, examine
    from talkcli.goals.goal import Goal, JsonObject

#: The maximum number of characters of spoken text to show when a goal is paused.
_PAUSED_TEXT_CHARS = 40


def cancel(options: CommonOptions, ids: tuple[str, ...], current: bool, before: str | None, key: str | None) -> None:
    """Cancel the selected goals, or all goals if none are selected. Print their ids."""
    with options.connect() as client:
        try:
            reply = client.cancel(ids or None, current=current, before=before, key=key)
            _show_canceled(reply, options)
            if key and not reply.canceled and not options.quiet and sys.stderr and sys.stderr.isatty():
                _suggest_similar_key(key, client)
        except UnknownGoal as error:
            _show_canceled(Canceled.from_items(error.items), options)
            raise


def status(options: CommonOptions, goal_id: str | None, long: bool) -> None:
    """Show the server's status, or the details of a goal if an id is given."""
    from talkcli.goals.goal import Goal
    from talkcli.terminal.goals import goal_lines, status_lines

    with options.connect() as client:
        found = client.status() if goal_id is None else client.goal(goal_id)

    def lines() -> Iterable[str]:
        now, output = time.time(), screen(long=long)
        return goal_lines(found, output, now) if isinstance(found, Goal) else status_lines(found, output, now)

    show_result(options, [found.to_json()], lines)


def watch(options: CommonOptions, words: bool, long: bool) -> int:
    """Show the events of all goals until interrupted. If `words` is true, show each word as well.

    Return the exit code.
    """
    from talkcli.cli.interrupts import Interrupts, has_reader
    from talkcli.terminal.transcript import Transcript

    if not has_reader():
        return EXIT_SIGPIPE
    transcript = Transcript(full=screen().width is None, words=words)
    # `talk watch | head` must end as soon as `head` does, even if the next event is hours away.
    with Interrupts(output=True) as interrupts, options.connect(interrupt=interrupts.watched) as client:
        for event in client.events():
            show_result(options, [event.to_json()], partial(transcript.lines, event, screen(long=long), time.time()))
    return interrupts.exit_code


def voices(options: CommonOptions, language: str | None) -> None:
    """Print the engine's voices, or only those for one language."""
    from talkcli.terminal.goals import voice_lines

    with options.connect() as client:
        found = every = client.voices()
    if language:
        from talkcli.engine.protocol import Voice
        from talkcli.engine.voices import matching_languages

        listed = [Voice(str(each.get("id")), _language_code(each), str(each.get("name"))) for each in every]
        wanted = matching_languages(language, listed)
        found = [each for each in every if _language_code(each) in wanted]
        if not found:
            raise TalkError(_describe_missing_voice(language, every))
    show_result(options, found, lambda: voice_lines(found))


def change(options: CommonOptions, **settings: Any) -> None:
    """Change the given settings of the server, or show all settings if none are given."""
    from talkcli.terminal.goals import setting_lines

    asked = {name: value for name, value in settings.items() if value is not None}
    with options.connect() as client:
        found = client.set(**asked) if asked else client.settings()
    show_result(options, [found], lambda: [] if asked else setting_lines(found))


def pause(options: CommonOptions, seconds: float | None, while_connected: bool, command: tuple[str, ...]) -> int | None:
    """Pause speech, and report which goal is paused. With `while_connected`, run a program during the pause.

    Return the exit code of the program, if any.
    """
    with options.connect() as client:
        if while_connected:
            from talkcli.cli.program import run_program

            with client.paused(seconds or PAUSE_S):
                return run_program(command)
        reply, _ = run_blocking(client._connection.request(Pause(seconds)))
    from talkcli.terminal.goals import clock_time
    from talkcli.terminal.text import printable

    goal, until = goal_in(reply), read_seconds(reply.get("paused_until"))
    heard = " ".join((goal.spoken or "").split()) if goal else ""
    if len(heard) > _PAUSED_TEXT_CHARS:
        end = heard[-_PAUSED_TEXT_CHARS:]
        heard = f"…{end.partition(' ')[2] or end}"
    place = f' after "{printable(heard)}"' if heard else ""
    words = f"goal {printable(goal.id)} is paused{place}" if goal else "speech is paused"
    words += "" if until is None else f" until {clock_time(until)}"
    _report_pause(options, goal, paused=True, message=f"{words}; to continue, run: talk resume")
    return None


def resume(options: CommonOptions) -> None:
    """Resume speech, and report which goal continues."""
    with options.connect() as client:
        goal = client.resume()
    from talkcli.terminal.text import printable

    words = f"speech continues with goal {printable(goal.id)}" if goal else "speech continues"
    _report_pause(options, goal, paused=False, message=words)


def _report_pause(options: CommonOptions, goal: Goal | None, *, paused: bool, message: str) -> None:
    """Report that speech has been paused or resumed, as a message or as a JSON object."""
    if options.json:
        show_json({"paused": paused, "goal": None if goal is None else goal.to_json()})
    elif not options.quiet:
        note(message)


def doctor(options: CommonOptions, silent: bool) -> int:
    """Run the doctor's checks. Show the findings and the advice. Return the exit code."""
    from talkcli.cli.interrupts import Interrupts
    from talkcli.doctor.report import format_conclusion, format_finding, next_steps
    from talkcli.goals.states import EXIT_CODES, State

    findings = []
    with Interrupts() as interrupts:
        examination = _create_examination(options, interrupts.watched, silent=silent)
        for finding in examination.findings():
            findings.append(finding)
            show_result(options, [fields(finding)], partial(format_finding, finding, screen()))
            if interrupts.signal_number is not None:
                break
    if interrupts.signal_number is not None:
        return interrupts.exit_code
    if not options.json and not options.quiet:
        note(format_conclusion(findings, screen(), examination.question))
    # If speech can't be heard, exit with the same code as for an aborted goal.
    return EXIT_CODES[State.ABORTED] if next_steps(findings) else 0


def _create_examination(
    options: CommonOptions, interrupt: Mapping[int, int], *, silent: bool
) -> examine.LocalExamination | broker.BrokerExamination:
    """Create the object that checks this machine or the selected robot."""
    robot = named_robot(options.robot, options.socket)
    if robot is None:
        from talkcli.doctor.examine import LocalExamination

        return LocalExamination(options.socket, silent=silent, interrupt=interrupt)
    from talkcli.fleet.broker import require_paho

    require_paho()
    from talkcli.doctor import broker

    return broker.BrokerExamination(robot, os.environ, insecure=options.insecure, interrupt=interrupt)


def _show_canceled(reply: Canceled, options: CommonOptions) -> None:
    """Print the cancelled goals, and report those that had already ended."""
    for goal in reply.canceled:
        if options.json:
            show_json(goal.to_json())
        elif not options.quiet:
            show(goal.id)
    for goal in reply.ended:
        if not options.quiet:
            note(f"goal {goal.id} had already ended: {goal.state.name}")


def _suggest_similar_key(unknown_key: str, client: Client) -> None:
    """Print a suggestion if an unfinished goal has a key similar to `unknown_key`."""
    from talkcli.terminal.text import printable

    try:
        status = client.status()
    except TalkError:
        return  # the suggestion is optional, so ignore the error
    near = nearest(unknown_key, {each.key for each in unfinished(status) if each.key})
    if near:
        note(f"no goal has the key '{printable(unknown_key)}'; did you mean '{printable(near)}'?")


def _describe_missing_voice(language: str, voices: Iterable[JsonObject]) -> str:
    """Return the error message for a language that no voice speaks."""
    from talkcli.goals.options import is_neural
    from talkcli.terminal.text import printable

    codes = {_language_code(each): _language_code(each) for each in voices}
    # Typical names are "German" and "English_(America)". The first part of a language code selects all voices of the
    # language. Neural voices are left out because they aren't named after languages.
    names = {
        str(each.get("name") or "").partition(" ")[0]: _language_code(each).partition("-")[0]
        for each in voices
        if not is_neural(str(each.get("id")))
    }
    near = nearest(language, names) or nearest(language, codes)
    hint = f"did you mean '{printable({**codes, **names}[near])}'?" if near else "list all voices with: talk voices"
    return f"no voice speaks '{printable(language)}'; {hint}"


def _language_code(voice: JsonObject) -> str:
    """Return the language code of a voice in lower case."""
    return str(voice.get("language") or "").lower()
