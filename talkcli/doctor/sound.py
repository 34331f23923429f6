"""What makes a sound of samples: players, devices, sound servers, and how loud the output is.

Programs of others tell it, each with a limit of time and of output: one that is missing or hangs is an answer, too.
Asking wakes no device. Only a sentence proves that there is sound: what may be in its way is a warning here. Without a
player it is certain.
"""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import socket
import subprocess
import tempfile
from typing import TYPE_CHECKING

from talkcli.doctor.machine import judge_access, judge_cards
from talkcli.doctor.report import Finding, failed, ok, some, warning
from talkcli.engine.players import DUMMY_SINK, PACKAGES, PLAYERS, is_silent, on_path, sound_server_sockets
from talkcli.frozen import frozen, replace
from talkcli.processes import kill, signal_name

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from talkcli.doctor.machine import Cards, Session

#: What ALSA lists besides devices: converters, and ways that nobody takes by default.
_NO_DEVICES = frozenset(
    {"null", "lavrate", "samplerate", "speexrate", "jack", "oss", "speex", "upmix", "vdownmix", "usbstream"}
)
#: Names of checks.
_SERVER, _LOUDNESS = "sound server", "loudness"
#: Per cent below which nobody may hear it across a room.
_FAINT = 20
#: ALSA's controls that a loudspeaker hangs on, as `amixer scontrols` names them.
_CONTROLS = ("Master", "PCM", "Speaker", "Headphone", "Digital")
#: What a sound server's mixer tells of; and, by its program, what undoes a mute of it and what makes it louder.
_SINK = "the default sink"
_PACTL = ("pactl set-sink-mute @DEFAULT_SINK@ 0", "pactl set-sink-volume @DEFAULT_SINK@ 70%")
_WPCTL = ("wpctl set-mute @DEFAULT_AUDIO_SINK@ 0", "wpctl set-volume @DEFAULT_AUDIO_SINK@ 0.7")
#: Seconds that a program may take. All of them answer within milliseconds, or wait for a sound server that hangs.
LIMIT = 3.0
#: Bytes of its output that are read: the devices of a large machine take a tenth.
_MOST = 64 * 1024


@frozen
class Said:
    """What a program said."""

    #: why it failed: the first line that it wrote to standard error, for one; None where all went well
    trouble: str | None
    out: str = ""
    #: whether it took too long
    late: bool = False


@frozen
class Players:
    """Which programs can play."""

    #: those of the programs that `talk` knows that are there, best first
    found: tuple[str, ...]
    #: what is to play, by the server's setting or by TALK_PLAYER; None for the first that is there
    wanted: str | None
    #: whether a wanted program can be run
    runs: bool = True
    #: what an engine process tries first where nothing is wanted; None if that is not known
    first: str | None = None


@frozen
class Devices:
    """Where the player can play to, by its own names."""

    #: the command that lists them, as it is typed
    listed_by: str
    names: tuple[str, ...] = ()
    #: why they can't be listed, in the program's own words
    trouble: str | None = None
    #: the one that is set; None for the player's default
    wanted: str | None = None
    #: the package of the program that lists them, if that program is not installed
    package: str | None = None


@frozen
class SoundServer:
    """PulseAudio or PipeWire, as a client of it finds it."""

    #: "PulseAudio (on PipeWire 0.3.65)", where one answers
    name: str | None = None
    #: the sink that is played to by default
    sink: str | None = None
    #: whether it takes PulseAudio's clients, as the player pulse is one
    pulse: bool = True
    #: where none answers: sockets of sound servers that are there all the same, of another user's for one
    sockets: tuple[str, ...] = ()
    #: what the client said; None where there is no program that could ask
    trouble: str | None = None
    #: whether the client took too long: the server is there and hangs
    hangs: bool = False
    #: PULSE_SERVER, where it is set
    named: str | None = None


@frozen
class Level:
    """A mixer's setting of one output."""

    #: the sink or the control
    name: str
    muted: bool
    #: None where the mixer doesn't say
    percent: int | None
    #: the command that undoes a mute, and the one that makes it louder
    unmute: str
    louder: str


def asked(program: str, *words: str, env: Mapping[str, str], limit: float | None = None) -> Said:
    """Run a program to its end, in its own language, and return what it said; `limit`: seconds, if not LIMIT."""
    limit = LIMIT if limit is None else limit
    if not on_path(program, env):
        return Said(f"{program} is not there")
    # Files, not pipes: what a program leaves running behind it would hold a pipe open.
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        try:
            process = subprocess.Popen(
                [program, *words],
                env={**env, "LC_ALL": "C"},
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=err,
                start_new_session=True,
            )
        except OSError as error:
            return Said(str(error))
        try:
            code = process.wait(limit)
        except subprocess.TimeoutExpired:
            code = None
        finally:
            _end(process)
        said, complaint = _read(out.fileno()), _read(err.fileno())
    if code is None:
        return Said(f"no answer within {limit:g} s", said, late=True)
    if code < 0:
        return Said(f"it was killed by {signal_name(-code)}", said)
    lines = filter(None, map(str.strip, (complaint or said).splitlines()))
    return Said(next(lines, "it said nothing") if code else None, said)


def _end(process: subprocess.Popen[bytes]) -> None:
    if process.returncode is None:
        kill([-process.pid])  # its group is its own, and it is not reaped: nobody else can be hit
        with contextlib.suppress(subprocess.TimeoutExpired):  # it hangs in a driver: init will reap it
            process.wait(1)


def _read(descriptor: int) -> str:
    return os.pread(descriptor, _MOST, 0).decode("utf-8", "replace")


def is_custom(player: str | None) -> bool:
    """Tell whether a player is a command of the user's own: what another program needs, only its user knows."""
    program = program_of(player) if player and not is_silent(player) else None
    return program is not None and program.rpartition("/")[2] not in PLAYERS


def program_of(command: str) -> str | None:
    """Return the program of a player's command line; None where that can't be read."""
    try:
        return next(iter(shlex.split(command)), None)
    except ValueError:
        return None


def players(env: Mapping[str, str], wanted: str | None, first: str | None) -> Players:
    """Return which players there are; `wanted`: the setting; `first`: as in `Players`."""
    found = tuple(each for each in PACKAGES if on_path(each, env))
    program = program_of(wanted or "")
    return Players(found, wanted, program == "pulse" or bool(program and on_path(program, env)), first)


def devices(env: Mapping[str, str], player: str | None, wanted: str | None) -> Devices | None:
    """Return where a player can play to; None for one that nobody can ask."""
    if player not in _LISTING:
        return None
    command, names, package = _LISTING[player]
    program, *words = command.split()
    if not on_path(program, env):
        return Devices(command, wanted=wanted, package=package)
    found = asked(program, *words, env=env)
    return Devices(command, tuple(names(found)), found.trouble, wanted)


def _alsa_names(said: Said) -> list[str]:
    return [each for each in said.out.splitlines() if each and not each[0].isspace() and each not in _NO_DEVICES]


def _sinks(said: Said) -> list[tuple[str, str]]:
    """Return names and states of the sinks: number, name, module, format, state, with tabs between them."""
    lines = [each.split("\t") for each in said.out.splitlines()]
    return [(each[1], each[-1].strip()) for each in lines if said.trouble is None and len(each) > 2]


def _sink_names(said: Said) -> list[str]:
    return [name for name, _ in _sinks(said)]


def _node_names(said: Said) -> list[str]:
    nodes = re.split(r"^\s*id \d+,", said.out, flags=re.MULTILINE)
    found = [re.search(r'node\.name = "([^"]*)"', each) for each in nodes if '"Audio/Sink"' in each]
    return [each[1] for each in found if each]


_SINKS = "pactl list short sinks"
#: How the devices of a player are listed, and read from what that says.
_LISTING: dict[str | None, tuple[str, Callable[[Said], list[str]], str]] = {
    "aplay": ("aplay -L", _alsa_names, PACKAGES["aplay"]),
    "pulse": (_SINKS, _sink_names, PACKAGES["pacat"]),
    "pacat": (_SINKS, _sink_names, PACKAGES["pacat"]),
    "pw-cat": ("pw-cli ls Node", _node_names, PACKAGES["pw-cat"]),
}


def installing(finding: Finding, env: Mapping[str, str]) -> Finding:
    """Return a finding whose next step also says where to get pactl, if the step needs it and it is missing."""
    if finding.next is None or "pactl " not in finding.next or on_path("pactl", env):
        return finding
    return replace(finding, next=f"{finding.next} (for pactl: sudo apt-get install -y {PACKAGES['pacat']})")


def suspended(env: Mapping[str, str]) -> tuple[str, ...]:
    """Return the sinks that take no data; while nothing plays, those that are asleep, too."""
    found = asked(*_SINKS.split(), env=env)
    return tuple(name for name, state in _sinks(found) if state == "SUSPENDED")


def sound_server(env: Mapping[str, str], session: Session) -> SoundServer:
    """Return the sound server that a player of this session finds."""
    pulse = asked("pactl", "info", env=env)
    if pulse.trouble is None:
        return SoundServer(_field(pulse.out, "Server Name") or "PulseAudio", _field(pulse.out, "Default Sink"))
    wire = pulse if pulse.late else asked("pw-cli", "info", "0", env=env)
    # Without pactl only the socket tells whether PulseAudio's clients are served.
    native = None if on_path("pactl", env) else _listening(env)
    if wire.trouble is None:
        name = "PipeWire" if native else "PipeWire, without its PulseAudio part"
        return SoundServer(name, pulse=native is not None)
    if native and native.startswith("/"):
        return SoundServer(f"one listens on {native}")
    answers = {"pactl": pulse, "pw-cli": wire}
    trouble = next((said.trouble for each, said in answers.items() if on_path(each, env)), None)
    sockets = sound_server_sockets(env, session.uid, *([session.sudo_uid] if session.sudo_uid is not None else []))
    named = env.get("PULSE_SERVER") or None
    return SoundServer(sockets=tuple(sockets), trouble=trouble, hangs=wire.late, named=named)


def _listening(env: Mapping[str, str]) -> str | None:
    """Return where a server takes PulseAudio's clients of this environment; None if there is none.

    Another machine's is not asked: a sentence shows whether it is there.
    """
    named = env.get("PULSE_SERVER", "").removeprefix("unix:")
    if named and not named.startswith("/"):
        return named
    for path in [named] if named else [each for each in sound_server_sockets(env) if each.endswith("/native")]:
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX) as probe:
            probe.settimeout(LIMIT)
            probe.connect(path)
            return path
    return None


def _field(text: str, name: str) -> str | None:
    found = re.search(rf"^\s*{name}: (.+)$", text, re.MULTILINE)
    return found[1].strip() if found else None


def levels(env: Mapping[str, str], server: SoundServer, cards: Cards) -> tuple[Level, ...]:
    """Return how loud the default output is, by the first mixer that tells."""
    if server.hangs:
        return ()
    if server.name is not None:
        mute = asked("pactl", "get-sink-mute", "@DEFAULT_SINK@", env=env)
        if mute.trouble is None:
            volume = asked("pactl", "get-sink-volume", "@DEFAULT_SINK@", env=env)
            return (level_of(_SINK, mute.out + volume.out, *_PACTL),)
        whole = asked("wpctl", "get-volume", "@DEFAULT_AUDIO_SINK@", env=env)
        return (level_of(_SINK, whole.out, *_WPCTL),) if whole.trouble is None else ()
    if not cards.names:
        return ()
    controls = asked("amixer", "scontrols", env=env)
    names = re.findall(r"control '([^']*)'", controls.out)
    told = [(each, asked("amixer", "sget", each, env=env)) for each in _CONTROLS if each in names]
    return tuple(
        level_of(name, said.out, f"amixer sset {name} unmute", f"amixer sset {name} 70%")
        for name, said in told
        if said.trouble is None
    )


def level_of(name: str, text: str, unmute: str, louder: str) -> Level:
    """Return what a mixer says of an output: pactl, "Mute: no" and "40%"; wpctl, "Volume: 0.40 [MUTED]"; or amixer.

    The loudest of its channels counts; by amixer, "[40%] [on]", it is muted where none is on.
    """
    switches = re.findall(r"\[(on|off)\]", text)
    muted = "Mute: yes" in text or "[MUTED]" in text or (bool(switches) and "on" not in switches)
    percents = [int(each) for each in re.findall(r"(\d+)%", text)]
    percents += [round(float(each) * 100) for each in re.findall(r"Volume: (\d+(?:\.\d+)?)", text)]
    return Level(name, muted, max(percents, default=None), unmute, louder)


def judge_silent(player: str | None, *, running: bool) -> list[Finding]:
    """Judge a player by its name alone: it may be one that makes no sound; `running`: as of `judge`."""
    if not is_silent(player):
        return []
    step = "start the server without --player" if running else "unset TALK_PLAYER"
    return [failed("player", f"{player} ({_by(running)}): it keeps the time and makes no sound", step)]


def judge(
    players: Players, devices: Devices | None, cards: Cards, server: SoundServer, session: Session, *, running: bool
) -> list[Finding]:
    """Judge what plays; `running`: whether a talk server runs, which has a player of its own, and set by itself."""
    served = server.name is not None
    return judge_silent(players.wanted, running=running) or [
        _player(players, server, running=running),
        *([] if devices is None else [_device(devices)]),
        judge_cards(cards, session, served=served),
        judge_access(cards, session, served=served),
        _sound_server(server, cards, session),
    ]


def _by(running: bool) -> str:
    """Return for people by whom a player is set."""
    return "the server's" if running else "TALK_PLAYER"


def _player(players: Players, server: SoundServer, *, running: bool) -> Finding:
    wanted, found = players.wanted, players.found
    broken = warning if running else failed
    pulse = players.first == "pulse" if players.first else server.name is not None and server.pulse
    if wanted is None and pulse:
        after = f"; then {', '.join(found)}" if found else ""
        return ok("player", f"pulse is used, by the sound server{after}")
    if wanted is None and not found:
        first = next(iter(PACKAGES.values()))
        return broken("player", f"none is on the PATH: {', '.join(PACKAGES)}", f"sudo apt-get install -y {first}")
    if wanted is None:
        after = f"; then {', '.join(found[1:])}" if len(found) > 1 else ""
        return ok("player", f"{found[0]} is used{after}")
    if not players.runs:
        package = PACKAGES.get(wanted)
        step = f"sudo apt-get install -y {package}" if package else "name a program that is there, with --player"
        return broken("player", f"{wanted} ({_by(running)}) is not there", step)
    others = [each for each in found if each != wanted]
    also = f"; there {'is' if len(others) == 1 else 'are'} also {', '.join(others)}" if others else ""
    return ok("player", f"{wanted} ({_by(running)}){also}")


def _device(devices: Devices) -> Finding:
    wanted, names = devices.wanted, devices.names
    if devices.package is not None:
        words = f"{wanted or 'the default'}; others cannot be listed: {devices.listed_by.split()[0]} is not installed"
        step = f"sudo apt-get install -y {devices.package}"
        return ok("device", words) if wanted is None else warning("device", words, step)
    if devices.trouble is not None:
        step = f"look at what this says: {devices.listed_by}"
        return warning("device", f"{devices.listed_by}: {devices.trouble}", step)
    if not names:
        step = "plug in a loudspeaker; in a container, hand the device in"
        return warning("device", f"{devices.listed_by} lists none", step)
    # ALSA makes plughw:1,0 of any card; whether it can, the sentence shows.
    if wanted is None or wanted in names or ":" in wanted:
        return ok("device", f"{wanted or 'the default'}; {devices.listed_by} lists {some(names)}")
    return warning(
        "device",
        f"{wanted} is not among those that {devices.listed_by} lists: {some(names)}",
        "start the server with --device and one of these names",
    )


def _sound_server(server: SoundServer, cards: Cards, session: Session) -> Finding:
    where = "from here" if session.server is None else f"from the server (process {session.server})"
    if server.name is not None and server.sink == DUMMY_SINK:
        step = "plug in a loudspeaker, and look whether it is there: pactl list short sinks"
        return warning(_SERVER, f"{server.name} has only a dummy output, {DUMMY_SINK}: nobody hears it", step)
    if server.name is not None:
        sink = f", plays to {server.sink}" if server.sink else ""
        return ok(_SERVER, f"{server.name}{sink}")
    if server.hangs:
        step = "restart it: systemctl --user restart pipewire pipewire-pulse (or: pulseaudio -k)"
        return warning(_SERVER, f"there is one, but it does not answer {where}", step)
    if not server.sockets and server.named is None:
        if session.kinds and not cards.names:
            return _out_of_reach(server, session, f"none can be reached {where}")
        alone = "; players use ALSA" if cards.names else ""
        return ok(_SERVER, f"no PulseAudio or PipeWire runs for user {session.user}{alone}")
    at = f"at {server.named} (PULSE_SERVER)" if server.named else f"at {some(server.sockets)}"
    if server.trouble is None:
        step = "sudo apt-get install -y pulseaudio-utils"
        return warning(_SERVER, f"there is one {at}, but no program to ask it: pactl, pw-cli", step)
    return _out_of_reach(server, session, f"the one {at} cannot be reached {where}: {server.trouble}")


def _out_of_reach(server: SoundServer, session: Session, words: str) -> Finding:
    step = "systemctl --user restart pipewire pipewire-pulse (or: pulseaudio --start)"
    if server.named is not None:
        step = "unset PULSE_SERVER, or start the sound server that it names"
    elif "a container" in session.kinds:
        words += "; a container sees only what it is given"
        step = "start the container with the host's socket and PULSE_SERVER: see the README"
    elif "a system service" in session.kinds:
        words += "; a system service is in no user's session"
        step = "serve as the user whose sound it is: talk serve --print-unit user"
    elif session.sudo_uid is not None:
        words += "; a sound server takes its own user only, not root"
        step = "leave sudo out: run this as the user whose sound it is"
    elif session.runtime is None and session.usual_runtime is not None:
        step = f"export XDG_RUNTIME_DIR={session.usual_runtime}"
    return warning(_SERVER, words, step)


def judge_levels(levels: tuple[Level, ...], *, default: bool) -> list[Finding]:
    """Judge how loud it is; `default`: whether it is this output that is played to, as far as can be known."""
    if not levels:
        return []
    broken = failed if default else warning
    for level in levels:
        if level.muted:
            return [broken(_LOUDNESS, f"{level.name} is muted", level.unmute)]
        if level.percent == 0:
            return [broken(_LOUDNESS, f"{level.name} is at 0%", level.louder)]
    for level in levels:
        if level.percent is not None and level.percent < _FAINT:
            return [warning(_LOUDNESS, f"{level.name} is at {level.percent}%: few will hear it", level.louder)]
    shown = [f"{each.name} at {each.percent}%" if each.percent is not None else f"{each.name} on" for each in levels]
    return [ok(_LOUDNESS, ", ".join(shown))]
