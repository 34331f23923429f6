"""`say` from standard input: read as one text, or spoken line by line, each a goal as it arrives, over one connection.

It never holds more than one text. Of lines, the main thread reads and sends them, waiting for room in the server's
queue; with --wait a second thread waits for the goals, in their order. Of a goal that has ended nothing is kept but the
exit code: the input may have no end.
"""

from __future__ import annotations

import os
import select
import threading
from collections import deque
from functools import partial

from talkcli.cli.command import readable
from talkcli.cli.interrupts import Interrupts
from talkcli.cli.show import Feedback, give_up_output, note, reader_is_gone, show_error
from talkcli.cli.wait import (
    SILENCE,
    feedback_for,
    introduce,
    refuse,
    regardless,
    report,
    rest,
    until_ended,
)
from talkcli.client.connect import Interrupted, ready
from talkcli.errors import EXIT_OK, EXIT_TIMEOUT, TalkError, UnknownGoal, UsageError, limits
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.goal import Goal
from talkcli.goals.options import MAX_BYTES, MAX_CHARACTERS
from talkcli.goals.states import State
from talkcli.protocol.events import Canceled, Result, unfinished
from talkcli.protocol.lines import Cut, LineSplitter

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from typing import Any, TypeVar

    from talkcli.cli.show import Common
    from talkcli.client.client import Client, GoalHandle

    _T = TypeVar("_T")

#: Bytes that are read at once: what a pipe holds.
_CHUNK = 65_536
#: Bytes that are read of one text: the longest one, and the end of its line.
_MOST = MAX_BYTES + len("\r\n")


class InputLate(TalkError):
    """What should be spoken was not there in time."""

    code = "timeout"
    exit_code = EXIT_TIMEOUT


class InputTooLong(Exception):
    """There is more on standard input than one text may have."""


def read_text(end: float | None, interrupt: Mapping[int, int], *, whole: bool = False) -> str:
    """Return standard input as one text; InputTooLong for more than the longest one, which is not read to its end.

    `end`: the monotonic time by which it must have been read, else InputLate; `interrupt`: what ends the reading with
    Interrupted, as in `connect.ready`; `whole`: read all of it, for no goal.
    """
    data = bytearray()
    while whole or len(data) <= _MOST:
        more = _read(_CHUNK if whole else _MOST + 1 - len(data), interrupt, end)
        if not more:
            return _decoded(bytes(data))
        data += more
    raise InputTooLong(
        f"standard input has more than {MAX_BYTES:,} bytes, and a text at most {MAX_CHARACTERS:,} characters: "
        "'talk say --lines' speaks it line by line"
    )


def rejected(words: str) -> Goal:
    """Return the goal that a server would have made of a text that is too long to be sent."""
    return Goal("", State.REJECTED, reason="text_too_long", message=f"Talk rejected: {words}")


def _lines(interrupt: Mapping[int, int]) -> Iterator[bytes]:
    """Iterate over standard input's lines, each as soon as its newline has come; the last one may lack it.

    One that is too long is read to its end, and `Cut`. `interrupt`: as in `read_text`.
    """
    # One byte above the longest text: the CR of a line that ends in CRLF.
    splitter = LineSplitter(MAX_BYTES + 1)
    while data := _read(_CHUNK, interrupt):
        yield from splitter.feed(data)
    if splitter.size:
        yield splitter.end()


def _read(count: int, interrupt: Mapping[int, int], end: float | None = None) -> bytes:
    """Return what there is of standard input once there is something, at most so many bytes; b"" at its end."""
    while True:
        if not ready({0: select.POLLIN}, rest(end), interrupt):
            raise InputLate("standard input has not ended within the time: nothing was sent")
        try:
            return os.read(0, count)
        except BlockingIOError:  # whoever started this has made it so
            continue
        except OSError as error:
            raise UsageError(f"standard input cannot be read: {error.strerror}") from error


def _decoded(data: bytes) -> str:
    # What is not UTF-8 stays recognisable, as in arguments: see `readable`.
    return data.decode(errors="surrogateescape").rstrip("\r\n")


def say_lines(
    options: Common, name: str | None, chosen: dict[str, Any], wait: bool, feedback: bool, timeout: float | None
) -> int:
    """Speak standard input line by line, and return the exit code.

    `name`: what the sender calls itself; `chosen`: options of each goal; `timeout`: seconds for all of it.
    """
    shown = feedback_for(options, asked=feedback)
    try:
        with (
            Interrupts(timeout, output=wait) as interrupts,
            options.connect(timeout, name=name, interrupt=interrupts.watched) as client,
        ):
            return _Lines(client, interrupts, options, chosen, wait, shown).run()
    finally:
        regardless(shown.close)
    return interrupts.exit_code


class _Lines:
    """One run of the command."""

    def __init__(
        self,
        client: Client,
        interrupts: Interrupts,
        options: Common,
        chosen: dict[str, Any],
        wait: bool,
        shown: Feedback,
    ) -> None:
        self._client = client
        self._interrupts = interrupts
        self._options = options
        self._chosen = chosen
        self._wait = wait
        self._shown = shown
        self._tally = _Tally(options, interrupts, shown)
        #: the number of the line that is being sent
        self._sending: int | None = None
        self._told_of_pause = False

    def run(self) -> int:
        """Send all lines; with --wait, see them end."""
        try:
            self._tally.start()
        except RuntimeError as error:  # all that Python says of a thread that it can't have
            raise TalkError(f"no thread can be started to wait for the goals: {limits()}") from error
        try:
            self._send_all()
            self._tally.finish()
        except Interrupted:
            return self._interrupted()
        except TalkError as error:
            return self._lost(error)
        except BaseException as error:
            if self._wait and isinstance(error, OSError) and reader_is_gone(error):
                self._interrupts.gone = True
                return self._interrupted()
            self._tally.stop()
            raise
        return self._tally.code

    def _send_all(self) -> None:
        for number, line in enumerate(_lines(self._interrupts.watched), start=1):
            self._sending = number
            text = _decoded(line)
            if isinstance(line, Cut):
                words = f"the line has {line.size:,} bytes, the longest text allowed has {MAX_BYTES:,}"
                self._refuse(number, rejected(words))
            elif text.strip():
                text, unreadable = readable(text, number)
                if unreadable and not self._options.quiet:
                    self._shown.aside(unreadable)
                self._send(number, text)
            self._sending = None

    def _send(self, number: int, text: str) -> None:
        handle = self._client.say(text, follow=self._wait, feedback=self._shown.shows, patient=True, **self._chosen)
        if handle.state is State.REJECTED:
            self._refuse(number, handle.goal)
            return
        self._tell(introduce, handle, pause_is_known=self._told_of_pause)
        self._told_of_pause = handle.speech_paused
        if self._wait:
            self._tally.add(handle)
        else:
            self._tell(report, handle.goal)

    def _refuse(self, number: int, goal: Goal) -> None:
        """Tell of a line that is no goal, and go on."""
        self._tally.add(self._tell(refuse, goal, where=f"line {number}: "))

    def _tell(self, act: Callable[..., _T], goal: Goal | GoalHandle, **how: object) -> _T:
        """Tell of a goal; where its reader is gone, who waits ends as by a signal, and who doesn't goes on without."""
        tell = partial(act, goal, self._options, self._shown, **how)
        return tell() if self._wait else regardless(tell)

    def _interrupted(self) -> int:
        """End before the input does: by a signal, by the timeout, because its output has no reader any more or the
        tally can't go on.
        """
        self._interrupts.look()
        if self._interrupts.gone:
            give_up_output()
        elif self._interrupts.number is None and not self._interrupts.late:
            self._tally.finish()
            self._tell_of_the_rest()
            return self._tally.code
        self._tally.stop()
        if self._wait:
            # Who hangs up takes back the line that waits for room: else it would get that of the goals that end now.
            self._client.close()
            self._interrupts.clear()
            self._cancel([each.id for each in self._tally.unfinished])
        self._tell_of_the_rest()
        return self._interrupts.exit_code

    def _cancel(self, ids: list[str]) -> None:
        """Cancel what was sent and has not ended, and tell how it ended."""
        try:
            with self._options.connect(SILENCE, interrupt=self._interrupts.watched, urgent=True) as client:
                # With the one that was accepted in the moment in which this command hung up, if there was one.
                ids = list(dict.fromkeys([*ids, *_own(client)]))
                if not ids:
                    return
                ended = _cancelled(client, ids)
        except (TalkError, Interrupted) as error:
            self._shown.aside(f"cancelled, but it is not known whether it is silent: {str(error) or 'interrupted'}")
            return
        for goal in ended:
            if self._shown.shows:
                regardless(self._shown.show, goal, Result(goal))
            elif self._options.json or goal.state is not State.RECALLED:
                regardless(report, goal, self._options, self._shown)
        recalled = sum(each.state is State.RECALLED for each in ended)
        if recalled and not (self._shown.shows or self._options.json or self._options.quiet):
            note(f"{recalled} that waited: recalled")

    def _lost(self, error: TalkError) -> int:
        """End because the server takes no more lines, or because standard input can't be read."""
        self._tally.finish()
        self._shown.close()
        show_error(error, json=self._options.json)
        self._tell_of_the_rest()
        return self._tally.code or error.exit_code

    def _tell_of_the_rest(self) -> None:
        """Say from which line on nothing was accepted, as far as that is known."""
        if self._sending is not None and not self._options.quiet:
            self._shown.aside(f"line {self._sending} may not have been accepted; what follows it was not sent")


class _Tally(threading.Thread):
    """Waits for the goals in their order, tells how each ended, and keeps the first exit code that is no success."""

    def __init__(self, options: Common, interrupts: Interrupts, shown: Feedback) -> None:
        super().__init__(name="tally", daemon=True)
        self._options = options
        self._interrupts = interrupts
        self._shown = shown
        self._changed = threading.Condition()
        #: goals that have not ended, as far as this thread knows, exit codes of lines that are no goals, at last None
        self._waiting: deque[GoalHandle | int | None] = deque()
        self._error: BaseException | None = None
        #: the exit code of all lines so far
        self.code = EXIT_OK

    @property
    def unfinished(self) -> list[GoalHandle]:
        """The goals that were not seen to end."""
        with self._changed:
            return [each for each in self._waiting if not isinstance(each, int | None)]

    def add(self, sent: GoalHandle | int | None) -> None:
        """Wait for this one, too, or count this exit code when its turn comes; None: there are no more."""
        with self._changed:
            self._waiting.append(sent)
            self._changed.notify()

    def finish(self) -> None:
        """Return when all have ended; what stopped this thread before that is raised."""
        self.add(None)
        self.join()
        if self._error is not None:
            raise self._error

    def stop(self) -> None:
        """End the thread as soon as that can be done, whatever has not ended."""
        self.add(None)
        self._interrupts.wake()
        # It may hang on a standard output that nobody reads: then it ends with the process.
        self.join(SILENCE)

    def run(self) -> None:
        """Wait for one after the other."""
        try:
            while (sent := self._next()) is not None:
                code = sent if isinstance(sent, int) else self._see_end(sent)
                with self._changed:
                    self._waiting.popleft()
                    self.code = self.code or code
        except BaseException as error:  # noqa: BLE001 - whatever it is, the main thread raises it
            self._error = error
            self._interrupts.wake()

    def _next(self) -> GoalHandle | int | None:
        with self._changed:
            self._changed.wait_for(lambda: self._waiting)
            return self._waiting[0]

    def _see_end(self, handle: GoalHandle) -> int:
        until_ended([handle], None, self._shown)
        if handle.state is State.LOST:
            self._interrupts.wake()  # nothing more can be sent
        return report(handle.goal, self._options, self._shown)


def _own(client: Client) -> list[str]:
    """Return the ids of all goals of this process that have not ended; none where the server is on another machine."""
    if client._connection.listener is None:
        return []  # what has this number there is another
    going = unfinished(client.status())
    return [each.id for each in going if each.client is not None and each.client.pid == os.getpid()]


def _cancelled(client: Client, ids: list[str]) -> list[Goal]:
    """Cancel these goals, and return them, in this order, as they ended."""
    try:
        done = client.cancel(ids)
    except UnknownGoal as error:
        done = Canceled.from_items(error.items)
    return sorted((*done.ended, *done.canceled), key=lambda each: ids.index(each.id) if each.id in ids else len(ids))
