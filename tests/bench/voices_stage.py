"""What the rows of neural voices are measured with: a sink, and servers that have such a voice loaded."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tests.bench.stage import SinkStage
from tests.support.census import descendants
from tests.support.loaded import await_loaded
from tests.support.processes import Talk
from tests.support.real_voice import REAL_VOICE
from tests.support.surroundings import short_directory

if TYPE_CHECKING:
    from collections.abc import Iterator

#: By its id: "en" is the language, and in such a server the neural voice of it.
ESPEAK = "gmw/en"
#: The voices that take turns, by what they are called in the table.
VOICES = {"joe": REAL_VOICE, "espeak": ESPEAK}


@dataclass(frozen=True, slots=True)
class VoiceOptions:
    """How much is measured."""

    rounds: int = 15
    kills: int = 20
    texts: int = 10
    idle: float = 10.0  # seconds


class VoiceStage(SinkStage):
    """Gives what a row needs; `with` ends all of it."""

    def __init__(self, options: VoiceOptions) -> None:
        super().__init__(18)
        self.options = options
        self._home = self._stack.enter_context(short_directory("voices-"))

    @contextlib.contextmanager
    def server(self, *options: str, heard: bool = True, env: dict[str, str] | None = None) -> Iterator[Talk]:
        """Run a server that has the voice loaded and speaks with it; one that is not `heard` needs no sink."""
        places = {"XDG_CACHE_HOME": f"{self._home}/cache", **(env or {})}
        sink = self.sink if heard else None
        talk = Talk(("--voice", REAL_VOICE, *options), sink=sink, env=places, forked=False)
        try:
            await_loaded(talk.socket, REAL_VOICE)
            yield talk
            talk.stop()
        finally:
            talk.close()


def engine_of(talk: Talk) -> int:
    """Return the process id of a server's engine, which must be there."""
    (found,) = descendants(talk.pid)
    return found
