"""`talk fleet status` and `talk fleet watch`, in a pipe and on a terminal."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest

from tests.conformance.bareserve import TALK
from tests.fleet import publish
from tests.fleet.robot import LONG
from tests.fleet.watch_process import WatchProcess
from tests.support.bridge import Desk
from tests.support.connection import PATIENCE
from tests.support.mqtt import Listener
from tests.support.ports import Port
from tests.support.screen import Terminal

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.fleet.robot import Robot
    from tests.support.broker import Broker
    from tests.support.processes import Finished


@pytest.fixture
def robots(broker: Broker) -> Iterator[Listener]:
    """A publisher that has published three robots. One is offline, and one has no server."""
    with Listener(broker) as publisher:
        publish.presence(publisher, "wh-2", online=False, groups=["warehouse"])
        publish.presence(publisher, "wh-1", groups=["warehouse"])
        publish.status(publisher, "wh-1", active="a-2", text="please step back", pending=2, last="a-1")
        publish.presence(publisher, "anna", server=None)
        yield publisher


def run(broker: Broker, *arguments: str, user: str | None = None, **env: str) -> Finished:
    with Desk(broker, user=user, env=env) as desk:
        return desk.run(*arguments)


def listed(done: Finished) -> list[str]:
    """Return the names of the robots in a table."""
    assert done.code == 0, done
    head, *lines = done.out.splitlines()
    assert head.startswith("ROBOT ")
    return [line.split()[0] for line in lines]


@pytest.mark.usefixtures("robots")
def test_the_status_of_each_robot_is_a_table_row_or_an_object(broker: Broker) -> None:
    done = run(broker, "fleet", "status")
    assert (done.code, done.err) == (0, "")
    assert [line.split() for line in done.out.splitlines()] == [
        ["ROBOT", "ONLINE", "SPEAKING", "QUEUE", "LAST"],
        ["anna", "no", "server", "-", "-", "-"],
        ["wh-1", "yes", '"please', "step", 'back"', "2", "SUCCEEDED", "1", "h"],
        ["wh-2", "OFFLINE", "-", "-", "-"],
    ]
    done = run(broker, "fleet", "status", "--long")
    assert [line.split() for line in done.out.splitlines()] == [
        ["ROBOT", "ONLINE", "SERVER", "SPEAKING", "QUEUE", "LAST", "SINCE"],
        ["anna", "no", "server", "-", "-", "-", "-", "2", "h"],
        ["wh-1", "yes", "0.1.0", '"please', "step", 'back"', "2", "SUCCEEDED", "1", "h", "2", "h"],
        ["wh-2", "OFFLINE", "-", "-", "-", "-", "-"],
    ]
    anna, first, second = (json.loads(line) for line in run(broker, "--json", "fleet", "status").out.splitlines())
    assert (anna["robot"], anna["presence"]["online"], anna["presence"]["server"]) == ("anna", True, None)
    assert anna["status"] is None
    assert first["presence"]["groups"] == ["all", "warehouse"]
    assert (first["status"]["text"], first["status"]["last"]["state"]) == ("please step back", "SUCCEEDED")
    assert (second["robot"], second["presence"]["online"]) == ("wh-2", False)


def test_the_status_shows_what_the_bridge_published(robot: Robot) -> None:
    assert robot.desk("say", "--wait", "--", "battery low").code == 0
    with robot.listen("status") as listener:
        listener.await_message(lambda message: message.topic.endswith("/status") and bool(message.json["last"]))
        robot_status = json.loads(run(robot.broker, "--json", "fleet", "status").out)
        assert robot_status["status"]["last"]["text"] == "battery low"
        assert robot_status["presence"]["server"]["pid"] == robot.talk.pid
        robot.bridge.kill()
        listener.await_message(robot.is_offline)
    assert "anna   OFFLINE" in run(robot.broker, "fleet", "status").out


@pytest.mark.usefixtures("robots")
def test_robots_are_selected_by_name_glob_or_group(broker: Broker) -> None:
    for text, selected in (("anna", ["anna"]), ("wh-*", ["wh-1", "wh-2"]), ("@warehouse", ["wh-1", "wh-2"])):
        assert listed(run(broker, "--robot", text, "fleet", "status")) == selected
    assert listed(run(broker, "fleet", "status", TALK_ROBOT="@all")) == ["anna", "wh-1", "wh-2"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("bert", "matches 'bert'; list all robots with: talk fleet status"),
        ("x*", "matches 'x*'; list all robots with: talk fleet status"),
        ("@night", "the group 'night' has no robots at"),
        ("", "no robot has connected to {broker.url} yet; start on each robot: talk bridge --name NAME"),
    ],
)
def test_a_selection_without_robots_exits_with_3(broker: Broker, text: str, expected: str) -> None:
    done = run(broker, "fleet", "status", *(["--robot", text] if text else []))
    assert (done.code, done.out) == (3, "")
    assert expected.format(broker=broker) in done.err


@pytest.mark.parametrize("command", ["status", "watch"])
def test_a_missing_broker_exits_with_3_and_missing_rights_with_10(secure_broker: Broker, command: str) -> None:
    done = run(secure_broker, "fleet", command, user="otto")
    assert (done.code, done.out, "does not allow 'otto'" in done.err) == (10, "", True), done
    with Port() as port:
        done = run(secure_broker, "fleet", command, TALK_BROKER=f"mqtts://127.0.0.1:{port.number}")
    assert (done.code, done.out, "talk: can't connect to the broker at mqtts://" in done.err) == (3, "", True), done


@pytest.mark.parametrize(
    ("args", "env", "error"),
    [
        (["fleet"], {}, "WHAT is missing; choose one of status, watch"),
        (["fleet", "list"], {}, "'list' is not one of 'status', 'watch'"),
        (["--robot", "@", "fleet", "status"], {}, "invalid group name ''"),
        (["--robot", "a b*", "fleet", "watch"], {}, "the pattern 'a b*' can't match any robot"),
        (["fleet", "status"], {"TALK_ROBOT": "a/b"}, "invalid robot name 'a/b'"),
        (["fleet", "status"], {"TALK_BROKER": ""}, "TALK_BROKER is not set; name your broker"),
    ],
)
def test_a_usage_error_names_the_mistake(broker: Broker, args: list[str], env: dict[str, str], error: str) -> None:
    done = run(broker, *args, **env)
    assert (done.code, done.out, error in done.err) == (2, "", True), done


def test_600_robots_are_listed_despite_mosquittos_message_queue(broker: Broker) -> None:
    """Mosquitto drops messages beyond 20 in flight and 1,000 queued, unless the client accepts more in flight."""
    with Listener(broker) as publisher:
        for number in range(600):
            publish.presence(publisher, f"wh-{number:03}")
            publish.status(publisher, f"wh-{number:03}", last="a-1")
    done = run(broker, "fleet", "status")
    assert listed(done) == [f"wh-{number:03}" for number in range(600)]
    assert done.out.count("SUCCEEDED") == 600


@pytest.fixture
def desk(broker: Broker) -> Iterator[Desk]:
    with Desk(broker) as result:
        yield result


def test_watch_prints_each_event_with_its_robot(robot: Robot, desk: Desk) -> None:
    watching = WatchProcess(desk)
    assert robot.desk("say", "--wait", "--id", "b-1", "--", "battery low").code == 0
    watching.until("SUCCEEDED")
    assert robot.desk("say", "--id", "b-2", "--", LONG).code == 0
    watching.until("b-2")
    assert robot.desk("pause").code == robot.desk("resume").code == robot.desk("cancel").code == 0
    watching.until("PREEMPTED")
    head, *lines = watching.lines
    assert head.endswith(f"1 robot; {robot.broker.url}")
    assert [line.split()[1:4] for line in lines] == [
        ["anna", "PENDING", "b-1"],
        ["anna", "ACTIVE", "b-1"],
        ["anna", "SUCCEEDED", "b-1"],
        ["anna", "PENDING", "b-2"],
        ["anna", "ACTIVE", "b-2"],
        ["anna", "paused", "b-2"],
        ["anna", "resumed", "b-2"],
        ["anna", "PREEMPTING", "b-2"],
        ["anna", "PREEMPTED", "b-2"],
    ]
    assert '"battery low"' in lines[0]
    assert "cancelled by" in lines[-1]
    assert (watching.end().code, watching.process.stderr and watching.process.stderr.closed) == (130, True)


def test_watch_prints_robots_and_servers_that_come_and_go(broker: Broker, robots: Listener, desk: Desk) -> None:
    watching, for_programs = WatchProcess(desk), WatchProcess(desk, "--json", "--robot", "wh-*")
    assert watching.lines[0].split("  ")[1] == f"3 robots, 1 OFFLINE, 1 without a server; {broker.url}"
    publish.presence(robots, "wh-2", session="1")
    publish.presence(robots, "wh-1", server=None)
    publish.presence(robots, "wh-1")
    publish.presence(robots, "wh-1", session="another")
    publish.presence(robots, "anna", online=False)
    publish.presence(robots, "bert", server=None)
    watching.until("bert")
    assert [line.split()[1:] for line in watching.lines[1:]] == [
        ["wh-2", "online", "talk", "0.1.0"],
        ["wh-1", "no", "server"],
        ["wh-1", "server", "talk", "0.1.0"],
        ["wh-1", "online", "talk", "0.1.0"],
        ["anna", "OFFLINE"],
        ["bert", "online", "no", "server"],
    ]
    publish.event(robots, "anna", "c-1", "ACTIVE")
    publish.event(robots, "wh-1", "a-2", "SUCCEEDED", "please step back")
    for_programs.until('SUCCEEDED", "text": "please')
    objects: list[dict[str, Any]] = [json.loads(line) for line in for_programs.lines]
    events = [(obj["robot"], obj["event"]) for obj in objects]
    changes = [(name, "presence") for name in ("wh-2", "wh-1", "wh-1", "wh-1")]
    assert events == [("wh-1", "snapshot"), ("wh-2", "snapshot"), *changes, ("wh-1", "state")]
    assert objects[0]["status"]["active"] == "a-2"
    assert [objects[2]["presence"]["online"], objects[3]["presence"]["server"]] == [True, None]
    assert objects[-1]["goal"]["text"] == "please step back"
    assert (watching.end().code, for_programs.end().code) == (130, 130)


@pytest.mark.usefixtures("robots")
def test_watch_reports_a_lost_broker_and_then_the_changes(broker: Broker, desk: Desk) -> None:
    watching = WatchProcess(desk)
    quiet = WatchProcess(desk, "-q")
    broker.kill()
    broker.start()
    with Listener(broker) as again:
        publish.presence(again, "anna", server=None)
        publish.presence(again, "wh-1", groups=["warehouse"])
        publish.status(again, "wh-1", last="a-2", state="ABORTED")
        publish.presence(again, "bert")
        for watch in (watching, quiet):
            while not any("ABORTED" in line for line in watch.lines) or not any("bert" in line for line in watch.lines):
                watch.until("")
    assert sorted(" ".join(line.split()[1:4]) for line in watching.lines[1:]) == [
        "bert online talk",
        "wh-1 ABORTED a-2",
    ]
    assert quiet.end().err == ""
    done = watching.end()
    assert done.code == 130
    gone, back = done.err.splitlines()
    assert gone == f"talk: the connection to the broker at {broker.url} was lost; reconnecting for up to 30 s"
    assert back.startswith(f"talk: the broker at {broker.url} is back after ")


@pytest.mark.usefixtures("robots")
def test_watch_exits_with_141_if_its_reader_goes_away(desk: Desk) -> None:
    watching = WatchProcess(desk)
    assert watching.process.stdout
    watching.process.stdout.close()
    assert watching.process.wait(PATIENCE) == 141


def test_watch_wraps_no_line_on_a_terminal(robots: Listener, desk: Desk) -> None:
    long = "a-robot-of-the-warehouse-in-the-north"
    publish.presence(robots, long)
    with Terminal([*TALK, "fleet", "watch"], desk.env, 80) as terminal:
        terminal.wait_for("4 robots")
        publish.event(robots, "wh-1", "a-3", "ACTIVE", "please step back " * 9)
        publish.event(robots, long, "its-own-id-which-is-long", "ABORTED", "请往后退，门即将关闭 " * 9)
        publish.presence(robots, long, online=False)
        terminal.wait_for("OFFLINE\n")
        terminal.type(b"\x03")
        assert terminal.finish() == 130
    assert terminal.screen.wraps == 0
    assert "a-robot-of-t" in terminal.text
