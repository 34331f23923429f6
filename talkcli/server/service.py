"""One server: who is connected to it, what it says of itself, and its end. It is the handler of its connections."""

from __future__ import annotations

import asyncio
import os
import time
from typing import TYPE_CHECKING

from talkcli import __version__, peers
from talkcli.goals.goal import Sender
from talkcli.goals.options import as_shown
from talkcli.goals.scheduler import Scheduler
from talkcli.protocol import replies
from talkcli.protocol.lines import encode
from talkcli.server.requests import Requests
from talkcli.server.speech import Speech

if TYPE_CHECKING:
    from talkcli.errors import TalkError
    from talkcli.goals.goal import JsonObject
    from talkcli.server.connection import Connection
    from talkcli.server.settings import Settings
    from talkcli.server.stream import Stream

#: Places at the door of a full server, for clients that want to know its status or to silence it.
DOOR = 16


class Service:
    """One server's state, for as long as it runs."""

    def __init__(self, boot: str, settings: Settings, path: str, mode: int) -> None:
        self.boot = boot
        self.settings = settings
        self.path = path
        #: whether the socket's mode lets others in than its owner
        self._open_to_others = bool(mode & 0o066)
        scheduler = Scheduler(boot, max_queue=settings.max_queue, max_text=settings.max_text, settings=settings.goals)
        self.speech = Speech(scheduler, settings.for_player)
        self.speech.lost = self.end
        self.streams = self.speech.streams
        self._requests = Requests(self.speech, self._describe)
        self.handle = self._requests.handle
        self.connections: set[Connection] = set()
        #: set while there is no client
        self.deserted = asyncio.Event()
        self.deserted.set()
        #: why the server must end at once: what it was told to do can't be done
        self.fatal: TalkError | None = None
        self._began = time.time(), time.monotonic()

    def end(self, fatal: TalkError | None = None) -> None:
        """End every goal; `speech.finished` is set once it is silent. `fatal`: what can't be done any more."""
        self.fatal = fatal or self.fatal
        self._requests.shut_down()

    # -- the handler of the connections

    def joined(self, connection: Connection, stream: Stream) -> None:
        """Admit a client, let it wait at the door of a full server, or turn it away."""
        pid, uid = peers.credentials(stream.socket)
        if uid not in {os.getuid(), 0} and not self._open_to_others:
            words = f"this server is uid {os.getuid()}'s; it would have to be started with --socket-mode"
            stream.write(encode({"talk": replies.PROTOCOL, "error": "permission_denied", "message": words}))
            stream.close()
            return
        if len(self.connections) >= self.settings.max_clients + DOOR:
            stream.write(encode(replies.busy_greeting()))
            stream.close()
            return
        connection.sender = Sender(pid or None, uid, peers.command_of(pid), peers.parent_command_of(pid))
        connection.admitted = len(self.connections) < self.settings.max_clients
        self.connections.add(connection)
        self.deserted.clear()

    def greeting(self) -> JsonObject:
        return replies.greeting(__version__, os.getpid(), self.boot)

    def owes(self, connection: Connection) -> bool:
        """Whether a client waits for something."""
        return self._requests.owes(connection) or self.speech.subscribers.has(connection)

    def left(self, connection: Connection) -> None:
        """Forget a client; its goals go on."""
        self.connections.discard(connection)
        if not self.connections:
            self.deserted.set()
        if len(self.connections) >= self.settings.max_clients:  # then somebody may wait at the door for this place
            waiting = [each for each in self.connections if not each.admitted]
            if waiting and len(self.connections) - len(waiting) < self.settings.max_clients:
                waiting[0].admit()
        self._requests.left(connection)
        self.speech.subscribers.left(connection)

    # -- what it says of itself

    def _describe(self) -> JsonObject:
        speech, settings = self.speech, self.settings
        scheduler, ready = speech.scheduler, speech.ready
        started_at, since = self._began
        return {
            "pid": os.getpid(),
            "version": __version__,
            "boot": self.boot,
            "socket": self.path,
            "started_at": started_at,
            "uptime": time.monotonic() - since,
            "engine": speech.engine_words,
            "driver": ready.driver if ready else settings.driver,
            "synthesizer": ready.version if ready else None,
            "player": ready.player if ready else settings.player,
            "device": settings.device,
            "lead_in": settings.lead_in,
            **as_shown(scheduler.settings),
            "paused": scheduler.paused,
            "pending": scheduler.pending_count,
            "max_queue": settings.max_queue,
            "clients": len(self.connections),
            "max_clients": settings.max_clients,
        }
