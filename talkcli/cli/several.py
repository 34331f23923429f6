"""The commands that can be sent to several robots with `--robot`.

They are say, play, wait, cancel, status, set, pause and resume.

Each outcome is printed as a line `ROBOT ID STATE CODE` as soon as it arrives. The last line says how many robots have
carried out the request. The same commands for a single server are in `say`, `wait` and `ask`.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from talkcli import paths
from talkcli.cli.interrupts import Interrupts, discard_unread_output
from talkcli.cli.say import replace_and_report_bad_bytes
from talkcli.cli.show import note, retry_without_output, show, show_error, show_if_possible, show_json
from talkcli.cli.wait import CANCEL_TIMEOUT_S, seconds_left, timeout_error
from talkcli.client.connect import ANSWER_LIMIT_S
from talkcli.errors import EXIT_DIFFER, EXIT_OK, EXIT_TIMEOUT, TalkError
from talkcli.frozen import replace
from talkcli.goals.options import SOUND, Cancel, Pause, Say, Set
from talkcli.polling import Interrupted
from talkcli.protocol.requests import Request, Resume, Status, Wait
from talkcli.terminal.goals import describe_end, setting_lines
from talkcli.terminal.text import printable

if TYPE_CHECKING:
    from typing import Any

    from talkcli.cli.show import CommonOptions
    from talkcli.fleet.desk.request import Outcome
    from talkcli.fleet.desk.several import FleetRequest

#: The maximum number of names in a failure message, and the maximum number of failure messages.
_MAX_NAMES, _MAX_NOTES = 5, 10


def say(
    options: CommonOptions,
    text: tuple[str, ...],
    wait: bool,
    timeout: float | None,
    name: str | None,
    **chosen: Any,
) -> int:
    """Send a text to each selected robot, and print the outcomes.

    The arguments are explained in `say.say`.
    """
    discard_unread_output()
    sentence: str | int = " ".join(text)
    if text == ("-",):
        from talkcli.cli.stdin import read_text

        sentence = read_text(options.deadline(timeout), stop_without_reader=wait)
    if isinstance(sentence, int):
        return sentence  # reading was interrupted by a signal or by closed output
    return _send_request(
        options, Say(replace_and_report_bad_bytes(sentence, options), wait=wait, **chosen), timeout, name
    )


def play(options: CommonOptions, sound: str, wait: bool, timeout: float | None, name: str | None, **chosen: Any) -> int:
    """Send a sound to each selected robot, and print the outcomes. Return the exit code."""
    discard_unread_output()
    return _send_request(options, Say(sound, wait=wait, format=SOUND, **chosen), timeout, name)


def wait(options: CommonOptions, ids: tuple[str, ...], timeout: float | None) -> int:
    """Wait until the given goals, or all goals, have ended on each robot. Print the outcomes.

    Return the exit code.
    """
    discard_unread_output()
    return _send_request(options, Wait(ids or None), timeout)


def cancel(options: CommonOptions, ids: tuple[str, ...], current: bool, before: str | None, key: str | None) -> int:
    """Cancel the selected goals, or all goals, on each robot. Print the outcomes."""
    return _send_request(options, Cancel(ids or None, current, before, key))


def status(options: CommonOptions, goal_id: str | None, long: bool) -> int:  # noqa: ARG001 - ids are always whole
    """Show the status of each robot, or the state of one goal on each robot.

    Return the exit code.
    """
    return _send_request(options, Status(goal_id))


def change(options: CommonOptions, **settings: Any) -> int:
    """Change the given settings on each robot, or show all settings if none are given.

    Return the exit code.
    """
    return _send_request(options, Set(**settings))


def pause(options: CommonOptions, seconds: float | None, **_: Any) -> int:
    """Pause speech on each robot, and print the outcomes. Ignore the other options of `pause`."""
    return _send_request(options, Pause(seconds))


def resume(options: CommonOptions) -> int:
    """Resume paused speech on each robot, and print the outcomes."""
    return _send_request(options, Resume())


def _send_request(
    options: CommonOptions, request: Request, timeout: float | None = None, sender_name: str | None = None
) -> int:
    """Send a request to the selected robots, and print the outcomes. Return the exit code.

    After an interrupt or a timeout, cancel the goals if the command waits for goals that it has sent itself.

    Args:
        options: the options of every command.
        request: the request.
        timeout: seconds for the whole command; None for no limit.
        sender_name: the sender's name.
    """
    owns_goals = isinstance(request, Say) and request.wait
    printer = _OutcomePrinter(options, request)
    with Interrupts(output=owns_goals or isinstance(request, Wait)) as interrupts:
        broker = options.broker()
        from talkcli.fleet.desk.request import Selection
        from talkcli.fleet.desk.several import FleetRequest

        selection = Selection(paths.named_robot(options.robot, options.socket) or "")
        patience_s = min(ANSWER_LIMIT_S, timeout or ANSWER_LIMIT_S)
        with FleetRequest(
            broker, selection, request, name=sender_name, interrupt=interrupts.watched, patience_s=patience_s
        ) as fleet_request:
            try:
                printer.show_outcomes(fleet_request, seconds_left(options.deadline(timeout)))
                return printer.summarize(fleet_request)
            except (Interrupted, OSError) as error:
                interrupts.handle_error(error)
                is_late = isinstance(error, TimeoutError)
            if owns_goals:
                _cancel_goals(fleet_request, interrupts, printer)
            if is_late:
                show_error(timeout_error(timeout), json=options.json)
            printer.summarize(fleet_request, "may still be speaking" if owns_goals else "not done")
            return EXIT_TIMEOUT if is_late else interrupts.exit_code
    return interrupts.exit_code


def _cancel_goals(fleet_request: FleetRequest, interrupts: Interrupts, printer: _OutcomePrinter) -> None:
    """Cancel a request's unfinished goals, wait briefly for the outcomes, and print them."""
    interrupts.prepare_cleanup()
    try:
        if fleet_request.unfinished_robots:
            fleet_request.cancel()
        retry_without_output(printer.show_outcomes, fleet_request, CANCEL_TIMEOUT_S)
    except (Interrupted, TimeoutError):
        pass  # the summary names the robots that haven't answered
    except TalkError as error:
        note(f"the goals could not be cancelled: {error}")


class _OutcomePrinter:
    """A printer that shows each robot's outcome as it arrives, and a summary at the end."""

    def __init__(self, options: CommonOptions, request: Request) -> None:
        self._options, self._request = options, request
        #: each robot's first failure or, if there is none, its latest outcome. The field `last` is always up to date.
        self._outcomes: dict[str, Outcome] = {}
        shows_count = not options.quiet and sys.stderr is not None and sys.stderr.isatty()
        self._terminal = sys.stderr if shows_count else None

    def show_outcomes(self, fleet_request: FleetRequest, timeout: float | None) -> None:
        """Wait for all outcomes. Record and print each one as it arrives.

        This raises the same errors as `FleetRequest.results`.
        """
        try:
            self._show_count(fleet_request)
            for each in fleet_request.results(timeout):
                self._record_outcome(each)
                self._clear_count()
                self._print_outcome(each)
                self._show_count(fleet_request)
        finally:
            self._clear_count()

    def _record_outcome(self, outcome: Outcome) -> None:
        """Record a robot's outcome, unless a failure of this robot has already been recorded.

        A failure that seemed to be final is replaced.
        """
        before = self._outcomes.get(outcome.robot)
        # A robot that answers after a final failure wasn't absent after all, so replace that failure.
        if before is not None and before.exit_code and not before.last:
            outcome = replace(before, last=outcome.last)
        self._outcomes[outcome.robot] = outcome

    def summarize(self, fleet_request: FleetRequest, unfinished_label: str = "not done") -> int:
        """Print how many robots succeeded and why others failed. Return the exit code.

        Args:
            fleet_request: the request.
            unfinished_label: the description of robots whose last outcome hasn't arrived.
        """
        failures = [each for each in self._outcomes.values() if each.exit_code]
        done = sum(each.last and not each.exit_code for each in self._outcomes.values())
        if not self._options.quiet:
            for words in _failure_notes(failures)[:_MAX_NOTES]:
                note(words)
            if fleet_request.unfinished_robots:
                why = f": {fleet_request.why_disconnected}" if fleet_request.why_disconnected else ""
                note(f"{unfinished_label}: {_join_names(fleet_request.unfinished_robots)}{why}")
            note(f"{done} of {len(fleet_request)} robots succeeded")
        codes = {each.exit_code for each in failures}
        return EXIT_DIFFER if len(codes) > 1 else next(iter(codes), EXIT_OK)

    def _print_outcome(self, outcome: Outcome) -> None:
        """Print an outcome as JSON, as a list of settings or as one line.

        With --quiet, leave out the line, except for `status`.
        """
        if self._options.json:
            show_if_possible(show_json, outcome.to_json())
        elif outcome.said and self._request == Set():
            settings = outcome.said.get("settings")
            for line in setting_lines(settings if isinstance(settings, dict) else {}):
                show_if_possible(show, f"{outcome.robot} {line}")
        elif not self._options.quiet or isinstance(self._request, Status):
            goal = printable(outcome.goal.id) if outcome.goal and outcome.goal.id else "-"
            show_if_possible(show, f"{outcome.robot} {goal} {outcome.state} {outcome.exit_code}")

    def _show_count(self, fleet_request: FleetRequest) -> None:
        """Show the number of finished robots on the terminal."""
        if self._terminal:
            finished = sum(each.last for each in self._outcomes.values())
            self._terminal.write(f"\r{finished} of {len(fleet_request)} robots")
            self._terminal.flush()

    def _clear_count(self) -> None:
        """Clear the number of finished robots from the terminal."""
        if self._terminal:
            self._terminal.write("\r\x1b[2K")
            self._terminal.flush()


def _failure_notes(failures: list[Outcome]) -> list[str]:
    """Return a message for each kind of failure, with the robots' names."""
    alike: dict[tuple[str, int], list[Outcome]] = {}
    for each in failures:
        alike.setdefault((each.state, each.exit_code), []).append(each)
    return [
        f"{state}: {_join_names([each.robot for each in some])}: {_describe_failure(some[0])}"
        for (state, _), some in alike.items()
    ]


def _join_names(names: list[str]) -> str:
    """Join the first few names. If there are more, add their number."""
    more = f" and {len(names) - _MAX_NAMES} more" if len(names) > _MAX_NAMES else ""
    return ", ".join(names[:_MAX_NAMES]) + more


def _describe_failure(outcome: Outcome) -> str:
    """Return a human-readable reason for a failure."""
    if outcome.error is not None:
        return outcome.error.message.removeprefix(f"{outcome.robot}: ")  # the message already contains the robot's name
    return describe_end(outcome.goal) if outcome.goal else outcome.state
