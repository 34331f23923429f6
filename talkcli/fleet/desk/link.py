"""An operator's connection to the broker, which reconnects when it is lost.

A handler subscribes to topics and processes the messages. While the broker is unreachable, nothing is sent or queued.
"""

from __future__ import annotations

import contextlib
import os
import random
import select
import socket
import time
from collections import deque
from functools import partial
from typing import TYPE_CHECKING, Protocol

from talkcli.errors import AccessDenied, RequestRefused, ServerUnavailable, TalkError
from talkcli.fleet import topics
from talkcli.fleet.broker import Broker, client_user
from talkcli.fleet.link import (
    KEEPALIVE_S,
    MAX_RECEIVE_COUNT,
    REASON_FAILURE,
    REASON_NOT_AUTHORIZED,
    TICK_EVERY_S,
    Link,
    LinkOpener,
    is_denied,
)
from talkcli.fleet.payloads import Message
from talkcli.goals.options import Say
from talkcli.polling import block_until_ready
from talkcli.protocol.lines import request_line, request_to_json

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping

    from talkcli.polling import WaitReady
    from talkcli.protocol.requests import Request

#: How long a broker or a robot may be absent before open requests count as lost. A bridge reconnects within 15 s after
#: its broker is back, and systemd restarts a bridge after 2 s.
ABSENCE_LIMIT_S = 30.0
#: The broker discards undelivered requests after this time. Sentences have a time limit of their own.
_REQUEST_EXPIRY_S = 5
#: How long to keep waiting for retained messages after the marker message. Some brokers send a few of them late.
RETAINED_GRACE_S = 0.3
#: The pause before reconnecting is random. Its upper limit starts at the first value, and doubles after each failed
#: attempt until it reaches the second value.
_FIRST_BROKER_PAUSE_S, _MAX_BROKER_PAUSE_S = 0.5, 10.0


class DeskHandler(Protocol):
    """Interface for an object that processes the messages of a DeskLink.

    `DeskLink.process` calls its methods.
    """

    def on_connected(self, link: Link) -> None:
        """Called when the link has connected to the broker.

        This method has to subscribe to topics.
        """

    def on_disconnected(self, why: str) -> None:
        """Called when the connection is lost, and when an attempt to connect fails."""

    def on_message(self, message: Message) -> None:
        """Called for each message from the broker."""


class DeskLink:
    """A connection to the broker that reconnects when it is lost.

    Only one thread at a time may call `prepare`, `process` and the coroutines. Any thread may call the other methods.
    """

    #: the object that processes all messages; must be set before `prepare` is first called
    handler: DeskHandler

    def __init__(self, broker: Broker, wait: WaitReady = block_until_ready) -> None:
        """Create a link. `prepare` opens the connection.

        Args:
            broker: the broker.
            wait: waits until descriptors are ready. By default, it blocks.

        Raises:
            UsageError: The user name can't be part of a topic.
        """
        self.broker, self.user, self._wait = broker, client_user(broker), wait
        #: a random part of the reply topics, so that each connection of a user has its own topics
        self.session = os.urandom(8).hex()
        #: the current MQTT connection, or None if there is none
        self.link: Link | None = None
        #: the error if an attempt to connect failed, or if the broker rejected the marker message or a subscription
        self.failure: TalkError | None = None
        #: monotonic time when the marker message came back after the retained messages. None until then
        self.marker_at: float | None = None
        #: functions that process messages and rejected requests. `process` calls them when the link isn't locked.
        self._calls: deque[Callable[[], object]] = deque()
        self._opening: LinkOpener | None = None
        self._failed_attempts = 0
        self._next_attempt_at = self._polled_at = time.monotonic()
        # Use sockets instead of a pipe, because the garbage collector closes them if nobody calls `close`.
        self._wake_reader, self._wake_writer = socket.socketpair()
        for each in (self._wake_reader, self._wake_writer):
            each.setblocking(False)

    @property
    def retained_received(self) -> bool:
        """Whether all retained messages have probably arrived.

        They do shortly after the marker message has arrived.
        """
        return self.marker_at is not None and time.monotonic() > self.marker_at + RETAINED_GRACE_S

    def reply_topic(self, robot: str) -> str:
        """Return the topic for a robot's replies to this connection."""
        return topics.reply(self.user, self.session, robot)

    async def poll(self, timeout: float, interrupt: Mapping[int, int] | None = None) -> bool:
        """Wait for messages, and pass them to the handler. Return whether data was read.

        Reconnect if necessary.

        Args:
            timeout: the maximum time to wait in seconds.
            interrupt: file descriptors that interrupt the wait, as in `wait_ready`.

        Returns:
            True if data was read. More data may be waiting, even if no message was complete.
        """
        now = time.monotonic()
        watched, due = self.prepare(now)
        return self.process(await self._wait(watched, min(timeout, due - now), interrupt))

    def prepare(self, now: float) -> tuple[dict[int, int], float]:
        """Connect, or keep the connection alive, without blocking. Return the descriptors and the time to wait for.

        Returns:
            The poll events by descriptor, and the monotonic time at which to call `process` even if nothing is ready.
        """
        link = self.link
        if link is not None and (link.ended or now - self._polled_at > 2 * KEEPALIVE_S):
            self._disconnect(link)
            link = None
        due = now + self._maintain(link, now)
        watched = {self._wake_reader.fileno(): select.POLLIN}
        if link is not None and link.fileno() >= 0:  # The descriptor is -1 if another thread closed the link.
            watched[link.fileno()] = select.POLLIN | (select.POLLOUT if link.wants_write else 0)
        return watched, due

    def process(self, ready: Collection[int]) -> bool:
        """Pass received messages to the handler, without blocking. Return whether data was read.

        `ready` are those of the descriptors from the last call of `prepare` that are ready.
        """
        if self._wake_reader.fileno() in ready:
            self._wake_reader.recv(4096)
        self._polled_at = time.monotonic()
        link = self.link if self.link and self.link.fileno() in ready else None
        if link:
            link.read()
        while self._calls:
            self._calls.popleft()()
        return link is not None

    def _receive(self, message: Message) -> None:
        """Pass a message to the handler, or record that all retained messages have arrived.

        The marker message shows that, because it comes back after the retained messages.
        """
        if message.topic == self.reply_topic(topics.MARKER):
            self.marker_at = time.monotonic()
        else:
            self.handler.on_message(message)

    async def wait_for_retained(
        self, timeout: float, is_enough: Callable[[], bool] = lambda: True, interrupt: Mapping[int, int] | None = None
    ) -> None:
        """Wait until the broker has sent its retained messages.

        Args:
            timeout: the maximum time to wait in seconds.
            is_enough: a function that is called after the marker has arrived. If it returns True, the wait ends without
                allowing time for late messages.
            interrupt: file descriptors that interrupt the wait, as in `poll`.

        Raises:
            ServerUnavailable: The broker can't be reached, or doesn't answer in time.
            AccessDenied: The broker rejected the login, or doesn't let this user read replies.
        """
        end = time.monotonic() + timeout
        while self.failure or not (self.retained_received or (self.marker_at is not None and is_enough())):
            if self.failure is not None:
                raise self.failure
            left = end - time.monotonic()
            if left <= 0:
                raise self._no_answer_error(timeout)
            await self.poll(left, interrupt)

    def send(
        self,
        request: Request,
        number: int,
        to: str,
        on_refused: Callable[[TalkError], None],
        *,
        is_group: bool = False,
        token: str | None = None,
    ) -> bool:
        """Send a request to a robot or a group. Return whether it was sent.

        Args:
            request: the request.
            number: the number of the request, which is repeated in the answers.
            to: the name of the robot or the group.
            on_refused: a function that is called with the error if the request is too long, or if the broker rejects it
                later.
            is_group: whether `to` is a group.
            token: the robot's latest token, which shows that the request is recent.
        """
        if self.link is None:
            return False

        def on_acknowledged(code: int) -> None:
            if code >= REASON_FAILURE:
                error = self._rejection_error(code, f"send requests to {'the group ' * is_group}{to}")
                self._calls.append(partial(on_refused, error))

        line = request_line({"seq": number, **request_to_json(request)})
        if len(line) > self.link.max_payload_bytes:
            limit = f"the broker accepts at most {self.link.max_payload_bytes:,}; nothing was sent"
            on_refused(RequestRefused(f"the request has {len(line):,} bytes, but {limit}", "too_long"))
            return False
        expiry = (request.ttl or None) if isinstance(request, Say) else _REQUEST_EXPIRY_S
        topic, response = self._topics(to, is_group=is_group)
        message = Message(topic, line, response=response, expiry=expiry, token=token)
        return self.link.publish(message, on_acknowledged=on_acknowledged)

    def end_session(self, to: str, *, is_group: bool = False) -> None:
        """Tell the bridges of a robot or a group to end their sessions with this connection."""
        if self.link is not None:
            topic, response = self._topics(to, is_group=is_group)
            self.link.publish(Message(topic, b"", response=response), 0)

    def _topics(self, to: str, *, is_group: bool) -> tuple[str, str]:
        """Return the topic for requests to a robot or a group, and the topic for replies."""
        topic = topics.group if is_group else topics.robot
        response = topics.reply(self.user, self.session) if is_group else self.reply_topic(to)
        return topic(to, topics.REQUEST, self.user), response

    def wake(self) -> None:
        """Wake the thread or the event loop that waits for messages, so that it calls `process`."""
        # Sending fails if the link is closed, or if the buffer is full because `wake` was called before.
        with contextlib.suppress(OSError):
            self._wake_writer.send(b"\0")

    async def flush(self, timeout: float) -> None:
        """Wait up to `timeout` seconds for the broker to acknowledge all messages."""
        end = time.monotonic() + timeout
        while self.link is not None and self.link.outstanding_bytes and (left := end - time.monotonic()) > 0:
            await self.poll(left)

    def close(self, *, forked: bool = False) -> None:
        """Close the connection for good. In a forked child, only close the child's descriptors.

        Args:
            forked: whether this is a forked child process.
        """
        if self._opening is not None and not forked:
            self._opening.cancel()
        if self.link is not None:
            (self.link.drop if forked else self.link.close)()
        self._wake_reader.close()
        self._wake_writer.close()

    def _rejection_error(self, code: int, action: str) -> TalkError:
        """Return the error to raise after the broker has rejected a message or a subscription.

        Args:
            code: the reason code from the broker.
            action: words for the error message that say what the user isn't allowed to do.
        """
        url = self.broker.url
        if not is_denied(code):
            return ServerUnavailable(f"nothing was sent: the broker at {url} refused it (reason 0x{code:02x})")
        words = f"the broker at {url} does not allow '{self.user}' to {action}"
        return AccessDenied(f"{words}; add the lines of an operator to its access rules: talk bridge --print-acl")

    def _no_answer_error(self, timeout: float) -> TalkError:
        """Return the error to raise if retained messages don't arrive in time.

        It is AccessDenied if the broker is connected but hasn't sent back the marker message.
        """
        if self.link is None or self.marker_at is not None:
            return ServerUnavailable(f"the broker at {self.broker.url} did not answer within {timeout:g} s")
        return self._rejection_error(REASON_NOT_AUTHORIZED, f"read {topics.reply(self.user, '+', '+')}")

    def _maintain(self, link: Link | None, now: float) -> float:
        """Connect, or keep the connection alive. Return how many seconds to wait before the next call."""
        if link is not None:
            link.tick()
            if self.marker_at is None or self.retained_received:
                return TICK_EVERY_S
            return self.marker_at + RETAINED_GRACE_S - now
        if self._opening is not None and self._opening.done:
            self._finish_connecting(self._opening)
            return 0.0
        if self._opening is None and now >= self._next_attempt_at:
            name = f"talk-desk-{self.user}-{self.session}"
            new = Link(
                self.broker,
                name,
                lambda message: self._calls.append(partial(self._receive, message)),
                receive_maximum=MAX_RECEIVE_COUNT,
                on_subscribed=self._on_subscribed,
            )
            self._opening = LinkOpener(new, self.wake)
        return TICK_EVERY_S if self._opening else max(0.0, self._next_attempt_at - now)

    def _finish_connecting(self, opening: LinkOpener) -> None:
        """Start using the new connection. If it couldn't be opened, schedule another attempt."""
        self._opening = None
        if opening.error is not None:
            self._failed_attempts += 1
            longest = min(_MAX_BROKER_PAUSE_S, _FIRST_BROKER_PAUSE_S * 2**self._failed_attempts)
            self._next_attempt_at = time.monotonic() + random.uniform(0, longest)
            self.failure = opening.error
            self.handler.on_disconnected(str(opening.error))
            return
        link, self._failed_attempts, self._polled_at = opening.link, 0, time.monotonic()
        self.failure = None
        self.link = link
        self._calls.clear()
        link.subscribe(self.reply_topic(topics.MARKER), retained=False)
        self.handler.on_connected(link)
        # The broker sends this message back after the retained messages, so it marks their end.
        link.publish(Message(self.reply_topic(topics.MARKER), b"\n"), on_acknowledged=self._on_marker_acknowledged)

    def _on_subscribed(self, topic: str, code: int) -> None:
        """Store an error if the broker has rejected a subscription."""
        if code >= REASON_FAILURE:
            self.failure = self._rejection_error(code, f"read {topic.replace(self.session, topics.ANY)}")

    def _on_marker_acknowledged(self, code: int) -> None:
        """Store an error if the broker has rejected the marker, which this link sends to itself."""
        if code >= REASON_FAILURE:
            self.failure = self._rejection_error(code, f"write to {topics.reply(self.user, '+', '+')}")

    def _disconnect(self, link: Link) -> None:
        """Close the connection, schedule an attempt to reconnect, and inform the handler."""
        link.close()
        self.link, self.marker_at = None, None
        self._next_attempt_at = time.monotonic() + random.uniform(0, _FIRST_BROKER_PAUSE_S)
        self.handler.on_disconnected(f"the connection to the broker at {self.broker.url} was lost")
