"""The examples of a fleet, in the README and in its own document: with a real broker, server and bridge.

The broker is elsewhere, and so are its logins: `talk` is told so beside what stands in an example, and mosquitto's own
clients by their files. What would change the machine has a stand-in.
"""

from __future__ import annotations

import contextlib
import json
import signal
import sys
from typing import TYPE_CHECKING, Any

import pytest

from talkcli.fleet import topics
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

#: The logins of the examples, and how each is proved.
PASSWORDS = {each: f"password-of-{each}" for each in ("anna", "olga", "ha")}
#: Where the examples of requests are answered.
_REPLIES = block("Requests and replies: A request").partition(" -e ")[2].split()[0]
#: Seconds in which a robot must be there, or have done what it was asked.
LIMIT = 20.0
#: What the examples' broker is here; what is no matter of theirs.
_TALK = """if [ "$1" = serve ]; then exec @PYTHON -m talkcli "$@"; fi
test "$TALK_BROKER" = mqtts://broker || exit 99
test -n "$TALK_MQTT_PASSWORD_FILE" || exit 98
export TALK_BROKER=@URL TALK_MQTT_CA=@CA TALK_MQTT_PASSWORD_FILE="@DIRECTORY/$TALK_MQTT_USER.password"
exec @PYTHON -m talkcli "$@"
"""
#: What would change the machine does so below a directory of the test, and asks for no password.
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


class Site:
    """A robot, anna, and a shell of somebody who has mosquitto's clients and nothing of talk's."""

    def __init__(self, talk: Talk, broker: Broker, bridge: Bridge, shell: Shell, listener: Listener) -> None:
        self.talk, self.broker, self.bridge = talk, broker, bridge
        self.shell, self._listener = shell, listener

    def run(self, name: str) -> str:
        """Run an example, which must go well, and return what it printed."""
        done = self.shell.run(block(name))
        assert (done.returncode, done.stderr) == (0, ""), done
        return done.stdout

    def goal(self, text: str, *states: str) -> dict[str, Any]:
        """Wait until the robot has told of a goal with this text in one of these states, and return it."""
        goal: dict[str, Any] = self._listener.await_message(lambda each: _tells(each, text, states), LIMIT).json["goal"]
        return goal

    def await_last_line(self, text: str) -> None:
        """Wait until the one who has asked for a goal with this text has been told how it ended: nothing more comes."""
        self._listener.await_message(lambda each: each.topic == _REPLIES and _has_result(each, text), LIMIT)


def _tells(message: Message, text: str, states: tuple[str, ...]) -> bool:
    if not message.topic.endswith("/event/state"):
        return False
    goal = message.json.get("goal") or {}
    return goal.get("text") == text and goal["state"] in states


def _has_result(message: Message, text: str) -> bool:
    lines = [json.loads(each) for each in message.text.splitlines()]
    return any(each.get("event") == "result" and each["goal"]["text"] == text for each in lines)


def _online(message: Message) -> bool:
    return bool(message.payload and message.json.get("online") and message.json["server"])


def _set_up_clients(shell: Shell, broker: Broker, user: str | None = None) -> None:
    """Tell mosquitto's clients which broker it is, and who they are, as the document says."""
    lines = [f"-h {'localhost' if broker.secure else '127.0.0.1'}", f"-p {broker.port}"]
    if user:
        lines += [f"-u {user}", f"-P {PASSWORDS[user]}"]
    if broker.secure:
        lines.append(f"--cafile {authority().file}")
    files = shell.directory / ".config"
    files.mkdir()
    for each in ("mosquitto_pub", "mosquitto_sub", "mosquitto_rr"):
        needs(each)
        (files / each).write_text("\n".join(lines) + "\n", encoding="utf-8")


@pytest.fixture
def site(make_talk: MakeTalk, tmp_path: Path, place: str) -> Iterator[Site]:
    needs_packages("paho")
    talk = make_talk(scripted=True)
    with contextlib.ExitStack() as stack:
        broker = stack.enter_context(Broker())
        bridge = stack.enter_context(Bridge(talk, broker, "anna", groups=["warehouse"]))
        bridge.await_online()
        listener = stack.enter_context(Listener(broker, "talk/robot/anna/event/+", _REPLIES))
        shell = stack.enter_context(contextlib.closing(Shell(tmp_path, clean_environment(place), talk=False)))
        _set_up_clients(shell, broker)
        yield Site(talk, broker, bridge, shell, listener)
        if bridge.running:
            assert bridge.terminate() == 0


@runs("A fleet: A robot", "A fleet: A desk", "A fleet: Home Assistant, cron")
def test_readmes_robot_and_its_desk(tmp_path: Path, place: str) -> None:
    """Two commands make a robot, with logins and the broker's rules; a desk and a plain text have it speak."""
    needs_packages("paho")
    operators = ("olga", "ha")
    with contextlib.ExitStack() as stack:
        broker = stack.enter_context(Broker(secure=True, users=PASSWORDS, acl=topics.access(operators) + "\n"))
        for user in PASSWORDS:
            broker.env(user)  # it writes the file of the password
        env = clean_environment(place) | {"TALK_SOCKET": f"{place}/s", "TALK_PLAYER": "null", "TALK_RATE": "450"}
        shell = stack.enter_context(contextlib.closing(Shell(tmp_path, env, talk=False)))
        told = {"@URL": broker.url, "@CA": authority().file, "@DIRECTORY": broker.directory, "@PYTHON": sys.executable}
        script = _TALK
        for name, value in told.items():
            script = script.replace(name, value)
        shell.program("talk", script)
        _set_up_clients(shell, broker, "ha")
        listener = stack.enter_context(Listener(broker, "talk/robot/anna/#", user="olga"))
        robot = shell.start(f'{block("A fleet: A robot")}bridge=$!\ntrap "kill $bridge" USR1\nwait\nwait\n')
        listener.await_message(_online, LIMIT)
        done = shell.run(block("A fleet: A desk"), TALK_SOCKET="/nowhere")
        assert (done.returncode, done.stderr) == (0, ""), done
        assert "exit code" not in done.stdout
        assert done.stdout.startswith("olga:")
        listener.await_message(lambda each: _tells(each, "the shift is over", ("SUCCEEDED",)), LIMIT)
        done = shell.run(block("A fleet: Home Assistant, cron"))
        assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
        found = listener.await_message(lambda each: _tells(each, "the washing is done", ("SUCCEEDED",)), LIMIT)
        assert found.json["goal"]["client"]["name"] == "mqtt:ha"
        robot.send_signal(signal.SIGUSR1)
        listener.await_message(lambda each: bool(each.payload) and b'"online": false' in each.payload, LIMIT)
        done = shell.run(block("A fleet: A desk"), TALK_SOCKET="/nowhere")
        assert done.stdout == "anna: exit code 3\n"
        assert "anna is offline: nothing was sent" in done.stderr


@runs("A fleet: Several", "A fleet: Several #2")
def test_several_robots(tmp_path: Path, place: str) -> None:
    """A glob, a group, everybody and one that is offline; and the same by the library."""
    needs_packages("paho")
    say, cancel, status, table, follow = commands("A fleet: Several")
    with contextlib.ExitStack() as stack:
        broker = stack.enter_context(Broker())
        robots = stack.enter_context(RealRobots(broker, ["bert", "wh-1", "wh-2"], ["warehouse"]))
        env = clean_environment(place) | {"TALK_BROKER": broker.url}
        shell = stack.enter_context(contextlib.closing(Shell(tmp_path, env)))
        watching = shell.start(follow)
        assert watching.stdout
        assert "  3 robots; mqtt://" in watching.stdout.readline()

        done = shell.run(say)
        assert (done.returncode, done.stderr) == (0, "talk: 2 of 2 as asked\n")
        found = sorted(line.split() for line in done.stdout.splitlines())
        assert [(robot, *rest) for robot, _, *rest in found] == [(f"wh-{n}", "SUCCEEDED", "0") for n in (1, 2)]
        assert '"the shift is over"' in watching.stdout.readline()

        done = shell.run(cancel)
        assert (done.returncode, done.stderr) == (0, "talk: 3 of 3 as asked\n")
        assert sorted(done.stdout.splitlines()) == [f"{each} - IDLE 0" for each in robots.names]

        code = block("A fleet: Several #2").replace("mqtts://broker", broker.url)
        python = shell.directory / "several.py"
        python.write_text(code, encoding="utf-8")
        done = shell.run(f"{sys.executable} several.py", PYTHONPATH=str(ROOT))
        assert (done.returncode, done.stderr) == (0, "")
        assert sorted(done.stdout.splitlines()) == [f"{each} SUCCEEDED 0" for each in robots.names]
        assert robots.spoken() == {each: ["the shift is over"] * (2 if "wh" in each else 1) for each in robots.names}

        assert robots["bert"].bridge.terminate() == 0
        done = shell.run(status)
        assert (done.returncode, done.stdout) == (0, "bert bert is offline: nothing was sent\n")
        assert done.stderr.splitlines()[-1] == "talk: 2 of 3 as asked"
        assert [line.split()[:2] for line in shell.run(table).stdout.splitlines()[1:]] == [
            ["bert", "OFFLINE"], ["wh-1", "yes"], ["wh-2", "yes"],
        ]  # fmt: skip


@runs("A site")
def test_broker_is_set_up(make_talk: MakeTalk, tmp_path: Path, place: str) -> None:
    """What its lines make is a broker that lets in those logins, by TLS alone, for what each may do."""
    needs_packages("paho")
    needs("mosquitto_passwd")
    etc = tmp_path / "etc"
    (etc / "conf.d").mkdir(parents=True)
    with contextlib.closing(Shell(tmp_path, clean_environment(place))) as shell:
        shell.stand_in("sudo", _SUDO.replace("ETC", str(etc)).replace("PROGRAM", str(find_program("mosquitto_passwd"))))
        done = shell.run(block("A site"))
        assert done.returncode == 0, done
        called = [each[0] for each in shell.calls("sudo")]
    assert called == ["apt-get", "mosquitto_passwd", "mosquitto_passwd", "tee", "tee", "systemctl"]
    settings = dict(each.split(" ", 1) for each in (etc / "conf.d/talk.conf").read_text("utf-8").splitlines())
    assert settings.pop("listener") == "8883"
    # Where the certificate is, and the port, only the test knows.
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
        with Desk(broker, user="olga", password="another") as desk:
            assert desk.run("--robot", "anna", "status").code == 10


@runs("Topics")
def test_plain_text_is_said_and_cancelled(site: Site) -> None:
    site.talk.request("pause")  # else it may have been spoken before
    assert site.run("Topics") == ""
    goal = site.goal("the washing is done", "RECALLED")
    assert (goal["client"]["name"], goal["by"]["client"]["name"]) == ("mqtt:ha", "mqtt:ha")


@runs(
    "Requests and replies: A request",
    "Requests and replies: A request #2",
    "Requests and replies: A request #3",
    "Requests and replies: A session",
)
def test_request_is_answered_once_and_hung_up(site: Site) -> None:
    example = json.loads(block("Requests and replies: A request #2"))
    answer = json.loads(site.run("Requests and replies: A request").splitlines()[0])
    assert _part(answer, example) == example
    site.goal("the door is open", "SUCCEEDED")
    site.await_last_line("the door is open")  # else it may be what the next one takes for its answer
    again = json.loads(site.run("Requests and replies: A request").splitlines()[0])
    assert again["attached"] is True
    assert site.run("Requests and replies: A request #3") == ""
    goal = site.goal("the shift is over", "SUCCEEDED")
    assert (goal["id"], 9 < goal["ttl"] <= 10) == ("shift-3", True)
    with site.talk.connect() as wire:
        wire.request("log", count=20)
        assert [each["goal"]["text"] for each in wire.items].count("the door is open") == 1
        before = wire.request("status")["server"]["clients"]
        assert site.run("Requests and replies: A session") == ""
        wait_until(lambda: wire.request("status")["server"]["clients"] == before - 1)


def _part(whole: Any, like: Any) -> Any:
    """Return what of an object an example shows of it."""
    if not isinstance(like, dict):
        return whole
    return {name: _part(whole[name], value) for name, value in like.items()}


def _shape(value: Any) -> Any:
    """Return an object's keys, and those of what it holds."""
    return {name: _shape(each) for name, each in value.items()} if isinstance(value, dict) else None


@runs(*(f"What a robot tells everybody: Presence{each}" for each in ("", " #2", " #3")))
def test_presence_has_the_keys_of_the_examples(site: Site) -> None:
    there, gone = (json.loads(block(f"What a robot tells everybody: Presence #{each}")) for each in (2, 3))
    found = json.loads(site.run("What a robot tells everybody: Presence"))
    assert _shape(found) == _shape(there)
    assert {**found, "server": None, "session": "", "since": 0, "version": ""} == {
        **there, "server": None, "session": "", "since": 0, "version": "",
    }  # fmt: skip
    site.bridge.terminate()
    assert json.loads(site.run("What a robot tells everybody: Presence")) == {**gone, "session": found["session"]}


@runs("What a robot tells everybody: Status", "What a robot tells everybody: Status #2")
def test_status_has_the_keys_of_the_example(site: Site) -> None:
    site.run("Requests and replies: A request")
    goal = site.goal("the door is open", "SUCCEEDED")
    example = json.loads(block("What a robot tells everybody: Status #2"))
    found: dict[str, Any] = {}

    def told() -> bool:
        found.update(json.loads(site.run("What a robot tells everybody: Status")))
        return found["active"] is None and found["last"] is not None

    wait_until(told)  # at most once a second
    example["last"]["at"] = goal["ended_at"]
    assert found == example


@runs("What a robot tells everybody: Events")
def test_events_are_followed(site: Site) -> None:
    before = site.broker.log.count("SUBACK")
    following = site.shell.start(block("What a robot tells everybody: Events"))
    wait_until(lambda: site.broker.log.count("SUBACK") > before)
    site.run("Requests and replies: A request")
    assert following.stdout
    states: list[str] = []
    while states[-1:] != ["SUCCEEDED"]:
        topic, _, event = following.stdout.readline().partition(" ")
        if topic.strip():
            assert topic == "talk/robot/anna/event/state"
            states.append(json.loads(event)["state"])
    assert states == ["PENDING", "ACTIVE", "SUCCEEDED"]
