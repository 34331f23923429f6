"""A bridge, from the first connection to the goodbye: one robot on the broker, as its server's client.

It holds the connection to the broker, and makes another where it breaks; it says that the robot is there, and measures
how old what comes may be. What is asked is judged in `policy`, and carried out by `askers`; `news` watches the server.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
import time
from typing import TYPE_CHECKING

from talkcli import __version__
from talkcli.daemon import log
from talkcli.daemon.systemd import Systemd
from talkcli.errors import AddressInUse, TalkError
from talkcli.fleet import topics
from talkcli.fleet.bridge import homeassistant
from talkcli.fleet.bridge.askers import Askers
from talkcli.fleet.bridge.local import apart
from talkcli.fleet.bridge.news import News
from talkcli.fleet.bridge.policy import ECHO_EVERY, STALE, Dropped, Echoes, HungUp, Policy, Refused
from talkcli.fleet.link import NOT_AUTHORIZED, Link, Will, boottime
from talkcli.fleet.presence import Presence, rank
from talkcli.frozen import frozen
from talkcli.protocol.lines import MAX_LINE, encode

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any

    from talkcli.fleet.broker import Broker
    from talkcli.fleet.message import Message
    from talkcli.goals.goal import JsonObject

#: Seconds that the broker keeps what says that a robot is there, and between two renewals of it.
PRESENCE_EXPIRY, PRESENCE_EVERY = 150, 60.0
#: Seconds in which another bridge of the same name says that it is there.
ANOTHER_WITHIN = 1.0
#: Seconds until a broker that is gone is tried again: at most so many, with jitter, and the most that this becomes, so
#: that a thousand robots don't come back at once.
AGAIN = (0.5, 10.0)
#: Seconds without an echo after which the connection is taken to be dead.
ECHO_LIMIT = 15.0
#: Seconds between two echoes, where what is refused for its age asks for one.
ECHO_SOONEST = 1.0
#: Bytes that the broker has not taken after which events are left out, and the server is read no more; and after which
#: the connection is given up.
SOFT_OUTPUT, HARD_OUTPUT = 256 * 1024, 4 * 1024 * 1024
#: Bytes of a packet from the broker: a request's longest line, and what is a little longer, so that it is told so. paho
#: takes seconds over a packet of 250 kB of nothing but properties, and a fourth of that is a tenth of a second.
MAX_INPUT = MAX_LINE + 8 * 1024
#: Seconds in which all robots are told of to a Home Assistant that has begun: not all at once.
TOLD_WITHIN = 3.0
#: Seconds in which the broker takes the goodbye.
_GOODBYE = 1.0
#: What is asked on the echo's topic: which other bridge of this name is there.
_WHO = b"? "
_RIGHTS = "may its user do there what 'talk bridge --print-acl' has for these options?"


@frozen
class Settings:
    """What `talk bridge` is told by its command line, and by the environment."""

    name: str
    broker: Broker
    #: the kinds of requests that may be asked for from afar
    allow: tuple[str, ...]
    #: those that it is in, besides that of everybody
    groups: tuple[str, ...] = ()
    #: the server's socket, None for the usual places
    socket: str | None = None
    #: whether everybody may read what is said
    with_text: bool = True
    #: whether Home Assistant is told of it
    homeassistant: bool = False


class Bridge:
    """One robot on the broker. All but the connecting is done in its event loop's thread; signals are the process's."""

    def __init__(self, settings: Settings, reread: Callable[[], Broker]) -> None:
        self._settings = settings
        #: the broker, as it was last read
        self._broker, self._reread = settings.broker, reread
        self._loop = asyncio.get_running_loop()
        self._session = f"{random.getrandbits(64):016x}"
        self._since = time.time()
        self._policy = Policy(settings.name, settings.allow)
        self._systemd = Systemd(self._loop, self._words)
        self._askers = Askers(settings.name, settings.socket, self._answer, self._room, self._systemd.changed)
        self._news = News(self._askers, self._tell, self._server_changed, with_text=settings.with_text)
        self._link: Link | None = None
        self._descriptor = -1
        self._writing = False
        #: set once the connection has ended
        self._down = asyncio.Event()
        #: whether requests are taken: no other bridge of this name is there
        self._settled = False
        #: whether the broker has kept the presence of another one
        self._other = False
        #: what settles that, once this bridge's question has come back
        self._question: asyncio.TimerHandle | None = None
        self._echoes = Echoes(boottime())
        #: by the loop's clock: when the last echo was sent, and since when none has come back, if one is awaited
        self._echoed = 0.0
        self._unanswered: float | None = None
        #: by the same: when it was last said that the robot is there
        self._present = 0.0
        #: when Home Assistant, which has begun, is told of this robot
        self._telling: asyncio.TimerHandle | None = None
        self._ended = asyncio.Event()
        self._fatal: BaseException | None = None

    async def run(self) -> None:
        """Be there until it is told to `end`."""
        link = self._new_link()
        log.line(f"robot {self._settings.name}, by the broker at {self._settings.broker.url}")
        self._systemd.ready()
        work = [asyncio.create_task(each) for each in (self._stay_connected(link), self._news.run())]
        for each in work:
            each.add_done_callback(self._on_done)
        self._next_beat = self._loop.call_later(ECHO_EVERY, self._beat, self._loop.time() + ECHO_EVERY)
        await self._ended.wait()
        self._systemd.stopping()
        self._next_beat.cancel()
        self._askers.hang_up_all()
        self._news.close()
        work[1].cancel()
        await self._say_goodbye()
        work[0].cancel()
        await asyncio.wait(work)
        self._systemd.close()
        if self._fatal:
            raise self._fatal

    # -- the connection

    def _new_link(self) -> Link:
        name, session = self._settings.name, self._session
        goodbye = Will(topics.robot(name, topics.PRESENCE), self._absence())
        return Link(self._broker, f"talk-{name}-{session}", self._hear, goodbye, most=MAX_INPUT)

    def _read_anew(self) -> None:
        """Take what has become of the settings: nobody starts the robot anew for another password."""
        try:
            self._broker = self._reread()
        except TalkError as error:
            log.seldom("settings", f"{log.shown(str(error))}; what was there before is used")

    async def _stay_connected(self, first: Link) -> None:
        least, most = AGAIN
        wait = least
        link: Link | None = first
        while True:
            try:
                link = link or self._new_link()
                await apart(link.open)
                self._come_up(link)
                await self._down.wait()
                log.line(f"the connection to the broker has ended: {log.shown(str(link.ended))}")
                wait = least if self._settled else wait
            except TalkError as error:
                log.seldom("broker", log.shown(str(error)))
            finally:
                if link:
                    self._go_down(link)
            link = None
            await asyncio.sleep(random.uniform(0, wait))
            wait = min(most, wait * 2)
            self._read_anew()

    def _come_up(self, link: Link) -> None:
        """Begin with a connection: first of all find out whether another bridge of this name is there."""
        self._down.clear()
        self._link, self._descriptor = link, link.fileno()
        self._settled, self._other, self._question = False, False, None
        self._loop.add_reader(self._descriptor, self._read)
        self._echoes = Echoes(boottime())
        self._unanswered = None
        name = self._settings.name
        link.subscribe(topics.robot(name, topics.PRESENCE), retained=True)
        link.subscribe(topics.robot(name, topics.ECHO), retained=False)
        # What another has left behind comes before the question does, and what it says now comes after it.
        self._publish(topics.robot(name, topics.ECHO), _WHO + self._session.encode())
        self._echo()

    def _settle(self) -> None:
        """Be the robot: take what is asked, and say so."""
        if self._settled or self._link is None:
            return
        self._settled = True
        name = self._settings.name
        own = [topics.robot(name, each, topics.ANY) for each in (topics.REQUEST, topics.SAY, topics.CANCEL)]
        groups = [topics.group(each, topics.REQUEST, topics.ANY) for each in self._groups]
        births = [topics.BIRTH] if self._settings.homeassistant else []
        self._link.subscribe(*own, *groups, *births, retained=False)
        self._be_present()
        self._tell_homeassistant()
        self._news.tell()
        self._systemd.changed()
        log.line(f"online, at {self._settings.broker.url}")

    def _go_down(self, link: Link) -> None:
        """End a connection, and all that goes with it; nothing happens where that is done."""
        if self._link is link:
            self._link = None
            self._forget_descriptor()
            if self._question:
                self._question.cancel()
            self._askers.hang_up_all()
            self._systemd.changed()
            self._down.set()
        link.close()

    def _forget_descriptor(self) -> None:
        if self._descriptor >= 0:
            for forget in (self._loop.remove_reader, self._loop.remove_writer):
                # Where paho has closed it already, one that is watched for both is forgotten with an error.
                with contextlib.suppress(OSError):
                    forget(self._descriptor)
            self._descriptor, self._writing = -1, False

    def _read(self) -> None:
        link = self._link
        if link:
            link.read()
            self._look_after(link)

    def _write(self) -> None:
        link = self._link
        if link:
            link.write()
            self._look_after(link)

    def _look_after(self, link: Link) -> None:
        """See how a connection is, after whatever was done with it."""
        if link is not self._link or self._descriptor < 0:
            return
        if link.ended is None and link.outstanding > HARD_OUTPUT:
            log.seldom(
                "output", f"the broker takes nothing: {HARD_OUTPUT >> 20} MiB wait, so the connection is given up"
            )
            link.close()
        if link.ended is not None:
            # At once: its descriptor may be another's soon. All else not in the middle of what has found it out.
            self._forget_descriptor()
            self._loop.call_soon(self._go_down, link)
            return
        if link.outstanding > SOFT_OUTPUT:
            self._askers.flowing.clear()
        else:
            self._askers.flowing.set()
        if link.wants_write != self._writing:
            self._writing = link.wants_write
            if self._writing:
                self._loop.add_writer(self._descriptor, self._write)
            else:
                self._loop.remove_writer(self._descriptor)

    def _publish(self, topic: str, payload: bytes, qos: int = 1, **more: Any) -> bool:
        link = self._link
        if link is None:
            return False
        if len(payload) > link.room:  # the broker would end the connection
            log.seldom("long", f"{len(payload):,} bytes for {topic} are not published: the broker takes {link.room:,}")
            return False
        done = link.publish(topic, payload, qos, **more)
        self._look_after(link)
        return done

    def _answer(self, topic: str, payload: bytes, qos: int, correlation: bytes | None) -> None:
        """Publish lines to an asker."""
        acknowledged = self._check_right if qos else None
        self._publish(topic, payload, qos, correlation=correlation, acknowledged=acknowledged)

    def _tell(self, topic: str, payload: bytes, *, retain: bool = False, expiry: float | None = None) -> None:
        """Publish to everybody; not where another may be this robot, and not what the broker has no time for."""
        if self._settled and self._link and (retain or self._link.outstanding <= SOFT_OUTPUT):
            self._publish(topic, payload, retain=retain, expiry=expiry)

    def _room(self) -> int:
        return self._link.room if self._link else 0

    # -- what comes in

    def _hear(self, message: Message) -> None:
        try:
            self._take(message)
        except Exception as error:  # noqa: BLE001 - nothing that anybody sends may end the robot
            log.bug("what came from the broker", error)

    def _take(self, message: Message) -> None:
        name = self._settings.name
        if message.topic == topics.robot(name, topics.ECHO):
            self._hear_echo(message.payload)
            return
        if message.topic == topics.robot(name, topics.PRESENCE):
            self._hear_presence(message.payload)
            return
        if message.topic == topics.BIRTH and message.payload == homeassistant.ONLINE and self._telling is None:
            self._telling = self._loop.call_later(random.uniform(0, TOLD_WITHIN), self._tell_homeassistant)
        asked = topics.asked(message.topic)
        if asked is None or not self._settled:
            return
        now = boottime()
        found = self._policy.judge(message, asked, now, stale=self._echoes.stale(now))
        if isinstance(found, Dropped):
            log.seldom(found.kind, log.shown(found.words))
        elif isinstance(found, HungUp):
            self._askers.hang_up(found.user, found.topic)
        elif isinstance(found, Refused):
            self._askers.answer(found.topic, found.answer, found.correlation)
            log.seldom(found.code, f"a request of {asked.user} is refused: {log.shown(found.words)}")
            if found.code == STALE and self._loop.time() - self._echoed >= ECHO_SOONEST:
                self._echo()
        else:
            self._askers.ask(found)

    def _hear_echo(self, payload: bytes) -> None:
        if payload.startswith(_WHO):
            if payload != _WHO + self._session.encode():
                if self._settled:
                    self._be_present()
            elif not (self._settled or self._question):
                wait = ANOTHER_WITHIN if self._other else 0
                self._question = self._loop.call_later(wait, self._settle)
            return
        session, _, number = payload.partition(b" ")
        if session == self._session.encode() and self._echoes.came(number):
            self._unanswered = None

    # -- who is there

    def _hear_presence(self, payload: bytes) -> None:
        """Hear what some bridge of this name says of itself: this one, one that has ended, another that is there."""
        said = Presence.read(self._settings.name, payload)
        found = rank(said)
        if payload and (said is None or (said.online and found is None)):
            words = 'it is not a JSON object with "online", "session" and a numeric "since"'
            log.seldom("presence", f"a message on this robot's presence topic is ignored: {words}")
        if found and found[1] == self._session:
            return
        if not self._question and not self._settled:
            # The broker has kept it, so its bridge may be gone.
            self._other = found is not None
        elif found is None:
            if self._settled:
                self._be_present()  # in place of a late will, or of a message that was ignored
        elif found < (self._since, self._session):
            words = f"another bridge is '{self._settings.name}' already: session {log.shown(found[1])}"
            self.end(AddressInUse(f"{words}; each robot has a name of its own, give another --name"))
        else:
            self._settle()
            self._be_present()  # so that the younger one hears of this

    def _be_present(self) -> None:
        self._present = self._loop.time()
        settings = self._settings
        presence: JsonObject = {
            "talk": 1,
            "version": __version__,
            "online": True,
            "session": self._session,
            "since": self._since,
            "groups": list(self._groups),
            "allow": list(settings.allow),
            "server": self._news.server,
        }
        topic = topics.robot(settings.name, topics.PRESENCE)
        self._publish(topic, encode(presence), retain=True, expiry=PRESENCE_EXPIRY, acknowledged=self._check_right)

    def _tell_homeassistant(self) -> None:
        """Tell Home Assistant of this robot, if it is to know; the broker keeps that for a later one."""
        self._telling = None
        if self._settings.homeassistant and self._settled:
            topic, device = homeassistant.device(self._settings.name, self._settings.allow, __version__)
            self._publish(topic, device, retain=True, acknowledged=self._check_right)

    def _check_right(self, reason: int) -> None:
        if reason == NOT_AUTHORIZED:
            log.seldom("rights", f"the broker doesn't let this robot publish all that it says: {_RIGHTS}")

    def _absence(self) -> bytes:
        gone: JsonObject = {"talk": 1, "online": False, "session": self._session, "groups": list(self._groups)}
        return encode(gone)

    def _server_changed(self) -> None:
        self._systemd.changed()
        if self._settled:
            self._be_present()

    # -- the time

    def _echo(self) -> None:
        now = self._echoed = self._loop.time()
        if self._unanswered is None:
            self._unanswered = now
        number = self._echoes.send(boottime())
        self._publish(topics.robot(self._settings.name, topics.ECHO), f"{self._session} {number}".encode())

    def _beat(self, due: float) -> None:
        """Do what is due every few seconds; `due`: when that was."""
        now = self._loop.time()
        self._next_beat = self._loop.call_at(now + ECHO_EVERY, self._beat, now + ECHO_EVERY)
        self._askers.beat()
        self._news.beat()
        link = self._link
        if link is None:
            return
        link.tick()
        self._look_after(link)
        if self._unanswered is not None:
            # This process was stopped itself: what came meanwhile has yet to be read.
            self._unanswered += now - due
            if now - self._unanswered > ECHO_LIMIT:
                log.seldom("echo", f"nothing that this robot sends itself comes back: {_RIGHTS}")
                self._go_down(link)
                return
        self._echo()
        if self._settled and now - self._present >= PRESENCE_EVERY:
            self._be_present()

    # -- how it is, and its end

    @property
    def _groups(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys((topics.EVERYBODY, *self._settings.groups)))

    def _words(self) -> str:
        broker, server = ("online" if self._settled and self._link else "OFFLINE"), self._news.server
        there = "server there" if server else "no server"
        pending = len(self._askers.share)
        goals = f"{pending} goal{'' if pending == 1 else 's'} pending"
        return f"{self._settings.name} at {self._settings.broker.url}: {broker}, {there}, {goals}"

    @property
    def ready(self) -> bool:
        """Whether it can be asked: it is online, and a server is there."""
        return self._settled and self._link is not None and self._news.server is not None

    def _on_done(self, work: asyncio.Task[None]) -> None:
        """End where what should go on for ever has not: somebody starts it anew."""
        if not work.cancelled() and (error := work.exception()):
            self.end(error)

    def end(self, error: BaseException | None = None) -> None:
        """Have `run` say goodbye, and return, or raise this error."""
        self._fatal = self._fatal or error
        self._ended.set()

    async def _say_goodbye(self) -> None:
        """Say that the robot is gone, if it was there, and that nobody else is."""
        link = self._link
        if link is None:
            return
        name, taken = self._settings.name, asyncio.Event()
        was_here = self._settled and not isinstance(self._fatal, AddressInUse)
        self._settled = False  # before it hears its own goodbye, which it would contradict
        if was_here:
            topic, goodbye, retain = topics.robot(name, topics.PRESENCE), self._absence(), True
        else:
            # Once this is taken nothing is on its way, so that the connection ends in peace: else the broker would
            # publish the will, and the robot be offline for a moment whose other bridge is there.
            topic, goodbye, retain = topics.robot(name, topics.ECHO), f"{self._session} 0".encode(), False
        self._publish(topic, goodbye, retain=retain, acknowledged=lambda _: taken.set())
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(taken.wait(), _GOODBYE)
        self._go_down(link)
