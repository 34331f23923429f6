"""The broker's address and login, read from environment variables.

Settings that would expose a secret are refused. This module doesn't connect to the broker.
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

# Names of environment variables.
URL = "TALK_BROKER"
USER = "TALK_MQTT_USER"
PASSWORD_FILE = "TALK_MQTT_PASSWORD_FILE"
CA = "TALK_MQTT_CA"
CERT = "TALK_MQTT_CERT"
KEY = "TALK_MQTT_KEY"
#: For each URL scheme, whether it uses TLS, and its default port.
_SCHEMES = {"mqtt": (False, 1883), "mqtts": (True, 8883)}
#: Maximum length of a password in MQTT.
_MAX_PASSWORD_BYTES = 65_535


@frozen
class Broker:
    """The address of a broker, and the credentials for logging in."""

    host: str
    port: int
    tls: bool
    #: the user name; None for an anonymous login, or if the certificate contains the user name
    user: str | None = None
    password: str | None = None
    #: path of the CA certificate for checking the broker; None to use the system's CAs
    ca: str | None = None
    #: path of the client's certificate
    cert: str | None = None
    #: path of the certificate's private key; None if the certificate file contains it
    key: str | None = None

    @property
    def url(self) -> str:
        """The broker's address, without the login."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'mqtts' if self.tls else 'mqtt'}://{host}:{self.port}"

    def ssl_context(self) -> ssl.SSLContext | None:
        """Create an SSL context. Return None if the connection doesn't use TLS.

        Raises:
            UsageError: a certificate or key file is unusable.
        """
        if not self.tls:
            return None
        names, path = CA, self.ca
        try:
            context = ssl.create_default_context(cafile=path)
            if self.cert:
                names, path = f"{CERT} and {KEY}", self.cert
                context.load_cert_chain(path, self.key, password=_refuse_passphrase)
        except (OSError, UsageError) as error:
            raise UsageError(f"{names}: {_describe_file_error(path, error)}") from error
        return context


def from_environment(environment: Mapping[str, str], *, insecure: bool = False) -> Broker:
    """Read the broker's address and credentials from environment variables.

    Args:
        environment: the variables.
        insecure: whether a password may be sent to another machine in clear text.

    Raises:
        UsageError: a variable is missing or invalid.
    """
    url = environment.get(URL, "")
    if not url:
        raise UsageError(f"{URL} is not set; name your broker: export {URL}=mqtts://broker.example")
    host, port, tls = _parse_url(url)
    user, file, ca, cert, key = (environment.get(each) or None for each in (USER, PASSWORD_FILE, CA, CERT, KEY))
    password = _read_password(file) if file else None
    if password is not None and user is None:
        raise UsageError(f"{PASSWORD_FILE} is set, but {USER} is not; set {USER} to the name of the user")
    for name, value in ((CA, ca), (CERT, cert), (KEY, key)):
        if value and not tls:
            raise UsageError(f"{name} needs TLS; change {URL} to an address that begins with mqtts://")
    if key and not cert:
        raise UsageError(f"{KEY} is set, but {CERT} is not; set {CERT} to the certificate file")
    if password is not None and not (tls or insecure or is_local(host)):
        raise UsageError(
            f"the password would be sent to {printable(host)} in clear text; use {URL}=mqtts://…, or add "
            "--insecure if you trust the network"
        )
    return Broker(host, port, tls, user, password, ca, cert, key)


def require_paho() -> None:
    """Raise UsageError if paho-mqtt is not installed."""
    if find_spec("paho") is None:
        raise UsageError(f"a fleet needs paho-mqtt; install it with: {install.command('paho-mqtt')}")


def client_user(broker: Broker) -> str:
    """Return the user name for topics. Without a login, this is the name of the local user.

    Raises:
        UsageError: the name isn't allowed in a topic.
    """
    name = broker.user
    if name is None:
        try:
            name = pwd.getpwuid(os.getuid()).pw_name
        except KeyError:
            name = f"uid-{os.getuid()}"
    if fault := topics.name_fault(name):
        raise UsageError(f"invalid user name '{printable(name)}': it {fault}; set {USER} to another name")
    return name


def _parse_url(url: str) -> tuple[str, int, bool]:
    """Parse a broker's URL. Return the host, the port and whether to use TLS.

    Error messages don't show the whole URL, because it may contain a password.

    Raises:
        UsageError: the URL is invalid.
    """
    try:
        parts = urlsplit(url)
    except ValueError:  # the original message shows the URL, which may contain a password
        raise UsageError(f"{URL} is not a valid URL; use mqtts://HOST or mqtt://HOST") from None
    if parts.scheme not in _SCHEMES:
        raise UsageError(
            f"{URL} is not the URL of a broker; use mqtts://HOST or mqtt://HOST, with :PORT if it isn't the default"
        )
    if parts.username is not None or parts.password is not None:
        raise UsageError(f"{URL} must not contain a user or a password; set {USER} and {PASSWORD_FILE} instead")
    tls, default_port = _SCHEMES[parts.scheme]
    try:
        port = parts.port
    except ValueError:
        raise UsageError(f"{URL} has an invalid port; it must be a number from 1 to 65535") from None
    if not parts.hostname or port == 0:
        raise UsageError(f"{URL} has no valid host or port; use {parts.scheme}://HOST or {parts.scheme}://HOST:PORT")
    if parts.path not in ("", "/") or parts.query or parts.fragment:
        raise UsageError(f"{URL} must only have a host and a port; use {parts.scheme}://{printable(parts.netloc)}")
    return parts.hostname, port or default_port, tls


def _read_password(path: str) -> str:
    """Return the password in a file. Raise UsageError if the file is unusable."""
    try:
        with open(path, "rb") as file:
            password = file.read(_MAX_PASSWORD_BYTES + 3).rstrip(b"\r\n")
    except OSError as error:
        raise UsageError(f"{PASSWORD_FILE}: {_describe_file_error(path, error)}") from error
    if not password or len(password) > _MAX_PASSWORD_BYTES:
        raise UsageError(
            f"{PASSWORD_FILE}: {printable(path)} is {'too long' if password else 'empty'}; put only the password in it"
        )
    try:
        return password.decode()
    except UnicodeDecodeError:
        raise UsageError(f"{PASSWORD_FILE}: {printable(path)} is not UTF-8") from None


def is_local(host: str) -> bool:
    """Return whether a host is localhost or a loopback address."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _refuse_passphrase() -> str:
    """Raise UsageError. OpenSSL calls this function if a key has a passphrase."""
    raise UsageError("the key has a passphrase, which talk can't ask for; use a key without a passphrase")


def _describe_file_error(path: str | None, error: Exception) -> str:
    """Return a message that explains why a file can't be used."""
    if isinstance(error, ssl.SSLError):
        return f"{printable(str(path))} is not a valid certificate or key: {error.reason or error}"
    words = error.strerror if isinstance(error, OSError) else str(error)
    return f"{printable(str(path))}: {words}"
