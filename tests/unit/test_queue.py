"""The queue by itself, against a list that is sorted anew after every step."""

from __future__ import annotations

from dataclasses import dataclass, field

from hypothesis import given
from hypothesis import strategies as st

from talkcli.goals.goal import Sender
from talkcli.goals.options import Say
from talkcli.goals.queue import Queue
from talkcli.goals.record import Record

steps = st.lists(
    st.tuples(
        st.sampled_from(["add", "add", "add", "preempt", "replace", "remove", "expire"]),
        st.sampled_from([0, 1, -2]),
        st.none() | st.sampled_from(["battery", "door"]),
        st.none() | st.integers(1, 9),
    ),
    max_size=40,
)


def goal(number: int, priority: int = 0, *, preempt: bool = False, key: str | None = None) -> Record:
    record = Record(f"4k7f-{number}", number, Say(f"text {number % 3}", priority=priority, key=key), Sender(), 1.0)
    record.preempt = preempt
    return record


@dataclass
class Both:
    """The queue, and the same as a list; its user keeps keys apart, as the scheduler does."""

    queue: Queue = field(default_factory=Queue)
    told: list[Record] = field(default_factory=list)
    count: int = 0

    def step(self, what: str, priority: int, key: str | None, seconds: int | None) -> None:
        self.count += 1
        old = self.queue.with_key(key)
        if what == "replace" and old is not None:
            priority = old.priority
        record = goal(self.count, priority, preempt=what == "preempt", key=key)
        record.expires_at = None if seconds is None else float(seconds)
        if what in {"remove", "expire"}:
            self.take_out(what, seconds)
        elif what == "replace" and old is not None:
            self.told[self.told.index(old)] = record
            self.queue.remove(old)
            self.queue.add(record, old)
        else:
            if old is not None:
                self.told.remove(old)
                self.queue.remove(old)
            self.told.insert(self.place_of(record), record)
            self.queue.add(record)

    def take_out(self, what: str, seconds: int | None) -> None:
        if what == "expire":
            due = [each for each in self.told if each.expires_at is not None and each.expires_at <= (seconds or 0)]
            found = []
            for record in self.queue.expired(seconds or 0):
                self.queue.remove(record)
                found.append(record)
            assert found == sorted(due, key=lambda each: (each.expires_at, each.number))
            self.told = [each for each in self.told if each not in due]
        elif self.told:
            self.queue.remove(self.told.pop((seconds or 0) % len(self.told)))

    def place_of(self, record: Record) -> int:
        before = [
            each
            for each in self.told
            if each.priority > record.priority or (each.priority == record.priority and not record.preempt)
        ]
        return len(before)


@given(steps)
def test_whatever_comes_and_goes_the_queue_is_as_the_list(
    sequence: list[tuple[str, int, str | None, int | None]],
) -> None:
    both = Both()
    for each in sequence:
        both.step(*each)
        queue, told = both.queue, both.told
        assert list(queue) == told
        assert (len(queue), queue.first()) == (len(told), told[0] if told else None)
        assert queue.next_expiry() == min((each.expires_at for each in told if each.expires_at), default=None)
        lowest = [each for each in told if each.priority == min(other.priority for other in told)]
        assert queue.newest_of_lowest() is max(lowest, key=lambda each: each.number, default=None)
        for priority in (-3, -2, 0, 1, 2):
            lower = [each for each in told if each.priority <= priority]
            assert queue.up_to(priority) == lower
            assert set(queue.preempting_up_to(priority)) == {each for each in lower if each.preempt}
        for key in ("battery", "door", "face", None):
            assert queue.with_key(key) == next((each for each in told if each.key == key is not None), None)
        for text in ("text 0", "text 1", "text 2", "text 3"):
            assert queue.with_text(text) == next((each for each in told if each.text == text), None)
