"""Fixtures for all tests: sound servers, and servers with the real or the scripted engine."""

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


#: Outcome of tests whose results were late together with their control.
_UNMEASURED = "not measured"
#: Starts a server: `make_talk("--preempt", sink=sink)`. See `Talk` for the parameters.
MakeTalk = Callable[..., Talk]


@pytest.fixture(scope="session", autouse=True)
def _interruptible() -> None:
    """Give clients the signal handling of a terminal, even if the tests run in the background with ignored signals."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.fixture
def nobody_serves() -> None:
    """Skip the test if clients on this machine would find a server or the socket of an earlier one."""
    needs_no_server()


def pytest_configure() -> None:
    """Time the control of limits while the machine is quiet, and keep numpy from starting threads.

    The workers inherit both through the environment.
    """
    calibrate()
    os.environ["OPENBLAS_NUM_THREADS"] = "1"


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Import the tests without garbage collection, and exclude their objects from later collections."""
    gc.disable()
    result = yield
    gc.freeze()
    gc.enable()
    return result


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Add late results to the report if their control was late, too."""
    report = yield
    if report.when == "call":
        late = take_unmeasured()
        if late and report.passed:
            report.user_properties.append((_UNMEASURED, "; ".join(late)))
    return report


def pytest_report_teststatus(report: pytest.TestReport) -> tuple[str, str, str] | None:
    """Count tests that were not measured separately."""
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
    """A sound server shared by all tests that don't change it."""
    with Sink() as result:
        yield result


@pytest.fixture
def private_sink() -> Iterator[Callable[[], Sink]]:
    """Starts sound servers that the test may break."""
    with contextlib.ExitStack() as stack:
        yield lambda: stack.enter_context(Sink())


@pytest.fixture
def home() -> Iterator[str]:
    """A new home directory for programs, with a path short enough for sockets. All users may enter it."""
    with short_directory() as path:
        os.chmod(path, 0o755)
        yield path


@pytest.fixture
def make_talk() -> Iterator[MakeTalk]:
    """Starts servers. After the test, stops those that still run, and checks the watcher of each server."""
    servers: list[Talk] = []

    def make(*options: str, **arguments: Any) -> Talk:
        servers.append(Talk(options, **arguments))
        return servers[-1]

    try:
        yield make
        for talk in servers:
            if talk.running:
                talk.stop()
            else:
                talk.check()
    finally:  # even if a check fails
        for talk in servers:
            talk.close()


@pytest.fixture
def talk(make_talk: MakeTalk, sink: Sink) -> Talk:
    """A server with the real engine, which plays to the recorded sink."""
    return make_talk(sink=sink)


@pytest.fixture
def scripted(make_talk: MakeTalk) -> Talk:
    """A server with the scripted engine, without sound. The texts of goals control it (see `tests.support.script`)."""
    return make_talk(scripted=True)


@pytest.fixture
def soundless(make_talk: MakeTalk) -> Talk:
    """A server with the real engine, which is ready, but without sound."""
    talk = make_talk("--player", "null", "--rate", "450")
    assert talk.run("voices").code == 0
    return talk
