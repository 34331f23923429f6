"""The client for asyncio, and the handles of its goals.

    async with Client(name="patrol") as talk:
        goal = await talk.say("battery low")
        ...
        if (await goal.wait(timeout=10)).state is not State.SUCCEEDED:
            print(goal.goal.message)

The calls have the names, parameters and errors of the blocking client, whose documentation has the details. The client
starts no thread. If a task is cancelled while it waits, nothing is cancelled on the robot.
"""

from __future__ import annotations

from functools import partial
from inspect import signature
from typing import TYPE_CHECKING

from talkcli.aio.connection import LoopSocketConnection
from talkcli.client import client as blocking
from talkcli.client.calls import ClientCalls, Paused, Saying
from talkcli.client.connect import ANSWER_LIMIT_S
from talkcli.client.connection import event_reader
from talkcli.client.goal import GoalCalls, end_time
from talkcli.client.stream import StreamCalls
from talkcli.errors import UsageError
from talkcli.goals.options import PAUSE_S, SOUND
from talkcli.protocol.events import Result, WordHeard

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Iterable
    from contextlib import AbstractAsyncContextManager
    from typing import Any

    from talkcli.aio.connection import LoopConnection
    from talkcli.client.calls import with_parameters_of
    from talkcli.goals.goal import Goal
    from talkcli.protocol.events import Event
else:

    def with_parameters_of(model: Callable) -> Callable:
        """Return a decorator that makes `help` show the parameters of `model` for a method."""

        def decorate(method: Callable) -> Callable:
            method.__signature__ = signature(model).replace(return_annotation=signature(method).return_annotation)
            return method

        return decorate


class GoalHandle(GoalCalls):
    """A handle for following and cancelling a goal.

    The state is up to date even if no task waits. Events are buffered until they are read. If there are more than 5,000
    words and pauses, the oldest are dropped. `events`, `feedback` and `poll` read from the same buffer, so each event
    is returned only once. A new loop continues where an interrupted one stopped.
    """

    async def wait(self, timeout: float | None = None) -> Goal:
        """Wait until the goal has ended, and return it. Raise TimeoutError if `timeout` expires first."""
        return await self._wait(timeout)

    def events(self, timeout: float | None = None) -> AsyncIterator[Event]:
        """Iterate over the goal's events as they happen. The last event is the Result."""
        return self._iterate_events(timeout, feedback=False)

    def feedback(self, timeout: float | None = None) -> AsyncIterator[WordHeard]:
        """Iterate over the goal's words as they are heard, until the goal has ended."""
        return (each async for each in self._iterate_events(timeout, feedback=True) if isinstance(each, WordHeard))

    async def cancel(self) -> Goal:
        """Cancel the goal, and wait until it has stopped. Return the goal."""
        return await self._cancel()

    async def _iterate_events(self, timeout: float | None, *, feedback: bool) -> AsyncIterator[Event]:
        """Follow the goal, optionally with words, and yield its events. Raise TimeoutError after `timeout`."""
        end, event = end_time(timeout), None
        read = event_reader(self._connection, self._take, end)
        await self._follow(feedback=feedback)
        while not isinstance(event, Result):
            # If the task is cancelled during this wait, no event has been taken.
            await self._connection.until(self._has_event, end)
            event = await self._read_event(read, timeout)
            yield event


class SpeechStream(StreamCalls):
    """Text that is spoken while it is being written.

    `Client.stream` creates the stream, which is a context manager. When the block ends, the text is complete. If an
    exception ends the block, the goal is ABORTED at once with the reason `broken_off`, or RECALLED if it hasn't
    started. Only one task at a time may write.
    """

    goal: GoalHandle | None
    _handle_type = GoalHandle

    async def write(self, text: str) -> bool:
        """Add text at the end, send it, and wait for the answer. Return whether the goal accepts more.

        If more than 10,000 characters have not been heard, the call waits until more of them have been heard.
        """
        return await self._write(text)

    async def wait(self, timeout: float | None = None) -> Goal | None:
        """Wait until the goal has ended, and return it. Return None if there is no goal."""
        return await self.goal.wait(timeout) if self.goal else None

    async def __aenter__(self) -> SpeechStream:
        return self

    async def __aexit__(self, kind: type[BaseException] | None, *_: object) -> None:
        await self._finish(failed=kind is not None)


class Client(ClientCalls):
    """A client for asyncio, which connects at the beginning of an `async with` block, or with `connect`.

    Use it in the event loop in which it was connected. It reconnects like the blocking client. The documentation of
    `talkcli.Client` describes the parameters and the errors of its calls.
    """

    def __init__(self, socket: str | None = None, *, name: str | None = None, timeout: float = ANSWER_LIMIT_S) -> None:
        """Create a client, without connecting it. The arguments are those of the blocking client."""
        self._open: Callable[[], Awaitable[LoopConnection]] = partial(
            LoopSocketConnection.open, socket, name=name, patience_s=timeout
        )

    async def connect(self) -> Client:
        """Connect to the server, unless the client is already connected. Return the client.

        The errors are those of the blocking client's constructor.
        """
        if "_connection" not in vars(self) or self._connection.ended is not None:
            super().__init__(await self._open())
        return self

    async def close(self) -> None:
        """Close the connection. Goals that were sent are still spoken."""
        self._connection.close()

    async def __aenter__(self) -> Client:
        return await self.connect()

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    @with_parameters_of(blocking.Client.say)
    async def say(self, *text: str, **options: Any) -> GoalHandle:
        """Send a text to be spoken. Return the handle of its goal.

        If the task is cancelled during this call, the text may still be spoken. To be able to cancel it, use `saying`,
        or choose its `key` or `id`.
        """
        return await self._say(GoalHandle, *text, **options)

    @with_parameters_of(blocking.Client.say)
    async def play(self, *text: str, **options: Any) -> GoalHandle:
        """Send a sound to be played. Return the handle of its goal."""
        return await self._say(GoalHandle, *text, format=SOUND, **options)

    @with_parameters_of(blocking.Client.say)
    def saying(self, *text: str, **options: Any) -> AbstractAsyncContextManager[GoalHandle]:
        """Return an asynchronous context manager that speaks a text, and cancels the goal when its block ends.

        It cancels the goal even if the task is cancelled.
        """
        return Saying(self, GoalHandle, *text, **options)

    @with_parameters_of(blocking.Client.stream)
    def stream(self, **options: Any) -> SpeechStream:
        """Return a stream that speaks a text while the text is being written."""
        return SpeechStream(self._connection, self._stream_request(**options))

    def paused(self, seconds: float = PAUSE_S) -> AbstractAsyncContextManager[Goal | None]:
        """Return an asynchronous context manager that pauses all speech during its block, up to `seconds`.

        Its value is the paused goal, if any.
        """
        return Paused(self, seconds)

    async def follow(self, ids: Iterable[str] | None = None, *, feedback: bool = False) -> list[GoalHandle]:
        """Subscribe to the events of goals. Return the goals' handles."""
        return await self._follow(GoalHandle, ids, feedback=feedback)

    async def events(self, *, reconnect: bool = False) -> AsyncIterator[Event]:
        """Iterate over the events of all goals. The client subscribes when the iteration begins."""
        next_event = await self._watch(reconnect=reconnect)
        while True:
            yield await next_event()

    if not TYPE_CHECKING:  # type checkers would otherwise accept any name

        def __getattr__(self, name: str) -> Any:
            """Raise UsageError if the connection is missing, or AttributeError for any other name."""
            if name == "_connection":
                raise UsageError("this client is not connected; connect it with: async with Client() as talk")
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
