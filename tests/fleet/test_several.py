"""Commands to several robots: outcomes, usage errors, and commands that take a while."""

from __future__ import annotations

import re
import shlex
import signal
import sys
import time
from typing import TYPE_CHECKING

import pytest

from tests.conformance.bareserve import TALK
from tests.fleet.many import RealRobots, alike, assert_outcomes, at_once, objects, printed_outcomes, request
from tests.fleet.robot import LONG
from tests.support.bridge import Desk
from tests.support.connection import PATIENCE
from tests.support.mqtt import Listener
from tests.support.screen import Terminal
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from pathlib import Path

    from tests.fleet.conftest import MakeRobot
    from tests.fleet.robot import Robot

PAIR = ["wh-1", "wh-2"]
ALL_SUCCEEDED = "talk: 2 of 2 robots succeeded\n"


#: Requests to both robots before a command, by the name of the scene. {} is the command's own goal.
SCENES: dict[str, list[dict[str, str]]] = {
    "nothing": [],
    "waiting": [{"name": "say", "id": "before-{}", "text": LONG}, {"name": "say", "id": "{}", "text": "length=0"}],
    "speaking": [{"name": "say", "id": "{}", "text": LONG}],
}
#: A command, its scene, the id that is shown ({first}: of the first command's goal), the state, and a key of the JSON.
#: `unit/test_fleet_outcome.py` tests the outcomes of all replies.
COMMANDS: list[tuple[str, str, str, str, str]] = [
    ("say --id {} hello", "nothing", "{}", "PENDING", "goal"),
    ("say --wait --id {} hello", "nothing", "{}", "SUCCEEDED", "goal"),
    ("cancel {}", "waiting", "{}", "RECALLED", "goal"),
    ("status", "nothing", "-", "IDLE", "status"),
    ("pause --for 60s", "speaking", "{first}", "PAUSED", "paused"),
    ("set --rate 150", "nothing", "-", "SET", "settings"),
]


def prepare(pair: RealRobots, scene: str, goal: str) -> None:
    for fields in SCENES[scene]:
        request(pair, **{name: value.format(goal) for name, value in fields.items()})


@pytest.mark.parametrize("row", COMMANDS, ids=[f"{row[0]}, {row[1]}" for row in COMMANDS])
def test_the_outcome_of_each_robot_is_a_line_or_an_object(
    pair: RealRobots, desk: Desk, row: tuple[str, str, str, str, str]
) -> None:
    command, scene, goal, state, key = row
    forms = [["--robot", "wh-*"], ["--robot", "@warehouse", "--json"], ["--quiet"]]
    goals = [f"{'-'.join(re.findall('[a-z]+', command))}-{scene}-{number}" for number in range(len(forms))]
    for goal_id in goals:
        prepare(pair, scene, goal_id)
    lines = [[*form, *command.format(goal_id).split()] for form, goal_id in zip(forms, goals, strict=True)]
    plain, for_programs, quiet = at_once(desk, *lines)
    shown = [goal.format(goal_id, first=goals[0]) for goal_id in goals]
    assert printed_outcomes(plain) == alike(PAIR, shown[0], state, 0)
    assert (plain.code, plain.err) == (0, ALL_SUCCEEDED)
    assert (quiet.code, quiet.err) == (0, "")
    if command.startswith("status"):  # its output is not only an acknowledgement
        assert printed_outcomes(quiet) == alike(PAIR, shown[2], state, 0)
    else:
        assert quiet.out == ""
    found_objects = objects(for_programs)
    assert (for_programs.code, for_programs.err, sorted(found_objects)) == (0, ALL_SUCCEEDED, PAIR)
    for answer in found_objects.values():
        assert (answer["exit_code"], answer["state"]) == (0, state)
        if answer.get("goal"):
            assert answer["goal"]["id"] == shown[1]
        assert {"status", "paused", "settings"} & answer.keys() == {key} - {"goal"}
        assert answer[key] is not None


def test_settings_are_listed_with_the_name_of_their_robot(pair: RealRobots, desk: Desk) -> None:
    request(pair, "set", rate=180)
    done = desk.run("set")
    assert sorted(line.split() for line in done.out.splitlines() if "rate" in line) == [
        [name, "rate", "180"] for name in PAIR
    ]
    assert (done.code, done.err) == (0, ALL_SUCCEEDED)


def test_each_selected_goal_has_a_line(pair: RealRobots, desk: Desk) -> None:
    prepare(pair, "waiting", "a-goal")
    with Listener(pair.broker, "talk/reply/+/+/+") as answers:
        named, unnamed = desk.start("wait", "before-a-goal", "a-goal"), desk.start("wait")
        assert answers.find(lambda _: sum(b'"ok": true' in reply.payload for reply in answers.messages) == 4, PATIENCE)
    done = desk.run("cancel")
    assert sorted(done.out.splitlines()) == [
        f"{name} {rest}" for name in PAIR for rest in ("a-goal RECALLED 0", "before-a-goal PREEMPTED 0")
    ]
    assert (done.code, done.err) == (0, ALL_SUCCEEDED)
    waited = desk.finish(named)
    assert sorted(waited.out.splitlines()) == [
        f"{name} {rest}" for name in PAIR for rest in ("a-goal RECALLED 6", "before-a-goal PREEMPTED 7")
    ]
    # If a robot has several failures, the first one counts, in the order of the arguments.
    assert (waited.code, waited.err.splitlines()[-1]) == (7, "talk: 0 of 2 robots succeeded")
    waited = desk.finish(unnamed)  # results of goals that weren't named don't count as failures
    assert (waited.code, waited.err, len(waited.out.splitlines())) == (0, ALL_SUCCEEDED, 4)


def test_options_of_say_reach_all_robots(pair: RealRobots, desk: Desk) -> None:
    options = ["--key", "door", "--priority", "7", "--rate", "300", "--ttl", "60", "--", "hello"]
    request(pair, "say", key="charge", text="I have to charge")
    codes = [
        done.code
        for done in at_once(
            desk,
            ["say", "--wait", "--id", "with-all", *options],
            ["say", "--wait", "--id", "no-ttl", "--ttl", "0", "hello"],
            ["say", "--wait", "--voice", "nobody", "hello"],
        )
    ]
    assert codes == [0, 0, 5]
    for goal in pair.each(lambda robot: robot.talk.goal("with-all")):
        assert (goal["key"], goal["priority"], goal["text"]) == ("door", 7, "hello")
        assert 10 < goal["ttl"] <= 60
    assert [goal["ttl"] for goal in pair.each(lambda robot: robot.talk.goal("no-ttl"))] == [None, None]
    assert desk.run("play", "--wait", "--id", "sound", "--key", "bell", "chirp").code == 0
    for goal in pair.each(lambda robot: robot.talk.goal("sound")):
        assert (goal["text"], goal["format"], goal["key"]) == ("chirp", "sound", "bell")
    throttled = desk.run("say", "--wait", "--throttle", "60", "--key", "charge", "I have to charge")
    assert {(state, code) for _, state, code in printed_outcomes(throttled).values()} == {("REJECTED", 0)}
    assert (throttled.code, throttled.err) == (0, ALL_SUCCEEDED)


def test_the_text_is_read_as_for_one_robot(pair: RealRobots, desk: Desk) -> None:
    text = "the door opens\nplease step back\n"
    done = desk.run("say", "--wait", "--id", "from-input", "-", stdin=text)
    assert_outcomes(done, 0, alike(PAIR, "from-input", "SUCCEEDED", 0), "2 of 2 robots succeeded")
    assert {goal["text"] for goal in pair.each(lambda robot: robot.talk.goal("from-input"))} == {text.rstrip()}
    done = desk.run("say", "--wait", "--id", "bytes", "caf\udce9 au lait")
    assert_outcomes(done, 0, alike(PAIR, "bytes", "SUCCEEDED", 0), "2 of 2 robots succeeded")
    assert done.err.splitlines()[0] == "talk: line 1, column 4: the byte 0xe9 is not valid UTF-8 and is skipped"
    assert {goal["text"] for goal in pair.each(lambda robot: robot.talk.goal("bytes"))} == {"caf\ufffd au lait"}
    for done in (desk.run("say", "  "), desk.run("say", "-", stdin="\n")):
        assert {(state, code) for _, state, code in printed_outcomes(done).values()} == {("REJECTED", 5)}
        assert (done.code, "the text is empty" in done.err) == (5, True)


# Commands that are refused before anything is sent

NUMBER, ONE_ROBOT = "a goal's number is only valid on one server", "only works with one robot; name it"


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("say --lines", f"'talk say --lines' {ONE_ROBOT}"),
        ("say --stream", f"'talk say --stream' {ONE_ROBOT}"),
        ("say -f hello", f"'talk say --feedback' {ONE_ROBOT}"),
        ("say -wf hello", f"'talk say --feedback' {ONE_ROBOT}"),
        ("say -o - hello", "'talk say --output' only works on this machine"),
        ("say", "TEXT is missing"),
        ("play", "NAME is missing"),
        ("play --list", f"'talk play --list' {ONE_ROBOT}"),
        ("say --id 12 hello", "the id '12' is not allowed"),
        ("say --rate 9 hello", "must be 80 to 450 words per minute, got 9"),
        ("wait -f", f"'talk wait --feedback' {ONE_ROBOT}"),
        ("wait old 3", NUMBER),
        ("cancel 12", NUMBER),
        ("cancel --before 12", NUMBER),
        ("status 4", NUMBER),
        ("log", f"'talk log' {ONE_ROBOT}, or try 'talk fleet status' for several"),
        ("watch", f"'talk watch' {ONE_ROBOT}"),
        ("voices", f"'talk voices' {ONE_ROBOT}"),
        ("doctor", f"'talk doctor' {ONE_ROBOT}"),
        ("serve", "'talk serve' only works on this machine"),
        ("set --rate 9999", "must be 80 to 450 words per minute, got 9999"),
        ("--socket /tmp/s --robot wh-* status", "leave out one of them"),
        ("--robot @a/b status", "invalid group name 'a/b'"),
        ("--robot a#* status", "the pattern 'a#*' can't match any robot"),
    ],
)
def test_a_command_that_works_with_only_one_robot_is_a_usage_error(desk: Desk, line: str, expected: str) -> None:
    done = desk.run(*([] if "--robot" in line else ["--robot", "wh-*"]), *line.split())
    assert (done.code, done.out, expected in done.err) == (2, "", True), done


@pytest.mark.parametrize(
    ("line", "code", "expected"),
    [
        (["status", ""], 2, "the goal's id is empty"),
        (["wait", *(f"{'é' * 60}{number}" for number in range(500))], 2, "500 ids do not fit into one request"),
        (["status", "x" * 70], 8, "an id has at most 64 characters"),
    ],
    ids=["empty", "too many", "too long"],
)
def test_an_invalid_id_is_refused_at_once(desk: Desk, line: list[str], code: int, expected: str) -> None:
    done = desk.run(*line)
    assert (done.code, done.out, expected in done.err) == (code, "", True), done


# Commands that take a while


#: A glob and a group that select both robots.
SELECTIONS = ("wh-*", "@warehouse")
#: Seconds until an offline robot is shown while others speak.
AT_ONCE = 1.0
#: The characters that clear the count from a terminal's line.
CLEAR_LINE = "\r\x1b[2K"


def await_state(pair: RealRobots, goal_id: str, state: str) -> None:
    pair.each(lambda robot: robot.talk.watcher.wait_for(goal_id, state))


def states(pair: RealRobots, goal_id: str) -> list[str]:
    """Return the state of a goal on each robot."""
    return [goal["state"] for goal in pair.each(lambda robot: robot.talk.goal(goal_id))]


@pytest.mark.parametrize("to", SELECTIONS)
def test_ctrl_c_cancels_the_goal_on_all_robots(pair: RealRobots, desk: Desk, to: str) -> None:
    """One robot speaks the goal. On the other, it waits behind another goal, which is not cancelled."""
    before, goal = (f"{name}-{SELECTIONS.index(to)}" for name in ("before", "interrupted"))
    assert pair["wh-2"].talk.request("say", id=before, text=LONG)["ok"]
    waiting = desk.start("--robot", to, "say", "--wait", "--id", goal, "--", LONG)
    pair["wh-1"].talk.watcher.wait_for(goal, "ACTIVE")
    pair["wh-2"].talk.watcher.wait_for(goal, "PENDING")
    waiting.send_signal(signal.SIGINT)
    done = desk.finish(waiting)
    expected = {"wh-1": (goal, "PREEMPTED", 7), "wh-2": (goal, "RECALLED", 6)}
    assert_outcomes(done, 130, expected, "0 of 2 robots succeeded")
    assert done.seconds < 1, "the command waited for more than the results"
    assert states(pair, goal) == ["PREEMPTED", "RECALLED"]
    assert pair["wh-2"].talk.goal(before)["state"] == "ACTIVE"


def test_ctrl_c_keeps_the_results_of_robots_that_are_done(pair: RealRobots, desk: Desk) -> None:
    assert pair["wh-2"].talk.request("say", text=LONG)["ok"]
    waiting = desk.start("say", "--wait", "--id", "done-on-one", "hello")
    assert waiting.stdout
    assert waiting.stdout.readline() == "wh-1 done-on-one SUCCEEDED 0\n"
    waiting.send_signal(signal.SIGINT)
    done = desk.finish(waiting)
    assert (done.code, done.out) == (130, "wh-2 done-on-one RECALLED 6\n")
    assert done.err.splitlines()[-1] == "talk: 1 of 2 robots succeeded"
    assert states(pair, "done-on-one") == ["SUCCEEDED", "RECALLED"]


def test_a_timeout_cancels_only_goals_of_its_own_command_and_exits_with_124(pair: RealRobots, desk: Desk) -> None:
    """`wait` doesn't cancel goals. A robot has finished if all goals that were named have ended."""
    request(pair, "say", id="over", text="length=0")
    request(pair, "say", id="in-front", text=LONG)
    await_state(pair, "in-front", "ACTIVE")
    late = ["--timeout", "0.6"]
    waited, by_glob, by_group = at_once(
        desk,
        ["wait", *late, "over", "in-front"],
        *(["--robot", to, "say", "--wait", *late, "--id", f"late-{n}", "hello"] for n, to in enumerate(SELECTIONS)),
    )
    for done, goal in ((by_glob, "late-0"), (by_group, "late-1")):
        assert_outcomes(done, 124, alike(PAIR, goal, "RECALLED", 6), "0 of 2 robots succeeded")
        assert "talk: timed out after 0.6 s\n" in done.err
        assert states(pair, goal) == ["RECALLED"] * 2
    assert (waited.code, sorted(waited.out.splitlines())) == (124, [f"{name} over SUCCEEDED 0" for name in PAIR])
    assert waited.err == "talk: timed out after 0.6 s\ntalk: not done: wh-1, wh-2\ntalk: 0 of 2 robots succeeded\n"
    assert states(pair, "in-front") == ["ACTIVE"] * 2


def test_an_interrupted_wait_does_not_cancel_goals(pair: RealRobots, desk: Desk) -> None:
    request(pair, "say", id="others", text=LONG)
    with Listener(pair.broker, "talk/reply/+/+/+") as answers:
        waiting = desk.start("--robot", "@warehouse", "wait")
        assert answers.find(lambda _: sum(b'"ok": true' in reply.payload for reply in answers.messages) == 2, PATIENCE)
    waiting.send_signal(signal.SIGINT)
    done = desk.finish(waiting)
    assert (done.code, done.out, done.err) == (130, "", "talk: not done: wh-1, wh-2\ntalk: 0 of 2 robots succeeded\n")
    assert states(pair, "others") == ["ACTIVE", "ACTIVE"]


def test_a_reader_that_goes_away_cancels_the_goal_with_exit_code_141(pair: RealRobots, desk: Desk) -> None:
    waiting = desk.start("--robot", "@warehouse", "say", "--wait", "--id", "unread", "--", LONG)
    await_state(pair, "unread", "ACTIVE")
    assert waiting.stdout
    assert waiting.stderr
    waiting.stdout.close()
    assert waiting.wait(PATIENCE) == 141
    assert waiting.stderr.read().splitlines()[-1] == "talk: 0 of 2 robots succeeded"
    assert states(pair, "unread") == ["PREEMPTED", "PREEMPTED"]


def test_without_wait_the_goal_is_spoken_even_if_the_reader_goes_away(pair: RealRobots, desk: Desk) -> None:
    waiting = desk.start("say", "--id", "never-read", "hello")
    assert waiting.stdout
    waiting.stdout.close()
    assert waiting.wait(PATIENCE) in (0, 141)  # 141 if the command tries to write
    assert pair.each(lambda robot: robot.talk.watcher.wait_for_terminal("never-read")) == ["SUCCEEDED"] * 2


def test_an_offline_robot_is_shown_at_once_and_never_speaks_the_goal(robot: Robot, make_robot: MakeRobot) -> None:
    late = make_robot("late")
    with Listener(robot.broker, late.presence) as listener, Desk(robot.broker) as desk:
        assert late.bridge.terminate() == 0
        listener.await_message(late.is_offline)
        with limits():
            started_at = time.monotonic()
            goals = {"*": "by-a-glob", "@all": "by-a-group"}
            arguments = ["say", "--wait", "--id"]
            waiting = [desk.start("--robot", to, *arguments, goal, "--", LONG) for to, goal in goals.items()]
            for process in waiting:
                assert process.stdout
                assert process.stdout.readline() == "late - OFFLINE 3\n"
                assert_within(time.monotonic() - started_at, AT_ONCE, "the line of an offline robot")
        late.bridge.start()
        late.bridge.await_online()
        for goal in goals.values():
            robot.talk.watcher.wait_for(goal, "PENDING")
        assert robot.desk("cancel").code == 0
        assert [desk.finish(process).code for process in waiting] == [13, 13]
        assert late.desk("say", "--wait", "spoken later").code == 0
    assert late.talk.watcher.texts("PENDING") == ["spoken later"]


# On a terminal


def test_a_terminal_counts_finished_robots_and_is_left_clean(pair: RealRobots, desk: Desk) -> None:
    assert pair["wh-2"].talk.request("say", text=LONG)["ok"]
    command = [*TALK, "--robot", "@warehouse", "say", "--wait", "--id", "counted", "hello"]
    with Terminal(command, desk.env) as terminal:
        terminal.wait_for("\r0 of 2")
        terminal.wait_for("counted SUCCEEDED 0\n")
        terminal.wait_until(lambda screen: screen.last == "1 of 2 robots")
        request(pair, "cancel")
        assert terminal.finish() == 6
    written = terminal.raw.decode()
    assert list(dict.fromkeys(re.findall(r"\r(\d of \d)", written))) == ["0 of 2", "1 of 2", "2 of 2"]
    assert terminal.screen.wraps == 0
    first, second, why, *_, summary, last = terminal.screen.lines
    assert (first, second) == ("wh-1 counted SUCCEEDED 0", "wh-2 counted RECALLED 6")
    assert why.startswith("talk: RECALLED: wh-2: counted: ")
    assert (summary, last) == ("talk: 1 of 2 robots succeeded", "")


@pytest.mark.usefixtures("pair")
def test_the_count_is_shown_only_if_standard_error_is_a_terminal(desk: Desk, tmp_path: Path) -> None:
    command = shlex.join([sys.executable, "-m", "talkcli", "status"])
    cases = {
        f"{command} > {tmp_path}/out": True,
        f"{command} 2> {tmp_path}/err": False,
        f"{command} -q": False,
    }
    terminals = [(Terminal(["sh", "-c", case], desk.env), counts) for case, counts in cases.items()]
    for terminal, counts in terminals:
        assert terminal.finish() == 0
        assert (b"\r0 of" in terminal.raw, CLEAR_LINE.encode() in terminal.raw) == (counts, counts)
    assert sorted((tmp_path / "out").read_text().splitlines()) == ["wh-1 - IDLE 0", "wh-2 - IDLE 0"]
    assert (tmp_path / "err").read_text() == "talk: 2 of 2 robots succeeded\n"


def test_ctrl_c_on_a_terminal_leaves_no_count_behind(pair: RealRobots, desk: Desk) -> None:
    with Terminal([*TALK, "say", "--wait", "--id", "typed", "--", LONG], desk.env) as terminal:
        await_state(pair, "typed", "ACTIVE")
        terminal.wait_for("\r0 of 2")
        terminal.type(b"\x03")
        assert terminal.finish() == 130
    assert terminal.screen.lines[-2:] == ["talk: 0 of 2 robots succeeded", ""]
    assert not [line for line in terminal.screen.lines if re.search(r"\d of 2 robots$", line)]
