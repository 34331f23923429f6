"""Reading the broker and the login from the environment. Error messages must not show secrets."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from talkcli.errors import UsageError
from talkcli.fleet.broker import Broker, client_user, from_environment

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize(
    ("url", "broker", "shown"),
    [
        ("mqtt://broker", Broker("broker", 1883, tls=False), "mqtt://broker:1883"),
        ("mqtts://broker", Broker("broker", 8883, tls=True), "mqtts://broker:8883"),
        ("mqtts://broker.example:8884/", Broker("broker.example", 8884, tls=True), "mqtts://broker.example:8884"),
        ("mqtt://[::1]:18", Broker("::1", 18, tls=False), "mqtt://[::1]:18"),
    ],
)
def test_the_broker_is_read_from_its_url(url: str, broker: Broker, shown: str) -> None:
    actual = from_environment({"TALK_BROKER": url})
    assert (actual, actual.url) == (broker, shown)


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("", "export TALK_BROKER=mqtts://broker.example"),
        ("broker", "mqtts://HOST or mqtt://HOST"),
        ("http://broker", "mqtts://HOST or mqtt://HOST"),
        ("mqtt://", "has no valid host"),
        ("mqtt://[::1", "is not a valid URL"),
        ("mqtt://broker:0", "has no valid host or port"),
        ("mqtt://broker:99999", "an invalid port"),
        ("mqtt://broker/robots", "must only have a host and a port; use mqtt://broker"),
        ("mqtt://broker?x=1", "must only have a host and a port"),
    ],
)
def test_an_invalid_url_is_refused_with_the_next_step(url: str, message: str) -> None:
    with pytest.raises(UsageError, match="TALK_BROKER") as caught:
        from_environment({"TALK_BROKER": url})
    assert message in str(caught.value)


@pytest.mark.parametrize(
    "url",
    ["mqtts://olga:hunter2@broker", "mqtts://olga@broker", "mqtts://:hunter2@broker:x", "mqtt://olga:hunter2\u2100@b"],
)
def test_a_url_with_a_login_is_refused_without_showing_the_password(url: str) -> None:
    with pytest.raises(UsageError, match=r"TALK_MQTT_PASSWORD_FILE|is not a valid URL") as caught:
        from_environment({"TALK_BROKER": url})
    assert "hunter2" not in str(caught.value)


def test_a_password_is_sent_in_clear_text_only_to_this_machine(tmp_path: Path) -> None:
    (tmp_path / "password").write_text("correct horse\n", encoding="utf-8")
    login = {"TALK_MQTT_USER": "olga", "TALK_MQTT_PASSWORD_FILE": str(tmp_path / "password")}
    for local_url in ("mqtt://localhost", "mqtt://127.0.0.1", "mqtt://127.8.0.1", "mqtt://[::1]", "mqtts://broker"):
        broker = from_environment({"TALK_BROKER": local_url, **login})
        assert (broker.user, broker.password) == ("olga", "correct horse")
    for host in ("broker", "192.168.1.2", "[fe80::1]", "localhost.example"):
        with pytest.raises(UsageError, match=r"clear text.*mqtts:.*--insecure"):
            from_environment({"TALK_BROKER": f"mqtt://{host}", **login})
        assert from_environment({"TALK_BROKER": f"mqtt://{host}", **login}, insecure=True).password


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ({"TALK_MQTT_PASSWORD_FILE": "{file}"}, "TALK_MQTT_USER is not; set TALK_MQTT_USER"),
        ({"TALK_MQTT_USER": "olga", "TALK_MQTT_PASSWORD_FILE": "{nothing}"}, "No such file"),
        ({"TALK_MQTT_USER": "olga", "TALK_MQTT_PASSWORD_FILE": "{empty}"}, "is empty"),
        ({"TALK_MQTT_USER": "olga", "TALK_MQTT_PASSWORD_FILE": "{bytes}"}, "not UTF-8"),
        ({"TALK_MQTT_USER": "olga", "TALK_MQTT_PASSWORD_FILE": "{long}"}, "too long"),
        ({"TALK_MQTT_KEY": "{file}"}, "TALK_MQTT_CERT is not"),
        ({"TALK_MQTT_CA": "{nothing}"}, "TALK_MQTT_CA: .*No such file"),
        ({"TALK_MQTT_CA": "{file}"}, "TALK_MQTT_CA: .*is not a valid certificate or key"),
        ({"TALK_MQTT_CERT": "{file}", "TALK_MQTT_KEY": "{file}"}, "TALK_MQTT_CERT and TALK_MQTT_KEY: "),
    ],
)
def test_an_incomplete_or_unreadable_login_is_refused(variables: dict[str, str], message: str, tmp_path: Path) -> None:
    files = {"file": b"x", "empty": b"\n", "bytes": b"\xff", "long": b"x" * 70_000}
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    named = {name: str(tmp_path / name) for name in [*files, "nothing"]}
    given = {name: value.format(**named) for name, value in variables.items()}
    with pytest.raises(UsageError, match=message):
        from_environment({"TALK_BROKER": "mqtts://broker", **given}).ssl_context()


@pytest.mark.parametrize("name", ["TALK_MQTT_CA", "TALK_MQTT_CERT", "TALK_MQTT_KEY"])
def test_a_certificate_without_tls_is_refused(name: str) -> None:
    with pytest.raises(UsageError, match=f"{name} needs TLS"):
        from_environment({"TALK_BROKER": "mqtt://broker", name: "/file"})


def test_the_user_name_comes_from_the_login_or_else_from_the_machine() -> None:
    assert client_user(Broker("broker", 1, tls=True, user="olga")) == "olga"
    assert client_user(Broker("broker", 1, tls=True))
    with pytest.raises(UsageError, match="TALK_MQTT_USER"):
        client_user(Broker("broker", 1, tls=True, user="olga/+"))
