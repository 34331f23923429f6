"""What makes a sound of samples: players, devices, cards, who may use them, sound servers. Pure.

Only a sentence proves that there is sound: what may be in its way is a warning here. Without a player it is certain.
"""

from __future__ import annotations

import shlex

from talkcli.doctor.findings import Finding, done, failed, warning
from talkcli.doctor.session import Session, seen_from
from talkcli.frozen import frozen

#: Players that are programs known here, as `engine.players` has them; nothing of the engine is imported to judge.
NAMED = frozenset({"aplay", "pacat", "pw-cat"})
#: Players that need no device.
SILENT = "null"
FILE = "file:"
#: Names that are shown of a long list.
_SHOWN = 4


@frozen
class Players:
    """Which programs can play."""

    #: those that `talk` knows, with the package each comes in
    packages: dict[str, str]
    #: … and those that are there, best first
    found: tuple[str, ...]
    #: what is to play, by the server's setting or by TALK_PLAYER; None for the first that is there
    wanted: str | None
    #: by whom that was said, for people: "the server", "TALK_PLAYER"
    by: str | None = None
    #: whether a wanted program can be run
    runs: bool = True


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


@frozen
class Cards:
    """The sound cards of the kernel."""

    #: whether the kernel tells of any: a container, or a machine without a driver, does not
    kernel: bool
    names: tuple[str, ...] = ()
    #: what plays: /dev/snd/pcmC0D0p
    nodes: tuple[str, ...] = ()
    #: those of them that may not be opened
    forbidden: tuple[str, ...] = ()
    #: the group that they belong to
    group: str | None = None
    #: whether this user is to be in that group from the next login on
    from_next_login: bool = False


@frozen
class SoundServer:
    """PulseAudio or PipeWire, as a client of it finds it."""

    #: "PulseAudio (on PipeWire 0.3.65)", where one answers
    name: str | None = None
    #: the sink that is played to by default
    sink: str | None = None
    #: sockets of sound servers that are there, though none answers at them or they are another user's
    sockets: tuple[str, ...] = ()
    #: what the client said
    trouble: str | None = None
    #: whether the client took too long: the server is there and hangs
    hangs: bool = False
    #: whether there is a program that could ask
    askable: bool = True
    #: PULSE_SERVER, where it is set
    named: str | None = None


def is_silent(player: str | None) -> bool:
    """Tell whether a player makes no sound by its nature."""
    return player is not None and (player == SILENT or player.startswith(FILE))


def is_custom(player: str | None) -> bool:
    """Tell whether a player is a command of the user's own: what another program needs, only its user knows."""
    program = program_of(player) if player and not is_silent(player) else None
    return program is not None and program.rpartition("/")[2] not in NAMED


def program_of(command: str) -> str | None:
    """Return the program of a player's command line; None where that can't be read."""
    try:
        return next(iter(shlex.split(command)), None)
    except ValueError:
        return None


def judge_setting(wanted: str | None, by: str | None) -> list[Finding]:
    """Judge a server's player where nothing else can be seen: it may be one that makes no sound."""
    return [_player(Players({}, (), wanted, by), running=True)] if is_silent(wanted) else []


def judge(
    players: Players, devices: Devices | None, cards: Cards, server: SoundServer, session: Session, *, running: bool
) -> list[Finding]:
    """Judge what plays; `running`: whether a talk server runs, which has a player of its own."""
    found = [_player(players, running=running)]
    if is_silent(players.wanted):
        return found
    if devices is not None:
        found.append(_device(devices))
    return [
        *found,
        _cards(cards, server, session),
        _group(cards, server, session),
        _sound_server(server, cards, session),
    ]


def _player(players: Players, *, running: bool) -> Finding:
    wanted = players.wanted
    if is_silent(wanted):
        step = "start the server without --player" if running else "unset TALK_PLAYER"
        return failed("player", f"{wanted} ({players.by}): it keeps the time and makes no sound", step)
    broken = warning if running else failed
    others = [each for each in players.found if each != wanted]
    if wanted is not None:
        if players.runs:
            also = f"; there {'is' if len(others) == 1 else 'are'} also {', '.join(others)}" if others else ""
            return done("player", f"{wanted} ({players.by}){also}")
        package = players.packages.get(wanted)
        step = f"sudo apt-get install -y {package}" if package else "name a program that is there, with --player"
        return broken("player", f"{wanted} ({players.by}) is not there", step)
    if not players.found:
        first = next(iter(players.packages.values()))
        names = ", ".join(players.packages)
        return broken("player", f"none is on the PATH: {names}", f"sudo apt-get install -y {first}")
    after = f"; then {', '.join(others[1:])}" if len(others) > 1 else ""
    return done("player", f"{others[0]} is used{after}")


def _device(devices: Devices) -> Finding:
    wanted, names = devices.wanted, devices.names
    if devices.trouble is not None:
        step = f"look at what this says: {devices.listed_by}"
        return warning("device", f"{devices.listed_by}: {devices.trouble}", step)
    if not names:
        return warning(
            "device", f"{devices.listed_by} lists none", "plug in a loudspeaker; in a container, hand the device in"
        )
    if wanted is None:
        return done("device", f"the default; {devices.listed_by} lists {_some(names)}")
    if wanted in names or ":" in wanted:  # ALSA makes plughw:1,0 of any card; whether it can, the sentence shows
        return done("device", f"{wanted}; {devices.listed_by} lists {_some(names)}")
    return warning(
        "device",
        f"{wanted} is not among those that {devices.listed_by} lists: {_some(names)}",
        "start the server with --device and one of these names",
    )


def _cards(cards: Cards, server: SoundServer, session: Session) -> Finding:
    if cards.names:
        return done("cards", _some(cards.names))
    if server.name is not None:
        return done("cards", "none of this machine's own; the sound server has what is needed")
    if "a container" in session.kinds:
        step = "start the container with --device /dev/snd, or with the sound server's socket: see the README"
        return warning("cards", "none in this container", step)
    words = "the kernel knows none" if cards.kernel else "the kernel has no sound (no /proc/asound)"
    return warning("cards", words, "plug in a loudspeaker or sound card, and look with: aplay -l")


def _group(cards: Cards, server: SoundServer, session: Session) -> Finding:
    group = cards.group or "audio"
    if not cards.nodes:
        return done("group", f"nothing in /dev/snd to open, so the group {group} is not needed")
    if not cards.forbidden:
        member = (
            f"in the group {group}" if group in session.groups else f"not in the group {group}, and needs not to be"
        )
        return done("group", f"user {session.user} may open the cards ({member})")
    words = f"user {session.user} may not open {_some(cards.forbidden)}: not in the group {group}"
    if server.name is not None:
        return done("group", f"{words}; the sound server opens them")
    if cards.from_next_login:
        step = "log out and in again" if session.server is None else "start the server again, from a new login"
        return warning("group", f"{words} yet, though it is to be from the next login on", step)
    return warning("group", words, f"sudo usermod -aG {group} {session.user}, and log in again")


def _sound_server(server: SoundServer, cards: Cards, session: Session) -> Finding:
    check = "sound server"
    where = seen_from(session)
    if server.name is not None:
        sink = f", plays to {server.sink}" if server.sink else ""
        return done(check, f"{server.name}{sink}")
    if server.hangs:
        step = "restart it: systemctl --user restart pipewire pipewire-pulse (or: pulseaudio -k)"
        return warning(check, f"there is one, but it does not answer {where}", step)
    if not server.sockets and server.named is None:
        alone = "; players use ALSA" if cards.names else ""
        if session.kinds and not cards.names:
            return _out_of_reach(server, session, f"none can be reached {where}")
        return done(check, f"no PulseAudio or PipeWire runs for user {session.user}{alone}")
    at = f"at {server.named} (PULSE_SERVER)" if server.named else f"at {_some(server.sockets)}"
    if not server.askable:
        step = "sudo apt-get install -y pulseaudio-utils"
        return warning(check, f"there is one {at}, but no program to ask it: pactl, pw-cli", step)
    return _out_of_reach(server, session, f"the one {at} cannot be reached {where}: {server.trouble or 'no answer'}")


def _out_of_reach(server: SoundServer, session: Session, words: str) -> Finding:
    check = "sound server"
    if server.named is not None:
        return warning(check, words, "unset PULSE_SERVER, or start the sound server that it names")
    if "a container" in session.kinds:
        step = "start the container with the host's socket and PULSE_SERVER: see the README"
        return warning(check, f"{words}; a container sees only what it is given", step)
    if "a system service" in session.kinds:
        step = "serve as the user whose sound it is: talk serve --print-unit user"
        return warning(check, f"{words}; a system service is in no user's session", step)
    if session.sudo_uid is not None:
        step = "leave sudo out: run this as the user whose sound it is"
        return warning(check, f"{words}; a sound server takes its own user only, not root", step)
    if session.runtime is None and session.usual_runtime is not None:
        return warning(check, words, f"export XDG_RUNTIME_DIR={session.usual_runtime}")
    return warning(check, words, "systemctl --user restart pipewire pipewire-pulse (or: pulseaudio --start)")


def _some(names: tuple[str, ...]) -> str:
    """Return names for people, not all of many."""
    rest = len(names) - _SHOWN
    return ", ".join(names) if rest <= 1 else f"{', '.join(names[:_SHOWN])} and {rest} more"
