"""Classes for a request to several robots at once.

If the robots are selected by a pattern, each of them is sent its own request. If they are selected by a group, a single
message is sent, which the broker delivers to all members. The members are known from their presence and their answers.
A request counts as successful only if the robot itself has confirmed it.
"""

from __future__ import annotations

import itertools
import time
from collections import deque
from typing import TYPE_CHECKING

from talkcli.client.calls import batches, check, check_id, too_long
from talkcli.client.connect import ANSWER_LIMIT_S
from talkcli.client.goal import GoalHandle, end_time
from talkcli.errors import EXIT_OK, Lost, ServerUnavailable, TalkError, UnknownGoal, Unreadable, UsageError
from talkcli.fleet import topics
from talkcli.fleet.desk.link import DeskLink
from talkcli.fleet.desk.request import Outcome, Selection, cancel_outcomes, failure_outcome, reply_outcomes
from talkcli.fleet.desk.robot import RobotConnection, RobotExchange, new_goal_id
from talkcli.fleet.link import Link, boottime
from talkcli.fleet.payloads import Message, Presence
from talkcli.frozen import replace
from talkcli.goals.goal import Goal, JsonObject
from talkcli.goals.options import Cancel, Say, Set, key_error
from talkcli.goals.states import State
from talkcli.polling import block_until_ready, run_blocking
from talkcli.protocol.events import goals
from talkcli.protocol.lines import FIRST_SEQ
from talkcli.protocol.requests import Request, Status, Wait

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from typing import Any

    from talkcli.fleet.broker import Broker
    from talkcli.polling import WaitReady

#: The default ttl of a sentence. It prevents a robot from saying something that was only true a minute ago.
DEFAULT_TTL_S = 10.0
#: How often to check for robots that haven't answered in time.
_CHECK_INTERVAL_S = 0.25
#: The maximum number of messages to process before a check for late robots. There may be many messages if this process
#: was suspended.
_MAX_MESSAGES_PER_CHECK = 5000
#: How long to wait for the tokens of robots, and how long `close` waits for the broker to acknowledge the request.
_FLUSH_LIMIT_S = 1.0


class FleetRequestCalls:
    """The base class of requests to several robots, with coroutines for the calls that wait."""

    def __init__(
        self,
        broker: Broker,
        selection: Selection,
        request: Request,
        *,
        name: str | None = None,
        interrupt: Mapping[int, int] | None = None,
        patience_s: float = ANSWER_LIMIT_S,
        wait: WaitReady = block_until_ready,
    ) -> None:
        """Check and prepare a request, without connecting to the broker.

        Args:
            broker: the broker of the fleet.
            selection: the robots.
            request: the request. It must refer to goals by their ids, because their numbers differ between robots.
            name: the name of the sender. The default is TALK_NAME.
            interrupt: file descriptors that interrupt any wait, as in `wait_ready`.
            patience_s: the time in seconds within which the broker and each robot must answer.
            wait: waits until descriptors are ready. By default, it blocks.

        Raises:
            UsageError: The selection or the request is not valid.
            UnknownGoal: The request contains an invalid goal id.
        """
        if selection.fault:
            raise UsageError(selection.fault)
        _check_request(request)
        self._selection, self._name, self._interrupt, self._patience = selection, name, interrupt, patience_s
        #: all known robots by name, including those that came online too late to receive the request
        self._robots: dict[str, RobotRequest] = {}
        #: the names of the robots that the request is for, and of the robots that haven't finished yet
        self._included, self._unfinished = set[str](), set[str]()
        self._outcomes: deque[Outcome] = deque()
        self._numbers = itertools.count(FIRST_SEQ)
        #: the number of the message, if the request was sent to a group
        self._number = next(self._numbers)
        #: the error if the broker has rejected the message to the group
        self._refused: TalkError | None = None
        #: whether the request has been started and not closed yet
        self._began = False
        #: whether all robots are known. Robots that appear later are ignored.
        self._complete = False
        self._closed = False
        #: the id of the goal that `cancel` has cancelled, or None if `cancel` hasn't been called
        self._canceled_id: str | None = None
        #: monotonic time of the next check for late robots
        self._next_check = 0.0
        self._desk = DeskLink(broker, wait)
        self._desk.handler = self
        if isinstance(request, Say):
            ttl = DEFAULT_TTL_S if request.ttl is None else request.ttl
            request = replace(request, id=request.id or new_goal_id(self._desk), ttl=ttl)
        self.request = request
        #: the rejected goal, if the text is too long for any server. In that case, the request isn't sent.
        self._rejected = too_long(request) if isinstance(request, Say) else None

    def __len__(self) -> int:
        """Return the number of selected robots found so far, including offline robots."""
        return len(self._included)

    @property
    def unfinished_robots(self) -> list[str]:
        """The names of the robots that haven't finished yet, sorted."""
        return sorted(self._unfinished)

    @property
    def why_disconnected(self) -> str | None:
        """An error message while the broker is disconnected, otherwise None."""
        return None if self._desk.link else f"the connection to the broker at {self._desk.broker.url} was lost"

    async def _start(self) -> None:
        """Connect to the broker, and send the request, unless this was done before.

        Raises:
            ServerUnavailable: The broker can't be reached.
            AccessDenied: The broker rejected the login, or its access rules don't allow the request.
        """
        if self._began or self._closed:
            return
        try:
            await self._desk.wait_for_retained(self._patience, interrupt=self._interrupt)
            ttl = self.request.ttl if isinstance(self.request, Say) else None
            #: when the sentence expires (by the `boottime` clock), or None if it never does
            self._expires_at = boottime() + ttl if ttl else None
            self._began, self._next_check = True, time.monotonic() + _CHECK_INTERVAL_S
            self._send_to_known_robots()
            await self._await_tokens()
        except BaseException:
            await self._close()
            raise

    async def _next_outcome(self, deadline: float | None, timeout: float | None) -> Outcome | None:
        """Return the next outcome, or None after the last one. Raise TimeoutError after the deadline.

        Args:
            deadline: the monotonic time limit.
            timeout: the number of seconds to name in the error message.
        """
        await self._start()
        while not (self._outcomes or self._closed):
            if self._refused is not None:
                await self._close()
                raise self._refused
            self._complete = self._complete or self._desk.retained_received
            if self._complete and not self._unfinished:
                await self._close()
                if not len(self):
                    raise self._no_robot_error()
                return None
            now = time.monotonic()
            if deadline is not None and now >= deadline:
                done = len(self) - len(self._unfinished)
                raise TimeoutError(f"{done} of {len(self)} robots have finished after {round(timeout or 0.0, 1):g} s")
            await self._desk.poll(min(self._next_check, deadline or self._next_check) - now, self._interrupt)
            if time.monotonic() >= self._next_check:
                await self._check_for_late_robots()
                self._next_check = time.monotonic() + _CHECK_INTERVAL_S
        return self._outcomes.popleft() if self._outcomes else None

    def cancel(self) -> None:
        """Cancel the sentence on all robots that haven't finished it.

        If a robot is absent, it cancels the sentence when it is back. Later outcomes report how the goals have ended.
        If the request isn't a sentence, this method has no effect.

        Raises:
            UsageError: The request has not been sent, or all outcomes have been returned. In the second case, cancel
                the goal by its id.
        """
        if not isinstance(self.request, Say):
            return
        if not self._began:
            why = "has ended; to cancel its goal, use the goal's id" if self._closed else "has not been sent"
            raise UsageError(f"this request {why}")
        goal_id = self._canceled_id = str(self.request.id)
        group = self._selection.group
        if group is not None:
            self._desk.send(Cancel((goal_id,)), next(self._numbers), group, self._on_refused, is_group=True)
        for name in list(self._unfinished):
            # A robot that has left the group doesn't receive the message to the group, so it gets its own message.
            robot = self._robots[name]
            is_sent = group is not None and robot.presence is not None and self._selection.includes(robot.presence)
            robot.connection.cancel_after_absence(goal_id, also_now=not is_sent)

    async def _close(self) -> None:
        """Send all queued messages, and close the connection. This doesn't cancel the request."""
        began, self._began, self._closed = self._began, False, True
        if began:
            await self._await_tokens()
            await self._desk.flush(_FLUSH_LIMIT_S)
            if self._selection.group is not None:
                self._desk.end_session(self._selection.group, is_group=True)
            else:
                for each in self._robots.values():
                    if each.was_asked:
                        each.connection.end_session()
        self._desk.close()

    async def _await_tokens(self) -> None:
        """Wait briefly until the sentence has been sent to all robots whose tokens were requested."""
        end = time.monotonic() + _FLUSH_LIMIT_S
        while self._desk.link and any(each.connection.awaits_token for each in self._robots.values()):
            if (left := end - time.monotonic()) <= 0:
                break
            await self._desk.poll(left)

    def _send_to_known_robots(self) -> None:
        """Send the request to the group, or to each selected robot that is known."""
        group = self._selection.group
        if group is not None and self._rejected is None:
            self._desk.send(self.request, self._number, group, self._on_refused, is_group=True)
            if self._refused is not None:
                raise self._refused
        for robot in list(self._robots.values()):
            if robot.presence and self._selection.includes(robot.presence):
                self._on_presence(robot, robot.presence)

    def _on_refused(self, error: TalkError) -> None:
        """Store the error for a rejected message to the group. `results` raises this error."""
        self._refused = error

    async def _check_for_late_robots(self) -> None:
        """Process all waiting messages, and record a failure for each robot that is late."""
        for _ in range(_MAX_MESSAGES_PER_CHECK):
            if not await self._desk.poll(0.0, self._interrupt):
                break
        for name in list(self._unfinished):
            self._record_ended_goals(name, fail_if_late=True)

    def _no_robot_error(self) -> TalkError:
        """Return the error to raise if no robot matches the selection."""
        selection, url = self._selection, self._desk.broker.url
        if selection.group is not None and self.why_disconnected:
            words = f"{self.request.kind} was sent to the group '{selection.group}', but {self.why_disconnected}"
            return Lost(f"{words}; it may still be carried out")
        group = selection.group
        which = f"is in the group '{group}'" if group is not None else f"matches '{selection.text}'"
        return ServerUnavailable(f"no robot {which} at {url}, so nothing was sent; list them with: talk fleet status")

    # -- messages from the broker

    def on_connected(self, link: Link) -> None:
        """Subscribe to all replies to this connection, and to the presence of all robots."""
        link.subscribe(topics.reply(self._desk.user, self._desk.session, topics.ANY), retained=False)
        link.subscribe(topics.robot(topics.ANY, topics.PRESENCE), retained=True)

    def on_disconnected(self, why: str) -> None:
        """Treat all robots as absent until they are back, and ignore new robots from now on."""
        # Ignore robots that appear later. When the broker is back, it may be too late to send them the request.
        self._complete = self._complete or self._began
        for each in self._robots.values():
            each.connection.on_disconnected(why)

    def on_message(self, message: Message) -> None:
        """Pass a presence message, or lines from a server, to the robot's RobotRequest."""
        _, kind, *_, name, last = message.topic.split("/")
        if kind != topics.ROBOT_LEVEL:
            self._on_reply(last, message)
            return
        presence = Presence.read(name, message.payload)
        if presence is None:
            return  # The retained message has been deleted, or it is malformed.
        if name in self._robots or self._selection.includes(presence):
            robot = self._get_robot(name)
            robot.presence = presence
            robot.connection.on_message(message)
            if self._began:
                self._on_presence(robot, presence)

    def _on_presence(self, robot: RobotRequest, presence: Presence) -> None:
        """Include a new robot, and send it the request if necessary. For a known robot, record ended goals.

        Send the request if possible. After all retained messages have arrived, new robots are ignored, because they
        came online too late. Until then, every member of a group is expected to answer. Some members may have come
        online after the request was sent, but they can't be recognized, because some brokers send retained messages
        late.
        """
        name = presence.name
        if name in self._included:
            self._record_ended_goals(name)
            return
        if self._complete:
            return
        self._include(name)
        if (goal := self._rejected) is not None:
            self._record(Outcome(name, goal.state.name, goal.exit_code or EXIT_OK, goal))
        elif self._selection.group is not None and presence.online:
            robot.expect_reply(self._number, self._expires_at)
        else:
            robot.send()

    def _on_reply(self, name: str, message: Message) -> None:
        """Pass on lines from a robot. Include the robot if it answers a request to its group.

        If a robot answers a request to a group, it is a member of the group, even if it seemed to be absent.
        """
        if topics.name_fault(name) or not self._began:
            return
        robot = self._get_robot(name)
        if self._selection.group is not None and not robot.was_asked:
            self._include(name)
            robot.expect_reply(self._number, self._expires_at)
            if self._canceled_id is not None:
                robot.connection.cancel_after_absence(self._canceled_id, also_now=True)
        robot.connection.on_message(message)
        self._record_ended_goals(name)

    def _get_robot(self, name: str) -> RobotRequest:
        """Return the RobotRequest for a robot. Create it if necessary."""
        if name not in self._robots:
            connection = RobotConnection(
                name, self._desk, name=self._name, patience_s=self._patience, numbers=self._numbers
            )
            self._robots[name] = RobotRequest(connection, self.request, self._record)
        return self._robots[name]

    def _include(self, name: str) -> None:
        """Count a robot as selected, and expect outcomes from it."""
        self._included.add(name)
        self._unfinished.add(name)

    def _record_ended_goals(self, name: str, *, fail_if_late: bool = False) -> None:
        """Record the outcomes of a robot's goals that have just ended, unless the robot is finished."""
        if name in self._unfinished:
            self._robots[name].record_ended_goals(fail_if_late=fail_if_late)

    def _record(self, *outcomes: Outcome) -> None:
        """Store outcomes for `results` to yield. A robot is finished after its last outcome."""
        self._outcomes += outcomes
        self._unfinished -= {each.robot for each in outcomes if each.last}


class FleetRequest(FleetRequestCalls):
    """A request to several robots. Iterate over it to receive the outcomes as they arrive.

    The connection to the broker is closed after the last outcome, by `close`, or at the end of a `with` block. This
    doesn't cancel the request. Only one thread may use this object.
    """

    def __init__(self, broker: Broker, selection: Selection, request: Request, **options: Any) -> None:
        """Connect to the broker, and send the request.

        The arguments are those of `FleetRequestCalls`.

        Raises:
            UsageError: The selection or the request is not valid.
            UnknownGoal: The request contains an invalid goal id.
            ServerUnavailable: The broker can't be reached.
            AccessDenied: The broker rejected the login, or its access rules don't allow the request.
        """
        super().__init__(broker, selection, request, **options)
        run_blocking(self._start())

    def __enter__(self) -> FleetRequest:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[Outcome]:
        return self.results()

    def results(self, timeout: float | None = None) -> Iterator[Outcome]:
        """Yield the outcomes as they arrive. Raise TimeoutError if some are missing after `timeout` seconds.

        After a TimeoutError or Interrupted, call this again to receive the remaining outcomes.

        Args:
            timeout: the time limit for all outcomes in seconds, or None for no limit.

        Raises:
            TimeoutError: Not all outcomes have arrived in time.
            Interrupted: One of the `interrupt` descriptors is ready.
            ServerUnavailable: No robot matches the selection.
            AccessDenied: The broker's access rules don't allow requests to the group.
        """
        end = end_time(timeout)
        while (outcome := run_blocking(self._next_outcome(end, timeout))) is not None:
            yield outcome

    def close(self) -> None:
        """Send all queued messages, and close the connection. This doesn't cancel the request."""
        run_blocking(self._close())


class RobotRequest:
    """The part of a `FleetRequest` that concerns one robot."""

    def __init__(self, connection: RobotConnection, request: Request, record: Callable[..., None]) -> None:
        """Prepare a request. All outcomes are passed to `record`."""
        self.connection = connection
        #: the latest presence of the robot, or None if unknown
        self.presence: Presence | None = None
        #: whether the request has been sent to this robot or to its group
        self.was_asked = False
        self._name, self._request, self._record = connection.robot, request, record
        #: the goals whose end hasn't been reported yet, and when the wait for them began (monotonic time)
        self._handles: deque[GoalHandle] = deque()
        self._since = time.monotonic()

    def send(self) -> None:
        """Send the request to this robot, or record a failure if it can't be sent."""
        try:
            self.connection.check_online()
            self.connection.begin(self._request, self._on_reply, self._on_failure)
            self.was_asked = True
        except TalkError as error:
            self._on_failure(error)

    def expect_reply(self, number: int, expires_at: float | None) -> None:
        """Prepare for the answer to a request that was sent to the robot's group.

        Args:
            number: the number of the request.
            expires_at: when the sentence expires (by the `boottime` clock), or None if it never does.
        """
        exchange = RobotExchange(self._request, self._on_reply, self._on_failure)
        exchange.number, exchange.expires_at = number, expires_at
        self.connection.expect_reply(exchange)
        self.was_asked = True

    def record_ended_goals(self, *, fail_if_late: bool) -> None:
        """Keep the bridge's session alive, and record the outcomes of goals that have just ended.

        Args:
            fail_if_late: whether to record a failure if the robot hasn't answered in time.
        """
        self.connection.keep_alive()
        if fail_if_late:
            now = time.monotonic()
            self.connection.expire(now)
            silent_at, why = self.connection.silence_deadline(self._since)
            if now > silent_at:
                self.connection.end(why)
        while self._handles and (self._handles[0].state.terminal or self._handles[0]._lose_if_disconnected()):
            handle = self._handles.popleft()
            # Waiting for all goals succeeds even if the goals fail.
            any_end = isinstance(self._request, Wait) and self._request.ids is None and handle.state is not State.LOST
            code = EXIT_OK if any_end else handle.goal.exit_code or EXIT_OK
            self._record(Outcome(self._name, handle.state.name, code, handle.goal, last=not self._handles))

    def _on_reply(self, reply: JsonObject, items: list[JsonObject]) -> None:
        """Follow the goals that the request waits for. If there are none, record the reply's outcomes."""
        request = self._request
        found: list[Goal] = []
        if isinstance(request, Say):
            goal = Goal.from_json(reply.get("goal"))  # This raises Unreadable if there is no goal.
            found = [goal] if request.wait else []
        elif isinstance(request, Wait):
            found = list(goals(items, "goal"))
        self._since = time.monotonic()
        self._handles.extend(GoalHandle(self.connection, each) for each in found)
        for each in self._handles:
            each._listen(feedback=False)
        if not found:
            self._record(*reply_outcomes(self._name, request, reply, items))

    def _on_failure(self, error: TalkError) -> None:
        """Record that the request has failed. First, record any goals that it cancelled nevertheless."""
        try:
            items = error.items if isinstance(error, UnknownGoal) else []
            self._record(*cancel_outcomes(self._name, items, last=False))
        except Unreadable as malformed:
            error = malformed
        self._record(failure_outcome(self._name, error))


def _check_request(request: Request) -> None:
    """Raise UsageError or UnknownGoal if a request can't be sent to several robots."""
    ids = (request.ids if isinstance(request, Cancel | Wait) else None) or ()
    other = request.before if isinstance(request, Cancel) else request.id if isinstance(request, Status) else None
    for each in (*ids, *(() if other is None else (other,))):
        check_id(each)
        if each.isdecimal():
            raise UsageError("a goal's number is only valid on one server; for several robots, use the goal's whole id")
    if len(batches(ids)) > 1:
        raise UsageError(f"{len(ids):,} ids do not fit into one request; name fewer ids, or none to select all goals")
    if isinstance(request, Cancel) and request.key is not None and (fault := key_error(request.key)):
        raise UsageError(fault)
    if isinstance(request, Say | Set):
        check(request)
