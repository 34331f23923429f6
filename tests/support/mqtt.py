"""A client of a broker as blunt as tests want it: it keeps all that comes, and publishes what nobody else would.

It knows nothing of what talk says to a broker, and nothing of talk's own client.
"""

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
from tests.support.surroundings import clean_environment, dying_with_parent, find_program, needs, needs_packages

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from paho.mqtt.client import Client, MQTTMessage
    from paho.mqtt.properties import Properties

    from tests.support.broker import Broker

#: Reason codes of MQTT 5: done; done, and nobody has subscribed to it, which others than mosquitto don't say; refused.
SUCCESS, NO_SUBSCRIBERS, NOT_AUTHORIZED = 0x00, 0x10, 0x87
#: Quality of service of a subscription by default.
_QOS = 1


@dataclass(frozen=True, slots=True)
class Message:
    """A message as it came."""

    topic: str
    payload: bytes
    qos: int
    retain: bool  # as its sender set it, or because it is what a broker kept
    response: str | None  # the response topic
    correlation: bytes | None
    expiry: int | None  # seconds; what a broker has kept it for is off
    user: tuple[tuple[str, str], ...]  # user properties
    arrived: float  # monotonic time

    @property
    def text(self) -> str:
        """The payload as text."""
        return self.payload.decode()

    @property
    def json(self) -> dict[str, Any]:
        """The payload as a JSON object."""
        found = json.loads(self.payload)
        assert isinstance(found, dict), self
        return found


class Listener(contextlib.AbstractContextManager["Listener"]):
    """A connection that keeps all messages of its topics; `close()` or `with` ends it. It never connects again.

    `user`, `password` and `cert` are as in `Broker.env`, `port` is that of a proxy, if it is to come by one. Raises
    ConnectionRefusedError where the broker lets it not in, ssl.SSLError where one doesn't trust the other.
    """

    def __init__(
        self,
        broker: Broker,
        *topics: str,
        user: str | None = None,
        password: str | bool = True,
        cert: str | None = None,
        port: int | None = None,
        env: Mapping[str, str] | None = None,
        name: str = "",
        will: tuple[str, str] | None = None,
    ) -> None:
        """`env`: variables that differ from the broker's; `name`: the client's identifier; `will`: retained."""
        needs_packages("paho")
        self._changed = threading.Condition()
        self._messages: list[Message] = []
        self._acknowledged: dict[int, int] = {}
        self._subscribed: dict[int, list[int]] = {}
        self._answer: str | None = None
        self._ended: str | None = None
        to = {"TALK_BROKER": broker.url_at(port)} if port else {}
        whole = broker.env(user, password, cert) | to | dict(env or {})
        self._client = self._make(whole, name)
        if will:
            self._client.will_set(*will, qos=1, retain=True)
        with contextlib.ExitStack() as stack:
            stack.callback(self._end)
            self._connect(whole)
            for each in topics:
                code = self.subscribe(each)
                assert code <= _QOS, f"{each}: refused with {code:#x}"
            self._stack = stack.pop_all()

    def __exit__(self, *_error: object) -> None:
        self.close()

    def close(self) -> None:
        """End the connection; what was collected stays."""
        self._stack.close()

    @property
    def messages(self) -> list[Message]:
        """All messages so far."""
        with self._changed:
            return list(self._messages)

    @property
    def ended(self) -> str | None:
        """Why the connection has ended, None while it is there."""
        return self._ended

    def subscribe(self, topic: str, qos: int = _QOS) -> int:
        """Subscribe, and return the reason code of the answer: the quality of service, or from 0x80 on a refusal."""
        from paho.mqtt.subscribeoptions import SubscribeOptions

        # Else a broker takes the flag off what is published now, and who publishes retained would not be found out.
        options = SubscribeOptions(qos=qos, retainAsPublished=True)
        _, number = self._client.subscribe([(topic, options)])
        assert number is not None, f"{topic}: not subscribed: {self._ended}"
        self._await(lambda: number in self._subscribed, PATIENCE, f"subscription to {topic}")
        return self._subscribed.pop(number)[0]

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
    ) -> int:
        """Publish, and return the reason code of the acknowledgement, 0 where there is none (`qos` 0)."""
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
        if response is not None:
            properties.ResponseTopic = response
        if correlation is not None:
            properties.CorrelationData = correlation
        if expiry is not None:
            properties.MessageExpiryInterval = expiry
        data = payload if isinstance(payload, str | bytes) else json.dumps(payload, ensure_ascii=False)
        number = self._client.publish(topic, data, qos, retain, properties).mid
        self._await(lambda: number in self._acknowledged, PATIENCE, f"acknowledgement of {topic}")
        return self._acknowledged.pop(number)

    def await_message(self, wanted: Callable[[Message], bool], within: float = PATIENCE) -> Message:
        """Wait for the first message, of all so far and to come, that is wanted, and return it."""
        found = self.find(wanted, within)
        assert found, f"no message: {self._told(within)}"
        return found

    def find(self, wanted: Callable[[Message], bool], within: float = 0.0) -> Message | None:
        """Return the first message that is wanted, None if none comes in time or the connection ends."""
        seen = 0
        end = time.monotonic() + within
        with self._changed:
            while True:
                for each in self._messages[seen:]:
                    if wanted(each):
                        return each
                seen = len(self._messages)
                left = end - time.monotonic()
                if left <= 0 or self._ended is not None:
                    return None
                self._changed.wait(left)

    def await_end(self, within: float = PATIENCE) -> str:
        """Wait until the connection has ended, and return why."""
        with self._changed:
            assert self._changed.wait_for(lambda: self._ended is not None, within), f"still connected after {within} s"
            assert self._ended is not None
            return self._ended

    def cut(self) -> None:
        """End the connection without a word, as one that crashed: the broker publishes its will, if it has one."""
        connection = self._client.socket()
        assert isinstance(connection, socket.socket)
        with contextlib.suppress(OSError):
            connection.shutdown(socket.SHUT_RDWR)
        self.await_end()

    def _await(self, come: Callable[[], bool], within: float, what: str) -> None:
        with self._changed:
            self._changed.wait_for(lambda: come() or self._ended is not None, within)
            assert come(), f"no {what}: {self._told(within)}"

    def _told(self, within: float) -> str:
        why = f"not within {within} s" if self._ended is None else f"the connection ended: {self._ended}"
        return "; ".join([why, *(f"{each.topic}: {each.payload!r}" for each in self._messages)])

    def _make(self, env: Mapping[str, str], name: str) -> Client:
        from paho.mqtt import client as paho
        from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion

        result = paho.Client(
            CallbackAPIVersion.VERSION2, name, protocol=MQTTProtocolVersion.MQTTv5, reconnect_on_failure=False
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
        result.on_connect = lambda _client, _data, _flags, reason, _properties: self._take_answer(str(reason))
        result.on_disconnect = lambda _client, _data, _flags, reason, _properties: self._take_end(str(reason))
        result.on_message = lambda _client, _data, message: self._take(message)
        result.on_publish = lambda _client, _data, number, reason, _properties: self._store(
            self._acknowledged, number, reason.value
        )
        result.on_subscribe = lambda _client, _data, number, reasons, _properties: self._store(
            self._subscribed, number, [each.value for each in reasons]
        )
        return result

    def _connect(self, env: Mapping[str, str]) -> None:
        url = urlsplit(env["TALK_BROKER"])
        assert url.hostname
        assert url.port
        self._client.connect(url.hostname, url.port, clean_start=True)
        self._client.loop_start()
        with self._changed:
            come = self._changed.wait_for(lambda: self._answer is not None or self._ended is not None, PATIENCE)
            assert come, f"no answer from the broker within {PATIENCE} s"
        if self._answer != "Success":
            raise ConnectionRefusedError(self._answer or self._ended)

    def _take_answer(self, reason: str) -> None:
        with self._changed:
            self._answer = reason
            self._changed.notify_all()

    def _acknowledge(self) -> None:
        """Have the system acknowledge what came at once: else a stock broker holds its next message back for 40 ms."""
        connection = self._client.socket()
        if isinstance(connection, socket.socket) and hasattr(
            socket, "TCP_QUICKACK"
        ):  # Linux forgets it with each packet
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)  # Linux forgets it with each packet

    def _take_end(self, reason: str) -> None:
        with self._changed:
            self._ended = reason
            self._changed.notify_all()

    def _take(self, message: MQTTMessage) -> None:
        arrived = time.monotonic()
        told = message.properties
        new = Message(
            message.topic,
            bytes(message.payload),
            message.qos,
            message.retain,
            _property(told, "ResponseTopic"),
            _property(told, "CorrelationData"),
            _property(told, "MessageExpiryInterval"),
            tuple(_property(told, "UserProperty") or ()),
            arrived,
        )
        self._acknowledge()
        with self._changed:
            self._messages.append(new)
            self._changed.notify_all()

    def _store(self, to: dict[int, Any], number: int, value: Any) -> None:
        self._acknowledge()
        with self._changed:
            to[number] = value
            self._changed.notify_all()

    def _end(self) -> None:
        client = self._client
        client.disconnect()
        client.loop_stop()
        # paho closes the sockets that wake its thread when it goes itself, which these would put off for any time.
        client.on_socket_open = client.on_connect = client.on_disconnect = None
        client.on_message = client.on_publish = client.on_subscribe = client.on_log = None
        del self._client


def mosquitto(
    broker: Broker,
    program: str,
    *words: str,
    user: str | None = None,
    password: str | bool = True,
    cert: str | None = None,
    stdin: str | None = None,
    timeout: float = 20,
) -> Finished:
    """Run one of mosquitto's own clients to its end: `mosquitto(broker, "pub", "-t", "a/topic", "-n")`."""
    needs(f"mosquitto_{program}")
    env = broker.env(user, password, cert)
    command = [find_program(f"mosquitto_{program}") or "", "-V", "5", "-p", str(broker.port)]
    command += ["-h", urlsplit(broker.url).hostname or ""]
    if user is not None:
        command += ["-u", user]
    if "TALK_MQTT_PASSWORD_FILE" in env:
        with open(env["TALK_MQTT_PASSWORD_FILE"], encoding="utf-8") as file:
            command += ["-P", file.read().rstrip("\n")]
    for name, option in (("CA", "--cafile"), ("CERT", "--cert"), ("KEY", "--key")):
        if f"TALK_MQTT_{name}" in env:
            command += [option, env[f"TALK_MQTT_{name}"]]
    began = time.monotonic()
    done = subprocess.run(
        dying_with_parent([*command, *words]),
        env=clean_environment(broker.directory),
        input=stdin or "",
        capture_output=True,
        encoding="utf-8",
        timeout=timeout,
        check=False,
    )
    return Finished(
        (f"mosquitto_{program}", *words), done.returncode, done.stdout, done.stderr, time.monotonic() - began
    )


def _shake_hands(context: ssl.SSLContext, url: str) -> None:
    """Raise ssl.SSLError where a handshake fails: paho would leave its socket open then."""
    parts = urlsplit(url)
    with socket.create_connection((parts.hostname or "", parts.port or 0), PATIENCE) as plain:
        context.wrap_socket(plain, server_hostname=parts.hostname).close()


def _property(told: Properties | None, name: str) -> Any:
    return getattr(told, name, None)


def _send_at_once(connection: Any) -> None:
    """Have acknowledgements go at once: else a broker's next message would wait for them, by Nagle's rule."""
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
