"""The known players, the command lines of player programs, and the machine's playback devices.

This module neither starts a program nor opens a device, so the server, doctor and the command line may use it. The
classes that play sound are in `talkcli.engine.child.players`.
"""

from __future__ import annotations

import contextlib
import os
import struct

from talkcli.frozen import TYPE_CHECKING, frozen

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

#: The size of a sample in bytes (signed 16 bit, one channel).
SAMPLE_BYTES = 2

#: The sample rates in Hz that players support.
RATES_HZ = range(4_000, 192_001)

#: The sample rate in Hz of espeak's voices and of the built-in sounds.
DEFAULT_RATE_HZ = 22_050

#: Seconds of sound to offer to a player at a time. The pieces are short, so that little sound is played after a stop.
PIECE_S = 0.02

#: Milliseconds of sound that a player may buffer. A larger buffer would delay words, and would lose more sound if the
#: player stalls. A buffer of less than three periods of 20 ms would cause gaps on a busy machine.
BUFFER_MS = 60

#: Bytes that a program may read before it opens its device (one block of standard input). A program that has read more
#: must be playing.
READ_AHEAD_BYTES = 4096

#: The prefix of a player that writes to a file, as in "file:PATH".
FILE_PREFIX = "file:"

#: The name of the sink that PulseAudio and PipeWire create if there is no other. PipeWire describes it as "Dummy
#: Output". Nobody can hear it. Every other virtual sink (echo canceller, remap, tunnel, effect) leads to a real device.
DUMMY_SINK = "auto_null"
#: Environment variables that select a sound server or a custom configuration.
_SOUND_VARIABLES = ("PULSE_SERVER", "PULSE_CLIENTCONFIG", "PIPEWIRE_REMOTE", "ALSA_CONFIG_PATH")
#: The runtime directory of a system-wide PulseAudio server.
_SYSTEM_PULSE = "/run/pulse"


@frozen
class PlayerCommand:
    """The command line of a player program, and how the program reads its input."""

    name: str
    argv: tuple[str, ...]
    #: the number of sample bytes that the program may read before it opens its device
    read_ahead: int = READ_AHEAD_BYTES
    #: bytes to write before the samples
    preamble: bytes = b""


@frozen
class KnownPlayer:
    """A player that users can select by name."""

    #: a short description of the player's output, such as "ALSA"
    description: str
    #: the Debian package that contains the player
    package: str = ""
    #: the function that builds the program's command line from the sample rate and the device, or None if the player is
    #: a class
    command: Callable[[int, str | None], PlayerCommand] | None = None
    #: the player's class as "module:Class", or "" if the player is a program. The class is called with the sample rate,
    #: the device, and whether a muted output is an error.
    class_path: str = ""
    #: whether this player may be chosen automatically. If the user names only a device, only programs are chosen.
    automatic: bool = False
    #: whether this player makes no sound and therefore needs no device
    silent: bool = False


def _aplay_command(rate: int, device: str | None) -> PlayerCommand:
    """Return the command line of aplay."""
    argv = ["aplay", "-q", "-t", "raw", "-f", "S16_LE", "-c", "1", "-r", str(rate)]
    argv += [f"--buffer-time={BUFFER_MS * 1000}"]
    argv += ["-D", device] if device else []
    # aplay opens the device before it reads any samples.
    return PlayerCommand("aplay", tuple(argv), read_ahead=0)


def _pacat_command(rate: int, device: str | None) -> PlayerCommand:
    """Return the command line of pacat."""
    argv = ["pacat", "--playback", "--raw", "--format=s16le", "--channels=1", f"--rate={rate}"]
    argv += [f"--latency-msec={BUFFER_MS}", "--process-time-msec=20", "--client-name=talk", "--stream-name=talk"]
    argv += ["-d", device] if device else []
    # While pacat is still connecting, it reads once and gets at most one piece of samples.
    return PlayerCommand("pacat", tuple(argv), read_ahead=int(PIECE_S * rate) * SAMPLE_BYTES)


def _pw_cat_command(rate: int, device: str | None) -> PlayerCommand:
    """Return the command line of pw-cat."""
    argv = ["pw-cat", "--playback", f"--latency={BUFFER_MS}ms", "--media-role=Accessibility"]
    argv += [f"--target={device}"] if device else []
    return PlayerCommand("pw-cat", (*argv, "-"), preamble=_au_header(rate))


def _au_header(rate: int) -> bytes:
    """Return the little-endian header of an AU stream.

    pw-cat reads standard input through libsndfile, which needs a format that works in a pipe. The pw-cat of Debian 12
    has no option for raw samples, but every version can read AU.
    """
    # the size of the header, an unknown length, the encoding (PCM of 16 bits), the rate, and the number of channels
    return b"dns." + struct.pack("<5I", 24, 0xFFFFFFFF, 3, rate, 1)


#: The players by name. If the user names no player, they are tried in this order, except that classes come before
#: programs. The sound server comes first because it starts at once and reports more than any program does. aplay comes
#: before the other programs because robots without a desktop have it, and because it loses no samples if it can't open
#: the device.
PLAYERS = {
    "aplay": KnownPlayer("ALSA", "alsa-utils", _aplay_command, automatic=True),
    "pacat": KnownPlayer("PulseAudio", "pulseaudio-utils", _pacat_command, automatic=True),
    "pw-cat": KnownPlayer("PipeWire", "pipewire-bin", _pw_cat_command, automatic=True),
    "pulse": KnownPlayer(
        "the sound server, PulseAudio or PipeWire", "libpulse0", class_path="pulse:PulsePlayer", automatic=True
    ),
    "null": KnownPlayer("silent, in real time", class_path="builtin:NullPlayer", silent=True),
}
#: The Debian package of each player program.
PACKAGES = {name: each.package for name, each in PLAYERS.items() if each.command is not None}
*_OTHERS, _LAST = [f"{package} ({name})" for name, package in PACKAGES.items()]
#: The error message if no player program is installed.
NO_PLAYER_MESSAGE = f"no player found; install {', '.join(_OTHERS)} or {_LAST}"


class PlayerMissing(Exception):
    """Raised if a player program is not installed, or if its command line can't be parsed."""


def is_silent(player: str | None) -> bool:
    """Return whether a player makes no sound and therefore needs no device."""
    return player is not None and (player.startswith(FILE_PREFIX) or (player in PLAYERS and PLAYERS[player].silent))


def on_path(program: str, env: Mapping[str, str] | None = None) -> bool:
    """Return whether a program is installed, given its name or its path.

    Args:
        program: The path or the name of the program. A name is searched for on the PATH.
        env: The environment with the PATH, or None for this process's environment.
    """
    places = [""] if os.sep in program else os.get_exec_path(env)
    paths = [os.path.join(place, program) for place in places]
    return any(os.path.isfile(each) and os.access(each, os.X_OK) for each in paths)


def player_commands(
    player: str | None, device: str | None, rate: int, last_player: str | None = None
) -> list[PlayerCommand]:
    """Return the command lines of the player programs to try, best first.

    Args:
        player: The name of a known program, a custom command line, or None for all installed programs that may be
            chosen automatically.
        device: The device to play to, or None for the program's default.
        rate: Samples per second.
        last_player: The name of the program that worked last time. If `player` is None, it is tried first.

    Raises:
        PlayerMissing: No suitable program is installed.
    """
    if player is None:
        programs = {name: each.command for name, each in PLAYERS.items() if each.automatic and each.command}
        names = sorted((name for name in programs if on_path(name)), key=lambda name: name != last_player)
        if not names:
            raise PlayerMissing(NO_PLAYER_MESSAGE)
        return [programs[name](rate, device) for name in names]
    command = PLAYERS[player].command if player in PLAYERS else None
    if command is None:
        return [_parse_custom_command(player, device, rate)]
    if not on_path(player):
        raise PlayerMissing(f'player "{player}" not found; install {PACKAGES[player]}')
    return [command(rate, device)]


def _parse_custom_command(player: str, device: str | None, rate: int) -> PlayerCommand:
    """Parse a custom player command, and fill in its placeholders.

    Raise PlayerMissing if it can't be run.
    """
    import shlex

    try:
        parts = shlex.split(player)
    except ValueError as error:
        raise PlayerMissing(f"invalid player command {player!r}: {str(error).lower()}") from error
    if not parts:
        raise PlayerMissing("the player command is empty; name a program that plays standard input")
    argv = [part.replace("{rate}", str(rate)).replace("{device}", device or "default") for part in parts]
    if not on_path(argv[0]):
        raise PlayerMissing(f'player "{argv[0]}" not found')
    return PlayerCommand(os.path.basename(argv[0]), tuple(argv))


def playback_devices(snd_dir: str = "/dev/snd") -> list[str]:
    """Return the paths of the kernel's playback devices, such as /dev/snd/pcmC0D0p."""
    names = _list_directory(snd_dir)
    return [f"{snd_dir}/{each}" for each in names if each.startswith("pcmC") and each.endswith("p")]


def sound_server_sockets(env: Mapping[str, str], *uids: int) -> list[str]:
    """Return the paths of the existing sockets of PulseAudio and PipeWire.

    Args:
        env: The environment variables that may name runtime directories.
        uids: The users whose runtime directories are searched.
    """
    runtime = [env.get("XDG_RUNTIME_DIR"), *(f"/run/user/{each}" for each in uids)]
    found = [f"{each}/{socket}" for each in runtime if each for socket in ("pulse/native", "pipewire-0")]
    found += [f"{each}/native" for each in (env.get("PULSE_RUNTIME_PATH"), _SYSTEM_PULSE) if each]
    if env.get("PIPEWIRE_RUNTIME_DIR"):
        found.append(f"{env['PIPEWIRE_RUNTIME_DIR']}/pipewire-0")
    # If there is no runtime directory, PulseAudio creates one in /tmp, and a link to it in its configuration directory.
    config = f"{_config_home(env)}/pulse"
    found += [f"{config}/{each}/native" for each in _list_directory(config) if each.endswith("-runtime")]
    return [each for each in dict.fromkeys(found) if os.path.exists(each)]


def has_no_output(env: Mapping[str, str], snd_dir: str = "/dev/snd", etc_dir: str = "/etc") -> bool:
    """Return whether this process certainly can't play any sound.

    This only looks at file names, so that no sleeping device wakes up. Any custom configuration counts as an output,
    because it may lead to any device.
    """
    if playback_devices(snd_dir) or any(map(env.get, _SOUND_VARIABLES)) or sound_server_sockets(env, os.getuid()):
        return False
    alsa = (f"{env.get('HOME', '')}/.asoundrc", f"{_config_home(env)}/alsa/asoundrc", f"{etc_dir}/asound.conf")
    pulse = [f"{each}/pulse/client.conf" for each in (_config_home(env), etc_dir)]
    pulse += [f"{each}.d/{name}" for each in pulse for name in _list_directory(f"{each}.d")]
    return not any(map(os.path.exists, alsa)) and not any(map(_has_default_server, pulse))


def _config_home(env: Mapping[str, str]) -> str:
    """Return the user's configuration directory."""
    return env.get("XDG_CONFIG_HOME") or f"{env.get('HOME', '')}/.config"


def _has_default_server(path: str) -> bool:
    """Return whether a configuration file for PulseAudio's clients names a server.

    Debian's default file doesn't.
    """
    with contextlib.suppress(OSError), open(path, "rb") as file:
        return any(line.lstrip().startswith(b"default-server") for line in file)
    return False


def _list_directory(directory: str) -> list[str]:
    """Return the sorted names in a directory, or an empty list if the directory can't be read."""
    with contextlib.suppress(OSError):
        return sorted(os.listdir(directory))
    return []
