"""The client library: send goals, follow them, cancel them, from Python.

    with Client(name="patrol") as talk:
        goal = talk.say("battery low")
        ...
        if goal.wait(timeout=10).state is not State.SUCCEEDED:
            print(goal.goal.message)

It imports neither click nor asyncio nor pyttsx3, starts no thread, and may be used from several. Errors are classes of
`talkcli.errors.TalkError`.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from talkcli import __version__, wire
from talkcli.connection import SILENCE_LIMIT, Connection
from talkcli.dial import ANSWER_LIMIT
from talkcli.errors import UnknownGoal, UsageError
from talkcli.messages import Goal
from talkcli.requests import MAX_DATA, MAX_ID, MAX_NAME, Cancel, Hello, Say, Status, Voices, Wait, write_request
from talkcli.states import State

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from types import TracebackType

    from talkcli.messages import JsonObject


@dataclass(frozen=True, slots=True)
class ServerStatus:
    """What a server says, will say and said. `server` is its own description, for people and programs."""

    server: JsonObject
    active: Goal | None
    pending: tuple[Goal, ...]
    recent: tuple[Goal, ...]

    def to_json(self) -> JsonObject:
        return {
            "server": self.server,
            "active": None if self.active is None else self.active.to_json(),
            "pending": [each.to_json() for each in self.pending],
            "recent": [each.to_json() for each in self.recent],
        }


@dataclass(frozen=True, slots=True)
class Canceled:
    """What a cancel did: the goals that it ended, and those named that had ended before."""

    canceled: tuple[Goal, ...]
    ended: tuple[Goal, ...]

    @classmethod
    def from_items(cls, items: list[JsonObject]) -> Canceled:
        """Return what the lines of a cancel's list say."""
        return cls(tuple(_goals(items, "canceled")), tuple(_goals(items, "ended")))


class GoalHandle:
    """A goal that was sent, or is waited for."""

    def __init__(self, client: Client, goal: Goal) -> None:
        self._client = client
        #: the goal as it was last heard of
        self.goal = goal
        #: whether the server tells this connection how it ends
        self._followed = False

    @property
    def id(self) -> str:
        return self.goal.id

    @property
    def state(self) -> State:
        """The goal's state as far as it was read: `wait` reads on."""
        return self.goal.state

    def wait(self, timeout: float | None = None) -> Goal:
        """Wait until the goal has ended, and return it; TimeoutError after `timeout` seconds.

        Where the server goes away first, the goal's state is LOST: it may have been spoken or not.
        """
        return self._client._wait_for(self, timeout)

    def request_cancel(self) -> None:
        """Ask for the goal to be cancelled, without waiting for it: `wait` tells how it ended."""
        self._client._post(Cancel((self.id,)))

    def cancel(self) -> Goal:
        """Cancel the goal, and return it once it has ended: silent, if it was being spoken."""
        return self._client._cancel_one(self)


class Client:
    """A connection to a talk server; the socket is found as the command `talk` finds it."""

    def __init__(
        self,
        socket: str | None = None,
        *,
        name: str | None = None,
        interrupt: int | None = None,
        patience: float = ANSWER_LIMIT,
        urgent: bool = False,
    ) -> None:
        """Connect.

        `socket`: path of the server's socket, default TALK_SOCKET, then the usual places; `name`: what this sender
        calls itself in `talk status` and the log, default TALK_NAME; `interrupt`: a descriptor that ends any waiting
        with talkcli.dial.Interrupted as soon as it is readable; `patience`: seconds in which the server must
        greet; `urgent`: for status and cancel alone, for which a full server keeps some places.

        UsageError for a name that is too long; ServerUnavailable, AccessDenied, Busy or ProtocolMismatch where there is
        no server to be had: nothing was sent then.
        """
        from talkcli import paths

        self._handles: dict[str, list[GoalHandle]] = {}
        name = name or os.environ.get("TALK_NAME") or None
        if name and len(name) > MAX_NAME:
            raise UsageError(f"the name of the sender has {len(name)} characters, the longest allowed is {MAX_NAME}")
        hello = Hello(name, urgent)
        self._connection = Connection(
            paths.named_socket(socket), hello, __version__, self._on_event, interrupt, patience
        )

    @property
    def path(self) -> str:
        """The socket of the server."""
        return self._connection.line.path

    @property
    def server_pid(self) -> int | None:
        return self._connection.line.pid

    def close(self) -> None:
        """Close the connection. What was sent is spoken all the same."""
        self._connection.close()

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def say(
        self, text: str, *, preempt: bool | None = None, data: JsonObject | None = None, follow: bool = True
    ) -> GoalHandle:
        """Send a goal, and return it as it was accepted, or REJECTED with the reason.

        `preempt`: stop what is being spoken and go first, None leaves that to the server; `data`: an object of at most
        1 KiB that travels with the goal; `follow`: have this connection told how it ends, so that `wait` works.
        """
        if data is not None and len(wire.encode(data)) > MAX_DATA:
            raise UsageError(f"data is an object of at most {MAX_DATA} bytes of JSON")
        request = Say(text, wait=follow, preempt=preempt, data=data)
        if len(wire.encode({"seq": 0, **write_request(request)})) > wire.MAX_LINE - 32:
            return GoalHandle(self, _too_long(text))
        handle = GoalHandle(self, Goal("", State.PENDING))

        def accepted(reply: JsonObject, _: list[JsonObject]) -> None:
            handle.goal = Goal.from_json(reply.get("goal"))
            if follow:
                self._attach(handle)

        self._connection.request(request, accepted)
        return handle

    def follow(self, ids: Iterable[str] | None = None) -> list[GoalHandle]:
        """Return handles for these goals, whoever sent them, to wait for; None: for all that have not ended.

        UnknownGoal if the server doesn't know one of them.
        """
        wanted = None if ids is None else tuple(self.full_id(each) for each in ids)
        handles: dict[str, GoalHandle] = {}

        def accepted(_: JsonObject, items: list[JsonObject]) -> None:
            for goal in _goals(items, "goal"):
                handles[goal.id] = GoalHandle(self, goal)
                self._attach(handles[goal.id])

        self._connection.request(Wait(wanted), accepted)
        return list(handles.values()) if wanted is None else [handles[each] for each in wanted]

    def cancel(self, ids: Iterable[str] | None = None, *, current: bool = False, before: str | None = None) -> Canceled:
        """Cancel the goals that are selected, or everything where no selector is given; return once it is silent.

        `ids`: these goals; an empty list selects none;
        `current`: the goal being spoken; `before`: this goal and all accepted before it. UnknownGoal if an id is not
        known: the others are cancelled all the same, and are in the error's `items`.
        """
        selected = None if ids is None else tuple(self.full_id(each) for each in ids)
        _, items = self._connection.request(Cancel(selected, current, before and self.full_id(before)))
        return Canceled.from_items(items)

    def status(self) -> ServerStatus:
        """Return what the server is saying, will say and said."""
        reply, items = self._connection.request(Status())
        server, active = reply.get("server"), reply.get("active")
        return ServerStatus(
            server if isinstance(server, dict) else {},
            None if active is None else Goal.from_json(active),
            tuple(_goals(items, "pending")),
            tuple(_goals(items, "recent")),
        )

    def goal(self, goal_id: str) -> Goal:
        """Return one goal as it is now; UnknownGoal if the server doesn't know it."""
        reply, _ = self._connection.request(Status(self.full_id(goal_id)))
        return Goal.from_json(reply.get("goal"))

    def voices(self) -> list[JsonObject]:
        """Return the voices of the server's engine: objects with id, language and name."""
        _, items = self._connection.request(Voices())
        return [each["voice"] for each in items if isinstance(each.get("voice"), dict)]  # type: ignore[misc]

    def full_id(self, goal_id: str) -> str:
        """Return the whole id for a number alone, which means a goal of this server's.

        UsageError for an empty id, UnknownGoal for one that no goal can have.
        """
        if not goal_id:
            raise UsageError("an id is empty: is the variable set that it comes from?")
        if goal_id.isascii() and goal_id.isdecimal():
            goal_id = f"{self._connection.line.boot}-{goal_id}"
        if len(goal_id) > MAX_ID:
            raise UnknownGoal(f"no goal {goal_id[:MAX_ID]!a}… is known: an id has at most {MAX_ID} characters")
        return goal_id

    # -- inside

    def _post(self, request: Cancel) -> None:
        self._connection.post(request)

    def _attach(self, handle: GoalHandle) -> None:
        handle._followed = True
        if not handle.state.terminal:
            self._handles.setdefault(handle.id, []).append(handle)

    def _on_event(self, event: JsonObject) -> None:
        if event.get("event") == "result":
            goal = Goal.from_json(event.get("goal"))
            for handle in self._handles.pop(goal.id, ()):
                handle.goal = goal
        elif event.get("event") == "state":
            state = State.__members__.get(str(event.get("state")))
            for handle in self._handles.get(str(event.get("id")), ()):
                # Its end comes with the result, which says how and why.
                if state is not None and not state.terminal:
                    handle.goal = replace(handle.goal, state=state)

    def _wait_for(self, handle: GoalHandle, timeout: float | None) -> Goal:
        end = None if timeout is None else time.monotonic() + timeout
        if not (handle._followed or handle.state.terminal):
            self._follow_late(handle)
        ended = self._connection.wait_until(lambda: handle.state.terminal, lambda: end, SILENCE_LIMIT)
        if not ended and self._connection.ended is not None:
            words = f"Talk lost: {self._connection.ended}; it may still be spoken"
            handle.goal = replace(handle.goal, state=State.LOST, reason="lost", message=words)
        elif not ended:
            raise TimeoutError(f"{handle.id} has not ended after {timeout:g} s")
        return handle.goal

    def _follow_late(self, handle: GoalHandle) -> None:
        def accepted(_: JsonObject, items: list[JsonObject]) -> None:
            handle.goal = next(_goals(items, "goal"))
            self._attach(handle)

        self._connection.request(Wait((handle.id,)), accepted)

    def _cancel_one(self, handle: GoalHandle) -> Goal:
        if not handle.state.terminal:
            for goal in self.cancel([handle.id]).canceled:
                handle.goal = goal
        return handle.goal if handle.state.terminal else self.goal(handle.id)


def _goals(items: list[JsonObject], name: str) -> Iterator[Goal]:
    return (Goal.from_json(each[name]) for each in items if name in each)


def _too_long(text: str) -> Goal:
    """Return the goal that the server would have made of a text that doesn't fit into a request."""
    message = f"Talk rejected: the text has {len(text):,} characters, more than a request can hold"
    return Goal("", State.REJECTED, text, reason="text_too_long", message=message)
