"""A link's reaction to a broker's packets. A script plays the broker."""

from __future__ import annotations

import contextlib
import socket
import threading
from typing import TYPE_CHECKING

import pytest

from talkcli.errors import AccessDenied, ProtocolMismatch, ServerUnavailable, TalkError
from talkcli.fleet.broker import Broker
from talkcli.fleet.payloads import Message
from tests.support.surroundings import needs_packages

if TYPE_CHECKING:
    from collections.abc import Iterator

    from talkcli.fleet.link import Link

#: A CONNACK packet that accepts the login, without properties.
ACCEPTED = b"\x20\x03\x00\x00\x00"


def login(code: int, properties: bytes = b"") -> bytes:
    """Return a CONNACK packet of MQTT 5."""
    return bytes([0x20, 3 + len(properties), 0, code, len(properties)]) + properties


@contextlib.contextmanager
def scripted_broker(first: bytes) -> Iterator[tuple[Broker, list[socket.socket]]]:
    """Answer the first packet of a client with these bytes. With b"", close the connection."""
    needs_packages("paho")
    with socket.create_server(("127.0.0.1", 0)) as listening, contextlib.ExitStack() as stack:
        clients: list[socket.socket] = []

        def serve() -> None:
            client = stack.enter_context(listening.accept()[0])
            client.settimeout(5)
            client.recv(4096)
            if first:
                clients.append(client)
                client.sendall(first)
            else:
                client.close()

        thread = threading.Thread(target=serve)
        thread.start()
        stack.callback(thread.join)
        yield Broker("127.0.0.1", listening.getsockname()[1], tls=False), clients


@pytest.mark.parametrize(
    ("answer", "error", "words"),
    [
        (b"", ServerUnavailable, "check that the broker supports MQTT 5, as mosquitto 1.6 or later does"),
        (b"\x20\x02\x00\x01", ProtocolMismatch, "does not support MQTT 5"),  # the answer of MQTT 3.1.1
        (login(0x84), ProtocolMismatch, "does not support MQTT 5"),
        (login(0x9A), ProtocolMismatch, "does not support retained messages"),
        (login(0x9B), ProtocolMismatch, "does not support QoS 1"),
        (login(0, b"\x24\x00"), ProtocolMismatch, "does not support QoS 1"),
        (login(0, b"\x25\x00\x28\x00"), ProtocolMismatch, "retained messages and wildcards in subscriptions"),
        *(
            (login(code), AccessDenied, "rejected the login of an anonymous user")
            for code in (0x86, 0x87, 0x8A, 0x8C, 0x90)
        ),
        (login(0x89), ServerUnavailable, "refused the connection: Server busy"),
    ],
)
def test_a_failed_login_has_an_error_with_its_likely_cause(answer: bytes, error: type[TalkError], words: str) -> None:
    from talkcli.fleet.link import Link

    with scripted_broker(answer) as (broker, _), pytest.raises(error) as caught:
        Link(broker, "test", lambda _: None).open()
    assert type(caught.value) is error
    assert words in caught.value.message


def test_a_rejected_topic_at_the_login_is_that_of_the_will() -> None:
    from talkcli.fleet.link import Link

    will = Message("talk/robot/anna/presence", b"")
    with scripted_broker(login(0x90)) as (broker, _), pytest.raises(AccessDenied) as caught:
        Link(broker, "test", lambda _: None, will).open()
    assert "does not allow an anonymous user to publish a robot's presence" in caught.value.message


@contextlib.contextmanager
def opened(answer: bytes, subscribed: list[tuple[str, int]]) -> Iterator[tuple[Link, socket.socket]]:
    """Yield an open link, and the broker's end of its connection. Record the answers to subscriptions."""
    from talkcli.fleet.link import Link

    with scripted_broker(answer) as (broker, clients):
        link = Link(broker, "test", lambda _: None, on_subscribed=lambda *each: subscribed.append(each))
        link.open()
        try:
            yield link, clients[0]
        finally:
            link.close()


@pytest.mark.parametrize(("properties", "limit"), [(b"\x21\x00\x03", 3), (b"\x21\x00\x40", 10), (b"", 10)])
def test_no_more_messages_are_sent_at_once_than_the_broker_accepts(properties: bytes, limit: int) -> None:
    with opened(login(0, properties), []) as (link, client):
        for _ in range(20):
            link.publish(Message("t", b"payload"))
        received = b""
        while received.count(b"payload") < limit:
            received += client.recv(4096)
        client.settimeout(0.05)
        with pytest.raises(TimeoutError):
            client.recv(1)
        assert received.count(b"payload") == limit


def test_the_brokers_limit_for_packets_is_obeyed() -> None:
    with opened(login(0, b"\x27\x00\x00\x08\x00"), []) as (link, _):
        assert link.max_payload_bytes == 1024


#: The packets of a broker if a user may not use a topic, and for another problem, with the reason code.
REJECTIONS = [
    *((packet, 0x87, AccessDenied, 10) for packet in ("SUBACK", "PUBACK", "DISCONNECT")),
    *((packet, 0x8F, AccessDenied, 10) for packet in ("SUBACK", "DISCONNECT")),
    *((packet, 0x90, AccessDenied, 10) for packet in ("PUBACK", "DISCONNECT")),
    *((packet, 0x97, ServerUnavailable, 3) for packet in ("SUBACK", "PUBACK")),
]


@pytest.mark.parametrize(("packet", "code", "error", "exit_code"), REJECTIONS)
def test_a_rejected_topic_is_reported_whatever_packet_rejects_it(
    packet: str, code: int, error: type[TalkError], exit_code: int
) -> None:
    from talkcli.fleet.desk.link import DeskLink

    subscribed: list[tuple[str, int]] = []
    codes: list[int] = []
    with opened(ACCEPTED, subscribed) as (link, client):
        link.subscribe("a/+", retained=False)
        link.publish(Message("t", b"payload"), on_acknowledged=codes.append)
        if packet == "SUBACK":
            client.sendall(bytes([0x90, 4, 0, 1, 0, code]))
        elif packet == "PUBACK":
            client.sendall(bytes([0x40, 4, 0, 2, code, 0]))
        else:
            client.sendall(bytes([0xE0, 2, code, 0]))
        while not (subscribed or codes or link.ended):
            link.read()
        assert subscribed == ([] if packet == "PUBACK" else [("a/+", code)])
        assert codes == ([] if packet == "SUBACK" else [code])
        desk = DeskLink(link._broker)
        try:
            rejection = desk._rejection_error(code, "read a/+")
        finally:
            desk.close()
    assert (type(rejection), rejection.exit_code) == (error, exit_code)
