"""`talk serve`, from the lock to the last goodbye: one server, who is connected to it, and what it says of itself."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import os
import random
import signal
import string
import time
from typing import TYPE_CHECKING

from talkcli import __version__, peers
from talkcli.daemon import log
from talkcli.daemon.systemd import ServiceManager
from talkcli.engine import protocol
from talkcli.engine.parent.supervisor import Supervisor
from talkcli.engine.protocol import START_LIMIT_S
from talkcli.engine.voices import is_neural
from talkcli.errors import EXIT_OK, EXIT_SIGNAL, AddressInUse, TalkError, UsageError, memory_limits
from talkcli.frozen import frozen, replace
from talkcli.goals.goal import Sender
from talkcli.goals.options import INITIAL, MAX_CHARACTERS, Say, Set, as_shown
from talkcli.goals.scheduler import Scheduler
from talkcli.protocol.events import PROTOCOL, busy_greeting, greeting
from talkcli.protocol.lines import encode
from talkcli.server.connection import Connection
from talkcli.server.listener import InheritedListener, Listener, listen, may_pass
from talkcli.server.requests import Requests
from talkcli.server.speech import Speech
from talkcli.server.stream import Acceptor, make_room

if TYPE_CHECKING:
    from talkcli.goals.goal import JsonObject

#: Clients at once. Each takes a descriptor of the 1,024 that a process usually has.
MAX_CLIENTS = 256
#: Goals that may wait: at two seconds a sentence, more than three minutes of speech that nobody can still want to hear.
MAX_QUEUE = 100
#: Megabytes of neural voices' models that are kept in memory: four of middle size, as Piper calls it.
VOICE_MEMORY = 300
MEGABYTE = 1_000_000
#: Places at the door of a full server, for clients that want to know its status or to silence it.
DOOR = 16
#: Seconds between two looks whether clients find the socket. Nobody reaches the server meanwhile, and 30 s is what is
#: promised; it is two calls of lstat, so it costs a machine at rest nothing.
LOOK_EVERY = 10.0
#: Seconds in which clients take their last answers before they are let go.
_GOODBYE = 0.3
#: Seconds in which the engine process must be gone before the server leaves it to the system.
_ENGINE_GOODBYE = 1.0


@frozen
class Settings:
    """What `talk serve` is told by its command line."""

    #: of goals that bring none of their own; all of them are given
    goals: Set = INITIAL
    max_queue: int = MAX_QUEUE
    max_text: int = MAX_CHARACTERS
    max_clients: int = MAX_CLIENTS
    player: str | None = None
    device: str | None = None
    lead_in: int = 0  # milliseconds of silence before a sentence, where the device has been idle
    audible: bool = False  # whether sentences are aborted whose output is muted, unless they say otherwise
    driver: str | None = None
    voice_memory: int = VOICE_MEMORY
    socket: str | None = None
    socket_mode: int = 0o600
    greeting: str | None = None

    @property
    def for_player(self) -> list[str]:
        """The options that were given and are a player's."""
        given = {"--player": self.player, "--device": self.device, "--lead-in": self.lead_in}
        return [name for name, value in given.items() if value]


def serve(settings: Settings) -> int:
    """Serve until SIGTERM or SIGINT, and return the exit code.

    AddressInUse if another server serves, or the socket's directory isn't safe; UsageError if the voice isn't known.
    """
    gc.freeze()  # what is imported stays: a full collection that looks at all of it keeps clients waiting for 10 ms
    listener = listen(settings.socket, settings.socket_mode)

    async def run() -> None:
        await Server(settings, listener).run()

    try:
        asyncio.run(run())
    finally:
        listener.close()
    return EXIT_OK


class Server:
    """One server, made in its event loop. It is the handler of its connections."""

    def __init__(self, settings: Settings, listener: Listener | InheritedListener) -> None:
        self._settings = settings
        self._listener = listener
        self._loop = asyncio.get_running_loop()
        self._scheduler = Scheduler(
            _boot(), max_queue=settings.max_queue, max_text=settings.max_text, settings=settings.goals
        )
        self.speech = Speech(self._scheduler, settings.for_player, settings.voice_memory * MEGABYTE)
        self.speech.lost = self._end
        self.speech.voices.driver = settings.driver
        self._systemd = ServiceManager(self._loop, self.speech.words)
        self.speech.changed = self._systemd.schedule_status
        self._requests = Requests(self.speech, self._describe)
        self.handle, self.owes = self._requests.handle, self._requests.owes
        self.greeting = encode(greeting(__version__, os.getpid(), self._scheduler.boot))
        self.connections: set[Connection] = set()
        #: set while there is no client
        self._deserted = asyncio.Event()
        self._deserted.set()
        #: why it must end at once: what it was told to do can't be done
        self._fatal: TalkError | None = None
        self._began = time.time(), time.monotonic()
        #: why clients can't reach it, as was last said
        self._unreachable = ""
        # A shell without job control starts what is in the background with SIGINT ignored: so it stays.
        ignored = signal.getsignal(signal.SIGINT) == signal.SIG_IGN
        self._ended_by = [signal.SIGTERM] if ignored else [signal.SIGTERM, signal.SIGINT]

    async def run(self) -> None:
        """Serve until it is told to end."""
        settings, speech = self._settings, self.speech
        descriptors = make_room(settings.max_clients + DOOR)
        self._acceptor = Acceptor(self._loop, lambda each: Connection(self, speech.streams, each).begin(), descriptors)
        self._loop.set_exception_handler(log.handle_loop_error)
        for number in self._ended_by:
            self._loop.add_signal_handler(number, self._on_signal, number)
        signal.signal(signal.SIGHUP, signal.SIG_IGN)  # a terminal that goes away doesn't take the voice along
        signal.pthread_sigmask(signal.SIG_SETMASK, ())  # whoever started this may have had some of them blocked
        voice = self._voice()
        speech.engine = Supervisor(
            protocol.Configure(
                os.getpid(),
                settings.driver,
                settings.player,
                settings.device,
                voice,
                settings.lead_in,
                audible=settings.audible,
            ),
            speech.report,
        )
        try:
            speech.engine.thread.start()
        except RuntimeError as error:  # all that Python says of a thread that it can't have
            raise TalkError(f"the engine's thread cannot be started: {memory_limits()}") from error
        try:
            self._acceptor.open(self._listener.socket)
            self._next_look = self._loop.call_later(LOOK_EVERY, self._look_after_socket)
            if voice or settings.driver:
                # Who asked for what can't be had is told so, and nothing else.
                with contextlib.suppress(asyncio.TimeoutError):
                    await asyncio.wait_for(speech.engine_known.wait(), START_LIMIT_S)
            if not self._scheduler.closing:
                self._systemd.notify_ready()
                log.write(f"ready on {self._listener.path} (pid {os.getpid()})")
            if settings.greeting:
                itself = Sender(os.getpid(), os.getuid(), "talk")
                speech.apply(self._scheduler.submit(Say(settings.greeting), itself, speech.now()).effects)
            await speech.finished.wait()
            self._next_look.cancel()
            self._acceptor.close()
            await self._say_goodbye()
        finally:
            speech.engine.close()
            speech.engine.thread.join(_ENGINE_GOODBYE)
            self._systemd.close()
        if self._fatal:
            raise self._fatal

    def _voice(self) -> str | None:
        """Return the voice that the engine process is to know in its start; UsageError for a neural one nobody has.

        A neural one is no part of its start: it is loaded beside the speech, and what is wrong with it costs nothing.
        """
        voices = self.speech.voices
        voice = voices.meant(self._settings.goals.voice)
        if voice is None or not is_neural(voice):
            return voice
        fault = voices.fault(voice)
        if fault:
            raise UsageError(fault[1])
        self._scheduler.settings = replace(self._scheduler.settings, voice=voice)
        return None

    def _look_after_socket(self) -> None:
        """See whether clients find the socket, and bind it again where they don't; connections live on."""
        self._next_look = self._loop.call_later(LOOK_EVERY, self._look_after_socket)
        if self._listener.in_place():
            self._unreachable = ""
            return
        try:
            former = self._listener.bind_again()
        except AddressInUse as error:
            if not (self._listener.passed or may_pass(error)):
                # Clients find another server, or none; a supervisor that starts this one again will hear why.
                self._next_look.cancel()
                log.write(log.sanitize(f"ending: {error}"))
                self._end(error)
            elif str(error) != self._unreachable:
                self._unreachable = str(error)
                log.write(log.sanitize(f"clients can't reach this server: {error}"))
            return
        self._unreachable = ""
        log.write(f"the socket's file or its lock was gone or another: bound again at {self._listener.path}")
        self._acceptor.open(self._listener.socket)
        if former:
            former.close()

    # -- the handler of the connections

    def joined(self, connection: Connection) -> None:
        """Admit a client, let it wait at the door of a full server, or turn it away."""
        pid, uid = peers.credentials(connection.stream.socket)
        # The socket's mode may let others in than its owner.
        if uid not in {os.getuid(), 0} and not self._listener.mode & 0o066:
            words = f"this server is uid {os.getuid()}'s; it would have to be started with --socket-mode"
            refusal = {"talk": PROTOCOL, "error": "permission_denied", "message": words}
        elif len(self.connections) >= self._settings.max_clients + DOOR:
            refusal = busy_greeting()
        else:
            connection.sender = Sender(pid or None, uid, peers.command_name(pid), peers.parent_command_line(pid))
            if len(self.connections) < self._settings.max_clients:
                connection.admit()
            self.connections.add(connection)
            self._deserted.clear()
            return
        connection.part(refusal)

    def left(self, connection: Connection) -> None:
        """Forget a client; its goals go on."""
        self.connections.discard(connection)
        if not self.connections:
            self._deserted.set()
        waiting = [each for each in self.connections if not each.admitted]
        if waiting and len(self.connections) - len(waiting) < self._settings.max_clients:
            waiting[0].admit()  # it was at the door, for this place
        self._requests.left(connection)

    # -- what it says of itself

    def _describe(self) -> JsonObject:
        speech, settings, scheduler, ready = self.speech, self._settings, self._scheduler, self.speech.ready
        started_at, since = self._began
        return {
            "pid": os.getpid(),
            "version": __version__,
            "boot": scheduler.boot,
            "socket": self._listener.path,
            "started_at": started_at,
            "uptime": time.monotonic() - since,
            "engine": speech.engine_words,
            "driver": ready.driver if ready else settings.driver,
            "synthesizer": ready.version if ready else None,
            "player": ready.player if ready else settings.player,
            "device": settings.device,
            "lead_in": settings.lead_in,
            "audible": settings.audible,
            **as_shown(scheduler.settings),
            "neural_voices": speech.voices.to_json(),
            "paused": scheduler.paused,
            "pending": scheduler.pending_count,
            "max_queue": settings.max_queue,
            "clients": len(self.connections),
            "max_clients": settings.max_clients,
        }

    # -- the end

    def _end(self, fatal: TalkError | None = None) -> None:
        """End every goal, and then the server. `fatal`: what can't be done any more, for whoever started it."""
        self._fatal = fatal or self._fatal
        self._systemd.notify_stopping()
        self._requests.shut_down()

    async def _say_goodbye(self) -> None:
        """Let every client take what was written for it, but wait for none that doesn't read."""
        for connection in list(self.connections):
            connection.stream.close()
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(self._deserted.wait(), _GOODBYE)
        for connection in list(self.connections):
            connection.stream.abort()

    def _on_signal(self, number: signal.Signals) -> None:
        log.write(f"{signal.Signals(number).name}: ending")
        for each in self._ended_by:
            # Not by the loop, which may have a long turn to finish: whoever asks twice wants no goodbye.
            signal.signal(each, self._on_second_signal)
        self._end()

    def _on_second_signal(self, number: int, _: object) -> None:
        """End at once; the engine process dies with this one."""
        with contextlib.suppress(OSError):
            self._listener.close()
        os._exit(EXIT_SIGNAL + number)


def _boot() -> str:
    """Return the four characters that set this server's goals apart from those of one before; see `goals.options`."""
    choice = random.SystemRandom().choice
    return "".join(choice(each) for each in (string.digits, string.ascii_lowercase) * 2)
