"""The rows of what runs until it is told to end: `talk serve` and `talk bridge`, with their options.

The rules of `commands` hold for this file, too, which it is a part of.
"""

from __future__ import annotations

from talkcli.cli.command import MODE, Command, option
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.option import FLAG, INTEGER, TEXT, WORD
from talkcli.goals.options import MAX_CHARACTERS, MAX_LEAD_IN, SETTINGS

if TYPE_CHECKING:
    from collections.abc import Mapping
    from collections.abc import Set as AbstractSet
    from typing import Any

#: The units of systemd's that each prints.
SERVE_UNITS = ("user", "system", "user-socket", "system-socket")
BRIDGE_UNITS = ("user", "system")

_SERVE = (
    *(each.at_start() for each in SETTINGS),
    # At two seconds a sentence, more than three minutes of speech that nobody can still want to hear; at most, five
    # hours, and to look at all that wait still takes no more than a millisecond or so.
    option("--max-queue", INTEGER, "Goals that may wait.", default=100, limits=(1, 10_000)),
    option("--max-text", INTEGER, "Characters of one text.", default=MAX_CHARACTERS, limits=(1, MAX_CHARACTERS)),
    # Each takes a descriptor of the 1,024 that a process usually has.
    option("--max-clients", INTEGER, "Clients at once.", default=256, limits=(1, None)),
    option(
        "--player",
        TEXT,
        "What plays the sound. One of pulse (the sound server), aplay, pacat and pw-cat; null (silent, in real time); "
        "file:PATH.wav; or a command that reads 16-bit mono PCM, with {rate} for its rate and {device} for the "
        "--device. [default: the first of the four that works]",
        metavar="PLAYER",
        env="TALK_PLAYER",
        offers="players",
    ),
    option(
        "--device",
        TEXT,
        "Device, by the player's own name for it. For aplay one that 'aplay -L' lists, such as plughw:1,0; for "
        "pulse and pacat one of 'pactl list short sinks'; for pw-cat the name of a node, as in 'pw-cli ls Node'. Name "
        "the --player, too.",
        metavar="NAME",
    ),
    option(
        "--lead-in",
        INTEGER,
        "Milliseconds of silence before a sentence; only where the output was idle: HDMI, USB and Bluetooth "
        "outputs fall asleep, and swallow what comes while they wake.",
        default=0,
        limits=(0, MAX_LEAD_IN),
        metavar="MS",
    ),
    option("--audible", FLAG, "Abort every sentence whose output is muted."),
    option(
        "--voice-memory",
        INTEGER,
        "Megabytes of memory that neural voices may take; past it those not used for longest are dropped.",
        default=300,
        limits=(0, 100_000),
        metavar="MB",
    ),
    option("--driver", TEXT, "A driver of pyttsx3's. [default: the one for this system]", metavar="NAME"),
    option("--socket-mode", MODE, "Who may connect: the socket's file mode.", default="0600"),
    option("--greeting", TEXT, "A sentence to speak at the start."),
    option(
        "--print-unit",
        TEXT,
        f"Print a systemd unit with these options, and end. One of {', '.join(SERVE_UNITS)}; it says where it goes.",
        metavar="UNIT",
        choices=SERVE_UNITS,
    ),
)


def _serve_rule(given: Mapping[str, Any], _: AbstractSet[str]) -> str | None:
    player = given["player"] or ""
    if given["device"] and player.startswith(("null", "file:")):
        return f"--device means nothing to the player {player}"
    if player == "file:":
        return "--player file: names no file: write file:PATH.wav"
    return None


SERVE = Command(
    name="serve",
    summary="Run the server, in the foreground.",
    about="""
    Run the server, in the foreground, until SIGTERM or Ctrl-C.

    It queues sentences and speaks one at a time; its log is on standard error. For systemd it prints its own
    units.
    """,
    runs="serve:serve",
    plain=False,
    asks=False,
    examples="""
    talk serve --rate 150
    talk serve --player null       no sound, same timing: for simulation and CI
    talk serve --print-unit user   a service for systemd, with how to install it
    """,
    exit_codes={
        0: "ended by SIGTERM or SIGINT; by a second one 128+n",
        1: "anything not named here; a bug says so",
        2: "usage: an option or a voice that there isn't",
        11: "this socket is served already, or its directory is not safe",
    },
    options=_SERVE,
    rule=_serve_rule,
)

_BRIDGE = (
    option("--name", WORD, "The robot's name, which no other robot has.", metavar="NAME"),
    option("--group", WORD, "Groups that it is in besides 'all'; several with commas.", metavar="GROUP"),
    option(
        "--allow",
        WORD,
        "Requests that are taken from afar.",
        default="say,cancel,status,wait,log,voices,pause,resume",
        metavar="LIST",
    ),
    option("--no-text", FLAG, "Leave what is said out of status and events."),
    option("--homeassistant", FLAG, "Be a device of Home Assistant's as well."),
    option(
        "--print-unit",
        TEXT,
        f"Print a systemd unit with these options, and end. One of {', '.join(BRIDGE_UNITS)}; it says where it goes.",
        metavar="UNIT",
        choices=BRIDGE_UNITS,
    ),
    option("--print-acl", FLAG, "Print who may do what on the broker; for mosquitto's acl_file."),
)


def _bridge_rule(given: Mapping[str, Any], _: AbstractSet[str]) -> str | None:
    if given["name"] is None and not given["print_acl"]:
        return "--name is missing: what the robot is called on the broker"
    return None


BRIDGE = Command(
    name="bridge",
    summary="Be a robot on an MQTT broker, in the foreground.",
    about="""
    Be the robot of this name on an MQTT broker, in the foreground, until SIGTERM or Ctrl-C.

    Who may write to it there can have it speak, by the server of this machine. Its log is on standard error.

    TALK_BROKER names the broker: mqtts://HOST, or mqtt://HOST without TLS. Beside it are TALK_MQTT_USER and
    TALK_MQTT_PASSWORD_FILE, and for certificates TALK_MQTT_CA, TALK_MQTT_CERT and TALK_MQTT_KEY, all three files.
    """,
    runs="bridge:bridge",
    plain=False,
    asks=False,
    examples="""
    TALK_BROKER=mqtts://broker talk bridge --name anna
    talk bridge --name anna --group warehouse,night --allow say,cancel
    talk bridge --name anna --print-unit system   a service for systemd
    talk bridge --print-acl                       for the broker
    """,
    exit_codes={
        0: "ended by SIGTERM or SIGINT",
        1: "anything not named here; a bug says so",
        2: "usage: a setting that is wrong or missing, or paho-mqtt is",
        11: "another bridge of this name is there already",
    },
    options=_BRIDGE,
    rule=_bridge_rule,
)
