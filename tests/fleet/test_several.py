"""Commands to several robots, picked by a glob or a group: what is told of each, what is said, and what can't be."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest

from tests.fleet.many import RealRobots, alike, assert_told, at_once, objects, request, told
from tests.fleet.robot import LONG
from tests.support.bridge import Desk
from tests.support.connection import PATIENCE
from tests.support.mqtt import Listener

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from tests.conftest import MakeTalk
    from tests.fleet.conftest import MakeBridge
    from tests.support.broker import Broker

PAIR = ["wh-1", "wh-2"]
#: Whatever picks both.
BOTH = ("wh-*", "@warehouse", "@all")
AS_ASKED = "2 of 2 as asked"


@pytest.fixture
def desk(pair: RealRobots) -> Iterator[Desk]:
    """Somebody who names both by a glob."""
    with Desk(pair.broker, env={"TALK_ROBOT": "wh-*"}) as result:
        yield result


def nothing(_: RealRobots, __: str) -> None:
    """Leave the robots as they are."""


def said(pair: RealRobots, goal_id: str) -> None:
    """Have this goal spoken by both."""
    request(pair, "say", id=goal_id, text="length=0")
    pair.each(lambda each: each.talk.watcher.wait_for_terminal(goal_id))


def pending(pair: RealRobots, goal_id: str) -> None:
    """Have this goal wait on both, behind one that has no end."""
    request(pair, "say", id=f"before-{goal_id}", text=LONG)
    request(pair, "say", id=goal_id, text="length=0")


def begun(pair: RealRobots, goal_id: str) -> None:
    """Have this goal, which has no end, spoken by both, or wait for one that is."""
    request(pair, "say", id=goal_id, text=LONG)


def held(pair: RealRobots, goal_id: str) -> None:
    """Have such a goal held on both."""
    begun(pair, goal_id)
    request(pair, "pause")


@pytest.fixture
def tidy(pair: RealRobots) -> Iterator[None]:
    """Ends, once the test is over, what was still to be said."""
    yield
    request(pair, "resume")
    request(pair, "cancel")


#: A command, `{}` for a goal of its own; what is done before; the goal that is told, `{first}` where it is that of the
#: first command, and the state; what an object has besides.
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


@pytest.mark.usefixtures("tidy")
@pytest.mark.parametrize(
    ("command", "prepare", "goal", "state", "key"), COMMANDS, ids=[f"{row[0]}, {row[1].__name__}" for row in COMMANDS]
)
def test_a_robot_is_a_line_whoever_picks_it(
    pair: RealRobots,
    desk: Desk,
    command: str,
    prepare: Callable[[RealRobots, str], None],
    goal: str,
    state: str,
    key: str | None,
) -> None:
    forms = [[], [], [], ["--json"], ["--quiet"]]
    name = "-".join(re.findall("[a-z]+", f"{command} {prepare.__name__}"))
    goals = [f"{name}-{number}" for number in range(len(forms))]
    for each in goals:
        prepare(pair, each)
    picks = [["--robot", each] for each in BOTH] + [[], []]
    lines = [
        [*pick, *form, *command.format(each).split()] for pick, form, each in zip(picks, forms, goals, strict=True)
    ]
    *plain, for_programs, quiet = at_once(desk, *lines)
    for done, each in zip(plain, goals, strict=False):
        assert told(done) == alike(PAIR, goal.format(each, first=goals[0]), state, 0)
        assert (done.code, done.err) == (0, f"talk: {AS_ASKED}\n")
    assert (quiet.code, quiet.err) == (0, "")
    if command.startswith("status"):  # which was asked for nothing else
        assert told(quiet) == alike(PAIR, goal.format(goals[4], first=goals[0]), state, 0)
    else:
        assert quiet.out == ""
    found = objects(for_programs)
    assert (for_programs.code, for_programs.err, sorted(found)) == (0, f"talk: {AS_ASKED}\n", PAIR)
    for answer in found.values():
        assert (answer["exit_code"], answer["state"]) == (0, state)
        if answer.get("goal"):
            assert answer["goal"]["id"] == goal.format(goals[3], first=goals[0])
        assert {"goal", "status", "paused", "settings"} & answer.keys() - {"goal"} == ({key} if key else set()) - {
            "goal"
        }
        assert key is None or answer[key] is not None


def test_the_settings_of_each_robot_are_listed_under_its_name(pair: RealRobots, desk: Desk) -> None:
    request(pair, "set", rate=180)
    done, for_programs = at_once(desk, ["set"], ["--json", "set"])
    assert sorted(line.split() for line in done.out.splitlines() if "rate" in line) == [
        [name, "rate", "180"] for name in PAIR
    ]
    assert (done.code, done.err) == (0, f"talk: {AS_ASKED}\n")
    assert {name: each["settings"]["rate"] for name, each in objects(for_programs).items()} == dict.fromkeys(PAIR, 180)


@pytest.mark.usefixtures("tidy")
def test_each_goal_that_a_command_is_about_is_a_line(pair: RealRobots, desk: Desk) -> None:
    pending(pair, "a-goal")
    with Listener(pair.broker, "talk/reply/+/+/+") as answers:
        named, unnamed = desk.start("wait", "before-a-goal", "a-goal"), desk.start("wait")
        assert answers.find(lambda _: sum(b'"ok": true' in each.payload for each in answers.messages) == 4, PATIENCE)
    done = desk.run("cancel")
    assert sorted(done.out.splitlines()) == [
        f"{name} {rest}" for name in PAIR for rest in ("a-goal RECALLED 0", "before-a-goal PREEMPTED 0")
    ]
    assert (done.code, done.err) == (0, f"talk: {AS_ASKED}\n")
    waited = desk.finish(named)
    assert sorted(waited.out.splitlines()) == [
        f"{name} {rest}" for name in PAIR for rest in ("a-goal RECALLED 6", "before-a-goal PREEMPTED 7")
    ]
    # Of a robot with several failures the first counts, in the order in which its goals were named.
    assert (waited.code, waited.err.splitlines()[-1]) == (7, "talk: 0 of 2 as asked")
    waited = desk.finish(unnamed)  # how those ended that were not named is nobody's failure
    assert (waited.code, waited.err, len(waited.out.splitlines())) == (0, f"talk: {AS_ASKED}\n", 4)


# what is said


def test_a_sentence_has_one_id_on_all_and_a_ttl_of_ten_seconds(pair: RealRobots, desk: Desk) -> None:
    for done in at_once(desk, *(["--robot", to, "say", "--wait", "hello"] for to in BOTH)):
        (goal_id,) = {goal_id for goal_id, _, _ in told(done).values()}
        assert done.code == 0
        for name in PAIR:
            assert 5 < pair[name].talk.goal(goal_id)["ttl"] <= 10


def test_options_of_a_sentence_go_along(pair: RealRobots, desk: Desk) -> None:
    words = ["--key", "door", "--priority", "7", "--rate", "300", "--ttl", "60", "--", "hello"]
    for done in at_once(
        desk,
        ["say", "--wait", "--id", "with-all", *words],
        ["say", "--wait", "--id", "no-ttl", "--ttl", "0", "hello"],
        ["say", "--wait", "--id", "by-voice", "--voice", "nobody", "hello"],
    ):
        assert done.code == (5 if "nobody" in done.command else 0), done
    for goal in pair.each(lambda each: each.talk.goal("with-all")):
        assert (goal["key"], goal["priority"], goal["text"]) == ("door", 7, "hello")
        assert 10 < goal["ttl"] <= 60
    assert [each["ttl"] for each in pair.each(lambda each: each.talk.goal("no-ttl"))] == [None, None]


def test_what_was_said_before_with_the_same_id_is_not_said_again(pair: RealRobots, desk: Desk) -> None:
    words = ["say", "--wait", "--id", "only-once", "once is enough"]
    for done in at_once(desk, words, ["--robot", "@all", *words]):
        assert_told(done, 0, alike(PAIR, "only-once", "SUCCEEDED", 0), AS_ASKED)
    assert [texts.count("once is enough") for texts in pair.spoken().values()] == [1, 1]


def test_who_asks_for_silence_about_the_same_thing_gets_it(pair: RealRobots, desk: Desk) -> None:
    request(pair, "say", key="charge", text="I have to charge")
    done = desk.run("say", "--wait", "--throttle", "60", "--key", "charge", "I have to charge")
    assert {(state, code) for _, state, code in told(done).values()} == {("REJECTED", 0)}
    assert (done.code, done.err) == (0, f"talk: {AS_ASKED}\n")
    assert [texts.count("I have to charge") for texts in pair.spoken().values()] == [1, 1]


def test_a_text_comes_from_standard_input(pair: RealRobots, desk: Desk) -> None:
    text = "the door opens\nplease step back\n"
    done = desk.run("say", "--wait", "--id", "from-input", "-", stdin=text)
    assert_told(done, 0, alike(PAIR, "from-input", "SUCCEEDED", 0), AS_ASKED)
    assert [each["text"] for each in pair.each(lambda each: each.talk.goal("from-input"))] == [text.rstrip()] * 2


def test_a_text_that_is_empty_is_rejected(desk: Desk) -> None:
    for done in (*at_once(desk, ["say", ""], ["say", "  "]), desk.run("say", "-", stdin="\n")):
        assert {(state, code) for _, state, code in told(done).values()} == {("REJECTED", 5)}
        assert (done.code, "the text is empty" in done.err) == (5, True)


def test_bytes_that_are_no_text_are_told_of_and_not_spoken(pair: RealRobots, desk: Desk) -> None:
    done = desk.run("say", "--wait", "--id", "bytes", "caf\udce9 au lait")
    assert_told(done, 0, alike(PAIR, "bytes", "SUCCEEDED", 0), AS_ASKED)
    assert done.err.splitlines()[0] == "talk: line 1, column 4: the byte 0xe9 is not UTF-8, and is not spoken"
    assert {each["text"] for each in pair.each(lambda each: each.talk.goal("bytes"))} == {"caf\ufffd au lait"}


def test_robots_speak_with_their_own_engines(make_talk: MakeTalk, make_bridge: MakeBridge, broker: Broker) -> None:
    names = ["real-1", "real-2"]
    talks = [make_talk("--player", "null", "--rate", "450") for _ in names]
    for name, talk in zip(names, talks, strict=True):
        make_bridge(talk, broker, name)
    with Desk(broker) as somebody:
        done = somebody.run("--robot", "real-?", "say", "--wait", "--id", "aloud", "--voice", "de", "--", "guten Tag")
    assert_told(done, 0, alike(names, "aloud", "SUCCEEDED", 0), AS_ASKED)
    assert [each.goal("aloud")["voice"] for each in talks] == ["gmw/de", "gmw/de"]


# usage


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("say --lines", "'talk say --lines' is of one robot: name it"),
        ("say -f hello", "'talk say --feedback' is of one robot: name it"),
        ("say -wf hello", "'talk say --feedback' is of one robot: name it"),
        ("say -o - hello", "'talk say --output' is of this machine alone"),
        ("say", "TEXT is missing"),
        ("say --id 12 hello", "the id '12' is not one that a sender may choose"),
        ("say --rate 9 hello", "'9' is not a whole number from 80 to 450"),
        ("wait -f", "'talk wait --feedback' is of one robot: name it"),
        ("wait 3", "a number is a goal of one server"),
        ("wait old 3", "a number is a goal of one server"),
        ("cancel 12", "a number is a goal of one server"),
        ("cancel --before 12", "a number is a goal of one server"),
        ("status 4", "a number is a goal of one server"),
        ("log", "'talk log' is of one robot: name it; 'talk fleet status' and 'talk fleet watch' show several"),
        ("watch", "'talk watch' is of one robot: name it"),
        ("voices", "'talk voices' is of one robot: name it"),
        ("doctor", "'talk doctor' is of one robot: name it"),
        ("serve", "'talk serve' is of this machine alone"),
        ("set --rate 9999", "'9999' is not a whole number from 80 to 450"),
        ("--socket /tmp/s status", "leave out one of them"),
    ],
)
def test_what_can_not_be_asked_of_several_is_a_usage_error(desk: Desk, line: str, words: str) -> None:
    for done in at_once(desk, *(["--robot", to, *line.split()] for to in BOTH[:2])):
        assert (done.code, done.out, words in done.err) == (2, "", True), done


@pytest.mark.parametrize(
    ("line", "code", "words"),
    [
        (["wait", ""], 2, "an id is empty"),
        (["cancel", "old", ""], 2, "an id is empty"),
        (["status", ""], 2, "an id is empty"),
        (["cancel", "--key", "k" * 65], 2, "a key has 1 to 64 characters, this one has 65"),
        (["wait", *(f"{'é' * 60}{number}" for number in range(500))], 2, "500 ids do not fit into one request"),
        (["status", "x" * 70], 8, "an id has at most 64 characters"),
    ],
    ids=["wait", "cancel", "status", "key", "too many", "too long"],
)
def test_goals_that_there_can_not_be_are_told_at_once(desk: Desk, line: list[str], code: int, words: str) -> None:
    done = desk.run(*line)
    assert (done.code, done.out, words in done.err) == (code, "", True), done


@pytest.mark.parametrize(
    ("to", "words"),
    [
        ("@", "no group can be called ''"),
        ("@a/b", "no group can be called 'a/b'"),
        ("@a*", "no group can be called 'a*'"),
        ("@@a", "no group can be called '@a'"),
        ("a#*", "the glob 'a#*' matches no robot's name"),
        ("wh-[1", "the glob 'wh-[1' matches no robot's name"),
        ("a b*", "the glob 'a b*' matches no robot's name"),
    ],
)
def test_names_that_can_not_be_are_a_usage_error(pair: RealRobots, to: str, words: str) -> None:
    with Desk(pair.broker) as somebody, Desk(pair.broker, env={"TALK_ROBOT": to}) as another:
        for done in (somebody.run("--robot", to, "status"), another.run("status")):
            assert (done.code, done.out, words in done.err) == (2, "", True), done


def test_a_variable_that_picks_several_is_looked_at_as_what_is_typed(pair: RealRobots) -> None:
    with Desk(pair.broker, env={"TALK_ROBOT": "@warehouse"}) as somebody:
        for line in ("say --lines", "watch", "wait 3"):
            assert somebody.run(*line.split()).code == 2
        one, alone = at_once(somebody, ["--robot", "wh-[!2]", "status"], ["--robot", "wh-1", "wait"])
    assert_told(one, 0, alike(["wh-1"], "-", "IDLE", 0), "1 of 1 as asked")
    assert (alone.code, alone.out, alone.err) == (0, "", "")
