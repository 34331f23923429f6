"""Text that is spoken while it is being written.

`SpeechStream` sends the text and blocks while the server holds its replies back. `StreamCalls` is the part that it
shares with the stream of the asyncio client. `growing` decides what to send.
"""

from __future__ import annotations

from contextlib import suppress

from talkcli.client.goal import GoalCalls, GoalHandle
from talkcli.client.growing import TextSender
from talkcli.errors import Lost, RequestRefused, ServerUnavailable, TalkError, UnknownGoal
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.goal import Goal
from talkcli.goals.options import Append, Say
from talkcli.goals.states import State
from talkcli.polling import run_blocking

if TYPE_CHECKING:
    from talkcli.client.connection import Connection
    from talkcli.goals.goal import JsonObject

#: How many times an addition to a text is sent again. Without this limit, a request that breaks the connection would be
#: repeated endlessly.
_MAX_RESENDS = 5


class StreamCalls:
    """The base class of speech streams, with coroutines that send the text."""

    #: the class of the goal's handle
    _handle_type: type[GoalCalls]

    def __init__(self, connection: Connection, say: Say) -> None:
        """Create a stream without sending anything.

        `say` has the options of the goal.
        """
        #: the handle of the goal, or None until there is text that can be spoken
        self.goal: GoalCalls | None = None
        self._connection = connection
        self._text = TextSender(say)
        #: the id of the goal, or None if no goal was sent. A goal that was sent may be spoken even if the wait for the
        #: server's answer was interrupted.
        self._goal_id: str | None = None
        #: whether the server takes no more text, because the goal has ended or is being stopped
        self._refused = False

    @property
    def _stopped(self) -> bool:
        """Whether the goal has ended or is being stopped."""
        return self._refused or (self.goal is not None and self.goal.state.terminal)

    async def _write(self, text: str) -> bool:
        """Add text at the end, send it, and wait for the answer. Return whether the goal accepts more."""
        if not self._stopped:
            self._text.write(text)
        return await self._send()

    async def _finish(self, *, failed: bool) -> None:
        """Send the rest of the text, or stop the goal if the program that writes the text has failed."""
        if failed and not self._stopped:
            await self._break_off()
        elif self._goal_id and not failed:
            self._text.ended = True
            await self._send()

    async def _send(self) -> bool:
        """Send all text that can be sent, and wait for the answers. Return whether the goal accepts more."""
        connection, resends = self._connection, 0
        while not self._stopped and (request := self._text.request_to_send()):
            if isinstance(request, Say):
                await self._begin_goal(request)
                continue
            try:
                await connection.request(request, self._add_text)
            except RequestRefused as error:
                if self._process_error(error):
                    raise
            except (Lost, ServerUnavailable) as error:
                # Wait until the client has reconnected, or until it gives up and the goal is LOST.
                await connection.until(lambda: self._stopped or connection.absent_since is None, None)
                resends += 1
                if connection.ended is not None or connection.absent_since is not None or resends > _MAX_RESENDS:
                    self._process_error(error)
                    raise Lost(f"{error.message}; the sentence may still be spoken") from error
        return not self._stopped

    async def _begin_goal(self, request: Say) -> None:
        """Send the goal with the beginning of its text, and wait for the server's answer."""
        handle = self._handle_type(self._connection, Goal("", State.PENDING))

        def on_reply(reply: JsonObject, _: list[JsonObject]) -> None:
            handle._accept(reply)
            handle._listen(feedback=request.feedback)
            self._text.accepted(handle.id)
            self.goal, self._goal_id = handle, handle.id

        self._goal_id = request.id
        try:
            await self._connection.request(request, on_reply)
        except TalkError:
            self._goal_id = None
            raise

    def _add_text(self, *_: object) -> None:
        """Add the text accepted by the server to the goal's handle."""
        assert self.goal
        addition = self._text.accepted(self.goal.id)
        assert isinstance(addition, Append)
        self.goal._grow(addition)

    async def _break_off(self) -> None:
        """Ask the server to stop the goal, because its text will never be complete."""
        if self._goal_id:
            with suppress(TalkError):
                await self._connection.request(Append(self._goal_id, broken=True))

    def _process_error(self, error: TalkError) -> bool:
        """Drop refused text, or end a lost goal as LOST. Return whether the goal accepts other text."""
        assert self.goal
        if isinstance(error, RequestRefused) and error.code == "goal_ended":
            self._refused = True
        elif isinstance(error, RequestRefused) and not isinstance(error, UnknownGoal):
            self._text.refused()
            return True
        else:
            with self._connection.changed:
                self.goal._mark_lost(f"{error.message}; the sentence may still be spoken")
        return False


class SpeechStream(StreamCalls):
    """Text that is spoken while it is being written.

    `Client.stream` creates the stream.

    A stream is a context manager. When the block ends, the text is complete. If an exception ends the block, the goal
    is ABORTED at once with the reason `broken_off`, or RECALLED if it hasn't started.

    Only one thread at a time may write. Any thread may use the goal's handle.
    """

    goal: GoalHandle | None
    _handle_type = GoalHandle

    def write(self, text: str) -> bool:
        """Add text at the end, send it, and wait for the answer. Return whether the goal accepts more.

        Text is sent at once, except blanks at the very beginning. If more than 10,000 characters have not been heard,
        the call waits until more of them have been heard.

        Returns:
            False if the goal has ended or is being stopped, for example because it was preempted or cancelled.

        Raises:
            RequestRefused: the server refused this text, for example because the whole text is longer than 50,000
                characters (`text_too_long`). The goal still has the earlier text.
            ServerUnavailable: the server can't be reached. Nothing was sent.
            Lost: the connection broke, and the client could not reconnect. The goal is LOST.
        """
        return run_blocking(self._write(text))

    def wait(self, timeout: float | None = None) -> Goal | None:
        """Wait until the goal has ended, and return it. Return None if there is no goal.

        Call this method after the block. The arguments and errors are those of `GoalHandle.wait`.
        """
        return self.goal.wait(timeout) if self.goal else None

    def __enter__(self) -> SpeechStream:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        run_blocking(self._finish(failed=kind is not None))
