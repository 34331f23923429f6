"""The examples on the page about asyncio."""

from __future__ import annotations

import asyncio
import json
import socket
import subprocess
import sys
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import pytest

from talkcli.aio import Client
from tests.fleet.many import RealRobots
from tests.readme.blocks import block, runs
from tests.readme.shell import wait_until
from tests.support.broker import Broker
from tests.support.loop import in_loop
from tests.support.ports import HOST, Port
from tests.support.surroundings import needs, needs_packages

if TYPE_CHECKING:
    from tests.readme.shell import Shell
    from tests.support.processes import Talk


def changed(name: str, *changes: tuple[str, str]) -> str:
    """Return an example with some of its values replaced."""
    code = block(name)
    for old, new in changes:
        assert code.count(old) == 1, (old, code)
        code = code.replace(old, new)
    return code


def run(code: str, env: dict[str, str]) -> list[str]:
    """Run a program, and return the lines that it prints."""
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, timeout=30, check=True)
    assert done.stderr == ""
    return done.stdout.splitlines()


def answers(port: int) -> bool:
    """Return whether a program listens on a port."""
    with socket.socket() as connection:
        return connection.connect_ex((HOST, port)) == 0


@runs("Use it from asyncio")
def test_the_first_example_prints_the_words(scripted: Talk) -> None:
    lines = run(block("Use it from asyncio"), scripted.env)
    assert [line.split(": ")[1] for line in lines] == ["follow", "me", "to", "the", "charger"]


@runs("Cancelled tasks: To end a goal together with a task")
@in_loop
async def test_asking_for_room_ends_with_the_wait(scripted: Talk) -> None:
    code = changed(
        "Cancelled tasks: To end a goal together with a task",
        ("Please step", "never-ends Please step"),
        ("30)", "0.1)"),
    )
    example: dict[str, Any] = {}
    exec(code, example)
    async with Client(scripted.socket) as talk:
        path_is_free = asyncio.Event()
        with pytest.raises(asyncio.TimeoutError):
            await example["ask_for_room"](talk, path_is_free)
        path_is_free.set()
        await example["ask_for_room"](talk, path_is_free)
        assert [goal.reason for goal in await talk.log(2)] == ["canceled"] * 2


@runs("A web endpoint that speaks", "A web endpoint that speaks #2")
def test_the_web_endpoint_answers_when_the_text_was_spoken(scripted_shell: Shell, scripted: Talk) -> None:
    needs("curl")
    name = "A web endpoint that speaks"
    with Port() as port, ExitStack() as stack:
        code = changed(name, ("8080", str(port.number)))
        server = stack.enter_context(subprocess.Popen([sys.executable, "-c", code], env=scripted.env))
        stack.callback(server.kill)
        wait_until(lambda: answers(port.number))
        done = scripted_shell.run(changed(f"{name} #2", ("8080", str(port.number)), ("curl", "curl --silent")))
        answer = json.loads(done.stdout)
        assert (answer["state"], scripted.goal(answer["id"])["text"]) == ("SUCCEEDED", "the coffee is ready")


@runs("A supervisor")
def test_a_supervisor_cancels_what_takes_too_long(scripted: Talk) -> None:
    code = changed("A supervisor", ("please hold on", "never-ends hold on"), ("seconds=5", "seconds=2"))
    *first, last = run(code, scripted.env)
    assert first == ["the doors are closing: SUCCEEDED", "never-ends hold on: PREEMPTED"]
    # Both cancels are sent at the same time, so the last goal may just have begun.
    assert last in {f"the next stop is the market: {state}" for state in ("RECALLED", "PREEMPTED")}


@runs("A fleet")
def test_a_fleet_speaks_in_turn_and_together() -> None:
    needs_packages("paho")
    with Broker() as broker, RealRobots(broker, ["wh-1", "wh-2"], ["warehouse"]) as robots:
        lines = run(block("A fleet"), robots["wh-1"].talk.env | {"TALK_BROKER": broker.url})
    assert sorted(lines) == ["wh-1: SUCCEEDED", "wh-2: SUCCEEDED"]
