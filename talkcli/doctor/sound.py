"""The sound checks: user session, sound cards, players, devices, sound servers and volume.

Facts come from the kernel's files and from programs such as pactl, which have a time limit. No device is opened,
because that would wake it. Only a spoken sentence proves that there is sound, so most faults are warnings. A missing or
silent player is a failure, and so is a muted output.
"""

from __future__ import annotations

import contextlib
import grp
import os
import pwd
import re
import shlex
import socket
import struct
import subprocess
import tempfile
from typing import TYPE_CHECKING

from talkcli import paths
from talkcli.doctor.report import FAILURE, WARNING, Finding, failure, join_names, ok, warning
from talkcli.engine import players
from talkcli.engine.players import DUMMY_SINK, PACKAGES, PLAYERS, is_silent, on_path
from talkcli.frozen import frozen, replace
from talkcli.peers import ancestors, command_name, read_proc_file
from talkcli.processes import kill, signal_name

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence
    from typing import Any

#: The kernel's description of its sound cards. Containers can hide this directory.
_KERNEL_SOUND = "/proc/asound"
#: The group that may use sound cards in Debian.
_AUDIO_GROUP = "audio"
#: Files that container runtimes create in every container.
_CONTAINER_FILES = ("/.dockerenv", "/run/.containerenv", "/run/systemd/container")
_CRON_PROGRAMS = frozenset({"cron", "crond", "cronie", "anacron"})
_SSH_PROGRAMS = frozenset({"ssh", "sshd"})
_CONTAINER, _CRON_JOB, _SYSTEM_SERVICE = "a container", "a cron job", "a system service"
#: The finding if the server runs on another machine.
SESSION_ELSEWHERE = ok(
    "session", "the server runs on another machine or in a container: to check its sound, run talk doctor there"
)
#: Tags and permission bits of access control lists, from <linux/posix_acl.h>.
_ACL_USER, _ACL_GROUP, _ACL_READ_WRITE = 2, 8, 6

#: Entries in ALSA's device list that are plugins or converters, not devices.
_NOT_DEVICES = frozenset(
    {"null", "lavrate", "samplerate", "speexrate", "jack", "oss", "speex", "upmix", "vdownmix", "usbstream"}
)
_SOUND_SERVER_CHECK, _LOUDNESS_CHECK = "sound server", "loudness"
#: Advice if the player needs a sound server and none is running.
START_SOUND_SERVER = "start PulseAudio or PipeWire, or use ALSA: talk serve --player aplay"
#: A sentence may be inaudible across a room if the volume is lower than this.
_FAINT_PERCENT = 20
#: The names of ALSA's mixer controls for loudspeakers.
_ALSA_CONTROLS = ("Master", "PCM", "Speaker", "Headphone", "Digital")
#: The human-readable name of a sound server's output.
_DEFAULT_SINK = "the default sink"
#: For each mixer program, the commands that unmute the default sink and raise its volume.
_PACTL_COMMANDS = ("pactl set-sink-mute @DEFAULT_SINK@ 0", "pactl set-sink-volume @DEFAULT_SINK@ 70%")
_WPCTL_COMMANDS = ("wpctl set-mute @DEFAULT_AUDIO_SINK@ 0", "wpctl set-volume @DEFAULT_AUDIO_SINK@ 0.7")
#: Time limit for a program. Programs answer within milliseconds, unless the sound server hangs.
PROGRAM_LIMIT_S = 3.0
#: Maximum size of a program's output. Even a long list of devices is only a tenth of this.
_MAX_OUTPUT_BYTES = 64 * 1024


@frozen
class UserSession:
    """The user and session of a process."""

    uid: int
    user: str
    #: the server's process id, or None if this describes the current process
    server_pid: int | None = None
    #: ids of the process's groups
    gids: tuple[int, ...] = ()
    #: id of the user who called sudo, or None if the process isn't root under sudo
    sudo_uid: int | None = None
    #: what started the process, such as "a system service" or "an ssh session"
    origins: tuple[str, ...] = ()
    #: XDG_RUNTIME_DIR, or None if it isn't set
    runtime_dir: str | None = None
    #: user id of that directory's owner, or None if the directory doesn't exist
    runtime_owner: int | None = None
    #: the directory that XDG_RUNTIME_DIR usually names, or None if it doesn't exist
    usual_runtime_dir: str | None = None


@frozen
class ProgramOutput:
    """The output of a program, and the error if the program failed."""

    #: why the program failed, or None if it succeeded
    error: str | None
    stdout: str = ""
    timed_out: bool = False


@frozen
class SoundServer:
    """Facts about the sound server (PulseAudio or PipeWire)."""

    #: name such as "PulseAudio (on PipeWire 0.3.65)", or None if no sound server answers
    name: str | None = None
    #: name of the default sink, or None if unknown
    default_sink: str | None = None
    #: whether PulseAudio clients can connect. The player `pulse` is such a client.
    accepts_pulse: bool = True
    #: the existing sockets of sound servers, if no server answers
    sockets: tuple[str, ...] = ()
    #: why the client program failed, or None if none is installed
    error: str | None = None
    #: whether the sound server accepts connections but doesn't answer
    hangs: bool = False
    #: value of PULSE_SERVER, or None if it isn't set
    pulse_server: str | None = None


def find_session(server_pid: int | None) -> tuple[UserSession, Mapping[str, str]]:
    """Return the session and environment of the `talk` server or, without a server, of this process.

    This process counts if there is no server or its environment can't be read.
    """
    environment = None if server_pid is None else _read_environment(server_pid)
    if environment is None:
        server_pid, environment = None, dict(os.environ)
    pid = os.getpid() if server_pid is None else server_pid
    uid = os.getuid()
    runtime = environment.get("XDG_RUNTIME_DIR") or None
    usual = f"/run/user/{uid}"
    session = UserSession(
        uid=uid,
        user=_name_or_id(pwd.getpwuid, uid),
        server_pid=server_pid,
        gids=_group_ids(pid),
        sudo_uid=paths.sudo_caller(environment),
        origins=tuple(_find_origins(environment, pid)),
        runtime_dir=runtime,
        runtime_owner=None if runtime is None else file_owner(runtime),
        usual_runtime_dir=usual if os.path.isdir(usual) else None,
    )
    return session, environment


def server_names_player(server_pid: int, env: Mapping[str, str]) -> bool:
    """Return whether the command line or environment of the `talk` server names a player.

    If it does, the server tries no other player.
    """
    return bool(env.get("TALK_PLAYER") or re.search(r"\0--player[=\0]", _read_proc_text(f"/proc/{server_pid}/cmdline")))


def file_owner(path: str) -> int | None:
    """Return the user id of a file's owner. Return None if the file doesn't exist.

    The owner of /proc/PID is the user who runs the process.
    """
    with contextlib.suppress(OSError):
        return os.stat(path).st_uid
    return None


def _read_environment(pid: int) -> dict[str, str] | None:
    """Return the environment of another process. Return None if another user runs the process."""
    data = read_proc_file(f"/proc/{pid}/environ", -1)
    if data is None or file_owner(f"/proc/{pid}") != os.getuid():
        return None  # root could read the environment, but can't use another user's sound server
    return dict(each.split("=", 1) for each in os.fsdecode(data).split("\0") if "=" in each)


def _name_or_id(look_up: Callable[[int], tuple[Any, ...]], number: int) -> str:
    """Return the name of a user or group, or the id if it has no name.

    `look_up` is `getpwuid` or `getgrgid`.
    """
    try:
        return str(look_up(number)[0])
    except KeyError:
        return str(number)


def _group_ids(pid: int) -> tuple[int, ...]:
    """Return the group ids of a process. If /proc can't be read, return this process's ids."""
    status = _read_proc_text(f"/proc/{pid}/status")
    found = re.search(r"^Gid:\s+\d+\s+(\d+).*?^Groups:([\d \t]*)$", status, re.MULTILINE | re.DOTALL)
    groups = map(int, " ".join(found.groups()).split()) if found else (os.getegid(), *os.getgroups())
    return tuple(sorted(set(groups)))


def _find_origins(environment: Mapping[str, str], pid: int) -> Iterable[str]:
    """Find out how a process was started. Yield descriptions, the most specific first."""
    if environment.get("container") or any(map(os.path.exists, _CONTAINER_FILES)):
        yield _CONTAINER
    unit = re.search(r"system\.slice/(?:[^\n]*/)?([^/\n]+)\.service", _read_proc_text(f"/proc/{pid}/cgroup"))
    service = unit[1] if unit else ""
    # The names are compared in lower case, because Debian's cron is also called CRON.
    programs = {service, *(str(command_name(each)).lower() for each in ancestors(pid))}
    if not _CRON_PROGRAMS.isdisjoint(programs):
        yield _CRON_JOB
    elif service and service not in _SSH_PROGRAMS and environment.get("INVOCATION_ID"):
        yield _SYSTEM_SERVICE
    if environment.get("SSH_CONNECTION"):
        yield "an ssh session"


def find_cards(directory: str = _KERNEL_SOUND) -> tuple[str, ...]:
    """Return the names of the sound cards that the kernel has found."""
    # The first of a card's two lines looks like " 0 [Device         ]: USB-Audio - USB Audio Device".
    names = re.findall(r"^\s*\d+ \[[^\]]*\]:.*? - (.*)$", _read_proc_text(f"{directory}/cards"), re.MULTILINE)
    return tuple(each.strip() for each in names)


def _may_open(stat: os.stat_result, acl: list[tuple[int, int, int]], session: UserSession) -> bool:
    """Return whether the user of the session may read and write a file.

    Args:
        stat: the file's mode and owner.
        acl: the file's access control list, as returned by `_read_acl`.
        session: the user.
    """
    own = {(_ACL_USER, session.uid), *((_ACL_GROUP, each) for each in session.gids)}
    of_mode = (_ACL_USER, stat.st_mode >> 6, stat.st_uid), (_ACL_GROUP, stat.st_mode >> 3, stat.st_gid)
    # logind adds an entry for the user. The permissions for others apply only if no entry matches the user.
    granted = [bits for tag, bits, holder in (*of_mode, *acl) if (tag, holder) in own] or [stat.st_mode]
    return session.uid == 0 or any(bits & _ACL_READ_WRITE == _ACL_READ_WRITE for bits in granted)


def _read_acl(path: str) -> list[tuple[int, int, int]]:
    """Return the entries of a file's access control list.

    Each entry has a tag, permission bits, and a user or group id.
    """
    with contextlib.suppress(OSError):
        data = os.getxattr(path, "system.posix_acl_access")
        return list(struct.iter_unpack("<HHI", data[4:]))  # the first four bytes are a version number
    return []


def _read_proc_text(path: str) -> str:
    """Return the text of a file in /proc. Return "" if it can't be read."""
    return (read_proc_file(path, -1) or b"").decode(errors="replace")


def run_program(program: str, *arguments: str, env: Mapping[str, str], limit: float | None = None) -> ProgramOutput:
    """Run a program in the C locale with a time limit. Return its output.

    The default limit is PROGRAM_LIMIT_S.
    """
    limit = PROGRAM_LIMIT_S if limit is None else limit
    # Use files instead of pipes, because a background process of the program would keep a pipe open.
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        try:
            process = subprocess.Popen(
                [program, *arguments],
                env={**env, "LC_ALL": "C"},
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=err,
                start_new_session=True,
            )
        except OSError as error:
            return ProgramOutput(str(error))
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(limit)
        code = process.returncode
        if code is None:
            kill([-process.pid])  # the group's id stays valid until the process is reaped
            with contextlib.suppress(subprocess.TimeoutExpired):  # the program hangs in a driver, so init will reap it
                process.wait(1)
        stdout, stderr = (os.pread(each.fileno(), _MAX_OUTPUT_BYTES, 0).decode(errors="replace") for each in (out, err))
    if code is None:
        return ProgramOutput(f"no answer within {limit:g} s", stdout, timed_out=True)
    if code < 0:
        return ProgramOutput(f"it was killed by {signal_name(-code)}", stdout)
    lines = filter(None, map(str.strip, (stderr or stdout).splitlines()))
    return ProgramOutput(next(lines, "it printed no message") if code else None, stdout)


def is_custom_command(player: str | None) -> bool:
    """Return whether a player is a custom command instead of a known player."""
    program = _program_of(player) if player and not is_silent(player) else None
    return program is not None and program.rpartition("/")[2] not in PLAYERS


def _program_of(command: str) -> str | None:
    """Return the program in a player's command line. Return None if the line can't be parsed."""
    try:
        return next(iter(shlex.split(command)), None)
    except ValueError:
        return None


def installed_players(env: Mapping[str, str]) -> list[str]:
    """Return the names of the installed player programs, best first."""
    return [each for each in PACKAGES if on_path(each, env)]


def _parse_alsa_devices(output: ProgramOutput) -> list[str]:
    """Return the devices listed by `aplay -L`, except plugins and converters."""
    return [each for each in output.stdout.splitlines() if each and not each[0].isspace() and each not in _NOT_DEVICES]


def _parse_pulse_sinks(output: ProgramOutput) -> dict[str, str]:
    """Return the state of each sink in pactl's list, by name.

    A line has the sink's number, name, module, format and state, separated by tabs.
    """
    lines = [] if output.error else [each.split("\t") for each in output.stdout.splitlines()]
    return {each[1]: each[-1].strip() for each in lines if len(each) > 2}


def _parse_pipewire_sinks(output: ProgramOutput) -> list[str]:
    """Return the names of the sinks listed by `pw-cli ls Node`."""
    nodes = re.split(r"^\s*id \d+,", output.stdout, flags=re.MULTILINE)
    found = [re.search(r'node\.name = "([^"]*)"', each) for each in nodes if '"Audio/Sink"' in each]
    return [each[1] for each in found if each]


_LIST_SINKS = "pactl list short sinks"
#: For each player: the command that lists its devices, the parser for the command's output, and the command's package.
DEVICE_LISTS: dict[str, tuple[str, Callable[[ProgramOutput], Iterable[str]], str]] = {
    "aplay": ("aplay -L", _parse_alsa_devices, PACKAGES["aplay"]),
    "pulse": (_LIST_SINKS, _parse_pulse_sinks, PACKAGES["pacat"]),
    "pacat": (_LIST_SINKS, _parse_pulse_sinks, PACKAGES["pacat"]),
    "pw-cat": ("pw-cli ls Node", _parse_pipewire_sinks, PACKAGES["pw-cat"]),
}


def with_pactl_hint(finding: Finding, env: Mapping[str, str]) -> Finding:
    """Return a finding. If its advice uses pactl and pactl isn't installed, add a hint."""
    if finding.next is None or "pactl " not in finding.next or on_path("pactl", env):
        return finding
    return replace(finding, next=f"{finding.next} (to install pactl: sudo apt-get install -y {PACKAGES['pacat']})")


def suspended_sinks(env: Mapping[str, str]) -> tuple[str, ...]:
    """Return the names of the sinks that the sound server has suspended."""
    sinks = _parse_pulse_sinks(run_program(*_LIST_SINKS.split(), env=env))
    return tuple(name for name, state in sinks.items() if state == "SUSPENDED")


def find_sound_server(env: Mapping[str, str], session: UserSession) -> SoundServer:
    """Run pactl or pw-cli to find the sound server of the session. Return facts about it."""
    pulse = run_program("pactl", "info", env=env)
    if pulse.error is None:
        fields = dict(re.findall(r"^\s*([\w ]+): (.*\S)", pulse.stdout, re.MULTILINE))
        return SoundServer(fields.get("Server Name", "PulseAudio"), fields.get("Default Sink"))
    pipewire = pulse if pulse.timed_out else run_program("pw-cli", "info", "0", env=env)
    # If pactl isn't installed, connecting to the socket is the only way to test whether PulseAudio clients can connect.
    native = None if on_path("pactl", env) else _find_pulse_address(env)
    if pipewire.error is None:
        name = "PipeWire" if native else "PipeWire without PulseAudio support"
        return SoundServer(name, accepts_pulse=native is not None)
    if native and native.startswith("/"):
        return SoundServer(f"a sound server listens on {native}")
    outputs = ("pactl", pulse), ("pw-cli", pipewire)
    error = next((output.error for program, output in outputs if on_path(program, env)), None)
    uids = [each for each in (session.uid, session.sudo_uid) if each is not None]
    sockets, named = tuple(players.sound_server_sockets(env, *uids)), env.get("PULSE_SERVER") or None
    return SoundServer(sockets=sockets, error=error, hangs=pipewire.timed_out, pulse_server=named)


def _find_pulse_address(env: Mapping[str, str]) -> str | None:
    """Return the address of a server that accepts PulseAudio clients, if there is one.

    An address on another machine isn't tested. The sentence will show whether it works.
    """
    named = env.get("PULSE_SERVER", "").removeprefix("unix:")
    if named and not named.startswith("/"):
        return named
    for path in [named] if named else [each for each in players.sound_server_sockets(env) if each.endswith("/native")]:
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX) as probe:
            probe.settimeout(PROGRAM_LIMIT_S)
            probe.connect(path)
            return path
    return None


def check_levels(env: Mapping[str, str], server: SoundServer, cards: Sequence[str], *, in_use: bool) -> list[Finding]:
    """Check the volume of the sound server's output, or of the sound cards. Return the findings.

    The sound cards are only checked if there is no sound server.

    Args:
        env: the environment of the player.
        server: the sound server.
        cards: the names of the sound cards.
        in_use: whether speech is known to go to these outputs.
    """
    levels = [judge_level(*each, in_use=in_use) for each in _read_levels(env, server, cards)]
    bad = [each for state in (FAILURE, WARNING) for each in levels if each.state == state]
    if bad or not levels:
        return bad[:1]
    return [ok(_LOUDNESS_CHECK, ", ".join(each.message for each in levels))]


def _read_levels(env: Mapping[str, str], sound_server: SoundServer, cards: Sequence[str]) -> Iterable[tuple[str, ...]]:
    """Read the volume of each output. Yield the arguments for `judge_level`."""
    if sound_server.name is not None:
        mute = run_program("pactl", "get-sink-mute", "@DEFAULT_SINK@", env=env)
        if mute.error is None:
            volume = run_program("pactl", "get-sink-volume", "@DEFAULT_SINK@", env=env)
            yield _DEFAULT_SINK, mute.stdout + volume.stdout, *_PACTL_COMMANDS
            return
        both = run_program("wpctl", "get-volume", "@DEFAULT_AUDIO_SINK@", env=env)
        if both.error is None:
            yield _DEFAULT_SINK, both.stdout, *_WPCTL_COMMANDS
    elif cards and not sound_server.hangs:
        found = re.findall(r"control '([^']*)'", run_program("amixer", "scontrols", env=env).stdout)
        for each in filter(found.__contains__, _ALSA_CONTROLS):
            output = run_program("amixer", "sget", each, env=env)
            if output.error is None:
                yield each, output.stdout, f"amixer sset {each} unmute", f"amixer sset {each} 70%"


def judge_level(name: str, mixer_output: str, unmute_command: str, louder_command: str, *, in_use: bool) -> Finding:
    """Check the volume of one output. Return the finding.

    If its channels differ, the loudest one counts.

    Args:
        name: the name of the sink or the mixer control.
        mixer_output: the output of a mixer program: "Mute: no" and "40%" by pactl, "Volume: 0.40 [MUTED]" by wpctl, or
            "[40%] [on]" for each channel by amixer.
        unmute_command: the command that unmutes the output.
        louder_command: the command that makes the output louder.
        in_use: whether speech is known to go to this output.
    """
    broken = failure if in_use else warning
    switches = re.findall(r"\[(on|off)\]", mixer_output)
    if "Mute: yes" in mixer_output or "[MUTED]" in mixer_output or (switches and "on" not in switches):
        return broken(_LOUDNESS_CHECK, f"{name} is muted", unmute_command)
    percents = [int(each) for each in re.findall(r"(\d+)%", mixer_output)]
    percents += [round(float(each) * 100) for each in re.findall(r"Volume: (\d+(?:\.\d+)?)", mixer_output)]
    if not percents:
        return ok(_LOUDNESS_CHECK, f"{name} is not muted")
    percent = max(percents)
    if percent == 0:
        return broken(_LOUDNESS_CHECK, f"{name} is at 0%", louder_command)
    if percent < _FAINT_PERCENT:
        return warning(_LOUDNESS_CHECK, f"{name} is at {percent}%, which may be too quiet", louder_command)
    return ok(_LOUDNESS_CHECK, f"{name} is at {percent}%")


def judge_session(session: UserSession) -> Finding:
    """Check the user and the directory in XDG_RUNTIME_DIR. Return the finding."""
    who = "" if session.server_pid is None else "the server runs as "
    who += f"user {session.user} (uid {session.uid})"
    who += "" if session.sudo_uid is None else f" through sudo by uid {session.sudo_uid}"
    who += f", in {' and '.join(session.origins)}" if session.origins else ""
    if session.runtime_dir is None:
        if session.usual_runtime_dir is None:
            # Robots without logind normally have no such directory, because logind would create it.
            return ok("session", f"{who}; XDG_RUNTIME_DIR is not set, because this user has no login session")
        again = "" if session.server_pid is None else " for the server, and restart it"
        return warning(
            "session",
            f"{who}; XDG_RUNTIME_DIR is not set, so players can't find this user's PipeWire or PulseAudio "
            "(usual under cron, sudo and su, and in system services)",
            f"export XDG_RUNTIME_DIR={session.usual_runtime_dir}{again}",
        )
    words = f"{who}; XDG_RUNTIME_DIR is {session.runtime_dir}"
    if session.runtime_owner is None:
        step = "log in as this user (without su or sudo), or unset XDG_RUNTIME_DIR"
        return warning("session", f"{words}, which does not exist", step)
    if session.runtime_owner != session.uid:
        step = f"run talk doctor as the directory's owner: sudo -u '#{session.runtime_owner}' talk doctor"
        words = f"{words}, which belongs to uid {session.runtime_owner}, whose sound server accepts no other user"
        return warning("session", words, step)
    return ok("session", words)


def judge_silent_player(player: str | None, *, set_by_server: bool) -> Finding:
    """Create the finding for a configured player that makes no sound."""
    step = "restart the server without --player" if set_by_server else "unset TALK_PLAYER"
    return failure("player", f"{player} ({_describe_player_setting(set_by_server)}) makes no sound", step)


def _describe_player_setting(set_by_server: bool) -> str:
    """Describe where the player was configured."""
    return "set by the server" if set_by_server else "set by TALK_PLAYER"


def check_player(env: Mapping[str, str], configured: str | None, used: str | None, *, used_by_server: bool) -> Finding:
    """Check whether the player is installed. Return the finding.

    Args:
        env: the environment of the player.
        configured: the player set by the server or by TALK_PLAYER, or None for the automatic choice.
        used: the player that is tried first, or None if no player is installed.
        used_by_server: whether the server uses the player. Otherwise, the doctor's own engine does.
    """
    others = [each for each in installed_players(env) if each != used]
    broken = warning if used_by_server else failure
    if used is None:
        package = next(iter(PACKAGES.values()))
        return broken(
            "player", f"no player is on the PATH ({', '.join(PACKAGES)})", f"sudo apt-get install -y {package}"
        )
    if configured is None:
        how = " to play through the sound server" if used == "pulse" else ""
        return ok("player", f"{used} is used{how}" + (f"; other players: {', '.join(others)}" if others else ""))
    words = f"{configured} ({_describe_player_setting(used_by_server)})"
    program = _program_of(configured)
    if program is None or not (program == "pulse" or on_path(program, env)):
        known = PACKAGES.get(configured)
        step = f"sudo apt-get install -y {known}" if known else "name an installed program with --player"
        return broken("player", f"{words} is not installed", step)
    also = f"; other players: {', '.join(others)}" if others else ""
    return ok("player", words + also)


def check_device(env: Mapping[str, str], player: str, configured: str | None) -> Finding:
    """Check whether the player has the configured device. Return the finding.

    Args:
        env: the environment of the player.
        player: a player in DEVICE_LISTS.
        configured: the configured device, or None for the player's default device.
    """
    command, parse, package = DEVICE_LISTS[player]
    program, *arguments = command.split()
    used = configured or "the default device"
    if not on_path(program, env):
        words = f"{used}; devices can't be listed, because {program} is not installed"
        step = f"sudo apt-get install -y {package}"
        return ok("device", words) if configured is None else warning("device", words, step)
    output = run_program(program, *arguments, env=env)
    names = list(parse(output))
    if output.error is not None and parse is _parse_pulse_sinks:
        return ok("device", f"{used}; {command}: {output.error}")  # the check of the sound server gives advice
    if output.error is not None:
        return warning("device", f"{command}: {output.error}", f"run this command to see the whole error: {command}")
    if not names:
        step = "connect a loudspeaker; in a container, pass the device to it"
        return warning("device", f"{command} lists no devices", step)
    # A device such as plughw:1,0 may work even if ALSA doesn't list it. The test sentence will show whether it works.
    if configured is None or configured in names or ":" in configured:
        return ok("device", f"{used}; {command} lists {join_names(names)}")
    words = f"{configured} is not a device that {command} lists: {join_names(names)}"
    return warning("device", words, f"restart the server with --device and a name from this list: {command}")


def check_cards(cards: Sequence[str], sound_server: SoundServer, session: UserSession) -> Finding:
    """Check whether the kernel has found any sound cards. Return the finding."""
    if cards:
        return ok("cards", join_names(cards))
    if sound_server.name is not None and sound_server.default_sink != DUMMY_SINK:
        return ok("cards", "this machine has no sound card, but the sound server has an output")
    if _CONTAINER in session.origins:
        step = "start the container with --device /dev/snd, or with the sound server's socket (see the README)"
        return warning("cards", "this container has no sound card", step)
    has_sound = os.path.isdir(_KERNEL_SOUND)
    words = "the kernel found no sound card" if has_sound else f"the kernel has no sound support (no {_KERNEL_SOUND})"
    return warning("cards", words, "connect a loudspeaker or a sound card, and check with: aplay -l")


def check_access(sound_server: SoundServer, session: UserSession, directory: str = "/dev/snd") -> Finding:
    """Check whether the user may open the sound cards. Return the finding."""
    nodes, group, forbidden = players.playback_devices(directory), _AUDIO_GROUP, []
    for each in nodes:
        with contextlib.suppress(OSError):
            found = os.stat(each)
            group = _name_or_id(grp.getgrgid, found.st_gid) if found.st_gid else group
            if not _may_open(found, _read_acl(each), session):
                forbidden.append(each)
    if not nodes:
        return ok("group", f"{directory} has no playback devices, so the group {group} is not needed")
    if not forbidden:
        is_member = group in [_name_or_id(grp.getgrgid, each) for each in session.gids]
        member = f"in the group {group}" if is_member else f"not in the group {group}, which is not needed"
        return ok("group", f"user {session.user} may open the cards ({member})")
    words = f"user {session.user} may not open {join_names(forbidden)}, and is not in the group {group}"
    if sound_server.name is not None:
        return ok("group", f"{words}; the sound server opens the cards")
    with contextlib.suppress(KeyError):
        if session.user in grp.getgrnam(group).gr_mem:
            step = "log out and in again" if session.server_pid is None else "restart the server from a new login"
            return warning("group", f"{words} yet, but will be after the next login", step)
    return warning("group", words, f"sudo usermod -aG {group} {session.user}, and log in again")


def judge_sound_server(
    server: SoundServer, cards: Sequence[str], session: UserSession, player: str | None = None
) -> Finding:
    """Check whether a sound server can be used. Return the finding.

    Without one, it is a warning if `player` needs a sound server.
    """
    check = _SOUND_SERVER_CHECK
    where = "from here" if session.server_pid is None else f"from the server (process {session.server_pid})"
    if server.name is not None and server.default_sink == DUMMY_SINK:
        step = "connect a loudspeaker, and check that it is listed: pactl list short sinks"
        return warning(check, f"{server.name} has only the dummy output {DUMMY_SINK}, which nobody can hear", step)
    if server.name is not None:
        return ok(check, server.name + (f", plays to {server.default_sink}" if server.default_sink else ""))
    if server.hangs:
        step = "restart the sound server: systemctl --user restart pipewire pipewire-pulse (or: pulseaudio -k)"
        return warning(check, f"a sound server is running, but does not answer {where}", step)
    if not server.sockets and server.pulse_server is None:
        if session.origins and not cards:
            return _judge_unreachable(server, session, f"no sound server can be reached {where}")
        words = f"no PulseAudio or PipeWire is running for user {session.user}"
        if player in DEVICE_LISTS and player != "aplay":
            return warning(check, f"{words}, but the player {player} needs one", START_SOUND_SERVER)
        return ok(check, words + ("; players use ALSA" if cards else ""))
    at = f"{server.pulse_server} (PULSE_SERVER)" if server.pulse_server else join_names(server.sockets)
    if server.error is None:
        step = "sudo apt-get install -y pulseaudio-utils"
        return warning(check, f"found a sound server at {at}, but no program to check it (pactl or pw-cli)", step)
    return _judge_unreachable(server, session, f"the sound server at {at} cannot be reached {where}: {server.error}")


def _judge_unreachable(server: SoundServer, session: UserSession, message: str) -> Finding:
    """Return a warning that the sound server can't be reached, with advice."""
    hint, step = "", "systemctl --user restart pipewire pipewire-pulse (or: pulseaudio --start)"
    if server.pulse_server is not None:
        step = "unset PULSE_SERVER, or start the sound server that it names"
    elif _CONTAINER in session.origins:
        hint = "; a container can't use the host's sound server by default"
        step = "start the container with the host's socket and PULSE_SERVER (see the README)"
    elif _SYSTEM_SERVICE in session.origins:
        hint = "; a system service doesn't belong to a user's session"
        step = "run the server as a service of your user: talk serve --print-unit user"
    elif session.sudo_uid is not None:
        hint = "; a sound server accepts only its own user, not root"
        step = "run talk doctor without sudo, as the user of the sound server"
    elif session.runtime_dir is None and session.usual_runtime_dir is not None:
        step = f"export XDG_RUNTIME_DIR={session.usual_runtime_dir}"
    return warning(_SOUND_SERVER_CHECK, message + hint, step)
