"""A connection to the broker through paho-mqtt, without an event loop or a thread.

The owner polls the connection's descriptor, and calls `read`, `write` and `tick`. A link is never reconnected, because
paho would resend unacknowledged messages, and the robot might speak an outdated sentence. Create a new link instead.
This module doesn't interpret payloads.
"""

from __future__ import annotations

import contextlib
import math
import os
import select
import socket
import ssl
import struct
import threading
import time
from functools import lru_cache
from typing import TYPE_CHECKING

from paho.mqtt import client as paho
from paho.mqtt.enums import CallbackAPIVersion, MQTTErrorCode
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.subscribeoptions import SubscribeOptions

from talkcli.errors import AccessDenied, ProtocolMismatch, ServerUnavailable, TalkError
from talkcli.fleet.payloads import Message
from talkcli.polling import wait_ready
from talkcli.terminal.text import printable

if TYPE_CHECKING:
    from collections.abc import Callable

    from paho.mqtt.reasoncodes import ReasonCode

    from talkcli.fleet.broker import Broker

    #: Callback that receives the reason code of a PUBACK packet.
    OnAcknowledged = Callable[[int], None]
    #: Callback that receives a topic and its reason code from a SUBACK packet.
    OnSubscribed = Callable[[str, int], None]

#: MQTT keepalive interval. The broker closes a connection if it receives nothing for one and a half intervals.
KEEPALIVE_S = 10
#: Time allowed for the broker to respond to a login. A desk waits for 5 s, so that it can report the reason.
LOGIN_LIMIT_S = 4.5
#: How often `tick` should be called.
TICK_EVERY_S = 5.0
#: Maximum size of a sent packet, including its header.
MAX_PACKET_BYTES = 256 * 1024
#: Space that is reserved in each packet for the topic and the properties.
MAX_HEADER_BYTES = 1024
#: Maximum number of unacknowledged QoS 1 messages, unless the broker's receive maximum is lower. paho queues further
#: messages.
_MAX_UNACKNOWLEDGED_MESSAGES = 10
#: The highest receive maximum that MQTT allows. A client that receives messages from all robots needs it. By default,
#: mosquitto queues only 1,000 messages for a client, and silently drops the rest, even retained messages.
MAX_RECEIVE_COUNT = 65_535
# MQTT 5 reason codes. All codes from REASON_FAILURE upwards are failures.
_REASONS_LOGIN_DENIED = (0x86, 0x87, 0x8A, 0x8C)
#: Reason codes for a topic that a user may not use. Some brokers, such as ejabberd, report that such a topic is
#: invalid.
_REASONS_TOPIC_DENIED = (0x86, 0x87, 0x8A, 0x8C, 0x8F, 0x90)
_REASON_UNSUPPORTED_PROTOCOL = 0x84
#: The broker features that talk needs. If a feature is missing, this property of the broker's response is 0, or the
#: login fails with this reason code. The last column is the name of the feature in error messages.
_NEEDED_FEATURES = (
    ("MaximumQoS", 0x9B, "QoS 1"),
    ("RetainAvailable", 0x9A, "retained messages"),
    ("WildcardSubscriptionAvailable", 0xA2, "wildcards in subscriptions"),
)
_SUITABLE_BROKER = "use another broker, such as mosquitto 1.6 or later"
_CHECK_MQTT_5 = "check that the broker supports MQTT 5, as mosquitto 1.6 or later does"
REASON_FAILURE, REASON_NOT_AUTHORIZED = 0x80, 0x87
#: Name of the MQTT user property that contains a robot's token.
_TOKEN_PROPERTY = "talk-token"
#: Values for SO_LINGER. A closed link usually discards unsent data, so that no sentence arrives minutes too late.
_LINGER_DISCARD, _LINGER_DELIVER = struct.pack("ii", 1, 0), struct.pack("ii", 0, 0)


def boottime() -> float:
    """Return the seconds since the machine booted.

    On Linux, this includes time spent suspended.
    """
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


def is_denied(code: int) -> bool:
    """Return whether a reason code means that the user may not use a topic."""
    return code in _REASONS_TOPIC_DENIED


class Link:
    """A single connection to the MQTT broker. It doesn't reconnect.

    Any thread may use it. Callbacks run in the thread that calls `read`.
    """

    def __init__(
        self,
        broker: Broker,
        client_id: str,
        on_message: Callable[[Message], None],
        will: Message | None = None,
        max_packet_bytes: int = MAX_PACKET_BYTES,
        receive_maximum: int | None = None,
        on_subscribed: OnSubscribed = lambda _topic, _code: None,
    ) -> None:
        """Create a link that isn't connected yet.

        Args:
            broker: the broker's address and login.
            client_id: the MQTT client id, which must be unique.
            on_message: called with each received message.
            will: retained message that the broker publishes if the connection breaks.
            max_packet_bytes: largest packet that the broker may send.
            receive_maximum: how many unacknowledged QoS 1 messages the broker may send. If None, the broker's default
                applies, so that a flood of messages can't stop mosquitto from delivering later ones.
            on_subscribed: called for each topic with the broker's answer to the subscription.
        """
        self._broker, self._has_will = broker, will is not None
        self._deliver, self._on_subscribed = on_message, on_subscribed
        #: the topics of each unanswered subscription, by message id
        self._subscribing: dict[int, tuple[str, ...]] = {}
        #: the names of needed features that the broker doesn't support
        self._missing_features: list[str] = []
        self._max_packet_bytes, self._receive_maximum = max_packet_bytes, receive_maximum
        #: why the connection has ended; None if it hasn't
        self.ended: str | None = None
        #: total size of the unsent and unacknowledged messages
        self.outstanding_bytes = 0
        #: size of the largest payload that the broker accepts
        self.max_payload_bytes = MAX_PACKET_BYTES - MAX_HEADER_BYTES
        #: size and callback of each unacknowledged message, by message id
        self._unacknowledged: dict[int, tuple[int, OnAcknowledged | None]] = {}
        #: the broker's response to the login; None until it arrives
        self._answer: ReasonCode | None = None
        #: the TLS alert that the broker sent during the login; "" if it sent none
        self._alert = ""
        #: held while paho runs, because a TLS connection can't be read and written at the same time
        self._lock = threading.RLock()
        #: whether paho is reading. Nothing may be written during that time, because paho deadlocks if a callback
        #: writes to a broken connection.
        self._delivering = False
        self._socket: socket.socket | None = None
        self._paho = paho.Client(
            CallbackAPIVersion.VERSION2, client_id, protocol=paho.MQTTv5, reconnect_on_failure=False
        )
        self._paho.max_inflight_messages_set(_MAX_UNACKNOWLEDGED_MESSAGES)
        if broker.user is not None:
            self._paho.username_pw_set(broker.user, broker.password)
        if will:
            self._paho.will_set(will.topic, will.payload, qos=1, retain=True)
        self._paho.on_connect = self._on_connect
        self._paho.on_disconnect = self._on_disconnect
        self._paho.on_message = self._on_message
        self._paho.on_publish = self._on_publish
        self._paho.on_subscribe = self._on_subscribe
        self._paho.on_log = self._on_log

    def open(self) -> None:
        """Connect to the broker, and wait until it has accepted the login.

        Raises:
            UsageError: a certificate or key file is unusable.
            ServerUnavailable: no broker answers.
            AccessDenied: the broker's certificate isn't trusted, or the broker rejects the login.
            ProtocolMismatch: the broker doesn't speak MQTT 5, or lacks a feature that talk needs.
        """
        url = self._broker.url
        properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
        properties.SessionExpiryInterval = 0
        properties.MaximumPacketSize = self._max_packet_bytes
        if self._receive_maximum is not None:
            properties.ReceiveMaximum = self._receive_maximum
        self._paho.connect_timeout = LOGIN_LIMIT_S
        if context := self._broker.ssl_context():  # reading the system's CAs takes about 40 ms
            self._paho.tls_set_context(context)
        try:
            self._paho.connect(
                self._broker.host, self._broker.port, KEEPALIVE_S, clean_start=True, properties=properties
            )
        except ssl.SSLCertVerificationError as error:
            words = f"the broker's certificate is not trusted: {error.verify_message} ({url})"
            raise AccessDenied(f"{words}; set TALK_MQTT_CA to the certificate file of its CA") from error
        except ssl.SSLError as error:
            raise ServerUnavailable(f"TLS with the broker at {url} failed: {error.reason or error}") from error
        except (OSError, ValueError) as error:  # ValueError means that the host name is invalid
            why = error.strerror if isinstance(error, OSError) else None
            raise ServerUnavailable(f"can't connect to the broker at {url}: {why or error}") from error
        found = self._paho.socket()
        if isinstance(found, socket.socket):  # there is no socket if the broker has already closed the connection
            self._socket = found
            # On macOS, setting this option fails if the broker has reset the connection. The first read reports the
            # error.
            with contextlib.suppress(OSError):
                # Nagle's algorithm would delay messages by 40 ms.
                found.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                found.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER_DISCARD)
        end = time.monotonic() + LOGIN_LIMIT_S
        while self._answer is None and self.ended is None and (left := end - time.monotonic()) > 0:
            events = select.POLLIN | (select.POLLOUT if self.wants_write else 0)
            if self._tls_pending() or wait_ready({self.fileno(): events}, left):
                self.read()
        if login_error := self._login_error():
            self.close()
            raise login_error

    def fileno(self) -> int:
        """Return the file descriptor to poll, or -1 if the connection has ended."""
        return -1 if self._socket is None else self._socket.fileno()

    @property
    def wants_write(self) -> bool:
        """Whether there is data to send once the descriptor becomes writable."""
        return self.ended is None and bool(self._paho.want_write())

    def read(self) -> None:
        """Read all available data without blocking, and call `on_message` with each message."""
        with self._lock:
            while self.ended is None:
                self._delivering = True
                try:
                    self._paho.loop_read()
                finally:
                    self._delivering = False
                if self.ended is None and self._socket is not None and hasattr(socket, "TCP_QUICKACK"):
                    # Linux would delay the TCP acknowledgement by 40 ms, and the broker might wait for it before it
                    # sends more.
                    self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
                if not self._tls_pending():
                    break
            self.write()

    def write(self) -> None:
        """Send as much data as possible without blocking.

        Nothing is sent during `on_message`, because `read` sends the data afterwards.
        """
        with self._lock:
            if self.wants_write and not self._delivering:
                self._paho.loop_write()

    def tick(self) -> None:
        """Send a keepalive message if one is due, and check that the broker still answers.

        Call this every `TICK_EVERY_S` seconds.
        """
        with self._lock:
            if self.ended is None:
                self._paho.loop_misc()

    def publish(self, message: Message, qos: int = 1, on_acknowledged: OnAcknowledged | None = None) -> bool:
        """Publish a message. Return False if the connection has ended.

        Args:
            message: the message. Its payload has at most `max_payload_bytes`.
            qos: 0 or 1.
            on_acknowledged: called with the reason code of the broker's acknowledgement of a QoS 1 message.
        """
        topic, payload = message.topic, message.payload
        properties = _properties(message.expiry, message.response, message.correlation, message.token)
        with self._lock:
            if self.ended is not None:
                return False
            info = self._paho.publish(topic, payload, qos, message.retained, properties)
            if info.rc == MQTTErrorCode.MQTT_ERR_NO_CONN or self.ended is not None:
                return False
            if not info.is_published():
                size = len(topic) + len(payload)
                self._unacknowledged[info.mid] = size, on_acknowledged
                self.outstanding_bytes += size
            self.write()
        return True

    def subscribe(self, *topics: str, retained: bool) -> None:
        """Subscribe to topics, with or without the messages that the broker has retained.

        Args:
            topics: the topics, which may contain wildcards.
            retained: whether to receive messages that the broker has already retained.
        """
        handling = SubscribeOptions.RETAIN_SEND_ON_SUBSCRIBE if retained else SubscribeOptions.RETAIN_DO_NOT_SEND
        options = SubscribeOptions(qos=1, retainAsPublished=True, retainHandling=handling)
        with self._lock:
            if self.ended is None:
                _, number = self._paho.subscribe([(each, options) for each in topics])
                if number is not None:
                    self._subscribing[number] = topics
                self.write()

    def close(self) -> None:
        """Close the connection. If any message is unacknowledged, unsent data is discarded.

        In that case, no DISCONNECT packet is sent.
        """
        with self._lock:
            logged_in = self._answer is not None and not self._answer.is_failure
            if self.ended is None and self._socket is not None and logged_in and not self._unacknowledged:
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER_DELIVER)
                self._paho.on_disconnect = None
                self._paho.disconnect()
                self.write()
            self.ended = self.ended or "the connection was closed"
            if self._socket is not None:
                self._socket.close()
                self._socket = None

    def drop(self) -> None:
        """Close a forked child's copy of the socket. The parent's connection stays open."""
        if self._socket is not None:
            os.close(self._socket.detach())

    # -- internals

    def _tls_pending(self) -> bool:
        """Return whether the TLS layer holds unread data."""
        return isinstance(self._socket, ssl.SSLSocket) and self._socket.pending() > 0

    def _login_error(self) -> TalkError | None:
        """Return an error if the login failed."""
        url, answer = self._broker.url, self._answer
        if answer is None and self._broker.tls and (self._alert or self.ended):
            # With TLS 1.3, the client finishes its handshake before the broker checks the client's certificate. If the
            # broker then closes the connection, its alert may get lost.
            why = self._alert or "it closed the connection without an answer"
            which = "the certificate of this client" if self._broker.cert else "a client without a certificate"
            words = f"the broker at {url} rejected {which}: {why}"
            remedy = "set TALK_MQTT_CERT and TALK_MQTT_KEY to a certificate that it accepts"
            return AccessDenied(f"{words}; {remedy}" if self._alert else f"{words}; {remedy}, or {_CHECK_MQTT_5}")
        if answer is None:
            why = f"did not answer: {self.ended}" if self.ended else f"did not answer within {LOGIN_LIMIT_S:g} s"
            return ServerUnavailable(f"the broker at {url} {why}; {_CHECK_MQTT_5}")
        who = "an anonymous user" if self._broker.user is None else f"'{printable(self._broker.user)}'"
        if is_denied(answer.value) and answer.value not in _REASONS_LOGIN_DENIED and self._has_will:
            # The broker rejects the topic of the will.
            words = f"the broker at {url} does not allow {who} to publish a robot's presence: {answer}"
            return AccessDenied(f"{words}; add the access rules of a robot: talk bridge --print-acl")
        if is_denied(answer.value):
            words = f"the broker at {url} rejected the login of {who}: {answer}"
            return AccessDenied(f"{words}; set TALK_MQTT_USER and TALK_MQTT_PASSWORD_FILE for your login")
        if answer.value == _REASON_UNSUPPORTED_PROTOCOL:
            return ProtocolMismatch(f"the broker at {url} does not support MQTT 5; {_SUITABLE_BROKER}")
        if self._missing_features:
            missing = " and ".join(self._missing_features)
            return ProtocolMismatch(f"the broker at {url} does not support {missing}; {_SUITABLE_BROKER}")
        if answer.is_failure or self.ended:
            reason = str(answer) if answer.is_failure else self.ended
            return ServerUnavailable(f"the broker at {url} refused the connection: {reason}")
        return None

    def _on_connect(
        self, _client: paho.Client, _data: object, _flags: object, code: ReasonCode, properties: Properties | None
    ) -> None:
        """Store the broker's response to the login, and obey its limits."""
        self._answer = code
        self._missing_features = [
            words for name, missing, words in _NEEDED_FEATURES if code == missing or getattr(properties, name, 1) == 0
        ]
        receive_maximum = getattr(properties, "ReceiveMaximum", MAX_RECEIVE_COUNT)
        # paho doesn't obey the broker's receive maximum, and its public setter can't be called after the login.
        self._paho._max_inflight_messages = min(_MAX_UNACKNOWLEDGED_MESSAGES, receive_maximum)
        # Turn off paho's log, because it uses a tenth of the CPU time. It is only needed to explain a failed login.
        self._paho.on_log = None
        limit = getattr(properties, "MaximumPacketSize", MAX_PACKET_BYTES)
        self.max_payload_bytes = max(0, min(MAX_PACKET_BYTES, limit) - MAX_HEADER_BYTES)

    def _on_disconnect(self, _client: paho.Client, _data: object, flags: object, code: ReasonCode, _: object) -> None:
        """Record why the connection has ended.

        Some brokers disconnect a client that uses a topic without permission. Then, everything unanswered counts as
        denied.
        """
        said = getattr(flags, "is_disconnect_packet_from_server", False)
        if said and is_denied(code.value):
            for number in list(self._subscribing):
                self._on_subscribe(_client, _data, number, [code] * len(self._subscribing[number]), None)
            for number in list(self._unacknowledged):
                self._on_publish(_client, _data, number, code, None)
        self.ended = self.ended or (f"the broker disconnected: {code}" if said else "the connection was lost")
        self._socket = None  # paho closes it

    def _on_message(self, _client: paho.Client, _data: object, message: paho.MQTTMessage) -> None:
        """Convert a message from paho, and pass it to `on_message`."""
        names = "ResponseTopic", "CorrelationData", "MessageExpiryInterval"
        properties = [getattr(message.properties, each, None) for each in names]
        properties.append(dict(getattr(message.properties, "UserProperty", ())).get(_TOKEN_PROPERTY))
        self._deliver(Message(message.topic, bytes(message.payload), message.retain, *properties))

    def _on_subscribe(
        self, _client: paho.Client, _data: object, number: int, codes: list[ReasonCode], _: object
    ) -> None:
        """Pass the broker's reason code for each topic of a subscription to `on_subscribed`."""
        for topic, code in zip(self._subscribing.pop(number, ()), codes, strict=False):
            self._on_subscribed(topic, code.value)

    def _on_publish(self, _client: paho.Client, _data: object, mid: int, code: ReasonCode, _: object) -> None:
        """Forget an acknowledged message, and pass the broker's reason code to `on_acknowledged`."""
        size, on_acknowledged = self._unacknowledged.pop(mid, (0, None))
        self.outstanding_bytes -= size
        if on_acknowledged:
            on_acknowledged(code.value)

    def _on_log(self, _client: paho.Client, _data: object, _level: int, text: str) -> None:
        """Store a TLS alert that paho logs during the login."""
        # With TLS 1.3, the broker's alert about a missing certificate arrives in the first read, and paho only logs it.
        if "ALERT" in text and self._answer is None:
            self._alert = text.rpartition("] ")[2].partition(" (")[0]


@lru_cache(maxsize=32)
def _properties(expiry: float | None, response: str | None, correlation: bytes | None, token: str | None) -> Properties:
    """Return the MQTT properties for a message.

    They are cached, because creating them is slow.
    """
    properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
    if expiry is not None:
        properties.MessageExpiryInterval = max(1, math.ceil(min(expiry, 2**31)))
    if response is not None:
        properties.ResponseTopic = response
    if correlation is not None:
        properties.CorrelationData = correlation
    if token is not None:
        properties.UserProperty = (_TOKEN_PROPERTY, token)
    return properties


class LinkOpener:
    """Opens a link in a thread, because `Link.open` blocks and can't be interrupted."""

    def __init__(self, link: Link, on_done: Callable[[], object]) -> None:
        """Start opening the link in a new thread.

        The thread calls `on_done` when it has finished, unless `cancel` was called before.
        """
        self.link = link
        self.error: TalkError | None = None
        self.done = False
        self._on_done = on_done
        self._canceled = False
        self._lock = threading.Lock()
        threading.Thread(target=self._open, name="talk: connecting", daemon=True).start()

    def cancel(self) -> None:
        """Close the link. If the link is still being opened, it is closed afterwards."""
        with self._lock:
            self._canceled = True
            if self.done:
                self.link.close()

    def _open(self) -> None:
        """Open the link, and store any error. Then call `on_done`, or close a cancelled link."""
        try:
            self.link.open()
        except TalkError as error:
            self.error = error
        except Exception as error:  # noqa: BLE001 - reported to the waiting thread
            self.error = ServerUnavailable(f"a bug in the connection to the broker: {type(error).__name__}: {error}")
        with self._lock:
            self.done = True
            if self._canceled:
                self.link.close()
            else:
                self._on_done()
