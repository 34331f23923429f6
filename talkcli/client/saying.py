"""Texts that are spoken while a block of the program runs."""

from __future__ import annotations

from contextlib import suppress

from talkcli.client.goal import GoalCalls, GoalHandle
from talkcli.errors import TalkError
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.options import Cancel
from talkcli.polling import run_blocking

if TYPE_CHECKING:
    from typing import Any, TypeVar

    from talkcli.client.calls import ClientCalls

    _Handle = TypeVar("_Handle", bound=GoalCalls)


class SayingCalls:
    """The base class of context managers that speak a text until their block ends."""

    def __init__(self, client: ClientCalls, *text: str, **options: Any) -> None:
        """Prepare to speak a text, without sending anything.

        The arguments are those of `Client.say`. The client chooses the id, so that the goal can be cancelled even if
        the wait for the server's answer is interrupted.
        """
        self._client, self._text = client, text
        self._options = {**options, "id": options.get("id") or client._connection.new_goal_id()}
        self._goal: GoalCalls | None = None

    async def _begin(self, handle_type: type[_Handle]) -> _Handle:
        """Send the goal. Return its handle."""
        try:
            self._goal = goal = await self._client._say(handle_type, *self._text, **self._options)
        except TalkError:
            raise
        except BaseException:
            with suppress(TalkError):
                request = Cancel((self._options["id"],))
                self._client._connection.submit(request, lambda *_: None, lambda _: None)
            raise
        return goal

    async def _end(self, *, failed: bool) -> None:
        """Cancel the goal, unless it has ended. If the block has failed, ignore errors."""
        assert self._goal
        try:
            await self._goal._cancel()
        except TalkError:
            if not failed:
                raise


class Saying(SayingCalls):
    """A text that is spoken until a `with` block ends. `Client.saying` creates it."""

    def __enter__(self) -> GoalHandle:
        return run_blocking(self._begin(GoalHandle))

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        run_blocking(self._end(failed=kind is not None))
