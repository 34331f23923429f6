"""Whether anything is there that could sound, as files tell: nothing is opened or started, so that no device wakes.

That there is nothing is said only where it is certain: what settings of the user's name may be anywhere. Whether what
is there plays, a sentence shows.
"""

from __future__ import annotations

import contextlib
import os

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Mapping

#: The sink that PulseAudio and PipeWire make where they have no other (PipeWire calls it "Dummy Output"): nobody hears
#: it. No other is taken for one: echo cancellers, remaps, tunnels and effects lead on to a real device.
DUMMY = "auto_null"
#: Variables that name a sound server, or another configuration than the usual one.
_VARIABLES = ("PULSE_SERVER", "PULSE_CLIENTCONFIG", "PIPEWIRE_REMOTE", "ALSA_CONFIG_PATH")
#: Where a PulseAudio that serves all users listens.
_SYSTEM_WIDE = "/run/pulse"


def playing(nodes: str = "/dev/snd") -> list[str]:
    """Return the kernel's devices that play, such as /dev/snd/pcmC0D0p."""
    return [f"{nodes}/{each}" for each in _listed(nodes) if each.startswith("pcmC") and each.endswith("p")]


def sound_servers(env: Mapping[str, str], *uids: int) -> list[str]:
    """Return the sockets of PulseAudio and PipeWire that are there: by an environment, of these users, of all."""
    own = [env.get("XDG_RUNTIME_DIR"), *(f"/run/user/{each}" for each in uids)]
    found = [f"{each}/{socket}" for each in own if each for socket in ("pulse/native", "pipewire-0")]
    found += [f"{each}/native" for each in (env.get("PULSE_RUNTIME_PATH"), _SYSTEM_WIDE) if each]
    if env.get("PIPEWIRE_RUNTIME_DIR"):
        found.append(f"{env['PIPEWIRE_RUNTIME_DIR']}/pipewire-0")
    # Without a runtime directory PulseAudio makes one in /tmp, and a link to it.
    settings = f"{_settings(env)}/pulse"
    found += [f"{settings}/{each}/native" for each in _listed(settings) if each.endswith("-runtime")]
    return [each for each in dict.fromkeys(found) if os.path.exists(each)]


def nothing_sounds(env: Mapping[str, str], nodes: str = "/dev/snd", etc: str = "/etc") -> bool:
    """Whether there is nothing that this process's players could play to."""
    if playing(nodes) or any(env.get(each) for each in _VARIABLES) or sound_servers(env, os.getuid()):
        return False
    alsa = (f"{env.get('HOME', '')}/.asoundrc", f"{_settings(env)}/alsa/asoundrc", f"{etc}/asound.conf")
    pulse = [f"{each}/pulse/client.conf" for each in (_settings(env), etc)]
    pulse += [f"{each}.d/{name}" for each in pulse for name in _listed(f"{each}.d")]
    return not any(map(os.path.exists, alsa)) and not any(map(_names_a_server, pulse))


def _settings(env: Mapping[str, str]) -> str:
    return env.get("XDG_CONFIG_HOME") or f"{env.get('HOME', '')}/.config"


def _names_a_server(path: str) -> bool:
    """Whether this configuration of PulseAudio's clients names a server; the one that comes with it does not."""
    with contextlib.suppress(OSError), open(path, "rb") as file:
        return any(line.lstrip().startswith(b"default-server") for line in file)
    return False


def _listed(directory: str) -> list[str]:
    with contextlib.suppress(OSError):
        return sorted(os.listdir(directory))
    return []
