"""What the rows of a fleet are measured with: a broker, with TLS or without, and a robot, its server and its bridge."""

from __future__ import annotations

import contextlib
import random
import re
import subprocess
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

from talkcli import Client
from talkcli.fleet.broker import from_environment
from talkcli.fleet.robot import reach
from tests.fleet.robot import Robot
from tests.support.bridge import Bridge, Desk
from tests.support.broker import Broker
from tests.support.processes import Talk
from tests.support.surroundings import find_program

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

ROBOT = "anna"


@dataclass(frozen=True, slots=True)
class FleetOptions:
    """How much is measured."""

    rounds: int = 60
    idle: float = 60.0  # seconds


class Site:
    """A robot at a broker, and who asks it: at a desk, or on the robot itself."""

    def __init__(self, robot: Robot, env: dict[str, str]) -> None:
        self.robot = robot
        #: of a desk's commands
        self.env = env

    def desk(self) -> Client:
        """Return a connection by the broker."""
        return Client.over(reach(ROBOT, from_environment(self.env), name="bench"))

    def local(self) -> Client:
        """Return a connection to the robot's own socket."""
        return Client(self.robot.talk.socket, name="bench")


class FleetStage(contextlib.AbstractContextManager["FleetStage"]):
    """Gives what a row needs, each when the first row needs it; `with` ends all of it."""

    def __init__(self, options: FleetOptions) -> None:
        self.options = options
        self._chance = random.Random(19)
        self._stack = contextlib.ExitStack()

    def __exit__(self, *_error: object) -> None:
        self._stack.close()

    @cached_property
    def plain(self) -> Site:
        """A robot at a broker that is as it comes."""
        return self._stack.enter_context(_site(secure=False))

    @cached_property
    def secure(self) -> Site:
        """The same by TLS."""
        return self._stack.enter_context(_site(secure=True))

    def shuffled(self, numbers: Sequence[int]) -> list[int]:
        """Return the numbers in another order each time, and in the same ones each run."""
        return self._chance.sample(numbers, len(numbers))

    def mosquitto(self) -> str:
        """Return the version of the broker."""
        done = subprocess.run([find_program("mosquitto") or "", "-h"], capture_output=True, text=True, check=False)
        found = re.search(r"mosquitto version (\S+)", done.stdout)
        return found.group(1) if found else "unknown"


@contextlib.contextmanager
def _site(*, secure: bool) -> Iterator[Site]:
    with contextlib.ExitStack() as stack:
        broker = stack.enter_context(Broker(secure=secure))
        talk = Talk(("--player", "null"), watched=False, forked=False)
        stack.callback(talk.close)
        bridge = stack.enter_context(Bridge(talk, broker, ROBOT))
        bridge.await_online()
        desk = stack.enter_context(Desk(broker, user="desk", password=False))
        yield Site(Robot(talk, broker, bridge), desk.env)
        bridge.terminate()
        talk.stop()
