"""The examples for fleets in the README and in the fleet's document, with a real broker, server and bridge.

Settings redirect the examples to the test's broker and logins. Stand-ins protect the machine from changes.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import re
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import pytest

from talkcli.fleet import topics
from talkcli.goals.options import Say
from talkcli.protocol.requests import read_request
from tests.fleet.many import RealRobots
from tests.readme.blocks import block, commands, runs
from tests.readme.shell import Shell, wait_until
from tests.support.bridge import Bridge, Desk
from tests.support.broker import Broker
from tests.support.certificates import authority
from tests.support.documents import ROOT
from tests.support.mqtt import Listener
from tests.support.surroundings import clean_environment, find_program, needs, needs_packages, short_directory

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from tests.conftest import MakeTalk
    from tests.support.mqtt import Message
    from tests.support.processes import Talk

#: The users of the examples and their passwords.
PASSWORDS = {user: f"password-of-{user}" for user in ("anna", "olga", "ha")}
#: The response topic in the examples of requests.
_REPLIES = block("Requests and replies: A request").partition(" -e ")[2].split()[0]
#: Time for a robot to come online or to carry out a request.
LIMIT = 20.0
#: Runs `talk` with the test's broker instead of the example's.
_TALK = f"""if [ "$1" != serve ]; then
    test "$TALK_BROKER" = mqtts://broker -a -n "$TALK_MQTT_PASSWORD_FILE" || exit 99
    export TALK_BROKER=$URL TALK_MQTT_CA=$CA TALK_MQTT_PASSWORD_FILE="$DIRECTORY/$TALK_MQTT_USER.password"
fi
exec {sys.executable} -m talkcli "$@"
"""
#: Writes into a directory of the test, and doesn't prompt for passwords.
_SUDO = """program=$1
shift
case $program in
    tee) exec tee "ETC/${1#/etc/mosquitto/}" ;;
    mosquitto_passwd)
        if [ "$1" = -c ]; then create=-c; shift; else create=; fi
        exec PROGRAM $create -b "ETC/${1#/etc/mosquitto/}" "$2" "password-of-$2" ;;
esac
"""


@pytest.fixture
def place() -> Iterator[str]:
    with short_directory() as directory:
        yield directory


@dataclass
class Site:
    """The robot anna, and the shell of a client with mosquitto's programs but without `talk`."""

    talk: Talk
    broker: Broker
    bridge: Bridge
    shell: Shell
    replies: Listener

    def run(self, name: str) -> str:
        """Run an example that must succeed, and return its output."""
        done = self.shell.run(block(name))
        assert (done.returncode, done.stderr) == (0, ""), done
        return done.stdout

    def goal(self, text: str, state: str) -> dict[str, Any]:
        """Wait until the goal with this text is in a state, and return the goal."""
        event = self.talk.watcher.wait_until(lambda event: _is_event(event, text, state), LIMIT)
        goal: dict[str, Any] = event["goal"]
        return goal


def _is_event(event: dict[str, Any], text: str, state: str) -> bool:
    return (event.get("goal") or {}).get("text") == text and event.get("state", event["event"]) == state


def _is_spoken(message: Message, text: str) -> bool:
    return message.topic.endswith("/event/state") and _is_event(message.json, text, "SUCCEEDED")


def _online(message: Message) -> bool:
    return bool(message.payload and message.json.get("online") and message.json["server"])


def _set_up_clients(shell: Shell, broker: Broker, user: str | None = None) -> None:
    """Write the configuration of mosquitto's clients with the broker and the login."""
    lines = [f"-h {'localhost' if broker.secure else '127.0.0.1'}", f"-p {broker.port}"]
    if user:
        lines += [f"-u {user}", f"-P {PASSWORDS[user]}"]
    if broker.secure:
        lines.append(f"--cafile {authority().file}")
    files = shell.directory / ".config"
    files.mkdir()
    for program in ("mosquitto_pub", "mosquitto_sub", "mosquitto_rr"):
        needs(program)
        (files / program).write_text("\n".join(lines) + "\n", encoding="utf-8")


@pytest.fixture
def site(make_talk: MakeTalk, tmp_path: Path, place: str) -> Iterator[Site]:
    needs_packages("paho")
    talk = make_talk(scripted=True)
    with contextlib.ExitStack() as stack:
        broker = stack.enter_context(Broker())
        bridge = stack.enter_context(Bridge(talk, broker, "anna", groups=["warehouse"]))
        bridge.await_online()
        replies = stack.enter_context(Listener(broker, _REPLIES))
        shell = stack.enter_context(contextlib.closing(Shell(tmp_path, clean_environment(place), talk=False)))
        _set_up_clients(shell, broker)
        yield Site(talk, broker, bridge, shell, replies)
        if bridge.running:
            assert bridge.terminate() == 0


@runs("Speak on many robots: On each robot", "Speak on many robots: On your machine")
def test_a_robot_and_a_desk_are_set_up(tmp_path: Path, place: str) -> None:
    """The broker has logins and access rules. The robot speaks a goal from a desk, and a plain text."""
    needs_packages("paho")
    operators = ("olga", "ha")
    with contextlib.ExitStack() as stack:
        broker = stack.enter_context(Broker(secure=True, users=PASSWORDS, acl=topics.access_rules(operators) + "\n"))
        for user in PASSWORDS:
            broker.env(user)  # this writes the password file
        env = clean_environment(place) | {"TALK_SOCKET": f"{place}/s", "TALK_PLAYER": "null", "TALK_RATE": "450"}
        shell = stack.enter_context(contextlib.closing(Shell(tmp_path, env, talk=False)))
        shell.env |= {"URL": broker.url, "CA": str(authority().file), "DIRECTORY": str(broker.directory)}
        shell.program("talk", _TALK)
        _set_up_clients(shell, broker, "ha")
        listener = stack.enter_context(Listener(broker, "talk/robot/anna/#", user="olga"))
        shell.start(f"{block('Speak on many robots: On each robot')}wait\nwait\n")
        listener.await_message(_online, LIMIT)
        done = shell.run(block("Speak on many robots: On your machine"), TALK_SOCKET="/nowhere")
        assert (done.returncode, done.stderr) == (0, ""), done
        assert "exit code" not in done.stdout
        listener.await_message(lambda message: _is_spoken(message, "the shift is over"), LIMIT)
        done = shell.run(commands("Topics")[0])
        assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
        message = listener.await_message(lambda message: _is_spoken(message, "the washing is done"), LIMIT)
        assert message.json["goal"]["client"]["name"] == "mqtt:ha"


@runs("Speak on many robots: Several robots", "Several robots: In Python")
def test_several_robots_are_commanded(tmp_path: Path, place: str) -> None:
    needs_packages("paho")
    say, cancel, status, table, follow = commands("Speak on many robots: Several robots")
    with contextlib.ExitStack() as stack:
        broker = stack.enter_context(Broker())
        robots = stack.enter_context(RealRobots(broker, ["bert", "wh-1", "wh-2"], ["warehouse"]))
        env = clean_environment(place) | {"TALK_BROKER": broker.url}
        shell = stack.enter_context(contextlib.closing(Shell(tmp_path, env)))
        watching = shell.start(follow)
        assert watching.stdout
        assert "  3 robots; mqtt://" in watching.stdout.readline()

        done = shell.run(say)
        assert (done.returncode, done.stderr) == (0, "talk: 2 of 2 robots succeeded\n")
        assert '"the shift is over"' in watching.stdout.readline()
        done = shell.run(cancel)
        assert (done.returncode, done.stderr) == (0, "talk: 3 of 3 robots succeeded\n")
        code = block("Several robots: In Python").replace("mqtts://broker", broker.url)
        python = shell.directory / "several.py"
        python.write_text(code, encoding="utf-8")
        done = shell.run(f"{sys.executable} several.py", PYTHONPATH=str(ROOT))
        assert (done.returncode, done.stderr) == (0, "")
        assert sorted(done.stdout.splitlines()) == [f"{name} SUCCEEDED 0" for name in robots.names]
        assert robots.spoken() == {name: ["the shift is over"] * (2 if "wh" in name else 1) for name in robots.names}

        assert robots["bert"].bridge.terminate() == 0
        done = shell.run(status)
        assert (done.returncode, done.stdout) == (0, "bert bert is offline, so nothing was sent\n")
        listed = [line.split()[:2] for line in shell.run(table).stdout.splitlines()[1:]]
        assert listed == [["bert", "OFFLINE"], ["wh-1", "yes"], ["wh-2", "yes"]]


@runs("Set up a site")
def test_a_broker_with_logins_is_set_up(make_talk: MakeTalk, tmp_path: Path, place: str) -> None:
    """The broker accepts only these logins, only with TLS, and each with its own rights."""
    needs_packages("paho")
    needs("mosquitto_passwd")
    etc = tmp_path / "etc"
    (etc / "conf.d").mkdir(parents=True)
    with contextlib.closing(Shell(tmp_path, clean_environment(place))) as shell:
        shell.stand_in("sudo", _SUDO.replace("ETC", str(etc)).replace("PROGRAM", str(find_program("mosquitto_passwd"))))
        done = shell.run(block("Set up a site"))
        assert done.returncode == 0, done
        called = [call[0] for call in shell.calls("sudo")]
    assert called == ["apt-get", "mosquitto_passwd", "mosquitto_passwd", "tee", "tee", "systemctl"]
    settings = dict(line.split(" ", 1) for line in (etc / "conf.d/talk.conf").read_text("utf-8").splitlines())
    assert settings.pop("listener") == "8883"
    # The test uses its own certificate and port.
    assert settings.keys() - {"password_file", "acl_file"} == {"certfile", "keyfile"}
    kept = [f"{name} {settings[name].replace('/etc/mosquitto', str(etc))}" for name in ("password_file", "acl_file")]
    with contextlib.ExitStack() as stack:
        broker = stack.enter_context(Broker(secure=True, anonymous=False, settings=kept))
        stack.enter_context(Bridge(make_talk(scripted=True), broker, "anna", user="anna", password=PASSWORDS["anna"]))
        with Listener(broker, "talk/robot/anna/presence", user="olga", password=PASSWORDS["olga"]) as listener:
            listener.await_message(_online, LIMIT)
        for user, code in (("olga", 0), ("anna", 10)):
            with Desk(broker, user=user, password=PASSWORDS[user]) as desk:
                done_there = desk.run("--robot", "anna", "status")
            assert done_there.code == code, done_there


@runs(
    "Topics",
    "Requests and replies: A request",
    "Requests and replies: A request #2",
    "Requests and replies: A request #3",
    "Requests and replies: A session",
)
def test_plain_texts_requests_and_sessions_work(site: Site) -> None:
    site.talk.request("pause")  # otherwise the text may already have been spoken
    assert site.run("Topics") == ""
    goal = site.goal("the washing is done", "RECALLED")
    assert (goal["client"]["name"], goal["by"]["client"]["name"]) == ("mqtt:ha", "mqtt:ha")
    site.talk.request("resume")
    example = json.loads(block("Requests and replies: A request #2"))
    answer = json.loads(site.run("Requests and replies: A request").splitlines()[0])
    assert _part(answer, example) == example
    site.goal("the door is open", "SUCCEEDED")
    ended = re.compile(rb'"event": ?"result"')  # after the result, the next request gets only its own reply
    site.replies.await_message(lambda message: bool(ended.search(message.payload)), LIMIT)
    again = json.loads(site.run("Requests and replies: A request").splitlines()[0])
    assert again["attached"] is True
    assert site.run("Requests and replies: A request #3") == ""
    goal = site.goal("the shift is over", "SUCCEEDED")
    assert (goal["id"], 9 < goal["ttl"] <= 10) == ("shift-3", True)
    with site.talk.connect() as wire:
        before = wire.request("status")["server"]["clients"]
        assert site.run("Requests and replies: A session") == ""
        wait_until(lambda: wire.request("status")["server"]["clients"] == before - 1)


@runs("Home Assistant: Scripts", "Home Assistant: Scripts #2")
def test_the_script_for_home_assistant_sends_a_valid_request() -> None:
    """`python -m tests.tools.homeassistant` runs the scripts themselves."""
    payload = re.search(r"\{\{ (dict\(request=.*\)) \| to_json \}\}", block("Home Assistant: Scripts"), re.DOTALL)
    assert payload
    request = read_request(eval(payload[1].replace(" | string", ""), {"text": "hello", "goal": "ha-1"}))
    assert request == Say("hello", id="ha-1", key="ha-1", ttl=30)


def _part(whole: Any, like: Any) -> Any:
    """Return only those fields of an object that the example shows."""
    return {name: _part(whole[name], value) for name, value in like.items()} if isinstance(like, dict) else whole


@runs(
    *(f"What a robot publishes: Presence{number}" for number in ("", " #2", " #3")),
    "What a robot publishes: Status",
    "What a robot publishes: Status #2",
    "What a robot publishes: Events",
)
def test_a_robot_publishes_events_status_and_presence(site: Site) -> None:
    before = site.broker.log.count("SUBACK")
    following = site.shell.start(block("What a robot publishes: Events"))
    wait_until(lambda: site.broker.log.count("SUBACK") > before)
    site.run("Requests and replies: A request")
    goal = site.goal("the door is open", "SUCCEEDED")
    assert following.stdout
    events = [line for line in itertools.islice(following.stdout, 6) if line.strip()][:3]
    assert [line.partition(" ")[0] for line in events] == ["talk/robot/anna/event/state"] * 3
    states = [json.loads(line.partition(" ")[2])["state"] for line in events]
    assert states == ["PENDING", "ACTIVE", "SUCCEEDED"]

    example = json.loads(block("What a robot publishes: Status #2"))
    example["last"]["at"] = goal["ended_at"]
    wait_until(lambda: bool(json.loads(site.run("What a robot publishes: Status")) == example))  # once a second

    online, gone = (json.loads(block(f"What a robot publishes: Presence #{number}")) for number in (2, 3))
    presence = json.loads(site.run("What a robot publishes: Presence"))
    vary = dict.fromkeys(("server", "session", "since", "version"))
    assert (presence.keys(), presence["server"].keys()) == (online.keys(), online["server"].keys())
    assert {**presence, **vary} == {**online, **vary}
    site.bridge.terminate()
    assert json.loads(site.run("What a robot publishes: Presence")) == {**gone, "session": presence["session"]}
