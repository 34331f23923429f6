"""The systemd units that commands print, and what fills them in: how this `talk` was started, and with which options.

A unit works as it stands, so whatever it says is shown by a test that starts a process with it. The system's units keep
a process away from everything but what its work takes. Nothing is installed here.

Each service is made of the parts that all have and of what is its command's own. Another command's units go beside the
server's, with a function that calls `print_unit`.
"""

from __future__ import annotations

import os
import re
import shutil
import stat
import sys
from typing import TYPE_CHECKING

from talkcli import paths
from talkcli.cli.command import MODE, spelt
from talkcli.cli.commands import COMMANDS
from talkcli.cli.show import note, show
from talkcli.errors import UsageError
from talkcli.terminal.text import printable

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from typing import Any

    from talkcli.cli.command import Command
    from talkcli.cli.show import Common
    from talkcli.goals.option import Option

#: Who may talk to the system's server: this group's members, who may use the sound card already.
GROUP = "audio"

# -- what every service has

_START = """\
# A robot has nobody who looks after it: what can't start now is tried again for as long as it takes.
StartLimitIntervalSec=0

[Service]
Type=notify
NotifyAccess=main
ExecStart={command}
"""
_SUPERVISION = """\
WatchdogSec=30
Restart=on-failure
# Wrong options don't get better.
RestartPreventExitStatus=2
TimeoutStartSec=30
TimeoutStopSec=10
"""

_USER_SANDBOX = """\
NoNewPrivileges=yes
LockPersonality=yes
RestrictRealtime=yes
RestrictSUIDSGID=yes
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6
SystemCallArchitectures=native
SystemCallFilter=@system-service
SystemCallErrorNumber=EPERM
"""
_USER_INSTALL = """
[Install]
WantedBy=default.target
"""

#: What of the machine's files a system's service finds; which devices and networks it adds itself.
_SYSTEM_FILES = """\
ProtectSystem=strict
ProtectHome={home}
PrivateTmp=yes
DevicePolicy=closed
"""
_SYSTEM_SANDBOX = """\
CapabilityBoundingSet=
AmbientCapabilities=
NoNewPrivileges=yes
ProtectClock=yes
ProtectControlGroups=yes
ProtectHostname=yes
ProtectKernelLogs=yes
ProtectKernelModules=yes
ProtectKernelTunables=yes
LockPersonality=yes
RestrictNamespaces=yes
RestrictRealtime=yes
RestrictSUIDSGID=yes
SystemCallArchitectures=native
SystemCallFilter=@system-service
SystemCallFilter=~@privileged @resources
SystemCallErrorNumber=EPERM
"""
_SYSTEM_INSTALL = """
[Install]
WantedBy=multi-user.target
"""

# -- the server's

_SERVER = (
    _START
    + "# It gives signs of life as long as it answers its clients, whatever became of the loudspeaker.\n"
    + _SUPERVISION
    + """\
RestartSec=2
# The server ends its goals, and then its engine; what is left after that is killed.
KillMode=mixed
"""
)

_USER_HEAD = """\
# ~/.config/systemd/user/talk.service: the voice of one user, through that user's PipeWire, PulseAudio or ALSA.
#   mkdir -p ~/.config/systemd/user
#   talk serve --print-unit user > ~/.config/systemd/user/talk.service
#   systemctl --user daemon-reload && systemctl --user enable --now talk
#   loginctl enable-linger        so that it runs from the start of the machine, without a login
#   journalctl --user -u talk     is its log

[Unit]
Description=talk, speech for robots
After=pipewire.service pipewire-pulse.service pulseaudio.service
"""
_USER_SOUND = """
# What works without privileges everywhere. Sound servers are reached through their sockets, or over the network.
"""

_SYSTEM_HEAD = """\
# /etc/systemd/system/talk.service: the voice of the machine, through ALSA; its socket is {socket}.
#   talk serve --print-unit system | sudo tee /etc/systemd/system/talk.service
#   sudo systemctl daemon-reload && sudo systemctl enable --now talk
#   sudo usermod -aG {group} NAME    lets NAME talk, from the next login on
#   journalctl -u talk             is its log
# Where PipeWire or PulseAudio runs in a user's session, the sound devices are theirs: take the user's unit.

[Unit]
Description=talk, speech for robots
After=sound.target
"""
_SYSTEM_USER = """
# It runs as a user of its own that exists as long as it runs. The group opens the sound devices, and is the socket's.
User=talk
DynamicUser=yes
Group={group}
# Without this line where there is a talk.socket: the directory would go with the service, and the socket with it.
RuntimeDirectory=talk
# What is kept of neural voices, so that they are loaded faster.
CacheDirectory=talk
CacheDirectoryMode=0700
UMask=0077

# It needs its program, the sound devices and Unix sockets, and nothing else of the machine.
"""
_SYSTEM_SOUND = """\
DeviceAllow=char-alsa rw
PrivateNetwork=yes
IPAddressDeny=any
RestrictAddressFamilies=AF_UNIX
"""
_SYSTEM_LEFT_OUT = """\
# Left out on purpose: PrivateUsers= and ProtectProc= would hide who sent a goal, PrivateDevices= the sound card,
# PrivateIPC= the programs that ALSA mixes with; and with MemoryDenyWriteExecute= an older libffi stops the engine.
"""

_SOCKET = """\

[Unit]
Description=The socket of talk, speech for robots

[Socket]
ListenStream={socket}
SocketMode={mode}
"""
_SOCKET_END = """\
RemoveOnStop=yes

[Install]
WantedBy=sockets.target
"""
_USER_SOCKET_HEAD = """\
# ~/.config/systemd/user/talk.socket: clients can connect before talk.service runs, and while it starts again.
# It comes beside that service ('--print-unit user'), which is started by the first client.
#   talk serve --print-unit user-socket > ~/.config/systemd/user/talk.socket
#   systemctl --user daemon-reload && systemctl --user stop talk && systemctl --user enable --now talk.socket
"""
_SYSTEM_SOCKET_HEAD = """\
# /etc/systemd/system/talk.socket: clients can connect before talk.service runs, and while it starts again.
# It comes beside that service ('--print-unit system'), which is started by the first client and must leave the
# socket's directory alone.
#   talk serve --print-unit system-socket | sudo tee /etc/systemd/system/talk.socket
#   sudo sed -i /^RuntimeDirectory=/d /etc/systemd/system/talk.service
#   sudo systemctl daemon-reload && sudo systemctl stop talk && sudo systemctl enable --now talk.socket
"""

#: Each unit of the server's.
_SERVER_UNITS = {
    "user": _USER_HEAD + _SERVER + _USER_SOUND + _USER_SANDBOX + _USER_INSTALL,
    "system": _SYSTEM_HEAD
    + _SERVER
    + _SYSTEM_USER
    + _SYSTEM_FILES
    + _SYSTEM_SOUND
    + _SYSTEM_SANDBOX
    + _SYSTEM_LEFT_OUT
    + _SYSTEM_INSTALL,
    "user-socket": _USER_SOCKET_HEAD + _SOCKET + "DirectoryMode=0700\n" + _SOCKET_END,
    "system-socket": _SYSTEM_SOCKET_HEAD + _SOCKET + "SocketGroup={group}\nDirectoryMode=0755\n" + _SOCKET_END,
}

# -- the bridge's

_BRIDGE = (
    _START
    + """\
EnvironmentFile={environment}
# It gives signs of life as long as it works, whether the broker and the server are there or not.
"""
    + _SUPERVISION
    + """\
# Where another robot has its name it ends, and comes back once that one is gone; it is no nuisance until then.
RestartSec=10
"""
)

_USER_BRIDGE_HEAD = """\
# ~/.config/systemd/user/talk-bridge.service: one user's talk, on an MQTT broker.
#   mkdir -p ~/.config/systemd/user ~/.config/talk
#   talk bridge --name NAME --print-unit user > ~/.config/systemd/user/talk-bridge.service
#   echo TALK_BROKER=mqtts://HOST > ~/.config/talk/bridge.env    and TALK_MQTT_USER=NAME, TALK_MQTT_PASSWORD_FILE=FILE
#   systemctl --user daemon-reload && systemctl --user enable --now talk-bridge
#   loginctl enable-linger               so that it runs from the start of the machine, without a login
#   journalctl --user -u talk-bridge     is its log

[Unit]
Description=talk, a robot on an MQTT broker
After=talk.service
"""
_USER_BRIDGE_END = """
# What works without privileges everywhere.
"""

_SYSTEM_BRIDGE_HEAD = """\
# /etc/systemd/system/talk-bridge.service: the machine's talk, at {socket}, on an MQTT broker.
#   talk bridge --name NAME --print-unit system | sudo tee /etc/systemd/system/talk-bridge.service
#   sudo useradd --system talk-bridge    whoever else may read a password or a key, this user has to
#   sudo mkdir -p /etc/talk
#   echo TALK_BROKER=mqtts://HOST | sudo tee /etc/talk/bridge.env    and TALK_MQTT_USER, TALK_MQTT_PASSWORD_FILE, …
#   sudo systemctl daemon-reload && sudo systemctl enable --now talk-bridge
#   journalctl -u talk-bridge            is its log

[Unit]
Description=talk, a robot on an MQTT broker
Wants=network-online.target
After=network-online.target talk.service
"""
_SYSTEM_BRIDGE_USER = """
# The group may use the server's socket.
User=talk-bridge
Group={group}
UMask=0077

# It needs its program, what its environment names, the server's socket and the network, and nothing else.
"""
_SYSTEM_BRIDGE_NETWORK = """\
PrivateDevices=yes
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6
"""

#: Each unit of the bridge's, and where it finds which broker it is and who logs in there.
_BRIDGE_UNITS = {
    "user": _USER_BRIDGE_HEAD + _BRIDGE + _USER_BRIDGE_END + _USER_SANDBOX + _USER_INSTALL,
    "system": _SYSTEM_BRIDGE_HEAD
    + _BRIDGE
    + _SYSTEM_BRIDGE_USER
    + _SYSTEM_FILES
    + _SYSTEM_BRIDGE_NETWORK
    + _SYSTEM_SANDBOX
    + _SYSTEM_INSTALL,
}
_BRIDGE_ENVIRONMENTS = {"user": "%h/.config/talk/bridge.env", "system": "/etc/talk/bridge.env"}

#: What would end a line of a unit, or is no UTF-8.
_CONTROLS = "[\0-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]"
#: What ProtectHome= hides.
_HOMES = ("/home/", "/root/", "/run/user/")


def print_server(options: Common, name: str, given: Mapping[str, Any]) -> None:
    """Print the server's unit of this name; `given`: the options of `serve`."""
    mode, words = given["socket_mode"], []
    if name.startswith("system") and "socket_mode" not in options.typed:
        mode = 0o660
        words.append("--socket-mode=0660")
    print_unit(options, COMMANDS["serve"], given, _SERVER_UNITS, name, words, mode=f"{mode:04o}")


def print_bridge(options: Common, name: str, given: Mapping[str, Any]) -> None:
    """Print the bridge's unit of this name; `given`: the options of `bridge`."""
    words, environment = ["--insecure"] if options.insecure else [], _BRIDGE_ENVIRONMENTS[name]
    print_unit(options, COMMANDS["bridge"], given, _BRIDGE_UNITS, name, words, environment=environment)


def print_unit(
    options: Common,
    row: Command,
    given: Mapping[str, Any],
    templates: Mapping[str, str],
    name: str,
    words: Sequence[str] = (),
    **more: str,
) -> None:
    """Print a command's unit of this name; it begins with "system" where it is the machine's, else it is one user's.

    `given`: the command's own options; those that were typed are written into the unit, behind `words`. What stands in
    braces in a template is filled in: the command, the group, whether homes are seen, the socket, and `more`. Where the
    system's own user can't run it, that is told.
    """
    typed = [_written(each, given[each.name]) for each in row.options if each.name in options.typed & given.keys()]
    socket = os.path.abspath(options.socket) if options.socket else None
    named = [f"--socket={socket}"] if socket else []
    usual = paths.SYSTEM_SOCKET if name.startswith("system") else f"%t/talk/{paths.SOCKET}"
    shown = _place if name.endswith("-socket") else printable
    program = _program(sys.argv[0])
    # What the program is made of: its script, its interpreter, its package.
    files = (program[0], *map(os.path.realpath, (program[0], sys.executable, __file__)))
    unit = templates[name].format(
        command=" ".join(map(_quoted, (*program, row.name, *words, *named, *typed))),
        group=GROUP,
        home="read-only" if any(each.startswith(_HOMES) for each in files) else "yes",
        socket=shown(socket) if socket else usual,
        **more,
    )
    show(unit.rstrip("\n"))
    hidden = _hidden_from_others(files) if name == "system" else None
    if hidden:
        file, directory = hidden
        note(
            f"this talk needs {printable(file)}, and the service's own user can't pass {printable(directory)}: install "
            "it for all, as with 'sudo /usr/bin/python3 -m venv /opt/talk && sudo /opt/talk/bin/pip install .' in a "
            "checkout, then print the unit"
        )


def _program(started_as: str) -> tuple[str, ...]:
    """Return the command of the `talk` that runs now: the installed script, else its module."""
    beside = os.path.join(os.path.dirname(sys.executable), "talk")
    found = shutil.which(started_as if os.path.basename(started_as) == "talk" else beside)
    return (os.path.abspath(found),) if found else (sys.executable, "-m", "talkcli")


def _written(option: Option, value: object) -> str:
    """Return an option as it is written on a command line."""
    if value is True:
        return spelt(option)
    return f"{spelt(option)}={value:04o}" if option.kind is MODE else f"{spelt(option)}={value}"


def _hidden_from_others(files: Sequence[str]) -> tuple[str, str] | None:
    """Return the first of these files that other users can't get to, and the directory that they can't pass."""
    for path in files:
        steps = path.split(os.sep)
        for count in range(2, len(steps)):
            directory = os.sep.join(steps[:count])
            if not os.stat(directory).st_mode & stat.S_IXOTH:
                return path, directory
    return None


def _quoted(word: str) -> str:
    """Return a word of a command line as systemd reads it."""
    word = _escaped(word).replace("$", "$$")
    plain = all(each.isalnum() or each in "/._-+=:,@%{}" for each in word)
    if word and plain:
        return word
    escaped = word.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{re.sub(_CONTROLS, _as_bytes, escaped)}"'


def _as_bytes(found: re.Match[str]) -> str:
    return "".join(f"\\x{each:02x}" for each in os.fsencode(found[0]))


def _place(path: str) -> str:
    """Return a path as the value of a setting, which has no quotes; UsageError where it would be read as another."""
    if re.search(_CONTROLS, path) or path.endswith(("\\", " ")):
        raise UsageError(f"a socket's unit can't name {printable(path)}: name a path without such signs")
    return _escaped(path)


def _escaped(word: str) -> str:
    """Return a word without systemd's specifiers."""
    return word.replace("%", "%%")
