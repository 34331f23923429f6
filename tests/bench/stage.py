"""What rows are measured with, each started when the first row needs it: sink, installed talk, speech-dispatcher."""

from __future__ import annotations

import contextlib
import os
import random
import shutil
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from tests.bench.dispatcher import dispatcher
from tests.bench.ear import fine_blocks
from tests.bench.installed import Installed, serve
from tests.support.sink import PROGRAMS, Sink
from tests.support.surroundings import clean_environment, short_directory

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from tests.bench.installed import Server

_Stage = TypeVar("_Stage", bound="SinkStage")

#: What to install for a program that is missing.
PACKAGES = {
    "pulseaudio": "pulseaudio",
    "pactl": "pulseaudio-utils",
    "parec": "pulseaudio-utils",
    "pacat": "pulseaudio-utils",
    "aplay": "alsa-utils libasound2-plugins",
    "espeak-ng": "espeak-ng",
    "spd-say": "speech-dispatcher",
    "speech-dispatcher": "speech-dispatcher speech-dispatcher-espeak-ng",
}
_SCRIPTED = str(Path(__file__).resolve().parents[1] / "support" / "scripted_serve.py")
PEERS = ("espeak-ng", "spd-say", "speech-dispatcher")


@dataclass(frozen=True, slots=True)
class Options:
    """How much is measured, and with what."""

    rounds: int = 15
    idle: float = 60.0  # seconds
    peers: bool = True
    venv: str | None = None
    refresh: bool = True
    #: what the rows of `onset` say
    text: str = "battery low"


def missing(*, peers: bool) -> dict[str, str]:
    """Return the programs that are not there, and the Debian packages that have them."""
    wanted = (*PROGRAMS, *(PEERS if peers else ()))
    return {each: PACKAGES[each] for each in wanted if shutil.which(each) is None}


class SinkStage:
    """A sink, and chance; `with` ends all that was entered."""

    def __init__(self, seed: int) -> None:
        self._chance = random.Random(seed)
        self._stack = contextlib.ExitStack()

    def __enter__(self: _Stage) -> _Stage:  # noqa: PYI019 - Self is in typing from Python 3.11 on
        return self

    def __exit__(self, *_error: object) -> None:
        self._stack.close()

    @cached_property
    def sink(self) -> Sink:
        """A sound server with one null sink, listened to from its start."""
        found = self._stack.enter_context(Sink())
        self._stack.enter_context(fine_blocks(found))
        return found

    def jitter(self, most: float = 0.02) -> float:
        """Return some seconds: two blocks of the sink, so that no row is measured at always the same moment of one."""
        return self._chance.random() * most

    def shuffled(self, names: Sequence[str]) -> list[str]:
        """Return the names in another order each time, and in the same ones each run."""
        return self._chance.sample(names, len(names))


class Stage(SinkStage):
    """Gives what a row needs; `close` or `with` ends all of it."""

    def __init__(self, options: Options) -> None:
        super().__init__(5)
        self.options = options

    @cached_property
    def plain(self) -> dict[str, str]:
        """The environment of a program that plays into the sink by itself."""
        env = clean_environment(self.sink.directory, self.sink.env)
        env.pop("PYTHONPATH", None)
        return env

    @cached_property
    def installed(self) -> Installed:
        """The environment that has talk."""
        directory = self.options.venv or f"{self._stack.enter_context(short_directory('bench-'))}/venv"
        found = Installed(os.path.abspath(directory))
        found.make(refresh=self.options.refresh)
        return found

    @cached_property
    def spd(self) -> dict[str, str]:
        """The environment in which `spd-say` finds a speech-dispatcher of ours."""
        return self._stack.enter_context(dispatcher(self.sink))

    @cached_property
    def speaking(self) -> Server:
        """A server with the real engine that plays into the sink, as one does that is told nothing."""
        return self._stack.enter_context(self.server())

    @contextlib.contextmanager
    def server(self, *options: str, heard: bool = True) -> Iterator[Server]:
        """Run a server of the installed talk with these options; one that is not `heard` needs no sink."""
        sound = self.sink.env if heard else {}
        with serve([self.installed.talk, "serve", *options], sound) as found:
            yield found

    def scripted(self, *options: str) -> list[str]:
        """Return the command of a server of the installed talk whose engine is scripted."""
        return [self.installed.python, _SCRIPTED, *options]
