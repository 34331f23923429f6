"""A conversation with one engine process of one's own, for one text or a few in their order: `say -o`, `talk doctor`.

It waits in the caller's thread and keeps the limits of `protocol`. When it is over, however that came, the process and
its player are gone. It decides nothing about what is said: which text comes next, and what an end means, is for who
asks. What a server speaks with, for months, is the supervisor's.
"""

from __future__ import annotations

import select
import time
from typing import TYPE_CHECKING

from talkcli.client.connect import ready
from talkcli.engine import protocol
from talkcli.engine.process import EngineProcess
from talkcli.engine.protocol import HANG_AFTER, SILENCE_LIMIT, START_LIMIT

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping


class EngineFailed(Exception):
    """The engine process failed: `reason` is for programs, as a goal has it. For `engine_crashed` the text says how."""

    def __init__(self, reason: str, words: str) -> None:
        super().__init__(words)
        self.reason = reason


class EngineSilent(EngineFailed):
    """The engine process has said nothing for `seconds`."""

    def __init__(self, reason: str, words: str, seconds: float) -> None:
        super().__init__(reason, words)
        self.seconds = seconds


class Conversation:
    """A started engine process, from the `with` to its end; EngineFailed where it can't be started."""

    def __init__(
        self,
        configure: protocol.Configure,
        *,
        env: Mapping[str, str] | None = None,
        deadline: float | None = None,
        interrupt: Mapping[int, int] | None = None,
    ) -> None:
        """`env`: the process's environment, if not this one's; `deadline`: the monotonic time by which all is over.

        `interrupt`: what ends any waiting with Interrupted, as in `connect.ready`.
        """
        self._configure = configure
        self._env = env
        self._deadline = float("inf") if deadline is None else deadline
        self._interrupt = interrupt

    def __enter__(self) -> Conversation:
        try:
            self._process = EngineProcess(self._configure, env=self._env)
        except OSError as error:
            raise EngineFailed("engine_failed", f"the engine process cannot be started: {error}") from error
        self._heard_at = time.monotonic()
        return self

    def __exit__(self, *_: object) -> None:
        """Kill the process and see it gone: it could write to its file once more."""
        self._process.kill()
        ready({self._process.liveness: select.POLLIN}, SILENCE_LIMIT)
        self._process.close()

    def say(self, say: protocol.Say) -> None:
        """Have a text spoken; the process must be ready, and have ended the one before."""
        self._heard_at = time.monotonic()
        if not self._process.send(say):
            for _ in self._received():
                pass  # where it is dead, it is known how it died
            raise EngineFailed("engine_hung", "the engine takes no commands")

    def events(self) -> Iterator[protocol.Event]:
        """Give what the process says, without an end; EngineFailed, TimeoutError past the deadline, Interrupted."""
        process = self._process
        watched = {process.socket.fileno(): select.POLLIN, process.stderr: select.POLLIN}
        while True:
            due = min(self._heard_at + self._limit(), self._deadline)
            found = ready(watched, due - time.monotonic(), self._interrupt)
            if process.stderr in found and not process.read_stderr():
                del watched[process.stderr]
            # Before the limits: who was stopped by Ctrl-Z finds all that was said meanwhile, and the limits long past.
            if process.socket.fileno() in found:
                yield from self._received()
            self._keep_limits()

    def _received(self) -> Iterator[protocol.Event]:
        for event in self._process.receive():
            self._heard_at = time.monotonic()
            if event is None:
                raise EngineFailed("engine_crashed", self._process.last_words())
            if isinstance(event, protocol.StartFailed):
                raise EngineFailed(event.reason, event.message)
            if isinstance(event, protocol.Ready):
                self._process.ready = True
            yield event

    def _limit(self) -> float:
        return HANG_AFTER if self._process.ready else START_LIMIT

    def _keep_limits(self) -> None:
        now = time.monotonic()
        if now >= self._deadline:
            raise TimeoutError
        if now < self._heard_at + self._limit():
            return
        if not self._process.ready:
            words = f"the engine was not ready after {START_LIMIT:g} s"
            raise EngineSilent("engine_failed", words, START_LIMIT)
        raise EngineSilent("engine_hung", f"the engine gave no sign of life for {HANG_AFTER:g} s", HANG_AFTER)
