"""Commands to one robot: their output compared with the robot's own, and faults of the broker."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import pytest

from talkcli import Client, Fleet, State
from talkcli.cli.wait import CANCEL_TIMEOUT_S
from talkcli.errors import Lost
from tests.fleet.fake_robot import FakeRobot
from tests.fleet.publish import SERVER, presence
from tests.fleet.robot import LONG, Robot
from tests.support.bridge import Bridge, Desk, desk
from tests.support.broker import Broker
from tests.support.mqtt import Listener
from tests.support.processes import Talk
from tests.support.proxy import Proxy
from tests.support.surroundings import short_directory

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from tests.conftest import MakeTalk
    from tests.support.processes import Clients, Finished, Process

ALLOW = ("--allow", "say,cancel,status,wait,log,voices,pause,resume,set")
#: The server's uptime, which differs between commands.
_UPTIME = re.compile(r'up \d+ s|"uptime": [\d.]+')


@pytest.fixture(scope="module")
def permissive_robot() -> Iterator[Robot]:
    """A robot that allows all requests. It has spoken a goal and rejected another."""
    with Broker() as broker, contextlib.closing(Talk(["--player", "null", "--rate", "450"])) as talk:
        with Bridge(talk, broker, "anna", *ALLOW) as bridge:
            bridge.await_online()
            assert talk.run("say", "--wait", "--id", "old", "--key", "door", "hello").code == 0
            assert talk.run("say", "--id", "bad", "--rate", "9999", "hello").code != 0
            yield Robot(talk, broker, bridge)
            assert bridge.terminate() == 0, bridge.log
        talk.stop()


def comparable(done: Finished) -> tuple[int, str, str]:
    return done.code, _UPTIME.sub("", done.out), _UPTIME.sub("", done.err)


@pytest.mark.parametrize(
    ("line", "code"),
    [
        ("status", 0),
        ("--json status old", 0),
        ("status nothing", 8),
        ("--json status nothing", 8),
        ("--json log -n 5", 0),
        ("--json log --since 2h --key door --state succeeded --grep ell", 0),
        ("log --since never", 2),
        ("--json voices --language en", 0),
        ("voices --language xx", 1),
        ("set", 0),
        ("--json set --rate 450", 0),
        ("set --voice nobody", 2),
        ("pause", 0),
        ("--json pause --for 20s", 0),
        ("--json resume", 0),
        ("wait", 0),
        ("--json wait -f old", 0),
        ("wait old nothing", 8),
        ("cancel", 0),
        ("--json cancel --key door", 0),
        ("cancel nothing", 8),
        ("say --rate 9999 hello", 2),
        ("--json say -wf --id old hello", 0),
        ("say --dry-run --id new --markdown # *hello*", 0),
        ("say --dry-run --voice parrot hello", 5),
        ("-q say --throttle 60 --key door hello", 0),
    ],
)
def test_a_command_has_the_same_output_as_on_the_robot(permissive_robot: Robot, line: str, code: int) -> None:
    local = permissive_robot.talk.run(*line.split())
    remote = permissive_robot.desk(*line.split())
    permissive_robot.talk.request("resume")  # other tests need a robot that isn't paused
    assert comparable(remote) == comparable(local)
    assert remote.code == code, remote


def test_a_sentence_has_the_same_output_while_it_is_spoken(permissive_robot: Robot) -> None:
    """Only the id and the times of the words differ."""
    shown: list[tuple[int, str, str]] = []
    for client in (permissive_robot.talk, Desk(permissive_robot.broker, env={"TALK_ROBOT": "anna"})):
        with contextlib.nullcontext(client) if isinstance(client, Talk) else client:
            for line, stdin in (("say -wf -- go on", None), ("say -w -", "go on\n")):
                goal = f"goal-{len(shown)}"
                done = client.run("say", "--id", goal, *line.split()[1:], stdin=stdin)
                assert done.code == 0, done
                shown.append((done.code, re.sub(rf"{goal}|\d+\.\d+", "", done.out), done.err))
    assert shown[2:] == shown[:2]


def test_a_remote_watch_shows_the_same_events_as_a_local_one(permissive_robot: Robot) -> None:
    talk = permissive_robot.talk
    with Desk(permissive_robot.broker) as operator:
        watchers: list[tuple[Clients, Process]] = [
            (talk, talk.start("--json", "watch")),
            (operator, operator.start("--robot", "anna", "--json", "watch")),
        ]
        seen: list[list[str]] = []
        for _, process in watchers:
            assert process.stdout
            seen.append([process.stdout.readline()])
        assert talk.run("say", "--wait", "--", "the door opens").code == 0
        for (client, process), lines in zip(watchers, seen, strict=True):
            assert process.stdout
            while len(lines) == 1 or '"SUCCEEDED"' not in lines[-1]:
                lines.append(process.stdout.readline())
            process.send_signal(signal.SIGINT)
            assert client.finish(process).code == 130
    local, remote = seen
    assert json.loads(remote[0]).keys() == json.loads(local[0]).keys()  # the number of clients differs
    assert remote[1:] == local[1:]
    assert len([line for line in remote if '"event": "word"' in line]) == 3


def test_lines_are_spoken_in_order_even_if_they_exceed_the_queue(robot: Robot) -> None:
    lines = [f"length=0.01 {n}" for n in range(25)]
    for options in (["--wait"], []):
        with Desk(robot.broker) as operator:
            done = operator.run("--robot", "anna", "say", "--lines", *options, stdin="\n".join(lines))
        assert (done.code, len(done.out.splitlines())) == (0, len(lines)), done
    assert robot.talk.run("wait").code == 0
    assert robot.talk.watcher.texts("SUCCEEDED") == lines * 2


def test_lines_time_out_while_the_queue_is_full(robot: Robot) -> None:
    lines = [LONG, *(f"{n}" for n in range(100))]
    assert robot.talk.run("say", "--lines", "--ahead", "101", stdin="\n".join(lines)).code == 0
    with Desk(robot.broker) as operator:
        done = operator.run("--robot", "anna", "say", "--lines", "--wait", "--timeout", "2", stdin="one\ntwo\n")
    assert done.code == 124, done
    assert "line 1 may not have been accepted" in done.err
    assert "timed out after 2 s" in done.err
    robot.talk.run("cancel")


def test_ctrl_c_cancels_lines_of_a_command_that_has_run_for_a_while(robot: Robot) -> None:
    with Desk(robot.broker) as operator:
        client = operator.start("--robot", "anna", "say", "--lines", "--wait", stdin=subprocess.PIPE)
        assert client.stdin
        assert client.stdout
        client.stdin.write("never-ends words=1\nsecond\n")
        client.stdin.flush()
        ids = [client.stdout.readline().strip() for _ in range(2)]
        robot.talk.watcher.wait_for_word(ids[0])
        time.sleep(CANCEL_TIMEOUT_S)
        client.send_signal(signal.SIGINT)
        done = operator.finish(client)
    assert (done.code, "not known" in done.err) == (130, False), done
    assert [robot.talk.watcher.wait_for_terminal(goal_id) for goal_id in ids] == ["PREEMPTED", "RECALLED"]


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("--robot anna say hello", "TALK_BROKER is not set"),
        ("--robot anna --socket /tmp/s status", "leave out one of them"),
        ("--robot anna serve", "serve"),
        ("--robot anna bridge --name anna", "bridge"),
        ("--robot anna completion bash", "completion"),
        ("--robot anna say -o - hello", "--output"),
        ("--robot @all say --dry-run hello", "'talk say --dry-run' only works with one robot"),
        ("--robot an/na status", "an/na"),
        ("--robot # status", "#"),
        ("--robot= status", "empty"),
    ],
)
def test_a_command_that_no_robot_can_run_is_a_usage_error(shared_robot: Robot, line: str, expected: str) -> None:
    with Desk(shared_robot.broker, env={"TALK_BROKER": ""} if "TALK_BROKER" in expected else {}) as operator:
        done = operator.run(*line.split())
    assert (done.code, done.out) == (2, ""), done
    assert expected in done.err


def test_markdown_is_only_sent_to_a_robot_whose_server_supports_it(shared_robot: Robot) -> None:
    done = shared_robot.desk("say", "-w", "--markdown", "--id", "marked", "length=0 **hello**")
    assert (done.code, shared_robot.talk.goal("marked")["format"]) == (0, "markdown"), done
    refused = "old-1: the server (version 0.1.0) does not support Markdown; restart it\n"
    with FakeRobot(shared_robot.broker, "old-1", lambda _: []) as robot, Desk(shared_robot.broker) as operator:
        presence(robot, "old-1", server={**SERVER, "features": []})
        done = operator.run("--robot", "old-1", "say", "--markdown", "**hello**")
        assert (done.code, done.out, done.err) == (9, "", f"talk: {refused}"), done
        done = operator.run("--robot", "old-*", "say", "--markdown", "**hello**")
        assert (done.code, refused.removeprefix("old-1: ") in done.err) == (9, True), done


def test_a_command_for_a_robot_never_reaches_the_local_server(broker: Broker) -> None:
    """This includes simple commands, which are sent before most modules are imported."""
    with short_directory() as home, socket.socket(socket.AF_UNIX) as local:
        local.bind(f"{home}/s")
        local.listen()
        local.setblocking(False)
        for options, env in ((["--robot", "nobody"], {}), ([], {"TALK_ROBOT": "nobody"})):
            with Desk(broker, env={"TALK_SOCKET": f"{home}/s", **env}) as operator:
                lines = ("say hello", "say -w hello", "cancel", "--json status", "watch")
                for client in [operator.start(*options, *line.split()) for line in lines]:
                    done = operator.finish(client)
                    assert (done.code, "no robot 'nobody'" in done.err) == (3, True), done
        with pytest.raises(BlockingIOError):  # no command has connected
            local.accept()


def test_options_override_variables_and_a_robot_overrides_a_socket(permissive_robot: Robot) -> None:
    variables = {"TALK_SOCKET": permissive_robot.talk.socket, "TALK_ROBOT": "nobody"}
    with Desk(permissive_robot.broker, env=variables) as operator:
        assert operator.run("status").code == 3
        assert operator.run("--robot", "anna", "status").code == 0
        assert operator.run("--socket", permissive_robot.talk.socket, "status").code == 0
    with Desk(permissive_robot.broker, env=variables | {"TALK_BROKER": ""}) as operator:
        assert operator.run("--socket", permissive_robot.talk.socket, "say", "--wait", "hello").code == 0


def completions(robot: Robot, line: str, **env: str) -> list[str]:
    """Return the completions of a command line in fish."""
    variables = {"_TALK_COMPLETE": "fish_complete", "COMP_WORDS": line, "COMP_CWORD": ""}
    with Desk(robot.broker, env={**env, **variables}) as operator:
        done = operator.run()
    assert done.err == "", done
    return [line.removeprefix("plain,").partition("\t")[0] for line in done.out.splitlines() if line]


def test_completion_offers_online_robots_and_their_goals(robot: Robot) -> None:
    with Listener(robot.broker) as publisher:
        presence(publisher, "bert")
        presence(publisher, "carl", online=False)
    assert robot.talk.run("say", "--id", "mine", "--", LONG).code == 0
    assert completions(robot, "talk --robot ") == ["anna", "bert", "@all"]
    assert completions(robot, "talk fleet status --robot @") == ["@all"]
    assert completions(robot, "talk --robot anna wait ") == ["mine"]
    assert completions(robot, "talk wait m", TALK_ROBOT="anna") == ["mine"]
    assert completions(robot, "talk --robot carl wait ") == []
    robot.broker.kill()
    assert completions(robot, "talk --robot ") == []
    robot.broker.start()


# A broker that limits messages or loses a reply


#: Too long for the broker, but not for a robot.
TOO_LONG = "word " * 1_200


@pytest.fixture
def client(shared_robot: Robot) -> Iterator[Client]:
    """A `Client` of the robot."""
    with Fleet(shared_robot.broker.url).robot("anna") as client:
        yield client


def test_a_text_too_long_for_the_broker_is_refused_before_it_is_sent(make_talk: MakeTalk) -> None:
    with Broker(max_packet=4096) as broker, Bridge(make_talk(scripted=True), broker, "anna") as bridge:
        bridge.await_online()
        done = desk(broker, "anna", "say", "--wait", "--", TOO_LONG)
        assert (done.code, done.out) == (1, "")
        assert "the broker accepts at most 3,072; nothing was sent" in done.err
        with Desk(broker, env={"TALK_MQTT_USER": "o" * 59}) as operator:  # the longest allowed name
            assert operator.run("--robot", "anna", "say", "--wait", "--rate", "450", "--", "short").code == 0


def test_a_cancel_whose_reply_is_lost_does_not_affect_later_goals(robot: Robot) -> None:
    robot.talk.request("pause")
    robot.talk.run("say", "--id", "old", "old")
    with (
        Proxy(robot.broker.port) as proxy,
        Fleet(robot.broker.url_at(proxy.port)).robot("anna") as client,
        ThreadPoolExecutor(1) as thread,
    ):
        with Listener(robot.broker, "talk/reply/+/+/anna") as listener:
            proxy.hold("to_client")
            future = thread.submit(client.cancel)
            listener.await_message(lambda message: b'"count": 1' in message.payload)
        robot.talk.run("say", "--id", "new", "new")
        proxy.cut()
        proxy.release()
        with pytest.raises(Lost, match="it may have been carried out"):
            future.result(30)
        assert client.goal("old").state is State.RECALLED
        assert client.goal("new").state is State.PENDING


def test_a_goal_may_be_sent_from_several_threads(client: Client) -> None:
    fields: dict[str, Any] = {"ttl": 60, "data": {"number": [1]}, "id": "the-same", "follow": False}
    with ThreadPoolExecutor(4) as threads:
        futures = [threads.submit(client.say, "a", **fields) for _ in range(20)]
    handles = [future.result() for future in futures]
    assert {handle.id for handle in handles} == {"the-same"}
    assert sum(not handle.attached for handle in handles) == 1


def test_a_robots_history_is_sent_in_several_messages(broker: Broker, make_talk: MakeTalk, tmp_path: Path) -> None:
    talk = make_talk("--history", f"{tmp_path}/h.db", scripted=True)
    text = "\0" + "long " * 1_900  # a text with NUL is rejected at once
    with talk.connect() as wire:
        ids = [wire.request("say", text=text)["goal"]["id"] for _ in range(100)]
    talk.stop()
    talk.start_server()
    with Bridge(talk, broker, "anna") as bridge:
        bridge.await_online()
        done = desk(broker, "anna", "--json", "log", "--since", "2h")
        assert [(goal["id"], goal["text"]) for goal in map(json.loads, done.out.splitlines())] == [
            (goal_id, text) for goal_id in ids
        ]
        assert bridge.terminate() == 0


@pytest.mark.slow  # a broker doesn't report withheld messages, so the desk waits for its limit of 5 s
def test_a_login_that_may_not_read_replies_is_refused_before_sending(make_talk: MakeTalk) -> None:
    rules = "user anna\ntopic readwrite #\n\nuser olga\ntopic write talk/#\ntopic read talk/robot/+/presence\n"
    with (
        Broker(users={"anna": "a", "olga": "b"}, acl=rules) as broker,
        Bridge(make_talk("--player", "null"), broker, "anna", user="anna", observer="anna") as bridge,
    ):
        bridge.await_online()
        done = desk(broker, "anna", "say", "--", "hello", user="olga")
        assert (done.code, "does not allow 'olga' to read talk/reply/olga" in done.err) == (10, True), done
        log = desk(broker, "anna", "--json", "log", user="anna")
        assert (log.code, log.out) == (0, "")


def test_a_forked_child_can_close_its_copy_of_a_client(client: Client) -> None:
    child = os.fork()
    if child == 0:
        client.close()
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
    assert client.status().server["pid"]
