"""The scheduler against a slow model of its own: any requests, engine events and time, compared after each step.

What is compared, and how, is in `side_by_side`; here is what may happen.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, initialize, invariant, multiple, precondition, rule

from talkcli.goals.goal import Sender
from talkcli.goals.options import Say
from talkcli.goals.scheduler import Now
from tests.unit.random_goals import BAD_SAYS, BOOT, OPTIONS, OWN_IDS, TEXTS, says_with
from tests.unit.side_by_side import SideBySide

if TYPE_CHECKING:
    from hypothesis.stateful import MultipleResults

    from tests.unit.random_goals import Fields
    from tests.unit.slow_goal import SlowGoal

NOBODYS_IDS = [f"{BOOT}-900", "9z9z-1", "17"]

clients = st.sampled_from(["arm", "base", "door"]).map(lambda name: Sender(pid=len(name), uid=1000, name=name))
voices = st.sampled_from(["piper/joe", "piper/amy"])
keys = st.sampled_from(["battery", "door"])
any_ids = st.sampled_from([*NOBODYS_IDS, *OWN_IDS])
steps = st.sampled_from([0.0, 0.5, 1.0, 1.5, 2.0, 10.0, 59.5])
jumps = st.sampled_from([0.0, 3_600.0, -3_600.0])
durations = st.none() | st.sampled_from([0.0, 1.25])
reasons = st.sampled_from(["audio_device", "audio_lost", "engine_crashed", "nothing_to_say"])


class SchedulerMachine(RuleBasedStateMachine):
    """Does the same to the scheduler and to the model, and compares."""

    goals = Bundle("goals")

    @initialize(
        preempt=st.sampled_from([False, False, True]),
        max_queue=st.sampled_from([2, 3, 1, 5, 8]),
        ttl=st.sampled_from([0.0, 0.0, 2.0]),
    )
    def open(self, *, preempt: bool, max_queue: int, ttl: float) -> None:
        self.both = SideBySide(preempt=preempt, max_queue=max_queue, ttl=ttl)

    @property
    def speaking(self) -> SlowGoal | None:
        return self.both.model.voice[0] if self.both.model.voice else None

    @property
    def stopping(self) -> bool:
        return self.speaking is not None and self.speaking.state == "PREEMPTING"

    # Time. The wall clock jumps as it likes, and nothing may depend on it.

    @rule(step=steps, jump=jumps)
    def time_goes_on(self, step: float, jump: float = 0.0) -> None:
        self.time_goes_on_unseen(step, jump)
        self.both.tick()

    @rule(step=steps, jump=jumps)
    def time_goes_on_unseen(self, step: float, jump: float) -> None:
        """Other things may come before the tick that is due."""
        now = self.both.now
        self.both.now = Now(now.monotonic + step, now.wall + step + jump)

    # Requests

    @rule(target=goals, say=says_with("preempt", "key"), sender=clients)
    def say(self, say: Fields, sender: Sender) -> str:
        return self.both.submit(Say(**say), sender)

    @rule(target=goals, say=says_with(*OPTIONS), sender=clients)
    def say_with_options(self, say: Fields, sender: Sender) -> str:
        return self.both.submit(Say(**say), sender)

    @rule(target=goals, say=says_with("priority", "preempt", "flush", "key"), sender=clients)
    def say_in_some_order(self, say: Fields, sender: Sender) -> str:
        return self.both.submit(Say(**say), sender)

    @rule(target=goals, goal=goals, keyed=st.booleans(), throttle=st.sampled_from(OPTIONS["throttle"]), sender=clients)
    def say_again(self, goal: str, *, keyed: bool, throttle: float, sender: Sender) -> str:
        """Say what was said before, but not too often."""
        earlier = self.both.records[goal]
        text = earlier.text if earlier.text in TEXTS else TEXTS[0]
        return self.both.submit(Say(text, key=earlier.key if keyed else None, throttle=throttle), sender)

    @precondition(lambda self: not (self.speaking or self.both.model.paused))
    @rule(target=goals, say=says_with("key", "throttle"), times=st.lists(steps, min_size=2, max_size=4), sender=clients)
    def say_again_and_again(self, say: Fields, times: list[float], sender: Sender) -> MultipleResults[str]:
        sent = []
        for step in times:
            sent.append(self.both.submit(Say(**say), sender))
            self.time_goes_on(step)
            self.speak_to_the_end()
        return multiple(*sent)

    @precondition(lambda self: self.both.model.early)
    @rule(target=goals, say=says_with("flush", "key"), data=st.data(), sender=clients)
    def say_what_was_cancelled_before(self, say: Fields, data: st.DataObject, sender: Sender) -> str:
        goal_id = data.draw(st.sampled_from(sorted(self.both.model.early)))
        return self.both.submit(Say(**say, id=goal_id), sender)

    @rule(target=goals, says=st.lists(says_with("priority", "preempt", "key"), min_size=2, max_size=6), sender=clients)
    def say_some(self, says: list[Fields], sender: Sender) -> MultipleResults[str]:
        return multiple(*[self.both.submit(Say(**each), sender) for each in says])

    @rule(target=goals, say=st.sampled_from(BAD_SAYS), sender=clients)
    def say_what_is_refused(self, say: tuple[Fields, str], sender: Sender) -> str:
        return self.both.submit(Say(**say[0]), sender, fault=say[1])

    @rule(
        ids=st.none() | st.lists(goals | any_ids, max_size=3),
        current=st.booleans(),
        before=goals | st.none() | any_ids,
        key=st.none() | keys,
        sender=clients,
    )
    def cancel(
        self, ids: list[str] | None, *, current: bool, before: str | None, key: str | None, sender: Sender
    ) -> None:
        self.both.cancel(ids, sender, current=current, before=before, key=key)

    @rule(goal=goals | any_ids, sender=clients)
    def cancel_one(self, goal: str, sender: Sender) -> None:
        self.both.cancel([goal], sender)

    @rule(key=keys, sender=clients)
    def cancel_a_key(self, key: str, sender: Sender) -> None:
        self.both.cancel(None, sender, key=key)

    @rule(preempt=st.booleans())
    def set_preempt(self, *, preempt: bool) -> None:
        self.both.change(preempt=preempt)

    @rule(ttl=st.sampled_from([0.0, 1.0, 3.0]))
    def set_ttl(self, ttl: float) -> None:
        self.both.change(ttl=ttl)

    @rule(voice=st.none() | voices)
    def set_voice(self, voice: str | None) -> None:
        self.both.change_voice(voice)

    @rule()
    def pause(self) -> None:
        self.both.pause()

    @rule()
    def resume(self) -> None:
        self.both.resume()

    @precondition(lambda self: len(self.both.records) > 25)
    @rule()
    def shut_down(self) -> None:
        self.both.shut_down()

    # The engine, with what it may truly say

    @precondition(lambda self: self.speaking)
    @rule(end=st.integers(0, 12))
    def hears(self, end: int) -> None:
        self.tell("heard", end=end)

    @precondition(lambda self: self.speaking)
    @rule(duration=durations)
    def completes(self, duration: float | None) -> None:
        self.tell("completed", duration=duration)

    @precondition(lambda self: self.speaking)
    @rule(count=st.integers(1, 4), step=st.sampled_from([0.0, 0.5, 1.0]))
    def speaks_some(self, count: int, step: float) -> None:
        for _ in range(count):
            self.time_goes_on(step)
            self.speak_to_the_end()

    @precondition(lambda self: self.speaking)
    @rule(reason=reasons, duration=durations)
    def fails(self, reason: str, duration: float | None) -> None:
        self.tell("failed", reason=reason, duration=duration)

    @precondition(lambda self: self.stopping)
    @rule()
    def stops(self) -> None:
        self.tell("stopped")

    @precondition(lambda self: self.speaking)
    @rule(end=st.integers(0, 4), sender=clients)
    def stops_in_the_middle(self, end: int, sender: Sender) -> None:
        self.tell("heard", end=end)
        self.both.cancel(None, sender, current=True)
        self.tell("stopped")

    @precondition(lambda self: self.stopping)
    @rule()
    def cannot_confirm_silence(self) -> None:
        self.tell("failed", reason="not_silent")

    @rule()
    def loses_its_process(self) -> None:
        self.both.engine_lost()

    @rule()
    def gets_ready(self) -> None:
        self.both.engine_ready()

    @precondition(lambda self: not self.both.model.engine)
    @rule(target=goals, says=st.lists(says_with("priority", "ttl"), max_size=3), step=steps, sender=clients)
    def does_not_get_ready(self, says: list[Fields], step: float, sender: Sender) -> MultipleResults[str]:
        sent = [self.both.submit(Say(**each), sender) for each in says]
        self.time_goes_on_unseen(step, 0.0)
        self.both.engine_missing()
        return multiple(*sent)

    @rule(voice=voices)
    def is_to_load_a_voice(self, voice: str) -> None:
        self.both.is_to_load(voice)

    @rule(voice=voices)
    def begins_to_load_a_voice(self, voice: str) -> None:
        self.both.begins_to_load(voice)

    @rule(voice=voices)
    def has_loaded_a_voice(self, voice: str) -> None:
        self.both.has_loaded(voice)

    @precondition(lambda self: not (self.speaking or self.both.model.paused))
    @rule(
        target=goals,
        voice=voices,
        begun=st.booleans(),
        says=st.lists(says_with("voice", "voice_only", "ttl", "priority"), min_size=1, max_size=3),
        times=st.lists(st.sampled_from([0.0, 0.5, 2.0, 2.5, 9.5, 10.0]), max_size=3),
        sender=clients,
    )
    def waits_for_a_voice(
        self, voice: str, *, begun: bool, says: list[Fields], times: list[float], sender: Sender
    ) -> MultipleResults[str]:
        self.both.begins_to_load(voice) if begun else self.both.is_to_load(voice)
        sent = [self.both.submit(Say(**each), sender) for each in says]
        for step in times:
            self.time_goes_on(step, 0.0)
        return multiple(*sent)

    @rule(event=st.sampled_from(["heard", "completed", "failed", "stopped"]), goal=goals | any_ids)
    def says_anything(self, event: str, goal: str) -> None:
        """An event of any goal: one that waits, one that ended, one that never was, or by chance the right one."""
        self.both.engine_says(event, goal, reason="engine_crashed")

    def speak_to_the_end(self) -> None:
        if self.speaking:
            self.tell("completed", duration=1.0)

    def tell(self, event: str, *, end: int = 1, reason: str = "", duration: float | None = None) -> None:
        assert self.speaking
        self.both.engine_says(event, self.speaking.id, end, reason, duration)

    # What is so after every step

    @invariant()
    def both_are_alike(self) -> None:
        real, model = self.both.real, self.both.model
        assert (real.paused, real.has_engine) == (model.paused, model.engine)
        assert [each.id for each in real.pending()] == [each.id for each in model.queue]
        assert real.pending_count == len(model.queue)
        assert {each.id for each in real.unfinished()} == {each.id for each in model.voice + model.queue}
        self.both.compare_goals()
        self.both.compare_deadline()

    @invariant()
    def higher_priorities_go_first_and_equals_in_the_order_in_which_they_came(self) -> None:
        waiting = list(self.both.real.pending())
        assert [each.priority for each in waiting] == sorted((each.priority for each in waiting), reverse=True)
        plain = [(-each.priority, each.number) for each in waiting if each.key is None and not each.preempt]
        assert plain == sorted(plain)
        with_key = [each.key for each in waiting if each.key is not None]
        assert len(with_key) == len(set(with_key)), "two goals with one key wait"

    def teardown(self) -> None:
        """After the last step everything is ended, and each goal has one terminal event."""
        if not hasattr(self, "both") or self.both.amidst:
            return
        self.both.shut_down()
        if self.stopping:
            self.stops()
        self.both.all_has_ended_once()


class BriefMachine(SchedulerMachine):
    """The same for every run of the tests: in a second it finds what goes wrong often."""


TestSchedulerBriefly = BriefMachine.TestCase
TestSchedulerBriefly.settings = settings(
    max_examples=settings().max_examples // 5, stateful_step_count=40, suppress_health_check=[HealthCheck.too_slow]
)
#: Where it fails, it takes its time to find the shortest sequence.
TestScheduler = pytest.mark.slow(pytest.mark.timeout(900)(SchedulerMachine.TestCase))
#: More than other tests have: what goes wrong only where three options meet is rare.
TestScheduler.settings = settings(
    max_examples=3 * settings().max_examples,
    stateful_step_count=60,
    suppress_health_check=[HealthCheck.too_slow],  # a busy machine is no fault of it
)
