"""`talk serve`: one server as a whole, its clients, its status and its end."""

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
from talkcli.errors import EXIT_OK, EXIT_SIGNAL, AddressInUse, TalkError, UsageError, memory_limits
from talkcli.frozen import frozen
from talkcli.goals.goal import Sender
from talkcli.goals.options import INITIAL, MAX_TEXT_CHARS, Say, Set, is_neural, shown_settings
from talkcli.goals.scheduler import Scheduler
from talkcli.goals.voices import VoiceScheduler
from talkcli.protocol.events import PROTOCOL, busy_greeting, greeting
from talkcli.protocol.lines import encode
from talkcli.server.connection import ClientConnection
from talkcli.server.listener import InheritedListener, Listener, is_temporary, listen
from talkcli.server.requests import Requests
from talkcli.server.speech import Speech
from talkcli.server.stream import Acceptor, raise_descriptor_limit
from talkcli.server.voices import VoiceCatalog

if TYPE_CHECKING:
    from talkcli.goals.goal import JsonObject

#: Clients at the same time. Each takes one of the 1,024 descriptors that a process usually has.
MAX_CLIENTS = 256
#: Goals that may be pending. At two seconds a sentence they take three minutes, and nobody wants to wait longer.
USUAL_QUEUE_GOALS = 100
#: Memory for neural voices: four of middle size.
VOICE_MEMORY_MB = 300
#: Clients that may connect to a full server, to ask for its status or to silence it.
MAX_EXTRA_CLIENTS = 16
#: How often to check that clients find the socket. The promise is that they can't reach the server for 30 s at most. A
#: check costs two system calls.
SOCKET_CHECK_S = 10.0
#: How long clients may take to read their last answers.
_CLIENT_CLOSE_S = 0.3
#: How long the engine process may take to end before the server leaves it to the system.
_ENGINE_CLOSE_S = 1.0


@frozen
class ServerSettings:
    """The options of `talk serve`."""

    #: the values of options that goals don't give; none of them is None
    goals: Set = INITIAL
    max_queue: int = USUAL_QUEUE_GOALS
    max_text: int = MAX_TEXT_CHARS
    max_clients: int = MAX_CLIENTS
    player: str | None = None
    device: str | None = None
    lead_in: int = 0  # milliseconds of silence before a sentence if the device has been idle
    audible: bool = False  # whether a sentence is aborted if its output is muted
    driver: str | None = None
    voice_memory: int = VOICE_MEMORY_MB
    socket: str | None = None
    socket_mode: int = 0o600
    greeting: str | None = None

    @property
    def player_options(self) -> list[str]:
        """The names of the options for the player that were given."""
        given = {"--player": self.player, "--device": self.device, "--lead-in": self.lead_in}
        return [name for name, value in given.items() if value]


def serve(settings: ServerSettings) -> int:
    """Serve until SIGTERM or SIGINT, and return the exit code.

    Raises:
        AddressInUse: another server serves, or the socket's directory isn't safe.
        UsageError: the voice is not known.
    """
    # Imported modules stay for ever. A full collection that looks at them delays clients by 10 ms.
    gc.freeze()
    listener = listen(settings.socket, settings.socket_mode)

    async def run() -> None:
        await Server(settings, listener).run()

    try:
        asyncio.run(run())
    finally:
        listener.close()
    return EXIT_OK


class Server:
    """One server, and the handler of its connections. It is created in its event loop."""

    def __init__(self, settings: ServerSettings, listener: Listener | InheritedListener) -> None:
        self._settings = settings
        self._listener = listener
        self._loop = asyncio.get_running_loop()
        self._scheduler = Scheduler(
            _random_boot_id(),
            max_queue=settings.max_queue,
            max_text=settings.max_text,
            settings=settings.goals,
            voices=VoiceScheduler(settings.voice_memory * 1_000_000, VoiceCatalog.file_size),
        )
        self.speech = Speech(self._scheduler, settings.player_options)
        self.speech.on_failure = self._end
        self.speech.voices.driver = settings.driver
        self._systemd = ServiceManager(self._loop, self.speech.status_words)
        self.speech.on_status_change = self._systemd.schedule_status
        self._requests = Requests(self.speech, self._describe)
        self.handle, self.is_waiting = self._requests.handle, self._requests.is_waiting
        self.greeting = encode(greeting(__version__, os.getpid(), self._scheduler.boot))
        self.connections: set[ClientConnection] = set()
        #: set while there is no client
        self._no_clients = asyncio.Event()
        self._no_clients.set()
        #: the error that ends the server, if there is one
        self._fatal_error: TalkError | None = None
        self._started_at = time.time(), time.monotonic()
        #: why clients can't reach the server, as last logged
        self._unreachable = ""
        # A shell without job control starts background processes with SIGINT ignored, and it must stay so.
        ignored = signal.getsignal(signal.SIGINT) == signal.SIG_IGN
        self._end_signals = [signal.SIGTERM] if ignored else [signal.SIGTERM, signal.SIGINT]

    async def run(self) -> None:
        """Serve until the server is told to end."""
        settings, speech = self._settings, self.speech
        descriptors = raise_descriptor_limit(settings.max_clients + MAX_EXTRA_CLIENTS)
        self._acceptor = Acceptor(
            self._loop, lambda each: ClientConnection(self, speech.streams, each).begin(), descriptors
        )
        self._loop.set_exception_handler(log.handle_loop_error)
        for number in self._end_signals:
            self._loop.add_signal_handler(number, self._on_signal, number)
        signal.signal(signal.SIGHUP, signal.SIG_IGN)  # the server goes on when its terminal is closed
        signal.pthread_sigmask(signal.SIG_SETMASK, ())  # the parent process may have blocked some signals
        voice = self._start_voice()
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
        except RuntimeError as error:  # Python raises nothing more specific
            raise TalkError(f"the engine's thread cannot be started: {memory_limits()}") from error
        try:
            self._acceptor.open(self._listener.socket)
            self._socket_check = self._loop.call_later(SOCKET_CHECK_S, self._check_socket)
            if voice or settings.driver:
                # If the voice or the driver is unknown, the error must be the only message.
                with contextlib.suppress(asyncio.TimeoutError):
                    await asyncio.wait_for(speech.engine_known.wait(), START_LIMIT_S)
            if not self._scheduler.closing:
                self._systemd.notify_ready()
                log.write(f"ready on {self._listener.path} (pid {os.getpid()})")
            if settings.greeting:
                itself = Sender(os.getpid(), os.getuid(), "talk")
                speech.apply(self._scheduler.submit(Say(settings.greeting), itself, speech.now()).effects)
            await speech.finished.wait()
            self._socket_check.cancel()
            self._acceptor.close()
            await self._close_connections()
        finally:
            speech.engine.close()
            speech.engine.thread.join(_ENGINE_CLOSE_S)
            self._systemd.close()
        if self._fatal_error:
            raise self._fatal_error

    def _start_voice(self) -> str | None:
        """Return the voice that the engine process checks when it starts; raise UsageError for an unknown neural voice.

        A neural voice is loaded later, so that its problems don't delay speech.
        """
        voices = self.speech.voices
        voice, refusal = voices.look_up(self._settings.goals.voice)
        if voice is None or not is_neural(voice):
            return voice
        if refusal:
            raise UsageError(refusal[1])
        self.speech.apply(self._scheduler.change_settings({"voice": voice}, self.speech.now()))
        return None

    def _check_socket(self) -> None:
        """Bind the socket again if clients don't find it. Existing connections go on."""
        self._socket_check = self._loop.call_later(SOCKET_CHECK_S, self._check_socket)
        if self._listener.in_place():
            self._unreachable = ""
            return
        try:
            former = self._listener.bind_again()
        except AddressInUse as error:
            if not (self._listener.passed or is_temporary(error)):
                # Clients find another server or none. A supervisor that starts this one again gets the message.
                self._socket_check.cancel()
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

    # -- called by connections

    def joined(self, connection: ClientConnection) -> None:
        """Admit a client, keep it waiting if the server is full, or turn it away."""
        pid, uid = peers.credentials(connection.stream.socket)
        # The socket's mode may let other users in.
        if uid not in {os.getuid(), 0} and not self._listener.mode & 0o066:
            words = f"this server is uid {os.getuid()}'s; it would have to be started with --socket-mode"
            refusal = {"talk": PROTOCOL, "error": "permission_denied", "message": words}
        elif len(self.connections) >= self._settings.max_clients + MAX_EXTRA_CLIENTS:
            refusal = busy_greeting()
        else:
            connection.client = Sender(pid or None, uid, peers.command_name(pid), peers.parent_command_line(pid))
            if len(self.connections) < self._settings.max_clients:
                connection.admit()
            self.connections.add(connection)
            self._no_clients.clear()
            return
        connection.close_with(refusal)

    def left(self, connection: ClientConnection) -> None:
        """Forget a client, and admit one that waits. The goals of the client go on."""
        self.connections.discard(connection)
        if not self.connections:
            self._no_clients.set()
        waiting = [each for each in self.connections if not each.admitted]
        if waiting and len(self.connections) - len(waiting) < self._settings.max_clients:
            waiting[0].admit()
        self._requests.left(connection)

    # -- the status

    def _describe(self) -> JsonObject:
        """Return what `status` shows about the server."""
        speech, settings, scheduler, ready = self.speech, self._settings, self._scheduler, self.speech.ready
        started_at, since = self._started_at
        return {
            "pid": os.getpid(),
            "version": __version__,
            "boot": scheduler.boot,
            "socket": self._listener.path,
            "started_at": started_at,
            "uptime": time.monotonic() - since,
            "engine": speech.engine_status,
            "driver": ready.driver if ready else settings.driver,
            "synthesizer": ready.version if ready else None,
            "player": ready.player if ready else settings.player,
            "device": settings.device,
            "lead_in": settings.lead_in,
            "audible": settings.audible,
            **shown_settings(scheduler.settings),
            "neural_voices": scheduler.voices.to_json(),
            "paused": scheduler.paused,
            "pending": scheduler.pending_count,
            "max_queue": settings.max_queue,
            "clients": len(self.connections),
            "max_clients": settings.max_clients,
        }

    # -- the end

    def _end(self, fatal: TalkError | None = None) -> None:
        """End all goals, and then the server. `fatal`: the error to raise, if the server can't go on."""
        self._fatal_error = fatal or self._fatal_error
        self._systemd.notify_stopping()
        self._requests.shut_down()

    async def _close_connections(self) -> None:
        """Give clients a short time to read their last answers."""
        for connection in list(self.connections):
            connection.stream.close()
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(self._no_clients.wait(), _CLIENT_CLOSE_S)
        for connection in list(self.connections):
            connection.stream.abort()

    def _on_signal(self, number: signal.Signals) -> None:
        log.write(f"{signal.Signals(number).name}: ending")
        for each in self._end_signals:
            # Not handled by the loop, which may be busy. A second signal ends the server at once.
            signal.signal(each, self._on_second_signal)
        self._end()

    def _on_second_signal(self, number: int, _: object) -> None:
        """End at once. The engine process ends with this one."""
        with contextlib.suppress(OSError):
            self._listener.close()
        os._exit(EXIT_SIGNAL + number)


def _random_boot_id() -> str:
    """Return the four characters that begin this server's ids of goals; see `goals.options.is_clients_id`."""
    choice = random.SystemRandom().choice
    return "".join(choice(each) for each in (string.digits, string.ascii_lowercase) * 2)
