"""`talk serve`: it runs the server, or prints a systemd unit that does. No other module imports the server.

A unit works as it stands, so whatever it says is shown by a test that starts a server with it. The system's unit keeps
the server away from everything but sockets, the sound devices and what it needs to say who sent a goal. Nothing is
installed here.
"""

from __future__ import annotations

import os
import re
import shutil
import stat
import sys
from typing import TYPE_CHECKING

from talkcli import paths
from talkcli.cli.command import MODE, nearest, spelt
from talkcli.cli.commands import COMMANDS
from talkcli.cli.show import note, show
from talkcli.errors import UsageError
from talkcli.terminal.text import printable

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from typing import Any

    from talkcli.cli.show import Common
    from talkcli.goals.option import Option

#: What is said at the start where nothing could sound.
NO_DEVICE = (
    "no sound device is here, and no PulseAudio or PipeWire: plug in a loudspeaker, or hand it to the container ('talk "
    "doctor' says more); it is looked for with each sentence, which ends ABORTED until it is there; to speak without "
    "one: '--player file:PATH.wav', '--player null'"
)
#: Who may talk to the system's server: this group's members, who may use the sound card already.
GROUP = "audio"

_SERVICE = """\
# A robot has nobody who looks after it: what can't start now is tried again for as long as it takes.
StartLimitIntervalSec=0

[Service]
Type=notify
NotifyAccess=main
ExecStart={command}
# It gives signs of life as long as it answers its clients, whatever became of the loudspeaker.
WatchdogSec=30
Restart=on-failure
RestartSec=2
# Wrong options don't get better.
RestartPreventExitStatus=2
TimeoutStartSec=30
TimeoutStopSec=10
# The server ends its goals, and then its engine; what is left after that is killed.
KillMode=mixed
"""

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
_USER_END = """
# What works without privileges everywhere. Sound servers are reached through their sockets, or over the network.
NoNewPrivileges=yes
LockPersonality=yes
RestrictRealtime=yes
RestrictSUIDSGID=yes
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6
SystemCallArchitectures=native
SystemCallFilter=@system-service
SystemCallErrorNumber=EPERM

[Install]
WantedBy=default.target
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
_SYSTEM_END = """
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
ProtectSystem=strict
ProtectHome={home}
PrivateTmp=yes
DevicePolicy=closed
DeviceAllow=char-alsa rw
PrivateNetwork=yes
IPAddressDeny=any
RestrictAddressFamilies=AF_UNIX
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
# Left out on purpose: PrivateUsers= and ProtectProc= would hide who sent a goal, PrivateDevices= the sound card,
# PrivateIPC= the programs that ALSA mixes with; and with MemoryDenyWriteExecute= an older libffi stops the engine.

[Install]
WantedBy=multi-user.target
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

#: Each unit; what stands in braces is filled in when it is printed.
_UNITS = {
    "user": _USER_HEAD + _SERVICE + _USER_END,
    "system": _SYSTEM_HEAD + _SERVICE + _SYSTEM_END,
    "user-socket": _USER_SOCKET_HEAD + _SOCKET + "DirectoryMode=0700\n" + _SOCKET_END,
    "system-socket": _SYSTEM_SOCKET_HEAD + _SOCKET + "SocketGroup={group}\nDirectoryMode=0755\n" + _SOCKET_END,
}

#: What would end a line of a unit, or is no UTF-8.
_CONTROLS = "[\0-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]"
#: What ProtectHome= hides.
_HOMES = ("/home/", "/root/", "/run/user/")


def serve(options: Common, print_unit: str | None, **given: Any) -> int:
    """Run the server, or print a unit that would; return the exit code. `given`: the other options, by their names."""
    if print_unit:
        _print_unit(options, print_unit, given)
        return 0
    if not options.quiet:
        _warn_of_sound(given["player"] or "", given["driver"])
    from talkcli.goals.options import SETTINGS, Set
    from talkcli.server import run

    goals = Set(**{each.name: given.pop(each.name) for each in SETTINGS})
    return run.serve(run.Settings(socket=paths.named_socket(options.socket), goals=goals, **given))


def _warn_of_sound(player: str, driver: str | None) -> None:
    """Tell what would be in the way of every sentence: no device, or a player that there isn't.

    With a device and no player named it only looks at the names of files, so that the start is not kept waiting.
    """
    from talkcli.engine.players import PACKAGES, is_silent
    from talkcli.engine.players.devices import nothing_sounds

    if is_silent(player):
        return
    silent = nothing_sounds(os.environ)
    if not player and not silent:
        return
    from talkcli.engine.synthesizers import is_own

    if not is_own(driver):
        return  # it plays by itself, and the server says so
    if silent and (not player or player in PACKAGES):
        note(NO_DEVICE)
    if player:
        _warn_of_player(player)


def _warn_of_player(player: str) -> None:
    """Tell of a player that there isn't: a word that was mistyped, or a program that is not installed yet."""
    from talkcli.engine.players import PACKAGES, PLAYERS, commands
    from talkcli.engine.players.base import CannotSpeak

    if player in PLAYERS and player not in PACKAGES:
        return  # it is no program
    try:
        commands(player, None, 0)
    except CannotSpeak as error:
        near = nearest(player, PLAYERS.keys() - {player})
        hint = f"did you mean '{near}'? " if near else ""
        note(f"{printable(str(error))}: {hint}nothing can be heard until it is there")


def _print_unit(options: Common, name: str, given: Mapping[str, Any]) -> None:
    """Print the unit of this name; `given`: the options of `serve`. Tell where the system's own user can't run it."""
    system = name.startswith("system")
    typed = [each for each in COMMANDS["serve"].options if each.name in options.typed and each.name in given]
    words = [_written(each, given[each.name]) for each in typed]
    socket = os.path.abspath(options.socket) if options.socket else None
    if socket:
        words.insert(0, f"--socket={socket}")
    mode = given["socket_mode"]
    if system and "socket_mode" not in options.typed:
        mode = 0o660
        words.insert(0, "--socket-mode=0660")
    program = _program(sys.argv[0])
    # What the program is made of: its script, its interpreter, its package.
    files = (program[0], *map(os.path.realpath, (program[0], sys.executable, __file__)))
    shown = _place if name.endswith("-socket") else printable
    usual = paths.SYSTEM_SOCKET if system else f"%t/talk/{paths.SOCKET}"
    unit = _UNITS[name].format(
        command=" ".join(map(_quoted, (*program, "serve", *words))),
        group=GROUP,
        home="read-only" if any(each.startswith(_HOMES) for each in files) else "yes",
        mode=f"{mode:04o}",
        socket=shown(socket) if socket else usual,
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
