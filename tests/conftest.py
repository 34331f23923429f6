"""Fixtures: sound servers, servers with the real and the scripted engine, and the checks at the end of each."""

from __future__ import annotations

import contextlib
import gc
import os
import signal
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import pytest

from tests.support.processes import Talk
from tests.support.sink import Sink
from tests.support.surroundings import needs_no_server, short_directory
from tests.support.timing import calibrate, take_unmeasured

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator


#: The name of late measurements in a test's report.
_UNMEASURED = "not measured"


#: Starts a server for a test, greeted and watched: `make_talk("--preempt", sink=sink)`; see `Talk` for its parameters.
MakeTalk = Callable[..., Talk]


@pytest.fixture(scope="session", autouse=True)
def _interruptible() -> None:
    """Start clients with the signals of a terminal, which may be ignored if the tests run in the background."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.fixture
def nobody_serves() -> None:
    """Skip the test on a machine where a server runs, or left its socket, at a place where clients look."""
    needs_no_server()


def pytest_configure() -> None:
    """Time the control of limits while the machine is quiet; the workers of a run inherit the result.

    They also inherit that numpy starts no threads, which would only wait.
    """
    calibrate()
    os.environ["OPENBLAS_NUM_THREADS"] = "1"


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Import the tests without looking for garbage, and never look for garbage among them."""
    gc.disable()
    result = yield
    gc.freeze()
    gc.enable()
    return result


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Report the parts of a test that were late together with their control."""
    report = yield
    if report.when == "call":
        found = take_unmeasured()
        if found and report.passed:
            report.user_properties.append((_UNMEASURED, "; ".join(found)))
    return report


def pytest_report_teststatus(report: pytest.TestReport) -> tuple[str, str, str] | None:
    """Count tests that were not measured as neither passed nor failed."""
    if report.when == "call" and report.passed and _UNMEASURED in dict(report.user_properties):
        return _UNMEASURED, "m", _UNMEASURED.upper()
    return None


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """List the tests that were not measured."""
    reports = terminalreporter.getreports(_UNMEASURED)
    if reports:
        terminalreporter.write_sep("-", "not measured: late, and so was the control")
    for report in reports:
        terminalreporter.write_line(f"{report.nodeid}: {dict(report.user_properties)[_UNMEASURED]}")


@pytest.fixture(scope="session")
def sink() -> Iterator[Sink]:
    """A sound server for all tests that leave it as it is."""
    with Sink() as result:
        yield result


@pytest.fixture
def private_sink() -> Iterator[Callable[[], Sink]]:
    """Starts sound servers for a test that breaks them."""
    with contextlib.ExitStack() as stack:
        yield lambda: stack.enter_context(Sink())


@pytest.fixture
def home() -> Iterator[str]:
    """The home of programs that a test starts: a new directory that other users may enter, short enough for sockets."""
    with short_directory() as path:
        os.chmod(path, 0o755)
        yield path


@pytest.fixture
def make_talk() -> Iterator[MakeTalk]:
    """Starts servers; each is stopped at the end, if the test did not end it, and its watcher is checked."""
    servers: list[Talk] = []

    def make(*options: str, **how: Any) -> Talk:
        servers.append(Talk(options, **how))
        return servers[-1]

    try:
        yield make
        for talk in servers:
            if talk.running:
                talk.stop()
            else:
                talk.check()
    finally:  # whichever of them fails its check
        for talk in servers:
            talk.close()


@pytest.fixture
def talk(make_talk: MakeTalk, sink: Sink) -> Talk:
    """A server with the real engine at the recorded sink."""
    return make_talk(sink=sink)


@pytest.fixture
def scripted(make_talk: MakeTalk) -> Talk:
    """A server with the scripted engine, without sound: goals say how it behaves, see `tests.support.script`."""
    return make_talk(scripted=True)
