"""Commands that fail on some of several robots: the reasons, and the exit code."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING

import pytest

from talkcli.fleet.bridge.policy import ALLOWABLE_REQUESTS
from tests.fleet import publish
from tests.fleet.many import RealRobots, alike, assert_outcomes, at_once, objects, printed_outcomes, request
from tests.fleet.robot import LONG
from tests.support.bridge import Desk
from tests.support.broker import Broker
from tests.support.mqtt import Listener
from tests.support.ports import Port

if TYPE_CHECKING:
    from collections.abc import Iterator

BOTH, OFFLINE = ["wh-1", "wh-2"], [f"off-{number}" for number in range(1, 8)]
#: A glob and a group that select only these two robots.
SELECTIONS = ("wh-[12]", "@willing")
#: Characters of a text that is too long for a server, and of a text that is too long for a request.
TOO_LONG, FAR_TOO_LONG = 20_000, 70_000


@pytest.fixture(scope="module")
def broker() -> Iterator[Broker]:
    with Broker() as result:
        yield result


@pytest.fixture(scope="module")
def robots(broker: Broker) -> Iterator[RealRobots]:
    """Two robots that allow all requests, wh-3 that allows only `status`, wh-4 without a server, and seven offline."""
    all_allowed = ("--allow", ",".join(ALLOWABLE_REQUESTS))
    with (
        Listener(broker, "talk/robot/wh-4/presence") as publisher,
        RealRobots(broker, BOTH, ["willing", "day", "night"], all_allowed) as result,
        RealRobots(broker, ["wh-3"], ["day"], ("--allow", "status")),
        RealRobots(broker, ["wh-4"], ["lonely"]) as lonely,
    ):
        for name in OFFLINE:
            publish.presence(publisher, name, online=False, groups=["night"])
        lonely["wh-4"].talk.stop()
        publisher.await_message(lambda message: message.json["online"] and message.json["server"] is None)
        yield result


@pytest.fixture
def desk(broker: Broker, robots: RealRobots) -> Iterator[Desk]:
    """A desk. All goals are cancelled afterwards."""
    with Desk(broker) as result:
        yield result
    request(robots, "cancel")


def idle_or_failed(*names: str) -> dict[str, tuple[str, str, int]]:
    """Return the outcomes of a cancel if there are no goals."""
    kinds = {"wh-3": ("-", "REFUSED", 10), "wh-4": ("-", "NO_SERVER", 3)}
    kinds |= dict.fromkeys(OFFLINE, ("-", "OFFLINE", 3))
    return {name: kinds.get(name, ("-", "IDLE", 0)) for name in names}


#: A selection, its robots, the exit code, and the number of robots that succeed.
MIXED: list[tuple[str, list[str], int, int]] = [
    ("@night", [*BOTH, *OFFLINE], 3, 2),
    ("wh-[124]", [*BOTH, "wh-4"], 3, 2),
    ("@day", [*BOTH, "wh-3"], 10, 2),
    ("*", [*BOTH, "wh-3", "wh-4", *OFFLINE], 13, 2),
    ("@all", [*BOTH, "wh-3", "wh-4", *OFFLINE], 13, 2),
]


def test_different_failures_exit_with_13_and_equal_ones_with_their_code(desk: Desk) -> None:
    *plain, for_programs, quiet = at_once(
        desk,
        *(["--robot", to, "cancel"] for to, _, _, _ in MIXED),
        *(["--robot", "@all", form, "cancel"] for form in ("--json", "-q")),
    )
    for done, (_, names, code, count) in zip(plain, MIXED, strict=True):
        assert_outcomes(done, code, idle_or_failed(*names), f"{count} of {len(names)} robots succeeded")
    outcomes = {name: ("-", outcome["state"], outcome["exit_code"]) for name, outcome in objects(for_programs).items()}
    assert (for_programs.code, outcomes) == (13, idle_or_failed(*MIXED[-1][1]))
    assert (quiet.code, quiet.out, quiet.err) == (13, "", "")


#: A selection, one of its robots, the error code, and the error message.
WHY = [
    ("off-1*", "off-1", "no_server", "off-1 is offline, so nothing was sent"),
    ("@lonely", "wh-4", "no_server", "wh-4: no server found; tried: "),
    ("wh-[4]", "wh-4", "no_server", "wh-4 has no running talk server, so nothing was sent"),
    (
        "wh-[3]",
        "wh-3",
        "permission_denied",
        "wh-3: this robot's bridge does not allow pause requests; add pause to its --allow",
    ),
    (
        "@day",
        "wh-3",
        "permission_denied",
        "wh-3: this robot's bridge does not allow pause requests; add pause to its --allow",
    ),
]


def test_each_failure_has_a_readable_message_and_an_error_code(robots: RealRobots, desk: Desk) -> None:
    results = at_once(desk, *(["--robot", to, *form, "pause"] for form in ([], ["--json"]) for to, *_ in WHY))
    request(robots, "resume")
    for readable, as_json, (_, name, code, message) in zip(results, results[len(WHY) :], WHY, strict=False):
        error = objects(as_json)[name]["error"]
        assert (error["code"], message in error["message"]) == (code, True), error
        assert f": {name}: {message.removeprefix(f'{name}: ')}" in readable.err
        assert f"{name}: {name}: " not in readable.err
    reason, _ = desk.run("--robot", "off-*", "status").err.splitlines()
    assert re.fullmatch(
        r"talk: OFFLINE: (off-\d, ){4}off-\d and 2 more: off-\d is offline, so nothing was sent", reason
    )


def test_a_selection_without_robots_or_a_missing_broker_exits_with_3(desk: Desk, broker: Broker) -> None:
    selections = {"x*": "no robot matches 'x*'", "@nobody": "no robot is in the group 'nobody'"}
    lines = [["--robot", to, *command.split()] for to in selections for command in ("say hello", "set")]
    *plain, for_programs = at_once(desk, *lines, ["--robot", "@nobody", "--json", "cancel"])
    for line, done in zip(lines, plain, strict=True):
        assert (done.code, done.out) == (3, "")
        assert done.err.startswith(f"talk: {selections[line[1]]} at {broker.url}, so nothing was sent")
    error = json.loads(for_programs.err)["error"]
    assert (for_programs.code, for_programs.out, error["code"]) == (3, "", "no_server")
    with Port() as port, Desk(broker, port=port.number) as other_desk:
        done = other_desk.run("--robot", "*", "cancel")
    assert (done.code, done.out, "talk: can't connect to the broker at mqtt://" in done.err) == (3, "", True), done


def test_a_text_that_is_too_long_is_rejected_by_each_robot(robots: RealRobots, desk: Desk) -> None:
    for length in (TOO_LONG, FAR_TOO_LONG):
        for done in at_once(desk, *(["--robot", selection, "say", "--wait", "x" * length] for selection in SELECTIONS)):
            outcomes = {(name, state, code) for name, (_, state, code) in printed_outcomes(done).items()}
            assert outcomes == {(name, "REJECTED", 5) for name in BOTH}
            assert (done.code, f"{length:,} characters" in done.err) == (5, True)
    assert not [text for texts in robots.spoken().values() for text in texts if "xx" in text]


def test_an_unknown_goal_exits_with_8(robots: RealRobots, desk: Desk) -> None:
    assert robots["wh-1"].talk.run("say", "--wait", "--id", "only-on-one", "length=0").code == 0
    request(robots, "say", id="known", text=LONG)
    commands = ["wait nobodys", "status nobodys", "cancel nobodys"]
    *unknown, for_programs, known_to_one, known = at_once(
        desk,
        *(["--robot", to, *command.split()] for to in SELECTIONS for command in commands),
        ["--robot", SELECTIONS[0], "--json", "wait", "nobodys"],
        ["--robot", SELECTIONS[1], "status", "only-on-one"],
        ["--robot", SELECTIONS[0], "cancel", "known", "nobodys"],
    )
    for done in unknown:
        assert_outcomes(done, 8, alike(BOTH, "-", "UNKNOWN", 8), "0 of 2 robots succeeded")
    codes = [outcome["error"]["code"] for outcome in objects(for_programs).values()]
    assert (for_programs.code, codes) == (8, ["unknown_goal"] * 2)
    expected = {"wh-1": ("only-on-one", "SUCCEEDED", 0), "wh-2": ("-", "UNKNOWN", 8)}
    assert_outcomes(known_to_one, 8, expected, "1 of 2 robots succeeded")
    assert sorted(known.out.splitlines()) == [
        f"{name} {rest}" for name in BOTH for rest in ("- UNKNOWN 8", "known PREEMPTED 0")
    ]
    assert (known.code, known.err.splitlines()[-1]) == (8, "talk: 0 of 2 robots succeeded")


def test_the_exit_code_follows_from_the_state_of_the_goal(robots: RealRobots, desk: Desk) -> None:
    waiting = desk.start("--robot", SELECTIONS[0], "say", "--wait", "--id", "cancelled", "--", LONG)
    robots.each(lambda robot: robot.talk.watcher.wait_for("cancelled", "ACTIVE"))
    request(robots, "cancel")
    assert robots["wh-1"].talk.run("say", "--wait", "--id", "fails-on-one", "length=0").code == 0
    assert robots["wh-2"].talk.run("say", "--wait", "--id", "fails-on-one", "fail=engine_failed").code == 4
    fails, differs = at_once(
        desk,
        ["--robot", SELECTIONS[1], "say", "--wait", "--id", "fails", "--", "fail=engine_failed"],
        ["--robot", SELECTIONS[1], "wait", "fails-on-one"],
    )
    assert_outcomes(desk.finish(waiting), 7, alike(BOTH, "cancelled", "PREEMPTED", 7), "0 of 2 robots succeeded")
    assert_outcomes(fails, 4, alike(BOTH, "fails", "ABORTED", 4), "0 of 2 robots succeeded")
    assert "talk: ABORTED: " in fails.err
    expected = {"wh-1": ("fails-on-one", "SUCCEEDED", 0), "wh-2": ("fails-on-one", "ABORTED", 4)}
    assert_outcomes(differs, 4, expected, "1 of 2 robots succeeded")
