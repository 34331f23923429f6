"""The publisher of a robot's status and events, which all subscribers receive.

The publisher watches the robot's server as long as the bridge runs. If the broker is too slow, events are dropped. If a
payload is too long for the broker, it is published without texts.
"""

from __future__ import annotations

import asyncio
import random
from functools import partial
from typing import TYPE_CHECKING

from talkcli.client.core import Exchange
from talkcli.daemon import log
from talkcli.errors import BadRequest, ServerUnavailable, TalkError
from talkcli.fleet import topics
from talkcli.fleet.bridge.local import LocalConnection
from talkcli.fleet.bridge.policy import PRIVATE_FIELDS
from talkcli.fleet.payloads import LastGoal, Message, RobotStatus
from talkcli.frozen import fields, replace
from talkcli.goals.options import MAX_LOG_GOALS, Log
from talkcli.goals.states import State
from talkcli.protocol.events import (
    GoalInterrupted,
    PausedChanged,
    ServerStatus,
    StateChanged,
    TextAdded,
    from_json,
    goals,
    unfinished,
)
from talkcli.protocol.features import FEATURES
from talkcli.protocol.lines import decode, encode
from talkcli.protocol.requests import Watch

if TYPE_CHECKING:
    from collections.abc import Callable

    from talkcli.fleet.bridge.session import RemoteSessions
    from talkcli.goals.goal import Goal, JsonObject
    from talkcli.protocol.events import Event

    PublishToAll = Callable[[Message], None]

#: How long the broker keeps an undelivered event.
EVENT_EXPIRY_S = 60
#: Minimum time between two status messages.
_STATUS_EVERY_S = 1.0
#: Delay between a change and the status message about it. A cancelled goal takes a few milliseconds to end. Without the
#: delay, the status would show the goal as active for another second.
_STATUS_AFTER_CHANGE_S = 0.1
#: Maximum length of a goal's text in the status. Longer texts are cut off.
_MAX_STATUS_TEXT_CHARS = 1_000
#: Maximum random pause before the first attempt to reconnect to the server, and before later ones.
_FIRST_SERVER_RETRY_S, _LAST_SERVER_RETRY_S = 0.2, 5.0


class Publisher:
    """Watches the robot's server, and publishes its status and events."""

    def __init__(self, sessions: RemoteSessions, publish: PublishToAll, on_server_change: Callable[[], None]) -> None:
        """Create a publisher that isn't connected to the server yet.

        Args:
            sessions: the remote sessions, which receive all changes of goals.
            publish: publishes a message to all subscribers.
            on_server_change: called after connecting to the server and after disconnecting from it.
        """
        self._sessions = sessions
        self._publish = publish
        self._on_server_change = on_server_change
        #: boot id, pid, version and features of the server; None if the bridge isn't connected to it
        self.server: JsonObject | None = None
        self._connection: LocalConnection | None = None
        #: texts of unfinished goals, by goal id
        self._texts: dict[str, str | None] = {}
        #: id of the active goal
        self._active: str | None = None
        #: ids of the interrupted goals
        self._interrupted: set[str] = set()
        #: the goal that ended last
        self._last: Goal | None = None
        self._paused = False
        #: timer for the next status
        self._timer: asyncio.TimerHandle | None = None
        #: when the last status was published, by the event loop's clock
        self._published_at = 0.0
        self._loop = asyncio.get_running_loop()

    async def run(self) -> None:
        """Watch the server, and reconnect whenever the connection ends."""
        self._retry_s = _FIRST_SERVER_RETRY_S
        while True:
            try:
                server = self._connection = await LocalConnection.open(self._sessions.socket, name="talk bridge")
                try:
                    await self._watch_server(server)
                finally:
                    self._connection = None
                    server.close()
                    if self.server:
                        self._set_server(None, ServerStatus({}, None, (), ()), "")
            except TalkError as error:
                words = " ".join(str(error).split())
                log.write_limited("server", f"not connected to the server: {log.sanitize(words)}")
            await asyncio.sleep(random.uniform(0, self._retry_s))
            self._retry_s = min(_LAST_SERVER_RETRY_S, self._retry_s * 2)

    async def _watch_server(self, server: LocalConnection) -> None:
        """Watch the server, and process its lines until the connection ends.

        Raises:
            ServerUnavailable: The server refused to be watched.
        """

        def remember(_: JsonObject, ended: list[JsonObject]) -> None:
            for goal in goals(ended, "goal"):
                self._sessions.remember(goal, server.boot)

        def refuse(error: TalkError) -> None:
            raise ServerUnavailable(f"the server at {server.path} can't be watched: {error}")

        # Request the log first, because it contains the goals that an earlier bridge has sent.
        server.send(Exchange(Log(MAX_LOG_GOALS), remember))
        server.send(Exchange(Watch(), partial(self._on_watch_reply, server), refuse))
        while lines := await server.read():
            self._receive(server, lines)
        log.write("the connection to the server has ended")

    def schedule_status(self) -> None:
        """Schedule the robot's next status message, unless one is already scheduled."""
        if self._timer is None:
            due = max(self._loop.time() + _STATUS_AFTER_CHANGE_S, self._published_at + _STATUS_EVERY_S)
            self._timer = self._loop.call_at(due, self._publish_status)

    def tick(self) -> None:
        """Disconnect from the server if it hangs. Call this every few seconds."""
        server = self._connection
        if server and self._loop.time() > server.silence_deadline(0.0)[0]:
            path = log.sanitize(server.path)
            log.write_limited("silence", f"the server at {path} does not respond; restart it if it hangs")
            server.abort()

    # -- from the server

    def _receive(self, server: LocalConnection, lines: list[bytes]) -> None:
        """Decode lines from the server, and pass on the replies and events. Log malformed lines."""
        for line in lines:
            try:
                message = decode(line)
                if "event" in message:
                    self._receive_event(server, message, line)
                else:
                    server.dispatch(message, self._loop.time())
            except (BadRequest, ValueError) as error:
                log.write_limited("line", f"the server sent a malformed message: {log.sanitize(str(error))}")

    def _on_watch_reply(self, server: LocalConnection, reply: JsonObject, items: list[JsonObject]) -> None:
        """Store the server's status from its reply to `watch`, and report that the server is connected."""
        status = ServerStatus.from_reply(reply, items)
        self._retry_s = _FIRST_SERVER_RETRY_S
        for each in unfinished(status):
            self._sessions.remember(each, server.boot)
        log.write(f"connected to the server at {log.sanitize(server.path)} (pid {server.server.pid})")
        # Leave out features that this bridge doesn't know, because it may be unable to pass on their requests.
        features = [each for each in FEATURES if each in (server.server.features or ())]
        self._set_server({**fields(server.server), "features": features}, status, server.boot)

    def _set_server(self, server_info: JsonObject | None, status: ServerStatus, boot: str) -> None:
        """Replace the stored state of the server and its goals, and call `on_server_change`."""
        self.server = server_info
        self._active = status.active.id if status.active else None
        self._interrupted = {each.id for each in status.interrupted}
        self._texts = {each.id: _shown_text(each) for each in unfinished(status)}
        self._last = status.recent[-1] if status.recent else self._last
        self._paused = status.server.get("paused") is True
        self._sessions.reset_pending(status.pending, boot)
        self._on_server_change()
        self.schedule_status()

    def _receive_event(self, server: LocalConnection, message: JsonObject, line: bytes) -> None:
        """Store what an event changes. If a goal's state or the pause has changed, publish the event."""
        event = from_json(message)
        if isinstance(event, StateChanged):
            self._update_goals(event)
            self._sessions.handle_goal_change(event, server.boot)
        elif isinstance(event, PausedChanged):
            self._paused = event.paused
        elif isinstance(event, GoalInterrupted):
            self._active = None if self._active == event.id else self._active
            self._interrupted.add(event.id)
        else:
            if isinstance(event, TextAdded):
                self._add_text(event)
            return
        self._publish_event(str(message["event"]), event, line + b"\n")

    def publish_end(self, goal: Goal) -> None:
        """Publish the end of a goal that the bridge has ended itself, without sending it to the server."""
        self._last = goal
        event = StateChanged(goal.id, goal.state, goal.ended_at, goal=goal)
        self._publish_event("state", event, encode(event.to_json()))

    def _publish_event(self, kind: str, event: Event, line: bytes) -> None:
        """Publish an event, and schedule a status. Leave out texts that are private or too long."""
        shown = self._sessions.with_text and len(line) <= self._sessions.max_payload()
        if isinstance(event, StateChanged) and event.goal and not shown:
            goal = replace(event.goal, **dict.fromkeys(PRIVATE_FIELDS))
            line = encode(replace(event, goal=goal).to_json())
        topic = topics.robot(self._sessions.name, topics.EVENT, kind)
        self._publish(Message(topic, line, expiry=EVENT_EXPIRY_S))
        self.schedule_status()

    def _update_goals(self, event: StateChanged) -> None:
        """Update the stored active goal, last goal and texts from an event."""
        self._interrupted.discard(event.id)
        if event.state is State.PENDING:
            self._texts[event.id] = _shown_text(event.goal)
        elif event.state is State.ACTIVE:
            self._active = event.id
        elif event.state.terminal:
            self._texts.pop(event.id, None)
            self._active = None if self._active == event.id else self._active
            self._last = event.goal or self._last

    def _add_text(self, event: TextAdded) -> None:
        """Add text to the stored beginning of a goal's text. If the status shows the text, schedule a status."""
        known = self._texts.get(event.id)
        if known and len(known) < _MAX_STATUS_TEXT_CHARS:
            self._texts[event.id] = (known + event.text)[:_MAX_STATUS_TEXT_CHARS]
            if event.id == self._active and self._sessions.with_text:
                self.schedule_status()

    # -- to the broker

    def _publish_status(self) -> None:
        """Publish the robot's status as a retained message.

        Leave out texts that are private or too long.
        """
        self._timer, self._published_at = None, self._loop.time()
        active, last = self._active, self._last
        text = self._texts.get(active) if active else None
        ended = LastGoal(last.id, last.state, last.reason, _shown_text(last), last.ended_at) if last else None
        pending = len(self._texts.keys() - {active} - self._interrupted)
        status = RobotStatus(active, text, pending, self._paused, ended).to_json()
        payload = encode(status)
        if not self._sessions.with_text or len(payload) > self._sessions.max_payload():
            for each in (status, status["last"]):
                if isinstance(each, dict):
                    del each["text"]
            payload = encode(status)
        self._publish(Message(topics.robot(self._sessions.name, topics.STATUS), payload, retained=True))


def _shown_text(goal: Goal | None) -> str | None:
    """Return the beginning of a goal's text, as shown in the status."""
    return goal.text[:_MAX_STATUS_TEXT_CHARS] if goal and goal.text else None
