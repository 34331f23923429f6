"""How loud the output is: what is muted is played to its end, and not heard. Pure: what mixers print goes in."""

from __future__ import annotations

import re

from talkcli.doctor.findings import Finding, done, failed, warning
from talkcli.frozen import frozen

#: The check's name.
CHECK = "loudness"
#: Per cent below which nobody may hear it across a room.
_FAINT = 20
#: ALSA's controls that a loudspeaker hangs on, as `amixer scontrols` names them.
CONTROLS = ("Master", "PCM", "Speaker", "Headphone", "Digital")


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


def of_pactl(mute: str, volume: str) -> Level:
    """Return what `pactl get-sink-mute` and `get-sink-volume` say of the default sink."""
    return Level(
        "the default sink",
        "yes" in mute.lower(),
        _percent(volume),
        "pactl set-sink-mute @DEFAULT_SINK@ 0",
        "pactl set-sink-volume @DEFAULT_SINK@ 70%",
    )


def of_wpctl(text: str) -> Level:
    """Return what `wpctl get-volume @DEFAULT_AUDIO_SINK@` says: "Volume: 0.40 [MUTED]"."""
    found = re.search(r"Volume: (\d+(?:\.\d+)?)", text)
    percent = round(float(found[1]) * 100) if found else None
    return Level(
        "the default sink",
        "[MUTED]" in text,
        percent,
        "wpctl set-mute @DEFAULT_AUDIO_SINK@ 0",
        "wpctl set-volume @DEFAULT_AUDIO_SINK@ 0.7",
    )


def of_amixer(control: str, text: str) -> Level:
    """Return what `amixer sget CONTROL` says; on some channels of several is on."""
    switches = re.findall(r"\[(on|off)\]", text)
    muted = bool(switches) and "on" not in switches
    words = f"amixer sset {control}"
    return Level(control, muted, _percent(text), f"{words} unmute", f"{words} 70%")


def judge(levels: tuple[Level, ...], *, default: bool) -> list[Finding]:
    """Judge how loud it is; `default`: whether it is this output that is played to, as far as can be known."""
    if not levels:
        return []
    broken = failed if default else warning
    for level in levels:
        if level.muted:
            return [broken(CHECK, f"{level.name} is muted", level.unmute)]
        if level.percent == 0:
            return [broken(CHECK, f"{level.name} is at 0%", level.louder)]
    for level in levels:
        if level.percent is not None and level.percent < _FAINT:
            return [warning(CHECK, f"{level.name} is at {level.percent}%: few will hear it", level.louder)]
    shown = [f"{each.name} at {each.percent}%" if each.percent is not None else f"{each.name} on" for each in levels]
    return [done(CHECK, ", ".join(shown))]


def _percent(text: str) -> int | None:
    """Return the loudest of the channels."""
    found = [int(each) for each in re.findall(r"(\d+)%", text)]
    return max(found, default=None)
