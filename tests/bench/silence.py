"""From a stop to silence: by a command, on an open connection, and by another goal that preempts."""

from __future__ import annotations

import time
from functools import partial
from typing import TYPE_CHECKING

from tests.bench.ear import SHORT, VOICED, Command, from_old_to_new, until_silence
from tests.bench.onset import milliseconds
from tests.bench.table import Limit, Row

if TYPE_CHECKING:
    from collections.abc import Callable

    from talkcli import Client
    from tests.bench.stage import Stage

#: On an open connection a round is short, and its 99th percentile is wanted: so many more than of the others.
MORE_ROUNDS = 7


def cancel(stage: Stage) -> list[Row]:
    """Measure `talk cancel` and `spd-say -S`, in turn."""
    ours, theirs = [], []
    stop = [stage.installed.talk, "cancel"]
    with stage.speaking.client() as client:
        begin = partial(_say, client, VOICED)
        for _ in range(stage.options.rounds + 1):
            ours.append(until_silence(stage.sink, begin, partial(_run, stop, stage.speaking.env), stage.jitter()))
            if stage.options.peers:
                say, hush = (partial(_run, ["spd-say", each], stage.spd) for each in (VOICED, "-S"))
                theirs.append(until_silence(stage.sink, say, hush, stage.jitter()))
    name = "start of `talk cancel` → silence"
    values, peer = milliseconds(ours[1:]), milliseconds(theirs[1:])  # the first warmed up
    return [Row("cancel", name, "ms", values, "spd-say -S", peer, (Limit("ratio", 0.9),))]


def connection(stage: Stage) -> list[Row]:
    """Measure a cancel on an open connection."""
    with stage.speaking.client() as client:
        say, stop = partial(_say, client, VOICED), partial(_cancel, client)
        rounds = range(stage.options.rounds * MORE_ROUNDS + 1)
        times = [until_silence(stage.sink, say, stop, stage.jitter()) for _ in rounds]
        running, stopped = _returns(stage, client)
    limits = Limit("median", 2), Limit("p99", 20)
    name = "`Client.cancel()` → its return, while the sound server is stopped"
    return [
        Row("connection", "cancel on an open connection → silence", "ms", milliseconds(times[1:]), limits=limits),
        Row("connection", name, "ms", milliseconds(stopped), "running", milliseconds(running), (Limit("above", 5),)),
    ]


def _returns(stage: Stage, client: Client) -> tuple[list[float], list[float]]:
    """Return the seconds of cancels while the sound server runs, and while it is stopped, in turn."""
    times: tuple[list[float], list[float]] = ([], [])
    for number in range(2 * stage.options.rounds + 2):
        stops = number % 2
        with stage.sink.record() as recording:
            client.say(VOICED)
            recording.wait_for_sound()
            if stops:
                stage.sink.freeze()
            began = time.monotonic()
            client.cancel()
            if number > 1:  # the first of each warmed up
                times[stops].append(time.monotonic() - began)
            if stops:
                stage.sink.thaw()
            recording.wait_until_quiet(0.3)
    return times


def pause(stage: Stage) -> list[Row]:
    """Measure a pause on an open connection."""
    with stage.speaking.client() as client:
        say, hold = partial(_say, client, VOICED), partial(_pause, client)
        rounds = range(stage.options.rounds + 1)
        times = [until_silence(stage.sink, say, hold, stage.jitter()) for _ in rounds]
    name = "pause on an open connection → silence"
    return [Row("pause", name, "ms", milliseconds(times[1:]), limits=(Limit("p99", 60),))]


def preempt(stage: Stage) -> list[Row]:
    """Measure a goal that preempts, on an open connection."""
    with stage.speaking.client() as client:
        say, newcomer = partial(_say, client, VOICED), partial(_say, client, SHORT, preempt=True)
        rounds = range(stage.options.rounds * 2 + 1)
        times = [from_old_to_new(stage.sink, say, newcomer, stage.jitter()) for _ in rounds]
    name = "preempt: last sample of the old → first of the new"
    return [Row("preempt", name, "ms", milliseconds(times[1:]), limits=(Limit("median", 6),))]


def _run(command: list[str], env: dict[str, str]) -> Callable[[], object]:
    return Command(command, env).finish


def _say(client: Client, text: str, *, preempt: bool = False) -> Callable[[], object]:
    return partial(client.say(text, preempt=preempt).wait, 10)


def _cancel(client: Client) -> Callable[[], object]:
    client.cancel()
    return int


def _pause(client: Client) -> Callable[[], object]:
    client.pause()

    def go_on() -> None:
        client.cancel()
        client.resume()

    return go_on
