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

from talkcli.client.calls import ClientCalls, ConnectedClient, Paused, Saying, with_parameters_of
from talkcli.client.connect import ANSWER_LIMIT_S
from talkcli.client.connection import ReconnectingConnection
from talkcli.client.goal import GoalHandle
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.options import PAUSE_S, SOUND, STALL_S
from talkcli.polling import run_blocking

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from contextlib import AbstractContextManager
    from typing import Any

    from talkcli.client.connection import Connection
    from talkcli.client.stream import SpeechStream
    from talkcli.goals.goal import Goal, JsonObject
    from talkcli.goals.states import State
    from talkcli.protocol.events import Canceled, Event, ServerStatus

__all__ = ["Client", "GoalHandle"]


class Client(ConnectedClient):
    """A blocking client of a talk server, which reconnects after a break.

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
        self._connection = run_blocking(ReconnectingConnection.open(socket, name=name, patience_s=timeout))
        self._calls = ClientCalls(self._connection)

    @classmethod
    def over(cls, connection: Connection) -> Client:
        """Return a client that uses an existing connection. This method is for internal use."""
        client = cls.__new__(cls)
        client._connection, client._calls = connection, ClientCalls(connection)
        return client

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
        interject: bool = False,
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
            interject: interrupt the active goal at the end of a word. It continues with its next word afterwards.
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
            ProtocolMismatch: the server is too old for Markdown, sounds or interjections. Nothing was sent.
            ServerUnavailable: the server can't be reached. Nothing was sent. With `block=False`, this is raised only
                if the client is closed.
            Lost: the goal was sent, but the server didn't answer. The goal may be spoken.
            Interrupted: a patient goal was waiting for room, in one of `talk`'s own commands. The goal is not spoken if
                the client is then closed, because the server notices that within 5 s.
        """
        given = {name: value for name, value in locals().items() if name != "self"}
        return run_blocking(self._calls._say(GoalHandle, **given))

    def dry_run(self, text: str, **options: Any) -> Goal:
        """Check a text without speaking it. Return the accepted or REJECTED goal.

        The goal has no id. Its `said` is the text as it would be said, or None if it would be said as it is. The
        options are those of `say` that describe the goal.

        Raises:
            UsageError: a value is out of its range.
            ProtocolMismatch: the server is too old for dry runs.
        """
        return run_blocking(self._calls.dry_run(text, **options))

    @with_parameters_of(say)
    def saying(self, text: str, **options: Any) -> AbstractContextManager[GoalHandle]:
        """Return a context manager that speaks a text, and cancels the goal when its block ends.

            with talk.saying("please step back") as goal:
                wait_until_path_is_free()

        The goal is sent when the block begins. It is cancelled when the block ends, unless it has ended before. The
        arguments and errors are those of `say`.

        At the end of the block, the errors are those of `GoalHandle.cancel`. If an exception ends the block, it is
        raised instead.
        """
        return _BlockingManager(Saying(self._calls, GoalHandle, text, **options))

    @with_parameters_of(say)
    def play(self, text: str, **options: Any) -> GoalHandle:
        """Send a sound to be played. Return the handle of its goal.

        A sound is a goal like a sentence, but it has no words. Its `text` is one of the names that `sounds` returns. If
        there is no such sound, the goal is REJECTED with the reason `unknown_sound`. If its file can't be played, the
        reason is `bad_sound`.

        The arguments and errors are those of `say`. A sound can't have the arguments `rate`, `voice`, `voice_only`,
        `pitch` and `format`.
        """
        return self.say(text, format=SOUND, **options)

    def stream(
        self,
        *,
        preempt: bool | None = None,
        flush: bool = False,
        interject: bool = False,
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
            ProtocolMismatch: the server is too old for growing texts, Markdown or interjections.
        """
        given = {name: value for name, value in locals().items() if name != "self"}
        say = self._calls._stream_request(**given)
        from talkcli.client.stream import SpeechStream  # this import is slow and rarely needed

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
        return run_blocking(self._calls._follow(GoalHandle, ids, feedback=feedback))

    def cancel(
        self,
        ids: Iterable[str] | None = None,
        *,
        current: bool = False,
        before: str | None = None,
        key: str | None = None,
    ) -> Canceled:
        """Cancel goals, and wait until they have stopped. Return these goals and the ones that had ended before.

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
        return run_blocking(self._calls.cancel(ids, current=current, before=before, key=key))

    def status(self) -> ServerStatus:
        """Return the state of the server, with its active, pending and recent goals."""
        return run_blocking(self._calls.status())

    def goal(self, goal_id: str) -> Goal:
        """Return a goal in its current state. Raise UnknownGoal if the server doesn't know it.

        Raises:
            UsageError: the id is empty.
            UnknownGoal: the server doesn't know the goal.
        """
        return run_blocking(self._calls.goal(goal_id))

    def log(
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
        """Return the most recently ended goals, including REJECTED ones, oldest first.

        All filters must match. None matches every goal.

        Args:
            count: the maximum number of goals, 1 to 2,200.
            since: only goals that ended at this time or later, in seconds since 1970 UTC.
            until: only goals that ended before this time.
            state: only goals that ended in this state.
            name: only goals whose sender has this name.
            key: only goals with this key.
            grep: only goals whose text contains this string.
            history: include the goals in the server's history on disk, if it keeps one. The server remembers at most
                2,200 other goals, and none from before its start.

        Raises:
            UsageError: a value is out of its range.
            ProtocolMismatch: the server is too old for filters.
            RequestRefused: the history can't be read.
        """
        given = {name: value for name, value in locals().items() if name != "self"}
        return run_blocking(self._calls.log(**given))

    def voices(self) -> list[JsonObject]:
        """Return the voices of the server's engine.

        Each voice has the fields `id`, `language`, `name`, `quality` and `speakers`. The quality of a neural voice is a
        word such as "medium". Its speakers are a list of names, or None if there is only one speaker. Other voices have
        None for both.
        """
        return run_blocking(self._calls.voices())

    def sounds(self) -> list[str]:
        """Return the names of the sounds that `play` can play."""
        return run_blocking(self._calls.sounds())

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
        return run_blocking(self._calls.set(rate, volume, voice, pitch, preempt, ttl))

    def pause(self, seconds: float | None = None) -> Goal | None:
        """Pause all speech for up to `seconds`. Wait until it has stopped, and return the paused goal, if any.

        Return None if no goal was being spoken. Nothing is spoken until any client calls `resume`. Pausing twice is no
        error.

        Args:
            seconds: end the pause after this time, 0.1 to 86,400. None means no limit.

        Raises:
            UsageError: `seconds` is out of its range.
        """
        return run_blocking(self._calls.pause(seconds))

    def paused(self, seconds: float = PAUSE_S) -> AbstractContextManager[Goal | None]:
        """Return a context manager that pauses all speech during its block, for at most `seconds`.

            with talk.paused():
                answer = listen()

        The value of the context is the paused goal, if any. The pause has a connection of its own, and ends with it: at
        the end of the block, or when the program dies, in any way. Speech continues when all pauses have ended, or when
        any client calls `resume`.

        Args:
            seconds: end the pause after this time, 0.1 to 86,400, in case the program hangs.

        Raises:
            UsageError: `seconds` is out of its range, or this client uses a broker.
        """
        return _BlockingManager(Paused(self._calls, seconds))

    def resume(self) -> Goal | None:
        """Resume speech. Return the resumed goal, if any.

        Return None if no goal was paused. Resuming twice is no error.
        """
        return run_blocking(self._calls.resume())

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
        next_event = run_blocking(self._calls._watch(reconnect=reconnect))
        return iter(lambda: run_blocking(next_event()), None)


class _BlockingManager:
    """A context manager that runs an asynchronous context manager and blocks instead of suspending."""

    def __init__(self, manager: Saying | Paused) -> None:
        self._manager = manager

    def __enter__(self) -> Any:
        return run_blocking(self._manager.__aenter__())

    def __exit__(self, *error: object) -> None:
        run_blocking(self._manager.__aexit__(*error))  # type: ignore[arg-type]
