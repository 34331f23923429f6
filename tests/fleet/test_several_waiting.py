"""Commands to several robots that take a while: interrupted, out of time, without a reader, and on a terminal."""

from __future__ import annotations

import re
import shlex
import signal
import sys
import time
from typing import TYPE_CHECKING

import pytest

from tests.conformance.bareserve import TALK
from tests.fleet.many import alike, assert_told, at_once, request
from tests.fleet.robot import LONG
from tests.support.bridge import Desk
from tests.support.connection import PATIENCE
from tests.support.mqtt import Listener
from tests.support.terminal import Terminal
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from pathlib import Path

    from tests.conftest import MakeTalk
    from tests.fleet.conftest import MakeBridge
    from tests.fleet.many import RealRobots
    from tests.fleet.robot import Robot

PAIR = ["wh-1", "wh-2"]
#: A glob and a group that pick both.
PICKS = ("wh-*", "@warehouse")
#: Seconds in which it is told that a robot is offline, while others speak.
AT_ONCE = 1.0
#: The bytes that clear the count from a terminal's line.
WIPED = "\r\x1b[2K"


def await_state(pair: RealRobots, goal_id: str, state: str) -> None:
    pair.each(lambda each: each.talk.watcher.wait_for(goal_id, state))


def states(pair: RealRobots, goal_id: str) -> list[str]:
    """Return the state of this goal at each robot."""
    return [each["state"] for each in pair.each(lambda each: each.talk.goal(goal_id))]


@pytest.mark.parametrize("to", PICKS)
def test_ctrl_c_cancels_on_all_that_took_it(pair: RealRobots, desk: Desk, to: str) -> None:
    """One robot speaks the goal; at the other it waits behind another goal, which goes on."""
    before, goal = (f"{each}-{PICKS.index(to)}" for each in ("before", "interrupted"))
    assert pair["wh-2"].talk.request("say", id=before, text=LONG)["ok"]
    waiting = desk.start("--robot", to, "say", "--wait", "--id", goal, "--", LONG)
    pair["wh-1"].talk.watcher.wait_for(goal, "ACTIVE")
    pair["wh-2"].talk.watcher.wait_for(goal, "PENDING")
    waiting.send_signal(signal.SIGINT)
    done = desk.finish(waiting)
    wanted = {"wh-1": (goal, "PREEMPTED", 7), "wh-2": (goal, "RECALLED", 6)}
    assert_told(done, 130, wanted, "0 of 2 as asked")
    assert done.seconds < 1, "it waited for more than the silence of both"
    assert states(pair, goal) == ["PREEMPTED", "RECALLED"]
    assert pair["wh-2"].talk.goal(before)["state"] == "ACTIVE"


def test_ctrl_c_takes_nothing_from_a_robot_that_is_done(pair: RealRobots, desk: Desk) -> None:
    assert pair["wh-2"].talk.request("say", text=LONG)["ok"]
    waiting = desk.start("say", "--wait", "--id", "done-on-one", "hello")
    assert waiting.stdout
    assert waiting.stdout.readline() == "wh-1 done-on-one SUCCEEDED 0\n"
    waiting.send_signal(signal.SIGINT)
    done = desk.finish(waiting)
    assert (done.code, done.out) == (130, "wh-2 done-on-one RECALLED 6\n")
    assert done.err.splitlines()[-1] == "talk: 1 of 2 as asked"
    assert states(pair, "done-on-one") == ["SUCCEEDED", "RECALLED"]


def test_what_is_not_done_in_time_is_cancelled_with_124(pair: RealRobots, desk: Desk) -> None:
    """A goal of others that was waited for is left alone; a robot counts as asked if all its goals have ended."""
    request(pair, "say", id="over", text="length=0")
    request(pair, "say", id="in-front", text=LONG)
    await_state(pair, "in-front", "ACTIVE")
    late = ["--timeout", "0.6"]
    waited, by_glob, by_group = at_once(
        desk,
        ["wait", *late, "over", "in-front"],
        *(["--robot", to, "say", "--wait", *late, "--id", f"late-{PICKS.index(to)}", "hello"] for to in PICKS),
    )
    for done, goal in ((by_glob, "late-0"), (by_group, "late-1")):
        assert_told(done, 124, alike(PAIR, goal, "RECALLED", 6), "0 of 2 as asked")
        assert "talk: timed out after 0.6 s\n" in done.err
        assert states(pair, goal) == ["RECALLED"] * 2
    assert (waited.code, sorted(waited.out.splitlines())) == (124, [f"{name} over SUCCEEDED 0" for name in PAIR])
    assert waited.err == "talk: timed out after 0.6 s\ntalk: not done: wh-1, wh-2\ntalk: 0 of 2 as asked\n"
    assert states(pair, "in-front") == ["ACTIVE"] * 2


def test_an_interrupted_wait_leaves_the_goals_of_others_alone(pair: RealRobots, desk: Desk) -> None:
    request(pair, "say", id="others", text=LONG)
    with Listener(pair.broker, "talk/reply/+/+/+") as answers:
        waiting = desk.start("--robot", "@warehouse", "wait")
        assert answers.find(lambda _: sum(b'"ok": true' in each.payload for each in answers.messages) == 2, PATIENCE)
    waiting.send_signal(signal.SIGINT)
    done = desk.finish(waiting)
    assert (done.code, done.out, done.err) == (130, "", "talk: not done: wh-1, wh-2\ntalk: 0 of 2 as asked\n")
    assert states(pair, "others") == ["ACTIVE", "ACTIVE"]


def test_where_the_reader_of_the_output_goes_away_it_is_cancelled_with_141(pair: RealRobots, desk: Desk) -> None:
    waiting = desk.start("--robot", "@warehouse", "say", "--wait", "--id", "unread", "--", LONG)
    await_state(pair, "unread", "ACTIVE")
    assert waiting.stdout
    assert waiting.stderr
    waiting.stdout.close()
    assert waiting.wait(PATIENCE) == 141
    assert waiting.stderr.read().splitlines()[-1] == "talk: 0 of 2 as asked"
    assert states(pair, "unread") == ["PREEMPTED", "PREEMPTED"]


def test_a_sentence_is_spoken_although_nobody_reads_the_output(pair: RealRobots, desk: Desk) -> None:
    waiting = desk.start("say", "--id", "never-read", "hello")
    assert waiting.stdout
    waiting.stdout.close()
    assert waiting.wait(PATIENCE) in (0, 141)  # 141 if it tries to write
    assert pair.each(lambda each: each.talk.watcher.wait_for_terminal("never-read")) == ["SUCCEEDED"] * 2


def test_one_that_is_offline_is_told_at_once_and_never_speaks_it(
    robot: Robot, make_talk: MakeTalk, make_bridge: MakeBridge
) -> None:
    goals = {"*": "by-a-glob", "@all": "by-a-group"}
    talk = make_talk(scripted=True)
    late = make_bridge(talk, robot.broker, "late")
    with Listener(robot.broker, "talk/robot/late/presence") as listener, Desk(robot.broker) as somebody:
        assert late.terminate() == 0
        listener.await_message(lambda each: each.json["online"] is False)
        with limits():
            began = time.monotonic()
            waiting = [
                somebody.start("--robot", to, "say", "--wait", "--id", goal, "--", LONG) for to, goal in goals.items()
            ]
            for each in waiting:
                assert each.stdout
                assert each.stdout.readline() == "late - OFFLINE 3\n"
                assert_within(time.monotonic() - began, AT_ONCE, "that a robot is offline, while another speaks")
        late.start()
        late.await_online()
        for goal in goals.values():
            robot.talk.watcher.wait_for(goal, "PENDING")
        assert somebody.run("--robot", "anna", "cancel").code == 0
        assert [somebody.finish(each).code for each in waiting] == [13, 13]
        assert somebody.run("--robot", "late", "say", "--wait", "this alone").code == 0
    assert talk.watcher.texts("PENDING") == ["this alone"]


# Terminals


def test_a_terminal_counts_the_robots_that_are_done_and_is_left_clean(pair: RealRobots, desk: Desk) -> None:
    assert pair["wh-2"].talk.request("say", text=LONG)["ok"]
    command = [*TALK, "--robot", "@warehouse", "say", "--wait", "--id", "counted", "hello"]
    with Terminal(command, desk.env) as terminal:
        terminal.wait_for("\r0 of 2")
        terminal.wait_for("counted SUCCEEDED 0\n")
        terminal.wait_until(lambda screen: screen.last == "1 of 2")
        request(pair, "cancel")
        assert terminal.finish() == 6
    written = terminal.raw.decode()
    assert list(dict.fromkeys(re.findall(r"\r(\d of \d)", written))) == ["0 of 2", "1 of 2", "2 of 2"]
    assert terminal.screen.wraps == 0
    first, second, why, *_, summary, last = terminal.screen.lines
    assert (first, second) == ("wh-1 counted SUCCEEDED 0", "wh-2 counted RECALLED 6")
    assert why.startswith("talk: RECALLED: wh-2: counted: ")
    assert (summary, last) == ("talk: 1 of 2 as asked", "")


@pytest.mark.usefixtures("pair")
def test_the_count_is_shown_only_if_standard_error_is_a_terminal(desk: Desk, tmp_path: Path) -> None:
    command = shlex.join([sys.executable, "-m", "talkcli", "status"])
    cases = {
        f"{command} > {tmp_path}/out": True,
        f"{command} 2> {tmp_path}/err": False,
        f"{command} -q": False,
    }
    terminals = [(Terminal(["sh", "-c", each], desk.env), counts) for each, counts in cases.items()]
    for terminal, counts in terminals:
        assert terminal.finish() == 0
        assert (b"\r0 of" in terminal.raw, WIPED.encode() in terminal.raw) == (counts, counts)
    assert sorted((tmp_path / "out").read_text().splitlines()) == ["wh-1 - IDLE 0", "wh-2 - IDLE 0"]
    assert (tmp_path / "err").read_text() == "talk: 2 of 2 as asked\n"


def test_ctrl_c_on_a_terminal_leaves_no_count_behind(pair: RealRobots, desk: Desk) -> None:
    with Terminal([*TALK, "say", "--wait", "--id", "typed", "--", LONG], desk.env) as terminal:
        await_state(pair, "typed", "ACTIVE")
        terminal.wait_for("\r0 of 2")
        terminal.type(b"\x03")
        assert terminal.finish() == 130
    assert terminal.screen.lines[-2:] == ["talk: 0 of 2 as asked", ""]
    assert not [each for each in terminal.screen.lines if re.search(r"\d of 2$", each)]
