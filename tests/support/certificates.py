"""Certificates for brokers and clients. openssl makes them once per process."""

from __future__ import annotations

import atexit
import contextlib
import functools
import os
import subprocess
from dataclasses import dataclass

from tests.support.surroundings import needs, short_directory

#: Extensions that Python 3.13 requires.
_EXTENSIONS = """
[req]
distinguished_name = name
[name]
[authority]
basicConstraints = critical, CA:TRUE
keyUsage = critical, keyCertSign, cRLSign
subjectKeyIdentifier = hash
[server]
basicConstraints = CA:FALSE
keyUsage = critical, digitalSignature
extendedKeyUsage = serverAuth
subjectAltName = DNS:localhost, IP:127.0.0.1
subjectKeyIdentifier = hash
authorityKeyIdentifier = keyid
[client]
basicConstraints = CA:FALSE
keyUsage = critical, digitalSignature
extendedKeyUsage = clientAuth
subjectKeyIdentifier = hash
authorityKeyIdentifier = keyid
"""
_KEY = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
_LIMIT = 20.0


@dataclass(frozen=True, slots=True)
class Certificate:
    """The paths of a certificate and its key."""

    file: str
    key: str


class Authority:
    """A certificate authority. `file` is the path of its own certificate."""

    def __init__(self, directory: str, name: str) -> None:
        needs("openssl")
        self._base = f"{directory}/{name}"
        self.file = f"{self._base}.crt"
        self._made: dict[tuple[str, str], Certificate] = {}
        self._settings = f"{self._base}.conf"
        with open(self._settings, "w", encoding="ascii") as file:
            file.write(_EXTENSIONS)
        new = ["-new", "-x509", *_KEY, "-days", "2", "-extensions", "authority", "-config", self._settings]
        self._openssl("req", *new, "-subj", f"/CN={name}", "-keyout", f"{self._base}.key", "-out", self.file)

    @property
    def server(self) -> Certificate:
        """The certificate of a server at localhost or 127.0.0.1."""
        return self._sign("localhost", "server", 2)

    @property
    def expired(self) -> Certificate:
        """A server certificate that expired yesterday."""
        return self._sign("localhost", "server", -1)

    def client(self, name: str) -> Certificate:
        """Return the certificate of the client with this name."""
        return self._sign(name, "client", 2)

    def _sign(self, name: str, kind: str, days: int) -> Certificate:
        made = self._made.get((name, f"{kind}{days}"))
        if made:
            return made
        base = f"{self._base}-{len(self._made)}"
        made = Certificate(f"{base}.crt", f"{base}.key")
        subject = ["-subj", f"/CN={name}", "-keyout", made.key, "-out", f"{base}.csr"]
        self._openssl("req", "-new", *_KEY, *subject, "-config", self._settings)
        ca = ["-CA", self.file, "-CAkey", f"{self._base}.key", "-set_serial", str(len(self._made) + 1)]
        options = ["-days", str(days), "-extfile", self._settings, "-extensions", kind]
        self._openssl("x509", "-req", "-in", f"{base}.csr", *ca, *options, "-out", made.file)
        self._made[name, f"{kind}{days}"] = made
        return made

    def _openssl(self, *arguments: str) -> None:
        command = ["openssl", *arguments]
        done = subprocess.run(command, capture_output=True, text=True, timeout=_LIMIT, check=False)
        assert done.returncode == 0, f"{' '.join(command)}: {done.stderr}"


@functools.cache
def authority() -> Authority:
    """Return the authority that the tests' clients trust."""
    return Authority(_directory(), "authority")


@functools.cache
def stranger() -> Authority:
    """Return an authority that no broker and no client trusts."""
    return Authority(_directory(), "stranger")


@functools.cache
def _directory() -> str:
    stack = contextlib.ExitStack()
    atexit.register(stack.close)
    directory = stack.enter_context(short_directory("certificates-"))
    os.chmod(directory, 0o755)  # a broker may run as another user
    return directory
