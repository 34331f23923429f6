"""A private broker: a real mosquitto on 127.0.0.1 that tests can kill and restart."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import time
from typing import TYPE_CHECKING

from tests.support.certificates import authority
from tests.support.ports import HOST, Port
from tests.support.resources import Resource
from tests.support.surroundings import clean_environment, dying_with_parent, find_program, needs, short_directory

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

#: Time limit until a broker listens, in seconds.
_START = 10.0


class Broker(Resource):
    """A running broker that stores nothing on disk. `close()` and `with` end it and remove its directory.

    Args:
        secure: Accept only TLS.
        users: Passwords by user name. Other users are refused, unless `anonymous`.
        certificates: Require client certificates, which name the user. Implies `secure`.
        acl: Text of an access control list.
        max_packet: Size of the largest packet in bytes.
        expired: Use an expired server certificate.
        settings: More lines for mosquitto's configuration.
    """

    def __init__(
        self,
        *,
        secure: bool = False,
        users: Mapping[str, str] | None = None,
        anonymous: bool | None = None,
        certificates: bool = False,
        acl: str | None = None,
        max_packet: int | None = None,
        expired: bool = False,
        settings: Sequence[str] = (),
    ) -> None:
        needs("mosquitto")
        self.secure = secure or certificates or expired
        self._users = dict(users or {})
        self._process: subprocess.Popen[bytes] | None = None
        with contextlib.ExitStack() as stack:
            self.directory = stack.enter_context(short_directory("broker-"))
            self.port = stack.enter_context(Port()).number
            lines = [f"listener {self.port} {HOST}", "log_dest stderr", "log_type all", "persistence false", *settings]
            if anonymous is None:
                anonymous = not (users or certificates)
            lines.append(f"allow_anonymous {str(anonymous).lower()}")
            if os.getuid() == 0:  # otherwise it becomes the user mosquitto, who may not read this directory
                lines.append("user root")
            if max_packet is not None:
                lines.append(f"max_packet_size {max_packet}")
            if users:
                lines.append(f"password_file {self._write_passwords(users)}")
            if acl is not None:
                lines.append(f"acl_file {self._write('acl', acl)}")
            if self.secure:
                certificate = authority().expired if expired else authority().server
                lines += [f"certfile {certificate.file}", f"keyfile {certificate.key}"]
            if certificates:
                lines += [f"cafile {authority().file}", "require_certificate true", "use_identity_as_username true"]
            self._settings = self._write("mosquitto.conf", "\n".join(lines) + "\n")
            stack.callback(self._end)
            self.start()
            self._stack = stack.pop_all()

    @property
    def url(self) -> str:
        return self.url_at(self.port)

    @property
    def pid(self) -> int:
        return self._running().pid

    def url_at(self, port: int) -> str:
        """Return the URL for clients that use another port, such as that of a proxy."""
        return f"mqtts://localhost:{port}" if self.secure else f"mqtt://{HOST}:{port}"

    def env(self, user: str | None = None, password: str | bool = True, cert: str | None = None) -> dict[str, str]:
        """Return the environment variables of a client. `password` is True for the user's own one, False for none."""
        result = {"TALK_BROKER": self.url}
        if self.secure:
            result["TALK_MQTT_CA"] = authority().file
        if user is not None:
            result["TALK_MQTT_USER"] = user
            if password is not False:
                secret = self._users[user] if password is True else password
                result["TALK_MQTT_PASSWORD_FILE"] = self._write(f"{user}.password", f"{secret}\n")
        if cert is not None:
            certificate = authority().client(cert)
            result |= {"TALK_MQTT_CERT": certificate.file, "TALK_MQTT_KEY": certificate.key}
        return result

    def start(self) -> None:
        """Start the broker and wait until it listens. After `kill()`, it uses the same port."""
        with open(f"{self.directory}/log", "ab") as log:
            self._process = subprocess.Popen(
                dying_with_parent([find_program("mosquitto") or "mosquitto", "-c", self._settings]),
                env=clean_environment(self.directory),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )
        end = time.monotonic() + _START
        with socket.socket() as probe:
            while probe.connect_ex((HOST, self.port)):
                code = self._process.poll()
                assert code is None, f"mosquitto ended with {code}: {self.log}"
                assert time.monotonic() < end, f"mosquitto does not listen within {_START} s: {self.log}"
                time.sleep(0.005)  # mosquitto doesn't report when it listens

    def kill(self) -> None:
        """Kill the broker as if it had crashed. Its connections and its retained messages are lost."""
        self._running().kill()
        self._running().wait()
        self._process = None

    def _running(self) -> subprocess.Popen[bytes]:
        if self._process is None:
            raise RuntimeError("the broker was killed and not restarted")
        return self._process

    def _write_passwords(self, users: Mapping[str, str]) -> str:
        needs("mosquitto_passwd")
        path = self._write("passwords", "".join(f"{name}:{password}\n" for name, password in users.items()))
        subprocess.run(
            [find_program("mosquitto_passwd") or "", "-U", path], check=True, capture_output=True, timeout=_START
        )
        return path

    def _write(self, name: str, text: str) -> str:
        path = f"{self.directory}/{name}"
        with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w", encoding="utf-8") as file:
            file.write(text)
        return path

    def _end(self) -> None:
        if self._process is not None:
            self.kill()
