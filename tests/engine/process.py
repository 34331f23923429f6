"""An engine process that is started as by the server, and controlled with the protocol's messages."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import time
from typing import TYPE_CHECKING, TypeVar

from talkcli.engine import protocol
from talkcli.goals.options import SOUND, is_neural

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from typing import Any

_E = TypeVar("_E", bound=protocol.Event)

#: Seconds after which a message is late even on a busy machine.
PATIENCE = 20.0
#: Words per minute. Most tests use the fast rate, which more than halves the time of a sentence. Drivers other than
#: espeak get the usual rate, because they may be unable to set another one.
FAST = 450
USUAL = 200
#: Seconds between signs of life in tests that wait for one to let some time pass.
SOON = 0.1
#: Wraps a function of `talkcli.engine.child` with code that runs first.
_BEFORE_CALL = """
import importlib, sys, threading, time
def wrap(module, path):
    *names, name = path.split(".")
    owner = importlib.import_module("talkcli.engine.child." + module)
    for part in names:
        owner = getattr(owner, part)
    original, seen = getattr(owner, name), []
    def wrapped(*arguments, **more):
        {does}
        return original(*arguments, **more)
    setattr(owner, name, wrapped)
wrap({module!r}, {path!r})
"""


def before_call(function: str, does: str) -> str:
    """Return code that makes a function of the engine do something else first.

    Args:
        function: the name of the function, such as "players.pulse:PulsePlayer.offer".
        does: a line of Python. It can use the call's `arguments`, and a list `seen` that all calls share.
    """
    module, _, path = function.partition(":")
    return _BEFORE_CALL.format(module=module, path=path, does=does)


class Engine:
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
        sounds: str | None = None,
    ) -> None:
        """Start the process.

        Args:
            limits: new values for constants of the playback.
            before: code that the process runs first.
            alive_every: seconds between signs of life, or None for the protocol's interval.
        """
        self.events: list[protocol.Event] = []
        self._rate = FAST if driver in (None, "espeak") else USUAL
        self._rest = b""
        self._ahead: list[protocol.Event | None] = []
        self._pauses = 0
        self._unfinished: set[str] = set()
        self._socket, child_socket = socket.socketpair()
        self._socket.settimeout(PATIENCE)
        self.liveness, inherited = os.pipe()
        settings = "".join(f"playback.{name} = {value}\n" for name, value in (limits or {}).items())
        if alive_every is not None:
            settings += f"from talkcli.engine import protocol\nprotocol.ALIVE_INTERVAL_S = {alive_every}\n"
        path = f"import sys\nsys.path[:] = {sys.path!r}\n"
        code = f"{path}{before}\nfrom talkcli.engine.child import playback\n{settings}"
        with child_socket:
            self.process = subprocess.Popen(
                [sys.executable, "-S", "-c", f"{code}from talkcli.engine.child.main import main\nmain()"],
                stdin=child_socket.fileno(),
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                pass_fds=[inherited],
                env={**os.environ, **(environment or {}), "TALK_LIVENESS_FD": str(inherited)},
                start_new_session=True,
            )
        os.close(inherited)
        self.send(
            protocol.Configure(
                server or os.getpid(), driver, player, device, voice, lead_in, list_voices, sounds=sounds
            )
        )

    def __enter__(self) -> Engine:
        """Wait until the process accepts commands. The first event remains to be read."""
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
        """Whether the process is running and all its goals have ended."""
        return self.process.poll() is None and not self._unfinished

    def send(self, *commands: protocol.Command) -> None:
        """Send commands in one piece, so that the process reads them together."""
        self._unfinished.update(command.id for command in commands if isinstance(command, protocol.Speak))
        self._socket.sendall(b"".join(map(protocol.encode, commands)))

    def leave(self) -> None:
        """Close the sending side, so that the process ends. Its events can still be read."""
        self._socket.shutdown(socket.SHUT_WR)

    def hang_up(self) -> None:
        """Close the connection in both directions, as the kernel does when the server dies."""
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
            voice_only = voice is not None and is_neural(voice)  # without a fallback to espeak
        rate = rate or self._rate
        self.send(
            protocol.Speak(goal, text, rate, 1.0, voice, pitch, next_waits, lead_in=lead_in, voice_only=voice_only)
        )

    def play(self, sound: str, goal: str = "g1", *, volume: float = 1.0, **fields: Any) -> None:
        self.send(protocol.Speak(goal, sound, USUAL, volume, None, 50, format=SOUND, **fields))

    def pause(self, goal: str = "g1") -> float:
        """Pause the sentence, and return the seconds until the process confirmed silence."""
        requested_at = time.monotonic()
        self._pauses += 1
        self.send(protocol.Hold(goal, self._pauses))
        assert self.until(protocol.Held) == protocol.Held(goal, self._pauses)
        return time.monotonic() - requested_at

    def resume(self, goal: str = "g1") -> None:
        self.send(protocol.Continue(goal))

    def until_word(self, number: int = 1) -> protocol.Word:
        """Wait for the word with this number or a later one, and return it."""
        while (word := self.until(protocol.Word)).number < number:
            pass
        return word

    def stop(self, goal: str = "g1") -> float:
        """Stop the sentence, and return the seconds until the process confirmed its end."""
        requested_at = time.monotonic()
        self.send(protocol.Stop(goal))
        ended = self.until(protocol.Ended)
        assert (ended.id, ended.outcome) == (goal, protocol.OUTCOME_STOPPED), ended
        return time.monotonic() - requested_at

    def event(self) -> protocol.Event | None:
        """Return the next event, or None at the end of the connection."""
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
        """Say a sentence with the options of `say`, and return the event of its end."""
        self.say(text, goal, **more)
        ended = self.until(protocol.Ended)
        assert ended.id == goal, ended
        return ended

    def words(self, goal: str = "g1") -> list[protocol.Word]:
        return [event for event in self.events if isinstance(event, protocol.Word) and event.id == goal]

    def errors(self) -> str:
        """Wait for the end of the process, and return its standard error."""
        assert self.process.stderr is not None
        return self.process.stderr.read().decode()

    def errors_line(self) -> str:
        """Wait for the next line on the process's standard error, and return it."""
        assert self.process.stderr is not None
        return self.process.stderr.readline().decode().strip()

    def errors_so_far(self) -> bytes:
        """Return what the process has written to standard error and was not read, without waiting."""
        assert self.process.stderr is not None
        os.set_blocking(self.process.stderr.fileno(), False)
        data: bytes | None = self.process.stderr.read()
        os.set_blocking(self.process.stderr.fileno(), True)
        return data or b""

    def all_gone(self, seconds: float = 2.0) -> bool:
        """Return whether the process and its player end within this time."""
        os.set_blocking(self.liveness, False)
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            try:
                return os.read(self.liveness, 1) == b""
            except BlockingIOError:
                time.sleep(0.002)
        return False


class SharedEngine:
    """An engine process for several tests. After a failed test or an unfinished goal, a new process replaces it."""

    def __init__(self, start: Callable[[], Engine]) -> None:
        self._start, self._stack = start, contextlib.ExitStack()
        self._engine: Engine | None = None
        self._failed = 0

    def take(self, failed: int) -> Engine:
        """Return an idle process without old events. `failed` is the number of tests that have failed so far."""
        if self._engine is None or not self._engine.idle or failed != self._failed:
            self.close()
            self._engine, self._failed = self._stack.enter_context(self._start()), failed
            self._engine.until(protocol.VoiceList)
        self._engine.events.clear()
        return self._engine

    def close(self) -> None:
        self._stack.close()
