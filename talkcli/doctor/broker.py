"""The broker of a fleet and one robot there: how far a sentence comes from here, and what this user may do.

It asks as a desk does, or as the robot itself where it logs in by the robot's name. Nothing that it does lasts: what it
publishes to find out what it may is empty, is kept by nobody, and means nothing to a bridge.
"""

from __future__ import annotations

import contextlib
import difflib
import os
import select
import socket
import ssl
import threading
import time
from concurrent.futures import Future
from functools import partial
from typing import TYPE_CHECKING, TypeVar

from talkcli.client.client import Client
from talkcli.doctor.report import ADMITTED, ANSWERED, FAILED, Finding, failed, ok, some, warning
from talkcli.doctor.server import span, summary
from talkcli.errors import ServerUnavailable, TalkError, UsageError
from talkcli.fleet import topics
from talkcli.fleet.broker import CA, URL, USER, from_environment, is_here, user
from talkcli.fleet.desk.robot import reach
from talkcli.fleet.desk.roster import roster
from talkcli.fleet.link import NOT_AUTHORIZED, PATIENCE, Link
from talkcli.fleet.presence import Presence
from talkcli.frozen import frozen, replace
from talkcli.polling import wait_ready
from talkcli.terminal.text import printable

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator, Mapping

    from talkcli.doctor.report import Question
    from talkcli.fleet.broker import Broker
    from talkcli.fleet.message import Message
    from talkcli.goals.goal import JsonObject

_T = TypeVar("_T")

#: What this client calls itself.
_NAME = "talk doctor"
#: Seconds that one step may take in all: what is asked has `PATIENCE`, the name of a host whatever the system gives it.
_LIMIT = 2 * PATIENCE
#: Seconds for which what should come back is awaited once the broker has taken everything.
_GRACE = 1.0
#: What is published where it comes back; a bridge takes it for no echo of its own.
_MARK = b"doctor"
#: Seconds before its end in which a certificate should be renewed.
_SOON = 14 * 86400
#: Checks behind which nothing can be found out where they failed.
_BARRIERS = ("broker", "certificate", "login")
#: Why nobody was reached: words for people, and to look them up by.
REFUSED, UNKNOWN_HOST, SILENT = "connection refused", "no such host", "no answer"
#: What to do then.
_STEPS = {
    REFUSED: "on {host}: systemctl status mosquitto; others than {host} reach it where its mosquitto.conf has a line "
    "'listener {port}'",
    UNKNOWN_HOST: "spell the host in TALK_BROKER rightly: getent hosts {host}",
    SILENT: "see whether {host} is up, and no firewall is between: ping {host}",
}
#: OpenSSL's numbers of what may be wrong with a certificate: not yet good, or no longer; another host's, or address's.
_BY_TIME, _BY_NAME = (9, 10), (62, 64)


@frozen
class Way:
    """What is between here and the broker."""

    #: how long it took to connect, in seconds; of TLS, too
    took: float = 0.0
    #: why nobody was reached; None where somebody was
    trouble: str | None = None
    #: why there is no TLS, and OpenSSL's number of what is wrong with the certificate, 0 where it is not that
    untrusted: str | None = None
    fault: int = 0
    #: until when the certificate is good, in seconds since the epoch; None without TLS
    until: float | None = None


@frozen
class Allowed:
    """What the broker did with all that was tried on it."""

    #: the robot's presence; None where the broker keeps none, or tells none
    presence: Presence | None
    #: topics to which this user may not publish, and those from which nothing came back
    unwritten: tuple[str, ...] = ()
    unread: tuple[str, ...] = ()
    #: why it could not be found out; None where it could
    trouble: str | None = None


class Examination:
    """One run of the doctor, for a robot of a fleet."""

    def __init__(
        self,
        robot: str,
        environment: Mapping[str, str],
        *,
        insecure: bool = False,
        interrupt: Mapping[int, int] | None = None,
    ) -> None:
        """`robot`: its name; `insecure`: as of `from_environment`; `interrupt`: what ends it, as in `ready`."""
        fault = topics.fault(robot)
        if fault:
            raise UsageError(f"no robot can be called '{printable(robot)}': a name {fault}")
        self._robot = robot
        self._environment, self._insecure = environment, insecure
        self._interrupt = interrupt
        #: whether it logs in as the robot's own bridge does
        self._itself = environment.get(USER) == robot
        self._session = os.urandom(8).hex()
        self._inbox: list[Message] = []

    @property
    def question(self) -> Question:
        """What is to be found out: a robot itself may ask nobody, and may not even ask itself."""
        return ADMITTED if self._itself else ANSWERED

    def findings(self) -> Iterator[Finding]:
        """Give each finding as soon as it is known; Interrupted."""
        with contextlib.closing(self._all()) as found:
            for each in found:
                yield each
                if each.state == FAILED and each.check in _BARRIERS:
                    return

    def _all(self) -> Generator[Finding, None, None]:
        try:
            broker = from_environment(self._environment, insecure=self._insecure)
            name, context = user(broker), broker.context()
        except UsageError as error:
            yield judge_settings(error.message, named=bool(self._environment.get(URL)))
            return
        way = self._way(broker, context)
        yield judge_way(broker, way)
        yield from judge_certificate(broker, way, time.time(), near=is_here(broker.host))
        try:
            link = self._open(broker, self._inbox.append)
        except TalkError as error:
            yield judge_login(broker, error.message)
            return
        with contextlib.closing(link):
            yield judge_login(broker, None)
            yield judge_anonymous(self._closed_to_anybody(broker))
            allowed = self._try(link, name)
        rights = judge_rights(name, allowed)
        if allowed.presence is not None:
            there = judge_name(allowed.presence, time.time())
        elif self._itself:
            there = judge_free(self._robot)
        else:
            may = rights.state != FAILED
            there = judge_unknown(self._robot, self._roster(broker) if may else (), name, may=may)
        yield there
        yield rights
        if not self._itself and FAILED not in (there.state, rights.state):
            yield self._answer(broker)

    def _way(self, broker: Broker, context: ssl.SSLContext | None) -> Way:
        try:
            return self._beside(partial(_go, broker, context))
        except TimeoutError:
            return Way(trouble=SILENT)

    def _open(self, broker: Broker, hear: Callable[[Message], None]) -> Link:
        """Return a connection to the broker; errors as of `Link.open`."""
        link = Link(broker, f"talk-doctor-{os.urandom(8).hex()}", hear)
        try:
            self._beside(link.open)
        except TimeoutError as error:
            raise ServerUnavailable(f"the broker at {broker.url} does not answer within {_LIMIT:g} s") from error
        return link

    def _closed_to_anybody(self, broker: Broker) -> str | None:
        """Return why the broker lets nobody in without credentials; None where it does."""
        try:
            self._open(replace(broker, user=None, password=None, cert=None, key=None), _ignore).close()
        except TalkError as error:
            return error.message
        return None

    def _try(self, link: Link, name: str) -> Allowed:
        """Try what a desk does with this robot, or what the robot's bridge does."""
        robot, answers = partial(topics.robot, self._robot), partial(topics.reply, name, self._session)
        if self._itself:
            mark = robot(topics.ECHO)
            empty = [robot(topics.STATUS), robot(topics.EVENT, "doctor"), answers(self._robot)]
        else:
            mark, empty = answers(topics.MARKER), [robot(topics.REQUEST, name)]
        presence, codes = robot(topics.PRESENCE), dict[str, int]()
        link.subscribe(mark, retained=False)
        link.subscribe(presence, retained=True)
        tried = {mark: _MARK} | dict.fromkeys(empty, b"")
        for topic, payload in tried.items():
            link.publish(topic, payload, acknowledged=partial(codes.__setitem__, topic))
        now = time.monotonic()
        end, taken = now + PATIENCE, False
        said: Presence | None = None
        back = False
        while link.ended is None and now < end and not (taken and back and said):
            if link.fileno() in wait_ready(_watched(link), end - now, self._interrupt):
                link.read()
            back = back or any(each.topic == mark and each.payload == _MARK for each in self._inbox)
            told = [each.payload for each in self._inbox if each.topic == presence]
            said = Presence.read(self._robot, told[-1]) if told else said
            self._inbox.clear()
            now = time.monotonic()
            if not taken and len(codes) == len(tried):
                taken, end = True, min(end, now + _GRACE)
        unwritten = tuple(each for each in tried if codes.get(each) == NOT_AUTHORIZED)
        unread = () if back or mark in unwritten else (mark,)
        missing = [each for each in tried if each not in codes]
        trouble = link.ended or (f"it has acknowledged nothing of {missing[0]}" if missing else None)
        return Allowed(said, unwritten, unread, trouble)

    def _roster(self, broker: Broker) -> tuple[str, ...]:
        """Return the names of all robots that the broker knows; none where it doesn't tell."""
        try:
            return tuple(sorted(self._beside(partial(roster, broker, PATIENCE))))
        except (TalkError, TimeoutError):
            return ()  # that this one is not known has been found out already

    def _answer(self, broker: Broker) -> Finding:
        end = time.monotonic() + _LIMIT
        try:
            connection = reach(self._robot, broker, name=_NAME, interrupt=self._interrupt, patience=PATIENCE, end=end)
            with Client.over(connection) as client:
                began = time.monotonic()
                server = client.status().server
                return judge_bridge(self._robot, server, time.monotonic() - began)
        except TalkError as error:
            return judge_no_answer(self._robot, error.message)

    def _beside(self, work: Callable[[], _T]) -> _T:
        """Return what this work returns, which waits where nothing can end it; TimeoutError, Interrupted."""
        result: Future[_T] = Future()
        wake, write = os.pipe()

        def run() -> None:
            try:
                result.set_result(work())
            except BaseException as error:  # noqa: BLE001 - it is raised below
                result.set_exception(error)
            finally:
                os.close(write)

        threading.Thread(target=run, name="talk doctor: asking", daemon=True).start()
        try:
            if not wait_ready({wake: 0}, _LIMIT, self._interrupt):
                raise TimeoutError
        finally:
            os.close(wake)
        return result.result()


def _go(broker: Broker, context: ssl.SSLContext | None) -> Way:
    """Connect to the broker, as far as TLS, and let go."""
    began = time.monotonic()
    try:
        connection = socket.create_connection((broker.host, broker.port), PATIENCE)
    except OSError as error:
        return Way(trouble=_trouble(error))
    with connection:
        if context is None:
            return Way(time.monotonic() - began)
        try:
            with context.wrap_socket(connection, server_hostname=broker.host) as secured:
                shown = secured.getpeercert() or {}
                return Way(time.monotonic() - began, until=ssl.cert_time_to_seconds(str(shown["notAfter"])))
        except ssl.SSLCertVerificationError as error:
            return Way(time.monotonic() - began, untrusted=error.verify_message, fault=error.verify_code)
        except OSError as error:
            words = error.reason if isinstance(error, ssl.SSLError) else _trouble(error)
            return Way(time.monotonic() - began, untrusted=words or str(error))


def _trouble(error: OSError) -> str:
    if isinstance(error, ConnectionRefusedError):
        return REFUSED
    if isinstance(error, socket.gaierror):
        return UNKNOWN_HOST
    return SILENT if isinstance(error, TimeoutError) else error.strerror or str(error)


def _ignore(_message: Message) -> None:
    """Take no notice of what comes."""


def _watched(link: Link) -> dict[int, int]:
    return {link.fileno(): select.POLLIN | (select.POLLOUT if link.wants_write else 0)}


def judge_settings(words: str, *, named: bool) -> Finding:
    """Judge variables that name no broker; `named`: whether TALK_BROKER is set."""
    if not named:
        return failed("broker", f"{URL} is not set", f"export {URL}=mqtts://broker.example")
    return failed("broker", words, "mend it where it is set: the shell's start file, or EnvironmentFile= of a unit")


def judge_way(broker: Broker, way: Way) -> Finding:
    """Judge whether there is anybody."""
    if way.trouble is None:
        return ok("broker", f"{broker.url} takes connections, in {way.took * 1000:.0f} ms")
    step = _STEPS.get(way.trouble, _STEPS[SILENT])
    return failed("broker", f"{broker.url}: {way.trouble}", step.format(host=broker.host, port=broker.port))


def judge_certificate(broker: Broker, way: Way, now: float, *, near: bool) -> list[Finding]:
    """Judge who can read on the way, and who it is that answers; `near`: whether that is this machine."""
    check = "certificate"
    if not broker.tls:
        if near:
            return []
        words = f"none: whoever is between here and {broker.host} can read all of it, and change it"
        step = f"give the broker a certificate (listener, certfile, keyfile in mosquitto.conf), and: {URL}=mqtts://…"
        return [warning(check, words, step)]
    by = f"the CA in {broker.ca}" if broker.ca else "the system's CAs"
    if way.untrusted is not None:
        return [failed(check, f"{way.untrusted} (by {by})", _trust(broker, way, now))]
    if way.until is None:
        return []
    date = time.strftime("%Y-%m-%d", time.gmtime(way.until))
    if way.until - now < _SOON:
        words = f"good until {date}, {span(way.until - now)} from now; trusted by {by}"
        return [warning(check, words, f"renew the certificate of {broker.host}, and have mosquitto read it: SIGHUP")]
    return [ok(check, f"trusted by {by}; good until {date}")]


def _trust(broker: Broker, way: Way, now: float) -> str:
    """Return what to do about a certificate that is none, or is not to be trusted."""
    if way.fault in _BY_TIME:
        clock = time.strftime("%Y-%m-%d %H:%M", time.gmtime(now))
        return f"renew the certificate of {broker.host}; or set this machine's clock: it says {clock} UTC"
    if way.fault in _BY_NAME:
        return f"name the host in {URL} as its certificate does, or have it certified as {broker.host}"
    if "ALERT" in str(way.untrusted):
        return "log in with a certificate that the broker takes: TALK_MQTT_CERT and TALK_MQTT_KEY name it"
    if not way.fault:
        log = "see what the broker's log says: journalctl -u mosquitto"
        return f"name the port that has TLS in {URL}, if {broker.port} of {broker.host} has none; or {log}"
    other = "another file" if broker.ca else "the file"
    return f"name {other} of the CA that the certificate of {broker.host} is of: {CA}=FILE"


def judge_login(broker: Broker, refusal: str | None) -> Finding:
    """Judge whether the broker lets this user in; `refusal`: why it does not."""
    if refusal is not None:
        wrong, _, remedy = refusal.partition("; ")
        step = "see what the broker's log says: journalctl -u mosquitto"
        if remedy:
            step = f"log in as somebody whom it knows: {remedy}"
        elif broker.tls and broker.cert is None:  # its word for that may be lost, as it hangs up at once
            step += "; where it wants a certificate, TALK_MQTT_CERT and TALK_MQTT_KEY name it"
        elif not broker.tls:
            step += f"; where port {broker.port} is for TLS: {URL}=mqtts://{broker.host}:{broker.port}"
        return failed("login", wrong, step)
    how = [words for words, given in (("a password", broker.password), ("a certificate", broker.cert)) if given]
    who = "nobody" if broker.user is None else f"'{broker.user}'"
    return ok("login", f"as {who}, with {' and '.join(how) or 'neither password nor certificate'}")


def judge_anonymous(refusal: str | None) -> Finding:
    """Judge whether anybody gets in; `refusal`: why nobody does."""
    if refusal is not None:
        return ok("anonymous", "who has no credentials is not let in")
    words = "the broker lets in who has no credentials: anybody on the network can make the robots speak"
    return warning("anonymous", words, "allow_anonymous false in mosquitto.conf, and: talk bridge --print-acl")


def judge_name(presence: Presence, now: float) -> Finding:
    """Judge what the broker keeps of the robot's presence."""
    robot = presence.name
    if not presence.online:
        step = f"see on {robot}: systemctl status talk-bridge; it has lost its network, its power, or its bridge"
        return failed("name", f"{robot} is offline", step)
    words = f"{robot} is online"
    if presence.since is not None:
        words += f" for {span(now - presence.since)}"
    words += f", session {presence.session}"
    if presence.groups:
        words += f", of {some(presence.groups)}"
    server = presence.server
    if server is None:
        return failed("name", f"{words}; it has no talk server", f"on {robot}: systemctl status talk; talk doctor")
    return ok("name", f"{words}; its server is talk {server.get('version')}, process {server.get('pid')}")


def judge_free(robot: str) -> Finding:
    """Judge a robot's own name of which the broker keeps nothing."""
    return ok("name", f"'{robot}' is free: no bridge has it, and none had it")


def judge_unknown(robot: str, known: tuple[str, ...], name: str, *, may: bool) -> Finding:
    """Judge a name of which the broker tells nothing: it has `known` others; `name` asks, and `may` do all else."""
    words = f"the broker knows no robot '{robot}'"
    by_lower = {each.lower(): each for each in known}
    near = [by_lower[each] for each in difflib.get_close_matches(robot.lower(), by_lower)]
    if near:
        return failed("name", f"{words}; it knows {some(tuple(near))}", f"talk --robot {near[0]} doctor")
    step = f"on the robot: talk bridge --name {robot}"
    if known:
        return failed("name", f"{words}; it knows {some(known)}", step)
    words += f", or does not tell '{name}'"
    if not may:
        return warning("name", words, f"let '{name}' do what an operator does, and ask again")
    return failed("name", words, f"{step}; or let '{name}' read presence: talk bridge --print-acl")


def judge_rights(name: str, allowed: Allowed) -> Finding:
    """Judge what the broker's access control list lets this user do."""
    parts = [f"write {' and '.join(allowed.unwritten)}"] if allowed.unwritten else []
    # Where the connection broke, what should have come back tells nothing.
    parts += [f"read {' and '.join(allowed.unread)}"] if allowed.unread and allowed.trouble is None else []
    if parts:
        words = f"the broker does not let '{name}' {', nor '.join(parts)}"
        return failed("rights", words, "give the broker's acl_file the lines for that: talk bridge --print-acl")
    if allowed.trouble is not None:
        words = f"what '{name}' may do can't be found out: {allowed.trouble}"
        return failed("rights", words, "see what the broker's log says: journalctl -u mosquitto")
    return ok("rights", f"the broker lets '{name}' do what is needed")


def judge_bridge(robot: str, server: JsonObject, took: float) -> Finding:
    """Judge what the robot's server says of itself, through all of it."""
    words = f"{robot} answers in {took * 1000:.0f} ms: {summary(server)}"
    if server.get("paused") is True:
        return warning("bridge", f"speech is paused; {words}", f"talk --robot {robot} resume")
    if server.get("engine") not in {"ready", "starting"}:
        return warning("bridge", words, f"on {robot}: talk doctor")
    return ok("bridge", words)


def judge_no_answer(robot: str, words: str) -> Finding:
    """Judge why no answer came."""
    wrong, _, remedy = words.partition("; ")
    step = f"see what the bridge's log says, on {robot}: journalctl -u talk-bridge"
    return failed("bridge", wrong, remedy or step)
