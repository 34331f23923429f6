"""Texts that are spoken while they are written.

`SpeechStream` sends the text and blocks while the server holds its replies back. `growing` decides what to send.
"""

from __future__ import annotations

import time
from contextlib import suppress

from talkcli.client.goal import GoalHandle
from talkcli.client.growing import TextSender
from talkcli.errors import Lost, RequestRefused, ServerUnavailable, TalkError, UnknownGoal, UsageError
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.goal import Goal
from talkcli.goals.options import Append, Say
from talkcli.goals.states import State

if TYPE_CHECKING:
    from types import TracebackType

    from talkcli.client.connection import Connection
    from talkcli.goals.goal import JsonObject


class SpeechStream:
    """A text that is spoken while it is written. `Client.stream` creates it.

    It is a context manager. When the block ends, the text is complete. If an exception ends the block, the goal is
    ABORTED at once with the reason `broken_off`, or RECALLED if it hasn't started.

    Only one thread at a time may write. Any thread may use the goal's handle.
    """

    def __init__(self, connection: Connection, say: Say) -> None:
        """Initialize a stream without sending anything. `say` has the options of the goal."""
        #: the handle of the goal, or None until there is text that can be spoken
        self.goal: GoalHandle | None = None
        self._connection = connection
        self._text = TextSender(say)
        #: whether the server takes no more text, because the goal has ended or is being stopped
        self._refused = False
        #: whether the caller can't write any more
        self._closed = False

    def write(self, text: str) -> bool:
        """Add text at the end, and return whether the goal can still take text.

        Text is sent at once, except blanks at the very beginning. If more than 10,000 characters have not been heard,
        the call waits until more of them have been heard.

        Returns:
            False if the goal has ended or is being stopped, for example because it was preempted or cancelled.

        Raises:
            UsageError: an option of the goal is out of its range, or the text has already ended.
            RequestRefused: the server refused this text, for example because the whole text is longer than 50,000
                characters (`text_too_long`). The goal still has the earlier text.
            ServerUnavailable: the server can't be reached. Nothing was sent.
            Lost: the connection broke, and the client could not reconnect. The goal is LOST.
        """
        if self._closed:
            raise UsageError("the text has already ended; start another one with Client.stream")
        if not self._stopped:
            self._text.write(text)
        return self._send()

    def end(self) -> None:
        """Declare the text complete. Nothing is sent if there is no goal. The errors are those of `write`."""
        if not self._closed:
            self._closed = True
            if self.goal:
                self._text.end()
                self._send()

    def break_off(self) -> None:
        """Stop the goal at once, because its text will never be complete. Errors of the connection are ignored."""
        if not self._closed:
            self._closed = True
            if self.goal and not self._stopped:
                with suppress(TalkError):
                    self._connection.request(Append(self.goal.id, broken=True))

    def wait(self, timeout: float | None = None) -> Goal | None:
        """Wait until the goal has ended, and return it, or return None if there is no goal.

        Call this after the block. The arguments and errors are those of `GoalHandle.wait`.
        """
        return self.goal.wait(timeout) if self.goal else None

    def __enter__(self) -> SpeechStream:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.end()
        else:
            self.break_off()

    # -- internal

    @property
    def _stopped(self) -> bool:
        """Whether the goal can't take more text, because it has ended or is being stopped."""
        return self._refused or (self.goal is not None and self.goal.state.terminal)

    def _send(self) -> bool:
        """Send all text that can be sent, and return whether the goal can still take text."""
        give_up = float("inf")
        while not self._stopped and (request := self._text.next_request()):
            if isinstance(request, Say):
                self._begin_goal(request)
                continue
            try:
                self._connection.request(request, self._add_text)
            except RequestRefused as error:
                self._process_error(error)
            except (Lost, ServerUnavailable) as error:
                give_up = min(give_up, time.monotonic() + self._connection._patience)
                self._await_reconnection(error, give_up)
        return not self._stopped

    def _begin_goal(self, request: Say) -> None:
        """Send the goal with the beginning of its text, and wait for the server's answer."""
        handle = GoalHandle(self._connection, Goal("", State.PENDING))
        handle._expect(request, time.monotonic())
        self.goal = handle

        def on_reply(reply: JsonObject, _: list[JsonObject]) -> None:
            handle._accept(reply)
            handle._listen(feedback=request.feedback)
            self._text.accepted(handle.id)

        try:
            self._connection.request(request, on_reply)
        except TalkError as error:
            with self._connection.changed:
                handle._fail(error)
            raise

    def _add_text(self, *_: object) -> None:
        """Record that the server has accepted the open request to add text."""
        assert self.goal
        self.goal._grow(self._text.accepted(self.goal.id))

    def _process_error(self, error: TalkError) -> None:
        """Record that the goal takes no more text, because a request to add text has failed.

        Raises:
            RequestRefused: the error only concerns the last text.
        """
        assert self.goal
        if isinstance(error, RequestRefused) and error.code == "goal_ended":
            self._refused = True
        elif isinstance(error, RequestRefused) and not isinstance(error, UnknownGoal):
            self._text.refused()
            raise error
        else:
            with self._connection.changed:
                self.goal._mark_lost(f"{error.message}; the sentence may still be spoken")

    def _await_reconnection(self, error: TalkError, give_up: float) -> None:
        """Wait until the client has reconnected or the goal has ended.

        Raises:
            Lost: the client can't reconnect in time.
        """
        connection = self._connection
        in_time = time.monotonic() < give_up and connection.wait_until(
            lambda: connection.absent_since is None or self._stopped, give_up
        )
        if connection.ended is not None or connection.absent_since is not None or not in_time:
            self._process_error(error)
            raise Lost(f"{error.message}; the sentence may still be spoken") from error
