"""The commands that may be asked of several robots by `--robot`: say, wait, cancel, status, set, pause, resume.

What becomes of it is a line a robot, `ROBOT ID STATE CODE`, as it comes; how many did as they were asked is told last.
What a robot alone is asked is in `say`, `wait` and `ask`. They know no click, and are imported for this alone.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from talkcli.cli.command import replace_bad_bytes
from talkcli.cli.interrupts import Interrupts, discard_unread_output
from talkcli.cli.show import (
    discard_output,
    note,
    reader_is_gone,
    retry_without_output,
    show,
    show_error,
    show_if_possible,
    show_json,
)
from talkcli.cli.wait import CANCEL_TIMEOUT_S, seconds_left, timeout_error
from talkcli.errors import EXIT_DIFFER, EXIT_OK, EXIT_TIMEOUT, TalkError, UsageError
from talkcli.goals.options import Cancel, Say, Set
from talkcli.polling import Interrupted
from talkcli.protocol.requests import Pause, Resume, Status, Wait
from talkcli.terminal.goals import describe_end, setting_lines
from talkcli.terminal.text import printable

if TYPE_CHECKING:
    from typing import Any

    from talkcli.cli.show import CommonOptions
    from talkcli.fleet.desk.crowd import Round
    from talkcli.fleet.desk.outcome import Outcome
    from talkcli.protocol.requests import Request

#: Names of robots in one note, and notes of those that did not do it: all of them are on standard output.
_NAMES, _NOTES = 5, 10


def say(
    options: CommonOptions,
    text: tuple[str, ...],
    wait: bool,
    timeout: float | None,
    name: str | None,
    **chosen: Any,
) -> int:
    """Have all of them speak a text, and return the exit code; the arguments are as those of `say.say`."""
    end = None if timeout is None else options.started_at + timeout
    discard_unread_output()
    sentence = " ".join(text)
    if text == ("-",):
        from talkcli.cli.stdin import InputTooLong, read_text

        try:
            read = read_text(end, wait=wait)
        except InputTooLong as error:
            raise UsageError(str(error)) from error
        if isinstance(read, int):
            return read  # nothing was sent
        sentence = read
    sentence, unreadable = replace_bad_bytes(sentence)
    if unreadable and not options.quiet:
        note(unreadable)
    return _ask(options, Say(sentence, wait=wait, **chosen), timeout, name)


def wait(options: CommonOptions, ids: tuple[str, ...], timeout: float | None) -> int:
    """Wait until these goals have ended on all of them, or all of theirs; return the exit code."""
    discard_unread_output()
    return _ask(options, Wait(ids or None), timeout)


def cancel(options: CommonOptions, ids: tuple[str, ...], current: bool, before: str | None, key: str | None) -> int:
    """Cancel on all of them what these select, or everything; return the exit code."""
    return _ask(options, Cancel(ids or None, current, before, key))


def status(options: CommonOptions, goal_id: str | None) -> int:
    """Show how each stands, or one goal on each; return the exit code."""
    return _ask(options, Status(goal_id))


def change(options: CommonOptions, **settings: Any) -> int:
    """Change those settings of all of them that aren't None, or show them; return the exit code."""
    return _ask(options, Set(**settings))


def pause(options: CommonOptions) -> int:
    """Hold speech on all of them; return the exit code."""
    return _ask(options, Pause())


def resume(options: CommonOptions) -> int:
    """Go on where speech is held on any of them; return the exit code."""
    return _ask(options, Resume())


def _ask(options: CommonOptions, request: Request, timeout: float | None = None, name: str | None = None) -> int:
    """Ask all of them, show what becomes of it, and return the exit code; `timeout`: seconds for all of it."""
    owns = isinstance(request, Say) and request.wait
    end = None if timeout is None else options.started_at + timeout
    found = _Tally(options, request)
    with (
        Interrupts(output=owns or isinstance(request, Wait)) as interrupts,
        options.connect_robots(timeout, name=name, interrupt=interrupts.watched) as crowd,
    ):
        asked = crowd.ask(request)
        late = False
        try:
            found.take(asked, seconds_left(end))
        except TimeoutError:
            late = True
        except (Interrupted, OSError) as error:
            if isinstance(error, OSError):
                if not reader_is_gone(error):
                    raise
                interrupts.reader_gone = True
            interrupts.check_reader()
        if not (late or interrupts.reader_gone or interrupts.signal_number is not None):
            return found.end(asked)
        if interrupts.reader_gone:
            discard_output()
        if owns:
            _cancel(asked, interrupts, found)
        if late:
            show_error(timeout_error(timeout), json=options.json)
        found.end(asked, "not known to be silent" if owns else "not done")
        return EXIT_TIMEOUT if late else interrupts.exit_code
    return interrupts.exit_code


def _cancel(asked: Round, interrupts: Interrupts, found: _Tally) -> None:
    """Cancel it wherever it has not ended, and wait a moment for silence."""
    interrupts.reset()
    try:
        if asked.open:
            asked.cancel()
        retry_without_output(found.take, asked, CANCEL_TIMEOUT_S)
    except (Interrupted, TimeoutError):
        pass  # where it is not known, `end` tells
    except TalkError as error:
        note(f"could not be cancelled: {error}")


class _Tally:
    """Shows what becomes of it, and counts."""

    def __init__(self, options: CommonOptions, request: Request) -> None:
        self._options, self._request = options, request
        #: what has become of it at each robot, by its name; the first that is no success, where there are several
        self._found: dict[str, Outcome] = {}
        #: the robots that have more to tell
        self._going: set[str] = set()
        self._count = _Count(shown=not options.quiet)

    def take(self, asked: Round, timeout: float | None) -> None:
        """Show what has become of it, as it comes, until all are done; what `Round.results` raises."""
        try:
            self._count.show(len(self._found) - len(self._going), len(asked))
            for each in asked.results(timeout):
                self._note(each)
                self._count.clear()
                self._show(each)
                self._count.show(len(self._found) - len(self._going), len(asked))
        finally:
            self._count.clear()

    def _note(self, outcome: Outcome) -> None:
        # One that was taken for absent, and then has answered, begins anew.
        robot = outcome.robot
        if robot not in self._going or not self._found[robot].exit_code:
            self._found[robot] = outcome
        if outcome.last:
            self._going.discard(robot)
        else:
            self._going.add(robot)

    def end(self, asked: Round, unknown: str = "not done") -> int:
        """Tell how many did as they were asked, and why the others did not; return the exit code.

        `unknown`: what is said of those of which not all is known.
        """
        failures = [each for each in self._found.values() if each.exit_code]
        done = [robot for robot, each in self._found.items() if not each.exit_code and robot not in self._going]
        if not self._options.quiet:
            for words in _reasons(failures)[:_NOTES]:
                note(words)
            if asked.open:
                note(f"{unknown}: {_some(asked.open)}{f': {asked.away}' if asked.away else ''}")
            note(f"{len(done)} of {len(asked)} as asked")
        codes = {each.exit_code for each in failures}
        return EXIT_DIFFER if len(codes) > 1 else next(iter(codes), EXIT_OK)

    def _show(self, outcome: Outcome) -> None:
        if self._options.json:
            show_if_possible(show_json, outcome.to_json())
        elif outcome.said and self._request == Set():
            settings = outcome.said.get("settings")
            for line in setting_lines(settings if isinstance(settings, dict) else {}):
                show_if_possible(show, f"{outcome.robot} {line}")
        elif not self._options.quiet or isinstance(self._request, Status):
            goal = printable(outcome.goal.id) if outcome.goal and outcome.goal.id else "-"
            show_if_possible(show, f"{outcome.robot} {goal} {outcome.state} {outcome.exit_code}")


def _reasons(failures: list[Outcome]) -> list[str]:
    """Return a note for each way in which it came to nothing, with some of the robots, and the words of one."""
    alike: dict[tuple[str, int], list[Outcome]] = {}
    for each in failures:
        alike.setdefault((each.state, each.exit_code), []).append(each)
    found = []
    for (state, _), some in alike.items():
        found.append(f"{state}: {_some([each.robot for each in some])}: {_why(some[0])}")
    return found


def _some(names: list[str]) -> str:
    """Return the first of these names, and how many more there are."""
    more = f" and {len(names) - _NAMES} more" if len(names) > _NAMES else ""
    return ", ".join(names[:_NAMES]) + more


def _why(outcome: Outcome) -> str:
    """Return in words why a robot did not do it."""
    if outcome.error is not None:
        return outcome.error.message.removeprefix(f"{outcome.robot}: ")  # who it is stands before it
    return describe_end(outcome.goal) if outcome.goal else outcome.state


class _Count:
    """How many are done, on a terminal's last line, while it goes on."""

    def __init__(self, *, shown: bool) -> None:
        self._stream = sys.stderr if shown and sys.stderr is not None and sys.stderr.isatty() else None
        self._there = False

    def show(self, done: int, asked: int) -> None:
        """Show it."""
        if self._stream:
            self._write(f"\r{done} of {asked}")
            self._there = True

    def clear(self) -> None:
        """Leave the line empty."""
        if self._there:
            self._write("\r\x1b[2K")
            self._there = False

    def _write(self, text: str) -> None:
        assert self._stream
        self._stream.write(text)
        self._stream.flush()
