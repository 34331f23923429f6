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
import select

from talkcli import __version__
from talkcli.client.connect import ANSWER_LIMIT
from talkcli.client.connection import SILENCE_LIMIT, Connection
from talkcli.client.event_buffer import MAX_STATES, EventBuffer
from talkcli.client.goal import Followed, GoalHandle
from talkcli.client.outgoing import batches, check, check_key, full_id, too_long
from talkcli.errors import Lost, UnknownGoal, UsageError
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.goal import Goal
from talkcli.goals.option import MAX_LOG
from talkcli.goals.options import Cancel, Say, Set
from talkcli.goals.states import State
from talkcli.protocol.events import Snapshot
from talkcli.protocol.replies import Canceled, ServerStatus, goal_in, goals
from talkcli.protocol.requests import MAX_NAME, Hello, Log, Pause, Resume, Status, Voices, Wait, Watch

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from types import TracebackType

    from talkcli.client.opening import Opened
    from talkcli.goals.goal import JsonObject
    from talkcli.protocol.events import Event

__all__ = ["Canceled", "Client", "GoalHandle", "ServerStatus"]


class Client:
    """A connection to a talk server; the socket is found as the command `talk` finds it."""

    def __init__(
        self,
        socket: str | None = None,
        *,
        name: str | None = None,
        interrupt: int | Mapping[int, int] | None = None,
        patience: float = ANSWER_LIMIT,
        urgent: bool = False,
        opened: Opened | None = None,
    ) -> None:
        """Connect.

        `socket`: path of the server's socket, default TALK_SOCKET, then the usual places; `name`: what this sender
        calls itself in `talk status` and the log, default TALK_NAME; `interrupt`: a descriptor that ends any waiting
        with `connect.Interrupted` as soon as it is readable, or several, each with the events of poll that do so
        (broken and hung up always do); `patience`: seconds in which the server must greet; `urgent`: for status and
        cancel alone, for which a full server keeps some places; `opened`: a connection that `client.opening` has begun,
        with the first request that this client will send.

        UsageError for a name that is too long; ServerUnavailable, AccessDenied, Busy or ProtocolMismatch where there is
        no server to be had: nothing was sent then.
        """
        from talkcli import paths

        self._followed = Followed()
        # Bytes in a variable that are no UTF-8 keep nobody from cancelling.
        called = os.environ.get("TALK_NAME", "").encode(errors="surrogateescape").decode(errors="replace")
        name = name or called or None
        if name and len(name) > MAX_NAME:
            raise UsageError(f"the name of the sender has {len(name)} characters, the longest allowed is {MAX_NAME}")
        if isinstance(interrupt, int):
            interrupt = {interrupt: select.POLLIN}
        hello = Hello(name, urgent)
        self._connection = Connection(
            paths.named_socket(socket), hello, __version__, self._followed.hear, interrupt, patience, opened
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
        self,
        text: str,
        *,
        preempt: bool | None = None,
        flush: bool = False,
        priority: int = 0,
        ttl: float | None = None,
        key: str | None = None,
        throttle: float | None = None,
        id: str | None = None,  # noqa: A002 - the name that it has everywhere
        rate: int | None = None,
        volume: float | None = None,
        voice: str | None = None,
        pitch: int | None = None,
        lead_in: int | None = None,
        data: JsonObject | None = None,
        follow: bool = True,
        feedback: bool = False,
        patient: bool = False,
    ) -> GoalHandle:
        """Send a goal, and return it as it was accepted, or REJECTED with the reason.

        `preempt`: stop what is being spoken and go first, None leaves that to the server; `flush`: that, and recall
        all that is pending of the same or a lower priority; `priority`: higher goes first; `ttl`: seconds in which it
        must have begun, else it is RECALLED, 0 for no limit, None leaves that to the server; `key`: 1 to 64 characters,
        replaces the pending goal with the same key; `throttle`: REJECTED where a goal of that key, or else of that
        text, began less than so many seconds ago; `id`: 1 to 64 of A-Z a-z 0-9 . _ : / - of the sender's choice: said
        again with the same id it is not spoken twice, the handle is `attached` to the first.

        `rate`: 80 to 450 words per minute; `volume`: 0 to 1; `voice`: id, name or language; `pitch`: 0 to 100; None is
        the server's setting when it starts. `lead_in`: 0 to 5,000 milliseconds of silence before it, also where the
        output was not idle; None is the server's, where it was. `data`: an object of at most 1 KiB that travels with
        the goal.

        `follow`: have this connection told how it ends; `feedback`: and each word as it is heard, for
        `GoalHandle.feedback` and `events`; `patient`: where the queue is full, wait until there is room, any time.

        UsageError for a value out of its range, ServerUnavailable where the server is gone: nothing was sent then.
        Lost where it was sent and not answered: it may be spoken. Interrupted only while a patient one waits for room:
        close the client then, and it is not spoken once the server has seen that, within 5 s.
        """
        request = Say(
            text,
            wait=follow or feedback,
            feedback=feedback,
            patient=patient,
            preempt=preempt,
            flush=flush,
            priority=priority,
            ttl=ttl,
            key=key,
            throttle=throttle,
            id=id,
            rate=rate,
            volume=volume,
            voice=voice,
            pitch=pitch,
            lead_in=lead_in,
            data=data,
        )
        check(request)
        rejected = too_long(request)
        if rejected is not None:
            return GoalHandle(self, rejected)
        handle = GoalHandle(self, Goal("", State.PENDING))

        def accepted(reply: JsonObject, _: list[JsonObject]) -> None:
            handle.goal = Goal.from_json(reply.get("goal"))
            handle.attached = reply.get("attached") is True
            handle.speech_paused = reply.get("paused") is True
            if request.wait:
                self._followed.add(handle, feedback=feedback)

        self._connection.request(request, accepted, slow=patient)
        return handle

    def follow(self, ids: Iterable[str] | None = None, *, feedback: bool = False) -> list[GoalHandle]:
        """Return handles for these goals, whoever sent them, to wait for; None: for all that have not ended.

        `feedback`: have this connection told each of their words, too. UnknownGoal if the server doesn't know one.
        """
        wanted = None if ids is None else [self._full_id(each) for each in ids]
        handles: dict[str, GoalHandle] = {}

        def accepted(_: JsonObject, items: list[JsonObject]) -> None:
            for goal in goals(items, "goal"):
                handles[goal.id] = GoalHandle(self, goal)
                self._followed.add(handles[goal.id], feedback=feedback)

        for some in [None] if wanted is None else batches(wanted):
            self._connection.request(Wait(some, feedback), accepted)
        return list(handles.values()) if wanted is None else [handles[each] for each in wanted]

    def cancel(
        self,
        ids: Iterable[str] | None = None,
        *,
        current: bool = False,
        before: str | None = None,
        key: str | None = None,
    ) -> Canceled:
        """Cancel the goals that are selected, or everything where no selector is given; return once it is silent.

        `ids`: these goals; an empty list selects none; `current`: the goal being spoken; `before`: this goal and all
        accepted before it; `key`: goals with this key, pending or active. UnknownGoal if an id is not known: the
        others are cancelled all the same, and are in the error's `items`.
        """
        wanted = None if ids is None else [self._full_id(each) for each in ids]
        first, *others = [None] if wanted is None else batches(wanted) or [()]
        last = None if before is None else self._full_id(before)
        requests = [Cancel(first, current, last, key), *map(Cancel, others)]
        check_key(key)
        items: list[JsonObject] = []
        unknown: list[str] = []
        for request in requests:
            try:
                items += self._connection.request(request)[1]
            except UnknownGoal as error:
                items += error.items
                unknown.append(error.message)
        if unknown:
            refused = UnknownGoal("\n".join(unknown))
            refused.items = items
            raise refused
        return Canceled.from_items(items)

    def status(self) -> ServerStatus:
        """Return what the server is saying, will say and said."""
        return ServerStatus.from_reply(*self._connection.request(Status()))

    def goal(self, goal_id: str) -> Goal:
        """Return one goal as it is now; UnknownGoal if the server doesn't know it."""
        reply, _ = self._connection.request(Status(self._full_id(goal_id)))
        return Goal.from_json(reply.get("goal"))

    def log(self, count: int = 20) -> list[Goal]:
        """Return the last `count` goals that ended, REJECTED ones too, oldest first; at most 1,200 are kept."""
        if not 0 < count <= MAX_LOG:
            raise UsageError(f"a log has 1 to {MAX_LOG} goals, not {count}")
        _, items = self._connection.request(Log(count))
        return list(goals(items, "goal"))

    def voices(self) -> list[JsonObject]:
        """Return the voices of the server's engine: objects with id, language and name."""
        _, items = self._connection.request(Voices())
        return [each["voice"] for each in items if isinstance(each.get("voice"), dict)]  # type: ignore[misc]

    def settings(self) -> JsonObject:
        """Return what goals are spoken with that say nothing else: rate, volume, voice, pitch, preempt, ttl.

        Units are those of `say`; a voice of None is the driver's own, a ttl of None is no limit.
        """
        return self.set()

    def set(
        self,
        rate: int | None = None,
        volume: float | None = None,
        voice: str | None = None,
        pitch: int | None = None,
        preempt: bool | None = None,
        ttl: float | None = None,
    ) -> JsonObject:
        """Change the running server's settings, for goals that have not begun, and return all of them as they are now.

        Those not given stay. `voice`: "default" for the driver's own; `ttl`: 0 for no limit; the others as in `say`.
        UsageError for a value out of its range; BadOption for one that this server doesn't take, such as a voice that
        its engine doesn't have.
        """
        request = Set(rate, volume, voice, pitch, preempt, ttl)
        check(request)
        reply, _ = self._connection.request(request)
        settings = reply.get("settings")
        return settings if isinstance(settings, dict) else {}

    def pause(self) -> Goal | None:
        """Hold speech where it is; return once it is silent. The goal that is held, if one was being spoken.

        Nothing is spoken until `resume`, whoever sends it. Pausing twice is no error.
        """
        return goal_in(self._connection.request(Pause(), slow=True)[0])

    def resume(self) -> Goal | None:
        """Go on where speech was held. The goal that goes on, if one was held. Resuming twice is no error."""
        return goal_in(self._connection.request(Resume())[0])

    def events(self) -> Iterator[Event]:
        """Iterate over everything that happens to any goal from now on: first a Snapshot, then StateChanged, with the
        whole goal where it begins and ends, WordHeard and PausedChanged. It has no end but Lost, when the server goes
        away; break off whenever you like.

        Words that nobody takes in time are dropped, the oldest first (`n` has gaps then). States are not: where 10,000
        wait, because other threads use this client and none takes these, it ends with Lost, too.
        """
        buffer = EventBuffer()

        def accepted(reply: JsonObject, items: list[JsonObject]) -> None:
            buffer.add(Snapshot(ServerStatus.from_reply(reply, items)))
            self._followed.watch(buffer)

        self._connection.request(Watch(), accepted)
        return self._take_all(buffer)

    # -- inside

    def _full_id(self, goal_id: str) -> str:
        return full_id(goal_id, self._connection.line.boot)

    def _take_all(self, buffer: EventBuffer) -> Iterator[Event]:
        event: Event | None = None

        def arrived() -> bool:
            nonlocal event
            event = buffer.take()
            return event is not None or buffer.overrun

        while self._connection.wait_until(arrived, lambda: None, SILENCE_LIMIT):
            if event is None:
                raise Lost(
                    f"more than {MAX_STATES} events waited and none was taken: watch again, and take them faster"
                )
            yield event
        raise Lost(f"nothing more is heard of the server at {self.path}: {self._connection.ended}")

    def _follow_late(self, handle: GoalHandle, *, feedback: bool) -> None:
        def accepted(_: JsonObject, items: list[JsonObject]) -> None:
            handle._settle(next(goals(items, "goal")))
            self._followed.add(handle, feedback=feedback)

        self._connection.request(Wait((handle.id,), feedback), accepted)
