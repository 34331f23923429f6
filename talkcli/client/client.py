"""The library's main class, which sends, follows and cancels goals.

    with Client(name="patrol") as talk:
        goal = talk.say("battery low")
        ...
        if goal.wait(timeout=10).state is not State.SUCCEEDED:
            print(goal.goal.message)

The library starts no thread, and any number of threads may use it. It imports neither click nor asyncio nor pyttsx3.
All errors except TimeoutError are subclasses of `talkcli.errors.TalkError`.
"""

from __future__ import annotations

import os
import time

from talkcli.client.connect import ANSWER_LIMIT_S
from talkcli.client.connection import ReconnectingConnection, take_repeatedly
from talkcli.client.core import EventBuffer
from talkcli.client.goal import GoalHandle
from talkcli.errors import Lost, UnknownGoal, UsageError
from talkcli.frozen import TYPE_CHECKING, replace
from talkcli.goals.goal import Goal
from talkcli.goals.options import MAX_ID_CHARS, MAX_IDS, MAX_LOG_GOALS, STALL_S, Cancel, Say, Set, bad_option, key_error
from talkcli.goals.states import State
from talkcli.protocol.events import Canceled, ServerStatus, Snapshot, goal_in, goals
from talkcli.protocol.lines import MAX_LINE_BYTES, request_line, request_to_json
from talkcli.protocol.requests import Log, Pause, Resume, Status, Voices, Wait, Watch

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from talkcli.client.connection import Connection
    from talkcli.client.core import OnReply
    from talkcli.client.stream import SpeechStream
    from talkcli.goals.goal import JsonObject
    from talkcli.protocol.events import Event

__all__ = ["Client", "GoalHandle"]

#: Number of bytes in a request that are reserved for everything except the list of ids.
_RESERVED_LINE_BYTES = 4096
#: The maximum size of an ASCII character, such as an escaped quote, and of any other character in JSON.
_MAX_ASCII_BYTES, _MAX_CHARACTER_BYTES = 2, 12
#: A `seq` that has more digits than any real one.
_LONG_SEQ = 10**15


class Client:
    """A connection to a talk server.

    The client looks for the server in the same places as the command `talk`. If the connection breaks, for example
    because the server was restarted, the next call reconnects. If the server is still the same process, its goals are
    followed again. Otherwise they are LOST.

    While there is no server, calls raise ServerUnavailable at once. There is a pause of 0.1 s between two attempts to
    reconnect, which only a cancel ignores.

    Every call that waits for an answer raises ServerUnavailable if there is none in time, or Lost if the request may
    have had an effect.
    """

    def __init__(self, socket: str | None = None, *, name: str | None = None, timeout: float = ANSWER_LIMIT_S) -> None:
        """Connect to the server.

        Args:
            socket: path of the server's socket. The default is TALK_SOCKET, or else the usual places.
            name: this sender's name in `talk status` and the log, up to 64 characters. The default is TALK_NAME.
            timeout: seconds in which the client must connect, and in which the server must answer each request.

        Raises:
            UsageError: the name is too long, or the timeout is not positive.
            ServerUnavailable, AccessDenied, Busy, ProtocolMismatch: there is no server that can be used.
        """
        if not timeout > 0:
            raise UsageError(f"the timeout must be more than 0, got {timeout!r}")
        self._connection: Connection = ReconnectingConnection(socket, name=name, patience_s=timeout)
        #: the first server's boot id, which is prepended to ids that are only numbers
        self._first_boot = self._connection.boot

    @classmethod
    def over(cls, connection: Connection) -> Client:
        """Return a client that uses an existing connection. This method is for internal use."""
        client = cls.__new__(cls)
        client._connection, client._first_boot = connection, connection.boot
        return client

    @property
    def path(self) -> str:
        """The path of the server's socket."""
        return self._connection.path

    @property
    def server_pid(self) -> int | None:
        """The server's process id."""
        return self._connection.server.pid

    def close(self) -> None:
        """Close the connection. Goals that were sent are still spoken."""
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
        id: str | None = None,  # noqa: A002 - the option has this name everywhere
        rate: int | None = None,
        volume: float | None = None,
        voice: str | None = None,
        voice_only: bool = False,
        pitch: int | None = None,
        lead_in: int | None = None,
        audible: bool | None = None,
        data: JsonObject | None = None,
        format: str = "text",  # noqa: A002 - the option has this name everywhere
        follow: bool = True,
        feedback: bool = False,
        patient: bool = False,
        block: bool = True,
    ) -> GoalHandle:
        """Send a text to be spoken. Return the handle of its goal.

        With `block`, wait until the server has accepted or REJECTED the goal.

        Args:
            text: the text to speak, up to 10,000 characters.
            preempt: stop the active goal, and speak this one first. None means the server's setting.
            flush: like `preempt`, and also recall all pending goals of the same or a lower priority.
            priority: goals with a higher priority are spoken first.
            ttl: seconds in which speaking must begin. Otherwise the goal is RECALLED. 0 means no limit, and None the
                server's setting.
            key: a label of 1 to 64 characters. The goal replaces the pending goal with the same key.
            throttle: reject the goal if another goal with the same key began less than this many seconds ago. Without a
                key, goals with the same text count.
            id: an id chosen by the sender: 1 to 64 of the characters A-Z a-z 0-9 . _ : / -. If a text is sent twice
                with the same id, it is spoken once, and the second handle is `attached` to the first goal.
            rate: speed in words per minute, 80 to 450. None means the server's setting.
            volume: volume from 0 to 1. None means the server's setting.
            voice: id, name or language of a voice. None means the server's setting.
            pitch: pitch from 0 to 100. None means the server's setting.
            voice_only: wait until a neural voice is loaded, and abort the goal with the reason `voice_failed` if
                loading fails. By default, espeak may speak instead.
            lead_in: silence before the goal in milliseconds, 0 to 5,000. It is always played. None means the server's
                setting, which is only played if the output was idle.
            audible: abort the goal with the reason `muted` if its output is muted. None means the server's setting.
            data: a JSON object of at most 1 KiB, which is stored with the goal.
            format: "text", or "markdown" for a text whose marks, code blocks, link addresses and emoji are not spoken.
            follow: receive the goal's states and its Result.
            feedback: also receive each word as it is heard, for `GoalHandle.feedback` and `events`.
            patient: if the queue is full, wait until there is room, without a time limit.
            block: wait for the server's answer. If False, the call returns at once, and the client chooses the id if
                none is given. Up to 256 KiB that the server doesn't accept yet are sent by later calls. If the goal
                can't be sent, it ends as REJECTED with the reason `not_sent`. If it was sent, but the connection broke
                or the server didn't answer within the client's timeout, it ends as LOST.

        Raises:
            UsageError: a value is out of its range. Nothing was sent.
            ProtocolMismatch: the server is too old for Markdown. Nothing was sent.
            ServerUnavailable: the server can't be reached. Nothing was sent. With `block=False`, this is raised only
                if the client is closed.
            Lost: the goal was sent, but the server didn't answer. The goal may be spoken.
            Interrupted: a patient goal was waiting for room, in one of `talk`'s own commands. The goal is not spoken if
                the client is then closed, because the server notices that within 5 s.
        """
        # The other parameters have the names of the request's fields.
        given = {name: value for name, value in locals().items() if name not in {"self", "follow", "block"}}
        request = Say(wait=follow or feedback, **given)
        if not block and id is None:
            request = replace(request, id=_new_goal_id())
        handle, accepted = self._create_handle(request)
        if handle.state.terminal:
            return handle
        if block:
            self._connection.request(request, accepted)
        else:
            handle._set_request(request, time.monotonic())
            self._connection.submit(request, accepted, handle._fail)
        return handle

    def stream(
        self,
        *,
        preempt: bool | None = None,
        flush: bool = False,
        priority: int = 0,
        ttl: float | None = None,
        key: str | None = None,
        throttle: float | None = None,
        id: str | None = None,  # noqa: A002 - the option has this name everywhere
        rate: int | None = None,
        volume: float | None = None,
        voice: str | None = None,
        voice_only: bool = False,
        pitch: int | None = None,
        lead_in: int | None = None,
        audible: bool | None = None,
        data: JsonObject | None = None,
        format: str = "text",  # noqa: A002 - the option has this name everywhere
        stall: float = STALL_S,
        feedback: bool = False,
        patient: bool = False,
    ) -> SpeechStream:
        """Return a stream that speaks a text while the text is being written.

            with talk.stream(preempt=True) as speech:
                for token in model:
                    if not speech.write(token):
                        break
            speech.wait()

        The goal is sent with the first text that can be spoken. A text has at most 50,000 characters. If the connection
        breaks, the client reconnects and continues the text.

        The arguments are those of `say`, and `stall`. If all of the text was spoken and no more text arrives for this
        time (1 to 60 seconds), the goal is ABORTED with the reason `text_stalled`. A throttle needs a key, because the
        whole text isn't known yet. If `id` is None, the client chooses an id.

        Raises:
            UsageError: a value is out of its range.
            ProtocolMismatch: the server is too old for growing texts.
        """
        given = {name: value for name, value in locals().items() if name != "self"}  # see `say`
        say = Say("", wait=True, more=True, **given)
        check(say)
        if error := self._connection.unsupported(say):
            raise error
        if id is None and isinstance(self._connection, ReconnectingConnection):
            say = replace(say, id=_new_goal_id())
        from talkcli.client.stream import SpeechStream  # rarely needed, and slow to import

        return SpeechStream(self._connection, say)

    def follow(self, ids: Iterable[str] | None = None, *, feedback: bool = False) -> list[GoalHandle]:
        """Subscribe to the events of goals. Return the goals' handles.

        Any client may have sent the goals.

        Args:
            ids: ids of goals; None for all goals that have not ended.
            feedback: also receive each word of these goals as it is heard.

        Raises:
            UsageError: an id is empty.
            UnknownGoal: the server doesn't know one of the goals.
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
        """Cancel goals, and wait until they have stopped. Return the result.

        Without arguments, cancel all goals. A goal is cancelled if any of the arguments selects it.

        Args:
            ids: select the goals with these ids. An empty list selects no goal.
            current: select the goal that is being spoken.
            before: select the goal with this id, and all goals that were accepted before it.
            key: select the active and the pending goals with this key.

        Raises:
            UsageError: an id or the key is not valid.
            UnknownGoal: an id is unknown. The other goals are cancelled, and are listed in the error's `items`.
        """
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
                items += self._connection.request(request)[1]
            except UnknownGoal as error:
                items += error.items
                unknown.append(error.message)
        if unknown:
            raise UnknownGoal("\n".join(unknown), items=items)
        return Canceled.from_items(items)

    def status(self) -> ServerStatus:
        """Return the state of the server, with its active, pending and recent goals."""
        return ServerStatus.from_reply(*self._connection.request(Status()))

    def goal(self, goal_id: str) -> Goal:
        """Return a goal in its current state. Raise UnknownGoal if the server doesn't know it.

        Raises:
            UsageError: the id is empty.
            UnknownGoal: the server doesn't know the goal.
        """
        reply, _ = self._connection.request(Status(self._full_id(goal_id)))
        return Goal.from_json(reply.get("goal"))

    def log(self, count: int = 20) -> list[Goal]:
        """Return the most recently ended goals, including REJECTED ones, oldest first.

        Args:
            count: the maximum number of goals, 1 to 2,200. The server keeps no more than 2,200.

        Raises:
            UsageError: the count is out of its range.
        """
        if not 0 < count <= MAX_LOG_GOALS:
            raise UsageError(f"the count must be 1 to {MAX_LOG_GOALS:,}, got {count}")
        _, items = self._connection.request(Log(count))
        return list(goals(items, "goal"))

    def voices(self) -> list[JsonObject]:
        """Return the voices of the server's engine.

        Each voice has the fields `id`, `language`, `name`, `quality` and `speakers`. The quality of a neural voice is a
        word such as "medium". Its speakers are a list of names, or None if there is only one speaker. Other voices have
        None for both.
        """
        _, items = self._connection.request(Voices())
        return [each["voice"] for each in items if isinstance(each.get("voice"), dict)]  # type: ignore[misc]

    def settings(self) -> JsonObject:
        """Return the server's settings, which are the defaults for new goals.

        The object has `rate`, `volume`, `voice`, `pitch`, `preempt` and `ttl`, in the units of `say`. A voice of None
        is the default voice of the driver. A ttl of None means no limit.
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
        """Change the server's settings. Return all settings.

        The new settings apply to goals that have not begun to be spoken. They last until the server ends. The units are
        those of `say`.

        Args:
            rate: words per minute. For all arguments, None leaves the setting unchanged.
            volume: volume from 0 to 1.
            voice: id, name or language of a voice, or "default" for the default voice of the driver.
            pitch: pitch from 0 to 100.
            preempt: whether each goal stops the active goal.
            ttl: seconds in which speaking must begin; 0 for no limit.

        Raises:
            UsageError: a value is out of its range.
            BadOption: the server refuses a value, for example a voice that its engine doesn't have.
        """
        request = Set(rate, volume, voice, pitch, preempt, ttl)
        check(request)
        reply, _ = self._connection.request(request)
        settings = reply.get("settings")
        return settings if isinstance(settings, dict) else {}

    def pause(self) -> Goal | None:
        """Pause all speech, and wait until it has stopped. Return the paused goal, if any.

        Return None if no goal was being spoken. Nothing is spoken until any client calls `resume`. Pausing twice is no
        error.
        """
        return goal_in(self._connection.request(Pause())[0])

    def resume(self) -> Goal | None:
        """Resume speech. Return the resumed goal, if any.

        Return None if no goal was paused. Resuming twice is no error.
        """
        return goal_in(self._connection.request(Resume())[0])

    def events(self, *, reconnect: bool = False) -> Iterator[Event]:
        """Iterate over the events of all goals, starting now.

        The first event is a Snapshot. It is followed by StateChanged, WordHeard and PausedChanged events. The first and
        the last StateChanged of a goal contain the whole goal. The iteration can be stopped at any time.

        If events are read too slowly while other threads use the client, the oldest words are dropped, and `n` has
        gaps. States are never dropped.

        Args:
            reconnect: reconnect after a break of the connection, and continue with a new Snapshot.

        Raises:
            Lost: the connection broke and `reconnect` is False, or more than 10,000 states were not read in time.
        """
        buffer = EventBuffer(reconnects=reconnect)

        def accepted(reply: JsonObject, items: list[JsonObject]) -> None:
            buffer.add(Snapshot(ServerStatus.from_reply(reply, items)))
            self._connection.listeners.watches.add(buffer)

        self._connection.request(Watch(), accepted)
        return self._take_all(buffer)

    # -- internal

    def _create_handle(self, request: Say) -> tuple[GoalHandle, OnReply]:
        """Check a `say` request. Return its goal's handle, and the function to call with the reply.

        If the text is too long for a request, the goal is already REJECTED.

        Raises:
            UsageError: a value is out of its range.
        """
        check(request)
        handle = GoalHandle(self._connection, too_long(request) or Goal("", State.PENDING))

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

    def _take_all(self, buffer: EventBuffer) -> Iterator[Event]:
        """Yield a buffer's events as they arrive. Raise Lost when the stream of events ends."""
        for event in take_repeatedly(self._connection, lambda: buffer.take() or buffer.closed, None):
            if event is None or isinstance(event, str):
                break
            yield event
        why = f"no more events from the server at {self.path}: {self._connection.ended}"
        raise Lost(buffer.closed or why)


def _new_goal_id() -> str:
    """Return a new random goal id."""
    return f"talk:{os.urandom(8).hex()}"


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


def check(request: Say | Set) -> None:
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
    from talkcli.goals.reasons import Reason  # rarely needed, and slow to import

    message = f"not spoken: the text is too long for a request ({len(request.text):,} characters)"
    return Goal("", State.REJECTED, request.text, reason=Reason.TEXT_TOO_LONG.value, message=message)
