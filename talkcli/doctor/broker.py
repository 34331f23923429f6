"""Functions that check an MQTT broker and one of its robots.

The checks use the rights of an operator, or those of the robot's bridge if the login is the robot's name. They have no
side effects, because the broker doesn't retain the test messages, and bridges ignore them.
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
from talkcli.doctor.report import BRIDGE_QUESTION, FAILURE, ROBOT_QUESTION, Finding, failure, join_names, ok, warning
from talkcli.doctor.server import format_span, summarize_server
from talkcli.doctor.voice import WORKING_STATES
from talkcli.errors import ServerUnavailable, TalkError, UsageError
from talkcli.fleet import topics
from talkcli.fleet.broker import CA, URL, USER, client_user, from_environment, is_local
from talkcli.fleet.desk.robot import RobotConnection
from talkcli.fleet.link import LOGIN_LIMIT_S, MAX_RECEIVE_COUNT, Link, is_denied
from talkcli.fleet.payloads import Message, Presence
from talkcli.frozen import replace
from talkcli.polling import run_blocking, wait_ready
from talkcli.terminal.goals import describe_pause
from talkcli.terminal.text import printable

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from talkcli.fleet.broker import Broker
    from talkcli.goals.goal import JsonObject

_Result = TypeVar("_Result")

#: Time limit for each check. It is longer than `LOGIN_LIMIT_S`, because looking up the broker's host name also takes
#: time.
_STEP_LIMIT_S = 2 * LOGIN_LIMIT_S
#: How long to wait for test messages and presence messages after the broker has acknowledged everything.
_RETURN_LIMIT_S = 1.0
#: Payload of the doctor's test message. The echoes of bridges have a different payload.
_ECHO_PAYLOAD = b"doctor"
#: A warning is shown if the certificate expires within this time.
_RENEWAL_LIMIT_S = 14 * 86400
_NO_ANSWER = "no answer"
#: Advice for each reason why the broker can't be reached.
_UNREACHABLE_STEPS = {
    "connection refused": "check that a broker runs on {host}, for example with: systemctl status mosquitto; to accept "
    "connections from other machines, mosquitto needs the line 'listener {port}' in its settings",
    "no such host": "correct the host in TALK_BROKER, and check it: getent hosts {host}",
    _NO_ANSWER: "check that {host} is up and that no firewall blocks it: ping {host}",
}
#: OpenSSL's error codes for a certificate with an invalid date or the wrong host name.
_DATE_CODES, _HOST_CODES = (9, 10), (62, 64)
_LOG_STEP = "read the broker's log on its machine, for example with: journalctl -u mosquitto"


class BrokerExamination:
    """Checks a broker and one robot for `talk doctor`."""

    def __init__(
        self,
        robot: str,
        environment: Mapping[str, str],
        *,
        insecure: bool = False,
        interrupt: Mapping[int, int] | None = None,
    ) -> None:
        """Prepare the examination.

        Args:
            robot: the robot's name.
            environment: the environment variables, which contain the broker's settings.
            insecure: whether a password may be sent without TLS, as in `from_environment`.
            interrupt: descriptors that interrupt the examination, as in `wait_ready`.

        Raises:
            UsageError: The robot's name is not allowed.
        """
        fault = topics.name_fault(robot)
        if fault:
            raise UsageError(f"invalid robot name '{printable(robot)}': it {fault}")
        self._robot = robot
        self._environment, self._insecure = environment, insecure
        self._interrupt = interrupt
        #: whether the doctor logs in as the robot's bridge
        self._is_robot = environment.get(USER) == robot
        self._inbox: list[Message] = []
        #: the topics that the broker does not allow this user to read
        self._denied: list[str] = []
        #: the question that the report answers
        self.question = BRIDGE_QUESTION if self._is_robot else ROBOT_QUESTION

    def findings(self) -> Iterator[Finding]:
        """Run the checks. Yield the findings.

        Stop at a failure that makes further checks impossible.
        """
        try:
            broker = from_environment(self._environment, insecure=self._insecure)
            name, context = client_user(broker), broker.ssl_context()
        except UsageError as error:
            yield judge_settings(error.message, has_url=bool(self._environment.get(URL)))
            return
        for finding in self._check_connection(broker, context):
            yield finding
            if finding.state == FAILURE:
                return
        try:
            link = self._log_in(broker)
        except TalkError as error:
            yield judge_login(broker, error.message)
            return
        with contextlib.closing(link):
            yield judge_login(broker, None)
            yield self._check_anonymous(broker)
            rights_finding, presences = self._test_rights(link, name)
        if self._robot in presences:
            presence_finding = judge_presence(presences[self._robot], time.time())
        elif self._is_robot:
            presence_finding = ok("name", f"the name '{self._robot}' is free: no bridge has used it")
        else:
            has_other_rights = rights_finding.state != FAILURE
            known = sorted(presences) if has_other_rights else []
            presence_finding = judge_unknown_robot(self._robot, known, name, has_other_rights=has_other_rights)
        yield presence_finding
        yield rights_finding
        if not self._is_robot and FAILURE not in (presence_finding.state, rights_finding.state):
            yield self._check_robot_server(broker)

    def _check_connection(self, broker: Broker, context: ssl.SSLContext | None) -> Iterator[Finding]:
        """Connect to the broker, and check its certificate. Yield the findings."""
        began = time.monotonic()
        try:
            connection = self._run_limited(partial(socket.create_connection, (broker.host, broker.port), LOGIN_LIMIT_S))
        except (OSError, UnicodeError) as error:  # UnicodeError means that the host name is invalid
            yield judge_unreachable(broker, _explain_error(error))
            return
        yield ok("broker", f"connected to {broker.url} in {(time.monotonic() - began) * 1000:.0f} ms")
        expires_at = None
        with connection:
            if context is not None:
                try:
                    expires_at = self._run_limited(partial(_read_expiry, connection, context, broker.host))
                except OSError as error:
                    code = error.verify_code if isinstance(error, ssl.SSLCertVerificationError) else 0
                    yield judge_tls_error(broker, _explain_error(error), code, time.time())
                    return
        if broker.tls or not is_local(broker.host):
            yield judge_certificate(broker, expires_at, time.time())

    def _log_in(self, broker: Broker) -> Link:
        """Log in to the broker. Return the open connection.

        Raises the same errors as `Link.open`.
        """
        name = f"talk-doctor-{os.urandom(8).hex()}"

        def on_subscribed(topic: str, code: int) -> None:
            if is_denied(code):
                self._denied.append(topic)

        link = Link(broker, name, self._inbox.append, receive_maximum=MAX_RECEIVE_COUNT, on_subscribed=on_subscribed)
        try:
            self._run_limited(link.open)
        except TimeoutError as error:
            raise ServerUnavailable(f"the broker at {broker.url} did not answer within {_STEP_LIMIT_S:g} s") from error
        return link

    def _check_anonymous(self, broker: Broker) -> Finding:
        """Check whether the broker accepts a login without credentials. Return the finding."""
        try:
            self._log_in(replace(broker, user=None, password=None, cert=None, key=None)).close()
        except TalkError:
            return ok("anonymous", "the broker rejects clients without credentials")
        words = "the broker accepts clients without credentials: anybody on the network can make the robots speak"
        return warning(
            "anonymous",
            words,
            "require a login (mosquitto: allow_anonymous false), and add access rules: talk bridge --print-acl",
        )

    def _test_rights(self, link: Link, user: str) -> tuple[Finding, dict[str, Presence]]:
        """Test the user's access rights. Return the finding and the robots' presence messages.

        The user needs the rights of an operator, or those of
        this robot's bridge. Other robots are only read if this robot's presence is missing, and the user isn't the
        robot.
        """
        robot, replies = partial(topics.robot, self._robot), partial(topics.reply, user, os.urandom(8).hex())
        if self._is_robot:
            echo = robot(topics.ECHO)
            others = [robot(topics.STATUS), robot(topics.EVENT, "doctor"), replies(self._robot)]
            # Requests that arrive are ignored, because the robot's bridge gets them, too.
            link.subscribe(*(robot(each, topics.ANY) for each in topics.REQUEST_LEVELS), retained=False)
        else:
            echo, others = replies(topics.MARKER), [robot(topics.REQUEST, user)]
        codes, presences = dict[str, int](), dict[str, Presence]()
        link.subscribe(echo, retained=False)
        link.subscribe(robot(topics.PRESENCE), retained=True)
        tested = {echo: _ECHO_PAYLOAD} | dict.fromkeys(others, b"")
        for topic, payload in tested.items():
            link.publish(Message(topic, payload), on_acknowledged=partial(codes.__setitem__, topic))
        now = time.monotonic()
        end = now + LOGIN_LIMIT_S
        is_acknowledged = is_back = False
        while link.ended is None and now < end and not (is_acknowledged and is_back and self._robot in presences):
            watched = {link.fileno(): select.POLLIN | (select.POLLOUT if link.wants_write else 0)}
            if link.fileno() in wait_ready(watched, end - now, self._interrupt):
                link.read()
            for message in self._inbox:
                is_back = is_back or (message.topic, message.payload) == (echo, _ECHO_PAYLOAD)
                _, _, sender, kind, *_ = message.topic.split("/")
                if kind == topics.PRESENCE and (presence := Presence.read(sender, message.payload)):
                    presences[sender] = presence
            self._inbox.clear()
            now = time.monotonic()
            if not is_acknowledged and len(codes) == len(tested):
                is_acknowledged, end = True, min(end, now + _RETURN_LIMIT_S)
                if not (self._is_robot or self._robot in presences):
                    link.subscribe(topics.robot(topics.ANY, topics.PRESENCE), retained=True)
        unwritable = tuple(each for each in tested if is_denied(codes.get(each, 0)))
        missing = [each for each in tested if each not in codes]
        trouble = link.ended or (f"the broker did not acknowledge a message to {missing[0]}" if missing else None)
        unreadable = dict.fromkeys(self._denied if is_back or echo in unwritable else (*self._denied, echo))
        return judge_rights(user, unwritable, tuple(unreadable), trouble), presences

    def _check_robot_server(self, broker: Broker) -> Finding:
        """Request the status of the robot's server. Return the finding."""
        end = time.monotonic() + _STEP_LIMIT_S
        try:
            connecting = RobotConnection.open(
                self._robot, broker, name="talk doctor", interrupt=self._interrupt, patience_s=LOGIN_LIMIT_S, end=end
            )
            with Client.over(run_blocking(connecting)) as client:
                began = time.monotonic()
                server = client.status().server
                return judge_server_status(self._robot, server, time.monotonic() - began)
        except TalkError as error:
            wrong, _, remedy = error.message.partition("; ")
            step = f"on {self._robot}, read the bridge's log: journalctl -u talk-bridge"
            rules = f"if it reports nothing, compare {self._robot}'s access rules with: talk bridge --print-acl"
            return failure("bridge", wrong, remedy or f"{step}; {rules}")

    def _run_limited(self, function: Callable[[], _Result]) -> _Result:
        """Run a blocking function in a thread. Return its result. Raise TimeoutError if it takes too long.

        Raises:
            TimeoutError: The work takes too long. The thread continues, but its result is ignored.
            Interrupted: The examination was interrupted.
        """
        result: Future[_Result] = Future()
        reader, writer = socket.socketpair()

        def run() -> None:
            with writer:
                try:
                    result.set_result(function())
                except BaseException as error:  # noqa: BLE001 - raised again in the waiting thread
                    result.set_exception(error)

        threading.Thread(target=run, name="talk doctor: asking", daemon=True).start()
        with reader:
            if not wait_ready({reader.fileno(): 0}, _STEP_LIMIT_S, self._interrupt):
                raise TimeoutError
        return result.result()


def _read_expiry(connection: socket.socket, context: ssl.SSLContext, host: str) -> float:
    """Start TLS. Return the certificate's expiry time, in seconds since 1970."""
    with context.wrap_socket(connection, server_hostname=host) as secured:
        return ssl.cert_time_to_seconds(str((secured.getpeercert() or {})["notAfter"]))


def _explain_error(error: OSError | UnicodeError) -> str:
    """Describe briefly why a connection to the broker failed."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return error.verify_message
    if isinstance(error, ssl.SSLError):
        return error.reason or str(error)
    if isinstance(error, ConnectionRefusedError):
        return "connection refused"
    if isinstance(error, socket.gaierror | UnicodeError):
        return "no such host"
    return _NO_ANSWER if isinstance(error, TimeoutError) else error.strerror or str(error)


def judge_settings(message: str, *, has_url: bool) -> Finding:
    """Create the finding for invalid or missing broker settings.

    Args:
        message: the error message.
        has_url: whether TALK_BROKER is set.
    """
    if not has_url:
        return failure("broker", f"{URL} is not set", f"export {URL}=mqtts://broker.example")
    return failure("broker", message, "correct it in the shell's startup file, or in the unit's EnvironmentFile=")


def judge_unreachable(broker: Broker, reason: str) -> Finding:
    """Create the finding for a broker that can't be reached.

    `reason` is a text of `_explain_error`.
    """
    step = _UNREACHABLE_STEPS.get(reason, _UNREACHABLE_STEPS[_NO_ANSWER])
    return failure("broker", f"{broker.url}: {reason}", step.format(host=broker.host, port=broker.port))


def judge_certificate(broker: Broker, expires_at: float | None, now: float) -> Finding:
    """Check when the broker's certificate expires, and whether TLS is used. Return the finding.

    Args:
        broker: the broker.
        expires_at: when the certificate expires, in seconds since 1970; None without TLS.
        now: the current time in seconds since 1970.
    """
    if expires_at is None:
        words = f"no TLS: anybody on the network between here and {broker.host} can read and change the messages"
        step = f"give the broker a certificate (mosquitto: listener, certfile, keyfile), and set {URL}=mqtts://…"
        return warning("certificate", words, step)
    date = time.strftime("%Y-%m-%d", time.gmtime(expires_at))
    if expires_at - now < _RENEWAL_LIMIT_S:
        words = f"valid until {date}, {format_span(expires_at - now)} from now; trusted by {_describe_cas(broker)}"
        step = f"renew the certificate of {broker.host}, and let the broker read it (mosquitto: send SIGHUP)"
        return warning("certificate", words, step)
    return ok("certificate", f"trusted by {_describe_cas(broker)}; valid until {date}")


def judge_tls_error(broker: Broker, message: str, verify_code: int, now: float) -> Finding:
    """Create the finding for a failed TLS connection.

    Args:
        broker: the broker.
        message: the error message.
        verify_code: OpenSSL's error code if the certificate was rejected, otherwise 0.
        now: the current time in seconds since 1970.
    """
    step = _advise_on_tls_error(broker, message, verify_code, now)
    return failure("certificate", f"{message} (checked against {_describe_cas(broker)})", step)


def _describe_cas(broker: Broker) -> str:
    """Describe the CAs that should have signed the broker's certificate."""
    return f"the CA in {broker.ca}" if broker.ca else "the system's CAs"


def _advise_on_tls_error(broker: Broker, message: str, verify_code: int, now: float) -> str:
    """Return advice on how to fix a TLS error.

    The arguments are those of `judge_tls_error`.
    """
    if verify_code in _DATE_CODES:
        clock = time.strftime("%Y-%m-%d %H:%M", time.gmtime(now))
        return f"renew the certificate of {broker.host}; or set this machine's clock, which shows {clock} UTC"
    if verify_code in _HOST_CODES:
        return f"use the host name of its certificate in {URL}, or get a certificate for {broker.host}"
    if "ALERT" in message:
        return "log in with a certificate that the broker accepts: set TALK_MQTT_CERT and TALK_MQTT_KEY"
    if not verify_code:
        return f"if port {broker.port} of {broker.host} has no TLS, use its TLS port in {URL}; otherwise, {_LOG_STEP}"
    file = "another file" if broker.ca else "a file"
    return f"set {CA} to {file} with the certificate of the CA that issued the certificate of {broker.host}"


def judge_login(broker: Broker, refusal: str | None) -> Finding:
    """Create the finding for a login. The login succeeded if `refusal` is None.

    Otherwise, `refusal` says why the broker refused it.
    """
    if refusal is not None:
        wrong, _, remedy = refusal.partition("; ")
        step = remedy or _LOG_STEP
        if "did not answer" in wrong:
            if broker.tls and broker.cert is None:  # the broker disconnects at once, so the reason may be missing
                step += "; if it requires a certificate, set TALK_MQTT_CERT and TALK_MQTT_KEY"
            elif not broker.tls:
                step += f"; if port {broker.port} is for TLS, set {URL}=mqtts://{broker.host}:{broker.port}"
        return failure("login", wrong, step)
    how = [words for words, given in (("a password", broker.password), ("a certificate", broker.cert)) if given]
    who = "an anonymous user" if broker.user is None else f"'{broker.user}'"
    return ok("login", f"as {who}, with {' and '.join(how) or 'no password or certificate'}")


def judge_presence(presence: Presence, now: float) -> Finding:
    """Check whether a robot and its server are online. Return the finding."""
    robot = presence.name
    if not presence.online:
        step = f"check its network and power; on {robot}, run: systemctl status talk-bridge"
        return failure("name", f"{robot} is offline", step)
    words = f"{robot} is online"
    if presence.since is not None:
        words += f" for {format_span(now - presence.since)}"
    words += f", session {presence.session}"
    if presence.groups:
        words += f", groups: {join_names(presence.groups)}"
    server = presence.server
    if server is None:
        return failure("name", f"{words}; it has no talk server", f"on {robot}: systemctl status talk; talk doctor")
    return ok("name", f"{words}; its server is talk {server.get('version')}, process {server.get('pid')}")


def judge_unknown_robot(robot: str, known_robots: list[str], user: str, *, has_other_rights: bool) -> Finding:
    """Create the finding for a robot that the broker doesn't know.

    Args:
        robot: the robot's name.
        known_robots: the names of the robots that the broker knows.
        user: the user's name.
        has_other_rights: whether the user has all other access rights.
    """
    words = f"the broker knows no robot named '{robot}'"
    by_lower = {each.lower(): each for each in known_robots}
    near = [by_lower[each] for each in difflib.get_close_matches(robot.lower(), by_lower)]
    if near:
        return failure("name", f"{words}; known robots: {join_names(near)}", f"talk --robot {near[0]} doctor")
    step = f"on the robot, run: talk bridge --name {robot}"
    if known_robots:
        return failure("name", f"{words}; known robots: {join_names(known_robots)}", step)
    words += f", or '{user}' is not allowed to see it"
    if not has_other_rights:
        return warning("name", words, f"give '{user}' the rights of an operator, and run talk doctor again")
    return failure("name", words, f"{step}; or add the access rules for '{user}': talk bridge --print-acl")


def judge_rights(user: str, unwritable: tuple[str, ...], unreadable: tuple[str, ...], error: str | None) -> Finding:
    """Create the finding for a test of the user's access rights.

    Args:
        user: the user's name.
        unwritable: topics to which the user must not publish.
        unreadable: topics that the user can't read, because the broker said so, or because no message came back.
        error: why the rights could not be tested, or None if they could.
    """
    parts = [f"write to {' and '.join(unwritable)}"] if unwritable else []
    # If the connection broke, a missing message doesn't prove that reading is forbidden.
    parts += [f"read {' and '.join(unreadable)}"] if unreadable and error is None else []
    if parts:
        words = f"the broker does not allow '{user}' to {', or to '.join(parts)}"
        return failure("rights", words, "add the missing access rules to the broker: talk bridge --print-acl")
    if error is not None:
        return failure("rights", f"the rights of '{user}' could not be tested: {error}", _LOG_STEP)
    return ok("rights", f"the broker gives '{user}' all the rights that are needed")


def judge_server_status(robot: str, server: JsonObject, response_s: float) -> Finding:
    """Check whether the robot's server is paused and its engine works. Return the finding."""
    words = f"{robot} answered in {response_s * 1000:.0f} ms: {summarize_server(server)}"
    if server.get("paused") is True:
        return warning("bridge", f"{describe_pause(server)}; {words}", f"talk --robot {robot} resume")
    if server.get("engine") not in WORKING_STATES:
        return warning("bridge", words, f"on {robot}, run: talk doctor")
    return ok("bridge", words)
