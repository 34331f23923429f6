"""`talk serve`, from the lock to the last goodbye."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import os
import random
import signal
import string
from typing import TYPE_CHECKING

from talkcli import resources
from talkcli.engine import protocol
from talkcli.engine.protocol import START_LIMIT
from talkcli.engine.supervisor import Supervisor
from talkcli.errors import EXIT_OK, EXIT_SIGNAL, AddressInUse, TalkError
from talkcli.goals.goal import Sender
from talkcli.goals.options import Say
from talkcli.server import log
from talkcli.server.connection import Connection
from talkcli.server.listener import InheritedListener, Listener, Upkeep, listen
from talkcli.server.service import DOOR, Service
from talkcli.server.stream import Acceptor, make_room
from talkcli.server.systemd import Systemd

if TYPE_CHECKING:
    import socket

    from talkcli.server.settings import Settings

#: Seconds in which clients take their last answers before they are let go.
_GOODBYE = 0.3
#: Seconds in which the engine process must be gone before the server leaves it to the system.
_ENGINE_GOODBYE = 1.0


def serve(settings: Settings) -> int:
    """Serve until SIGTERM or SIGINT, and return the exit code.

    AddressInUse if another server serves, or the socket's directory isn't safe; UsageError if the voice isn't known.
    """
    gc.freeze()  # what is imported stays: a full collection that looks at all of it keeps clients waiting for 10 ms
    listener = listen(settings.socket, settings.socket_mode)
    try:
        asyncio.run(_Server(settings, listener).run())
    finally:
        listener.close()
    return EXIT_OK


def _boot() -> str:
    """Return the four characters that set this server's goals apart from those of one before; see `goals.options`."""
    choice = random.SystemRandom().choice
    return "".join(choice(each) for each in (string.digits, string.ascii_lowercase) * 2)


class _Server:
    def __init__(self, settings: Settings, listener: Listener | InheritedListener) -> None:
        self._settings = settings
        self._listener = listener
        self._service: Service
        self._systemd: Systemd
        self._acceptor: Acceptor
        self._ended_by = [signal.SIGTERM]
        # A shell without job control starts what is in the background with SIGINT ignored: so it stays.
        if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:
            self._ended_by.append(signal.SIGINT)

    async def run(self) -> None:
        loop = asyncio.get_running_loop()
        settings = self._settings
        make_room(settings.max_clients + DOOR)
        service = self._service = Service(_boot(), settings, self._listener.path, self._listener.mode)
        speech = service.speech
        systemd = self._systemd = Systemd(loop, os.environ, speech.words)
        speech.changed = systemd.changed
        acceptor = self._acceptor = Acceptor(loop, lambda each: Connection(service, loop, each).begin(), log.bug)
        upkeep = Upkeep(loop, self._listener, self._moved, self._lost)
        loop.set_exception_handler(self._on_bug)
        for number in self._ended_by:
            loop.add_signal_handler(number, self._on_signal, number)
        signal.signal(signal.SIGHUP, signal.SIG_IGN)  # a terminal that goes away doesn't take the voice along
        signal.pthread_sigmask(signal.SIG_SETMASK, ())  # whoever started this may have had some of them blocked
        speech.engine = Supervisor(
            protocol.Configure(
                os.getpid(), settings.driver, settings.player, settings.device, settings.goals.voice, settings.lead_in
            ),
            speech.report,
        )
        self._start(speech.engine)
        try:
            acceptor.open(self._listener.socket)
            upkeep.begin()
            if settings.goals.voice or settings.driver:
                # Who asked for what can't be had is told so, and nothing else.
                with contextlib.suppress(asyncio.TimeoutError):
                    await asyncio.wait_for(speech.engine_known.wait(), START_LIMIT)
            if not speech.closing:
                systemd.ready()
                log.line(f"ready on {self._listener.path} (pid {os.getpid()})")
            if settings.greeting:
                speech.apply(speech.scheduler.submit(Say(settings.greeting), _self(), speech.now()).effects)
            await speech.finished.wait()
            systemd.stopping()
            upkeep.end()
            acceptor.close()
            await self._say_goodbye()
        finally:
            speech.engine.close()
            speech.engine.join(_ENGINE_GOODBYE)
            systemd.close()
        if service.fatal:
            raise service.fatal

    @staticmethod
    def _start(engine: Supervisor) -> None:
        try:
            engine.start()
        except RuntimeError as error:  # all that Python says of a thread that it can't have
            raise TalkError(f"the engine's thread cannot be started: {resources.limits()}") from error

    def _moved(self, former: socket.socket | None) -> None:
        """Take up connections where the listener is now; those that there are live on."""
        self._service.path = self._listener.path
        self._acceptor.open(self._listener.socket)
        if former:
            former.close()

    def _lost(self, error: AddressInUse) -> None:
        """End: clients find another server, or none; a supervisor that starts this one again will hear why."""
        log.line(log.shown(f"ending: {error}"))
        self._systemd.stopping()
        self._service.end(error)

    async def _say_goodbye(self) -> None:
        """Let every client take what was written for it, but wait for none that doesn't read."""
        for connection in list(self._service.connections):
            connection.close()
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(self._service.deserted.wait(), _GOODBYE)
        for connection in list(self._service.connections):
            connection.drop()

    def _on_signal(self, number: signal.Signals) -> None:
        log.line(f"{signal.Signals(number).name}: ending")
        for each in self._ended_by:
            # Not by the loop, which may have a long turn to finish: whoever asks twice wants no goodbye.
            signal.signal(each, self._on_second_signal)
        self._systemd.stopping()
        self._service.end()

    def _on_second_signal(self, number: int, _: object) -> None:
        """End at once; the engine process dies with this one."""
        with contextlib.suppress(OSError):
            self._listener.close()
        os._exit(EXIT_SIGNAL + number)

    def _on_bug(self, _: asyncio.AbstractEventLoop, context: dict[str, object]) -> None:
        error = context.get("exception")
        if isinstance(error, Exception):
            log.bug(str(context.get("message")), error)
        else:
            log.line(log.shown(str(context.get("message"))))


def _self() -> Sender:
    """Return the server as a sender: of its greeting."""
    return Sender(os.getpid(), os.getuid(), "talk")
