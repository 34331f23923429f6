"""Row 44: messages of the engine about wrong goals, or out of order, are refused and change nothing."""

from __future__ import annotations

import itertools
import os
from typing import TYPE_CHECKING

import pytest

from tests.conformance.checks import count_ends, states

if TYPE_CHECKING:
    import pathlib

    from tests.conftest import MakeTalk
    from tests.support.processes import Talk

ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))

#: An engine process that sends the messages in the text of a goal, like "word=1", "ended=failed:2" or "raw=…". They are
#: about the current goal, or about the goal with the number after a colon. "stop?" waits for a command.
ENGINE = """
import os, sys
sys.path.insert(0, {root!r})
from talkcli.engine import protocol

def send(event):
    os.write(0, protocol.encode(event))

def run(word, goal):
    event, _, goal_id = word.partition(":")
    name, _, value = event.partition("=")
    goal_id = goal.id.rpartition("-")[0] + "-" + goal_id if goal_id else goal.id
    if name == "started":
        send(protocol.Started(goal_id))
    elif name == "alive":
        send(protocol.Alive(goal_id))
    elif name == "ready":
        send(protocol.Ready("scripted", "again", "none"))
    elif name == "word":
        send(protocol.Word(goal_id, 0, int(value), 1, 0.0))
    elif name == "ended":
        send(protocol.Ended(goal_id, value, "engine_failed", "out of order", 1.0))
    elif name == "raw":
        os.write(0, value.encode() + b"\\n")
    elif name == "stop?":
        assert isinstance(next(arriving), protocol.Stop)

commands = (protocol.decode(line.rstrip(b"\\n"), protocol.COMMAND_CLASSES) for line in open(0, "rb", closefd=False))
arriving = (command for command in commands if not isinstance(command, protocol.NextGoal))
for command in arriving:
    if isinstance(command, protocol.Configure):
        send(protocol.Ready("scripted", None, None))
        send(protocol.VoiceList(()))
    elif isinstance(command, protocol.Speak):
        for word in command.text.split():
            run(word, command)
"""
SERVE = """
import sys
sys.path.insert(0, {root!r})
from talkcli.cli import main
from talkcli.engine.parent import process

process.engine_command = lambda: [sys.executable, {engine!r}]
sys.argv = ["talk", "serve", *sys.argv[1:]]
main()
"""


@pytest.fixture
def talk(make_talk: MakeTalk, tmp_path: pathlib.Path) -> Talk:
    engine, serve = tmp_path / "engine.py", tmp_path / "serve.py"
    engine.write_text(ENGINE.format(root=ROOT))
    serve.write_text(SERVE.format(root=ROOT, engine=str(engine)))
    return make_talk(program=str(serve))


def test_row_44_engine_messages_for_inactive_goals_change_nothing(talk: Talk) -> None:
    others = ("1", "3", "99")  # an ended, a pending and an unknown goal
    strange = " ".join(
        f"started:{other} alive:{other} word=7:{other} ended={outcome}:{other}"
        for other, outcome in itertools.product(others, ("completed", "failed", "stopped"))
    )
    with talk.connect() as wire:
        texts = ["ended=completed", f"{strange} started word=3 stop?", "started ended=completed"]
        first, active, pending = (wire.request("say", text=text)["goal"]["id"] for text in texts)
        talk.watcher.wait_for_word(active)
        assert talk.goal(first)["state"] == "SUCCEEDED"
        assert [talk.goal(goal_id)["state"] for goal_id in (active, pending)] == ["ACTIVE", "PENDING"]
        assert talk.goal(active)["spoken"] == "sta"
        assert wire.request("cancel", ids=[pending])["ok"]
    assert states(talk, first) == ["PENDING", "ACTIVE", "SUCCEEDED"]
    assert states(talk, pending) == ["PENDING", "RECALLED"]
    assert talk.watcher.words(first) == talk.watcher.words(pending) == []


def test_row_44_engine_messages_after_the_end_change_nothing(talk: Talk) -> None:
    with talk.connect() as wire:
        text = "started word=5 ended=completed ended=completed ended=stopped word=7 started alive ended=failed ready"
        goal_id = wire.request("say", text=text, wait=True)["goal"]["id"]
        goal = wire.receive_event("result")["goal"]
        following = wire.request("say", text="started ended=completed", wait=True)["goal"]["id"]
        assert wire.receive_event("result")["goal"]["state"] == "SUCCEEDED"
    assert goal["state"] == "SUCCEEDED"
    assert talk.goal(goal_id) == goal
    assert len(talk.watcher.words(goal_id)) == 1
    assert count_ends(talk, goal_id, following) == [1, 1]


def test_row_44_a_malformed_engine_message_affects_no_other_goal(talk: Talk) -> None:
    lines = ("no-json", "[]", '{"kind":"Word","id":7}')
    with talk.connect() as wire:
        for line in lines:
            goal_id = wire.request("say", text=f"started raw={line} ended=completed", wait=True)["goal"]["id"]
            assert wire.receive_event("result", timeout=10)["goal"]["state"] in {"SUCCEEDED", "ABORTED"}
            following = wire.request("say", text="started ended=completed", wait=True)["goal"]["id"]
            assert wire.receive_event("result", timeout=10)["goal"]["state"] == "SUCCEEDED"
            assert count_ends(talk, goal_id, following) == [1, 1]
