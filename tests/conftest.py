"""Fixtures: sound servers, servers with the real and the scripted engine, and what must hold of each when it ends."""

from __future__ import annotations

import contextlib
import signal
from typing import TYPE_CHECKING, Protocol

import pytest

from tests.support.company import company
from tests.support.processes import Talk
from tests.support.sink import Sink

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence


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
    """Run beside other tests; alone what listens, and what is marked so."""
    listens = not {"sink", "private_sink"}.isdisjoint(request.fixturenames)
    if listens or request.node.get_closest_marker("alone"):
        company.stay_alone()
    else:
        company.join()
    yield
    company.leave()


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
