"""Signals end a client's waiting, whichever thread the kernel gives them to, and whenever they come."""

from __future__ import annotations

import signal
import threading
import time

import pytest

from talkcli.cli.interrupts import Interrupts
from talkcli.client.connect import ready
from talkcli.errors import EXIT_TIMEOUT

CAUGHT = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]


def to_another_thread(number: signal.Signals) -> None:
    """Have the kernel give a signal to a thread that is not the main one, which stays where it is."""
    thread = threading.Thread(target=lambda: signal.pthread_kill(threading.get_ident(), number))
    thread.start()
    thread.join()


@pytest.mark.parametrize("number", [*CAUGHT, signal.SIGALRM])
def test_a_signal_that_another_thread_is_given_ends_the_waiting(number: signal.Signals) -> None:
    began = time.monotonic()
    with Interrupts(60) as interrupts:
        sender = threading.Timer(0.1, to_another_thread, [number])
        sender.start()
        ready({}, 10, interrupts.watched)
    sender.join()
    assert interrupts.exit_code == (EXIT_TIMEOUT if number == signal.SIGALRM else 128 + number)
    assert time.monotonic() - began < 5
    assert signal.set_wakeup_fd(-1) == -1  # nothing is left behind


def test_of_what_is_cleared_only_a_first_signal_ends_anything() -> None:
    with Interrupts() as interrupts:
        signal.raise_signal(signal.SIGHUP)
        interrupts.clear()
        signal.raise_signal(signal.SIGHUP)
        assert ready({}, 0.05, interrupts.watched) == set()
    assert interrupts.number == signal.SIGHUP
    with Interrupts() as interrupts:
        interrupts.clear()
        signal.raise_signal(signal.SIGTERM)
        ready({}, 10, interrupts.watched)
        pytest.fail("it was not interrupted")
    assert interrupts.number == signal.SIGTERM
