"""The server behind `talk serve`: how it starts, admits clients, reports its status and shuts down."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import os
import random
import signal
import string
import time

from talkcli import __version__, paths, peers
from talkcli.daemon import log
from talkcli.daemon.systemd import ServiceManager
from talkcli.engine import protocol
from talkcli.engine.parent.supervisor import Supervisor
from talkcli.engine.players import FILE_PREFIX, is_silent
from talkcli.engine.pronunciation import PronunciationFile
from talkcli.engine.protocol import START_LIMIT_S
from talkcli.engine.sounds import SoundLibrary
from talkcli.engine.voices import is_own_driver
from talkcli.errors import EXIT_OK, EXIT_SIGNAL, AddressInUse, TalkError, UsageError, memory_hint
from talkcli.frozen import frozen
from talkcli.goals.goal import JsonObject, Sender
from talkcli.goals.options import DEFAULTS, MAX_TEXT_CHARS, NO_TEXT_HISTORY, Say, Set, is_neural, shown_settings
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

#: Number of additional clients that a full server accepts. They can only ask for the status or cancel goals.
MAX_EXTRA_CLIENTS = 16
#: How often to check that clients can find the socket. A missing socket must be noticed within 30 s, and a check takes
#: only two system calls.
SOCKET_CHECK_S = 10.0
#: How long clients have to read their last replies before the server exits.
_CLIENT_CLOSE_S = 0.3
#: How long the server waits for the engine process to exit.
_ENGINE_CLOSE_S = 1.0


@frozen
class ServerSettings:
    """The options of `talk serve`."""

    #: default values for the options of goals
    goals: Set = DEFAULTS
    #: maximum number of pending goals. Speaking 100 goals takes about three minutes, and nobody wants to wait longer.
    max_queue: int = 100
    max_text: int = MAX_TEXT_CHARS
    #: maximum number of clients. Each client uses a file descriptor, and a process can usually have 1,024 of them.
    max_clients: int = 256
    player: str | None = None
    device: str | None = None
    lead_in: int = 0  # milliseconds of silence before a sentence if the device was idle
    audible: bool = False  # whether to abort a sentence if the output is muted
    driver: str | None = None
    sounds: str | None = None  # directory of sounds
    #: memory limit for neural voices in MB, enough for four voices of medium size
    voice_memory: int = 300
    #: TEXT_HISTORY, NO_TEXT_HISTORY, or the path of a file with a "/"; None for no history
    history: str | None = None
    #: path of a file of pronunciations
    pronounce: str | None = None
    socket: str | None = None
    socket_mode: int = 0o600
    greeting: str | None = None

    @property
    def player_options(self) -> list[str]:
        """The names of the player options that were given."""
        given = {"--player": self.player, "--device": self.device, "--lead-in": self.lead_in}
        return [name for name, value in given.items() if value]


def serve(settings: ServerSettings) -> int:
    """Run a server until it receives SIGTERM or SIGINT. Return the exit code.

    Raises:
        AddressInUse: if another server is running, or the socket's directory isn't safe.
        UsageError: if the voice is unknown.
    """
    # Exclude imported modules from garbage collection. Otherwise, each full collection delays clients by 10 ms.
    gc.freeze()
    listener = listen(settings.socket, settings.socket_mode)

    async def run() -> None:
        await Server(settings, listener).run()

    with contextlib.closing(listener):
        asyncio.run(run())
    return EXIT_OK


class Server:
    """The server behind `talk serve`, and its goals, engine and clients.

    Create it inside a running event loop.
    """

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
            can_interrupt=not (settings.player or "").startswith(FILE_PREFIX),
        )
        self.speech = Speech(self._scheduler, settings.player_options)
        self.speech.on_failure = self._begin_shutdown
        self.speech.voices.driver = settings.driver
        self.speech.sounds = SoundLibrary(settings.sounds)
        self._systemd = ServiceManager(self._loop, self.speech.status_message)
        self.speech.on_status_change = self._systemd.schedule_status
        self._open_history()
        if settings.pronounce:
            if not is_own_driver(settings.driver):
                raise UsageError("--pronounce needs talk's own driver; on Linux, leave out --driver")
            path = settings.pronounce
            self.speech.pronunciation_file = PronunciationFile(path, lambda words: log.write(log.sanitize(words)))
        self._requests = Requests(self.speech, self._describe)
        self.handle, self.is_waiting = self._requests.handle, self._requests.is_waiting
        self.input_ended = self._requests.input_ended
        self.greeting = encode(greeting(__version__, os.getpid(), self._scheduler.boot))
        self.connections: set[ClientConnection] = set()
        #: set while no client is connected
        self._no_clients = asyncio.Event()
        self._no_clients.set()
        #: the error that ended the server, if any
        self._fatal_error: TalkError | None = None
        self._started_at = time.time(), time.monotonic()
        #: the last logged reason why clients can't connect, or an empty string if they can
        self._unreachable_reason = ""
        # A shell without job control starts background processes with SIGINT ignored. In this case, keep ignoring it.
        ignored = signal.getsignal(signal.SIGINT) == signal.SIG_IGN
        self._end_signals = [signal.SIGTERM] if ignored else [signal.SIGTERM, signal.SIGINT]

    async def run(self) -> None:
        """Run the server until a signal stops it. If an error stops it, raise the error."""
        settings, speech = self._settings, self.speech
        descriptors = raise_descriptor_limit(settings.max_clients + MAX_EXTRA_CLIENTS)
        self._acceptor = Acceptor(lambda each: ClientConnection(self, speech.streams, each).begin(), descriptors)
        self._loop.set_exception_handler(log.handle_loop_error)
        for number in self._end_signals:
            self._loop.add_signal_handler(number, self._on_signal, number)
        signal.signal(signal.SIGHUP, signal.SIG_IGN)  # keep running when the terminal is closed
        signal.pthread_sigmask(signal.SIG_SETMASK, ())  # unblock signals that the parent process may have blocked
        voice = self._apply_configured_voice()
        speech.engine = Supervisor(
            protocol.Configure(
                os.getpid(),
                settings.driver,
                settings.player,
                settings.device,
                voice,
                settings.lead_in,
                audible=settings.audible,
                sounds=settings.sounds,
            ),
            speech.report,
        )
        try:
            speech.engine.thread.start()
        except RuntimeError as error:  # there is no more specific exception
            raise TalkError(f"can't start the engine's thread: {memory_hint()}") from error
        try:
            self._acceptor.open(self._listener.socket)
            self._socket_check = self._loop.call_later(SOCKET_CHECK_S, self._maintain_socket)
            if voice or settings.driver:
                # Wait before logging, so that an unknown voice or driver produces nothing but an error message.
                with contextlib.suppress(asyncio.TimeoutError):
                    await asyncio.wait_for(speech.engine_known.wait(), START_LIMIT_S)
            if not self._scheduler.closing:
                self._systemd.notify_ready()
                log.write(f"ready on {self._listener.path} (pid {os.getpid()})")
            if settings.greeting:
                itself = Sender(os.getpid(), os.getuid(), "talk")
                _, effects = self._scheduler.submit(Say(settings.greeting), itself, speech.advance_time())
                speech.apply(effects)
            await speech.finished.wait()
            self._socket_check.cancel()
            self._acceptor.close()
            await self._close_connections()
        finally:
            speech.engine.close()
            speech.engine.thread.join(_ENGINE_CLOSE_S)
            if speech.history:
                speech.history.close()
            self._systemd.close()
        if self._fatal_error:
            raise self._fatal_error

    def _open_history(self) -> None:
        """Open the configured history, if any.

        Raises:
            UsageError: this Python has no sqlite3.
        """
        where, player = self._settings.history, self._settings.player
        if where is None:
            return
        if is_silent(player) and "/" not in where:
            log.write(f"no history is kept, because the player {log.sanitize(player or '')} is silent")
            return
        try:
            from talkcli.server.history import History
        except ImportError as error:
            raise UsageError(f"--history needs the module sqlite3, which this Python lacks ({error})") from error
        path, with_text = paths.history_file(where, self._listener.path), where != NO_TEXT_HISTORY
        log.write(log.sanitize(f"storing goals {'' if with_text else 'without their texts '}in {path}"))
        self.speech.history = History(path, with_text=with_text)

    def _apply_configured_voice(self) -> str | None:
        """Apply the configured voice if it is neural. Otherwise, return the voice for the engine to check.

        A neural voice is loaded later, so that it doesn't delay speech.

        Raises:
            UsageError: if a neural voice is unknown.
        """
        voices = self.speech.voices
        voice, refusal = voices.look_up(self._settings.goals.voice)
        if voice is None or not is_neural(voice):
            return voice
        if refusal:
            raise UsageError(refusal[1])
        self.speech.apply(self._scheduler.change_settings({"voice": voice}, self.speech.advance_time()))
        return None

    def _maintain_socket(self) -> None:
        """If clients can't find the socket, bind it again or shut down. Schedule the next check.

        Shut down only if binding fails for good.
        """
        self._socket_check = self._loop.call_later(SOCKET_CHECK_S, self._maintain_socket)
        if self._listener.in_place():
            self._unreachable_reason = ""
            return
        try:
            former = self._listener.bind_again()
        except AddressInUse as error:
            if not (self._listener.passed or is_temporary(error)):
                # Clients can't reach this server any more, so shut down. A service manager may restart it.
                log.write(log.sanitize(f"stopping: {error}"))
                self._begin_shutdown(error)
            elif str(error) != self._unreachable_reason:
                self._unreachable_reason = str(error)
                log.write(log.sanitize(f"clients can't reach this server: {error}"))
            return
        self._unreachable_reason = ""
        log.write(f"created the socket {self._listener.path} again, because it or its lock was removed or replaced")
        self._acceptor.open(self._listener.socket)
        if former:
            former.close()

    # -- called by connections

    def joined(self, connection: ClientConnection) -> None:
        """Admit a new client, let it wait until another one leaves, or refuse it."""
        pid, uid = peers.credentials(connection.stream.socket)
        # Other users may connect only if the socket's mode allows it.
        if uid not in {os.getuid(), 0} and not self._listener.mode & 0o066:
            words = f"this server belongs to uid {os.getuid()}; ask its owner to run: talk serve --socket-mode 0660"
            connection.close_with({"talk": PROTOCOL, "error": "permission_denied", "message": words})
        elif len(self.connections) >= self._settings.max_clients + MAX_EXTRA_CLIENTS:
            connection.close_with(busy_greeting())
        else:
            connection.client = Sender(pid or None, uid, peers.command_name(pid), peers.parent_command_line(pid))
            if len(self.connections) < self._settings.max_clients:
                connection.admit()
            self.connections.add(connection)
            self._no_clients.clear()

    def left(self, connection: ClientConnection) -> None:
        """Remove a client and its requests, and admit the next waiting client.

        The goals of the removed client continue.
        """
        self.connections.discard(connection)
        if not self.connections:
            self._no_clients.set()
        waiting = [each for each in self.connections if not each.admitted]
        if waiting and len(self.connections) - len(waiting) < self._settings.max_clients:
            waiting[0].admit()
        self._requests.left(connection)

    # -- the status

    def _describe(self) -> JsonObject:
        """Return the description of the server for the reply to `status`."""
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
            **speech.describe_pause(),
            "pending": len(scheduler.pending),
            "max_queue": settings.max_queue,
            "clients": len(self.connections),
            "max_clients": settings.max_clients,
            "history": speech.history.describe() if speech.history else None,
            "pronunciations": speech.pronunciation_file.describe() if speech.pronunciation_file else None,
        }

    # -- shutdown

    def _begin_shutdown(self, cause: TalkError | None = None) -> None:
        """Start to shut down: end all goals and reject new ones. `run` raises `cause` at the end."""
        self._fatal_error = cause or self._fatal_error
        self._systemd.notify_stopping()
        self._requests.shut_down()

    async def _close_connections(self) -> None:
        """Close all connections, after giving clients a short time to read their last replies."""
        for connection in list(self.connections):
            connection.finish()
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(self._no_clients.wait(), _CLIENT_CLOSE_S)
        for connection in list(self.connections):
            connection.stream.abort()

    def _on_signal(self, number: signal.Signals) -> None:
        """Log a signal and start to shut down. A second signal will end the server immediately."""
        log.write(f"stopping after {signal.Signals(number).name}")
        for each in self._end_signals:
            # A second signal ends the server immediately, without the event loop, which may be busy.
            signal.signal(each, self._on_second_signal)
        self._begin_shutdown()

    def _on_second_signal(self, number: int, _: object) -> None:
        """Close the socket and exit immediately.

        The engine process notices this and exits, too.
        """
        with contextlib.suppress(OSError):
            self._listener.close()
        os._exit(EXIT_SIGNAL + number)


def _random_boot_id() -> str:
    """Return a random prefix of four characters for the ids of this server's goals."""
    choice = random.SystemRandom().choice
    return "".join(choice(each) for each in (string.digits, string.ascii_lowercase) * 2)
