"""Sessions of remote clients: how they end, and their limits. The server is real, and there is no broker."""

from __future__ import annotations

import asyncio
import gc
import json
import socket
import threading
import time
from typing import TYPE_CHECKING

import pytest

from talkcli import __version__
from talkcli.goals.goal import Goal
from talkcli.protocol.events import greeting
from talkcli.protocol.lines import encode
from tests.fleet.conftest import in_loop
from tests.fleet.without_broker import SessionsWithoutBroker
from tests.support.surroundings import short_directory

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.conftest import MakeTalk
    from tests.support.processes import Talk

#: Seconds without a request after which a client's session ends.
GONE = 90.0


@pytest.fixture
def talk(make_talk: MakeTalk) -> Talk:
    """A paused server without sound."""
    talk = make_talk("--player", "null")
    talk.request("pause")
    return talk


@pytest.fixture
def pass_time(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """A function that advances the clock of the running event loop."""
    passed = 0.0

    def move(seconds: float) -> None:
        nonlocal passed
        passed += seconds
        monkeypatch.setattr(asyncio.get_running_loop(), "time", lambda: time.monotonic() + passed)

    return move


def say(number: int, **more: object) -> dict[str, object]:
    return {"seq": number, "request": "say", "text": f"sentence {number}", **more}


async def await_no_sessions(talk: Talk) -> None:
    """Wait until only the watcher and this request are clients. The server doesn't report that a client has left."""
    end = time.monotonic() + 5
    while talk.request("status")["server"]["clients"] > 2:
        assert time.monotonic() < end, "a connection to the server is kept"
        await asyncio.sleep(0.01)


@pytest.mark.parametrize("waits_for", ["room", "a result", "events"])
@in_loop
async def test_a_waiting_remote_client_is_gone_after_90_s_of_silence(
    talk: Talk, pass_time: Callable[[float], None], waits_for: str
) -> None:
    anna = SessionsWithoutBroker(talk.socket)
    if waits_for == "room":
        for number in range(20):
            await anna.ask(say(number), "s2")
        anna.post(say(100, patient=True, wait=True, id="patient"))
        await anna.ask({"seq": 101, "request": "hello"})
        assert [request.seq for request, _, _ in anna.sessions.waiting] == [100]
    elif waits_for == "a result":
        await anna.ask(say(100, wait=True))
    else:
        await anna.ask({"seq": 100, "request": "watch"})
    for _ in range(8):  # lines sent to the client don't prove that it is alive
        pass_time(11)
        anna.sessions.tick()
        if waits_for == "events":
            await anna.ask(say(1), "s3")
    assert not [line for line in anna.lines() if line.get("event") == "gone"]
    pass_time(GONE - 88 + 0.1)
    anna.sessions.tick()
    assert "must send hello every 30 s" in anna.lines()[-1]["message"]
    assert anna.sessions.waiting == []
    before = len(anna.lines())
    await anna.ask({"seq": 1, "request": "cancel"}, "s4")
    assert len(anna.lines()) == before
    anna.sessions.end_all()


@in_loop
async def test_hello_keeps_the_session_of_a_remote_client(talk: Talk, pass_time: Callable[[float], None]) -> None:
    anna = SessionsWithoutBroker(talk.socket)
    goal = await anna.ask(say(1, wait=True))
    for number in range(2, 8):
        pass_time(30)
        anna.sessions.tick()
        await anna.ask({"seq": number, "request": "hello"})
    await anna.ask({"seq": 10, "request": "cancel"})
    ended = await anna.line(lambda line: line.get("event") == "result")
    assert ended["goal"]["id"] == goal["goal"]["id"]
    anna.sessions.end_all()


@in_loop
async def test_an_idle_remote_client_loses_its_session_silently(talk: Talk, pass_time: Callable[[float], None]) -> None:
    anna = SessionsWithoutBroker(talk.socket)
    await anna.ask({"seq": 1, "request": "status"})
    lines = anna.lines()
    pass_time(GONE + 0.1)
    anna.sessions.tick()
    await await_no_sessions(talk)
    assert anna.lines() == lines


@in_loop
async def test_dry_runs_do_not_count_as_waiting_goals(talk: Talk) -> None:
    anna = SessionsWithoutBroker(talk.socket)
    for number in range(30):
        reply = await anna.ask(say(number, dry_run=True, id=f"dry-{number}"), "s1")
        assert (reply["goal"]["state"], reply["goal"]["id"]) == ("PENDING", "")
    assert (await anna.ask(say(30), "s1"))["goal"]["state"] == "PENDING"
    assert talk.request("status")["server"]["pending"] == 1
    anna.post(b"", "s1")
    await await_no_sessions(talk)


@in_loop
async def test_only_goals_that_wait_for_room_are_dropped_by_a_goodbye(talk: Talk) -> None:
    """With and without a connection to the server. A client that returns after a goodbye gets answers again."""
    anna = SessionsWithoutBroker(talk.socket)
    await anna.ask({"seq": 1, "request": "hello"}, "s2")
    for session in ("s1", "s2", "s3"):
        anna.post(say(2, id=f"of-{session}"), session)
        if session != "s2":  # this session is connected, so the server would accept the goal at once
            anna.post(say(3, id=f"of-{session}-patient", patient=True), session)
        anna.post(b"", session)
    assert (await anna.ask({"seq": 4, "request": "hello"}, "s3"))["ok"]
    await anna.ask(say(5, id="last"), "s3")
    anna.post(b"", "s3")
    await await_no_sessions(talk)
    with talk.connect() as wire:
        wire.request("status")
        assert sorted(item["pending"]["id"] for item in wire.items) == ["last", "of-s1", "of-s2", "of-s3"]
    assert anna.lines("s1") == []


@in_loop
async def test_a_cancel_ends_the_longest_silent_session(talk: Talk, pass_time: Callable[[float], None]) -> None:
    anna = SessionsWithoutBroker(talk.socket)
    for number in range(32):
        await anna.ask({"seq": 1, "request": "watch"}, f"w{number}")
        pass_time(0.1)
    await anna.ask({"seq": 2, "request": "hello"}, "w0")
    assert (await anna.ask({"seq": 3, "request": "log"}, "another"))["error"]["code"] == "busy"
    assert (await anna.ask({"seq": 3, "request": "cancel"}, "urgent"))["ok"]
    await anna.ask(say(4), "w0")
    for number in range(32):
        gone = [line for line in anna.lines(f"w{number}") if line.get("event") == "gone"]
        assert bool(gone) == (number == 1), number
    assert (await anna.ask({"seq": 4, "request": "status"}, "urgent"))["ok"]  # in its existing session
    assert (await anna.ask({"seq": 5, "request": "log"}, "another"))["ok"]  # that session waits for nothing now
    await anna.ask({"seq": 5, "request": "cancel"}, "w0")
    anna.sessions.end_all()


@in_loop
async def test_a_user_has_8_sessions_while_another_user_needs_a_place(
    talk: Talk, pass_time: Callable[[float], None]
) -> None:
    anna = SessionsWithoutBroker(talk.socket)
    for number in range(32):
        await anna.ask({"seq": 1, "request": "watch"}, f"w{number}")
        pass_time(0.1)
    for number in range(10):
        assert (await anna.ask(say(2, wait=True), f"olga/s{number}"))["ok"] == (number < 8)
    assert (await anna.ask({"seq": 2, "request": "log"}, "another"))["error"]["code"] == "busy"
    left = [number for number in range(32) if not any(line.get("event") == "gone" for line in anna.lines(f"w{number}"))]
    assert left == [*range(8, 32)]
    anna.sessions.end_all()


@in_loop
async def test_waiting_goals_of_a_user_do_not_delay_other_users(talk: Talk) -> None:
    anna = SessionsWithoutBroker(talk.socket)
    for number in range(40):
        anna.post(say(number, patient=True))
    assert [(await anna.ask(say(number), "olga/s1"))["goal"]["state"] for number in range(2)] == ["PENDING"] * 2
    anna.post(say(2, patient=True), "olga/s1")
    assert (await anna.line(lambda line: line.get("seq") == 2, "olga/s1"))["goal"]["state"] == "PENDING"
    anna.sessions.end_all()


@in_loop
async def test_clients_of_a_hung_server_take_32_connections_and_no_threads() -> None:
    """A closed connection stays in the backlog. A client that leaves before its turn is never connected."""
    with short_directory() as directory, socket.socket(socket.AF_UNIX) as listening:
        listening.bind(f"{directory}/s")
        listening.listen(256)
        listening.settimeout(5)
        anna = SessionsWithoutBroker(f"{directory}/s")
        before = threading.active_count()
        for turn in range(100):
            for number in range(3):
                anna.post({"seq": 1, "request": "status"}, f"user-{turn}/s{number}")
                await asyncio.sleep(0)  # so that the session starts to connect
                anna.post(b"", f"user-{turn}/s{number}")
        await asyncio.sleep(0)
        assert threading.active_count() == before
        for _ in range(32):
            listening.accept()[0].close()
        anna.post({"seq": 2, "request": "status"})
        (await asyncio.to_thread(listening.accept))[0].close()
        answer = await anna.line(lambda line: line.get("seq") == 2)
        assert answer["error"]["code"] == "no_server"
        listening.setblocking(False)
        with pytest.raises(BlockingIOError):
            listening.accept()


@in_loop
async def test_an_ended_session_keeps_its_slot_until_the_server_greets() -> None:
    with short_directory() as directory, socket.socket(socket.AF_UNIX) as listening:
        listening.bind(f"{directory}/s")
        listening.listen()
        listening.settimeout(5)
        anna = SessionsWithoutBroker(f"{directory}/s")
        slots = anna.sessions.dialing = asyncio.Semaphore(1)
        anna.post({"seq": 1, "request": "log"})
        with (await asyncio.to_thread(listening.accept))[0] as server, server.makefile("rb") as file:
            anna.post(b"")
            await asyncio.sleep(0.1)
            assert slots.locked()
            server.sendall(encode(greeting(__version__, 7, "a1b2")))
            await asyncio.wait_for(slots.acquire(), 5)
            assert await asyncio.to_thread(file.readlines) == [encode({"request": "hello", "name": "mqtt:bob"})]
    gc.collect()  # reports sockets that were left open


@in_loop
async def test_a_session_without_a_free_descriptor_returns_its_slot(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OSError("Too many open files")

    monkeypatch.setattr("talkcli.client.connect.reach", fail)
    anna = SessionsWithoutBroker("unused")
    slots = anna.sessions.dialing = asyncio.Semaphore(1)
    anna.post({"seq": 1, "request": "status"})
    await asyncio.sleep(0.1)
    assert not slots.locked()


@in_loop
async def test_requests_of_all_clients_are_limited_to_4_mib_except_cancels(talk: Talk) -> None:
    anna = SessionsWithoutBroker(talk.socket)
    for number in range(20):
        await anna.ask(say(number), "full")
    long = {"text": "a", "patient": True, "data": {"more": "x" * 900}}
    blanks = b" " * 60_000
    line = json.dumps({"seq": 1, "request": "say", **long}).encode()
    refused = []
    for user, count in (("olga", 40), ("eve", 30), ("otto", 30)):
        for _ in range(count):
            anna.post(line + blanks, f"{user}/s1")
        await anna.ask({"seq": 2, "request": "hello"}, f"{user}/s1")
        refused.append([line for line in anna.lines(f"{user}/s1") if line.get("ok") is False])
    assert [bool(lines) for lines in refused] == [True, False, True], "olga may only use half of the space"
    assert {line["error"]["code"] for lines in refused for line in lines} == {"busy"}
    assert (4 << 20) - 61_000 < anna.sessions.count_unanswered_bytes() <= 4 << 20
    assert (await anna.ask({"seq": 3, "request": "cancel"}, "another"))["ok"]
    assert anna.sessions.count_unanswered_bytes() == 0
    anna.sessions.end_all()


@pytest.mark.parametrize(("wait", "feedback"), [(False, False), (True, False), (False, True)])
@in_loop
async def test_a_bridge_reports_its_own_results_like_the_server(talk: Talk, wait: bool, feedback: bool) -> None:
    anna = SessionsWithoutBroker(talk.socket)
    for number in range(20):
        await anna.ask(say(number), "full")
    more = {"wait": wait, "feedback": feedback, "key": "k", "priority": -2}
    anna.post(say(1, id="patient", patient=True, **more))
    await anna.ask(say(2, id="mine", **more))
    await anna.ask({"seq": 3, "request": "cancel", "ids": ["patient"]}, "another")
    await anna.line(lambda line: line.get("seq") == 1)
    for number, state, reason in ((1, "RECALLED", "canceled"), (2, "REJECTED", "queue_full")):
        (reply,) = [line for line in anna.lines() if line.get("seq") == number]
        goal = reply["goal"]
        assert (reply["ok"], goal["state"], goal["reason"]) == (True, state, reason)
        assert (goal["text"], goal["key"], goal["priority"]) == (f"sentence {number}", "k", -2)
        assert goal["client"] == {"name": "mqtt:bob", **dict.fromkeys(goal["client"].keys() - {"name"})}
        assert bool(goal["by"]) == (number == 1)
        assert (goal["id"] == "patient") == (number == 1)  # a rejected goal never has the id that its client chose
        assert goal["id"] != "mine"
        events = [line for line in anna.lines() if "event" in line and goal["id"] in json.dumps(line)]
        assert [event["event"] for event in events] == (["state", "result"] if wait or feedback else [])
        assert all(event["goal"] == goal for event in events[1:])
    anna.sessions.end_all()


@in_loop
async def test_a_reply_too_long_for_the_broker_has_no_text_or_is_an_error(talk: Talk) -> None:
    anna = SessionsWithoutBroker(talk.socket, room=3_000)
    for number in range(20):
        await anna.ask(say(number), "full")
    goal = (await anna.ask(say(1, text="long " * 1_000, wait=True)))["goal"]
    assert (goal["state"], goal["reason"], goal["text"]) == ("REJECTED", "queue_full", None)
    ended = await anna.line(lambda line: line.get("event") == "result")
    assert ended["goal"] == goal
    await anna.ask({"seq": 2, "request": "cancel"})
    anna.sessions.end_all()
    anna = SessionsWithoutBroker(talk.socket, room=300)
    reply = await anna.ask({"seq": 1, "request": "status"})
    assert (reply["ok"], reply["error"]["code"]) == (False, "too_long")
    assert (await anna.ask({"seq": 2, "request": "cancel"}))["count"] == 0
    anna.sessions.end_all()


async def begin(anna: SessionsWithoutBroker, goal_id: str, session: str = "s1", **fields: object) -> None:
    reply = await anna.ask(say(1, id=goal_id, text="One. ", more=True, **fields), session)
    assert reply["goal"]["more"], reply


def append(number: int, goal_id: str, **fields: object) -> dict[str, object]:
    return {"seq": number, "request": "append", "id": goal_id, **fields}


@in_loop
async def test_only_its_own_user_and_session_add_to_a_text(talk: Talk) -> None:
    """Other users can't continue a text, even after its sender has left. Nobody can continue the robot's own texts."""
    anna = SessionsWithoutBroker(talk.socket)
    await begin(anna, "text")
    assert (await anna.ask(append(2, "text", text="Two.", at=5)))["length"] == 9
    anna.sessions.end_all()
    with talk.connect() as local:
        assert local.request("say", text="One. ", more=True, id="local")["ok"]
        refused = await anna.ask(append(3, "local", text="Two."))
        assert refused["error"]["code"] == "unknown_goal"
    refused = await anna.ask(append(4, "local", text="Two."))
    assert refused["error"]["code"] == "unknown_goal"
    for fields in (append(5, "text", text="Three."), say(5, id="text", text="One. ", more=True)):
        refused = await anna.ask(fields, "olga/s1")
        assert refused["error"] == {"code": "not_sender", "message": "the goal text was not sent by olga"}
    assert (await anna.ask(append(6, "text", text="Three.", at=9, end=True)))["length"] == 15
    anna.sessions.end_all()


@in_loop
async def test_a_text_breaks_off_after_its_session_has_ended_but_may_be_continued_before(talk: Talk) -> None:
    anna = SessionsWithoutBroker(talk.socket)
    for goal_id in ("kept", "left"):
        await begin(anna, goal_id, stall=1)
        anna.post(append(2, goal_id, text="Two.", at=5))
    anna.post(b"")  # a goodbye; both additions still arrive
    await await_no_sessions(talk)
    await anna.ask(append(3, "kept", text=" Three.", at=9, end=True), "s2")
    talk.watcher.wait_for("left", "RECALLED")
    assert (talk.goal("left")["reason"], talk.goal("left")["text"]) == ("broken_off", "One. Two.")
    assert (talk.goal("kept")["state"], talk.goal("kept")["text"]) == ("PENDING", "One. Two. Three.")
    anna.sessions.end_all()


@in_loop
async def test_the_senders_of_texts_are_known_to_a_new_bridge(talk: Talk) -> None:
    anna = SessionsWithoutBroker(talk.socket)
    await begin(anna, "text")
    anna.sessions.end_all()
    anna = SessionsWithoutBroker(talk.socket)
    goal = Goal.from_json(talk.goal("text"))
    anna.sessions.remember(goal, goal.id)
    anna.sessions.remember(goal, talk.request("status")["server"]["boot"])
    assert (await anna.ask(append(2, "text"), "olga/s1"))["error"]["code"] == "not_sender"
    assert (await anna.ask(append(3, "text", at=5)))["ok"]
    anna.sessions.end_all()
