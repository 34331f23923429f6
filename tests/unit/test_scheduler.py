"""The scheduler's results: messages, effects, times, the result of a cancel, and the recent goals."""

from __future__ import annotations

from math import inf

import pytest

from talkcli.goals import memory
from talkcli.goals.goal import By, Output
from talkcli.goals.memory import EARLY_CANCEL_S, MAX_EARLY_CANCELS, MAX_SPEECH_TIMES
from talkcli.goals.options import Cancel, Say
from talkcli.goals.reasons import Reason
from talkcli.goals.scheduler import CONFIRM_SILENCE_S, Cancellation, Now, Scheduler
from talkcli.goals.states import State
from tests.unit.robot import ARM, DOOR, Robot, play

#: The message of the last goal of each script.
MESSAGES = {
    "a; completed a": "Talk completed successfully",
    "a; failed a": "speech failed: device is gone",
    "lost; a; missing": "speech failed: no memory",
    "a; cancel a; wait 2": "speech failed: the goal was stopped, but silence was not confirmed within 1.9 s",
    "a; cancel a; stopped a": "Talk preempted: the goal was cancelled",
    "a ttl=1; lost; wait 1; stopped a": "Talk preempted: its ttl of 1 s was over",
    "a; shutdown; stopped a": "Talk preempted: the server was stopped",
    "a; b; cancel b": "not spoken: the goal was cancelled before it started",
    "a canceled": "not spoken: the goal was cancelled before it started",
    "cancel mine; a id=mine": "not spoken: the goal was cancelled before it arrived",
    "a; b; shutdown": "not spoken: the server was stopped",
    "a; b ttl=1; wait 1": "not spoken: its ttl of 1 s was over",
    "a; b ttl=1 waited=1": "not spoken: its ttl of 1 s was over",
    "shutdown; a": "not spoken: the server is stopping",
    "a text=": "not spoken: the text is empty",
    "a fault=unknown_voice": "not spoken: it can't be had",
    "room 1; a; b; c": "not spoken: the queue is full (1 goals); wait, or cancel some of them",
    "a id=mine; b id=mine": "not spoken: the id mine was already used for another text",
    "a; b text=a throttle=60": "not spoken: the same text is being spoken",
    "a key=k; b key=k throttle=60": "not spoken: a goal with this key is being spoken",
    "a; b; c text=b throttle=60": "not spoken: the same text is already waiting",
    "a; completed a; b text=a throttle=2.5": "not spoken: the same text was spoken less than 2.5 s ago",
}

#: The effects of each script in their order. Only the first row lists all of them.
EFFECTS = {
    "a; b; completed a": "a PENDING, a ACTIVE, a Start, b PENDING, a SUCCEEDED, b ACTIVE, b Start",
    "a; b preempt; c preempt": "b PENDING, a PREEMPTING, a Stop, c PENDING, b RECALLED",
    "a; b; c key=k; d flush key=k": "d PENDING, c RECALLED, b RECALLED, a PREEMPTING, a Stop",
    "pause; a; b flush; resume": "a PENDING, b PENDING, a RECALLED, b ACTIVE, b Start",
    "room 1; a; b; c 5": "c PENDING, b RECALLED",
    "a; pause; pause; resume; resume; completed a": "a Start, a Hold, a Resume, a SUCCEEDED",
    "a; cancel a; pause; resume": "a Start, a PREEMPTING, a Stop",
    "a; pause; cancel a; resume": "a Hold, a PREEMPTING, a Stop",
    "a; b; cancel": "b PENDING, b RECALLED, a PREEMPTING, a Stop",
    "a; b; shutdown; shutdown": "b PENDING, b RECALLED, a PREEMPTING, a Stop",
    "a; b; cancel a; wait 2": "a Stop, a GiveUp, a ABORTED, b ACTIVE, b Start",
    "a; b ttl=2; c ttl=1; wait 3": "c PENDING, c RECALLED, b RECALLED",
    "lost; a; missing": "a PENDING, a ACTIVE, a ABORTED",
    "cancel mine; a id=mine": "a PENDING, a RECALLED",
}

#: The scheduler's next deadline after each script, in monotonic seconds. A script starts at 100.
DEADLINES = {
    "a; b": inf,
    "a ttl=1": inf,
    "a; b ttl=1": 101,
    "a; b ttl=9; c ttl=2; d ttl=4": 102,
    "a; b ttl=9; c ttl=2; d ttl=4; cancel c": 104,
    "a; b ttl=9; c ttl=2; d ttl=4; cancel c; wait 4": 109,
    "a; b ttl=5; cancel a": 100 + CONFIRM_SILENCE_S,
    "a; b ttl=1; cancel a": 101,
    "a; cancel a; pass 1; cancel a": 100 + CONFIRM_SILENCE_S,
    "a; cancel a; wait 2": inf,
    "a ttl=1; lost": 101,
    "a ttl=1; heard a; lost": inf,
    "lost; a; b ttl=3": 103,
    "a; b key=k ttl=1; c key=k ttl=9": 109,
}


@pytest.mark.parametrize("script", MESSAGES)
def test_each_ended_goal_has_a_message(script: str) -> None:
    assert [*play(script).goals.values()][-1].message == MESSAGES[script]


@pytest.mark.parametrize("script", EFFECTS)
def test_effects_are_in_order(script: str) -> None:
    expected = EFFECTS[script].split(", ")
    assert play(script).seen[-len(expected) :] == expected


@pytest.mark.parametrize("script", DEADLINES)
def test_the_deadline_is_the_earliest_due_time(script: str) -> None:
    assert play(script).scheduler.deadline() == DEADLINES[script]


def test_the_wait_for_silence_ends_before_a_cancel_must_be_answered() -> None:
    assert 1.5 < CONFIRM_SILENCE_S < 2


def test_a_succeeded_goal_shows_when_and_how_it_was_spoken() -> None:
    robot = Robot()
    record = robot.submit(Say("door", data={"page": 3}, priority=-7), "a")
    goal = robot.play("pass 3; completed a").goals["a"].snapshot()
    assert (goal, play("a format=x").goals["a"].snapshot().format) == (record.snapshot(), "x")
    assert (goal.id, goal.state, goal.client, goal.priority) == ("4k7f-1", State.SUCCEEDED, ARM, -7)
    assert (goal.data, goal.key, goal.voice, goal.output, goal.paused) == ({"page": 3}, None, None, None, False)
    assert (goal.reason, goal.by, goal.duration, goal.spoken, goal.format) == (None, None, 1.5, "door", "text")
    assert (goal.queued_at, goal.started_at, goal.ended_at) == (1.7e9 + 100, 1.7e9 + 100, 1.7e9 + 103)


def test_the_spoken_text_only_grows_and_is_kept_after_a_failure() -> None:
    robot = play("a text=door_open; b")
    assert robot.goals["a"].snapshot().spoken == ""
    assert robot.goals["b"].snapshot().spoken is None
    for end, spoken in ((4, "door"), (2, "door"), (0, "door"), (9, "door_open"), (4, "door_open")):
        robot.scheduler.word_heard("4k7f-1", 0, end, 0.0)
        assert robot.goals["a"].snapshot().spoken == spoken
    goal = play("a text=door_open; heard a; failed a").goals["a"].snapshot()
    assert (goal.spoken, goal.duration) == ("door", 1.5)


@pytest.mark.parametrize(
    ("text", "words", "spoken_end"),
    [
        ("one two three", ["one"], ""),
        ("one two three", ["one", "two"], "one"),
        ('He said: "go", and left.', ["He", "said", "go"], "He said:"),
        ('He said: "go", and left.', ["He", "said", "go", "and"], 'He said: "go",'),
        ("in the box", ["in", "box"], "in the"),
        ("well-known", ["well", "known"], "well"),
        ("你好，世界", ["你好", "世界"], "你好"),
    ],
)
def test_a_word_is_heard_to_its_end_when_the_next_word_starts(text: str, words: list[str], spoken_end: str) -> None:
    scheduler = Scheduler("4k7f", max_queue=1)
    scheduler.engine_ready(Now(0, 0))
    record, _ = scheduler.submit(Say(text), ARM, Now(0, 0))
    assert record.snapshot().spoken_end == 0
    for number, word in enumerate(words):
        start = text.index(word)
        scheduler.word_heard(record.id, start, start + len(word), number * 0.5)
    scheduler.audio_heard(record.id, 0.0)  # less than is known already
    goal = record.snapshot()
    assert (text[: goal.spoken_end], goal.heard) == (spoken_end, (len(words) - 1) * 0.5)
    scheduler.audio_heard(record.id, 7.25)
    scheduler.completed(record.id, 7.25, Now(0, 0))
    goal = record.snapshot()
    assert (goal.spoken_end, goal.heard) == (len(text), 7.25)


@pytest.mark.parametrize(
    ("gaps", "muted", "suffix"),
    [
        (0, False, ""),
        (1, False, ", but with 1 gap (2.0 s in total): this machine is too slow for the voice"),
        (2, False, ", but with 2 gaps (2.0 s in total): this machine is too slow for the voice"),
        (0, True, ", but the output was muted: card"),
    ],
)
def test_the_message_of_a_goal_mentions_gaps_and_a_muted_output(gaps: int, muted: bool, suffix: str) -> None:
    robot = play("a")
    output = Output("pulse", "card", 0.5, muted)
    robot.scheduler.output_changed("4k7f-1", output)
    robot.collect(robot.scheduler.completed("4k7f-1", 1.5, robot.now, gaps, 2.04))
    goal = robot.goals["a"].snapshot()
    assert (goal.state, goal.output, goal.message) == (State.SUCCEEDED, output, f"Talk completed successfully{suffix}")


def test_the_snapshot_of_a_pending_goal_has_no_later_values() -> None:
    robot = play("pause; a; resume; pause")
    robot.scheduler.voice_chosen("4k7f-1", "gmw/en-US", robot.now)
    robot.scheduler.output_changed("4k7f-1", Output("pulse", "card", 0.5, False))
    robot.play("cancel; failed a")
    now = robot.goals["a"].snapshot()
    assert (now.voice, now.reason, now.duration) == ("gmw/en-US", "canceled", 1.5)
    assert now.message == "Talk preempted: the goal was cancelled"
    goal = robot.goals["a"].snapshot(State.PENDING)
    assert (goal.voice, goal.reason, goal.by, goal.message, goal.spoken) == (None,) * 5
    assert (goal.started_at, goal.ended_at, goal.duration, goal.output) == (None,) * 4
    assert (goal.state, goal.paused, goal.queued_at) == (State.PENDING, False, 1.7e9 + 100)
    assert robot.goals["a"].pause_count == 1


@pytest.mark.parametrize(
    ("script", "ttl"),
    [("a", None), ("a ttl=0", None), ("a ttl=2.5", 2.5), ("set ttl=5; a", 5), ("set ttl=5; a ttl=0", None)],
)
def test_a_goal_shows_its_effective_ttl(script: str, ttl: float | None) -> None:
    assert play(script).goals["a"].snapshot().ttl == ttl


def test_each_goal_has_its_own_id_and_attaching_uses_no_new_one() -> None:
    robot = play("room 1; a; b text=; c; d; e id=mine; f text=a; g id=other text=; h")
    ids = ["4k7f-1", "4k7f-2", "4k7f-3", "4k7f-4", "4k7f-5", "4k7f-6", "4k7f-7", "4k7f-8"]
    assert [record.id for record in robot.goals.values()] == ids
    assert play("a id=mine; b id=mine text=a; c").goals["c"].id == "4k7f-2"


def test_a_goal_is_found_after_its_end() -> None:
    robot = play("a; b; c; cancel; stopped a")
    assert [robot.scheduler.find(record.id) for record in robot.goals.values()] == [*robot.goals.values()]
    assert robot.scheduler.find("4k7f-4") is None
    robot = play("a id=mine; completed a")
    robot.goals["a"].drop_text()
    assert robot.play("b text=a id=mine; c id=mine").outcome() == "a SUCCEEDED; c REJECTED id_conflict; b is a"


def test_the_wall_clock_does_not_matter() -> None:
    robot = play("a; b ttl=1; completed a; c; d ttl=1")
    assert robot.scheduler.tick(Now(robot.seconds + 0.5, 9e9)) == []
    assert robot.scheduler.submit(Say("a", throttle=60), ARM, Now(159, 9e9))[0].reason == "throttled"


def test_a_cancel_returns_ended_and_unknown_goals() -> None:
    robot = play("a; completed a; b; c; d")
    a, b, c, _ = robot.goals.values()
    done = robot.cancel(a.id, "4k7f-99", c.id, c.id, current=True, before="mine")
    assert (done.ended, done.unknown, done.ended_at_once, done.stopping) == ([a], ["4k7f-99", "mine"], [c], b)
    assert len(done.effects) == 3
    assert (c.by, b.by) == (By(client=DOOR), By(client=DOOR))
    again = robot.cancel(b.id)
    assert (again.stopping, again.effects) == (b, [])
    assert Robot().cancel() == Robot().cancel(current=True) == Robot().cancel(key="k") == Cancellation()


def test_a_cancel_knows_the_ids_of_goals_that_wait_for_room() -> None:
    robot = play("a; b")
    assert robot.cancel("mine", waiting=("mine",)) == Cancellation()
    done = robot.cancel(before="mine", waiting=("mine",))
    assert (done.unknown, done.ended_at_once, done.stopping) == ([], [robot.goals["b"]], robot.goals["a"])
    assert robot.play("c id=mine").goals["c"].state is State.PENDING


@pytest.mark.parametrize(
    ("selection", "chosen"),
    [
        (Cancel(), [0, 1, 2, 3]),
        (Cancel(ids=()), []),
        (Cancel(ids=("b", "7", "c")), [1, 2]),
        (Cancel(key="k"), [0, 1]),
        (Cancel(current=True), []),
        (Cancel(before="b"), [0, 1]),
        (Cancel(before="nobody's"), []),
        (Cancel(ids=("c",), before="b", current=True), [0, 1, 2]),
    ],
    ids=str,
)
def test_a_cancel_selects_among_goals_that_wait_for_room(selection: Cancel, chosen: list[int]) -> None:
    waiting = [Say("1", key="k"), Say("2", id="b", key="k"), Say("3", id="c"), Say("4")]
    assert selection.select_waiting(waiting) == chosen


def test_a_goal_lacks_room_only_if_nothing_else_is_wrong_with_it() -> None:
    robot = play("room 1; a")
    assert not robot.scheduler.only_lacks_room(Say("x"), robot.now)
    robot.play("b id=mine key=face")
    cases = {
        True: [Say("x"), Say("x", preempt=True, priority=-1), Say("x", key="other")],
        False: [
            *(Say("x", priority=1), Say("x", flush=True), Say("x", preempt=True), Say("x", key="face")),
            *(Say(""), Say("x", rate=1), Say("b", id="mine"), Say("z", id="mine")),
        ],
    }
    for lacks, says in cases.items():
        for say in says:
            assert robot.scheduler.only_lacks_room(say, robot.now) is lacks, say
    assert not robot.scheduler.only_lacks_room(Say("x"), robot.now, (Reason.UNKNOWN_VOICE, "no such voice"))
    robot.play("cancel early")
    assert not robot.scheduler.only_lacks_room(Say("x", id="early"), robot.now), "it is RECALLED at once"
    robot.play("cancel mine")
    assert not robot.scheduler.only_lacks_room(Say("x"), robot.now)


def test_a_goal_stops_waiting_for_room_if_it_has_room_or_never_will() -> None:
    robot = play("room 1; a; b id=mine")
    assert not robot.scheduler.has_room(Say("x"))
    assert robot.scheduler.has_room(Say("x", priority=1))
    assert robot.scheduler.has_room(Say("x", id="mine"))
    assert robot.play("shutdown").scheduler.has_room(Say("x"))


def test_stored_keys_and_texts_are_limited_and_the_oldest_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    assert MAX_SPEECH_TIMES == 20_000
    monkeypatch.setattr(memory, "MAX_SPEECH_TIMES", 6)
    robot = Robot()
    for name in ("a", "b", "c", "a", "d"):
        robot.report("completed", robot.submit(Say(f"text {name}", key=f"key {name}")).id)
    for name in ("a", "c", "d"):
        assert robot.submit(Say("x", key=f"key {name}", throttle=60)).reason == "throttled"
        assert robot.submit(Say(f"text {name}", throttle=60)).reason == "throttled"
    assert robot.submit(Say("x", key="key b", throttle=60)).state is State.ACTIVE
    assert robot.submit(Say("text b", throttle=60)).state is State.PENDING


def test_a_thousand_early_cancels_are_stored_and_the_oldest_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    assert (EARLY_CANCEL_S, MAX_EARLY_CANCELS) == (60, 1_000)
    monkeypatch.setattr(memory, "MAX_EARLY_CANCELS", 3)
    robot = play("cancel one two three; cancel one four; cancel 4k7f-8 9z9z-7 17 -x")
    robot.play("a id=one; b id=three; c id=four; d id=two")
    assert robot.outcome() == "d ACTIVE; a b c RECALLED canceled by door"


def test_a_sound_has_no_words_and_counts_as_heard_if_some_of_it_was() -> None:
    robot = play("set voice=piper/joe; a format=sound; cancel a; stopped a; b text=a format=sound throttle=60")
    assert robot.outcome() == "b ACTIVE; a PREEMPTED canceled by door"
    robot.scheduler.audio_heard(robot.goals["b"].id, 0.5)
    robot.play("cancel b; stopped b; c text=a format=sound throttle=60")
    assert robot.goals["c"].reason == "throttled"
    goal = robot.goals["b"].snapshot()
    assert (goal.heard, goal.spoken, goal.spoken_end) == (0.5, None, None)
    assert robot.scheduler.wanted_voice(robot.goals["b"]) == ""
