"""The bridge, which connects one robot's server to the broker.

This module maintains the connection to the broker, publishes the robot's presence, and detects outdated messages.
`policy` decides which requests are accepted, `session` carries them out, and `publisher` watches the server.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
import signal
import time
from collections import deque
from typing import TYPE_CHECKING

from talkcli import __version__
from talkcli.daemon import log
from talkcli.daemon.systemd import ServiceManager
from talkcli.errors import AddressInUse, TalkError
from talkcli.fleet import topics
from talkcli.fleet.bridge.policy import (
    ECHO_EVERY_S,
    MAX_MESSAGES_PER_S,
    STALE_CODE,
    Goodbye,
    Ignored,
    Policy,
    RemoteRequest,
    is_cancel,
)
from talkcli.fleet.bridge.publisher import Publisher
from talkcli.fleet.bridge.session import RemoteSessions
from talkcli.fleet.link import REASON_FAILURE, Link, LinkOpener, boottime, is_denied
from talkcli.fleet.payloads import Message, Presence, bridge_rank, homeassistant_device
from talkcli.frozen import frozen, replace
from talkcli.protocol.events import PROTOCOL
from talkcli.protocol.lines import MAX_LINE_BYTES, encode

if TYPE_CHECKING:
    from collections.abc import Callable

    from talkcli.fleet.bridge.policy import Decision
    from talkcli.fleet.broker import Broker
    from talkcli.fleet.link import OnAcknowledged
    from talkcli.goals.goal import Goal

#: How long the broker keeps a robot's presence, and how often the bridge renews it.
PRESENCE_EXPIRY_S, PRESENCE_EVERY_S = 150, 60.0
#: Time allowed for another bridge with the same robot name to answer.
_RIVAL_LIMIT_S = 1.0
#: Maximum random pause before the first attempt to reconnect to the broker, and before later ones. Without randomness,
#: a thousand robots would reconnect at the same moment.
_FIRST_BROKER_RETRY_S, _LAST_BROKER_RETRY_S = 0.5, 10.0
#: If no echo returns for this long, the bridge closes its connection to the broker.
_ECHO_TIMEOUT_S = 15.0
#: After refusing a stale message, the bridge sends an extra echo if the last echo is at least this old.
_ECHO_PAUSE_S = 1.0
#: If more data than this is unacknowledged, the bridge drops events and stops reading from the server.
SLOW_BROKER_BYTES = 256 * 1024
#: If more data than this is unacknowledged, the bridge closes the connection.
STUCK_BROKER_BYTES = 4 * 1024 * 1024
#: Largest packet that the broker may send. A request that is slightly too long still fits, so that the bridge can
#: answer it with an error. The limit isn't higher, because paho takes several seconds to parse 250 kB of MQTT
#: properties.
_MAX_INCOMING_BYTES = MAX_LINE_BYTES + 8 * 1024
#: When Home Assistant starts, each bridge waits for a random time up to this limit before it describes its robot.
_DEVICE_DELAY_S = 3.0
#: Time allowed for the broker to acknowledge the bridge's last message.
_OFFLINE_LIMIT_S = 1.0
#: Prefix of an echo message that asks whether another bridge uses the robot's name.
_RIVAL_QUESTION = b"? "
_RIGHTS = "compare its access rules with 'talk bridge --print-acl' (with the same options)"


@frozen
class BridgeSettings:
    """The settings of a bridge, from the command line and the environment."""

    #: the robot's name
    name: str
    #: requests that remote clients may send, such as `say`
    allow: tuple[str, ...]
    #: the robot's groups, except the group of all robots
    groups: tuple[str, ...] = ()
    #: path of the server's socket; None to try the default locations
    socket: str | None = None
    #: whether to publish the texts of goals
    with_text: bool = True
    #: whether to add the robot to Home Assistant as a device
    homeassistant: bool = False


def run_bridge(settings: BridgeSettings, read_broker_settings: Callable[[], Broker]) -> None:
    """Run the bridge until SIGTERM or SIGINT.

    Args:
        settings: the bridge's settings.
        read_broker_settings: called before each connection to read the broker's settings, because a password may have
            changed.

    Raises:
        UsageError: a certificate or key file is unusable.
        AddressInUse: an older bridge has the same robot name.
    """
    asyncio.run(_run_until_signal(settings, read_broker_settings))


async def _run_until_signal(settings: BridgeSettings, read_broker_settings: Callable[[], Broker]) -> None:
    """Run the bridge in the event loop until SIGTERM, SIGINT or an error."""
    loop, bridge = asyncio.get_running_loop(), Bridge(settings, read_broker_settings)

    def on_signal(number: signal.Signals) -> None:
        log.write(f"stopping after {number.name}")
        bridge.end()

    loop.set_exception_handler(log.handle_loop_error)
    # Don't handle SIGINT if it is ignored. A shell without job control starts background programs with SIGINT ignored.
    if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:
        loop.add_signal_handler(signal.SIGINT, on_signal, signal.SIGINT)
    loop.add_signal_handler(signal.SIGTERM, on_signal, signal.SIGTERM)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # keep running when the terminal closes
    await bridge.run()


class Bridge:
    """Connects one robot to the broker. All methods run in the event loop's thread."""

    def __init__(self, settings: BridgeSettings, read_broker_settings: Callable[[], Broker]) -> None:
        """Create a bridge that isn't connected yet.

        The arguments are those of `run_bridge`.
        """
        self._settings = settings
        self._echo_topic = topics.robot(settings.name, topics.ECHO)
        self._presence_topic = topics.robot(settings.name, topics.PRESENCE)
        self._broker, self._read_broker_settings = read_broker_settings(), read_broker_settings
        self._loop = asyncio.get_running_loop()
        self._session, self._since = f"{random.getrandbits(64):016x}", time.time()
        groups = tuple(dict.fromkeys((topics.ALL_ROBOTS, *settings.groups)))
        #: the presence that this bridge publishes, except for the state of the server
        self._presence = Presence(
            settings.name, True, self._session, self._since, groups, settings.allow, version=__version__, tokens=True
        )
        self._policy = Policy(settings.name, settings.allow, self._session)
        self._systemd = ServiceManager(self._loop, self._describe_status)
        self._sessions = RemoteSessions(
            settings.name,
            settings.socket,
            self._publish,
            self._max_payload,
            self._systemd.schedule_status,
            lambda: self._policy.new_token(boottime()),
            self._on_goal_end,
            with_text=settings.with_text,
        )
        self._publisher = Publisher(self._sessions, self._publish_to_all, self._on_server_change)
        offline = {"talk": PROTOCOL, "online": False, "session": self._session, "groups": groups}
        #: the message that reports the robot as offline
        self._will = Message(self._presence_topic, encode(offline), retained=True)
        self._link: Link | None = None
        #: the link's descriptor while the event loop watches it, otherwise -1
        self._descriptor = -1
        self._disconnected = asyncio.Event()
        #: longest possible pause before the next attempt to reconnect
        self._retry_s = _FIRST_BROKER_RETRY_S
        #: whether this bridge has claimed the robot's name and accepts requests
        self._online = False
        #: whether this bridge has subscribed to the robot's requests
        self._claimed = False
        #: when the last echo was sent, by the `boottime` clock
        self._echo_at = 0.0
        #: when the presence was last published, by the event loop's clock
        self._presence_at = 0.0
        #: delayed decisions on messages, by user, with the time when each is due, by the `boottime` clock
        self._delayed: dict[str, deque[tuple[float, Decision]]] = {}
        #: timer for the next description for Home Assistant; None if none is scheduled
        self._device_timer: asyncio.TimerHandle | None = None
        self._ending = asyncio.Event()
        self._error: BaseException | None = None

    async def run(self) -> None:
        """Keep the robot connected until `end` is called, and then take it offline.

        At the end, raise the error given to `end`.
        """
        self._broker.ssl_context()  # check the certificate files before anything is started
        log.write(f"starting: robot {self._settings.name}, broker {self._broker.url}")
        self._systemd.notify_ready()
        tasks = [asyncio.create_task(each) for each in (self._stay_connected(), self._publisher.run())]
        for task in tasks:
            task.add_done_callback(self._on_task_done)
        self._tick_timer = self._loop.call_later(ECHO_EVERY_S, self._tick)
        await self._ending.wait()
        self._systemd.notify_stopping()
        self._tick_timer.cancel()
        self._sessions.end_all()
        tasks[1].cancel()
        await self._go_offline()
        tasks[0].cancel()
        await asyncio.wait(tasks)
        self._systemd.close()
        if self._error:
            raise self._error

    def end(self, error: BaseException | None = None) -> None:
        """Take the robot offline, and end `run`. If an error is given, `run` raises it."""
        self._error = self._error or error
        self._ending.set()

    def _on_task_done(self, task: asyncio.Task[None]) -> None:
        """End the bridge if a task has failed. The service manager will restart it."""
        if not task.cancelled() and (error := task.exception()):
            self.end(error)

    def _describe_status(self) -> str:
        """Return the bridge's status line for systemd."""
        broker = "online" if self._online else "OFFLINE"
        there = "server running" if self._publisher.server else "no server"
        pending = len(self._sessions.goals)
        goals = f"{pending} goal{'' if pending == 1 else 's'} waiting"
        return f"{self._settings.name} at {self._broker.url}: {broker}, {there}, {goals}"

    # -- the connection

    async def _stay_connected(self) -> None:
        """Stay connected to the broker. Before each reconnection, read the broker's settings again."""
        client_id = f"talk-{self._settings.name}-{self._session}"
        while True:
            try:
                link = Link(
                    self._broker,
                    client_id,
                    self._on_message,
                    self._will,
                    _MAX_INCOMING_BYTES,
                    on_subscribed=self._on_subscribed,
                )
                try:
                    await self._open_link(link)
                    self._on_connect(link)
                    await self._disconnected.wait()
                finally:
                    self._disconnect(link)
                log.write_limited("disconnected", f"disconnected from the broker: {log.sanitize(str(link.ended))}")
            except TalkError as error:
                log.write_limited("broker", log.sanitize(str(error)))
            await asyncio.sleep(random.uniform(0, self._retry_s))
            self._retry_s = min(_LAST_BROKER_RETRY_S, self._retry_s * 2)
            try:
                self._broker = self._read_broker_settings()
            except TalkError as error:
                log.write_limited("settings", f"{log.sanitize(str(error))}; the previous settings are used")

    async def _open_link(self, link: Link) -> None:
        """Open a connection to the broker in a thread. Wait for it without blocking the event loop."""
        done = asyncio.Event()
        opener = LinkOpener(link, lambda: self._loop.call_soon_threadsafe(done.set))
        try:
            await done.wait()
        except asyncio.CancelledError:
            opener.cancel()
            raise
        if opener.error:
            raise opener.error

    def _on_connect(self, link: Link) -> None:
        """Start using a new connection. Ask whether another bridge already uses the robot's name."""
        self._disconnected.clear()
        self._link, self._descriptor = link, link.fileno()
        self._claimed = False
        #: whether the broker has retained the presence of another bridge
        self._rival_seen = False
        #: timer that brings the robot online if no other bridge uses its name; None until the timer starts
        self._rival_timer: asyncio.TimerHandle | None = None
        self._policy.newest_echo_at = boottime()
        self._loop.add_reader(self._descriptor, self._on_ready, Link.read)
        link.subscribe(self._presence_topic, retained=True)
        link.subscribe(self._echo_topic, retained=False)
        # The broker sends any retained presence of another bridge before it returns this message. If the other bridge
        # is still running, its answer arrives afterwards.
        self._publish(Message(self._echo_topic, _RIVAL_QUESTION + self._session.encode()))
        self._send_echo()

    def _claim_name(self) -> None:
        """Subscribe to the robot's requests. The robot goes online once the broker has allowed this."""
        if self._claimed or self._link is None:
            return
        self._claimed = True
        name = self._settings.name
        wanted = [topics.robot(name, each, topics.ANY) for each in topics.REQUEST_LEVELS]
        wanted += [topics.group(each, topics.REQUEST, topics.ANY) for each in self._presence.groups]
        if self._settings.homeassistant:
            wanted.append(topics.HOMEASSISTANT_STATUS)
        self._link.subscribe(*wanted, retained=False)

    def _on_subscribed(self, topic: str, code: int) -> None:
        """Go online if the broker allows the robot to read its requests. Otherwise, disconnect for a while.

        If the broker doesn't allow another subscription, only log this.
        """
        if code >= REASON_FAILURE:
            words = f"the broker does not allow this robot to read {topic} (reason 0x{code:02x})"
            log.write_limited(f"rights {topic}", f"{words}; {_RIGHTS}")
        if topic != topics.robot(self._settings.name, topics.REQUEST, topics.ANY) or self._link is None:
            return
        if code >= REASON_FAILURE:
            self._loop.call_soon(self._disconnect, self._link)
        else:
            self._go_online()

    def _go_online(self) -> None:
        """Accept requests, and publish the robot's presence."""
        self._online, self._retry_s = True, _FIRST_BROKER_RETRY_S
        self._publish_presence()
        self._publish_device()
        self._publisher.schedule_status()
        self._systemd.schedule_status()
        log.write_limited("online", f"online at {self._broker.url}")

    def _disconnect(self, link: Link) -> None:
        """Close a connection. If it is the current one, end all clients' sessions."""
        if self._link is link:
            self._link, self._online = None, False
            self._unwatch_link()
            for delayed in self._delayed.values():
                delayed.clear()
            if self._rival_timer:
                self._rival_timer.cancel()
            self._sessions.end_all()
            self._systemd.schedule_status()
            self._disconnected.set()
        link.close()

    def _unwatch_link(self) -> None:
        """Stop watching the descriptor of the connection to the broker."""
        if self._descriptor >= 0:
            for forget in (self._loop.remove_reader, self._loop.remove_writer):
                # If paho has already closed the socket, this call removes the descriptor and then raises an error.
                with contextlib.suppress(OSError):
                    forget(self._descriptor)
            self._descriptor = -1

    def _on_ready(self, action: Callable[[Link], None]) -> None:
        """Read from the link or write to it with `action`. Then call `_check_link`."""
        if link := self._link:
            action(link)
            self._check_link(link)

    def _check_link(self, link: Link) -> None:
        """Disconnect if the link is broken or stuck, and pause all sessions while the broker is slow.

        The link is stuck if the broker accepts no data. Call this after each use of the link.
        """
        if link is not self._link or self._descriptor < 0:
            return
        if link.ended is None and link.outstanding_bytes > STUCK_BROKER_BYTES:
            words = f"{STUCK_BROKER_BYTES >> 20} MiB are unsent, so the connection is closed"
            log.write_limited("output", f"the broker accepts no data: {words}")
            link.close()
        if link.ended is not None:
            # Stop watching the descriptor now, because its number may be reused. Disconnect later, because the caller
            # may still be using the sessions.
            self._unwatch_link()
            self._loop.call_soon(self._disconnect, link)
            return
        if link.outstanding_bytes > SLOW_BROKER_BYTES:
            self._sessions.may_read.clear()
        else:
            self._sessions.may_read.set()
        if link.wants_write:
            self._loop.add_writer(self._descriptor, self._on_ready, Link.write)
        else:
            self._loop.remove_writer(self._descriptor)

    def _publish(self, message: Message, qos: int = 1, on_acknowledged: OnAcknowledged | None = None) -> None:
        """Publish a message if the bridge is connected and the message isn't too long.

        The arguments are those of `Link.publish`. By default, a warning is logged if the broker rejects the message.
        """
        link = self._link
        if link is None:
            return
        if len(message.payload) > link.max_payload_bytes:  # otherwise, the broker would close the connection
            words = f"dropped a message of {len(message.payload):,} bytes for {message.topic}"
            log.write_limited("long", f"{words}: the broker accepts at most {link.max_payload_bytes:,}")
            return
        link.publish(message, qos, on_acknowledged or self._log_if_denied)
        self._check_link(link)

    def _publish_to_all(self, message: Message) -> None:
        """Publish a status or an event if the robot is online. Drop events if the broker is slow."""
        if self._online and self._link and (message.retained or self._link.outstanding_bytes <= SLOW_BROKER_BYTES):
            self._publish(message)

    def _log_if_denied(self, code: int) -> None:
        """Log an error if the broker did not allow this robot to publish a message."""
        if is_denied(code):
            log.write_limited("rights", f"the broker does not allow this robot to publish a message; {_RIGHTS}")

    def _max_payload(self) -> int:
        """Return the size of the largest payload that the broker accepts, or 0 without a connection."""
        return self._link.max_payload_bytes if self._link else 0

    # -- messages

    def _on_message(self, message: Message) -> None:
        """Pass a message from the broker to `_handle_message`. Log any exception as a bug."""
        try:
            self._handle_message(message)
        except Exception as error:  # noqa: BLE001 - no message may crash the bridge
            log.write_bug("a message from the broker", error)

    def _handle_message(self, message: Message) -> None:
        """React to an echo, a presence message or a client's request from the broker."""
        if message.topic == self._echo_topic:
            self._handle_echo(message.payload)
            return
        if message.topic == self._presence_topic:
            self._handle_presence(message.payload)
            return
        if message.topic == topics.HOMEASSISTANT_STATUS and message.payload == b"online":
            delay = random.uniform(0, _DEVICE_DELAY_S)
            self._device_timer = self._device_timer or self._loop.call_later(delay, self._publish_device)
        topic = topics.parse_request_topic(message.topic)
        if topic is None or not self._online:
            return
        self._handle_request(message, *topic)

    def _handle_request(self, message: Message, kind: str, user: str) -> None:
        """Decide on a client's request. Carry the decision out now, or later if the user sends many messages."""
        now, cancels = boottime(), is_cancel(message, kind)
        due = now if cancels else self._policy.due_time(user, now)
        if due is None:
            words = f"dropped messages of {user}, who sends more than {MAX_MESSAGES_PER_S} per second"
            log.write_limited("flood", log.sanitize(words))
            return
        decision = self._policy.decide(message, kind, user, now)
        delayed = self._delayed.get(user, deque())
        while cancels and delayed:  # A `cancel` also has to end the goals that were sent before it.
            self._carry_out(delayed.popleft()[1], user)
        if due <= now and not delayed:
            self._carry_out(decision, user)
            return
        delayed.append((due, decision))
        if user not in self._delayed:
            self._delayed[user] = delayed
            self._loop.call_later(due - now, self._carry_out_delayed, user)

    def _carry_out_delayed(self, user: str) -> None:
        """Carry out the oldest delayed decision on a user's message, if any. Schedule the next one."""
        delayed = self._delayed[user]
        _, decision = delayed.popleft() if delayed else (0.0, None)
        if delayed:
            self._loop.call_later(delayed[0][0] - boottime(), self._carry_out_delayed, user)
        else:
            del self._delayed[user]
        if decision:
            self._carry_out(decision, user)

    def _carry_out(self, decision: Decision, user: str) -> None:
        """Pass a client's request to its session, or refuse or ignore it, as the policy decided."""
        if isinstance(decision, Ignored):
            log.write_limited(decision.kind, log.sanitize(decision.words))
        elif isinstance(decision, Goodbye):
            self._sessions.handle_goodbye(decision.user, decision.reply_topic)
        elif isinstance(decision, RemoteRequest):
            self._sessions.submit(decision)
        else:
            error = decision.error
            if decision.reply:
                self._publish(decision.reply)
            log.write_limited(error.code, f"refused a request of {user}: {log.sanitize(error.message)}")
            if error.code == STALE_CODE and boottime() - self._echo_at >= _ECHO_PAUSE_S:
                self._send_echo()

    def _handle_echo(self, payload: bytes) -> None:
        """Record an echo, answer another bridge's question, or schedule going online.

        The question asks whether the robot's name is in use. If this bridge's own question returns, go online unless
        another bridge answers.
        """
        if payload.startswith(_RIVAL_QUESTION):
            if payload != _RIVAL_QUESTION + self._session.encode():
                if self._online:
                    self._publish_presence()
            elif not self._rival_timer:
                wait = _RIVAL_LIMIT_S if self._rival_seen else 0
                self._rival_timer = self._loop.call_later(wait, self._claim_name)
            return
        session, _, sent_at = payload.partition(b" ")
        if session == self._session.encode():
            self._policy.record_echo(sent_at, boottime())

    def _handle_presence(self, payload: bytes) -> None:
        """React to a presence message. End this bridge if an older bridge has the same name.

        Tell a younger bridge that the name is taken. The message may come from this bridge, an earlier one, or another
        one with the same robot name.
        """
        presence = Presence.read(self._settings.name, payload)
        rank = bridge_rank(presence)
        if payload and (presence is None or (presence.online and rank is None)):
            words = 'it is not a JSON object with "online", "session" and a numeric "since"'
            log.write_limited("presence", f"ignored a message on this robot's presence topic: {words}")
        if rank and rank[1] == self._session:
            return
        if not self._rival_timer:
            self._rival_seen = rank is not None  # the presence may come from a bridge that has already ended
        elif rank is None:
            if self._online:
                self._publish_presence()  # replace an invalid message, or a will that arrived late
        elif rank < (self._since, self._session):
            words = f"another bridge already uses the name '{self._settings.name}': session {log.sanitize(rank[1])}"
            self.end(AddressInUse(f"{words}; choose another name with --name"))
        else:
            self._claim_name()
            if self._online:
                self._publish_presence()  # tell the younger bridge that the name is in use

    # -- what this bridge publishes about itself

    def _publish_presence(self) -> None:
        """Publish a retained message that reports the robot as online and describes its server."""
        self._presence_at = self._loop.time()
        presence = replace(self._presence, server=self._publisher.server).to_json()
        line = encode({"talk": PROTOCOL, "version": __version__, **presence})
        self._publish(Message(self._presence_topic, line, retained=True, expiry=PRESENCE_EXPIRY_S))

    def _publish_device(self) -> None:
        """Publish the robot's description for Home Assistant as a retained message, if enabled."""
        self._device_timer = None
        if self._settings.homeassistant and self._online:
            self._publish(homeassistant_device(self._settings.name, self._settings.allow, __version__))

    def _on_goal_end(self, goal: Goal) -> None:
        """Publish the end of a goal that was never sent to the server."""
        self._publisher.publish_end(goal)

    def _on_server_change(self) -> None:
        """Report to systemd and to the fleet that the robot's server has started or ended."""
        self._systemd.schedule_status()
        if self._online:
            self._publish_presence()

    def _send_echo(self) -> None:
        """Publish a message that contains the current time. The broker sends it back."""
        self._echo_at = boottime()
        self._publish(Message(self._echo_topic, f"{self._session} {self._echo_at}".encode()))

    def _tick(self) -> None:
        """End silent sessions and connections, send an echo, and renew the presence if it is due.

        Schedule the next tick.
        """
        self._tick_timer = self._loop.call_later(ECHO_EVERY_S, self._tick)
        self._sessions.tick()
        self._publisher.tick()
        link = self._link
        if link is None:
            return
        link.tick()
        self._check_link(link)
        # Compare sending times, because this process may have been stopped for a while and not have read returned
        # echoes.
        if self._echo_at - self._policy.newest_echo_at > _ECHO_TIMEOUT_S:
            log.write_limited("echo", f"the broker does not return this robot's own messages; {_RIGHTS}")
            self._disconnect(link)
            return
        self._send_echo()
        if self._online and self._loop.time() - self._presence_at >= PRESENCE_EVERY_S:
            self._publish_presence()

    async def _go_offline(self) -> None:
        """Report the robot as offline unless another bridge uses its name. Then disconnect."""
        link = self._link
        if link is None:
            return
        taken = asyncio.Event()
        was_online = self._online and not isinstance(self._error, AddressInUse)
        self._online = False  # otherwise, the bridge would overwrite its own offline message
        # If another bridge is online, publish a message that has no effect, and wait until everything is acknowledged.
        # Otherwise, `Link.close` would not send a DISCONNECT packet. The broker would then publish the will, and the
        # robot would seem to be offline.
        message = self._will if was_online else Message(self._echo_topic, f"{self._session} 0".encode())
        self._publish(message, on_acknowledged=lambda _: taken.set())
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(taken.wait(), _OFFLINE_LIMIT_S)
        self._disconnect(link)
