"""The calls of a client as coroutines, which the blocking and the asyncio client share.

A coroutine waits only with `Connection.request` and `Connection.until`. The blocking client runs it with
`run_blocking`.
"""

from __future__ import annotations

import time

from talkcli.client.connection import event_reader
from talkcli.client.core import EventBuffer
from talkcli.errors import Lost, TalkError, UnknownGoal, UsageError
from talkcli.frozen import TYPE_CHECKING, replace
from talkcli.goals.goal import Goal
from talkcli.goals.options import MAX_ID_CHARS, MAX_IDS, Cancel, Log, Pause, Say, Set, bad_option, key_error
from talkcli.goals.states import State
from talkcli.protocol.events import Canceled, ServerStatus, Snapshot, goal_in, goals
from talkcli.protocol.lines import MAX_LINE_BYTES, request_line, request_to_json
from talkcli.protocol.requests import Resume, Sounds, Status, Voices, Wait, Watch

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterable
    from typing import Any, Concatenate, ParamSpec, TypeVar

    from talkcli.client.connection import Connection
    from talkcli.client.core import OnReply
    from talkcli.client.goal import GoalCalls
    from talkcli.goals.goal import JsonObject
    from talkcli.protocol.events import Event

    _Handle = TypeVar("_Handle", bound=GoalCalls)
    _P = ParamSpec("_P")
    _R = TypeVar("_R")

#: Number of bytes in a request that are reserved for everything except the list of ids.
_RESERVED_LINE_BYTES = 4096
#: The maximum size in JSON of an ASCII character, such as an escaped quote, and of any other character.
_MAX_ASCII_BYTES, _MAX_CHARACTER_BYTES = 2, 12
#: A `seq` with more digits than any real one has.
_LONG_SEQ = 10**15


def with_parameters_of(
    model: Callable[Concatenate[Any, _P], object],  # noqa: ARG001 - for type checkers
) -> Callable[[Callable[..., _R]], Callable[Concatenate[Any, _P], _R]]:
    """Return a decorator that tells type checkers that a method has the parameters of `model`."""
    return lambda method: method


class ConnectedClient:
    """The base class of all clients, with the socket path and the process id of their server."""

    _connection: Connection

    @property
    def path(self) -> str:
        """The path of the server's socket."""
        return self._connection.path

    @property
    def server_pid(self) -> int | None:
        """The server's process id."""
        return self._connection.server.pid


class ClientCalls(ConnectedClient):
    """The calls of a client. Those that wait are coroutines."""

    def __init__(self, connection: Connection) -> None:
        """Use a connection that has received the server's greeting."""
        self._connection = connection
        #: the first server's boot id, which is prepended to ids that consist only of a number
        self._first_boot = connection.boot

    async def cancel(
        self,
        ids: Iterable[str] | None = None,
        *,
        current: bool = False,
        before: str | None = None,
        key: str | None = None,
    ) -> Canceled:
        """Cancel goals, and wait until they have stopped. Return these goals and the ones that had ended before."""
        wanted = None if ids is None else [self._full_id(each) for each in ids]
        first, *others = [None] if wanted is None else batches(wanted) or [()]
        last = None if before is None else self._full_id(before)
        requests = [Cancel(first, current, last, key), *map(Cancel, others)]
        if key is not None and (fault := key_error(key)):
            raise UsageError(fault)
        items: list[JsonObject] = []
        unknown: list[str] = []
        for request in requests:
            try:
                items += (await self._connection.request(request))[1]
            except UnknownGoal as error:
                items += error.items
                unknown.append(error.message)
        if unknown:
            raise UnknownGoal("\n".join(unknown), items=items)
        return Canceled.from_items(items)

    async def status(self) -> ServerStatus:
        """Return the state of the server, with its active, pending and recent goals."""
        return ServerStatus.from_reply(*await self._connection.request(Status()))

    async def goal(self, goal_id: str) -> Goal:
        """Return a goal in its current state. Raise UnknownGoal if the server doesn't know it."""
        reply, _ = await self._connection.request(Status(self._full_id(goal_id)))
        return Goal.from_json(reply.get("goal"))

    async def log(
        self,
        count: int = 20,
        *,
        since: float | None = None,
        until: float | None = None,
        state: State | None = None,
        name: str | None = None,
        key: str | None = None,
        grep: str | None = None,
        history: bool = True,
    ) -> list[Goal]:
        """Return the most recently ended goals, including REJECTED ones, oldest first."""
        request = Log(count, since, until, state.name if state else None, name, key, grep)
        # Older servers have no history and don't support filters.
        known = "history" in (self._connection.server.features or ())
        request = replace(request, history=history and (known or request != Log(count)))
        return list(goals((await self._ask(request))[1], "goal"))

    async def dry_run(self, text: str, **options: Any) -> Goal:
        """Check a text without speaking it. Return the accepted or REJECTED goal."""
        request = Say(text, dry_run=True, **options)
        check(request)
        if rejected := too_long(request):
            return rejected
        reply, _ = await self._connection.request(request)
        return Goal.from_json(reply.get("goal"))

    async def voices(self) -> list[JsonObject]:
        """Return the voices of the server's engine."""
        _, items = await self._connection.request(Voices())
        return [each["voice"] for each in items if isinstance(each.get("voice"), dict)]  # type: ignore[misc]

    async def sounds(self) -> list[str]:
        """Return the names of the sounds that can be played."""
        _, items = await self._connection.request(Sounds())
        return [str(each["sound"].get("name")) for each in items if isinstance(each.get("sound"), dict)]  # type: ignore[attr-defined]

    async def settings(self) -> JsonObject:
        """Return the server's settings, which are the defaults for new goals."""
        return await self.set()

    async def set(
        self,
        rate: int | None = None,
        volume: float | None = None,
        voice: str | None = None,
        pitch: int | None = None,
        preempt: bool | None = None,
        ttl: float | None = None,
    ) -> JsonObject:
        """Change the server's settings. Return all settings."""
        reply, _ = await self._ask(Set(rate, volume, voice, pitch, preempt, ttl))
        settings = reply.get("settings")
        return settings if isinstance(settings, dict) else {}

    async def pause(self, seconds: float | None = None) -> Goal | None:
        """Pause all speech for up to `seconds`. Wait until it has stopped, and return the paused goal, if any."""
        return goal_in((await self._ask(Pause(seconds)))[0])

    async def resume(self) -> Goal | None:
        """Resume speech. Return the resumed goal, if any."""
        return goal_in((await self._connection.request(Resume()))[0])

    async def _ask(self, request: Set | Pause | Log) -> tuple[JsonObject, list[JsonObject]]:
        """Check the options of a request, and send it. Return the reply and the list items that came with it."""
        check(request)
        return await self._connection.request(request)

    # -- calls that clients adapt, because their results depend on the client

    async def _say(
        self, handle_type: type[_Handle], text: str, *, follow: bool = True, block: bool = True, **options: Any
    ) -> _Handle:
        """Send a text to be spoken. With `block`, wait for the server's answer. Return the goal's handle."""
        request = Say(text, wait=follow or options.get("feedback") is True, **options)
        if not (block or request.id):
            request = replace(request, id=self._connection.new_goal_id())
        handle, accepted = self._create_handle(handle_type, request)
        if handle.state.terminal:
            return handle
        if block:
            await self._connection.request(request, accepted)
        else:
            handle._set_request(request, time.monotonic())
            self._connection.submit(request, accepted, handle._fail)
        return handle

    def _stream_request(self, **options: Any) -> Say:
        """Check the options of a stream. Return its `say` request, which has no text yet."""
        say = Say("", wait=True, more=True, **options)
        check(say)
        if error := self._connection.unsupported(say):
            raise error
        if say.id is None and self._connection.reconnects:
            say = replace(say, id=self._connection.new_goal_id())
        return say

    async def _follow(self, handle_type: type[_Handle], ids: Iterable[str] | None, *, feedback: bool) -> list[_Handle]:
        """Subscribe to the events of goals. Return the goals' handles."""
        wanted = None if ids is None else [self._full_id(each) for each in ids]
        handles: dict[str, _Handle] = {}

        def accepted(_: JsonObject, items: list[JsonObject]) -> None:
            for goal in goals(items, "goal"):
                handles[goal.id] = handle_type(self._connection, goal)
                handles[goal.id]._listen(feedback=feedback)

        for some in [None] if wanted is None else batches(wanted):
            await self._connection.request(Wait(some, feedback), accepted)
        return list(handles.values()) if wanted is None else [handles[each] for each in wanted]

    async def _watch(self, *, reconnect: bool) -> Callable[[], Coroutine[Any, Any, Event]]:
        """Watch all goals. Return a coroutine function that returns the next event.

        It raises Lost when the stream of events ends.
        """
        buffer = EventBuffer(reconnects=reconnect)

        def accepted(reply: JsonObject, items: list[JsonObject]) -> None:
            buffer.add(Snapshot(ServerStatus.from_reply(reply, items)))
            self._connection.listeners.watches.add(buffer)

        await self._connection.request(Watch(), accepted)
        read = event_reader(self._connection, lambda: buffer.take() or buffer.closed, None)

        async def next_event() -> Event:
            event = await read()
            if event is None or isinstance(event, str):
                why = f"no more events from the server at {self.path}: {self._connection.ended}"
                raise Lost(buffer.closed or why)
            return event

        return next_event

    def _create_handle(self, handle_type: type[_Handle], request: Say) -> tuple[_Handle, OnReply]:
        """Check a `say` request. Return its goal's handle, and the function to call with the reply.

        If the text is too long for a request, the goal is already REJECTED.

        Raises:
            UsageError: a value is out of its range.
        """
        check(request)
        handle = handle_type(self._connection, too_long(request) or Goal("", State.PENDING))

        def accepted(reply: JsonObject, _: list[JsonObject]) -> None:
            handle._accept(reply)
            if request.wait:
                handle._listen(feedback=request.feedback)

        return handle, accepted

    def _full_id(self, goal_id: str) -> str:
        """Check a goal id, and add the boot id if it is missing. Return the full id.

        Raises the same errors as `check_id`.
        """
        if goal_id.isascii() and goal_id.isdecimal():
            goal_id = f"{self._first_boot}-{goal_id}"
        check_id(goal_id)
        return goal_id


class Saying:
    """An asynchronous context manager that speaks a text, and cancels the goal when its block ends.

    Its value is the goal's handle.
    """

    def __init__(self, client: ClientCalls, handle_type: type[GoalCalls], *text: str, **options: Any) -> None:
        """Prepare to speak a text, without sending anything.

        The other arguments are those of `Client.say`. The client chooses the id, so that the goal can be cancelled even
        if the wait for the server's answer is interrupted.
        """
        self._client, self._handle_type, self._text = client, handle_type, text
        self._options = {**options, "id": options.get("id") or client._connection.new_goal_id()}

    async def __aenter__(self) -> Any:
        try:
            self._handle = await self._client._say(self._handle_type, *self._text, **self._options)
        except BaseException as error:
            if not isinstance(error, TalkError):
                self._client._connection.begin(Cancel((self._options["id"],)), on_failure=lambda _: None)
            raise
        return self._handle

    async def __aexit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            await self._handle._cancel()
        except TalkError:
            if kind is None:  # otherwise, the block's own exception is raised
                raise


class Paused:
    """An asynchronous context manager that pauses all speech during its block.

    Its value is the paused goal, if any.
    """

    def __init__(self, client: ClientCalls, seconds: float) -> None:
        """Prepare a pause of at most this number of seconds, without connecting."""
        self._client, self._request = client, Pause(seconds, while_connected=True)

    async def __aenter__(self) -> Goal | None:
        check(self._request)
        self._connection = await self._client._connection.open_another()
        try:
            return goal_in((await self._connection.request(self._request))[0])
        except BaseException:
            self._connection.close()
            raise

    async def __aexit__(self, *_: object) -> None:
        self._connection.close()


def check_id(goal_id: str) -> None:
    """Raise an error if no goal can have this id.

    Raises:
        UsageError: the id is empty.
        UnknownGoal: the id is too long for any goal.
    """
    if not goal_id:
        raise UsageError("the goal's id is empty; check the variable that should contain it")
    if len(goal_id) > MAX_ID_CHARS:
        raise UnknownGoal(f"unknown goal {goal_id[:MAX_ID_CHARS]!a}…: an id has at most {MAX_ID_CHARS} characters")


def batches(ids: Iterable[str]) -> list[tuple[str, ...]]:
    """Return the ids without duplicates, in groups that each fit into one request."""
    groups: list[list[str]] = []
    room = 0
    for each in dict.fromkeys(ids):
        plain = each.isascii() and each.isprintable()
        size = (_MAX_ASCII_BYTES if plain else _MAX_CHARACTER_BYTES) * len(each) + len('"", ')
        if not groups or size > room or len(groups[-1]) == MAX_IDS:
            groups.append([])
            room = MAX_LINE_BYTES - _RESERVED_LINE_BYTES
        room -= size
        groups[-1].append(each)
    return [tuple(each) for each in groups]


def check(request: Say | Set | Pause | Log) -> None:
    """Raise UsageError if an option of a request is invalid."""
    for option in request.options:
        try:
            fault = option.type_error(getattr(request, option.name))
        except (TypeError, ValueError) as error:  # `data` contains a value that JSON can't represent
            fault = f"can't be sent as JSON: {error}"
        if fault:
            raise UsageError(f"{option.name!r} {fault}")
    if words := bad_option(request):
        raise UsageError(words)


def too_long(request: Say) -> Goal | None:
    """Return a REJECTED goal if a text is too long for a request. Otherwise, return None.

    Raises:
        UsageError: `data` has no JSON form.
    """
    try:
        line = request_line({"seq": _LONG_SEQ, **request_to_json(request)})
    except ValueError as error:  # `data` contains NaN or an infinite number
        raise UsageError(f"'data' can't be sent as JSON: {error}") from None
    if len(line) <= MAX_LINE_BYTES:
        return None
    from talkcli.goals.reasons import Reason  # this import is slow and rarely needed

    message = f"not spoken: the text is too long for a request ({len(request.text):,} characters)"
    return Goal("", State.REJECTED, request.text, reason=Reason.TEXT_TOO_LONG.value, message=message)
