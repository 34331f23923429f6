"""The server is killed in mid-sentence, again and again: silent, no orphan, and the next one serves at once.

A few times, or with `-m slow` as often as TALK_TEST_KILLS says; by hand:
`TALK_TEST_KILLS=1000 pytest -s -m slow tests/faults/test_killed_server.py`.
"""

from __future__ import annotations

import os
import random
import statistics
import time
from typing import TYPE_CHECKING

import pytest

from tests.conformance.hearing import LONG, await_word, send
from tests.faults.broken import heard_again, told
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from tests.conftest import MakeTalk
    from tests.support.sink import Sink

FEW, KILLS = 3, int(os.environ.get("TALK_TEST_KILLS", "20"))
#: Seconds from the kill to the last sound and to the end of the last process; from a start to its greeting.
SILENT, SERVES = 0.3, 1.0
#: Between which words of LONG it is killed: before the second, nothing loud may have been heard.
WORDS = (2, 5)


@pytest.mark.timeout(60 + 10 * KILLS)
@pytest.mark.parametrize("kills", [FEW, pytest.param(KILLS, marks=pytest.mark.slow)])
def test_server_is_killed_in_mid_sentence(make_talk: MakeTalk, sink: Sink, kills: int) -> None:
    talk = make_talk(sink=sink, forked=False)  # its start is timed
    chance = random.Random(kills)
    files = set(os.listdir(talk.directory))
    silences: list[float] = []
    starts: list[float] = []

    with limits():
        for _ in range(kills):
            with sink.record() as recording:
                await_word(talk, send(talk, LONG), chance.randint(*WORDS))
                killed = time.monotonic()
                gone = talk.kill()
                last = recording.wait_until_quiet(0.2)
            assert last is not None
            began = time.monotonic()
            talk.start_server()
            starts.append(time.monotonic() - began)
            silences.append(last - killed)
            assert_within(gone, SILENT, "the end of all processes after the server was killed")
            assert_within(silences[-1], SILENT, "the silence after the server was killed")
            assert_within(starts[-1], SERVES, "the start after the server was killed")
    for what, times in (("silent after", silences), ("serves after", starts)):
        told(f"{len(times)} kills, {what} at most {max(times):.3f} s, median", statistics.median(times))
    heard_again(talk, sink)
    assert set(os.listdir(talk.directory)) == files
