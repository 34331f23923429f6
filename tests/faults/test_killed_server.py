"""The server is killed in mid-sentence, again and again: silent, no orphan, and the next one serves at once.

TALK_TEST_KILLS says how often; by hand: `TALK_TEST_KILLS=1000 pytest -s tests/faults/test_killed_server.py`.
"""

from __future__ import annotations

import os
import random
import statistics
import time
from typing import TYPE_CHECKING

import pytest

from tests.conformance.hearing import LONG, await_word, send
from tests.faults.broken import heard_again, sound, told
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from tests.conftest import MakeTalk
    from tests.support.sink import Sink

__all__ = ["sound"]

KILLS = int(os.environ.get("TALK_TEST_KILLS", "20"))
#: Seconds from the kill to the last sound and to the end of the last process; from a start to its greeting.
SILENT, SERVES = 0.3, 1.0
#: Between which words of LONG it is killed: before the second, nothing loud may have been heard.
WORDS = (2, 5)


@pytest.mark.timeout(60 + 10 * KILLS)
def test_server_is_killed_in_mid_sentence(make_talk: MakeTalk, sound: Sink) -> None:
    talk = make_talk(sink=sound)
    chance = random.Random(KILLS)
    files = set(os.listdir(talk.directory))
    silences: list[float] = []
    starts: list[float] = []

    with limits():
        for _ in range(KILLS):
            with sound.record() as recording:
                await_word(talk, send(talk, LONG), chance.randint(*WORDS))
                killed = time.monotonic()
                talk.kill(gone_within=SILENT)
                last = recording.wait_until_quiet(0.2)
            assert last is not None
            began = time.monotonic()
            talk.start_server()
            starts.append(time.monotonic() - began)
            silences.append(last - killed)
            assert_within(silences[-1], SILENT, "the silence after the server was killed")
            assert_within(starts[-1], SERVES, "the start after the server was killed")
    for what, times in (("silent after", silences), ("serves after", starts)):
        told(f"{len(times)} kills, {what} at most {max(times):.3f} s, median", statistics.median(times))
    heard_again(talk, sound)
    assert set(os.listdir(talk.directory)) == files
