"""`talk fleet status` and `talk fleet watch` at a desk, in a pipe and on a terminal."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest

from tests.conformance.bareserve import TALK
from tests.fleet import told
from tests.fleet.robot import LONG
from tests.fleet.watching import Watching
from tests.support.bridge import Desk
from tests.support.connection import PATIENCE
from tests.support.mqtt import Listener
from tests.support.ports import Port
from tests.support.terminal import Terminal

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.fleet.robot import Robot
    from tests.support.broker import Broker
    from tests.support.processes import Finished


@pytest.fixture
def robots(broker: Broker) -> Iterator[Listener]:
    """A publisher for three robots, one of which is offline, and one without a server."""
    with Listener(broker) as publisher:
        told.presence(publisher, "wh-2", online=False, groups=["warehouse"])
        told.presence(publisher, "wh-1", groups=["warehouse"])
        told.status(publisher, "wh-1", active="a-2", text="please step back", pending=2, last="a-1")
        told.presence(publisher, "anna", server=None)
        yield publisher


def run(broker: Broker, *words: str, user: str | None = None, **env: str) -> Finished:
    with Desk(broker, user=user, env=env) as somebody:
        return somebody.run(*words)


def listed(done: Finished) -> list[str]:
    """Return the robots that a table lists."""
    assert done.code == 0, done
    head, *lines = done.out.splitlines()
    assert head.startswith("ROBOT ")
    return [each.split()[0] for each in lines]


@pytest.mark.usefixtures("robots")
def test_the_table_and_the_objects_show_each_robot(broker: Broker) -> None:
    done = run(broker, "fleet", "status")
    assert (done.code, done.err) == (0, "")
    assert [each.split() for each in done.out.splitlines()] == [
        ["ROBOT", "ONLINE", "SPEAKING", "QUEUE", "LAST"],
        ["anna", "no", "server", "-", "-", "-"],
        ["wh-1", "yes", '"please', "step", 'back"', "2", "SUCCEEDED", "1", "h"],
        ["wh-2", "OFFLINE", "-", "-", "-"],
    ]
    done = run(broker, "fleet", "status", "--long")
    assert [each.split() for each in done.out.splitlines()] == [
        ["ROBOT", "ONLINE", "SERVER", "SPEAKING", "QUEUE", "LAST", "SINCE"],
        ["anna", "no", "server", "-", "-", "-", "-", "2", "h"],
        ["wh-1", "yes", "0.1.0", '"please', "step", 'back"', "2", "SUCCEEDED", "1", "h", "2", "h"],
        ["wh-2", "OFFLINE", "-", "-", "-", "-", "-"],
    ]
    anna, first, second = (json.loads(each) for each in run(broker, "--json", "fleet", "status").out.splitlines())
    assert (anna["robot"], anna["presence"]["online"], anna["presence"]["server"]) == ("anna", True, None)
    assert anna["status"] is None
    assert first["presence"]["groups"] == ["all", "warehouse"]
    assert (first["status"]["text"], first["status"]["last"]["state"]) == ("please step back", "SUCCEEDED")
    assert (second["robot"], second["presence"]["online"]) == ("wh-2", False)


def test_a_robot_is_shown_by_the_words_of_its_bridge(robot: Robot) -> None:
    assert robot.desk("say", "--wait", "--", "battery low").code == 0
    with robot.listen("status") as listener:
        listener.await_message(lambda each: each.topic.endswith("/status") and bool(each.json["last"]))
        found = json.loads(run(robot.broker, "--json", "fleet", "status").out)
        assert found["status"]["last"]["text"] == "battery low"
        assert found["presence"]["server"]["pid"] == robot.talk.pid
        robot.bridge.kill()
        listener.await_message(robot.is_offline)
    assert "anna   OFFLINE" in run(robot.broker, "fleet", "status").out


@pytest.mark.usefixtures("robots")
def test_a_name_a_glob_or_a_group_picks(broker: Broker) -> None:
    for text, picked in (("anna", ["anna"]), ("wh-*", ["wh-1", "wh-2"]), ("@warehouse", ["wh-1", "wh-2"])):
        assert listed(run(broker, "--robot", text, "fleet", "status")) == picked
    assert listed(run(broker, "fleet", "status", TALK_ROBOT="@all")) == ["anna", "wh-1", "wh-2"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("bert", "matches 'bert'; list all robots with: talk fleet status"),
        ("x*", "matches 'x*'; list all robots with: talk fleet status"),
        ("@night", "the group 'night' has no robots at"),
        ("", "no robot has connected to {broker.url} yet; start on each robot: talk bridge --name NAME"),
    ],
)
def test_a_pick_of_no_robot_ends_it_with_3(broker: Broker, text: str, words: str) -> None:
    done = run(broker, "fleet", "status", *(["--robot", text] if text else []))
    assert (done.code, done.out) == (3, "")
    assert words.format(broker=broker) in done.err


@pytest.mark.parametrize("what", ["status", "watch"])
def test_without_a_broker_or_rights_it_ends_with_3_or_10(secure_broker: Broker, what: str) -> None:
    done = run(secure_broker, "fleet", what, user="otto")
    assert (done.code, done.out, "does not allow 'otto'" in done.err) == (10, "", True), done
    with Port() as port:
        done = run(secure_broker, "fleet", what, TALK_BROKER=f"mqtts://127.0.0.1:{port.number}")
    assert (done.code, done.out, "talk: can't connect to the broker at mqtts://" in done.err) == (3, "", True), done


@pytest.mark.parametrize(
    ("words", "env", "said"),
    [
        (["fleet"], {}, "WHAT is missing; choose one of status, watch"),
        (["fleet", "list"], {}, "'list' is not one of 'status', 'watch'"),
        (["--robot", "@", "fleet", "status"], {}, "invalid group name ''"),
        (["--robot", "a b*", "fleet", "watch"], {}, "the pattern 'a b*' can't match any robot"),
        (["fleet", "status"], {"TALK_ROBOT": "a/b"}, "invalid robot name 'a/b'"),
        (["fleet", "status"], {"TALK_BROKER": ""}, "TALK_BROKER is not set; name your broker"),
    ],
)
def test_a_usage_error_names_the_mistake(broker: Broker, words: list[str], env: dict[str, str], said: str) -> None:
    done = run(broker, *words, **env)
    assert (done.code, done.out, said in done.err) == (2, "", True), done


def test_more_robots_are_shown_than_mosquitto_queues_messages_for_a_client(broker: Broker) -> None:
    """It sends 20 at once and queues 1,000; it drops others, unless the client asks for more at once."""
    with Listener(broker) as publisher:
        for number in range(600):
            told.presence(publisher, f"wh-{number:03}")
            told.status(publisher, f"wh-{number:03}", last="a-1")
    done = run(broker, "fleet", "status")
    assert listed(done) == [f"wh-{number:03}" for number in range(600)]
    assert done.out.count("SUCCEEDED") == 600


@pytest.fixture
def somebody(broker: Broker) -> Iterator[Desk]:
    with Desk(broker) as result:
        yield result


def test_each_event_has_a_line_with_its_robot(robot: Robot, somebody: Desk) -> None:
    watching = Watching(somebody)
    assert robot.desk("say", "--wait", "--id", "b-1", "--", "battery low").code == 0
    watching.until("SUCCEEDED")
    assert robot.desk("say", "--id", "b-2", "--", LONG).code == 0
    watching.until("b-2")
    assert robot.desk("pause").code == robot.desk("resume").code == robot.desk("cancel").code == 0
    watching.until("PREEMPTED")
    head, *lines = watching.lines
    assert head.endswith(f"1 robot; {robot.broker.url}")
    assert [each.split()[1:4] for each in lines] == [
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
    assert "canceled by" in lines[-1]
    assert (watching.end().code, watching.process.stderr and watching.process.stderr.closed) == (130, True)


def test_robots_and_servers_that_come_and_go_have_lines_or_objects(
    broker: Broker, robots: Listener, somebody: Desk
) -> None:
    watching, for_programs = Watching(somebody), Watching(somebody, "--json", "--robot", "wh-*")
    assert watching.lines[0].split("  ")[1] == f"3 robots, 1 OFFLINE, 1 without a server; {broker.url}"
    told.presence(robots, "wh-2", session="1")
    told.presence(robots, "wh-1", server=None)
    told.presence(robots, "wh-1")
    told.presence(robots, "wh-1", session="another")
    told.presence(robots, "anna", online=False)
    told.presence(robots, "bert", server=None)
    watching.until("bert")
    assert [each.split()[1:] for each in watching.lines[1:]] == [
        ["wh-2", "online", "talk", "0.1.0"],
        ["wh-1", "no", "server"],
        ["wh-1", "server", "talk", "0.1.0"],
        ["wh-1", "online", "talk", "0.1.0"],
        ["anna", "OFFLINE"],
        ["bert", "online", "no", "server"],
    ]
    told.event(robots, "anna", "c-1", "ACTIVE")
    told.event(robots, "wh-1", "a-2", "SUCCEEDED", "please step back")
    for_programs.until('SUCCEEDED", "text": "please')
    found: list[dict[str, Any]] = [json.loads(each) for each in for_programs.lines]
    events = [(each["robot"], each["event"]) for each in found]
    changes = [(name, "presence") for name in ("wh-2", "wh-1", "wh-1", "wh-1")]
    assert events == [("wh-1", "snapshot"), ("wh-2", "snapshot"), *changes, ("wh-1", "state")]
    assert found[0]["status"]["active"] == "a-2"
    assert [found[2]["presence"]["online"], found[3]["presence"]["server"]] == [True, None]
    assert found[-1]["goal"]["text"] == "please step back"
    assert (watching.end().code, for_programs.end().code) == (130, 130)


@pytest.mark.usefixtures("robots")
def test_a_break_is_told_on_standard_error_and_then_what_has_changed(broker: Broker, somebody: Desk) -> None:
    watching = Watching(somebody)
    quiet = Watching(somebody, "-q")
    broker.kill()
    broker.start()
    with Listener(broker) as again:
        told.presence(again, "anna", server=None)
        told.presence(again, "wh-1", groups=["warehouse"])
        told.status(again, "wh-1", last="a-2", state="ABORTED")
        told.presence(again, "bert")
        for each in (watching, quiet):
            while not any("ABORTED" in line for line in each.lines) or not any("bert" in line for line in each.lines):
                each.until("")
    assert sorted(" ".join(each.split()[1:4]) for each in watching.lines[1:]) == [
        "bert online talk",
        "wh-1 ABORTED a-2",
    ]
    assert quiet.end().err == ""
    done = watching.end()
    assert done.code == 130
    gone, back = done.err.splitlines()
    assert gone == f"talk: the connection to the broker at {broker.url} was lost; trying again for 30 s"
    assert back.startswith(f"talk: the broker at {broker.url} is back after ")


@pytest.mark.usefixtures("robots")
def test_a_reader_that_goes_away_ends_it_with_141(somebody: Desk) -> None:
    watching = Watching(somebody)
    assert watching.process.stdout
    watching.process.stdout.close()
    assert watching.process.wait(PATIENCE) == 141


def test_on_a_terminal_no_line_is_broken(robots: Listener, somebody: Desk) -> None:
    long = "a-robot-of-the-warehouse-in-the-north"
    told.presence(robots, long)
    with Terminal([*TALK, "fleet", "watch"], somebody.env, 80) as terminal:
        terminal.wait_for("4 robots")
        told.event(robots, "wh-1", "a-3", "ACTIVE", "please step back " * 9)
        told.event(robots, long, "its-own-id-which-is-long", "ABORTED", "请往后退，门即将关闭 " * 9)
        told.presence(robots, long, online=False)
        terminal.wait_for("OFFLINE\n")
        terminal.type(b"\x03")
        assert terminal.finish() == 130
    assert terminal.screen.wraps == 0
    assert "a-robot-of-t" in terminal.text
