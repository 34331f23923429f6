"""The broker, the client and the network that the fleet's tests stand on: what they are trusted with is shown here."""

from __future__ import annotations

import contextlib
import os
import socket
import ssl
import threading
from typing import TYPE_CHECKING

import pytest

from tests.support.broker import Broker
from tests.support.certificates import authority, stranger
from tests.support.connection import PATIENCE
from tests.support.mqtt import NO_SUBSCRIBERS, NOT_AUTHORIZED, SUCCESS, Listener, mosquitto
from tests.support.ports import HOST, Port, bound
from tests.support.proxy import Proxy

if TYPE_CHECKING:
    from collections.abc import Iterator

ACL = "user anna\ntopic read a/#\nuser bert\ntopic write a/#\n"


@pytest.fixture
def broker() -> Iterator[Broker]:
    with Broker() as result:
        yield result


def test_a_message_comes_as_it_was_sent(broker: Broker) -> None:
    with Listener(broker, "a/+") as listener:
        assert listener.publish("b", "unheard") == NO_SUBSCRIBERS
        assert listener.publish("a/1", "é", response="reply", correlation=b"\x00", expiry=100) == SUCCESS
        assert listener.publish("a/2", {"n": 1}, qos=0, retain=True) == SUCCESS
        plain = listener.await_message(lambda each: each.topic == "a/1")
        assert (plain.text, plain.qos, plain.retain) == ("é", 1, False)
        assert (plain.response, plain.correlation, plain.expiry, plain.user) == ("reply", b"\x00", 100, ())
        kept = listener.await_message(lambda each: each.topic == "a/2")
        assert (kept.json, kept.qos, kept.retain, kept.response, kept.expiry) == ({"n": 1}, 0, True, None, None)
        assert listener.messages == [plain, kept]
        assert plain.arrived <= kept.arrived
        with pytest.raises(AssertionError, match=r"no message: not within 0.01 s; a/1: .*; a/2: "):
            listener.await_message(lambda each: each.topic == "b", within=0.01)
    with Listener(broker, "a/+") as later:
        assert later.await_message(lambda each: each.topic == "a/2").retain
        assert len(later.messages) == 1


def test_mosquittos_own_clients_are_heard(broker: Broker) -> None:
    with Listener(broker, "a") as listener:
        done = mosquitto(broker, "pub", "-q", "1", "-t", "a", "-m", "hello", "-D", "publish", "user-property", "k", "v")
        assert (done.code, done.err) == (0, "")
        message = listener.await_message(lambda each: each.text == "hello")
        assert message.user == (("k", "v"),)


def test_a_broker_is_killed_and_up_again_at_the_same_port_without_what_it_kept(broker: Broker) -> None:
    port = broker.port
    with Listener(broker) as listener:
        listener.publish("a", "kept", retain=True)
        broker.kill()
        listener.await_end()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((HOST, port), PATIENCE)
    broker.start()
    assert broker.port == port
    with Listener(broker, "a", "b") as listener:
        listener.publish("b", "last")
        listener.await_message(lambda each: each.topic == "b")
        assert [each.topic for each in listener.messages] == ["b"]


def test_a_broker_that_is_stopped_says_nothing_and_goes_on_with_what_was_sent_meanwhile(broker: Broker) -> None:
    with Listener(broker, "a") as listener:
        broker.stop_process()
        with open(f"/proc/{broker.pid}/stat", encoding="ascii") as file:
            assert file.read().rpartition(")")[2].split()[0] == "T"
        thread = threading.Thread(target=listener.publish, args=("a", "late"))
        thread.start()
        assert listener.find(lambda each: each.topic == "a", within=0.05) is None
        broker.go_on()
        thread.join()
        assert [listener.await_message(lambda each: each.topic == "a").text] == ["late"]


def test_nothing_is_left_of_a_broker() -> None:
    with Broker() as broker:
        pid, directory = broker.pid, broker.directory
        assert "mosquitto version" in broker.log
    assert not os.path.exists(directory)
    assert not os.path.exists(f"/proc/{pid}")
    broker.close()


def test_a_will_comes_of_a_connection_that_is_cut(broker: Broker) -> None:
    with Listener(broker, "will") as listener, Listener(broker, will=("will", "gone")) as cut:
        cut.cut()
        assert listener.await_message(lambda each: each.topic == "will").retain


def test_passwords_and_an_acl_are_obeyed() -> None:
    with Broker(users={"anna": "a b", "bert": "b"}, acl=ACL) as broker:
        for user, password in ((None, True), ("anna", False), ("anna", "b")):
            with pytest.raises(ConnectionRefusedError, match="Not authorized"):
                Listener(broker, user=user, password=password)
        with Listener(broker, "a/1", user="anna") as anna, Listener(broker, user="bert") as bert:
            assert anna.publish("a/1", "no") == NOT_AUTHORIZED
            assert bert.publish("a/1", "yes") == SUCCESS
            assert mosquitto(broker, "pub", "-t", "a/1", "-m", "too", user="bert").code == 0
            assert mosquitto(broker, "pub", "-t", "a/1", "-m", "too", user="bert", password="a").code != 0
            anna.await_message(lambda each: each.text == "too")
            assert [each.text for each in anna.messages] == ["yes", "too"]


def test_anonymous_clients_are_let_in_beside_users_where_that_is_said() -> None:
    with Broker(users={"anna": "a"}, anonymous=True) as broker, Listener(broker, "a") as listener:
        with Listener(broker, user="anna") as anna:
            anna.publish("a", "")
        assert listener.await_message(lambda each: each.topic == "a").payload == b""


def test_a_broker_with_tls_is_trusted_by_who_knows_its_authority() -> None:
    with Broker(secure=True) as broker:
        assert broker.url == f"mqtts://localhost:{broker.port}"
        with Listener(broker, "a") as listener:
            assert mosquitto(broker, "pub", "-t", "a", "-m", "by TLS").code == 0
            listener.await_message(lambda each: each.text == "by TLS")
        with pytest.raises(ssl.SSLCertVerificationError, match="unable to get local issuer"):
            Listener(broker, env={"TALK_MQTT_CA": stranger().file})


def test_a_certificate_that_has_expired_is_refused() -> None:
    with Broker(expired=True) as broker, pytest.raises(ssl.SSLCertVerificationError, match="expired"):
        Listener(broker)


def test_a_clients_certificate_says_who_it_is() -> None:
    with Broker(certificates=True, acl=ACL) as broker:
        with Listener(broker, "a/1", cert="anna") as anna, Listener(broker, cert="bert") as bert:
            assert anna.publish("a/1", "no") == NOT_AUTHORIZED
            assert bert.publish("a/1", "yes") == SUCCESS
            assert mosquitto(broker, "pub", "-t", "a/1", "-m", "too", cert="bert").code == 0
            assert anna.await_message(lambda each: each.text == "too")
        false = stranger().client("anna")
        for env in ({}, {"TALK_MQTT_CERT": false.file, "TALK_MQTT_KEY": false.key}):
            with pytest.raises(ConnectionRefusedError):
                Listener(broker, env=env)


def test_certificates_are_made_once() -> None:
    assert authority() is authority()
    assert authority().client("anna") == authority().client("anna") != authority().client("bert")
    assert authority().server != authority().expired


def test_a_packet_that_is_too_large_ends_the_connection() -> None:
    with Broker(max_packet=1000) as broker, Listener(broker, "a") as listener:
        listener.publish("a", "x" * 900)
        with pytest.raises(AssertionError, match="the connection ended"):
            listener.publish("a", "x" * 1000)


def test_a_port_is_nobody_elses() -> None:
    with Port() as port:
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection((HOST, port.number), PATIENCE)
        with bound(port.number) as listening:
            listening.listen()
            socket.create_connection((HOST, port.number), PATIENCE).close()


@pytest.fixture
def far_end() -> Iterator[socket.socket]:
    with socket.create_server((HOST, 0)) as listening:
        listening.settimeout(PATIENCE)
        yield listening


def test_a_proxy_holds_and_loses_nothing(far_end: socket.socket) -> None:
    data = os.urandom(8_000_000)
    with contextlib.ExitStack() as stack:
        proxy = stack.enter_context(Proxy(far_end.getsockname()[1]))
        near = stack.enter_context(socket.create_connection((HOST, proxy.port), PATIENCE))
        far = stack.enter_context(far_end.accept()[0])
        far.settimeout(PATIENCE)
        near.sendall(b"first")
        assert _receive(far, 5) == b"first"
        proxy.hold("to_broker")
        sending = threading.Thread(target=near.sendall, args=(data,))
        sending.start()
        far.sendall(b"back")
        assert _receive(near, 4) == b"back"
        _assert_silent(far)
        proxy.hold()
        far.sendall(b"held, too")
        _assert_silent(near)
        proxy.release()
        assert _receive(far, len(data)) == data
        assert _receive(near, 9) == b"held, too"
        sending.join()


def test_the_end_of_either_side_passes_a_proxy_after_all_that_was_sent(far_end: socket.socket) -> None:
    with contextlib.ExitStack() as stack:
        proxy = stack.enter_context(Proxy(far_end.getsockname()[1]))
        near = stack.enter_context(socket.create_connection((HOST, proxy.port), PATIENCE))
        far = stack.enter_context(far_end.accept()[0])
        far.settimeout(PATIENCE)
        proxy.hold("to_broker")
        near.sendall(b"last words")
        near.shutdown(socket.SHUT_WR)
        _assert_silent(far)
        proxy.release()
        assert _receive(far, 11) == b"last words"
        far.sendall(b"heard")
        assert _receive(near, 5) == b"heard"
        far.close()
        assert near.recv(1) == b""


def test_a_proxy_cuts_refuses_and_accepts(far_end: socket.socket) -> None:
    with contextlib.ExitStack() as stack:
        proxy = stack.enter_context(Proxy(far_end.getsockname()[1]))
        near = stack.enter_context(socket.create_connection((HOST, proxy.port), PATIENCE))
        far = stack.enter_context(far_end.accept()[0])
        far.settimeout(PATIENCE)
        proxy.refuse()
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection((HOST, proxy.port), PATIENCE)
        near.sendall(b"still there")
        assert _receive(far, 11) == b"still there"
        assert proxy.connections == 1
        proxy.cut()
        assert proxy.connections == 0
        for each in (near, far):
            with pytest.raises(ConnectionResetError):
                each.recv(1)
        proxy.accept()
        again = stack.enter_context(socket.create_connection((HOST, proxy.port), PATIENCE))
        stack.enter_context(far_end.accept()[0]).sendall(b"x")
        assert _receive(again, 1) == b"x"


def test_a_proxy_resets_who_comes_where_no_broker_is() -> None:
    with Port() as nobody, Proxy(nobody.number) as proxy:
        with pytest.raises(ConnectionResetError):
            _connect_and_receive(proxy.port)  # either may raise it: the reset may come while it still connects
        assert proxy.connections == 0


def test_a_client_comes_through_a_proxy_by_tls() -> None:
    with contextlib.ExitStack() as stack:
        broker = stack.enter_context(Broker(secure=True))
        proxy = stack.enter_context(Proxy(broker.port))
        far = stack.enter_context(Listener(broker, "a", port=proxy.port))
        near = stack.enter_context(Listener(broker))
        near.publish("a", "first")
        far.await_message(lambda each: each.text == "first")
        proxy.hold("to_client")
        near.publish("a", "second")
        assert far.find(lambda each: each.text == "second", within=0.05) is None
        proxy.release()
        far.await_message(lambda each: each.text == "second")
        proxy.cut()
        far.await_end()


def _connect_and_receive(port: int) -> bytes:
    with socket.create_connection((HOST, port), PATIENCE) as near:
        return near.recv(1)


def _receive(connection: socket.socket, size: int) -> bytes:
    """Return so many bytes, or what came before the end."""
    result = bytearray()
    while len(result) < size and (piece := connection.recv(size - len(result))):
        result += piece
    return bytes(result)


def _assert_silent(connection: socket.socket) -> None:
    """Assert that nothing has come; a proxy that hands on does so within a fraction of this."""
    connection.settimeout(0.05)
    with pytest.raises(TimeoutError):
        connection.recv(1)
    connection.settimeout(PATIENCE)
