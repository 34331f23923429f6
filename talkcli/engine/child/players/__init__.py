"""What takes the samples of a sentence: programs at the end of a pipe, files, silence; here the names they go by.

The table has the players that have a name, and the command lines of those that are programs. Who wants to know what
players there are imports this alone: nothing is started or opened here.
`base` has what each of them does and may raise; `choice` chooses one for each sentence; `devices` tells whether there
is anything to play to. A player that is no program is a module here, and each goes through
`tests/engine/test_player_contract.py`. The package may import the ground, and the protocol for its types.
"""

from __future__ import annotations

import os
import struct

from talkcli.engine.child.players.base import PIECE, SAMPLE, CannotSpeak
from talkcli.frozen import TYPE_CHECKING, frozen

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from talkcli.engine.child.players.base import Player

#: Milliseconds of sound that a player may hold. What it holds is heard late and is lost in a stall; with less than
#: three periods of 20 ms a busy machine makes gaps.
BUFFER_MS = 60

#: Milliseconds of sound that wait for aplay while it starts. It begins to play when its buffer is full, and reads whole
#: periods of 15 ms; with one piece of 20 ms after the other, each asked for, it would begin 2 ms later on a PC.
START_MS = 80

#: Bytes that a player may take before it has opened its device: a block as programs read it. Only what is taken beyond
#: proves that the sound goes somewhere. Where more is known about a player, it is said there.
READ_AHEAD = 4096


@frozen
class Command:
    """A player program, ready to be started."""

    name: str
    argv: tuple[str, ...]
    #: bytes of samples that it may have taken without having opened its device.
    read_ahead: int = READ_AHEAD
    #: what goes in front of the samples.
    preamble: bytes = b""
    #: bytes of samples that may wait for it while it starts, if they are more than one piece.
    at_start: int = 0


@frozen
class Known:
    """A player that `talk` knows by its name."""

    #: what it is, for people; of a program, what it plays to
    about: str
    #: the package of Debian's that the program comes in
    package: str = ""
    #: makes the program's command, of the samples per second and a device; None for a player that is no program
    command: Callable[[int, str | None], Command] | None = None
    #: … and opens that one, of the same, and of whether it is to fail where it is muted
    opens: Callable[[int, str | None, bool], Player] | None = None


def _aplay(rate: int, device: str | None) -> Command:
    argv = ["aplay", "-q", "-t", "raw", "-f", "S16_LE", "-c", "1", "-r", str(rate)]
    argv += [f"--buffer-time={BUFFER_MS * 1000}"]
    argv += ["-D", device] if device else []
    # It opens the device before it reads.
    return Command("aplay", tuple(argv), read_ahead=0, at_start=START_MS * rate // 1000 * SAMPLE)


def _pacat(rate: int, device: str | None) -> Command:
    argv = ["pacat", "--playback", "--raw", "--format=s16le", "--channels=1", f"--rate={rate}"]
    argv += [f"--latency-msec={BUFFER_MS}", "--process-time-msec=20", "--client-name=talk", "--stream-name=talk"]
    argv += ["-d", device] if device else []
    # It reads once while it still connects, and there is never more than one piece to read.
    return Command("pacat", tuple(argv), read_ahead=int(PIECE * rate) * SAMPLE)


def _pw_cat(rate: int, device: str | None) -> Command:
    argv = ["pw-cat", "--playback", f"--latency={BUFFER_MS}ms", "--media-role=Accessibility"]
    argv += [f"--target={device}"] if device else []
    return Command("pw-cat", (*argv, "-"), preamble=_au_header(rate))


def _au_header(rate: int) -> bytes:
    """Return the header of a stream without a length, in the little-endian form of AU.

    pw-cat reads its standard input through libsndfile, which wants a header that a pipe can carry; the option for raw
    samples came later than Debian 12's version, the header works with both.
    """
    endless = 0xFFFFFFFF
    pcm16 = 3
    return b"dns." + struct.pack("<5I", 24, endless, pcm16, rate, 1)


def sound_server(rate: int, device: str | None = None, audible: bool = False) -> Player:
    """Open a player that speaks to the sound server; CannotSpeak."""
    from talkcli.engine.child.players.pulse import PulsePlayer

    return PulsePlayer(rate, device, audible=audible)


def _null(rate: int, _device: str | None, _audible: bool) -> Player:
    from talkcli.engine.child.players.null import NullPlayer

    return NullPlayer(rate)


#: The players that `talk` knows by name. Where none is named the sound server is asked first: it begins at once, and
#: tells more than any program. Then the programs are tried, in this order: `aplay` first, as it opens the device before
#: it reads, so that a failure is known before a sample is lost, and as it is there on a robot without a desktop.
PLAYERS = {
    "aplay": Known("ALSA", "alsa-utils", _aplay),
    "pacat": Known("PulseAudio", "pulseaudio-utils", _pacat),
    "pw-cat": Known("PipeWire", "pipewire-bin", _pw_cat),
    "pulse": Known("the sound server, PulseAudio's or PipeWire's", "libpulse0", opens=sound_server),
    "null": Known("silent, in real time", opens=_null),
}
#: How the player begins that is a file; its path follows.
FILE = "file:"
_PROGRAMS = {name: each.command for name, each in PLAYERS.items() if each.command is not None}
#: The programs among them, and the package each comes in.
PACKAGES = {name: PLAYERS[name].package for name in _PROGRAMS}
*_OTHERS, _LAST = [f"{package} ({name})" for name, package in PACKAGES.items()]
#: What is said where none of them is there.
NO_PLAYER = f"no player found: install {', '.join(_OTHERS)} or {_LAST}"


def is_silent(player: str | None) -> bool:
    """Tell whether a player makes no sound by its nature, so that it needs no device."""
    return player is not None and (player == "null" or player.startswith(FILE))


def commands(player: str | None, device: str | None, rate: int, last: str | None = None) -> list[Command]:
    """Return the players to try, best first, `last` the one that worked last; CannotSpeak (no_player) for none."""
    if player is None:
        names = sorted((name for name in PACKAGES if on_path(name)), key=lambda name: name != last)
        if not names:
            raise CannotSpeak("no_player", NO_PLAYER)
        return [_PROGRAMS[name](rate, device) for name in names]
    if player in PACKAGES:
        if not on_path(player):
            raise CannotSpeak("no_player", f'player "{player}" not found: install {PACKAGES[player]}')
        return [_PROGRAMS[player](rate, device)]
    return [_custom(player, device, rate)]


def on_path(program: str, env: Mapping[str, str] | None = None) -> bool:
    """Return whether the program can be run; a name without a slash is looked for on the PATH: this process's, or of
    that environment.
    """
    places = [""] if os.sep in program else os.get_exec_path(env)
    paths = [os.path.join(place, program) for place in places]
    return any(os.path.isfile(each) and os.access(each, os.X_OK) for each in paths)


def _custom(player: str, device: str | None, rate: int) -> Command:
    import shlex

    try:
        parts = shlex.split(player)
    except ValueError as error:
        raise CannotSpeak("no_player", f"player command {player!r}: {str(error).lower()}") from error
    if not parts:
        raise CannotSpeak("no_player", "player command is empty: name a program that reads samples")
    argv = [part.replace("{rate}", str(rate)).replace("{device}", device or "default") for part in parts]
    if not on_path(argv[0]):
        raise CannotSpeak("no_player", f'player "{argv[0]}" not found')
    return Command(os.path.basename(argv[0]), tuple(argv))
