"""Fixtures: sound servers, servers with the real and the scripted engine, and what must hold of each when it ends."""

from __future__ import annotations

import contextlib
import signal
from typing import TYPE_CHECKING, Protocol

import pytest
from _pytest.runner import runtestprotocol

from tests.support.company import company
from tests.support.processes import Talk
from tests.support.sink import Sink

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence


#: Fixtures of tests that listen.
_LISTENING = frozenset({"sink", "private_sink"})
#: Set for a test that is tried again; and the same in its reports.
_AGAIN = pytest.StashKey[bool]()
_TRIED_AGAIN = "tried again"


class MakeTalk(Protocol):
    """Starts a server for a test: `make_talk("--preempt", sink=sink)`; see `Talk`."""

    def __call__(
        self,
        *options: str,
        scripted: bool = False,
        sink: Sink | None = None,
        driver: str | None = None,
        env: Mapping[str, str] | None = None,
        watched: bool = True,
    ) -> Talk:
        """Return the server, greeted and watched."""
        ...


@pytest.fixture(scope="session", autouse=True)
def _interruptible() -> None:
    """Start clients with SIGINT as a terminal would: what runs the tests in its background may have it ignored."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def _place(request: pytest.FixtureRequest) -> Iterator[None]:
    """Run beside other tests; alone what is marked so, and what is tried again."""
    if request.node.get_closest_marker("alone") or request.node.stash.get(_AGAIN, False):
        company.stay_alone()
    else:
        company.join()
    yield
    company.leave()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run what is alone first, beside short tests, and what takes long last: whoever wants to be alone waits for it."""
    items.sort(key=lambda item: (item.get_closest_marker("alone") is None, item.get_closest_marker("slow") is not None))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
    """Try a test that listens again, alone, where it failed beside others: what they did, it may have heard."""
    listens = not _LISTENING.isdisjoint(getattr(item, "fixturenames", ()))
    if company.alone or not listens or item.get_closest_marker("alone"):
        return None
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    reports = runtestprotocol(item, nextitem=nextitem, log=False)
    failed = next((each for each in reports if each.failed), None)
    if failed:
        item.stash[_AGAIN] = True
        reports = runtestprotocol(item, nextitem=nextitem, log=False)
        for each in reports:
            each.sections.append(("it failed beside other tests before", failed.longreprtext))
            each.user_properties.append((_TRIED_AGAIN, failed.longreprtext.splitlines()[-1]))
    for each in reports:
        item.ihook.pytest_runtest_logreport(report=each)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Name what passed only when it was alone."""
    again = [
        (report.nodeid, dict(report.user_properties)[_TRIED_AGAIN])
        for report in terminalreporter.getreports("passed")
        if report.when == "call" and _TRIED_AGAIN in dict(report.user_properties)
    ]
    if again:
        terminalreporter.write_sep("-", "failed beside other tests, passed alone")
        for name, why in again:
            terminalreporter.write_line(f"{name}: {why}")


@pytest.fixture(scope="session")
def sink() -> Iterator[Sink]:
    """A sound server for tests that leave it as it is."""
    with Sink() as result:
        yield result


@pytest.fixture
def private_sink() -> Iterator[Callable[[], Sink]]:
    """Starts sound servers for a test that breaks them."""
    with contextlib.ExitStack() as stack:
        yield lambda: stack.enter_context(Sink())


@pytest.fixture
def make_talk() -> Iterator[MakeTalk]:
    """Starts servers; each is stopped at the end, if the test did not end it, and what was watched is checked."""
    servers: list[Talk] = []

    def make(
        *options: str,
        scripted: bool = False,
        sink: Sink | None = None,
        driver: str | None = None,
        env: Mapping[str, str] | None = None,
        watched: bool = True,
    ) -> Talk:
        talk = Talk(options, scripted=scripted, sink=sink, driver=driver, env=env, watched=watched)
        servers.append(talk)
        return talk

    with contextlib.ExitStack() as stack:
        # Entered before the first server and left in reverse: all are closed, whichever fails its check.
        stack.callback(_close, servers)
        yield make
        for talk in servers:
            if talk.running:
                talk.stop()
            else:
                talk.check()


@pytest.fixture
def talk(make_talk: MakeTalk, sink: Sink) -> Talk:
    """A server with the real engine at the recorded sink."""
    return make_talk(sink=sink)


@pytest.fixture
def scripted(make_talk: MakeTalk) -> Talk:
    """A server with the scripted engine, without sound: goals say what it does, see `tests.support.script`."""
    return make_talk(scripted=True)


def _close(servers: Sequence[Talk]) -> None:
    for talk in servers:
        talk.close()
