"""Commands to several robots of which some do not do it: why, beside each, and the exit code for all of them."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING

import pytest

from talkcli.fleet.policy import ASKABLE
from tests.fleet import told as robots_told
from tests.fleet.asker import Asker
from tests.fleet.many import RealRobots, alike, assert_told, at_once, objects, request, told
from tests.fleet.robot import LONG
from tests.support.bridge import Desk
from tests.support.broker import Broker
from tests.support.connection import PATIENCE
from tests.support.mqtt import Listener
from tests.support.ports import Port

if TYPE_CHECKING:
    from collections.abc import Iterator

BOTH, OFFLINE = ["wh-1", "wh-2"], ["off-1", "off-2", "off-3", "off-4", "off-5", "off-6", "off-7"]
#: What picks both, and nobody else.
PICKS = ("wh-[12]", "@willing")
#: Goals that may be pending from afar, and characters of a text that no server takes, and that no request can hold.
PENDING, TOO_LONG, FAR_TOO_LONG = 20, 20_000, 70_000


@pytest.fixture(scope="module")
def broker() -> Iterator[Broker]:
    with Broker() as result:
        yield result


@pytest.fixture(scope="module")
def robots(broker: Broker) -> Iterator[RealRobots]:
    """Two of which all may be asked; besides them one that allows little, wh-3, one without a server, wh-4, and
    seven that are offline.
    """
    all_allowed = ("--allow", ",".join(ASKABLE))
    with (
        Listener(broker, "talk/robot/wh-4/presence") as publisher,
        RealRobots(broker, BOTH, ["willing", "day", "night"], all_allowed) as result,
        RealRobots(broker, ["wh-3"], ["day"], ("--allow", "status")),
        RealRobots(broker, ["wh-4"], ["lonely"]) as lonely,
    ):
        for each in OFFLINE:
            robots_told.presence(publisher, each, online=False, groups=["night"])
        lonely["wh-4"].talk.stop()
        publisher.await_message(lambda each: each.json["online"] and each.json["server"] is None)
        yield result


@pytest.fixture
def desk(broker: Broker, robots: RealRobots) -> Iterator[Desk]:
    """Somebody who asks; what they have left to be said is cancelled in the end."""
    with Desk(broker) as result:
        yield result
    request(robots, "cancel")


def asked_in_vain(*names: str) -> dict[str, tuple[str, str, int]]:
    """Return what is told of these where a cancel finds nothing to be cancelled."""
    kinds = {"wh-3": ("-", "REFUSED", 10), "wh-4": ("-", "NO_SERVER", 3)}
    kinds |= dict.fromkeys(OFFLINE, ("-", "OFFLINE", 3))
    return {each: kinds.get(each, ("-", "IDLE", 0)) for each in names}


#: What is picked, who that is, the exit code of all of them, and how many do as they are asked.
MIXED: list[tuple[str, list[str], int, int]] = [
    ("off-*", OFFLINE, 3, 0),
    ("@night", [*BOTH, *OFFLINE], 3, 2),
    ("wh-[4]", ["wh-4"], 3, 0),
    ("@lonely", ["wh-4"], 3, 0),
    ("wh-[124]", [*BOTH, "wh-4"], 3, 2),
    ("wh-[123]", [*BOTH, "wh-3"], 10, 2),
    ("@day", [*BOTH, "wh-3"], 10, 2),
    ("wh-?", [*BOTH, "wh-3", "wh-4"], 13, 2),
    ("*", [*BOTH, "wh-3", "wh-4", *OFFLINE], 13, 2),
    ("@all", [*BOTH, "wh-3", "wh-4", *OFFLINE], 13, 2),
]


def test_failures_alike_are_the_exit_code_and_others_make_it_13(desk: Desk) -> None:
    found = at_once(desk, *(["--robot", to, "cancel"] for to, _, _, _ in MIXED))
    for done, (_, names, code, count) in zip(found, MIXED, strict=True):
        assert_told(done, code, asked_in_vain(*names), f"{count} of {len(names)} as asked")


def test_programs_and_who_wants_no_words_are_told_the_same(desk: Desk) -> None:
    _, names, code, _ = MIXED[-1]
    for_programs, quiet = at_once(desk, *(["--robot", "@all", form, "cancel"] for form in ("--json", "-q")))
    found = {name: ("-", each["state"], each["exit_code"]) for name, each in objects(for_programs).items()}
    assert (for_programs.code, found) == (code, asked_in_vain(*names))
    assert (quiet.code, quiet.out, quiet.err) == (code, "", "")


#: What is picked, one of those, and why it does nothing.
WHY = [
    ("off-1*", "off-1", "no_server", "off-1 is offline: nothing was sent"),
    ("@lonely", "wh-4", "no_server", "wh-4: no server, tried: "),
    ("wh-[4]", "wh-4", "no_server", "wh-4 has no talk server at this moment: nothing was sent"),
    ("wh-[3]", "wh-3", "permission_denied", "wh-3: this robot takes no pause from afar: see its --allow"),
    ("@day", "wh-3", "permission_denied", "wh-3: this robot takes no pause from afar: see its --allow"),
]


def test_why_is_told_in_words_and_by_a_code(robots: RealRobots, desk: Desk) -> None:
    found = at_once(desk, *(["--robot", to, *form, "pause"] for form in ([], ["--json"]) for to, *_ in WHY))
    request(robots, "resume")
    for told_so, told_in_json, (_, name, code, words) in zip(found, found[len(WHY) :], WHY, strict=False):
        error = objects(told_in_json)[name]["error"]
        assert (error["code"], words in error["message"]) == (code, True), error
        assert f": {name}: {words.removeprefix(f'{name}: ')}" in told_so.err
        assert f"{name}: {name}: " not in told_so.err


def test_of_many_that_fail_alike_five_are_named(desk: Desk) -> None:
    reason, _ = desk.run("--robot", "off-*", "status").err.splitlines()
    assert re.fullmatch(r"talk: OFFLINE: (off-\d, ){4}off-\d and 2 more: off-\d is offline: nothing was sent", reason)


def test_where_nobody_is_picked_it_says_so_with_3(desk: Desk, broker: Broker) -> None:
    picks = {"x*": "no robot matches 'x*'", "@nobody": "no robot is in the group 'nobody'"}
    commands = ["say hello", "cancel", "wait", "status", "pause", "resume", "set"]
    lines = [["--robot", to, *each.split()] for to in picks for each in commands]
    for line, done in zip(lines, at_once(desk, *lines), strict=True):
        assert (done.code, done.out) == (3, "")
        assert done.err.startswith(f"talk: {picks[line[1]]} at {broker.url}: nothing was sent")
    done = desk.run("--robot", "@nobody", "--json", "cancel")
    assert (done.code, done.out, json.loads(done.err)["error"]["code"]) == (3, "", "no_server")


def test_without_a_broker_it_is_3(broker: Broker) -> None:
    with Port() as port, Desk(broker, port=port.number) as somebody:
        for done in at_once(somebody, *(["--robot", each, "cancel"] for each in PICKS)):
            assert (done.code, done.out, "talk: no broker at mqtt://" in done.err) == (3, "", True), done


# what a robot's server refuses


def test_a_text_that_is_too_long_is_rejected_by_each(robots: RealRobots, desk: Desk) -> None:
    for length in (TOO_LONG, FAR_TOO_LONG):
        for done in at_once(desk, *(["--robot", each, "say", "--wait", "x" * length] for each in PICKS)):
            assert {(name, state, code) for name, (_, state, code) in told(done).items()} == {
                (name, "REJECTED", 5) for name in BOTH
            }
            assert (done.code, f"the text has {length:,} characters" in done.err) == (5, True)
    assert not [text for texts in robots.spoken().values() for text in texts if "xx" in text]


def test_a_queue_that_is_full_rejects_it(robots: RealRobots, desk: Desk, broker: Broker) -> None:
    request(robots, "say", text=LONG)
    with Asker(broker) as bob:
        for number in range(PENDING):
            bob.send({"seq": number, "request": "say", "text": "length=0"}, to="talk/group/willing")
        assert bob.listener.find(lambda _: sum("ok" in each for each in bob.lines) == len(BOTH) * PENDING, PATIENCE)
    for done in at_once(desk, *(["--robot", each, "--json", "say", "hello"] for each in PICKS)):
        assert (done.code, done.err.splitlines()[-1]) == (5, "talk: 0 of 2 as asked")
        assert [each["goal"]["reason"] for each in objects(done).values()] == ["queue_full"] * 2


def test_a_goal_that_nobody_knows_makes_it_8(desk: Desk) -> None:
    commands = ["wait nobodys", "status nobodys", "cancel nobodys"]
    lines = [["--robot", to, *each.split()] for to in PICKS for each in commands]
    *plain, for_programs = at_once(desk, *lines, ["--robot", PICKS[0], "--json", "wait", "nobodys"])
    for done in plain:
        assert_told(done, 8, alike(BOTH, "-", "UNKNOWN", 8), "0 of 2 as asked")
    assert (for_programs.code, [each["error"]["code"] for each in objects(for_programs).values()]) == (
        8,
        ["unknown_goal"] * 2,
    )


def test_of_goals_known_and_unknown_the_known_are_cancelled(robots: RealRobots, desk: Desk) -> None:
    request(robots, "say", id="known", text=LONG)
    done = desk.run("--robot", PICKS[0], "cancel", "known", "nobodys")
    assert sorted(done.out.splitlines()) == [
        f"{name} {rest}" for name in BOTH for rest in ("- UNKNOWN 8", "known PREEMPTED 0")
    ]
    assert (done.code, done.err.splitlines()[-1]) == (8, "talk: 0 of 2 as asked")


def test_a_goal_that_only_one_robot_knows_is_told_of_that_one(robots: RealRobots, desk: Desk) -> None:
    assert robots["wh-1"].talk.run("say", "--wait", "--id", "mine-alone", "length=0").code == 0
    wanted = {"wh-1": ("mine-alone", "SUCCEEDED", 0), "wh-2": ("-", "UNKNOWN", 8)}
    assert_told(desk.run("--robot", PICKS[1], "status", "mine-alone"), 8, wanted, "1 of 2 as asked")


def test_how_a_sentence_ended_is_the_exit_code(robots: RealRobots, desk: Desk) -> None:
    waiting = desk.start("--robot", PICKS[0], "say", "--wait", "--id", "cancelled", "--", LONG)
    robots.each(lambda each: each.talk.watcher.wait_for("cancelled", "ACTIVE"))
    request(robots, "cancel")
    assert robots["wh-1"].talk.run("say", "--wait", "--id", "fails-on-one", "length=0").code == 0
    assert robots["wh-2"].talk.run("say", "--wait", "--id", "fails-on-one", "fail=engine_failed").code == 4
    fails, differs = at_once(
        desk,
        ["--robot", PICKS[1], "say", "--wait", "--id", "fails", "--", "fail=engine_failed"],
        ["--robot", PICKS[1], "wait", "fails-on-one"],
    )
    assert_told(desk.finish(waiting), 7, alike(BOTH, "cancelled", "PREEMPTED", 7), "0 of 2 as asked")
    assert_told(fails, 4, alike(BOTH, "fails", "ABORTED", 4), "0 of 2 as asked")
    assert "talk: ABORTED: " in fails.err
    wanted = {"wh-1": ("fails-on-one", "SUCCEEDED", 0), "wh-2": ("fails-on-one", "ABORTED", 4)}
    assert_told(differs, 4, wanted, "1 of 2 as asked")
