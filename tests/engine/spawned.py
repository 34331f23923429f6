"""An engine process started the way the server starts it, driven by the protocol's messages."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import time
from typing import TYPE_CHECKING, TypeVar

from talkcli.engine import protocol
from talkcli.goals.options import is_neural

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from typing import Any

_E = TypeVar("_E", bound=protocol.Event)

#: Seconds after which a message is late on the busiest machine.
PATIENCE = 20.0
#: Words a minute in tests of something else: a sentence takes less than half as long as at talk's own rate. Another
#: driver is told its own rate, which it need not set.
FAST = 450
USUAL = 200
#: Seconds between two signs of life in tests that wait for one to let some time pass.
SOON = 0.1


#: Wraps a function of the package.
_FIRST = """
import importlib, sys, threading, time
def wrap(module, path):
    *names, name = path.split(".")
    owner = importlib.import_module("talkcli.engine.child." + module)
    for each in names:
        owner = getattr(owner, each)
    original, seen = getattr(owner, name), []
    def wrapped(*arguments, **more):
        {does}
        return original(*arguments, **more)
    setattr(owner, name, wrapped)
wrap({module!r}, {path!r})
"""


def first(function: str, does: str) -> str:
    """Return code that has a function of the engine, as "players.pulse:PulsePlayer.offer", do something first.

    That is a line of Python, which sees its `arguments`, and a list `seen` that stays.
    """
    module, _, path = function.partition(":")
    return _FIRST.format(module=module, path=path, does=does)


class Spawned:
    """A running engine process. Leaving the context kills it and its player."""

    def __init__(
        self,
        player: str | None = "null",
        *,
        driver: str | None = None,
        device: str | None = None,
        voice: str | None = None,
        server: int | None = None,
        limits: Mapping[str, float] | None = None,
        before: str = "",
        environment: Mapping[str, str] | None = None,
        lead_in: int = 0,
        list_voices: bool = True,
        alive_every: float | None = None,
    ) -> None:
        """`limits` replaces constants of the playback, `before` is code that runs in the process first.

        `alive_every`: seconds between signs of life, if not the protocol's.
        """
        self.events: list[protocol.Event] = []
        self._rate = FAST if driver in (None, "espeak") else USUAL
        self._rest = b""
        self._ahead: list[protocol.Event | None] = []
        self._pauses = 0
        self._unfinished: set[str] = set()
        self._socket, theirs = socket.socketpair()
        self._socket.settimeout(PATIENCE)
        self.liveness, inherited = os.pipe()
        settings = "".join(f"playback.{name} = {value}\n" for name, value in (limits or {}).items())
        if alive_every is not None:
            settings += f"from talkcli.engine import protocol\nprotocol.ALIVE_INTERVAL_S = {alive_every}\n"
        path = f"import sys\nsys.path[:] = {sys.path!r}\n"
        code = f"{path}{before}\nfrom talkcli.engine.child import playback\n{settings}"
        with theirs:
            self.process = subprocess.Popen(
                [sys.executable, "-c", f"{code}from talkcli.engine.child.main import main\nmain()"],
                stdin=theirs.fileno(),
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                pass_fds=[inherited],
                env={**os.environ, **(environment or {}), "TALK_LIVENESS_FD": str(inherited)},
                start_new_session=True,
            )
        os.close(inherited)
        self.send(protocol.Configure(server or os.getpid(), driver, player, device, voice, lead_in, list_voices))

    def __enter__(self) -> Spawned:
        """Wait for the first event, behind which it takes commands; it can still be read."""
        self._ahead.append(self.event())
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()
        self._socket.close()
        os.close(self.liveness)
        if self.process.stderr is not None:
            self.process.stderr.close()

    @property
    def idle(self) -> bool:
        """Whether it runs, and all its goals have ended."""
        return self.process.poll() is None and not self._unfinished

    def send(self, *commands: protocol.Command) -> None:
        """Send commands in one piece, so that they are read at once."""
        self._unfinished.update(each.id for each in commands if isinstance(each, protocol.Speak))
        self._socket.sendall(b"".join(map(protocol.encode, commands)))

    def leave(self) -> None:
        """Send nothing more, and let the process end; its events can still be read."""
        self._socket.shutdown(socket.SHUT_WR)

    def hang_up(self) -> None:
        """Close the connection both ways, as the kernel does when the server dies."""
        self._socket.shutdown(socket.SHUT_RDWR)

    def say(
        self,
        text: str,
        goal: str = "g1",
        *,
        rate: int | None = None,
        voice: str | None = None,
        pitch: int = 50,
        lead_in: int | None = None,
        next_waits: bool = False,
        voice_only: bool | None = None,
    ) -> None:
        if voice_only is None:
            voice_only = voice is not None and is_neural(voice)  # what is asked for is heard, or it fails
        rate = rate or self._rate
        self.send(
            protocol.Speak(goal, text, rate, 1.0, voice, pitch, next_waits, lead_in=lead_in, voice_only=voice_only)
        )

    def pause(self, goal: str = "g1") -> float:
        """Hold the sentence and return the seconds until the process said that it is silent."""
        asked = time.monotonic()
        self._pauses += 1
        self.send(protocol.Hold(goal, self._pauses))
        assert self.until(protocol.Held) == protocol.Held(goal, self._pauses)
        return time.monotonic() - asked

    def resume(self, goal: str = "g1") -> None:
        self.send(protocol.Continue(goal))

    def until_word(self, number: int = 1) -> protocol.Word:
        """Return the word of this number, or the first one after it."""
        while (word := self.until(protocol.Word)).number < number:
            pass
        return word

    def stop(self, goal: str = "g1") -> float:
        """Stop the sentence and return the seconds until the process said that it has ended."""
        asked = time.monotonic()
        self.send(protocol.Stop(goal))
        ended = self.until(protocol.Ended)
        assert (ended.id, ended.outcome) == (goal, protocol.OUTCOME_STOPPED), ended
        return time.monotonic() - asked

    def event(self) -> protocol.Event | None:
        """Return the next event, None at the end of the connection."""
        if self._ahead:
            return self._ahead.pop()
        while b"\n" not in self._rest:
            data = self._socket.recv(65536)
            if not data:
                return None
            self._rest += data
        line, self._rest = self._rest.split(b"\n", 1)
        event = protocol.decode(line, protocol.EVENT_CLASSES)
        self.events.append(event)
        if isinstance(event, protocol.Ended):
            self._unfinished.discard(event.id)
        return event

    def until(self, kind: type[_E]) -> _E:
        """Return the next event of this kind."""
        while (event := self.event()) is not None:
            if isinstance(event, kind):
                return event
        raise AssertionError(f"no {kind.__name__} before the process ended: {self.errors()}")

    def spoken(self, text: str, goal: str = "g1", **more: Any) -> protocol.Ended:
        """Say a sentence and return how it ended; `more`: as in `say`."""
        self.say(text, goal, **more)
        ended = self.until(protocol.Ended)
        assert ended.id == goal, ended
        return ended

    def words(self, goal: str = "g1") -> list[protocol.Word]:
        return [event for event in self.events if isinstance(event, protocol.Word) and event.id == goal]

    def errors(self) -> str:
        """Return the standard error of the process; waits for its end."""
        assert self.process.stderr is not None
        return self.process.stderr.read().decode()

    def errors_line(self) -> str:
        """Return the next line that the process writes to standard error; waits for it."""
        assert self.process.stderr is not None
        return self.process.stderr.readline().decode().strip()

    def all_gone(self, seconds: float = 2.0) -> bool:
        """Return whether the process and its player are gone within that time."""
        os.set_blocking(self.liveness, False)
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            try:
                return os.read(self.liveness, 1) == b""
            except BlockingIOError:
                time.sleep(0.002)
        return False


class Shared:
    """An engine process for several tests. After a failure or an unfinished goal, the next test gets a new process."""

    def __init__(self, start: Callable[[], Spawned]) -> None:
        self._start, self._stack = start, contextlib.ExitStack()
        self._engine: Spawned | None = None
        self._failed = 0

    def take(self, failed: int) -> Spawned:
        """Return an idle process, without the events of the tests before. So many tests have `failed` until now."""
        if self._engine is None or not self._engine.idle or failed != self._failed:
            self.close()
            self._engine, self._failed = self._stack.enter_context(self._start()), failed
            self._engine.until(protocol.VoiceList)
        self._engine.events.clear()
        return self._engine

    def close(self) -> None:
        self._stack.close()
