"""One MQTT connection to the broker, from nothing to its end, by paho. It has no loop and no thread of its own.

Whoever has it polls its descriptor, and calls `read`, `write` and `tick`. It is made anew for each connection: paho
would send what an old one had not acknowledged again, which may be a sentence. Nothing here knows what is said.
"""

from __future__ import annotations

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

from talkcli.errors import AccessDenied, ProtocolMismatch, RequestRefused, ServerUnavailable, TalkError
from talkcli.fleet.message import Message
from talkcli.frozen import frozen
from talkcli.terminal.text import printable

if TYPE_CHECKING:
    from collections.abc import Callable

    from paho.mqtt.reasoncodes import ReasonCode

    from talkcli.fleet.broker import Broker

#: Seconds: the broker counts a client as gone that says nothing for one and a half of these.
KEEPALIVE = 10
#: Seconds in which a broker must answer that one is connected; and seconds between two calls of `tick`.
PATIENCE, TICK = 5.0, 5.0
#: Bytes of a packet at most: a reply's lines, with room for the topics.
MAX_PACKET = 256 * 1024
#: What stands in a packet besides its payload, at most: topics, properties, numbers.
MAX_HEAD = 1024
#: Messages of QoS 1 that the broker has not acknowledged yet; more wait here. HiveMQ's cloud takes 10, others more, and
#: paho can't obey what this one says when it answers.
_IN_FLIGHT = 10
#: Messages of QoS 1 that may be on their way to who hears of all robots, the most that MQTT knows. mosquitto by itself
#: sends 20, has 1,000 more wait for each client, and drops what is past that without a word, of what it keeps, too.
MANY_AT_ONCE = 65_535
#: Reasons of MQTT 5 for which one is not let in, and that of another protocol.
_DENIED = (0x86, 0x87, 0x8A, 0x8C)
_OTHER_PROTOCOL = 0x84
#: Reasons of an acknowledgement from which on nothing was taken, and that for who may not publish there.
REFUSED, NOT_AUTHORIZED = 0x80, 0x87
#: Discard what is unsent when it is closed: a sentence that waits in a stalled line must not arrive minutes later.
_DISCARD, _DELIVER = struct.pack("ii", 1, 0), struct.pack("ii", 0, 0)


def boottime() -> float:
    """Return the seconds since the machine's start, those in which it was suspended among them, where that is known."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


@frozen
class Will:
    """What the broker publishes, retained, once this connection has broken."""

    topic: str
    payload: bytes


class Link:
    """A connection to the broker. Any thread may call it, `hear` is called by the one that reads."""

    def __init__(
        self,
        broker: Broker,
        client_id: str,
        hear: Callable[[Message], None],
        will: Will | None = None,
        most: int = MAX_PACKET,
        at_once: int | None = None,
    ) -> None:
        """Make one; it connects with `open`. UsageError where what TLS needs can't be read.

        `most`: bytes of a packet that may come; `at_once`: messages of QoS 1 that may come before the first of them is
        acknowledged, None for as many as the broker thinks best.
        """
        self._broker = broker
        self._hear = hear
        self._most = most
        self._at_once = at_once
        #: why nothing more comes, once that is so
        self.ended: str | None = None
        #: bytes that the broker has not taken yet, or not acknowledged
        self.outstanding = 0
        #: bytes of a payload that the broker takes
        self.room = MAX_PACKET - MAX_HEAD
        self._sizes: dict[int, int] = {}
        self._acknowledged: dict[int, Callable[[int], None]] = {}
        self._answer: ReasonCode | None = None
        self._alert = ""
        #: held while paho is used: TLS can't be read and written at once
        self._using = threading.RLock()
        #: whether paho is handing on what has come: it would wait for itself where a write then finds the broker gone
        self._hearing = False
        self._tls: ssl.SSLSocket | None = None
        self._socket: socket.socket | None = None
        self._paho = paho.Client(
            CallbackAPIVersion.VERSION2, client_id, protocol=paho.MQTTv5, reconnect_on_failure=False
        )
        self._paho.max_inflight_messages_set(_IN_FLIGHT)
        context = broker.context()
        if context:
            self._paho.tls_set_context(context)
        if broker.user is not None:
            self._paho.username_pw_set(broker.user, broker.password)
        if will:
            self._paho.will_set(will.topic, will.payload, qos=1, retain=True)
        self._paho.on_connect = self._on_connect
        self._paho.on_disconnect = self._on_disconnect
        self._paho.on_message = self._on_message
        self._paho.on_publish = self._on_publish
        self._paho.on_log = self._on_log

    def open(self) -> None:
        """Connect, log in, and return once the broker has said yes. It waits, and so has a thread to itself.

        ServerUnavailable where no broker answers, AccessDenied where it, or its certificate, is not to be trusted or it
        doesn't let this user in, ProtocolMismatch for one that doesn't speak MQTT 5.
        """
        url = self._broker.url
        properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
        properties.SessionExpiryInterval = 0
        properties.MaximumPacketSize = self._most
        if self._at_once is not None:
            properties.ReceiveMaximum = self._at_once
        self._paho.connect_timeout = PATIENCE
        try:
            self._paho.connect(self._broker.host, self._broker.port, KEEPALIVE, clean_start=True, properties=properties)
        except ssl.SSLCertVerificationError as error:
            words = f"the broker's certificate is not to be trusted: {error.verify_message} ({url})"
            raise AccessDenied(f"{words}; TALK_MQTT_CA names the file of the CA that it is of") from error
        except ssl.SSLError as error:
            raise ServerUnavailable(f"no TLS with the broker at {url}: {error.reason or error}") from error
        except (OSError, ValueError) as error:  # ValueError: a host's name that is none
            why = error.strerror if isinstance(error, OSError) else None
            raise ServerUnavailable(f"no broker at {url}: {why or error}") from error
        found = self._paho.socket()
        if isinstance(found, socket.socket):  # else the broker has hung up before the login was sent
            self._prepare(found)
        end = time.monotonic() + PATIENCE
        while self._answer is None and self.ended is None and (left := end - time.monotonic()) > 0:
            self._wait(left)
        fault = self._fault()
        if fault:
            self.close()
            raise fault

    def fileno(self) -> int:
        """Return the descriptor to poll; -1 once it has ended."""
        return -1 if self._socket is None else self._socket.fileno()

    @property
    def wants_write(self) -> bool:
        """Whether something waits until the descriptor can be written."""
        return self.ended is None and bool(self._paho.want_write())

    def read(self) -> None:
        """Take what has come, and hand it to `hear`; it never waits."""
        with self._using:
            while self.ended is None:
                self._hearing = True
                try:
                    self._paho.loop_read()
                finally:
                    self._hearing = False
                if self.ended is None and self._socket is not None and hasattr(socket, "TCP_QUICKACK"):
                    # Else the broker's Nagle waits 40 ms for the acknowledgement that this kernel delays as long.
                    self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
                if not (self._tls and self.ended is None and self._tls.pending()):
                    break
            self.write()

    def write(self) -> None:
        """Send what waits, as far as it goes; it never waits. What `hear` publishes goes once that has returned."""
        with self._using:
            if self.wants_write and not self._hearing:
                self._paho.loop_write()

    def tick(self) -> None:
        """See to the signs of life; every `TICK` seconds."""
        with self._using:
            if self.ended is None:
                self._paho.loop_misc()

    def publish(
        self,
        topic: str,
        payload: bytes,
        qos: int = 1,
        *,
        retain: bool = False,
        expiry: float | None = None,
        response: str | None = None,
        correlation: bytes | None = None,
        acknowledged: Callable[[int], None] | None = None,
    ) -> bool:
        """Publish, and return whether that was still possible.

        `expiry`: seconds after which the broker need not deliver it any more; `acknowledged`: called, by who reads,
        with the reason of the broker's acknowledgement, of QoS 1; `NOT_AUTHORIZED` is one.
        """
        properties = _properties(expiry, response, correlation)
        with self._using:
            if self.ended is not None:
                return False
            info = self._paho.publish(topic, payload, qos, retain, properties)
            if info.rc == MQTTErrorCode.MQTT_ERR_NO_CONN or self.ended is not None:
                return False
            if not info.is_published():
                size = len(topic) + len(payload)
                self._sizes[info.mid] = size
                self.outstanding += size
                if acknowledged:
                    self._acknowledged[info.mid] = acknowledged
            self.write()
        return True

    def too_long(self, line: bytes, kind: str) -> RequestRefused | None:
        """Return the error for a request of this kind that is longer than what the broker takes; None where it fits."""
        if len(line) <= self.room:
            return None
        words = f"{kind} has {len(line):,} bytes, and the broker takes {self.room:,}: nothing was sent"
        return RequestRefused(words, "too_long")

    def subscribe(self, *wanted: str, retained: bool) -> None:
        """Have messages of these topics come; `retained`: those that the broker keeps, too.

        Whoever publishes with the flag for that is found out either way: see `Message.retained`.
        """
        handling = SubscribeOptions.RETAIN_SEND_ON_SUBSCRIBE if retained else SubscribeOptions.RETAIN_DO_NOT_SEND
        options = SubscribeOptions(qos=1, retainAsPublished=True, retainHandling=handling)
        with self._using:
            if self.ended is None:
                self._paho.subscribe([(each, options) for each in wanted])
                self.write()

    def close(self) -> None:
        """End it, with a goodbye where nothing is on its way; else what the broker has not taken is discarded."""
        with self._using:
            let_in = self._answer is not None and not self._answer.is_failure
            if self.ended is None and self._socket is not None and let_in and not self._sizes:
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _DELIVER)
                self._paho.disconnect()
                self.write()
            self.ended = self.ended or "the connection was closed"
            if self._socket is not None:
                self._socket.close()
                self._socket = None

    def drop(self) -> None:
        """Close this process's copy of the descriptor, as a child does: the connection is its parent's."""
        if self._socket is not None:
            os.close(self._socket.detach())

    # -- inside

    def _prepare(self, connected: socket.socket) -> None:
        self._socket = connected
        self._tls = connected if isinstance(connected, ssl.SSLSocket) else None
        try:
            connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # paho leaves Nagle on: 40 ms a message
            connected.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _DISCARD)
        except OSError:
            pass  # macOS: the broker has reset it, which the first read will find

    def _wait(self, timeout: float) -> None:
        poll = select.poll()
        poll.register(self.fileno(), select.POLLIN | (select.POLLOUT if self.wants_write else 0))
        if (self._tls and self._tls.pending()) or poll.poll(math.ceil(timeout * 1000)):
            self.read()

    def _fault(self) -> TalkError | None:
        """Return why the broker doesn't let this client in, None where it does."""
        url, answer = self._broker.url, self._answer
        if answer is None and self._broker.tls and (self._alert or self.ended):
            # With TLS 1.3 a client is done before the broker has looked at its certificate; what that says then may
            # be lost with the connection.
            why = self._alert or "it ends the connection before it answers"
            which = "the certificate of this client" if self._broker.cert else "a client without a certificate"
            words = f"the broker at {url} does not let {which} in: {why}"
            return AccessDenied(f"{words}; TALK_MQTT_CERT and TALK_MQTT_KEY name one that it takes")
        if answer is None:
            why = self.ended or f"nothing in {PATIENCE:g} s"
            return ServerUnavailable(f"the broker at {url} does not answer: {why}")
        if answer.value in _DENIED:
            who = "a client without a user" if self._broker.user is None else f"'{printable(self._broker.user)}'"
            words = f"the broker at {url} does not let {who} in: {answer}"
            return AccessDenied(f"{words}; TALK_MQTT_USER and TALK_MQTT_PASSWORD_FILE say who you are")
        if answer.value == _OTHER_PROTOCOL:
            return ProtocolMismatch(f"the broker at {url} does not speak MQTT 5: mosquitto does from 1.6 on")
        if answer.is_failure or self.ended:
            return ServerUnavailable(f"the broker at {url} refuses: {answer if answer.is_failure else self.ended}")
        return None

    def _on_connect(
        self, _client: paho.Client, _data: object, _flags: object, code: ReasonCode, properties: Properties | None
    ) -> None:
        self._answer = code
        # What it logs is of use for a login that fails alone, and takes a tenth of the processor time of each packet.
        self._paho.on_log = None
        most = getattr(properties, "MaximumPacketSize", MAX_PACKET)
        self.room = max(0, min(MAX_PACKET, most) - MAX_HEAD)

    def _on_disconnect(self, _client: paho.Client, _data: object, flags: object, code: ReasonCode, _: object) -> None:
        said = getattr(flags, "is_disconnect_packet_from_server", False)
        self.ended = self.ended or (f"the broker ended the connection: {code}" if said else "the broker went away")
        self._socket = None  # paho closes it

    def _on_message(self, _client: paho.Client, _data: object, message: paho.MQTTMessage) -> None:
        properties = message.properties
        self._hear(
            Message(
                message.topic,
                bytes(message.payload),
                message.retain,
                getattr(properties, "ResponseTopic", None),
                getattr(properties, "CorrelationData", None),
                getattr(properties, "MessageExpiryInterval", None),
            )
        )

    def _on_publish(self, _client: paho.Client, _data: object, mid: int, code: ReasonCode, _: object) -> None:
        self.outstanding -= self._sizes.pop(mid, 0)
        acknowledged = self._acknowledged.pop(mid, None)
        if acknowledged:
            acknowledged(code.value)

    def _on_log(self, _client: paho.Client, _data: object, _level: int, words: str) -> None:
        # Where TLS 1.3 wants a client's certificate, that comes with the first read, and paho says it here alone.
        if "ALERT" in words and self._answer is None:
            self._alert = words.rpartition("] ")[2].partition(" (")[0]


@lru_cache(maxsize=32)
def _properties(expiry: float | None, response: str | None, correlation: bytes | None) -> Properties | None:
    """Return what a message has besides topic and payload, if anything; events have the same, and paho takes time."""
    given: dict[str, object] = {}
    if expiry is not None:
        given["MessageExpiryInterval"] = max(1, math.ceil(min(expiry, 2**31)))
    if response is not None:
        given["ResponseTopic"] = response
    if correlation is not None:
        given["CorrelationData"] = correlation
    if not given:
        return None
    properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
    for name, value in given.items():
        setattr(properties, name, value)
    return properties


class Opening:
    """A connection to the broker that is being made, by a thread of its own: that waits, and can't be interrupted."""

    def __init__(self, link: Link, wake: Callable[[], None]) -> None:
        self.link = link
        self.error: TalkError | None = None
        self.done = False
        self._wake = wake
        self._given_up = False
        self._ending = threading.Lock()
        threading.Thread(target=self._open, name="talk: connecting", daemon=True).start()

    def give_up(self) -> None:
        """Let go of it, whenever it is there."""
        with self._ending:
            self._given_up = True
            if self.done:
                self.link.close()

    def _open(self) -> None:
        try:
            self.link.open()
        except TalkError as error:
            self.error = error
        except Exception as error:  # noqa: BLE001 - whoever waits for this thread hears it
            self.error = ServerUnavailable(f"a bug in the connection to the broker: {type(error).__name__}: {error}")
        with self._ending:
            self.done = True
            if self._given_up:
                self.link.close()
            else:
                self._wake()
