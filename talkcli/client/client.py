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

from talkcli.client.connection import SocketConnection, taken
from talkcli.client.following import MAX_STATES, EventBuffer
from talkcli.client.goal import GoalHandle
from talkcli.errors import Lost, UnknownGoal, UsageError
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.goal import Goal
from talkcli.goals.option import MAX_ID, MAX_IDS, MAX_LOG
from talkcli.goals.options import Cancel, Say, Set, bad_key, bad_option
from talkcli.goals.states import State
from talkcli.protocol.events import Canceled, ServerStatus, Snapshot, goal_in, goals
from talkcli.protocol.lines import MAX_LINE, request_line, write_request
from talkcli.protocol.requests import Log, Pause, Resume, Status, Voices, Wait, Watch

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from talkcli.client.connection import Connection, OnReply
    from talkcli.goals.goal import JsonObject
    from talkcli.protocol.events import Event

__all__ = ["Client", "GoalHandle"]

#: Bytes of a request's line that are left for what isn't its list of ids: another id, a key, the names of the fields.
_REST_OF_LINE = 4096
#: Bytes of JSON that one character may take: a quote with its backslash, two halves of a surrogate pair, escaped.
_LONGEST_ASCII, _LONGEST_CHARACTER = 2, 12
#: The number of a request has no more digits than this.
_LONGEST_NUMBER = 10**15


class Client:
    """A connection to a talk server; the socket is found as the command `talk` finds it."""

    def __init__(self, socket: str | None = None, *, name: str | None = None) -> None:
        """Connect.

        `socket`: path of the server's socket, default TALK_SOCKET, then the usual places; `name`: what this sender
        calls itself in `talk status` and the log, default TALK_NAME.

        UsageError for a name that is too long; ServerUnavailable, AccessDenied, Busy or ProtocolMismatch where there is
        no server to be had: nothing was sent then.
        """
        self._connection: Connection = SocketConnection(socket, name=name)

    @classmethod
    def over(cls, connection: Connection) -> Client:
        """Return a client on a connection that there is already. Internal: for `talk`'s own commands, no promise."""
        client = cls.__new__(cls)
        client._connection = connection
        return client

    @property
    def path(self) -> str:
        """The socket of the server."""
        return self._connection.path

    @property
    def server_pid(self) -> int | None:
        return self._connection.pid

    def close(self) -> None:
        """Close the connection. What was sent is spoken all the same."""
        self._connection.close()

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
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
        voice_only: bool = False,
        pitch: int | None = None,
        lead_in: int | None = None,
        audible: bool | None = None,
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
        the server's setting when it starts. `voice_only`: wait until a neural voice is loaded, and be ABORTED,
        `voice_failed`, where it can't be; else espeak may speak in its place. `lead_in`: 0 to 5,000 milliseconds of
        silence before it, also where the output was not idle; None is the server's, where it was. `audible`: whether it
        is ABORTED, `muted`, where its output is muted; None leaves that to the server. `data`: an object of at most 1
        KiB that travels with the goal.

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
            voice_only=voice_only,
            pitch=pitch,
            lead_in=lead_in,
            audible=audible,
            data=data,
        )
        handle, accepted = self._handle(request)
        if not handle.state.terminal:
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
                handles[goal.id] = GoalHandle(self._connection, goal)
                handles[goal.id]._listen(feedback=feedback)

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
        if key is not None and (fault := bad_key(key)):
            raise UsageError(fault)
        items: list[JsonObject] = []
        unknown: list[str] = []
        for request in requests:
            try:
                items += self._connection.request(request)[1]
            except UnknownGoal as error:
                items += error.items
                unknown.append(error.message)
        if unknown:
            raise UnknownGoal("\n".join(unknown), items=items)
        return Canceled.from_items(items)

    def status(self) -> ServerStatus:
        """Return what the server is saying, will say and said."""
        return ServerStatus.from_reply(*self._connection.request(Status()))

    def goal(self, goal_id: str) -> Goal:
        """Return one goal as it is now; UnknownGoal if the server doesn't know it."""
        reply, _ = self._connection.request(Status(self._full_id(goal_id)))
        return Goal.from_json(reply.get("goal"))

    def log(self, count: int = 20) -> list[Goal]:
        """Return the last `count` goals that ended, REJECTED ones too, oldest first; at most 2,200 are kept."""
        if not 0 < count <= MAX_LOG:
            raise UsageError(f"a log has 1 to {MAX_LOG} goals, not {count}")
        _, items = self._connection.request(Log(count))
        return list(goals(items, "goal"))

    def voices(self) -> list[JsonObject]:
        """Return the voices of the server's engine: objects with id, language, name, quality and speakers.

        The last two are a neural voice's: None, or how good its maker calls it, "medium"; and None, or what each of its
        speakers is called, by number.
        """
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
            self._connection.followed.watch(buffer)

        self._connection.request(Watch(), accepted)
        return self._take_all(buffer)

    # -- inside

    def _handle(self, request: Say) -> tuple[GoalHandle, OnReply]:
        """Return a handle for a goal that has not been sent, and the function that takes in the server's answer.

        The handle is REJECTED if the text is too long to be sent. UsageError for a value out of its range.
        """
        check(request)
        handle = GoalHandle(self._connection, too_long(request) or Goal("", State.PENDING))

        def accepted(reply: JsonObject, _: list[JsonObject]) -> None:
            handle.goal = Goal.from_json(reply.get("goal"))
            handle.attached = reply.get("attached") is True
            handle.speech_paused = reply.get("paused") is True
            if request.wait:
                handle._listen(feedback=request.feedback)

        return handle, accepted

    def _full_id(self, goal_id: str) -> str:
        """Return the whole id for a number alone, which means a goal of this server; what `check_id` raises."""
        if goal_id.isascii() and goal_id.isdecimal():
            goal_id = f"{self._connection.boot}-{goal_id}"
        check_id(goal_id)
        return goal_id

    def _take_all(self, buffer: EventBuffer) -> Iterator[Event]:
        for event in taken(self._connection, lambda: buffer.take() or buffer.overrun, None):
            if isinstance(event, bool):
                break
            yield event
        if buffer.overrun:
            raise Lost(f"more than {MAX_STATES} events waited and none was taken: watch again, and take them faster")
        raise Lost(f"nothing more is heard of the server at {self.path}: {self._connection.ended}")


def check_id(goal_id: str) -> None:
    """UsageError for an empty id, UnknownGoal for one that no goal can have."""
    if not goal_id:
        raise UsageError("an id is empty: is the variable set that it comes from?")
    if len(goal_id) > MAX_ID:
        raise UnknownGoal(f"no goal {goal_id[:MAX_ID]!a}… is known: an id has at most {MAX_ID} characters")


def batches(ids: Iterable[str]) -> list[tuple[str, ...]]:
    """Return the ids in their order, each once, in parts that each fit into a request's line."""
    parts: list[list[str]] = []
    room = 0
    for each in dict.fromkeys(ids):
        plain = each.isascii() and each.isprintable()
        size = (_LONGEST_ASCII if plain else _LONGEST_CHARACTER) * len(each) + len('"", ')
        if not parts or size > room or len(parts[-1]) == MAX_IDS:
            parts.append([])
            room = MAX_LINE - _REST_OF_LINE
        room -= size
        parts[-1].append(each)
    return [tuple(each) for each in parts]


def check(request: Say | Set) -> None:
    """Raise UsageError for options of the wrong kind, or out of their range: as the server would, without asking it."""
    for option in request.options:
        try:
            fault = option.fault(getattr(request, option.name))
        except (TypeError, ValueError) as error:  # something in `data`
            fault = f"is no JSON: {error}"
        if fault:
            raise UsageError(f"{option.name!r} {fault}")
    if words := bad_option(request):
        raise UsageError(words)


def too_long(request: Say) -> Goal | None:
    """Return the goal that the server would have made of a text that doesn't fit into a request, None if it fits."""
    try:
        line = request_line({"seq": _LONGEST_NUMBER, **write_request(request)})
    except ValueError as error:  # NaN in `data`
        raise UsageError(f"'data' is no JSON: {error}") from None
    if len(line) <= MAX_LINE:
        return None
    message = f"Talk rejected: the text has {len(request.text):,} characters, more than a request can hold"
    return Goal("", State.REJECTED, request.text, reason="text_too_long", message=message)
