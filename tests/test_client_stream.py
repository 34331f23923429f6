"""The library's stream: a text that is spoken while it is written."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import pytest

from talkcli import Client, State
from talkcli.errors import Lost, ProtocolMismatch, RequestRefused, ServerUnavailable, UsageError
from talkcli.frozen import replace
from tests.test_client_reconnecting import disconnect, restart

if TYPE_CHECKING:
    from collections.abc import Iterator

    from talkcli import SpeechStream
    from tests.support.processes import Talk

#: Takes about half an hour.
LONG = "one two three four. " * 600
FACE = "\N{GRINNING FACE}"


@pytest.fixture
def client(soundless: Talk) -> Iterator[Client]:
    with Client(soundless.socket, timeout=1) as result:
        yield result


def ended(speech: SpeechStream) -> tuple[State, str | None, str | None]:
    """Wait for the end of the goal, and return its state, its reason and its text."""
    goal = speech.wait(20)
    assert goal
    return goal.state, goal.reason, goal.text


def await_start(speech: SpeechStream) -> None:
    goal = speech.goal
    assert goal
    assert goal._connection.wait_until(lambda: goal.state is State.ACTIVE, time.monotonic() + 10)


def test_a_text_is_spoken_while_it_is_written(client: Client) -> None:
    with client.stream(feedback=True, key="answer") as speech:
        assert speech.write("  ")
        assert speech.goal is None
        for token in ("Hel", "lo", " ", "wor\ud83d", "\ude00ld."):
            assert speech.write(token)
        assert speech.goal
        assert speech.goal.goal.text == f"  Hello wor{FACE}ld."
        first = next(speech.goal.feedback(20))  # spoken before the text has ended
        assert (first.word, first.start) == ("Hello", 2)
        assert speech.write(" End")
    assert ended(speech) == (State.SUCCEEDED, None, f"  Hello wor{FACE}ld. End")
    assert speech.goal.goal.key == "answer"
    assert not speech.write("more")


@pytest.mark.parametrize("texts", [[], ["", " \n"]])
def test_without_text_there_is_no_goal(client: Client, texts: list[str]) -> None:
    with client.stream() as speech:
        assert all(map(speech.write, texts))
    with suppress(ZeroDivisionError), client.stream() as broken:
        broken.write(" ")
        raise ZeroDivisionError
    assert speech.goal is broken.goal is None
    assert speech.wait() is None
    assert client.log() == []


def test_an_exception_breaks_the_text_off_at_once(client: Client) -> None:
    for paused, state in ((False, State.ABORTED), (True, State.RECALLED)):
        if paused:
            client.pause()
        started_at = time.monotonic()
        with suppress(ZeroDivisionError), client.stream() as speech:
            speech.write(LONG[:2_000])
            if not paused:
                await_start(speech)
            raise ZeroDivisionError
        assert ended(speech)[:2] == (state, "broken_off")
        assert time.monotonic() - started_at < 2


def test_write_returns_false_after_the_end_of_the_goal(client: Client) -> None:
    with client.stream() as speech:
        assert speech.write("One. ")
        await_start(speech)
        client.say("other", preempt=True)
        assert not speech.write("Two. ")
        assert not speech.write("Three.")
    assert ended(speech)[0] is State.PREEMPTED


def test_a_refused_text_is_rejected_at_the_beginning_and_raises_later(client: Client) -> None:
    with client.stream() as speech:
        assert not speech.write("a\ude00")
    assert ended(speech)[:2] == (State.REJECTED, "invalid_text")
    with client.stream() as speech:
        assert speech.write("One. ")
        with pytest.raises(RequestRefused, match="character 6 is half of a surrogate pair") as caught:
            speech.write("\ude00")
        assert caught.value.code == "invalid_text"
        assert speech.write("Two.")
    assert ended(speech) == (State.SUCCEEDED, None, "One. Two.")


def test_a_write_waits_while_much_is_unheard(client: Client) -> None:
    with client.stream() as speech:
        assert speech.write(LONG[:10_000])  # in a single piece
        assert speech.goal
        threading.Timer(0.2, speech.goal.request_cancel).start()
        started_at = time.monotonic()
        assert not speech.write(LONG[10_000:])
        assert time.monotonic() - started_at > 0.1
    assert ended(speech)[0] is State.PREEMPTED


def test_the_text_continues_over_a_new_connection(soundless: Talk, client: Client) -> None:
    with client.stream() as speech:
        for token in ("One. ", "Two. ", "Three. "):
            assert speech.write(token)
            disconnect(client)
    assert ended(speech) == (State.SUCCEEDED, None, "One. Two. Three. ")
    assert soundless.watcher.texts("ACTIVE") == ["One. Two. Three. "]  # a single goal


def test_the_goal_is_lost_if_the_server_was_restarted(soundless: Talk, client: Client) -> None:
    with client.stream() as speech:
        assert speech.write("One. ")
        restart(soundless)
        assert not speech.write("Two. ")
    assert ended(speech)[0] is State.LOST


def test_a_write_fails_if_the_server_is_gone(soundless: Talk) -> None:
    with Client(soundless.socket, timeout=0.3) as client:
        with client.stream() as speech:
            assert speech.write("One. ")
            soundless.kill()
            with pytest.raises(Lost, match="the sentence may still be spoken"):
                speech.write("Two. ")
        assert ended(speech)[0] is State.LOST
        with pytest.raises(ServerUnavailable), client.stream() as speech:
            speech.write("One. ")
        assert speech.goal is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"stall": 0.5}, "the stall must be 1 to 60 seconds, got 0.5"),
        ({"throttle": 5}, "a growing text can only be throttled by its key"),
        ({"rate": "fast"}, "'rate' must be an integer"),
    ],
)
def test_an_invalid_option_is_refused_before_anything_is_sent(
    client: Client, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        client.stream(**options)


def test_an_older_server_is_refused(client: Client) -> None:
    client._connection.server = replace(client._connection.server, features=())
    with pytest.raises(ProtocolMismatch, match="does not support growing texts; restart it"):
        client.stream()
