"""An MQTT client that keeps all messages and can publish anything. It shares no code with talk."""

from __future__ import annotations

import contextlib
import json
import socket
import ssl
import subprocess
import threading
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from tests.support.connection import PATIENCE
from tests.support.processes import Finished
from tests.support.resources import Resource
from tests.support.surroundings import clean_environment, dying_with_parent, find_program, needs, needs_packages
from tests.support.watcher import wait_for_first

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from paho.mqtt.client import Client, MQTTMessage

    from tests.support.broker import Broker

#: Reason code of MQTT 5 that mosquitto sends if a message has no subscribers.
NO_SUBSCRIBERS = 0x10
_QOS = 1


@dataclass(frozen=True, slots=True)
class Message:
    topic: str
    payload: bytes
    qos: int
    retain: bool  # set by the sender, or because the broker had retained the message
    response: str | None  # the response topic
    correlation: bytes | None
    expiry: int | None  # remaining seconds
    user: tuple[tuple[str, str], ...]  # user properties
    arrived: float  # monotonic time

    @property
    def text(self) -> str:
        return self.payload.decode()

    @property
    def json(self) -> dict[str, Any]:
        value = json.loads(self.payload)
        assert isinstance(value, dict), self
        return value


class Listener(Resource):
    """A connection that keeps all messages of its topics. It never reconnects.

    `user`, `password` and `cert` are as in `Broker.env`. The constructor raises ConnectionRefusedError if the broker
    refuses the client, and ssl.SSLError if one side doesn't trust the other.
    """

    def __init__(
        self,
        broker: Broker,
        *topics: str,
        user: str | None = None,
        password: str | bool = True,
        cert: str | None = None,
    ) -> None:
        needs_packages("paho")
        self._changed = threading.Condition()
        self._messages: list[Message] = []
        #: reason codes of acknowledgements, by packet number
        self._codes: dict[int, int] = {}
        self._connected: str | None = None
        self._ended: str | None = None
        variables = broker.env(user, password, cert)
        self._client = self._make(variables)
        with contextlib.ExitStack() as stack:
            stack.callback(self._end)
            self._connect(variables)
            for topic in topics:
                code = self.subscribe(topic)
                assert code <= _QOS, f"{topic}: refused with {code:#x}"
            self._stack = stack.pop_all()

    @property
    def messages(self) -> list[Message]:
        with self._changed:
            return list(self._messages)

    @property
    def ended(self) -> str | None:
        """The reason why the connection has ended, or None while it is open."""
        return self._ended

    def subscribe(self, topic: str) -> int:
        """Subscribe, and return the reason code: the quality of service, or at least 0x80 if it was refused."""
        from paho.mqtt.subscribeoptions import SubscribeOptions

        # Without this option, new retained messages would lose their flag.
        options = SubscribeOptions(qos=_QOS, retainAsPublished=True)
        _, number = self._client.subscribe([(topic, options)])
        assert number is not None, f"{topic}: not subscribed: {self._ended}"
        self._await(lambda: number in self._codes, f"subscription to {topic}")
        return self._codes.pop(number)

    def publish(
        self,
        topic: str,
        payload: str | bytes | Mapping[str, object],
        qos: int = 1,
        retain: bool = False,
        *,
        response: str | None = None,
        correlation: bytes | None = None,
        expiry: int | None = None,
        user: Sequence[tuple[str, str]] = (),
    ) -> int:
        """Publish, and return the reason code of the acknowledgement, or 0 with `qos` 0."""
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
        if response is not None:
            properties.ResponseTopic = response
        if correlation is not None:
            properties.CorrelationData = correlation
        if expiry is not None:
            properties.MessageExpiryInterval = expiry
        if user:
            properties.UserProperty = list(user)
        data = payload if isinstance(payload, str | bytes) else json.dumps(payload, ensure_ascii=False)
        number = self._client.publish(topic, data, qos, retain, properties).mid
        self._await(lambda: number in self._codes, f"acknowledgement of {topic}")
        return self._codes.pop(number)

    def await_message(self, wanted: Callable[[Message], bool], within: float = PATIENCE) -> Message:
        """Return the first wanted message, including messages that have come already."""
        message = self.find(wanted, within)
        assert message, f"no message within {within} s: {self._describe()}"
        return message

    def find(self, wanted: Callable[[Message], bool], within: float = 0.0) -> Message | None:
        """Return the first wanted message, or None if it doesn't come in time or the connection ends."""
        return wait_for_first(self._messages, wanted, self._changed, within, lambda: self._ended is not None)

    def _await(self, condition: Callable[[], bool], description: str) -> None:
        with self._changed:
            self._changed.wait_for(lambda: condition() or self._ended is not None, PATIENCE)
            assert condition(), f"no {description}: {self._describe()}"

    def _describe(self) -> str:
        state = "connected" if self._ended is None else f"the connection ended: {self._ended}"
        return "; ".join([state, *(f"{message.topic}: {message.payload!r}" for message in self._messages)])

    def _make(self, env: Mapping[str, str]) -> Client:
        from paho.mqtt import client as paho
        from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion

        result = paho.Client(
            CallbackAPIVersion.VERSION2, protocol=MQTTProtocolVersion.MQTTv5, reconnect_on_failure=False
        )
        if "TALK_MQTT_USER" in env:
            password = None
            if "TALK_MQTT_PASSWORD_FILE" in env:
                with open(env["TALK_MQTT_PASSWORD_FILE"], encoding="utf-8") as file:
                    password = file.read().rstrip("\n")
            result.username_pw_set(env["TALK_MQTT_USER"], password)
        if "TALK_MQTT_CA" in env:
            context = ssl.create_default_context(cafile=env["TALK_MQTT_CA"])
            if "TALK_MQTT_CERT" in env:
                context.load_cert_chain(env["TALK_MQTT_CERT"], env["TALK_MQTT_KEY"])
            _shake_hands(context, env["TALK_BROKER"])
            result.tls_set_context(context)
        result.on_socket_open = lambda _client, _data, connection: _send_at_once(connection)
        result.on_connect = lambda _client, _data, _flags, reason, _properties: self._note("_connected", str(reason))
        result.on_disconnect = lambda _client, _data, _flags, reason, _properties: self._note("_ended", str(reason))
        result.on_message = lambda _client, _data, message: self._receive(message)
        result.on_publish = lambda _client, _data, number, reason, _properties: self._note(number, reason.value)
        result.on_subscribe = lambda _client, _data, number, reasons, _properties: self._note(number, reasons[0].value)
        return result

    def _connect(self, env: Mapping[str, str]) -> None:
        url = urlsplit(env["TALK_BROKER"])
        assert url.hostname
        assert url.port
        self._client.connect(url.hostname, url.port, clean_start=True)
        self._client.loop_start()
        self._await(lambda: self._connected is not None or self._ended is not None, "reply from the broker")
        if self._connected != "Success":
            raise ConnectionRefusedError(self._connected or self._ended)

    def _receive(self, message: MQTTMessage) -> None:
        arrived = time.monotonic()
        properties = message.properties
        new = Message(
            message.topic,
            bytes(message.payload),
            message.qos,
            message.retain,
            getattr(properties, "ResponseTopic", None),
            getattr(properties, "CorrelationData", None),
            getattr(properties, "MessageExpiryInterval", None),
            tuple(getattr(properties, "UserProperty", ())),
            arrived,
        )
        self._acknowledge()
        with self._changed:
            self._messages.append(new)
            self._changed.notify_all()

    def _note(self, key: int | str, value: Any) -> None:
        """Store the reason code of a packet number, or set the attribute with this name."""
        self._acknowledge()
        with self._changed:
            if isinstance(key, int):
                self._codes[key] = value
            else:
                setattr(self, key, value)
            self._changed.notify_all()

    def _acknowledge(self) -> None:
        """Make the system acknowledge data at once. Otherwise, mosquitto delays its next message by 40 ms."""
        connection = self._client.socket()
        if isinstance(connection, socket.socket) and hasattr(socket, "TCP_QUICKACK"):
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)  # Linux resets this option

    def _end(self) -> None:
        client = self._client
        client.disconnect()
        client.loop_stop()
        # The client only closes its sockets when it is deleted, and the callbacks would keep it alive.
        client.on_socket_open = client.on_connect = client.on_disconnect = None
        client.on_message = client.on_publish = client.on_subscribe = client.on_log = None
        del self._client


def mosquitto(broker: Broker, program: str, *arguments: str) -> Finished:
    """Run one of mosquitto's clients: `mosquitto(broker, "pub", "-t", "a/topic", "-n")`."""
    needs(f"mosquitto_{program}")
    command = [find_program(f"mosquitto_{program}") or "", "-V", "5", "-p", str(broker.port)]
    command += ["-h", urlsplit(broker.url).hostname or "", *arguments]
    started_at = time.monotonic()
    done = subprocess.run(
        dying_with_parent(command),
        env=clean_environment(broker.directory),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        encoding="utf-8",
        timeout=20,
        check=False,
    )
    return Finished(tuple(command), done.returncode, done.stdout, done.stderr, time.monotonic() - started_at)


def _shake_hands(context: ssl.SSLContext, url: str) -> None:
    """Raise ssl.SSLError if the handshake fails, because paho would then leave its socket open."""
    parts = urlsplit(url)
    with socket.create_connection((parts.hostname or "", parts.port or 0), PATIENCE) as plain:
        context.wrap_socket(plain, server_hostname=parts.hostname).close()


def _send_at_once(connection: Any) -> None:
    """Disable Nagle's algorithm, so that acknowledgements are sent at once."""
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
