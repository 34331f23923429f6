"""Word feedback comes when the word is heard: measured at the sink, against where libespeak-ng says the word is."""

from __future__ import annotations

import re
import statistics
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import pytest

from tests.conformance.hearing import LONG, await_word, heard, send
from tests.conformance.voices import ESPEAK
from tests.support.compare import assert_begun, compare, extent, time_heard
from tests.support.distant_sink import DistantSink
from tests.support.reference import RATE, Rendering, Sentence, played
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from tests.conformance.voices import Joe, Voice
    from tests.conftest import MakeTalk
    from tests.support.connection import Message
    from tests.support.processes import Talk
    from tests.support.sink import Sink

#: Seconds between a word's feedback and the moment it is heard: of the word in the middle, and of the worst.
MEDIAN, WORST = 0.03, 0.1
#: How much alike a sentence is that came through a tunnel: 0.985 were measured, of another one 0.1.
ALIKE = 0.95
#: Thirty words, of which libespeak-ng says some neighbours as one. It begins with a moment of silence, see `hearing`.
THIRTY = (
    "coming home to the charger in the kitchen, because the battery of this robot is low; "
    "please bring the small red box from the table to me and then wait"
)
#: The words of it that are told: "in the", "from the" are said as one.
TOLD = re.sub(r"\b(in|from|of) the\b", r"\1", re.sub("[,;]", "", THIRTY)).split()
#: Ten words with characters of one to four bytes; "from the" and "this one" are said as one, 東京 is told repeatedly.
TEN = "coming from the café 東京 is 😀 naïve, this one"


@dataclass(frozen=True)
class Measured:
    """A sentence that was spoken: its word events, and for each by how many seconds it came after its word."""

    words: list[Message]
    received: list[float]  # by the watcher
    stamped: list[float]  # by `at`, the server's own clock

    def __str__(self) -> str:
        return ", ".join(
            f"{name} median {statistics.median(late) * 1000:.1f} ms, {min(late) * 1000:.1f} to {max(late) * 1000:.1f}"
            for name, late in (("received", self.received), ("stamped", self.stamped))
        )

    def assert_in_time(self) -> None:
        """Assert the limits: a word that is told before it is heard is as wrong as one that is told after."""
        for late in (self.received, self.stamped):
            assert_within(statistics.median(map(abs, late)), MEDIAN, f"the median of words ({self})")
            assert_within(max(map(abs, late)), WORST, f"the worst of words ({self})")


def measure(talk: Talk, text: str, rate: int, *, exact: bool = True, voice: Voice = ESPEAK) -> Measured:
    """Speak a server's first sentence to its end, and measure it.

    `exact`: whether the sink plays every sample as it is; a tunnel doesn't.
    """
    wall = time.time() - time.monotonic()
    done = talk.run("say", "--wait", "--", text, timeout=60)
    assert (done.code, done.err) == (0, "")
    samples = heard(talk)
    reference = voice.render_with_words(Sentence(text, rate))
    compared = compare(samples, reference.samples)
    assert compared.same or (not exact and compared.correlation > ALIKE), compared
    words = talk.watcher.words(done.id)
    begins = (len(reference.samples) - len(played(reference.samples))) / RATE
    positions = [max(begins, position(reference, each["start"])) for each in words]
    moments = [time_heard(talk.recording, compared, reference.samples, each) for each in positions]
    received = [talk.watcher.arrived(each) - moment for each, moment in zip(words, moments, strict=True)]
    stamped = [each["at"] - wall - moment for each, moment in zip(words, moments, strict=True)]
    return Measured(words, received, stamped)


def position(reference: Rendering, start: int) -> float:
    """Return where in the sound a word begins, as libespeak-ng tells it, the first time if it does so repeatedly."""
    return next(seconds for offset, _, seconds in reference.words if offset == start)


@pytest.mark.parametrize(
    ("player", "rate"),
    [
        ("aplay", 350),
        ("pulse", 350),
        *(pytest.param("aplay", rate, marks=pytest.mark.slow) for rate in (100, 200)),
        *(pytest.param("pacat", rate, marks=pytest.mark.slow) for rate in (200, 350)),
        *(pytest.param("pulse", rate, marks=pytest.mark.slow) for rate in (100, 200)),
    ],
)
def test_done_when_thirty_words_are_told_as_they_are_heard(
    make_talk: MakeTalk, sink: Sink, player: str, rate: int
) -> None:
    assert len(THIRTY.split()) == 30

    with limits():
        talk = make_talk("--rate", str(rate), "--player", player, sink=sink)
        measured = measure(talk, THIRTY, rate)
        talk.stop()
        assert [THIRTY[each["start"] : each["end"]] for each in measured.words] == TOLD
        print(f"{player}, rate {rate}: {measured}")
        measured.assert_in_time()


@pytest.mark.slow
@pytest.mark.parametrize("rate", [200, 300])
def test_done_when_thirty_words_of_a_neural_voice_are_told_as_they_are_heard(
    make_talk: MakeTalk, sink: Sink, joe: Joe, rate: int
) -> None:
    with limits():
        talk = joe.serve(make_talk, sink, rate=rate)
        measured = measure(talk, THIRTY, rate, voice=joe)
        talk.stop()
        assert [THIRTY[each["start"] : each["end"]] for each in measured.words] == TOLD
        print(f"rate {rate}: {measured}")
        # Where in the sound a word is said to be is no matter of how busy the machine is.
        reference = joe.render_with_words(Sentence(THIRTY, rate))
        beside = [abs(each["time"] - position(reference, each["start"])) for each in measured.words]
        assert statistics.median(beside) <= MEDIAN, beside
        assert max(beside) <= WORST, beside
        measured.assert_in_time()


def test_words_are_told_as_they_are_heard_where_that_is_late(make_talk: MakeTalk, sink: Sink) -> None:
    """By a clock of our own they would be told 200 ms before."""
    with limits(), DistantSink(sink) as distant:
        talk = make_talk("--rate", "350", sink=sink, env=distant.env)
        measured = measure(talk, THIRTY, 350, exact=False)
        talk.stop()
        print(measured)
        measured.assert_in_time()


def test_row_42_ten_words_of_any_script_are_told_once_each_in_their_place(make_talk: MakeTalk, sink: Sink) -> None:
    assert len(TEN.split()) == 10

    with limits():
        talk = make_talk(sink=sink)
        measured = measure(talk, TEN, 200)
        talk.stop()
        _assert_ten(measured.words)
        assert measured.words[0]["time"] == 0
        print(measured)
        measured.assert_in_time()


@pytest.mark.slow
def test_row_42_ten_words_of_any_script_are_told_once_each_by_a_neural_voice(
    make_talk: MakeTalk, sink: Sink, joe: Joe
) -> None:
    """When they are heard nobody else knows: the recognizer knows English words alone."""
    talk = joe.serve(make_talk, sink, rate=200)
    done = talk.run("say", "--wait", "--", TEN)
    assert (done.code, done.err) == (0, "")
    _assert_ten(talk.watcher.words(done.id))


def _assert_ten(words: list[Message]) -> None:
    assert [each["word"] for each in words] == ["coming", "from", "café", "東京", "is", "😀", "naïve", "this"]
    assert [each["start"] for each in words] == [TEN.index(each["word"]) for each in words]
    assert [each["end"] - each["start"] for each in words] == [len(each["word"]) for each in words]
    assert [each["number"] for each in words] == list(range(1, 9))
    times = [each["time"] for each in words]
    assert times == sorted(times)


@pytest.mark.parametrize("number", [2, pytest.param(5, marks=pytest.mark.slow), 8])
def test_row_42_a_stopped_goal_has_spoken_what_was_heard_of_it(
    make_talk: MakeTalk, sink: Sink, number: int, voice: Voice
) -> None:
    reference = voice.render_with_words(Sentence(LONG))
    begins = extent(reference.samples)
    assert begins is not None

    with limits():
        talk = voice.serve(make_talk, sink, rate=200)
        goal_id = send(talk, LONG)
        await_word(talk, goal_id, number)
        assert talk.request("cancel", ids=[goal_id])["ok"]
        goal = talk.goal(goal_id)
        assert (goal["state"], goal["message"]) == ("PREEMPTED", "Talk preempted")
        last = talk.watcher.words(goal_id)[-1]
        assert last["number"] >= number
        assert goal["spoken"] == LONG[: last["end"]]
        heard(talk)
        # To where it was heard: the last word that was told had begun by then, the next one had not.
        until = begins[0] / RATE + assert_begun(talk.recording, reference.samples)
        later = [seconds for start, _, seconds in reference.words if start > last["start"]]
        following = min(later, default=len(reference.samples) / RATE)
        talk.stop()
        assert_within(
            position(reference, last["start"]) - until, WORST, f"the word {last['word']!r}, before its sound,"
        )
        assert_within(until - following, WORST, f"the word after {last['word']!r}, heard and not told,")
