"""`talk serve`, from the lock to the last goodbye."""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import signal
import string
from typing import TYPE_CHECKING

from talkcli.engine import protocol
from talkcli.engine.thread import EngineThread
from talkcli.errors import EXIT_OK, EXIT_SIGNAL
from talkcli.messages import Sender
from talkcli.requests import Say
from talkcli.server import log
from talkcli.server.connection import Connection
from talkcli.server.listener import BACKLOG, InheritedListener, Listener, listen
from talkcli.server.service import Service

if TYPE_CHECKING:
    from talkcli.server.settings import Settings

#: Seconds in which clients take their last answers before they are let go.
_GOODBYE = 0.3
#: Seconds in which the engine process must be gone before the server leaves it to the system.
_ENGINE_GOODBYE = 1.0


def serve(settings: Settings) -> int:
    """Serve until SIGTERM or SIGINT, and return the exit code.

    AddressInUse if another server serves, or the socket's directory isn't safe; UsageError if the voice isn't known.
    """
    listener = listen(settings.socket, settings.socket_mode)
    try:
        asyncio.run(_Server(settings, listener).run())
    finally:
        listener.close()
    return EXIT_OK


def _boot() -> str:
    """Return the four characters that set this server's goals apart from those of one before."""
    return "".join(random.SystemRandom().choices(string.ascii_lowercase + string.digits, k=4))


class _Server:
    def __init__(self, settings: Settings, listener: Listener | InheritedListener) -> None:
        self._settings = settings
        self._listener = listener
        self._service: Service
        self._signals = 0

    async def run(self) -> None:
        loop = asyncio.get_running_loop()
        settings = self._settings
        service = self._service = Service(_boot(), settings, self._listener.path, self._listener.mode)
        loop.set_exception_handler(self._on_bug)
        for number in (signal.SIGTERM, signal.SIGINT):
            # A shell without job control starts what is in the background with SIGINT ignored: so it stays.
            if signal.getsignal(number) != signal.SIG_IGN:
                loop.add_signal_handler(number, self._on_signal, number)
        signal.signal(signal.SIGHUP, signal.SIG_IGN)  # a terminal that goes away doesn't take the voice along
        service.engine = EngineThread(
            protocol.Configure(
                os.getpid(), settings.driver, settings.player, settings.device, settings.voice, settings.lead_in
            ),
            service.report,
        )
        service.engine.start()
        try:
            # Not create_unix_server: that would remove a socket's file, with whoever serves it now.
            server = await loop.create_server(
                lambda: Connection(service, loop), sock=self._listener.socket, backlog=BACKLOG
            )
            log.line(f"ready on {self._listener.path} (pid {os.getpid()})")
            if settings.greeting:
                service.apply(service.scheduler.submit(Say(settings.greeting), _self(), service.now()).effects)
            await service.finished.wait()
            server.close()
            await self._say_goodbye()
        finally:
            service.engine.close()
            await asyncio.to_thread(service.engine.join, _ENGINE_GOODBYE)
        if service.fatal:
            raise service.fatal

    async def _say_goodbye(self) -> None:
        """Let every client take what was written for it, but wait for none that doesn't read."""
        for connection in list(self._service.connections):
            connection.close()
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(self._service.deserted.wait(), _GOODBYE)
        for connection in list(self._service.connections):
            connection.drop()

    def _on_signal(self, number: signal.Signals) -> None:
        self._signals += 1
        if self._signals > 1:
            # Whoever asks twice wants no goodbye. The engine process dies with this one.
            with contextlib.suppress(OSError):
                self._listener.close()
            os._exit(EXIT_SIGNAL + number)
        log.line(f"{signal.Signals(number).name}: ending")
        self._service.shut_down()

    def _on_bug(self, _: asyncio.AbstractEventLoop, context: dict[str, object]) -> None:
        error = context.get("exception")
        if isinstance(error, Exception):
            self._service.failed(str(context.get("message")), error)
        else:
            log.line(log.shown(str(context.get("message"))))


def _self() -> Sender:
    """Return the server as a sender: of its greeting."""
    return Sender(os.getpid(), os.getuid(), "talk")
