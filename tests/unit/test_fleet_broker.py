"""Which broker, and who logs in there: what the environment may say, and what is refused so that no secret gets out."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from talkcli.errors import UsageError
from talkcli.fleet.broker import Broker, from_environment, user

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def password(tmp_path: Path) -> str:
    file = tmp_path / "password"
    file.write_text("correct horse\n", encoding="utf-8")
    return str(file)


@pytest.mark.parametrize(
    ("url", "broker", "shown"),
    [
        ("mqtt://broker", Broker("broker", 1883, tls=False), "mqtt://broker:1883"),
        ("mqtts://broker", Broker("broker", 8883, tls=True), "mqtts://broker:8883"),
        ("mqtts://broker.example:8884/", Broker("broker.example", 8884, tls=True), "mqtts://broker.example:8884"),
        ("mqtt://[::1]:18", Broker("::1", 18, tls=False), "mqtt://[::1]:18"),
    ],
)
def test_a_url_names_a_broker(url: str, broker: Broker, shown: str) -> None:
    found = from_environment({"TALK_BROKER": url})
    assert (found, found.url) == (broker, shown)


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("", "export TALK_BROKER=mqtts://broker.example"),
        ("broker", "mqtts://HOST or mqtt://HOST"),
        ("http://broker", "mqtts://HOST or mqtt://HOST"),
        ("mqtt://", "names no host"),
        ("mqtt://[::1", "is no URL"),
        ("mqtt://broker:0", "names no host and port"),
        ("mqtt://broker:99999", "a port that is none"),
        ("mqtt://broker/robots", "more than a host and a port: write mqtt://broker"),
        ("mqtt://broker?x=1", "more than a host and a port"),
    ],
)
def test_what_is_no_broker_is_told_with_what_to_write(url: str, words: str) -> None:
    with pytest.raises(UsageError, match="TALK_BROKER") as caught:
        from_environment({"TALK_BROKER": url})
    assert words in str(caught.value)


@pytest.mark.parametrize(
    "url",
    ["mqtts://olga:hunter2@broker", "mqtts://olga@broker", "mqtts://:hunter2@broker:x", "mqtt://olga:hunter2\u2100@b"],
)
def test_a_url_that_holds_a_secret_is_refused_without_showing_it(url: str) -> None:
    with pytest.raises(UsageError, match=r"TALK_MQTT_PASSWORD_FILE|is no URL") as caught:
        from_environment({"TALK_BROKER": url})
    assert "hunter2" not in str(caught.value)


def test_the_password_is_the_file_s_without_its_line_s_end(password: str) -> None:
    found = from_environment(
        {"TALK_BROKER": "mqtts://broker", "TALK_MQTT_USER": "olga", "TALK_MQTT_PASSWORD_FILE": password}
    )
    assert (found.user, found.password) == ("olga", "correct horse")


def test_a_password_goes_in_clear_text_to_this_machine_alone(password: str) -> None:
    login = {"TALK_MQTT_USER": "olga", "TALK_MQTT_PASSWORD_FILE": password}
    for here in ("localhost", "127.0.0.1", "127.8.0.1", "[::1]"):
        assert from_environment({"TALK_BROKER": f"mqtt://{here}", **login}).password
    for elsewhere in ("broker", "192.168.1.2", "[fe80::1]", "localhost.example"):
        with pytest.raises(UsageError, match=r"clear text.*mqtts:.*--insecure"):
            from_environment({"TALK_BROKER": f"mqtt://{elsewhere}", **login})
        assert from_environment({"TALK_BROKER": f"mqtt://{elsewhere}", **login}, insecure=True).password


@pytest.mark.parametrize(
    ("variables", "words"),
    [
        ({"TALK_MQTT_PASSWORD_FILE": "{file}"}, "TALK_MQTT_USER is not: whose password"),
        ({"TALK_MQTT_USER": "olga", "TALK_MQTT_PASSWORD_FILE": "{nothing}"}, "No such file"),
        ({"TALK_MQTT_USER": "olga", "TALK_MQTT_PASSWORD_FILE": "{empty}"}, "is empty"),
        ({"TALK_MQTT_USER": "olga", "TALK_MQTT_PASSWORD_FILE": "{bytes}"}, "not UTF-8"),
        ({"TALK_MQTT_USER": "olga", "TALK_MQTT_PASSWORD_FILE": "{long}"}, "too long"),
        ({"TALK_MQTT_KEY": "{file}"}, "TALK_MQTT_CERT is not"),
    ],
)
def test_what_is_missing_or_wrong_is_named(variables: dict[str, str], words: str, tmp_path: Path) -> None:
    files = {"file": b"x", "empty": b"\n", "bytes": b"\xff", "long": b"x" * 70_000}
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    named = {each: str(tmp_path / each) for each in [*files, "nothing"]}
    given = {name: value.format(**named) for name, value in variables.items()}
    with pytest.raises(UsageError) as caught:
        from_environment({"TALK_BROKER": "mqtts://broker", **given})
    assert words in str(caught.value)


@pytest.mark.parametrize("name", ["TALK_MQTT_CA", "TALK_MQTT_CERT", "TALK_MQTT_KEY"])
def test_a_certificate_without_tls_is_a_mistake(name: str) -> None:
    with pytest.raises(UsageError, match=f"{name} means nothing without TLS"):
        from_environment({"TALK_BROKER": "mqtt://broker", name: "/file"})


@pytest.mark.parametrize(
    ("variables", "words"),
    [
        ({"TALK_MQTT_CA": "{nothing}"}, "TALK_MQTT_CA: .*No such file"),
        ({"TALK_MQTT_CA": "{text}"}, "TALK_MQTT_CA: .*is not what it should be"),
        ({"TALK_MQTT_CERT": "{text}", "TALK_MQTT_KEY": "{text}"}, "TALK_MQTT_CERT and TALK_MQTT_KEY: "),
    ],
)
def test_a_file_that_is_no_certificate_is_named(variables: dict[str, str], words: str, tmp_path: Path) -> None:
    (tmp_path / "text").write_text("no certificate", encoding="utf-8")
    given = {
        name: value.format(nothing=tmp_path / "nothing", text=tmp_path / "text") for name, value in variables.items()
    }
    broker = from_environment({"TALK_BROKER": "mqtts://broker", **given})
    with pytest.raises(UsageError, match=words):
        broker.context()


def test_who_asks_is_the_broker_s_user_or_else_the_machine_s() -> None:
    assert user(Broker("broker", 1, tls=True, user="olga")) == "olga"
    assert user(Broker("broker", 1, tls=True))
    with pytest.raises(UsageError, match="TALK_MQTT_USER"):
        user(Broker("broker", 1, tls=True, user="olga/+"))
