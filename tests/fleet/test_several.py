"""Commands to several robots, picked by a glob or a group: the outcome of each robot, and requests that are refused."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest

from tests.fleet.many import RealRobots, alike, assert_told, at_once, objects, request, told
from tests.fleet.robot import LONG
from tests.support.connection import PATIENCE
from tests.support.mqtt import Listener

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.support.bridge import Desk

PAIR = ["wh-1", "wh-2"]
AS_ASKED = "talk: 2 of 2 as asked\n"


def nothing(_: RealRobots, __: str) -> None:
    """Leave the robots as they are."""


def said(pair: RealRobots, goal_id: str) -> None:
    """Have both robots speak this goal to its end."""
    request(pair, "say", id=goal_id, text="length=0")
    pair.each(lambda each: each.talk.watcher.wait_for_terminal(goal_id))


def pending(pair: RealRobots, goal_id: str) -> None:
    """Have this goal wait at both robots, behind one that has no end."""
    request(pair, "say", id=f"before-{goal_id}", text=LONG)
    request(pair, "say", id=goal_id, text="length=0")


def begun(pair: RealRobots, goal_id: str) -> None:
    """Have both robots speak this goal, which has no end, or let it wait for one that has none."""
    request(pair, "say", id=goal_id, text=LONG)


def held(pair: RealRobots, goal_id: str) -> None:
    """Have such a goal paused at both robots."""
    begun(pair, goal_id)
    request(pair, "pause")


#: A command, with `{}` for a goal of its own; what is done before; the goal that is shown (`{first}`: that of the first
#: command) and the state; the key that an object has besides.
COMMANDS: list[tuple[str, Callable[[RealRobots, str], None], str, str, str | None]] = [
    ("say --id {} hello", nothing, "{}", "PENDING", "goal"),
    ("say --wait --id {} hello", nothing, "{}", "SUCCEEDED", "goal"),
    ("cancel {}", pending, "{}", "RECALLED", "goal"),
    ("cancel", nothing, "-", "IDLE", None),
    ("wait {}", said, "{}", "SUCCEEDED", "goal"),
    ("wait", nothing, "-", "IDLE", None),
    ("status", nothing, "-", "IDLE", "status"),
    ("status {}", said, "{}", "SUCCEEDED", "goal"),
    ("pause", begun, "{first}", "PAUSED", "paused"),
    ("status", held, "{first}", "PAUSED", "status"),
    ("status", begun, "{first}", "ACTIVE", "status"),
    ("resume", nothing, "-", "RESUMED", "paused"),
    ("set --rate 150", nothing, "-", "SET", "settings"),
]


@pytest.mark.parametrize(
    ("command", "prepare", "goal", "state", "key"), COMMANDS, ids=[f"{row[0]}, {row[1].__name__}" for row in COMMANDS]
)
def test_each_robot_has_a_line_or_an_object(
    pair: RealRobots,
    desk: Desk,
    command: str,
    prepare: Callable[[RealRobots, str], None],
    goal: str,
    state: str,
    key: str | None,
) -> None:
    forms = [["--robot", "wh-*"], ["--robot", "@warehouse", "--json"], ["--quiet"]]
    name = "-".join(re.findall("[a-z]+", f"{command} {prepare.__name__}"))
    goals = [f"{name}-{number}" for number in range(len(forms))]
    for each in goals:
        prepare(pair, each)
    lines = [[*form, *command.format(each).split()] for form, each in zip(forms, goals, strict=True)]
    plain, for_programs, quiet = at_once(desk, *lines)
    shown = [goal.format(each, first=goals[0]) for each in goals]
    assert told(plain) == alike(PAIR, shown[0], state, 0)
    assert (plain.code, plain.err) == (0, AS_ASKED)
    assert (quiet.code, quiet.err) == (0, "")
    if command.startswith("status"):  # which was asked for nothing else
        assert told(quiet) == alike(PAIR, shown[2], state, 0)
    else:
        assert quiet.out == ""
    found = objects(for_programs)
    assert (for_programs.code, for_programs.err, sorted(found)) == (0, AS_ASKED, PAIR)
    for answer in found.values():
        assert (answer["exit_code"], answer["state"]) == (0, state)
        if answer.get("goal"):
            assert answer["goal"]["id"] == shown[1]
        assert {"status", "paused", "settings"} & answer.keys() == ({key} if key else set()) - {"goal"}
        assert key is None or answer[key] is not None


def test_the_settings_of_each_robot_are_listed_under_its_name(pair: RealRobots, desk: Desk) -> None:
    request(pair, "set", rate=180)
    done = desk.run("set")
    assert sorted(line.split() for line in done.out.splitlines() if "rate" in line) == [
        [name, "rate", "180"] for name in PAIR
    ]
    assert (done.code, done.err) == (0, AS_ASKED)


def test_each_goal_that_a_command_selects_has_a_line(pair: RealRobots, desk: Desk) -> None:
    pending(pair, "a-goal")
    with Listener(pair.broker, "talk/reply/+/+/+") as answers:
        named, unnamed = desk.start("wait", "before-a-goal", "a-goal"), desk.start("wait")
        assert answers.find(lambda _: sum(b'"ok": true' in each.payload for each in answers.messages) == 4, PATIENCE)
    done = desk.run("cancel")
    assert sorted(done.out.splitlines()) == [
        f"{name} {rest}" for name in PAIR for rest in ("a-goal RECALLED 0", "before-a-goal PREEMPTED 0")
    ]
    assert (done.code, done.err) == (0, AS_ASKED)
    waited = desk.finish(named)
    assert sorted(waited.out.splitlines()) == [
        f"{name} {rest}" for name in PAIR for rest in ("a-goal RECALLED 6", "before-a-goal PREEMPTED 7")
    ]
    # Of a robot with several failures the first counts, in the order in which its goals were named.
    assert (waited.code, waited.err.splitlines()[-1]) == (7, "talk: 0 of 2 as asked")
    waited = desk.finish(unnamed)  # how goals ended that were not named is no failure
    assert (waited.code, waited.err, len(waited.out.splitlines())) == (0, AS_ASKED, 4)


def test_options_of_a_sentence_go_along(pair: RealRobots, desk: Desk) -> None:
    words = ["--key", "door", "--priority", "7", "--rate", "300", "--ttl", "60", "--", "hello"]
    request(pair, "say", key="charge", text="I have to charge")
    codes = [
        done.code
        for done in at_once(
            desk,
            ["say", "--wait", "--id", "with-all", *words],
            ["say", "--wait", "--id", "no-ttl", "--ttl", "0", "hello"],
            ["say", "--wait", "--voice", "nobody", "hello"],
        )
    ]
    assert codes == [0, 0, 5]
    for goal in pair.each(lambda each: each.talk.goal("with-all")):
        assert (goal["key"], goal["priority"], goal["text"]) == ("door", 7, "hello")
        assert 10 < goal["ttl"] <= 60
    assert [each["ttl"] for each in pair.each(lambda each: each.talk.goal("no-ttl"))] == [None, None]
    throttled = desk.run("say", "--wait", "--throttle", "60", "--key", "charge", "I have to charge")
    assert {(state, code) for _, state, code in told(throttled).values()} == {("REJECTED", 0)}
    assert (throttled.code, throttled.err) == (0, AS_ASKED)


def test_a_text_is_read_as_for_one_robot(pair: RealRobots, desk: Desk) -> None:
    text = "the door opens\nplease step back\n"
    done = desk.run("say", "--wait", "--id", "from-input", "-", stdin=text)
    assert_told(done, 0, alike(PAIR, "from-input", "SUCCEEDED", 0), "2 of 2 as asked")
    assert {each["text"] for each in pair.each(lambda each: each.talk.goal("from-input"))} == {text.rstrip()}
    done = desk.run("say", "--wait", "--id", "bytes", "caf\udce9 au lait")
    assert_told(done, 0, alike(PAIR, "bytes", "SUCCEEDED", 0), "2 of 2 as asked")
    assert done.err.splitlines()[0] == "talk: line 1, column 4: the byte 0xe9 is not UTF-8, and is not spoken"
    assert {each["text"] for each in pair.each(lambda each: each.talk.goal("bytes"))} == {"caf\ufffd au lait"}
    for done in (desk.run("say", "  "), desk.run("say", "-", stdin="\n")):
        assert {(state, code) for _, state, code in told(done).values()} == {("REJECTED", 5)}
        assert (done.code, "the text is empty" in done.err) == (5, True)


# Requests that are refused before anything is sent

NUMBER, ONE_ROBOT = "a number is a goal of one server", "is of one robot: name it"


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("say --lines", f"'talk say --lines' {ONE_ROBOT}"),
        ("say -f hello", f"'talk say --feedback' {ONE_ROBOT}"),
        ("say -wf hello", f"'talk say --feedback' {ONE_ROBOT}"),
        ("say -o - hello", "'talk say --output' is of this machine alone"),
        ("say", "TEXT is missing"),
        ("say --id 12 hello", "the id '12' is not one that a sender may choose"),
        ("say --rate 9 hello", "'9' is not a whole number from 80 to 450"),
        ("wait -f", f"'talk wait --feedback' {ONE_ROBOT}"),
        ("wait old 3", NUMBER),
        ("cancel 12", NUMBER),
        ("cancel --before 12", NUMBER),
        ("status 4", NUMBER),
        ("log", f"'talk log' {ONE_ROBOT}; 'talk fleet status' and 'talk fleet watch' show several"),
        ("watch", f"'talk watch' {ONE_ROBOT}"),
        ("voices", f"'talk voices' {ONE_ROBOT}"),
        ("doctor", f"'talk doctor' {ONE_ROBOT}"),
        ("serve", "'talk serve' is of this machine alone"),
        ("set --rate 9999", "'9999' is not a whole number from 80 to 450"),
        ("--socket /tmp/s --robot wh-* status", "leave out one of them"),
        ("--robot @a/b status", "no group can be called 'a/b'"),
        ("--robot a#* status", "the glob 'a#*' matches no robot's name"),
    ],
)
def test_a_request_that_several_robots_cannot_be_asked_is_a_usage_error(desk: Desk, line: str, words: str) -> None:
    done = desk.run(*([] if "--robot" in line else ["--robot", "wh-*"]), *line.split())
    assert (done.code, done.out, words in done.err) == (2, "", True), done


@pytest.mark.parametrize(
    ("line", "code", "words"),
    [
        (["status", ""], 2, "an id is empty"),
        (["wait", *(f"{'é' * 60}{number}" for number in range(500))], 2, "500 ids do not fit into one request"),
        (["status", "x" * 70], 8, "an id has at most 64 characters"),
    ],
    ids=["empty", "too many", "too long"],
)
def test_an_id_that_no_goal_can_have_is_refused_at_once(desk: Desk, line: list[str], code: int, words: str) -> None:
    done = desk.run(*line)
    assert (done.code, done.out, words in done.err) == (code, "", True), done


def test_a_name_is_preferred_to_a_variable_that_picks_several(desk: Desk) -> None:
    one, alone = at_once(desk, ["--robot", "wh-[!2]", "status"], ["--robot", "wh-1", "wait"])
    assert_told(one, 0, alike(["wh-1"], "-", "IDLE", 0), "1 of 1 as asked")
    assert (alone.code, alone.out, alone.err) == (0, "", "")
