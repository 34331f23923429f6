"""The command `talk bridge`: usage errors, printed units and access rules, and systemd notifications."""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
from typing import TYPE_CHECKING

import pytest

from talkcli import install
from talkcli.fleet import topics
from tests.conformance.bareserve import TALK, environment, run, serving
from tests.faults.supervisor import Supervisor
from tests.fleet.remote_client import RemoteClient
from tests.support.import_recorder import record_imports
from tests.support.processes import run_talk
from tests.support.surroundings import needs

if TYPE_CHECKING:
    from pathlib import Path

    from tests.fleet.conftest import MakeBridge
    from tests.support.broker import Broker
    from tests.support.processes import Talk


def run_bridge(home: str, *arguments: str, **extra: str) -> tuple[int, str, str]:
    return run_talk(["bridge", *arguments], environment(home, **extra), 20)


@pytest.mark.parametrize(
    ("arguments", "env", "error"),
    [
        ("", {}, "--name is missing"),
        ("--name a/b", {}, "--name: 'a/b' is not a valid name; it must have 1 to 59 characters"),
        ("--name anna --group day,#", {}, "--group: '#' is not a valid name"),
        ("--name anna --group day,", {}, "--group: '' is not a valid name"),
        ("--name anna --allow say,cancle", {}, "--allow: unknown request 'cancle'; did you mean 'cancel'?"),
        ("--name anna --allow xyz", {}, "--allow: unknown request 'xyz'; choose from say, wait, cancel"),
        ("--name anna --print-unit launchd", {}, "--print-unit: 'launchd' is not one of"),
        (
            "--name anna --print-addon-acl --print-acl --homeassistant",
            {},
            "--print-acl and --print-addon-acl can't be combined; use only one of them",
        ),
        ("--name anna", {}, "TALK_BROKER is not set; name your broker"),
        ("anna", {}, "'talk bridge' takes no arguments (got 'anna')"),
        ("--name anna", {"TALK_BROKER": "http://broker"}, "TALK_BROKER is not the URL of a broker"),
        ("--name anna", {"TALK_BROKER": "mqtts://x:hunter2@broker"}, "must not contain a user or a password"),
        ("--name anna", {"TALK_BROKER": "mqtts://b", "TALK_MQTT_CA": "/no"}, "TALK_MQTT_CA: /no: No such file"),
    ],
)
def test_usage_errors_name_the_next_step(home: str, arguments: str, env: dict[str, str], error: str) -> None:
    code, out, err = run_bridge(home, *arguments.split(), **env)
    assert (code, out, error in err, "Traceback" in err, "hunter2" in err) == (2, "", True, False, False), err


def test_only_printing_works_without_paho(home: str, tmp_path: Path) -> None:
    env = record_imports(tmp_path, environment(home, TALK_BROKER="mqtt://127.0.0.1:1"), ["paho"])
    done = run([*TALK, "bridge", "--name", "anna"], env)
    assert (done.code, done.out) == (2, "")
    assert done.err == f"talk: a fleet needs paho-mqtt; install it with: {install.command('paho-mqtt')}\n"
    done = run([*TALK, "bridge", "--name", "anna", "--print-unit", "user"], env)
    assert (done.code, done.err, "[Unit]" in done.out) == (0, "", True), done


def test_the_access_rules_are_printed(home: str) -> None:
    assert run_bridge(home, "--print-acl") == (0, topics.access_rules() + "\n", "")
    rules = topics.access_rules(homeassistant=True, name="r2.d2") + "\n"
    assert run_bridge(home, "--name", "r2.d2", "--homeassistant", "--print-acl") == (0, rules, "")
    assert run_bridge(home, "--print-addon-acl") == (0, topics.access_rules(addon=True) + "\n", "")


def printed_unit(home: str, name: str, *options: str) -> str:
    code, out, _ = run_bridge(home, "--name", "anna", *options, "--print-unit", name)
    assert code == 0
    return out


def values(unit: str, name: str) -> list[str]:
    return re.findall(rf"^{name}=(.*)$", unit, re.MULTILINE)


def command_of(unit: str) -> list[str]:
    (line,) = values(unit, "ExecStart")
    return [part.replace("%%", "%").replace("$$", "$") for part in shlex.split(line)]


@pytest.mark.parametrize(
    ("name", "folder", "environment_file"),
    [
        ("user", "~/.config/systemd/user", "%h/.config/talk/bridge.env"),
        ("system", "/etc/systemd/system", "/etc/talk/bridge.env"),
    ],
)
def test_a_unit_names_its_path_and_options(home: str, name: str, folder: str, environment_file: str) -> None:
    unit = printed_unit(home, name)
    head = unit.partition("\n[Unit]\n")[0].splitlines()
    assert head[0].startswith(f"# {folder}/talk-bridge.service: ")
    assert any(f"talk bridge --name NAME --print-unit {name} " in line for line in head)
    assert any(environment_file.replace("%h", "~") in line for line in head)
    assert any("daemon-reload" in line and "enable --now talk-bridge" in line for line in head)
    assert all(line.startswith("#") and len(line) <= 120 for line in head)
    settings = {
        "EnvironmentFile": environment_file, "Type": "notify", "WatchdogSec": "30", "Restart": "on-failure",
        "RestartPreventExitStatus": "2",  # not 11: the other bridge with this name may end
        "RestartSec": "10", "StartLimitIntervalSec": "0", "RestrictAddressFamilies": "AF_UNIX AF_INET AF_INET6",
    }  # fmt: skip
    if name == "system":
        settings |= {"User": "talk-bridge", "Group": "audio", "PrivateDevices": "yes"}
        assert "/run/talk/talk.sock" in unit
    assert {key: values(unit, key) for key in settings} == {key: [value] for key, value in settings.items()}
    assert not values(unit, "PrivateNetwork") + values(unit, "IPAddressDeny") + values(unit, "DeviceAllow")
    assert "\n[Install]\nWantedBy=" in unit
    flags = ["--no-text", "--homeassistant"]
    command = command_of(printed_unit(home, name, "--group", "a,b", *flags, "--insecure", "--socket", "/run/other"))
    assert os.path.isabs(command[0])
    assert command[-7:] == ["bridge", "--insecure", "--socket=/run/other", "--name=anna", "--group=a,b", *flags]
    assert command_of(unit)[-2:] == ["bridge", "--name=anna"]


@pytest.mark.parametrize("name", ["user", "system"])
def test_systemd_accepts_the_unit(home: str, name: str) -> None:
    needs("systemd-analyze")
    with open(f"{home}/talk-bridge.service", "w", encoding="utf-8") as file:
        file.write(printed_unit(home, name))
    scope = ["--user"] if name == "user" else []
    done = run(
        ["systemd-analyze", *scope, "verify", "--man=no", f"{home}/talk-bridge.service"],
        environment(home, XDG_RUNTIME_DIR=home),
    )
    assert (done.code, done.err) == (0, ""), done


def test_a_supervisor_gets_the_state_with_and_without_a_broker(home: str, scripted: Talk, broker: Broker) -> None:
    broker.kill()
    with Supervisor(f"{home}/n") as supervisor:
        own = {"NOTIFY_SOCKET": supervisor.address, "WATCHDOG_USEC": "1000000"}
        command = command_of(printed_unit(home, "system"))
        with subprocess.Popen(
            command, env=scripted.env | broker.env() | own, stderr=subprocess.PIPE, stdin=subprocess.DEVNULL, text=True
        ) as process:
            try:
                ready = supervisor.wait_for("READY", "1")
                supervisor.wait_for("STATUS", "OFFLINE, server running, 0 goals waiting")
                broker.start()
                supervisor.wait_for("STATUS", f"anna at {broker.url}: online, server running", since=ready)
                scripted.request("pause")
                with RemoteClient(broker) as client:
                    client.say("a secret")
                    pending = supervisor.wait_for("STATUS", "1 goal waiting")
                    client.ask("cancel")
                supervisor.wait_for("STATUS", "0 goals waiting", since=pending)
                supervisor.wait_for("WATCHDOG", "1", since=pending)
                assert not any("secret" in value for _, value, _ in supervisor.messages)
                process.send_signal(signal.SIGINT)
                supervisor.wait_for("STOPPING", "1")
                assert process.wait(5) == 0
            finally:
                process.kill()
            assert process.stderr
            assert "Traceback" not in process.stderr.read()


def test_the_bridge_uses_the_given_socket(home: str, scripted: Talk, broker: Broker, make_bridge: MakeBridge) -> None:
    with serving(environment(home, TALK_SOCKET=f"{home}/s")):
        make_bridge(scripted, broker, "berta", "--socket", f"{home}/s")
        with RemoteClient(broker) as client:
            client.send({"seq": 1, "request": "status"}, to="talk/robot/berta")
            assert client.reply(1)["server"]["socket"] == f"{home}/s"
