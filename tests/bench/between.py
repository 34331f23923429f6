"""Between two queued sentences, above the pause that espeak-ng itself adds; and long texts against short ones."""

from __future__ import annotations

import time
from functools import partial
from typing import TYPE_CHECKING

from tests.bench.arithmetic import beyond_own_pause
from tests.bench.ear import Command, until_sound
from tests.bench.failure import FailedError
from tests.bench.onset import milliseconds
from tests.bench.table import Limit, Row
from tests.support.espeak import RATE
from tests.support.reference import render

if TYPE_CHECKING:
    from collections.abc import Callable

    from talkcli import Client
    from tests.bench.stage import Stage
    from tests.support.recording import Samples

#: Said one after the other; no stretch within one is as quiet for as long as the pause between two.
SENTENCES = ("battery low", "coming home", "all is well", "moving along")
#: Samples of quiet that are a pause between sentences; espeak-ng's own at the end of one is 235 ms.
_PAUSE = int(0.15 * RATE)
#: Ten characters, and ten thousand that begin with the same words.
TEN = "I am ready"
TEN_THOUSAND = ("I am ready to go. We are leaving now. Please follow me. " * 200)[:10_000]


def gap(stage: Stage) -> list[Row]:
    """Measure the gaps between queued sentences, talk's and spd-say's in turn."""
    rounds = max(1, stage.options.rounds // 3)  # each gives three gaps, and takes as long
    ours: list[float] = []
    theirs: list[float] = []
    # espeak-ng says nothing twice alike in one process: the reference is of all that this server has said, in order.
    references = render([*SENTENCES] * (rounds + 1))
    with stage.server() as server, server.client() as client:
        for number in range(rounds + 1):
            expected = references[number * len(SENTENCES) : (number + 1) * len(SENTENCES)]
            found = _gaps(stage, partial(_queue, client), expected)
            peer = _gaps(stage, partial(_queue_at_spd, stage), expected) if stage.options.peers else []
            if number:  # the first warmed up
                ours += found
                theirs += peer
    name = "end of a queued sentence → start of the next, above espeak-ng's own pause"
    limits = Limit("median", 5), Limit("median", -5, at_least=True), Limit("least", -10, at_least=True)
    return [Row("gap", name, "ms", milliseconds(ours), "spd-say", milliseconds(theirs), limits)]


def long_text(stage: Stage) -> list[Row]:
    """Measure how soon a text of 10,000 characters is heard, against one of 10, in turn."""
    times: dict[str, list[float]] = {TEN: [], TEN_THOUSAND: []}
    with stage.speaking.client() as client:
        for _ in range(stage.options.rounds + 1):
            for text, into in times.items():
                into.append(until_sound(stage.sink, partial(_say_and_cancel, client, text), stage.jitter()))
    few, many = (milliseconds(each[1:]) for each in times.values())
    name = "`Client.say()` of 10,000 characters → first sample"
    return [Row("long-text", name, "ms", many, "10 characters", few, (Limit("ratio", 1.3),))]


def _gaps(stage: Stage, say: Callable[[], None], expected: list[Samples]) -> list[float]:
    time.sleep(stage.jitter())
    with stage.sink.record() as recording:
        say()
        recording.wait_for_sound()
        recording.wait_until_quiet(0.6)
    try:
        return [each / RATE for each in beyond_own_pause(recording.samples, expected, _PAUSE)]
    except ValueError as error:
        raise FailedError(str(error)) from None


def _queue(client: Client) -> None:
    for each in SENTENCES:
        client.say(each, follow=False)


def _queue_at_spd(stage: Stage) -> None:
    for each in SENTENCES:
        # Its priority "message" is a queue; at the usual one, "text", each takes the place of the one before it.
        Command(["spd-say", "-P", "message", each], stage.spd).finish()


def _say_and_cancel(client: Client, text: str) -> Callable[[], object]:
    client.say(text, follow=False)
    return client.cancel
