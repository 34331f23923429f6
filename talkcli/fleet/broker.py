"""Which broker, and who logs in there: read from the environment, and refused where a secret would be given away.

Nothing here connects to anything.
"""

from __future__ import annotations

import ipaddress
import os
import pwd
import ssl
from importlib.util import find_spec
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from talkcli import install
from talkcli.errors import UsageError
from talkcli.fleet import topics
from talkcli.frozen import frozen
from talkcli.terminal.text import printable

if TYPE_CHECKING:
    from collections.abc import Mapping

URL = "TALK_BROKER"
USER = "TALK_MQTT_USER"
PASSWORD_FILE = "TALK_MQTT_PASSWORD_FILE"
CA = "TALK_MQTT_CA"
CERT = "TALK_MQTT_CERT"
KEY = "TALK_MQTT_KEY"
#: By the URL's scheme: whether it is TLS, and the port that IANA has for it.
_SCHEMES = {"mqtt": (False, 1883), "mqtts": (True, 8883)}
#: Bytes of a password file at most: MQTT's limit of a password.
_LONGEST_PASSWORD = 65_535


@frozen
class Broker:
    """A broker, and how to log in there."""

    host: str
    port: int
    tls: bool
    #: None logs in as nobody, or as whoever the certificate names
    user: str | None = None
    password: str | None = None
    #: files of the CA that the broker's certificate is of (None: the system's), of a client's certificate and its key
    ca: str | None = None
    cert: str | None = None
    key: str | None = None

    @property
    def url(self) -> str:
        """Where it is, for people; no secret is in it."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'mqtts' if self.tls else 'mqtt'}://{host}:{self.port}"

    def context(self) -> ssl.SSLContext | None:
        """Return what TLS needs, None without TLS; UsageError for a file that can't be read or is none of its kind."""
        if not self.tls:
            return None
        try:
            context = ssl.create_default_context(cafile=self.ca)
        except (OSError, ssl.SSLError) as error:
            raise UsageError(f"{CA}: {_wrong(self.ca, error)}") from error
        if self.cert:
            try:
                context.load_cert_chain(self.cert, self.key, password=_no_passphrase)
            except (OSError, ssl.SSLError, UsageError) as error:
                raise UsageError(f"{CERT} and {KEY}: {_wrong(self.cert, error)}") from error
        return context


def from_environment(environment: Mapping[str, str], *, insecure: bool = False) -> Broker:
    """Return the broker that TALK_BROKER names, with what the variables beside it say.

    `insecure`: whether a password may go in clear text to another machine. UsageError for what is wrong, or missing.
    """
    url = environment.get(URL, "")
    if not url:
        raise UsageError(f"which broker? {URL} is not set: export {URL}=mqtts://broker.example")
    host, port, tls = _parts(url)
    user, file = environment.get(USER) or None, environment.get(PASSWORD_FILE)
    ca, cert, key = environment.get(CA) or None, environment.get(CERT) or None, environment.get(KEY) or None
    password = _password(file) if file else None
    if password is not None and user is None:
        raise UsageError(f"{PASSWORD_FILE} is set, and {USER} is not: whose password is it?")
    for name, value in ((CA, ca), (CERT, cert), (KEY, key)):
        if value and not tls:
            raise UsageError(f"{name} means nothing without TLS: {URL} begins with mqtts:// then")
    if key and not cert:
        raise UsageError(f"{KEY} is set, and {CERT} is not: name the certificate, too")
    if password is not None and not (tls or insecure or is_here(host)):
        raise UsageError(
            f"the password would go to {printable(host)} in clear text: write {URL}=mqtts://…, or give "
            "--insecure where nobody can listen"
        )
    return Broker(host, port, tls, user, password, ca, cert, key)


def need_client() -> None:
    """Raise UsageError if the MQTT client, paho-mqtt, is not installed."""
    if find_spec("paho") is None:
        raise UsageError(f"a fleet needs paho-mqtt: {install.command('paho-mqtt')}")


def user(broker: Broker) -> str:
    """Return who asks, as the last level of a topic has it: the broker's user, or else this machine's.

    UsageError for one that can't be a level of a topic.
    """
    name = broker.user
    if name is None:
        try:
            name = pwd.getpwuid(os.getuid()).pw_name
        except KeyError:
            name = f"uid-{os.getuid()}"
    fault = topics.fault(name)
    if fault:
        raise UsageError(f"the name '{printable(name)}' can't be in a topic, it {fault}: set {USER} to one that can")
    return name


def _parts(url: str) -> tuple[str, int, bool]:
    """Return host, port, and whether it is TLS; what is wrong is said without the URL, which may hold a password."""
    try:
        parts = urlsplit(url)
    except ValueError:  # which shows the URL
        raise UsageError(f"{URL} is no URL: write mqtts://HOST or mqtt://HOST") from None
    if parts.scheme not in _SCHEMES:
        raise UsageError(
            f"{URL} is no broker's URL: write mqtts://HOST or mqtt://HOST, with :PORT if it is not the usual"
        )
    if parts.username is not None or parts.password is not None:
        raise UsageError(f"{URL} holds a user or a password: set {USER} and {PASSWORD_FILE}, and leave them out there")
    tls, usual = _SCHEMES[parts.scheme]
    try:
        port = parts.port
    except ValueError:
        raise UsageError(f"{URL} has a port that is none: a number from 1 to 65535") from None
    if not parts.hostname or port == 0:
        raise UsageError(f"{URL} names no host and port: write {parts.scheme}://HOST or {parts.scheme}://HOST:PORT")
    if parts.path not in ("", "/") or parts.query or parts.fragment:
        raise UsageError(f"{URL} has more than a host and a port: write {parts.scheme}://{printable(parts.netloc)}")
    return parts.hostname, port or usual, tls


def _password(path: str) -> str:
    try:
        with open(path, "rb") as file:
            found = file.read(_LONGEST_PASSWORD + 3).rstrip(b"\r\n")
    except OSError as error:
        raise UsageError(f"{PASSWORD_FILE}: {_wrong(path, error)}") from error
    if not found or len(found) > _LONGEST_PASSWORD:
        raise UsageError(
            f"{PASSWORD_FILE}: {printable(path)} is {'too long' if found else 'empty'}: it holds the password alone"
        )
    try:
        return found.decode()
    except UnicodeDecodeError:
        raise UsageError(f"{PASSWORD_FILE}: {printable(path)} is not UTF-8") from None


def is_here(host: str) -> bool:
    """Whether a host is this machine, so that nobody listens in between."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _no_passphrase() -> str:
    raise UsageError("the key has a passphrase, and nobody is there to type it: take a key without one")


def _wrong(path: str | None, error: Exception) -> str:
    """Return what is wrong with a file, for people."""
    if isinstance(error, ssl.SSLError):
        return f"{printable(str(path))} is not what it should be: {error.reason or error}"
    words = error.strerror if isinstance(error, OSError) else str(error)
    return f"{printable(str(path))}: {words}"
