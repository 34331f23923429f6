"""Word feedback comes when the word is heard: measured at the sink, against the place where libespeak-ng puts it."""

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
from tests.support.reference import RATE, Rendering, Sentence, played
from tests.support.sink import DistantSink
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from tests.conformance.voices import Joe, Voice
    from tests.conftest import MakeTalk
    from tests.support.connection import Message
    from tests.support.processes import Talk
    from tests.support.sink import Sink

#: Seconds between a word's feedback and the moment it is heard: the median, and the worst.
MEDIAN, WORST = 0.03, 0.1
#: The least likeness of a sentence that came through a tunnel: 0.985 were measured, 0.1 for another sentence.
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
    """The word events of a sentence that was spoken, and by how many seconds each came after its word."""

    words: list[Message]
    received: list[float]  # by the watcher
    stamped: list[float]  # by `at`, the server's own clock

    def assert_in_time(self) -> None:
        """Assert the limits: a word that is told before it is heard is as wrong as one that is told after."""
        for name, late in (("received", self.received), ("stamped", self.stamped)):
            median, worst = statistics.median(map(abs, late)), max(map(abs, late))
            print(f"{name}: median {median * 1000:.1f} ms, {min(late) * 1000:.1f} to {max(late) * 1000:.1f} ms")
            assert_within(median, MEDIAN, f"the median of words, as {name},")
            assert_within(worst, WORST, f"the worst of words, as {name},")


def measure(talk: Talk, text: str, rate: int, *, exact: bool = True, voice: Voice = ESPEAK) -> Measured:
    """Speak a server's first sentence to its end, stop the server, and return what was measured.

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
    talk.stop()
    received = [talk.watcher.arrived(each) - moment for each, moment in zip(words, moments, strict=True)]
    stamped = [each["at"] - wall - moment for each, moment in zip(words, moments, strict=True)]
    return Measured(words, received, stamped)


def position(reference: Rendering, start: int) -> float:
    """Return the seconds into the sound at which a word begins, the first time if libespeak-ng tells it repeatedly."""
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
    with limits():
        talk = make_talk("--rate", str(rate), "--player", player, sink=sink)
        measured = measure(talk, THIRTY, rate)
        assert [THIRTY[each["start"] : each["end"]] for each in measured.words] == TOLD
        measured.assert_in_time()


@pytest.mark.slow
@pytest.mark.parametrize("rate", [200, 300])
def test_done_when_thirty_words_of_a_neural_voice_are_told_as_they_are_heard(
    make_talk: MakeTalk, sink: Sink, joe: Joe, rate: int
) -> None:
    with limits():
        measured = measure(joe.serve(make_talk, sink, rate=rate), THIRTY, rate, voice=joe)
        assert [THIRTY[each["start"] : each["end"]] for each in measured.words] == TOLD
        # How busy the machine is doesn't change where in the sound a word is said to be.
        reference = joe.render_with_words(Sentence(THIRTY, rate))
        beside = [abs(each["time"] - position(reference, each["start"])) for each in measured.words]
        assert statistics.median(beside) <= MEDIAN, beside
        assert max(beside) <= WORST, beside
        measured.assert_in_time()


def test_words_are_told_as_they_are_heard_by_an_output_that_is_late(make_talk: MakeTalk, sink: Sink) -> None:
    """By a clock of the engine's own they would be told 200 ms before."""
    with limits(), DistantSink(sink) as distant:
        talk = make_talk("--rate", "350", sink=sink, env=distant.env)
        measure(talk, THIRTY, 350, exact=False).assert_in_time()


def test_row_42_ten_words_of_any_script_are_told_once_each_in_their_place(make_talk: MakeTalk, sink: Sink) -> None:
    with limits():
        measured = measure(make_talk(sink=sink), TEN, 200)
        _assert_ten(measured.words)
        assert measured.words[0]["time"] == 0
        measured.assert_in_time()


@pytest.mark.slow
def test_row_42_ten_words_of_any_script_are_told_once_each_by_a_neural_voice(
    make_talk: MakeTalk, sink: Sink, joe: Joe
) -> None:
    """Nothing else knows when they are heard: the recognizer knows English words alone."""
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


def test_row_42_a_stopped_goal_has_spoken_what_was_heard_of_it(make_talk: MakeTalk, sink: Sink, voice: Voice) -> None:
    reference = voice.render_with_words(Sentence(LONG))
    begins = extent(reference.samples)
    assert begins is not None

    with limits():
        talk = voice.serve(make_talk, sink, rate=200)
        goal_id = send(talk, LONG)
        await_word(talk, goal_id, 5)
        assert talk.request("cancel", ids=[goal_id])["ok"]
        goal = talk.goal(goal_id)
        assert (goal["state"], goal["message"]) == ("PREEMPTED", "Talk preempted")
        last = talk.watcher.words(goal_id)[-1]
        assert last["number"] >= 5
        assert goal["spoken"] == LONG[: last["end"]]
        heard(talk)
        # When the sound ended, the last word that was told had begun, and the next one had not.
        until = begins[0] / RATE + assert_begun(talk.recording, reference.samples)
        later = [seconds for start, _, seconds in reference.words if start > last["start"]]
        following = min(later, default=len(reference.samples) / RATE)
        talk.stop()
        assert_within(
            position(reference, last["start"]) - until, WORST, f"the word {last['word']!r}, before its sound,"
        )
        assert_within(until - following, WORST, f"the word after {last['word']!r}, heard and not told,")
