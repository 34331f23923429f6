"""Facts that programs of others tell: players on the PATH, devices, sound servers, mixers.

Each has a limit of time, and one that is missing is a fact. It judges nothing. Asking wakes no device.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from talkcli.doctor import level, programs
from talkcli.doctor.sound import Devices, Players, SoundServer, is_silent, program_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from talkcli.doctor.level import Level
    from talkcli.doctor.session import Session
    from talkcli.doctor.sound import Cards

#: What ALSA lists besides devices: converters, and ways that nobody takes by default.
_NO_DEVICES = frozenset(
    {"null", "lavrate", "samplerate", "speexrate", "jack", "oss", "speex", "upmix", "vdownmix", "usbstream"}
)


def players(env: Mapping[str, str], wanted: str | None, by: str | None) -> Players:
    """Return which players there are; `wanted`: the setting, `by` whom it is."""
    from talkcli.engine.players.programs import PACKAGES

    found = tuple(each for each in PACKAGES if programs.path_of(each, env))
    runs = True
    if wanted is not None and not is_silent(wanted):
        program = program_of(wanted)
        runs = bool(program and programs.path_of(program, env))
    return Players(dict(PACKAGES), found, wanted, by, runs)


def devices(env: Mapping[str, str], player: str | None, wanted: str | None) -> Devices | None:
    """Return where a player can play to; None for one that nobody can ask."""
    if player == "aplay":
        said = programs.said("aplay", "-L", env=env)
        names = [each for each in said.out.splitlines() if each and not each[0].isspace() and each not in _NO_DEVICES]
        return _devices("aplay -L", said, names, wanted)
    if player == "pacat":
        said = programs.said("pactl", "list", "short", "sinks", env=env)
        return _devices("pactl list short sinks", said, [name for name, _ in _sinks(said)], wanted)
    if player == "pw-cat":
        said = programs.said("pw-cli", "ls", "Node", env=env)
        blocks = re.split(r"^\s*id \d+,", said.out, flags=re.MULTILINE)
        found = [re.search(r'node\.name = "([^"]*)"', each) for each in blocks if '"Audio/Sink"' in each]
        return _devices("pw-cli ls Node", said, [each[1] for each in found if each], wanted)
    return None


def _devices(command: str, said: programs.Said, names: list[str], wanted: str | None) -> Devices:
    return Devices(command, tuple(names), None if said.well else _trouble(command.partition(" ")[0], said), wanted)


def _trouble(program: str, said: programs.Said) -> str:
    if said.late:
        return f"no answer within {programs.LIMIT:g} s"
    return f"{program} is not there" if said.code is None and not said.err else said.complaint


def suspended(env: Mapping[str, str]) -> tuple[str, ...]:
    """Return the sinks that take no data; while nothing plays, those that are asleep, too."""
    return tuple(name for name, state in _sinks(programs.said("pactl", "list", "short", "sinks", env=env))
                 if state == "SUSPENDED")  # fmt: skip


def _sinks(said: programs.Said) -> list[tuple[str, str]]:
    """Return names and states of the sinks: number, name, module, format, state, with tabs between them."""
    lines = [each.split("\t") for each in said.out.splitlines()]
    return [(each[1], each[-1].strip()) for each in lines if said.well and len(each) > 2]


def sound_server(env: Mapping[str, str], session: Session) -> SoundServer:
    """Return the sound server that a player of this session finds."""
    from talkcli.engine.devices import sound_servers

    named = env.get("PULSE_SERVER") or None
    sockets = tuple(sound_servers(env, session.uid, *([session.sudo_uid] if session.sudo_uid is not None else [])))
    pulse = programs.said("pactl", "info", env=env)
    if pulse.well:
        name = _field(pulse.out, "Server Name") or "PulseAudio"
        return SoundServer(name=name, sink=_field(pulse.out, "Default Sink"), sockets=sockets, named=named)
    wire = programs.Said(None) if pulse.late else programs.said("pw-cli", "info", "0", env=env)
    if wire.well:
        return SoundServer(name="PipeWire, without its PulseAudio part", sockets=sockets, named=named)
    askable = any(programs.path_of(each, env) for each in ("pactl", "pw-cli"))
    trouble = _trouble("pactl", pulse) if programs.path_of("pactl", env) else _trouble("pw-cli", wire)
    return SoundServer(
        sockets=sockets, trouble=trouble, hangs=pulse.late or wire.late, askable=askable, named=named
    )  # fmt: skip


def _field(text: str, name: str) -> str | None:
    found = re.search(rf"^\s*{name}: (.+)$", text, re.MULTILINE)
    return found[1].strip() if found else None


def levels(env: Mapping[str, str], server: SoundServer, cards: Cards) -> tuple[Level, ...]:
    """Return how loud the default output is, by the first mixer that tells."""
    if server.hangs:
        return ()
    if server.name is not None:
        mute = programs.said("pactl", "get-sink-mute", "@DEFAULT_SINK@", env=env)
        if mute.well:
            volume = programs.said("pactl", "get-sink-volume", "@DEFAULT_SINK@", env=env)
            return (level.of_pactl(mute.out, volume.out),)
        whole = programs.said("wpctl", "get-volume", "@DEFAULT_AUDIO_SINK@", env=env)
        return (level.of_wpctl(whole.out),) if whole.well else ()
    if not cards.names:
        return ()
    controls = programs.said("amixer", "scontrols", env=env)
    names = re.findall(r"control '([^']*)'", controls.out)
    asked = [(each, programs.said("amixer", "sget", each, env=env)) for each in level.CONTROLS if each in names]
    return tuple(level.of_amixer(name, said.out) for name, said in asked if said.well)
