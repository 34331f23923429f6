"""Sentences that follow each other: each is whole, and the pause between them is its own, neither cut nor stretched."""

from __future__ import annotations

from typing import TYPE_CHECKING

from talkcli.engine.players.choice import MOST
from tests.conformance.hearing import HOME, LOW, heard, send
from tests.support.compare import assert_heard, extent
from tests.support.reference import RATE, render

if TYPE_CHECKING:
    from tests.support.processes import Talk

#: Seconds that the monitor may lose where a stream starts.
_LOST = 0.012


def test_what_is_left_out_between_queued_sentences_is_silence_and_never_too_much_of_it(talk: Talk) -> None:
    """How much less than without it a change takes is a matter of speed; that enough of the pause stays is not."""
    texts = [LOW, HOME, LOW, HOME]
    goals = [send(talk, text) for text in texts]
    assert talk.watcher.wait_for_terminal(goals[-1], 20) == "SUCCEEDED"
    references = render(texts)
    found = assert_heard(heard(talk), references)
    for number in range(len(texts) - 1):
        before, after = (extent(each) for each in references[number : number + 2])
        assert before is not None
        assert after is not None
        own = (len(references[number]) - before[1] + after[0]) / RATE
        pause = (found[number + 1].offset - found[number].offset) / RATE - found[number].expected
        assert pause > own - MOST - _LOST
        played, whole = talk.goal(goals[number])["duration"], len(references[number]) / RATE
        assert whole - MOST <= played <= whole + 0.001
    assert abs(talk.goal(goals[-1])["duration"] - len(references[-1]) / RATE) < 0.001
